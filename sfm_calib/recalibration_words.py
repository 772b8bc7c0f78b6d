"""What is to be known of a recalibration, beside what is said of any calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from graphs.problem import PriorMode
from sfm_calib import result
from sfm_calib.config import BaselineConfig, RigConfig
from sfm_calib.drift_record import DriftRecord
from sfm_calib.old_calibration import OldCalibration

OF_PLACE = ("rotation", "translation", "places")
UNUSABLE = "not usable: "  # as the verdict's reasons begin
MOST_REASONS = 3


def assumption(old: OldCalibration, old_sigma_px: float) -> str:
    """That an old calibration's sigmas are not its own."""
    return (
        f"{old.rig.path} states no sigmas: it is taken to be right to {old_sigma_px:g} px (rms) in "
        "the picture (--old-sigma-px)"
    )


def with_metres_of(scale: result.Scale, known: BaselineConfig | None) -> result.Scale:
    """The scale, called the old calibration's where a baseline of it gave the metres."""
    if known is None:
        return scale
    whose = " of the old calibration"
    ledger = tuple(one.model_copy(update={"what": one.what + whose}) for one in scale.ledger)
    a, b = known.cameras
    source = f"baseline {a} to {b}{whose}: {known.length_m:g} m"
    return scale.model_copy(update={"source": source, "ledger": ledger})


def messages_of(
    old: OldCalibration,
    config: RigConfig,
    wanted: PriorMode,
    used: PriorMode,
    known: BaselineConfig | None,
    stayed: Sequence[str],
    leaning: bool,
    drift: DriftRecord,
    verdict: result.Verdict,
) -> Iterator[str]:
    """For the verdict of the result, the weightiest first.

    known: the old baseline that gave the metres; stayed: cameras that are known not to
    have moved; leaning: sigmas of the result are the old calibration's, in part.
    """
    if drift.verdict == "replace" and not verdict.usable:
        yield _not_by_this(verdict)
    if wanted == "full" and used != "full":
        yield (
            "the old calibration contradicts the scan and was not believed (--prior full): the "
            "result is the scan's, with wide beliefs about the old one"
        )
    if known and _moved(drift) and not set(known.cameras) <= set(stayed):
        yield (
            f"metres are by the old distance of {' and '.join(known.cameras)}, and the rig has "
            "changed since: if that distance did too, all lengths are off by as much; measure one "
            "(scale in rig.yaml)"
        )
    if old.assumed and leaning:
        yield (
            "the old calibration states no sigmas: what is taken from it is as sure here as --old-"
            "sigma-px says"
        )
    yield from _of_rig_yaml(old, config)


def doubted(drift: DriftRecord, verdict: result.Verdict | None) -> DriftRecord:
    """The drift test, told that what it says to replace the old calibration by is not usable."""
    if drift.verdict != "replace" or verdict is None or verdict.usable:
        return drift
    return drift.model_copy(update={"lines": (*drift.lines, _not_by_this(verdict))})


def _not_by_this(verdict: result.Verdict) -> str:
    reasons = [m.removeprefix(UNUSABLE) for m in verdict.messages if m.startswith(UNUSABLE)]
    more = len(reasons) - MOST_REASONS
    told = "; ".join(reasons[:MOST_REASONS]) + (f"; and {more} more" if more > 0 else "")
    return f"the old calibration does not hold, but this scan cannot replace it: {told}"


def _moved(drift: DriftRecord) -> bool:
    return any(test.found and test.group in OF_PLACE for test in drift.tests)


def _of_rig_yaml(old: OldCalibration, config: RigConfig) -> Iterator[str]:
    """Which of two that speak of the same parameter is heard."""
    known = {camera.name: camera.named() for camera in old.rig.cameras}
    for name, said in config.cameras.items():
        if name not in known:
            continue
        if own := [p for p, value in said.params.items() if value != known[name][p]]:
            yield f"{name}: {', '.join(own)} as rig.yaml has it, not as the old calibration has"
        if held := [p for p in said.fixed if p not in own]:
            yield f"{name}: {', '.join(held)} held at the old calibration's, as rig.yaml says"
        placed = said.cam_from_rig
        if placed and (placed.sigma_rotation_deg or placed.sigma_translation):
            yield f"{name}: rig.yaml's cam_from_rig is believed beside the old calibration's"

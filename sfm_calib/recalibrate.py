"""The story of a recalibration: an old calibration and today's scan in; keep or replace out.

The scan is solved with the old calibration as no more than a start, or the centre of wide beliefs:
so the test for drift holds two witnesses against each other. Where they agree and the whole of the
old one is to be believed (`prior: full`), the graph is solved once more with it in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from pydantic import BaseModel, ConfigDict, Field

from graphs.compare import Stated
from graphs.consider import completed as with_old_errors
from graphs.consider import cov_difference, sensitivity
from graphs.covariance import Covariance
from graphs.ladder import Ladder
from graphs.problem import PriorMode, PriorRig
from graphs.refine import Refinement
from graphs.split_check import SplitCheck
from graphs.stated_covariance import CalibrationCovariance
from graphs.twin import Certificate
from sfm_calib.cache import Cache
from sfm_calib.calibrate import (
    Outcome,
    Stopwatch,
    certificate_of,
    checked_scan,
    choose_lens,
    enough_placed,
    own_covariance_of,
    refusals,
    remeasured,
    solve_problem,
)
from sfm_calib.config import BaselineConfig, RigConfig
from sfm_calib.contributions import contributions_of
from sfm_calib.drift import DriftOptions, judge
from sfm_calib.drift_record import DriftRecord
from sfm_calib.drift_sides import freed_groups, leaning_of, part_of, without_lengths
from sfm_calib.errors import CalibrationError
from sfm_calib.files import calibration_sha256
from sfm_calib.formats import CameraRig
from sfm_calib.guided import map_with_prior
from sfm_calib.images import Progress, Scan
from sfm_calib.learned.choice import refuse_learned
from sfm_calib.mapping import Mapped
from sfm_calib.nominal import check_config, start_from_config
from sfm_calib.old_calibration import OldCalibration, old_calibration, with_scale_of
from sfm_calib.partial import completed
from sfm_calib.prior import prior_of, started, with_lenses
from sfm_calib.provenance import Replaced
from sfm_calib.recalibration_record import Contribution, OldFile, Recalibration
from sfm_calib.recalibration_words import assumption, doubted, messages_of, with_metres_of
from sfm_calib.result import Calibration
from sfm_calib.run import Given, Run
from sfm_calib.summary import summarise


class RecalibrateOptions(BaseModel):
    """What is made of the old calibration."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    prior: PriorMode = "weak"
    """start: OLD only says where to start; weak: the wide beliefs of every calibration are centred
    on it; full: it is believed as far as its covariance says, unless the scan contradicts it."""
    free: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT"), Field(min_length=1)] = ("all",)
    """What is estimated anew: all, intrinsics, extrinsics, focal, principal_point, distortion,
    rotation, translation, a camera, or one of these of a camera (right.rotation)."""
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="OLD=SCAN")] = ()
    """Which cameras are the same, as name in OLD=name in SCAN; default: by name, else by order."""
    metres: Annotated[float | None, tyro.conf.arg(metavar="M"), Field(gt=0)] = None
    """How many metres the unit of OLD's lengths is, where the file does not say (0.001: mm)."""


@dataclass(frozen=True)
class Recalibrated:
    """The result with all cameras of the rig, and how it differs from the old one."""

    outcome: Outcome
    drift: DriftRecord


@dataclass(frozen=True)
class Solved:
    """An optimum under one use of the old calibration, and how sure it is."""

    refinement: Refinement
    covariance: CalibrationCovariance
    split: SplitCheck | None
    prior: PriorRig
    model: Covariance  # of noise and priors alone, before what is held has its errors
    cov_change: Covariance | None  # of it less the old calibration; None: they are independent
    baseline: BaselineConfig | None  # the old one that gave the metres
    ladder: Ladder | None  # of cameras that the old calibration lacks

    @property
    def side(self) -> Stated:
        """In the result's unit, for the maths."""
        unit = 1 / self.covariance.basis.unit
        return Stated(self.refinement.estimate.scaled(unit), self.covariance.stated)


def recalibrate(
    read: CameraRig,
    scan_path: Path,
    config: RigConfig,
    options: RecalibrateOptions,
    drift: DriftOptions,
    cache: Cache,
    progress: Progress,
    command: str = "",
) -> Recalibrated:
    """Test an old calibration by a scan, and calibrate its rig anew.

    drift: by what the old one is judged. As `calibrate`. Raises CalibrationError also where the
    two have no camera in common.
    """
    refuse_learned(config, "recalibrate")
    watch = Stopwatch()
    scan = checked_scan(scan_path, config, cache, progress, watch)

    def mapping(old: CameraRig, config: RigConfig) -> Mapped:
        mapped = map_with_prior(scan, old, config, cache, progress)
        return remeasured(mapped, scan, config, cache, progress) if config.refine else mapped

    return recalibrate_scan(
        read, scan, mapping, config, options, drift, progress, command, watch
    )  # fmt: skip


def recalibrate_scan(
    read: CameraRig,
    scan: Scan,
    mapping: Callable[[CameraRig, RigConfig], Mapped],
    config: RigConfig,
    options: RecalibrateOptions,
    drift: DriftOptions,
    progress: Progress,
    command: str,
    watch: Stopwatch,
) -> Recalibrated:
    """As `recalibrate`, of a scan that was read, or was never on disk.

    mapping: its tracks and rough places, given the old calibration in the scan's terms and a
    configuration with its lenses.
    """
    replaces = _replaced(read)
    if options.metres is not None:
        read = read.metric(options.metres)
    old = old_calibration(read, scan, config, options.cameras, drift)
    config = _with_reference(with_lenses(config, old.rig, scan.cameras), old, scan.cameras)
    check_config(config, scan)
    # What it refuses (a wrong word of --free) is refused before the minutes that mapping takes.
    _prior_of(old, "start", options.free, scan.cameras, config)
    with watch.stage("tracks and mapping"):
        mapped = mapping(old.rig, config)
    given = Given(scan, config, mapped, command)
    with enough_placed(mapped.problem, len(scan.images)):
        judged = _judged(given, old, options, drift, watch, progress)
    with watch.stage("certificate"):
        certificate = certificate_of(judged.best.refinement, config, progress)
    return _result(given, old, options, judged, certificate, watch.seconds, replaces)


@dataclass(frozen=True)
class Judged:
    """The scan's own optimum, what it says of the old calibration, and the optimum to hand out."""

    alone: Solved
    best: Solved
    drift: DriftRecord
    stayed: tuple[str, ...]  # cameras that kept their places, where it is known which moved


def _judged(
    given: Given,
    old: OldCalibration,
    options: RecalibrateOptions,
    drift: DriftOptions,
    watch: Stopwatch,
    progress: Progress,
) -> Judged:
    """Solve a scan by itself, test the old calibration, and solve with what of it still holds."""
    cameras, reference = given.scan.cameras, given.config.reference
    careful: PriorMode = "start" if options.prior == "start" else "weak"
    alone = _solve(given, old, careful, options.free, cameras, watch, progress)
    with watch.stage("drift"), refusals():
        found = _drift(given, old, alone, drift, options.free)
    stayed = _unmoved(found, reference)
    best = alone
    if options.prior == "full" and found.verdict != "replace":
        best = _solve(given, old, "full", options.free, cameras, watch, progress, alone)
    elif alone.baseline and len(stayed) > 1 and not set(alone.baseline.cameras) <= set(stayed):
        best = _solve(given, old, careful, options.free, stayed, watch, progress, alone)
    return Judged(alone, best, found, stayed)


def _with_reference(config: RigConfig, old: OldCalibration, names: Sequence[str]) -> RigConfig:
    """With the old calibration's reference, where the scan has it and nothing else is asked for."""
    if config.reference is not None and config.reference not in old.rig.names:
        raise CalibrationError(
            f"--reference {config.reference}: {old.rig.path} has no such camera, and places are "
            f"compared in a frame of both: name one of {', '.join(old.common(names))}"
        )
    return config.model_copy(update={"reference": config.reference or old.reference(names)})


def _prior_of(
    old: OldCalibration,
    mode: PriorMode,
    free: Sequence[str],
    names: Sequence[str],
    config: RigConfig,
) -> PriorRig:
    assert config.reference is not None
    return prior_of(old.rig, mode, free, names, config.reference)


def _solve(
    given: Given,
    old: OldCalibration,
    mode: PriorMode,
    free: Sequence[str],
    measured: Sequence[str],
    watch: Stopwatch,
    progress: Progress,
    before: Solved | None = None,
) -> Solved:
    """The optimum of a scan under one use of the old calibration, with its covariance.

    measured: cameras whose old distance may give the metres. before: a first one.
    """
    scan, config = given.scan, given.config
    prior = _prior_of(old, mode, free, scan.cameras, config)
    baseline = None
    if not prior.gives_scale and not config.scale.measured:
        baseline = old.baseline(measured)
        config = with_scale_of(config, baseline)
    problem = started(start_from_config(given.mapped.problem, config), prior)
    ladder = before.ladder if before else None
    if before is None:
        with watch.stage("choosing the lens"):
            ladder = choose_lens(problem, config, progress)
    which = f"{mode}, again" if before and before.prior.mode == mode else mode
    with watch.stage(f"solving ({which})"):
        refinement = solve_problem(problem, config, progress, ladder)
    with watch.stage(f"covariance ({which})"):
        covariance, split = own_covariance_of(refinement, config, progress)
        if not prior.held and mode != "full":
            return Solved(
                refinement, covariance, split, prior, covariance.model, None, baseline, ladder
            )
        with refusals():
            how = sensitivity(
                refinement.graph, refinement.estimate, refinement.values, covariance.basis
            )
        cov_change = cov_difference(covariance.stated, how)
    model, covariance = covariance.model, with_old_errors(covariance, how)
    return Solved(refinement, covariance, split, prior, model, cov_change, baseline, ladder)


def _drift(
    given: Given, old: OldCalibration, new: Solved, options: DriftOptions, free: Sequence[str]
) -> DriftRecord:
    """Of the cameras that both have."""
    names = old.common([camera.name for camera in new.refinement.estimate.cameras])
    before = part_of(old.own if new.cov_change is None else old.stated, names)
    after = part_of(new.side, names)
    notes, assumed = list(old.notes), old.assumed and new.cov_change is not None
    if assumed:
        notes.append(assumption(old, options.old_sigma_px))
    if new.prior.held:
        notes.append(f"only {', '.join(free)} was freed and judged: the rest counts as unchanged")
    # Lengths are compared where each side has metres of its own.
    scale_free = not (given.config.scale.measured and old.unit == "m")
    fixed = frozenset(f"{n}.{p}" for n, c in given.config.cameras.items() for p in c.fixed)
    tested = set(freed_groups(before, new.prior, fixed))
    if old.unit is None:  # its cameras are in one place: it says how they are turned
        before, after = without_lengths(before), without_lengths(after)
        tested = {(name, group) for name, group in tested if group != "translation"}
    record = judge(
        before, after, old.unit or "m", options,
        scale_free=scale_free, tested=tested,
        cov_difference=new.cov_change, notes=notes,
        n_frames=len(new.refinement.problem.frame_names), n_frames_old=old.rig.n_frames,
        leaning={} if new.prior.mode == "start" else leaning_of(new.refinement, new.model),
    ).record  # fmt: skip
    return record.model_copy(update={"old_sigma_px": options.old_sigma_px}) if assumed else record


def _unmoved(found: DriftRecord, reference: str | None) -> tuple[str, ...]:
    """Cameras that kept their places, the reference first, where it can be told which moved."""
    if len(found.moved) != 1:
        return ()
    stayed = (name for name in found.cameras if name not in found.moved[0])
    return tuple(sorted(stayed, key=lambda name: name != reference))


# ---- the result ----------------------------------------------------------------------------


def _result(
    given: Given,
    old: OldCalibration,
    options: RecalibrateOptions,
    judged: Judged,
    certificate: Certificate | None,
    seconds: dict[str, float],
    replaces: OldFile,
) -> Recalibrated:
    """All cameras of the rig, and what became of the old calibration."""
    best = judged.best
    run = Run(
        given.scan, given.config, given.mapped, best.refinement, best.covariance, seconds,
        given.command, best.ladder, best.split, certificate,
    )  # fmt: skip
    calibration, unit = summarise(run)
    found = doubted(judged.drift, calibration.verdict)
    calibration = _told(calibration, old, given.config, options, best, found, judged.stayed)
    record = Recalibration(old=replaces, prior=best.prior.mode, freed=options.free, drift=found)
    whole = completed(calibration, old.rig, record, judged.stayed or None)
    by = _size(whole) / _size(calibration)
    contributions = contributions_of(
        best.prior, best.side.scaled(by), judged.alone.side.scaled(by), best.covariance.model,
        whole.rig.metric,
    )  # fmt: skip
    whole = _recorded(whole, contributions, replaces)
    return Recalibrated(Outcome(whole, best.refinement, unit * by), found)


def _replaced(read: CameraRig) -> OldFile:
    return OldFile(path=str(read.path), sha256=calibration_sha256(read.path), format=read.format)


def _told(
    calibration: Calibration,
    old: OldCalibration,
    config: RigConfig,
    options: RecalibrateOptions,
    best: Solved,
    found: DriftRecord,
    stayed: Sequence[str],
) -> Calibration:
    """With what is to be known of it as a recalibration."""
    assert calibration.verdict is not None
    verdict, rig = calibration.verdict, calibration.rig
    used, missing = best.prior.mode, set(old.rig.names) - set(calibration.cameras)
    leaning = used == "full" or bool(best.prior.held or missing)
    said = messages_of(
        old, config, options.prior, used, best.baseline, stayed, leaning, found, verdict
    )
    scale = with_metres_of(rig.scale, best.baseline)
    return calibration.model_copy(
        update={
            "verdict": verdict.model_copy(update={"messages": (*said, *verdict.messages)}),
            "rig": rig.model_copy(update={"scale": scale}),
        }
    )


def _size(calibration: Calibration) -> float:
    """The farthest of the cameras that the scan has, from the reference; 1 of one camera."""
    lengths = [
        float(np.linalg.norm(placed.translation))
        for name, placed in calibration.rig.cam_from_rig.items()
        if not calibration.cameras[name].kept_from
    ]
    return max(lengths) or 1.0


def _recorded(
    whole: Calibration, contributions: dict[str, Contribution], old: OldFile
) -> Calibration:
    """With what the old calibration contributed, and as what takes its place."""
    assert whole.recalibration is not None
    replaces = Replaced(path=old.path, sha256=old.sha256)
    return whole.model_copy(
        update={
            "recalibration": whole.recalibration.model_copy(
                update={"contributions": contributions}
            ),
            "provenance": whole.provenance.model_copy(update={"replaces": replaces}),
        }
    )

"""The first screen: may I use this, what did it rest on, and how much was it in doubt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphs.problem import Problem, images_seen
from sfm_calib.report.digits import short
from sfm_calib.report.rows import Z_ALARM, TruthRow
from sfm_calib.result import OF_LENS, PRIOR_DECIDES_SHARE, Calibration, Verdict

Tone = Literal["good", "doubtful", "bad", "unknown"]


@dataclass(frozen=True)
class Banner:
    """The verdict in one line and the reasons below it."""

    tone: Tone
    text: str
    explanation: str


@dataclass(frozen=True)
class Figure:
    """One key figure: the number, what it counts, and a remark in small print."""

    value: str
    label: str
    remark: str = ""


def banner(calibration: Calibration) -> Banner:
    """What a reader in a hurry must know."""
    verdict = calibration.verdict
    if verdict is None:
        return Banner("unknown", "Not judged", "This file holds no verdict.")
    if not verdict.usable:
        return Banner("bad", "Not usable", "Do not deploy this calibration; the reasons follow.")
    reasons = _reasons_for_care(calibration, verdict)
    if reasons:
        return Banner("doubtful", "Usable with care", " ".join(reasons))
    text = "The solve converged, and the scan leaves nothing weakly determined."
    if believed := _decided_by_priors(calibration):
        what = "one parameter is" if believed == 1 else f"{believed} parameters are"
        text += f" By priors mostly, {what} decided: marked below."
    return Banner("good", "Usable", text)


def _reasons_for_care(calibration: Calibration, verdict: Verdict) -> list[str]:
    solve, reasons = calibration.solve, []
    if solve is not None and not solve.converged:
        reasons.append(f"The solver stopped before it converged: {solve.reason}.")
    if verdict.certificate is not None and not verdict.certificate.holds:
        reasons.append("On simulated twins of this scan its sigmas do not hold.")
    if verdict.split is not None and not verdict.split.agrees:
        reasons.append("Two halves of the scan contradict each other.")
    weak = [one for one in verdict.weak if one.kind != OF_LENS]
    if weak:
        what = "one direction" if len(weak) == 1 else f"{len(weak)} directions"
        text = f"The scan left {what} weakly determined"
        effects = [one.effect_px for one in weak if one.effect_px is not None]
        if effects:
            text += f": one sigma shows as up to {short(max(effects))} px in the picture"
        reasons.append(f"{text}.")
    if len(weak) < len(verdict.weak):
        reasons.append("It does not settle which lens this is; what hangs on that is told below.")
    return reasons


def _decided_by_priors(calibration: Calibration) -> int:
    """How many parameters that were estimated are more belief than data."""
    return sum(
        share > PRIOR_DECIDES_SHARE and entry.sigma.get(name, 1.0) > 0
        for entry in calibration.cameras.values()
        for name, share in entry.prior_share.items()
    )


def key_figures(calibration: Calibration, problem: Problem) -> tuple[Figure, ...]:
    """The numbers under the verdict."""
    solve, noise = calibration.solve, calibration.noise
    observations = problem.observations
    seen = images_seen(observations)
    n_images = solve.n_images if solve else len(seen)
    n_frames = solve.n_frames if solve else len(problem.frame_names)
    n_observations = solve.n_observations if solve else len(observations)
    n_points = solve.n_points if solve else len(np.unique(observations.point))
    n_cameras = len(calibration.cameras)
    cameras = "one camera" if n_cameras == 1 else f"{n_cameras} cameras"
    of_points = f"of {n_points:,} scene points"
    if solve is not None and (chosen := solve.selection):
        of_points += (
            f"; {chosen.kept:,} of {chosen.available:,} were chosen, "
            f"sigmas × {chosen.sigma_factor:.2f} for it"
        )
    figures = [
        Figure(f"{n_images:,}", "images used", f"{n_frames:,} frames, {cameras}"),
        Figure(f"{n_observations:,}", "observations", of_points),
    ]
    if noise is not None:
        figures.append(Figure(f"{noise.sigma_px:.3f} px", "noise sigma", "robust, one coordinate"))
    if solve is not None:
        figures.append(
            Figure(f"{solve.rms_px:.3f} px", "RMS residual", "gross mismatches set aside")
        )
    if noise is not None:
        remark = "stated sigma / sigma of noise alone, median"
        figures.append(Figure(f"× {noise.inflation:.2f}", "inflation", remark))
    return (*figures, _scale_figure(calibration))


def _scale_figure(calibration: Calibration) -> Figure:
    scale = calibration.rig.scale
    if not calibration.rig.metric:
        return Figure("not metric", "scale", scale.source.removeprefix("none: "))
    remark = f"from {scale.source}"
    if scale.sigma_relative:
        remark += f", ± {100 * scale.sigma_relative:.2g} %"
    return Figure("metric", "scale", remark)


def truth_summary(truth_rows: Sequence[TruthRow]) -> str:
    """How the errors compare with the stated sigmas, in one sentence."""
    judged = [row for row in truth_rows if np.isfinite(row.z)]
    if not judged:
        return "No quantity carries a sigma to judge its error by."
    size = np.abs([row.z for row in judged])
    worst = judged[int(np.argmax(size))]
    alarms = int((size > Z_ALARM).sum())
    beyond = "none" if alarms == 0 else str(alarms)
    return (
        f"Of {len(judged)} quantities, {100 * np.mean(size <= 1):.0f} % lie within 1 sigma of the "
        f"truth (68 % expected), {100 * np.mean(size <= 2):.0f} % within 2 (95 %) and {beyond} "
        f"beyond {Z_ALARM:.0f}. The largest is {worst.name} with z = {worst.z:+.1f}."
    )

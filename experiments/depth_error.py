"""Do depth errors grow as the textbooks say, and as large as our propagation says?

Question: sigma_Z with Z^2 by the noise of pixels, with Z by an error of the focal length, and 3-D
errors with r^3 by one of radial distortion; and do the depth sigmas of a calibrated scan hold?
Method: two cameras side by side; an error of known sigma is drawn and points are triangulated with
it, against `graphs.triangulation` and the closed forms of `experiments/depth_laws.py`, each law
where the textbook has it and where each camera errs alone. End to end: a scan of the rig, its
baseline measured, is calibrated as `sfm-calib calibrate` does, and points that it never saw, at
known depths, are measured with the result. Truth and calibration both have the first camera's frame
and metres: nothing is fitted between them.
Expectation: exponents 2, 1, 3 to EXPONENT_ROOM; Monte Carlo over propagated 1 to RATIO_ROOM; of
scans, depth errors over their stated sigma have an RMS as Z_RMS has it (`depth_answer.py`); all
within three standard errors.
Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., 12.6, and Gallup et al., Variable
baseline/resolution stereo, CVPR 2008 (sigma_Z); Brown, Close-range camera calibration, 1971 (r^3).
Run: sfm-calib run configs/studies/depth_error.yaml -o out/depth_error
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from experiments.depth_answer import Group, group_of, in_words, judged
from experiments.depth_figures import figures
from experiments.depth_laws import DEPTHS_M, EFFECTS, Effect, Pair, errors, exponent
from experiments.runner.protocol import Answer, AnswerTable, Finished, Row, Study, TrialOptions
from experiments.stereo import (
    PAIR,
    RADIAL,
    LensShape,
    calibrated,
    parallel_pair,
    points_at,
    seen_by_both,
)
from graphs.triangulation import triangulate, triangulated_covariance

POINTS = 30  # at each depth; they share their scan's calibration, more say little more


class DepthOptions(TrialOptions):
    """One rig, and what errs."""

    effect: Effect | Literal["scan"] = "scan"
    """What errs: one thing alone, or the calibration that a scan gives."""
    shape: LensShape = "straight"
    """Distortion of both lenses: none, or a usual barrel."""
    baseline_m: Annotated[float, Field(ge=0.02, le=0.5)] = 0.2
    """Between the two cameras."""
    focal_px: Annotated[float, Field(ge=100, le=4000)] = 600.0
    """Images are 1.5 times as wide: the field of view stays the same."""
    sigma_px: Annotated[float, Field(gt=0, le=2)] = 0.3
    """Noise of one pixel coordinate, of scans too."""
    draws: Annotated[int, Field(ge=2, le=100_000)] = 40
    """Of the error, where it is one thing alone."""
    frames: Annotated[int, Field(ge=5, le=1000)] = 30
    """Of the scan."""


def trial(options: DepthOptions, seed: int) -> Row:
    """Errors of points against depth or radius, their propagated sigma, and the textbook's."""
    kind = [*EFFECTS, "scan"].index(options.effect)
    rig = (
        list(RADIAL).index(options.shape),
        round(options.focal_px),
        round(1e4 * options.baseline_m),
    )
    rng = np.random.default_rng([seed, kind, *rig])
    if options.effect == "scan":
        return _scanned(options, rng)
    pair = Pair(options.focal_px, options.baseline_m, options.shape, options.sigma_px)
    found = errors(options.effect, pair, options.draws, rng)
    return {
        "at": found.at.tolist(),
        "rms_m": found.rms_m.tolist(),
        "bias_m": found.bias_m.tolist(),
        "propagated_m": found.propagated_m.tolist(),
        "closed_m": found.closed_m.tolist(),
        "exponent": exponent(found.at, found.rms_m),
        "exponent_propagated": exponent(found.at, found.propagated_m),
    }


def _scanned(options: DepthOptions, rng: np.random.Generator) -> Row:
    """Calibrate a scan, measure points that it never saw; squares are means over the points."""
    rig = parallel_pair(options.focal_px, options.baseline_m, options.shape)
    found = calibrated(rig, options.frames, options.sigma_px, rng)
    calibration, covariance = found.stated.estimate, found.stated.covariance
    points = np.array([points_at(found.truth, z, POINTS, rng) for z in DEPTHS_M])
    exact = seen_by_both(found.truth, points)
    noisy = exact + options.sigma_px * rng.standard_normal(exact.shape)
    told = triangulated_covariance(calibration, covariance, PAIR, exact, found.sigma_px)
    off = told.points[..., 2] - points[..., 2]
    measured = triangulate(calibration, PAIR, noisy, found.sigma_px)[..., 2] - points[..., 2]
    of_calibration, of_noise = told.cov_calibration[..., 2, 2], told.cov_noise[..., 2, 2]
    sigma = np.sqrt(of_calibration.mean(1))
    return {
        "at": DEPTHS_M.tolist(),
        "rms_m": np.sqrt((off**2).mean(1)).tolist(),
        "bias_m": off.mean(1).tolist(),
        "propagated_m": sigma.tolist(),
        "noise_m": np.sqrt(of_noise.mean(1)).tolist(),
        "z_square": (off**2 / of_calibration).mean(1).tolist(),
        "z_square_total": (measured**2 / (of_calibration + of_noise)).mean(1).tolist(),
        "exponent_propagated": exponent(DEPTHS_M, sigma),
        "sigma_px": found.sigma_px,
    }


def answer(trials: Sequence[Finished[DepthOptions]]) -> Answer:
    """Exponents and ratios of each effect over all rigs, against what is expected."""
    done = [t for t in trials if t.error is None]
    failed = len(trials) - len(done)
    kinds = dict.fromkeys((t.options.effect, t.options.shape) for t in done)
    groups = [group_of(e, s, [t.row for t in _of(done, e, s)]) for e, s in kinds]
    if not groups:
        return Answer("no trial was finished", None)
    holds = judged(groups)
    word = {True: "yes", False: "no", None: "too few trials to say"}[holds]
    lost = f"; {failed} of {len(trials)} trials failed" if failed else ""
    tables = (_overview(groups), _by_rig(done, list(kinds)))
    return Answer(f"{word}: {in_words(groups)}{lost}", holds, tables, figures(groups))


def _of(
    done: Sequence[Finished[DepthOptions]], effect: Effect | Literal["scan"], shape: LensShape
) -> list[Finished[DepthOptions]]:
    return [t for t in done if (t.options.effect, t.options.shape) == (effect, shape)]


def _overview(groups: Sequence[Group]) -> AnswerTable:
    columns = (
        "effect", "lens", "trials", "law", "expected exponent", "exponent", "±",
        "propagated exponent", "Monte Carlo / propagated", "±", "propagated / textbook",
        "z RMS with noise", "±", "bias / RMS, at most",
    )  # fmt: skip
    rows = [
        (
            g.effect, g.shape, g.trials, g.said, g.expected, *g.exponent, g.exponent_propagated,
            *g.ratio, g.of_closed, *g.total, g.bias,
        )
        for g in groups
    ]  # fmt: skip
    return AnswerTable("effects", "Each error alone, and scans", columns, tuple(rows))


def _by_rig(
    done: Sequence[Finished[DepthOptions]],
    kinds: Sequence[tuple[Effect | Literal["scan"], LensShape]],
) -> AnswerTable:
    rows = []
    for effect, shape in kinds:
        some = _of(done, effect, shape)
        rigs = sorted({(t.options.baseline_m, t.options.focal_px) for t in some})
        for rig in rigs:
            of_rig = [t for t in some if (t.options.baseline_m, t.options.focal_px) == rig]
            g = group_of(effect, shape, [t.row for t in of_rig])
            rows.append((effect, shape, *rig, g.trials, *g.exponent, *g.ratio))
    columns = (
        "effect", "lens", "baseline (m)", "focal (px)", "trials", "exponent", "±",
        "Monte Carlo / propagated", "±",
    )  # fmt: skip
    return AnswerTable("rigs", "Rig by rig", columns, tuple(rows))


STUDY = Study(DepthOptions, trial, answer)

"""Averaging removes the noise of pixels, not the calibration's error: by how much, and is it told?

Question: a rig is calibrated once, and measures the same depth, point or length N times. How far
does the mean err, where does averaging stop to pay, and does our split of a depth's sigma into
noise and calibration (`graphs.triangulation`, `uncertainty.depth` of every result) predict it?
Method: two cameras side by side are calibrated from a simulated scan, their baseline measured;
places that it never saw are measured REPEATS times with fresh noise, and means of N are held
against the truth, over many calibrations. The floor is what is measured without noise.
Expectation: the mean square error is noise^2 / N + calibration^2, both as stated by the one
calibration at hand with the noise that it estimated: RMSE over predicted as RMSE_RATIO has it at
N = 1 and at the most, the NEES of the floor as FLOOR_NEES, within three standard errors; averaging
stops to pay at N* = noise^2 / calibration^2, as predicted to NSTAR_ROOM or to three standard
errors, each and pooled over measures and ranges; and the noise that a scan estimates, from which
both parts follow, is the true one to SIGMA_ROOM or three standard errors.
Source: JCGM 100:2008 (GUM), 4.2.3 and F.1.1: repetition tells and reduces scatter alone; the names
after Der Kiureghian and Ditlevsen, Aleatory or epistemic? Does it matter?, 2009.
Run: sfm-calib run configs/studies/aleatory_epistemic.yaml -o out/aleatory_epistemic
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from experiments.averaging import (
    MEASURES,
    Measure,
    figures,
    in_words,
    judged,
    kind_of,
    tables,
)
from experiments.runner.protocol import Answer, Finished, Row, Study, TrialOptions
from experiments.stereo import PAIR, LensShape, calibrated, parallel_pair, points_at, seen_by_both
from graphs.compare import Stated
from graphs.frames import FloatArray
from graphs.propagation import cross_covariance
from graphs.triangulation import Triangulation, triangulate, triangulated_covariance

COUNTS = (1, 3, 10, 30, 100, 300, 1000)  # how many measurements a mean is of
REPEATS = COUNTS[-1]
RANGES_M = (1.0, 2.0, 4.0)
PLACES = 4  # at each range; they share the calibration, more say little more
END_FARTHER = 1.2  # a length goes from its range to so many times it, and across


class AveragingOptions(TrialOptions):
    """One rig and its scan."""

    frames: Annotated[int, Field(ge=5, le=1000)] = 30
    """Of the scan that calibrates."""
    sigma_px: Annotated[float, Field(gt=0, le=2)] = 0.3
    """Noise of one pixel coordinate, in the scan and of each measurement."""
    baseline_m: Annotated[float, Field(ge=0.05, le=0.5)] = 0.2
    """Between the two cameras."""
    focal_px: Annotated[float, Field(ge=100, le=4000)] = 600.0
    """Images are 1.5 times as wide."""
    shape: LensShape = "barrel"
    """Distortion of both lenses."""


# ---- one calibration -----------------------------------------------------------------------


@dataclass(frozen=True)
class Split:
    """One measure at some places: what noise and calibration are stated to do to it."""

    noise: FloatArray  # (places,) variance in m^2 of one measurement
    calibration: FloatArray  # (places,) variance in m^2


def trial(options: AveragingOptions, seed: int) -> Row:
    """Mean squares (in m^2, over places) of the errors of means, and of what was predicted.

    `MEASURE_square` goes range by range, in each by `n`; all others are one a range.
    """
    rng = np.random.default_rng([seed, options.frames, round(1e4 * options.baseline_m)])
    rig = parallel_pair(options.focal_px, options.baseline_m, options.shape)
    found = calibrated(rig, options.frames, options.sigma_px, rng)
    near = np.array([points_at(found.truth, z, PLACES, rng) for z in RANGES_M])
    far = np.array([points_at(found.truth, END_FARTHER * z, PLACES, rng) for z in RANGES_M])
    ends = np.stack([near, far], axis=2)  # (ranges, places, 2, 3)
    exact = seen_by_both(found.truth, ends)
    told = triangulated_covariance(
        found.stated.estimate, found.stated.covariance, PAIR, exact, found.sigma_px
    )
    noise = options.sigma_px * rng.standard_normal((REPEATS, *exact.shape))
    measured = triangulate(found.stated.estimate, PAIR, exact + noise, found.sigma_px)
    splits = split(told, found.stated)
    row: dict[str, list[float] | float] = {
        "range_m": list(RANGES_M),
        "n": [float(n) for n in COUNTS],
        "sigma_px": found.sigma_px,
    }
    for measure in MEASURES:
        true, floor, drawn = (_measured(measure, p) for p in (ends, told.points, measured))
        stated, off = splits[measure], floor - true
        row[f"{measure}_square"] = squares_of_means(drawn - true).ravel().tolist()
        row[f"{measure}_noise"] = stated.noise.mean(1).tolist()
        row[f"{measure}_calibration"] = stated.calibration.mean(1).tolist()
        row[f"{measure}_floor"] = (off**2).sum(-1).mean(1).tolist()
        row[f"{measure}_nees"] = _nees(off, measure, told, stated).mean(1).tolist()
    return row


def _measured(measure: Measure, ends: FloatArray) -> FloatArray:
    """What is measured (..., k) of ends (..., 2, 3): in the first camera's frame, all in m."""
    if measure == "depth":
        return np.linalg.norm(ends[..., 0, :], axis=-1, keepdims=True)
    if measure == "point":
        return ends[..., 0, :]
    return np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1, keepdims=True)


def squares_of_means(off: FloatArray) -> FloatArray:
    """Mean square (ranges, counts) of means of N of the errors (REPEATS, ranges, places, k).

    All means of N that do not overlap, but for what does not fill one.
    """
    squares = []
    for n in COUNTS:
        blocks = REPEATS // n
        means = off[: blocks * n].reshape(blocks, n, *off.shape[1:]).mean(1)
        squares.append((means**2).sum(-1).mean((0, 2)))
    return np.stack(squares, axis=1)


def split(told: Triangulation, stated: Stated) -> dict[Measure, Split]:
    """What is stated of depths and points of the near ends, and of the lengths to the far ends.

    A length's two ends share the calibration: its sigma is that of their difference.
    """
    along = told.points[..., 1, :] - told.points[..., 0, :]
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    of_ends = told.cov_noise.sum(-3)
    by = np.einsum(
        "...i,...ij->...j",
        along,
        told.by_calibration[..., 1, :, :] - told.by_calibration[..., 0, :, :],
    )
    names = told.names
    of_calibration = cross_covariance(stated.covariance, names, names)
    near_noise, near_calibration = told.cov_noise[..., 0, :, :], told.cov_calibration[..., 0, :, :]
    return {
        "depth": Split(
            told.sigma_depth_noise[..., 0] ** 2, told.sigma_depth_calibration[..., 0] ** 2
        ),
        "point": Split(
            np.trace(near_noise, axis1=-2, axis2=-1),
            np.trace(near_calibration, axis1=-2, axis2=-1),
        ),
        "length": Split(
            np.einsum("...i,...ij,...j->...", along, of_ends, along),
            np.einsum("...i,ij,...j->...", by, of_calibration, by),
        ),
    }


def _nees(off: FloatArray, measure: Measure, told: Triangulation, stated: Split) -> FloatArray:
    """Normalised squared error (ranges, places) of the floor, a degree of freedom."""
    if measure != "point":
        normalised: FloatArray = off[..., 0] ** 2 / stated.calibration
        return normalised
    cov = told.cov_calibration[..., 0, :, :]
    weighed = np.linalg.solve(cov, off[..., None])[..., 0]
    result: FloatArray = (off * weighed).sum(-1) / 3
    return result


# ---- all calibrations ----------------------------------------------------------------------


def answer(trials: Sequence[Finished[AveragingOptions]]) -> Answer:
    """Errors of means against what was predicted, by rig, measure and range."""
    done = [t for t in trials if t.error is None]
    if not done:
        return Answer("no trial was finished", None)
    every = list(dict.fromkeys(t.options for t in done))
    kinds = [
        kind_of(name, options.sigma_px, [t.row for t in done if t.options == options])
        for options, name in zip(every, _names(every), strict=True)
    ]
    holds = judged(kinds)
    word = {True: "yes", False: "no", None: "too few trials to say"}[holds]
    failed = len(trials) - len(done)
    lost = f"; {failed} of {len(trials)} trials failed" if failed else ""
    curves = [c for kind in kinds for c in kind.curves]
    return Answer(f"{word}: {in_words(kinds)}{lost}", holds, tables(kinds), figures(curves))


def _names(kinds: Sequence[AveragingOptions]) -> list[str]:
    """What tells each from the others; of one alone, its frames."""
    every = [one.model_dump() for one in kinds]
    told = [key for key in every[0] if len({one[key] for one in every}) > 1] or ["frames"]
    return [", ".join(f"{key} {one[key]}" for key in told) for one in every]


STUDY = Study(AveragingOptions, trial, answer)

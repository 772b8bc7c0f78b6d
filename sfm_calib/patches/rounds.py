"""Rounds of matching patches and solving, until the cameras show every track as it was matched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from graphs.build import GraphOptions, build
from graphs.frames import FloatArray
from graphs.losses import SCALE_95
from graphs.problem import BoolArray, IntArray, Observations, Problem, residuals_px
from graphs.refine import ROUGH_LOSS, ROUGH_STEPS, ROUND_TOLERANCES, noise_of
from graphs.selection import select_tracks, well_seen
from graphs.solve import solve
from graphs.threads import at_most
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress
from sfm_calib.patches.crops import Images
from sfm_calib.patches.match import Matches, Sights, match_patches
from sfm_calib.patches.slopes import normals_of
from sfm_calib.patches.warps import HALF, warps_of
from sfm_calib.torch_import import Device

FILE = "patches.npz"
VERSION = 1  # counted up where something else is found: caches ask
# What is left out, of rendered scans, errs by half a pixel and more; what is weighed by its own
# sigma below that does no harm.
LEAST_LIKENESS = 0.7
MOST_SIGMA_PX = 0.5
# Where the others of a track agree to a thousandth, what is merely alike is something before it:
# of patches that were covered 17 in 100 pass without this rule, and none of a real scan fails it.
CLEARLY_UNLIKE, MUCH_MORE = 0.1, 15.0
FLOOR_PX = 0.01  # of the sigma: what interpolating and a surface's shape leave at the least
LEAST_MATCHED = 0.2  # of the observations: of scans that went well nine in ten are
MOST_ROUNDS = 3
Values = TypeVar("Values", bound=NDArray[Any])
BENT = 0.05  # samples at a patch's edge, of what no affine change makes of it: a lean of 0.02


@dataclass(frozen=True)
class Job:
    """What is matched, and how."""

    rough: Problem
    image: IntArray  # (n_obs,) number of each observation's image
    paths: Sequence[Path]  # of the images, by number
    graph_options: GraphOptions
    min_parallax_deg: float
    device: Device


def match_in_rounds(job: Job, n_threads: int, place: Path, progress: Progress) -> None:
    """Match all tracks; those that the cameras, as they then are, show in another way again.

    What was found is kept in a folder, as `load_state` reads it. Raises CalibrationError where
    too few observations can be matched or an image or the device cannot be had, and ValueError
    where they determine too little.
    """
    state, images = State.before(job.rough), Images(job.paths)
    with at_most(n_threads):
        for number in range(MOST_ROUNDS):
            if number:
                state = solved(state, job)
            rows = to_be_matched(state, number)
            if not rows.size:
                break
            state = matched(state, rows, images, job, progress)
    np.savez(place / FILE, pixels=state.pixels, cov_px=state.cov_px, good=state.good)


def load_state(rough: Problem, place: Path) -> State:
    """What `match_in_rounds` kept of this problem; its estimate is still the rough one."""
    with np.load(place / FILE) as file:
        return replace(State.before(rough), **file)


@dataclass(frozen=True)
class State:
    """Where a rough problem's observations are, round after round."""

    now: Problem  # the rough one, with its keypoints and the latest estimate
    pixels: FloatArray  # (n_obs, 2)
    cov_px: FloatArray  # (n_obs, 2, 2)
    bend: FloatArray  # (n_obs, 2, 3) of the warps by which they were matched
    fitted: FloatArray  # (n_obs, 2, 2) px a sample, as they were matched; NaN: not yet
    good: BoolArray  # (n_obs,) matched

    @staticmethod
    def before(rough: Problem) -> State:
        seen = replace(rough.observations, relative_sigma=None)
        square, bend = np.full((len(seen), 2, 2), np.nan), np.full((len(seen), 2, 3), np.nan)
        good = np.ones(len(seen), dtype=bool)
        return State(replace(rough, observations=seen), seen.pixels, square, bend, square, good)

    @cached_property
    def normals(self) -> FloatArray:
        """Of the surfaces (n_points, 3), as far as patches were matched."""
        fitted = np.where(self.good[:, None, None], self.fitted, np.nan)
        return normals_of(self.now.initial, self.now.observations, fitted)

    def measured(self) -> Observations:
        """The observations as they are now; those that are not good mean nothing."""
        cov_px = np.where(self.good[:, None, None], self.cov_px, np.eye(2))
        cov_px = cov_px + FLOOR_PX**2 * np.eye(2)
        sigma = np.linalg.det(cov_px) ** 0.25
        return replace(
            self.now.observations,
            pixels=self.pixels,
            relative_sigma=sigma / np.median(sigma[self.good]),
            noise_shape=cov_px / sigma[:, None, None] ** 2,
            matched_sigma_px=sigma,
        )


def to_be_matched(state: State, number: int) -> IntArray:
    """Observations of tracks that look different now or, once, were not found whole."""
    if number == 0:
        return np.arange(len(state.good))
    point, n_points = state.now.observations.point, len(state.now.initial.points)
    after = warps_of(state.now.initial, state.now.observations, state.pixels, state.normals)
    change = HALF**2 * np.abs(after.bend - state.bend).max((1, 2))
    odd = state.good & (change > BENT)
    if number == 1:
        odd |= ~state.good
    whole = np.bincount(point, state.good, minlength=n_points) > 1
    is_odd = np.bincount(point, odd, minlength=n_points) > 0
    result: IntArray = np.flatnonzero((whole & is_odd)[point])
    return result


def matched(state: State, rows: IntArray, images: Images, job: Job, progress: Progress) -> State:
    """The state after these rows, of whole tracks, were matched.

    Raises CalibrationError where most observations have no match.
    """
    now, seen = state.now, state.now.observations.subset(rows)
    projected = seen.pixels + residuals_px(now.initial, seen)
    middle = np.where(state.good[rows, None], state.pixels[rows], projected)
    sights = Sights(now.initial, seen, middle, state.normals, job.image[rows], images)
    found = match_patches(sights, job.device, progress)
    good = _put(state.good, rows, is_good(found, seen.point))
    if good.mean() < LEAST_MATCHED:
        raise CalibrationError(
            f"only {good.sum():,} of {len(good):,} observations look alike in the images of their "
            f"track (needs {LEAST_MATCHED:.0%}): calibrate without --refine"
        )
    return State(
        now,
        _put(state.pixels, rows, found.pixels),
        _put(state.cov_px, rows, found.cov_px),
        _put(state.bend, rows, found.bend),
        _put(state.fitted, rows, found.fitted),
        good,
    )


def _put(values: Values, rows: IntArray, new: Values) -> Values:
    """Values with those of some rows replaced."""
    result = values.copy()
    result[rows] = new
    return result


def is_good(found: Matches, point: IntArray) -> BoolArray:
    """Which observations, of the points (n_obs,), look like the rest at a place that is known."""
    with np.errstate(invalid="ignore"):
        sigma_px = np.abs(np.linalg.det(found.cov_px)) ** 0.25
    unlike = 1 - found.likeness
    odd = (unlike > CLEARLY_UNLIKE) & (unlike > MUCH_MORE * medians(unlike, point))
    return (found.likeness >= LEAST_LIKENESS) & (sigma_px <= MOST_SIGMA_PX) & ~odd


def medians(values: FloatArray, label: IntArray) -> FloatArray:
    """The lower median of the values (n,) with each one's label (n,)."""
    order = np.lexsort((values, label))
    _, first, which, count = np.unique(
        label[order], return_index=True, return_inverse=True, return_counts=True
    )
    result = np.empty(len(values))
    result[order] = values[order][(first + (count - 1) // 2)[which]]
    return result


def solved(state: State, job: Job) -> State:
    """The state with the estimate that its observations lead to.

    Raises ValueError where they determine too little.
    """
    now, measured = state.now, state.measured()
    point, frame = measured.point, measured.frame
    part = replace(now, observations=measured.subset(state.good))
    rows = state.good & well_seen(part, job.min_parallax_deg)[point]
    few = select_tracks(part, job.min_parallax_deg)
    rough = replace(
        job.graph_options, sigma_px=noise_of(few), loss=ROUGH_LOSS, loss_scale=SCALE_95[ROUGH_LOSS]
    )
    found, _, _ = solve(build(few, rough), ROUGH_STEPS, ROUND_TOLERANCES[0])
    points, placed = now.initial.points.copy(), list(now.initial.rig_from_world)
    points[np.unique(point[rows])] = found.points
    for index, transform in zip(np.unique(frame[rows]), found.rig_from_world, strict=True):
        placed[index] = transform
    initial = replace(found, points=points, rig_from_world=tuple(placed))
    return replace(state, now=replace(now, initial=initial))

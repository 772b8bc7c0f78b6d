"""`--refine`: every track measured anew, by least-squares matching of its patches.

Keypoints scatter by 0.2 to 1 px, each by itself. Once the cameras are roughly known, what each
image shows of a point can be laid over what the others show, which is good to some hundredths.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphs.build import GraphOptions, build
from graphs.frames import FloatArray
from graphs.losses import SCALE_95
from graphs.problem import BoolArray, IntArray, Observations, Problem, residuals_px
from graphs.refine import ROUGH_LOSS, ROUGH_STEPS, ROUND_TOLERANCES, noise_of, refine
from graphs.selection import compact, select_tracks, well_seen
from graphs.solve import solve
from graphs.threads import thread_count
from graphs.track_building import joined_at_spots
from sfm_calib.cache import Cache
from sfm_calib.config import Options
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan
from sfm_calib.patches.match import Matches, Sights, load_matches, match_patches
from sfm_calib.patches.warps import warps_of
from sfm_calib.torch_import import check_torch, torch_versions
from sfm_calib.worker import run_apart

# What is left out, of rendered scans, errs by half a pixel and more; what is weighed by its own
# sigma below that does no harm.
LEAST_LIKENESS = 0.7
MOST_SIGMA_PX = 0.3
# Where the others of a track agree to a thousandth, what is merely alike is something before it:
# of patches that were covered 17 in 100 pass without this rule, and none of a real scan fails it.
CLEARLY_UNLIKE, MUCH_MORE = 0.1, 15.0
FLOOR_PX = 0.01  # of the sigma: what interpolating and a surface's shape leave at the least
LEAST_MATCHED = 0.2  # of the observations: of scans that went well nine in ten are
MOST_ROUNDS = 3
WHO = "matching patches"  # in messages, where it is ended from outside
WARP_CHANGED = 0.03  # of its size: a patch's edge then lies a fifth of a sample elsewhere


@dataclass(frozen=True)
class Refined:
    """A problem of matched observations, and what became of those that it came from."""

    problem: Problem
    n_before: int
    moved_px: float  # median

    @property
    def message(self) -> str:
        """One line on what was done."""
        return (
            f"patches were matched: {len(self.problem.observations):,} of {self.n_before:,} "
            f"observations agree with the other views of their track, and moved by "
            f"{self.moved_px:.2f} px (median)"
        )


def refine_tracks(
    problem: Problem,
    scan: Scan,
    graph_options: GraphOptions,
    options: Options,
    cache: Cache,
    progress: Progress,
) -> Refined:
    """The problem with its observations measured anew in the scan's images.

    It is solved roughly before, for the warps, and after each round: tracks are matched again that
    the cameras as they are now show in another way, or that were not found whole.
    Raises CalibrationError where too few observations can be matched, or torch is missing, and
    ValueError as `graphs.refine.refine`.
    """
    check_torch("--refine")
    rough = refine(
        joined_at_spots(problem), graph_options, options.min_parallax_deg, options.max_observations,
        on_iteration=lambda iteration, cost: progress("solving roughly", iteration, 0),
    ).problem  # fmt: skip
    state = _State.before(rough)
    for number in range(MOST_ROUNDS):
        again = _to_be_matched(state, number)
        if not again.size:
            break
        state = _matched(state, again, scan, options, cache, progress, number)
        state = _solved(state, graph_options, options)
    moved = np.linalg.norm(state.pixels - rough.observations.pixels, axis=1)[state.good]
    final = compact(state.now, state.measured().subset(state.good))
    return Refined(final, len(state.good), float(np.median(moved)))


@dataclass(frozen=True)
class _State:
    """Where a rough problem's observations are, round after round."""

    now: Problem  # the rough one, with its keypoints and the latest estimate
    pixels: FloatArray  # (n_obs, 2)
    cov_px: FloatArray  # (n_obs, 2, 2)
    linear: FloatArray  # (n_obs, 2, 2) px a sample, of the warps by which they were matched
    good: BoolArray  # (n_obs,) matched

    @staticmethod
    def before(rough: Problem) -> _State:
        seen = replace(rough.observations, relative_sigma=None)
        square = np.full((len(seen), 2, 2), np.nan)
        good = np.ones(len(seen), dtype=bool)
        return _State(replace(rough, observations=seen), seen.pixels, square, square, good)

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


def _to_be_matched(state: _State, number: int) -> IntArray:
    """Observations of tracks that look different now or, once, were not found whole."""
    if number == 0:
        return np.arange(len(state.good))
    point, n_points = state.now.observations.point, len(state.now.initial.points)
    after = warps_of(state.now.initial, state.now.observations, state.pixels).linear
    with np.errstate(invalid="ignore"):
        known = np.abs(np.linalg.det(state.linear)) > 0
    change = np.linalg.solve(np.where(known[:, None, None], state.linear, np.eye(2)), after)
    with np.errstate(invalid="ignore"):
        odd = state.good & (np.abs(change - np.eye(2)).max((1, 2)) > WARP_CHANGED)
    if number == 1:
        odd |= ~state.good
    whole = np.bincount(point, state.good, minlength=n_points) > 1
    is_odd = np.bincount(point, odd, minlength=n_points) > 0
    result: IntArray = np.flatnonzero((whole & is_odd)[point])
    return result


def _matched(
    state: _State,
    rows: IntArray,
    scan: Scan,
    options: Options,
    cache: Cache,
    progress: Progress,
    number: int,
) -> _State:
    """The state after these rows, of whole tracks, were matched.

    Raises CalibrationError where most observations have no match.
    """
    now, seen = state.now, state.now.observations.subset(rows)
    projected = seen.pixels + residuals_px(now.initial, seen)
    middle = np.where(state.good[rows, None], state.pixels[rows], projected)
    of_image = {(image.camera, image.frame): i for i, image in enumerate(scan.images)}
    frame = [scan.frames.index(name) for name in now.frame_names]
    image = np.array([of_image[c, frame[f]] for c, f in zip(seen.camera, seen.frame, strict=True)])
    paths = [scan.root / one.path for one in scan.images]
    sights = Sights(now.initial, seen, middle, image, paths)
    place = cache.stage(
        f"patches{number}",
        [_digest(sights), scan.hashes, options.device, torch_versions()],
        lambda to: run_apart(
            match_patches, (sights, options.device, thread_count(), to), progress, WHO
        ),
    )
    found = load_matches(place)
    pixels, cov_px, linear = (one.copy() for one in (state.pixels, state.cov_px, state.linear))
    good = state.good.copy()
    pixels[rows], cov_px[rows], linear[rows] = found.pixels, found.cov_px, found.linear
    good[rows] = is_good(found, seen.point)
    if good.mean() < LEAST_MATCHED:
        raise CalibrationError(
            f"only {good.sum():,} of {len(good):,} observations look alike in the images of their "
            f"track (needs {LEAST_MATCHED:.0%}): calibrate without --refine"
        )
    return _State(now, pixels, cov_px, linear, good)


def is_good(found: Matches, point: IntArray) -> BoolArray:
    """Which observations, of the points (n_obs,), look like the rest at a place that is known."""
    with np.errstate(invalid="ignore"):
        sigma_px = np.abs(np.linalg.det(found.cov_px)) ** 0.25
    unlike = 1 - found.likeness
    odd = (unlike > CLEARLY_UNLIKE) & (unlike > MUCH_MORE * _medians(unlike, point))
    return (found.likeness >= LEAST_LIKENESS) & (sigma_px <= MOST_SIGMA_PX) & ~odd


def _medians(values: FloatArray, label: IntArray) -> FloatArray:
    """The lower median of the values (n,) with each one's label (n,)."""
    order = np.lexsort((values, label))
    _, first, which, count = np.unique(
        label[order], return_index=True, return_inverse=True, return_counts=True
    )
    result = np.empty(len(values))
    result[order] = values[order][(first + (count - 1) // 2)[which]]
    return result


def _solved(state: _State, graph_options: GraphOptions, options: Options) -> _State:
    """The state with the estimate that its observations lead to.

    Raises ValueError where they determine too little.
    """
    now, measured = state.now, state.measured()
    point, frame = measured.point, measured.frame
    part = replace(now, observations=measured.subset(state.good))
    rows = state.good & well_seen(part, options.min_parallax_deg)[point]
    few = select_tracks(part, options.min_parallax_deg)
    rough = replace(
        graph_options, sigma_px=noise_of(few), loss=ROUGH_LOSS, loss_scale=SCALE_95[ROUGH_LOSS]
    )
    found, _, _ = solve(build(few, rough), ROUGH_STEPS, ROUND_TOLERANCES[0])
    points, placed = now.initial.points.copy(), list(now.initial.rig_from_world)
    points[np.unique(point[rows])] = found.points
    for index, transform in zip(np.unique(frame[rows]), found.rig_from_world, strict=True):
        placed[index] = transform
    initial = replace(found, points=points, rig_from_world=tuple(placed))
    return replace(state, now=replace(now, initial=initial))


def _digest(sights: Sights) -> str:
    """Of everything that matching depends on but the images."""
    start, seen = sights.estimate, sights.seen
    places = [[t.rotation, t.translation] for t in (*start.cam_from_rig, *start.rig_from_world)]
    arrays: list[NDArray[Any]] = [camera.params for camera in start.cameras]
    arrays += [one for place in places for one in place]
    arrays += [start.points, sights.middle, sights.image, seen.point, seen.camera, seen.frame]
    arrays += [] if seen.feature_scale is None else [seen.feature_scale]
    text = repr([(camera.lens, camera.size) for camera in start.cameras])
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()

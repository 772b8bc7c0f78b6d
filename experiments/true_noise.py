"""The noise of a rendered scan's observations, held against its true cameras and places."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from graphs.build import GraphOptions, build
from graphs.clusters import euclidean, homogeneous
from graphs.frames import FloatArray, Transform
from graphs.losses import LossName
from graphs.noise import RAYLEIGH_MEDIAN, left_by_point, residual_lengths
from graphs.problem import (
    BoolArray,
    Estimate,
    Observations,
    Problem,
    residuals_px,
    whitened,
)
from graphs.refine import noise_of, residuals
from graphs.selection import compact
from graphs.threads import threads
from graphs.track_building import nearest_points, rays_of
from graphs.tracks import triangulate
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import CameraRig

QUANTILE = 0.9
FAR = 4.0  # sigmas: of Gaussian errors 3 in 10,000 are longer


@dataclass(frozen=True)
class Noise:
    """Of the pixel coordinates of a scan's observations."""

    sigma_px: float  # robust, by the median length
    quantile_px: float  # 90 % of the errors are no longer
    weighed_px: float  # robust, of an observation whose relative sigma is 1: as a solve states it


def true_noise(problem: Problem, truth: Estimate) -> Noise:
    """The noise of a problem's observations, from the truth of its cameras and frames.

    Each point is where its own observations put it, seen by the true cameras; what it takes of
    them for its three numbers is given back. `truth` holds no points. Mismatches, far off a robust
    fit, take no part in placing points and are counted with the rest; points with less than two
    others are left out. Raises ValueError where nothing can be projected.
    """
    robust = triangulated(begun(problem, truth), "cauchy")
    far = noise_about(robust.initial, robust.observations).weighed_px * FAR
    with np.errstate(invalid="ignore"):
        good = residual_lengths(robust, residuals(robust)) < far
    often = np.bincount(robust.observations.point[good], minlength=len(robust.initial.points))
    kept = often[robust.observations.point] > 1
    robust = compact(robust, robust.observations.subset(kept))
    good = good[kept]
    fitted = triangulated(compact(robust, robust.observations.subset(good)), "none")
    everywhere = replace(fitted.initial, rig_from_world=robust.initial.rig_from_world)
    return noise_about(everywhere, robust.observations, good)


def begun(problem: Problem, truth: Estimate) -> Problem:
    """The problem with the true cameras and frames, and points nearest to where these look.

    Observations that a true camera cannot have made are left out, with points that lose all but
    one of theirs.
    """
    seen = problem.observations
    centres, rays = rays_of(truth, seen)
    known = np.isfinite(rays).all(axis=1)
    known &= np.bincount(seen.point[known], minlength=len(problem.initial.points))[seen.point] > 1
    blank = replace(truth, points=np.zeros_like(problem.initial.points))
    start = compact(replace(problem, initial=blank), seen.subset(known))
    points = nearest_points(centres[known], rays[known], start.observations.point)
    return replace(start, initial=replace(start.initial, points=points))


def triangulated(problem: Problem, loss: LossName) -> Problem:
    """The problem with its points where its cameras and frames see them, these held as they are."""
    graph = build(problem, GraphOptions(noise_of(problem), loss))
    with threads() as pool:
        start = homogeneous(graph.tracks, problem.initial.points)
        ended, _ = triangulate(graph.tracks, graph.variables(graph.initial), start, pool)
    points = euclidean(graph.tracks, ended, problem.initial.points)
    return replace(problem, initial=replace(problem.initial, points=points))


def noise_about(estimate: Estimate, seen: Observations, fitted: BoolArray | None = None) -> Noise:
    """The noise of observations about an estimate of which only the points were fitted to them.

    fitted (n_obs,): to which; all, where it is not given.
    """
    errors = residuals_px(estimate, seen)
    weight = np.ones(len(seen)) if seen.relative_sigma is None else seen.relative_sigma**-2.0
    used = weight if fitted is None else np.where(fitted, weight, 0.0)
    of_track = np.bincount(seen.point, used).astype(np.float64)[seen.point]
    left = left_by_point(used, of_track)
    lengths = _lengths(errors, left)
    weighed = _lengths(whitened(errors, seen.whitening), left)
    if not lengths.size:
        raise ValueError("none of the observations can be projected by the true cameras")
    return Noise(
        float(np.median(lengths)) / RAYLEIGH_MEDIAN,
        float(np.quantile(lengths, QUANTILE)),
        float(np.median(weighed)) / RAYLEIGH_MEDIAN,
    )


def _lengths(errors: FloatArray, left: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(errors, axis=1) / np.sqrt(left)
    return lengths[np.isfinite(lengths)]


# ---- the truth -----------------------------------------------------------------------------


def true_estimate(
    problem: Problem, truth: CameraRig, rig_from_world: Mapping[str, Transform]
) -> Estimate:
    """The truth of a problem's cameras and frames, in its order, without points.

    rig_from_world: of every frame by its name. Raises CalibrationError where one is not there.
    """
    names = [camera.name for camera in problem.initial.cameras]
    missing = sorted(set(problem.frame_names) - set(rig_from_world))
    if missing:
        raise CalibrationError(
            f"the truth has no frame {missing[0]!r}: its frames are called as the scan's images"
        )
    rig = truth.only(names)
    assert rig.cam_from_rig is not None
    placed = tuple(rig_from_world[name] for name in problem.frame_names)
    return Estimate(rig.cameras, rig.cam_from_rig, placed, np.zeros((0, 3)))


def true_frames(path: Path) -> dict[str, Transform]:
    """rig_from_world of every frame of a simulated scan, from its truth_frames.json.

    Raises CalibrationError where it cannot be read.
    """
    try:
        record = json.loads(path.read_text())
        return {
            name: Transform.from_wxyz(one["rotation_wxyz"], one["translation"])
            for name, one in record.items()
        }
    except (AttributeError, KeyError, OSError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"cannot read the true frames from {path}: {error}; simulate again"
        ) from error

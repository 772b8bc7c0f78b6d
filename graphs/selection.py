"""Which tracks enter the graph: long enough, and seen from places far enough apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import Estimate, IntArray, Observations, Problem

MIN_TRACK_LENGTH = 3  # two views of a point cannot show that one is wrong


def select_tracks(problem: Problem, min_parallax_deg: float) -> Problem:
    """Leave out short tracks and points without parallax, and frames that see nothing then.

    Raises ValueError when nothing is left.
    """
    seen = problem.observations
    length = np.bincount(seen.point, minlength=len(problem.initial.points))
    keep = (length >= MIN_TRACK_LENGTH) & (parallax_deg(problem) >= min_parallax_deg)
    if not keep.any():
        raise ValueError(
            f"none of {len(length)} points is seen {MIN_TRACK_LENGTH} times with "
            f"{min_parallax_deg:g} deg of parallax: move the camera sideways, closer to things"
        )
    return compact(problem, seen.subset(keep[seen.point]))


GRID = 8  # cells a side over which an image's observations are spread


def within_budget(problem: Problem, max_observations: int) -> Problem:
    """The problem with the tracks that say most, at most `max_observations` of them together.

    Long tracks first, as long as they fall into a part of some image that still lacks
    observations; then long tracks anywhere. Random order breaks no ties: the result is the same
    every time.
    """
    seen = problem.observations
    if len(seen) <= max_observations:
        return problem
    size = np.array([camera.size for camera in problem.initial.cameras])[seen.camera]
    cell = np.clip((seen.pixels / size * GRID).astype(np.int64), 0, GRID - 1)
    image = seen.frame * len(problem.initial.cameras) + seen.camera
    place = (image * GRID + cell[:, 1]) * GRID + cell[:, 0]
    quota = max(max_observations // (len(np.unique(image)) * GRID * GRID), 1)
    order = np.argsort(seen.point, kind="stable")
    length = np.bincount(seen.point, minlength=len(problem.initial.points))
    by_length = np.argsort(-length, kind="stable")
    begins = np.cumsum(length) - length
    keep = _spread(place[order], begins, length, by_length, quota, max_observations)
    return compact(problem, seen.subset(keep[seen.point]))


@njit(cache=True)
def _spread(
    place: IntArray,
    begins: IntArray,
    length: IntArray,
    order: IntArray,
    quota: int,
    budget: int,
) -> NDArray[np.bool_]:
    filled = np.zeros(place.max() + 1, np.int64)
    keep = np.zeros(len(length), np.bool_)
    total = 0
    for lacking_only in (True, False):
        for point in order:
            n = length[point]
            if keep[point] or n == 0 or total + n > budget:
                continue
            cells = place[begins[point] : begins[point] + n]
            if lacking_only and np.sum(filled[cells] < quota) * 2 < n:
                continue
            keep[point] = True
            total += n
            for cell in cells:
                filled[cell] += 1
    return keep


def compact(problem: Problem, observations: Observations) -> Problem:
    """The problem with these observations, and only the frames and points they see."""
    start = problem.initial
    points, point = np.unique(observations.point, return_inverse=True)
    frames, frame = np.unique(observations.frame, return_inverse=True)
    return replace(
        problem,
        initial=Estimate(
            start.cameras,
            start.cam_from_rig,
            tuple(start.rig_from_world[f] for f in frames),
            start.points[points],
        ),
        observations=replace(observations, point=point, frame=frame),
        frame_names=tuple(problem.frame_names[f] for f in frames),
    )


def parallax_deg(problem: Problem) -> FloatArray:
    """Largest angle (n_points,) between any two rays that see each point."""
    start, seen = problem.initial, problem.observations
    rig_centres = np.array([t.inverse.translation for t in start.rig_from_world])
    world_from_rig = np.array([t.rotation.T for t in start.rig_from_world])
    in_rig = np.array([t.inverse.translation for t in start.cam_from_rig])[seen.camera]
    centres = rig_centres[seen.frame] + np.einsum("nij,nj->ni", world_from_rig[seen.frame], in_rig)
    rays = start.points[seen.point] - centres
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    order = np.argsort(seen.point, kind="stable")
    ends = np.cumsum(np.bincount(seen.point, minlength=len(start.points)))
    return np.degrees(2 * np.arcsin(np.clip(_longest_chord(rays[order], ends) / 2, 0, 1)))


@njit(cache=True)
def _longest_chord(rays: FloatArray, ends: IntArray) -> FloatArray:
    longest = np.zeros(len(ends))
    begin = 0
    for point in range(len(ends)):
        for i in range(begin, ends[point]):
            for j in range(i + 1, ends[point]):
                squared = 0.0
                for axis in range(3):
                    squared += (rays[i, axis] - rays[j, axis]) ** 2
                longest[point] = max(longest[point], squared)
        longest[point] = np.sqrt(longest[point])
        begin = ends[point]
    return longest

"""Which tracks enter the graph: long enough, and seen from places far enough apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from graphs.frames import FloatArray
from graphs.problem import (
    BoardPoints,
    BoolArray,
    IntArray,
    KnownPath,
    KnownSpan,
    Observations,
    Problem,
    ScaleSource,
)

MIN_TRACK_LENGTH = 3  # two views of a point cannot show that one is wrong
MIN_CORNERS = 6  # of a board in one image: twice what its place takes


class NoParallaxError(ValueError):
    """No point is seen from places far enough apart."""


def select_tracks(problem: Problem, min_parallax_deg: float) -> Problem:
    """Leave out short tracks and points without parallax, and frames that see nothing then.

    Raises NoParallaxError when nothing is left.
    """
    keep = well_seen(problem, min_parallax_deg)
    if not keep.any():
        raise NoParallaxError(
            f"none of {len(keep)} points is seen {MIN_TRACK_LENGTH} times with "
            f"{min_parallax_deg:g} deg of parallax: move the camera sideways, closer to things"
        )
    seen = problem.observations
    return compact(problem, seen.subset(keep[seen.point]))


def well_seen(problem: Problem, min_parallax_deg: float) -> BoolArray:
    """Points (n_points,) with tracks that are long enough, and seen from far enough apart."""
    length = np.bincount(problem.observations.point, minlength=len(problem.initial.points))
    keep = (length >= MIN_TRACK_LENGTH) & (parallax_deg(problem) >= min_parallax_deg)
    result: BoolArray = np.where(problem.known, _in_enough_company(problem), keep)
    return result


def _in_enough_company(problem: Problem) -> BoolArray:
    """Points (n_points,) that one camera sees together with enough other corners of the board."""
    seen, enough = problem.observations, np.zeros(len(problem.initial.points), dtype=bool)
    rows = problem.known[seen.point]
    image = seen.frame * len(problem.initial.cameras) + seen.camera
    count = np.bincount(image[rows], minlength=int(image.max(initial=0)) + 1)
    best = np.zeros(len(problem.frame_names), dtype=np.int64)
    np.maximum.at(best, seen.frame[rows], count[image[rows]])
    enough[seen.point[rows]] = best[seen.frame[rows]] >= MIN_CORNERS
    return enough


def compact(problem: Problem, observations: Observations) -> Problem:
    """The problem with these observations, and only the frames and points they see.

    Raises ValueError when an end of a measured distance goes with the rest.
    """
    start = problem.initial
    points, point = np.unique(observations.point, return_inverse=True)
    board = _board_of(problem, points)
    frames, frame = np.unique(observations.frame, return_inverse=True)
    return replace(
        problem,
        initial=replace(
            start,
            rig_from_world=tuple(start.rig_from_world[f] for f in frames),
            points=start.points[points],
            world_from_board=start.world_from_board if board and board.still.any() else None,
        ),
        observations=replace(observations, point=point, frame=frame),
        frame_names=tuple(problem.frame_names[f] for f in frames),
        scales=tuple(_renumbered(problem, one, frames, points) for one in problem.scales),
        board=board,
    )


def _board_of(problem: Problem, points: IntArray) -> BoardPoints | None:
    board = problem.board
    if board is None or not board.known[points].any():
        return None
    return replace(board, corner=board.corner[points], still=board.still[points])


def _renumbered(
    problem: Problem, scale: ScaleSource, frames: IntArray, points: IntArray
) -> ScaleSource:
    """A scale source of the problem once only these frames and points are left."""
    if isinstance(scale, KnownPath):
        if not np.isin(scale.frames, frames).all():
            names = " and ".join(problem.frame_names[f] for f in scale.frames)
            raise ValueError(
                f"the distance of {scale.length_m:g} m between the frames {names} cannot be used: "
                "too few points of one of them are consistent; measure between other frames"
            )
        first, second = np.searchsorted(frames, scale.frames).tolist()
        return replace(scale, frames=(first, second))
    if isinstance(scale, KnownSpan):
        if not np.isin(scale.points, points).all():
            raise ValueError(
                f"the distance of {scale.length_m:g} m between two points cannot be used: one is "
                f"seen fewer than {MIN_TRACK_LENGTH} times consistently, or almost without "
                "parallax; measure between other points"
            )
        first, second = np.searchsorted(points, scale.points).tolist()
        return replace(scale, points=(first, second))
    return scale


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

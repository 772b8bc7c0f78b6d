"""How far the calibration moves when a block of frames is left out: a delete-group jackknife.

What the model covariance predicts of those moves is computed too: an efficient estimate and one
from a part of its data differ by the difference of their covariances (Hausman, Econometrica 1978).
What they move beyond it is error that whole blocks share: shutters that roll, images that blur,
things that move, features that drift as the view changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.build import CalibrationGraph, build
from graphs.frames import FloatArray, log_rotation
from graphs.model_covariance import ModelCovariance, model_covariance
from graphs.problem import BoardPoints, Estimate, IntArray, KnownPath, KnownSpan, Problem
from graphs.selection import select_tracks
from graphs.solve import solve
from graphs.unit import unit_jacobian

# Neighbouring frames err alike. On the three real scans of the tests, 10 blocks of 5 frames moved
# the focal lengths 1.2 to 1.5 times as far as 17 to 25 smaller ones would have it.
BLOCKS = 10
FRAMES_A_BLOCK = 2  # at least, where that leaves enough blocks; else single frames
FEWEST_BLOCKS = 4  # fewer say next to nothing of how far they scatter
STEPS, TOLERANCE = 50, 1e-6  # from the optimum of all, 3 to 6 steps lead to that of most frames


@dataclass(frozen=True)
class Jackknife:
    """The calibration without each block, less that with all, and what was expected of it."""

    names: tuple[str, ...]
    moved: FloatArray  # (n_blocks, n)
    expected: FloatArray  # (n, n) sum over blocks of what noise alone has their squares be
    frames: tuple[tuple[str, str], ...]  # the first and the last frame of each block
    failed: tuple[tuple[str, str], ...]  # blocks without which nothing is determined

    @property
    def weight(self) -> float:
        """Of each block's squared move in the covariance; blocks that failed are as the others."""
        n_blocks = len(self.moved) + len(self.failed)
        return (n_blocks - 1) / len(self.moved)

    @property
    def covariance(self) -> FloatArray:
        """The jackknife's own covariance (n, n), about the estimate from all frames."""
        result: FloatArray = self.weight * self.moved.T @ self.moved
        return result


def blocks_of(problem: Problem, most: int = BLOCKS) -> IntArray:
    """The block (n_frames,) of each frame, in the order of the scan, all about equally long.

    Frames of a board are a series of their own beside those of the scan.
    """
    n_frames = len(problem.frame_names)
    count = min(most, n_frames // FRAMES_A_BLOCK)
    if count < min(most, FEWEST_BLOCKS):
        count = min(most, n_frames)
    place = np.arange(n_frames) / n_frames
    of_board = problem.board_frames
    if of_board.any() and not of_board.all():  # each block takes its share of both kinds
        for kind in (of_board, ~of_board):
            place[kind] = (np.arange(kind.sum()) + 0.5) / kind.sum()
    block: IntArray = np.unique((place * count).astype(np.int64), return_inverse=True)[1]
    return block


def delete_group_jackknife(
    graph: CalibrationGraph,
    estimate: Estimate,
    model: ModelCovariance,
    min_parallax_deg: float,
    on_block: Callable[[int, int], None] | None = None,
) -> Jackknife | None:
    """Solve again without each block in turn, from the optimum; None where frames are too few.

    on_block(done, total) is called after each.
    """
    problem, block = graph.problem, blocks_of(graph.problem)
    n_blocks = int(block.max()) + 1
    if n_blocks < FEWEST_BLOCKS:
        return None
    moved, expected = [], np.zeros_like(model.matrix)
    kept: list[tuple[str, str]] = []
    failed: list[tuple[str, str]] = []
    for number in range(n_blocks):
        own = np.flatnonzero(block == number)
        ends = problem.frame_names[own[0]], problem.frame_names[own[-1]]
        part = solve_part(graph, estimate, model, block != number, min_parallax_deg)
        if part is None:
            failed.append(ends)
        else:
            moved.append(part[0])
            expected += part[1].from_data - model.from_data
            kept.append(ends)
        if on_block is not None:
            on_block(number + 1, n_blocks)
    if len(moved) < FEWEST_BLOCKS:
        return None
    return Jackknife(model.names, np.array(moved), expected, tuple(kept), tuple(failed))


def solve_part(
    graph: CalibrationGraph,
    estimate: Estimate,
    model: ModelCovariance,
    frames: NDArray[np.bool_],
    min_parallax_deg: float,
) -> tuple[FloatArray, ModelCovariance] | None:
    """How far the calibration (n,) moves with these frames (n_frames,) alone, and its covariance.

    Both in the unit of `model`. Frames that give the unit stay: the ends of measured paths, all
    with clicks, and those with a board where no other frame has one. None where these frames do not
    determine the calibration.
    """
    problem = graph.problem
    seen = problem.observations
    of_unit = np.union1d(_of_scale(problem), _of_lost_scale(problem, frames))
    keep = frames[seen.frame] | np.isin(seen.frame, of_unit)
    try:
        rest = select_tracks(
            replace(problem, initial=estimate, observations=seen.subset(keep)), min_parallax_deg
        )
        if rest.metric != problem.metric or rest.of_board_alone != problem.of_board_alone:
            return None
        if rest.board is None and problem.board is not None:  # what is known of it is a prior still
            scene = np.zeros(len(rest.initial.points), dtype=bool)
            rest = replace(rest, board=BoardPoints(problem.board.board, scene - 1, scene))
        part = build(rest, graph.options)
        found, values, summary = solve(part, STEPS, TOLERANCE, near=True)
        if not summary.converged:
            return None
        covariance = model_covariance(part, found, values, model)
    except ValueError:
        return None
    before, after = estimate.scaled(1 / model.unit), found.scaled(1 / covariance.unit)
    along = tangent(before, model)
    return along @ change(before, after, model.names), replace(
        covariance,
        from_data=along @ covariance.from_data @ along.T,
        of_priors=covariance.of_priors @ along.T,
    )


def tangent(in_unit: Estimate, model: ModelCovariance) -> FloatArray:
    """Projection (n, n) of changes onto those that leave the unit of length as it is.

    A baseline that is the unit stays on a sphere: what it turns by takes it off the plane that the
    covariance lies in, by a second order that is large beside the rounding of a first order of 0.
    """
    if model.unit_camera is None:
        return np.eye(len(model.names))
    return unit_jacobian(model.names, in_unit, model.unit_camera)


def _of_scale(problem: Problem) -> IntArray:
    """Frames without which nothing gives a unit: of paths' ends, of clicks, the one that sees a
    board."""
    seen, kept = problem.observations, [np.empty(0, np.int64)]
    for source in problem.scales:
        if isinstance(source, KnownPath):
            kept.append(np.array(source.frames))
        elif isinstance(source, KnownSpan):
            kept.append(seen.frame[np.isin(seen.point, source.points)])
    with_board = np.unique(seen.frame[problem.known[seen.point]])
    if len(with_board) == 1:
        kept.append(with_board)
    return np.unique(np.concatenate(kept))


def _of_lost_scale(problem: Problem, frames: NDArray[np.bool_]) -> IntArray:
    """Frames that have a scan in the board's unit, where none of `frames` (n_frames,) is one.

    Without them the size would be held where it is, and seem to be known.
    """
    part = replace(
        problem, observations=problem.observations.subset(frames[problem.observations.frame])
    )
    if part.metric or problem.of_board_alone:  # without a scan that fails, and is said
        return np.empty(0, np.int64)
    return problem.frames_of_scale


def change(estimate: Estimate, other: Estimate, names: tuple[str, ...]) -> FloatArray:
    """Reported parameters (n,) of `other` less those of `estimate`; rotations as a turn (rad).

    Lenses may differ in parameters that are not asked for.
    """
    values: dict[str, float] = {}
    cameras = zip(
        estimate.cameras, other.cameras, estimate.cam_from_rig, other.cam_from_rig, strict=True
    )
    for camera, moved, cam_from_rig, moved_from_rig in cameras:
        known = camera.named()
        difference = {p: value - known[p] for p, value in moved.named().items() if p in known}
        turn = log_rotation((moved_from_rig @ cam_from_rig.inverse).rotation)
        shift = moved_from_rig.translation - cam_from_rig.translation
        for place, axis in enumerate("xyz"):
            difference[f"rotation_{axis}"] = float(turn[place])
            difference[f"translation_{axis}"] = float(shift[place])
        values |= {f"{camera.name}.{name}": value for name, value in difference.items()}
    return np.array([values[name] for name in names])

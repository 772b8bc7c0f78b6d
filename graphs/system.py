"""The whole graph's normal equations at one point, ready to be factorised.

Tracks come linearised and reduced from their kernel; every other factor is linearised by GTSAM.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import scipy.sparse
from numba import njit
from numpy.typing import NDArray

from graphs.boards import board_keys, board_width, place_corners
from graphs.camera import valid_limit
from graphs.clusters import TrackColumns, Tracks
from graphs.elimination import (
    FRAME_SIZE,
    Cholesky,
    Elimination,
    factorise,
    null_directions,
    plan_elimination,
)
from graphs.frames import FloatArray
from graphs.keys import frame_key, lens_key, rig_key
from graphs.lenses import MODEL_INDEX
from graphs.problem import IntArray, Problem
from graphs.tracks import Variables, linearise


@dataclass(frozen=True)
class Layout:
    """Where each variable stands among the columns of the system."""

    elimination: Elimination
    of_tracks: TrackColumns
    first_column: dict[int, int]  # of each key
    size: dict[int, int]  # of each key
    lens_of: tuple[int, ...]  # the camera whose lens variable a camera uses

    def columns(self, key: int) -> IntArray:
        return np.arange(self.first_column[key], self.first_column[key] + self.size[key])

    def variable_at(self, column: int) -> tuple[int, int]:
        """The key of the variable that a column belongs to, and which of its columns it is."""
        first, key = max((f, k) for k, f in self.first_column.items() if f <= column)
        return key, column - first


def make_layout(
    problem: Problem,
    others: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    lens_of: tuple[int, ...],
) -> Layout:
    """Frames in the order of their elimination, then rigs, lenses, and all other variables."""
    n_frames = len(problem.frame_names)
    linked = _linked_frames(problem.observations.frame, problem.observations.point, n_frames)
    frame_of = {frame_key(i): i for i in range(n_frames)}
    for index in range(others.size()):
        frames = [frame_of[key] for key in list(others.at(index).keys()) if key in frame_of]
        linked[np.ix_(frames, frames)] = True
    keys, zero = list(initial.keys()), initial.zeroVectors()
    size = {key: int(zero.at(key).size) for key in keys}
    of_tracks = track_columns(problem, lens_of)
    shared = shared_keys(problem, lens_of)
    of_board = board_keys(problem)  # next to what tracks know, for they are tracks too
    others_of = [key for key in keys if key not in frame_of and key not in shared]
    rest = [*of_board, *(key for key in others_of if key not in of_board)]
    border = of_tracks.width + sum(size[key] for key in rest)
    elimination = plan_elimination(linked, border)
    first_column = {frame_key(f): FRAME_SIZE * p for p, f in enumerate(elimination.order)}
    offset = FRAME_SIZE * n_frames
    for key in (*shared, *rest):
        first_column[key] = offset
        offset += size[key]
    return Layout(elimination, of_tracks, first_column, size, lens_of)


def shared_keys(problem: Problem, lens_of: tuple[int, ...]) -> list[int]:
    """The variables that all frames share: rigs but the reference's, then lenses."""
    rigs = [rig_key(i) for i in range(len(lens_of)) if i != problem.reference]
    return rigs + [lens_key(i) for i in sorted(set(lens_of))]


def track_columns(problem: Problem, lens_of: tuple[int, ...]) -> TrackColumns:
    """Where tracks find `shared_keys` after the frames' columns."""
    cameras = problem.initial.cameras
    n_params = np.array([camera.params.size for camera in cameras])
    rig, width = np.full(len(cameras), -1), 0
    for i in range(len(cameras)):
        if i != problem.reference:
            rig[i], width = width, width + FRAME_SIZE
    lens = np.empty(len(cameras), dtype=np.int64)
    for i in sorted(set(lens_of)):
        lens[i], width = width, width + n_params[i]
    return TrackColumns(rig, lens[list(lens_of)], n_params, int(width), board_width(problem))


def _linked_frames(frame: IntArray, point: IntArray, n_frames: int) -> NDArray[np.bool_]:
    """Which frames (n_frames, n_frames) see a point together."""
    order = np.argsort(point, kind="stable")
    return _mark_links(frame[order], point[order], n_frames)


@njit(cache=True)
def _mark_links(frame: IntArray, point: IntArray, n_frames: int) -> NDArray[np.bool_]:
    linked = np.zeros((n_frames, n_frames), np.bool_)
    begin = 0
    for end in range(1, len(point) + 1):
        if end < len(point) and point[end] == point[begin]:
            continue
        for i in range(begin, end):
            for j in range(begin, end):
                linked[frame[i], frame[j]] = True
        begin = end
    return linked


def variables_of(
    values: gtsam.Values,
    problem: Problem,
    lens_of: tuple[int, ...],
    order: IntArray,
    frames: IntArray | None = None,
) -> Variables:
    """What tracks depend on, out of GTSAM's values.

    order (n_frames,): the frame at each position. frames: positions to read; the others stay
    undefined, as do cameras that the values do not hold.
    """
    cameras = problem.initial.cameras
    rig, cam = np.empty((len(order), 4, 4)), np.tile(np.eye(4), (len(cameras), 1, 1))
    for place in range(len(order)) if frames is None else frames:
        rig[place] = values.atPose3(frame_key(order[place])).matrix()
    params = np.zeros((len(cameras), max(camera.params.size for camera in cameras)))
    limits = np.zeros(len(cameras))
    for i, camera in enumerate(cameras):
        if i != problem.reference and values.exists(rig_key(i)):
            cam[i] = values.atPose3(rig_key(i)).matrix()
        if values.exists(lens_key(lens_of[i])):
            own = values.atVector(lens_key(lens_of[i]))
            params[i, : own.size] = own
            limits[i] = valid_limit(replace(camera, params=own))
    return Variables(
        np.ascontiguousarray(rig[:, :3, :3]),
        np.ascontiguousarray(rig[:, :3, 3]),
        np.ascontiguousarray(cam[:, :3, :3]),
        np.ascontiguousarray(cam[:, :3, 3]),
        np.array([MODEL_INDEX[camera.lens] for camera in cameras]),
        params,
        limits,
        None if problem.board is None else place_corners(problem.board.board, values),
    )


@dataclass(frozen=True)
class System:
    """Normal equations H x = -g of the whole graph, cut along the fronts of its elimination."""

    elimination: Elimination
    matrices: Sequence[FloatArray]  # upper triangles, one a front, over its columns
    border: FloatArray  # upper triangle of what concerns the border alone
    gradient: FloatArray  # (n_columns,) of the cost

    @property
    def diagonal(self) -> FloatArray:
        """Diagonal of H (n_columns,)."""
        diagonal = np.zeros(self.elimination.n_columns)
        for front, matrix in zip(self.elimination.fronts, self.matrices, strict=True):
            diagonal[self.elimination.columns(front)] += np.diag(matrix)
        diagonal[len(diagonal) - len(self.border) :] += np.diag(self.border)
        return diagonal

    def factorise(self, damping: float = 0.0) -> Cholesky:
        """Cholesky factor of H with `damping` of its diagonal added.

        Raises NotPositiveDefiniteError.
        """
        return factorise(self.elimination, self.matrices, self.border, damping)

    def null_directions(self) -> FloatArray:
        """What the border's variables can do at no cost (n_border, n), as far as frames follow.

        Raises NotPositiveDefiniteError when already a frame is not determined.
        """
        return null_directions(self.elimination, self.matrices, self.border)


def assemble(
    tracks: Tracks,
    others: gtsam.GaussianFactorGraph,
    layout: Layout,
    variables: Variables,
    points: FloatArray,
    pool: ThreadPoolExecutor,
    data_weight: float = 1.0,
    newton: bool = False,
) -> System:
    """Linearised tracks, points (n_points, 4) eliminated, and linearised other factors.

    data_weight: what the tracks' share is multiplied by; newton: as in `linearise`.
    """
    plan = layout.elimination
    gradient = np.zeros(plan.n_columns)
    matrices: list[FloatArray | None] = [None] * len(plan.fronts)
    blocks = linearise(tracks, variables, points, plan.border, pool, newton)
    for index in reversed(range(len(blocks))):
        H, g = blocks.pop()
        if data_weight != 1.0:
            H, g = H * data_weight, g * data_weight
        front = tracks.clusters[index].front
        gradient[plan.columns(plan.fronts[front])] += g
        present = matrices[front]
        if present is None:
            matrices[front] = H
        else:
            present += H
    whole = [
        np.zeros((len(plan.columns(front)),) * 2) if matrix is None else matrix
        for front, matrix in zip(plan.fronts, matrices, strict=True)
    ]
    border = np.zeros((plan.border, plan.border))
    A, b = jacobian_of(others, layout)
    gradient -= A.T @ b
    _add_others(scipy.sparse.triu(A.T @ A, format="coo"), plan, whole, border)
    return System(plan, whole, border, gradient)


def jacobian_of(
    others: gtsam.GaussianFactorGraph, layout: Layout
) -> tuple[scipy.sparse.csr_array, FloatArray]:
    """Whitened Jacobian (n_rows, n_columns) and right-hand side of GTSAM's linear factors."""
    rows, columns, entries = others.sparseJacobian_()
    keys = sorted(set(others.keys()))
    place = np.concatenate([layout.columns(key) for key in keys])
    n_rows, rhs_column = int(rows.max()), len(place)
    row, column = rows.astype(np.int64) - 1, columns.astype(np.int64) - 1
    is_rhs = column == rhs_column
    rhs = np.zeros(n_rows)
    rhs[row[is_rhs]] = entries[is_rhs]
    row, column, entries = row[~is_rhs], column[~is_rhs], entries[~is_rhs]
    shape = (n_rows, layout.elimination.n_columns)
    return scipy.sparse.csr_array((entries, (row, place[column])), shape), rhs


def _add_others(
    upper: scipy.sparse.coo_array,
    plan: Elimination,
    matrices: Sequence[FloatArray],
    border: FloatArray,
) -> None:
    """Add entries of the system to the matrix of the front that eliminates their first column."""
    start = FRAME_SIZE * len(plan.order)
    row, column = upper.coords
    in_border = row >= start
    np.add.at(border, (row[in_border] - start, column[in_border] - start), upper.data[in_border])
    owner = np.full(len(row), -1)
    owner[~in_border] = plan.front_of[row[~in_border] // FRAME_SIZE]
    for front in np.unique(owner[~in_border]):
        mine = owner == front
        columns = plan.columns(plan.fronts[front])
        place = (np.searchsorted(columns, row[mine]), np.searchsorted(columns, column[mine]))
        np.add.at(matrices[front], place, upper.data[mine])

"""The track factor: feature tracks as one smart factor that knows calibration.

Points are not variables. Whenever the factor is evaluated it triangulates them for the frames,
cam_from_rig and lenses at hand; when it is linearised it eliminates them (variable projection,
Golub and Pereyra 1973; in bundle adjustment: the Schur complement), so that what is left is a
quadratic in frames, cam_from_rig and lenses.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from graphs.boards import Corners
from graphs.clusters import Cluster, TrackColumns, Tracks
from graphs.frames import FloatArray
from graphs.lenses import project_many, project_point_many
from graphs.losses import LOSS_INDEX, weigh_many
from graphs.points import advance_points, eliminate_points
from graphs.problem import IntArray
from graphs.rows import all_rows, carry_points, into_cameras, move_points, point_rows

TRIANGULATION_STEPS = 20
TRIANGULATION_TOLERANCE = 1e-11  # predicted decrease of the cost, in half squared sigmas


@dataclass(frozen=True)
class Variables:
    """The values of all variables that tracks depend on, as GTSAM holds them."""

    rig_rotation: FloatArray  # (n_frames, 3, 3) world_from_rig
    rig_centre: FloatArray  # (n_frames, 3)
    cam_rotation: FloatArray  # (n_cameras, 3, 3) rig_from_cam
    cam_centre: FloatArray  # (n_cameras, 3)
    models: IntArray  # (n_cameras,) MODEL_INDEX
    params: FloatArray  # (n_cameras, n) padded with zeros
    limits: FloatArray  # (n_cameras,) of the valid region
    corners: Corners | None = None  # of the board

    def poses(self, frames: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Rotations and centres of these frames and of all cameras, as the kernels take them."""
        return (
            self.rig_rotation[frames],
            self.rig_centre[frames],
            self.cam_rotation,
            self.cam_centre,
        )

    @property
    def lenses(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Models, parameters and limits, as the kernels take them."""
        return self.models, self.params, self.limits


class Rows(NamedTuple):
    """Linearised, weighted rows of a chunk; all but the last in the order of the kernels."""

    active: IntArray  # (n_active,) points of the cluster
    begins: IntArray  # (n_points + 1,)
    rows: IntArray  # (n, 4) observation, point, frame, camera; all of the cluster
    points: FloatArray  # (n_points, 4)
    smallest_w: float
    residuals: FloatArray  # (n, 2)
    of_point: FloatArray  # (n, 2, 3)
    of_frame: FloatArray  # (n, 2, 6)
    of_rig: FloatArray  # (n, 2, 6)
    of_lens: FloatArray  # (n, 2, n_params)
    n_frames: int
    of_board: FloatArray | None  # (n, 2, k) of corners, whose `of_point` is zero


class Scratch:
    """Arrays for the rows of one chunk, one set a thread."""

    def __init__(self, cluster: Cluster, n_params: int) -> None:
        n = cluster.most_rows
        self.rows = np.empty((n, 4), np.int64)
        self.in_rig, self.in_cam = np.empty((n, 3)), np.empty((n, 3))
        self.pixels, self.by_point = np.empty((n, 2)), np.empty((n, 2, 3))
        self.by_params, self.of_point = np.empty((n, 2, n_params)), np.empty((n, 2, 3))
        self.residuals, self.weights = np.empty((n, 2)), np.empty(n)
        self.bends, self.costs = np.empty(n), np.empty(n)
        if n_params:
            self.of_frame, self.of_rig = np.empty((n, 2, 6)), np.empty((n, 2, 6))


def triangulate(
    tracks: Tracks,
    variables: Variables,
    points: FloatArray,
    pool: ThreadPoolExecutor,
    tolerance: float = TRIANGULATION_TOLERANCE,
    before: Variables | None = None,
) -> tuple[FloatArray, float]:
    """The points (n_points, 4) that cost least for given variables, from a start; and the cost.

    Each point runs its own Levenberg-Marquardt and is done when a step promises to lower the cost
    by less than `tolerance`. What cannot be projected costs as much as INVALID_SIGMAS.
    before: the variables that the start belongs to; points then move along with their cameras.
    """
    result = np.array(points)

    def run(cluster: Cluster) -> float:
        of_cluster = result[cluster.points]
        return triangulate_cluster(tracks, cluster, variables, of_cluster, tolerance, before)

    return result, float(sum(pool.map(run, tracks.clusters)))


def triangulate_cluster(
    tracks: Tracks,
    cluster: Cluster,
    variables: Variables,
    points: FloatArray,
    tolerance: float,
    before: Variables | None = None,
) -> float:
    """As `triangulate`, of one cluster, its points (n_points, 4) in place; returns their cost."""
    poses, s = variables.poses(cluster.frames), Scratch(cluster, 0)
    if cluster.corner is not None:
        return _place_cluster(tracks, cluster, variables, points)
    if before is not None:
        carry_points(
            cluster.begins, cluster.frame, cluster.camera, cluster.anchors,
            *before.poses(cluster.frames), *poses, points,
        )  # fmt: skip
        np.maximum(points[:, 3], tracks.smallest_w, out=points[:, 3])
    trial, cost = points.copy(), np.full(len(points), np.inf)
    normal, steps = np.zeros((len(points), 10)), np.empty((len(points), 3))
    still, waiting = np.empty(len(points), np.int64), np.arange(cluster.n_points)
    for _ in range(TRIANGULATION_STEPS):
        going_on = []
        for active in cluster.chunks(waiting):
            n = _see(tracks, cluster, variables, poses, active, trial, s)
            point_rows(
                n, s.rows, cluster.anchors, trial, *poses, cluster.root_information,
                s.by_point, s.of_point,
            )  # fmt: skip
            count = advance_points(
                active, cluster.begins, s.of_point, s.residuals, s.weights, s.bends, s.costs,
                tracks.smallest_w, tolerance, trial, points, cost, normal, still, steps,
            )  # fmt: skip
            on = still[:count].copy()
            moved = np.empty((count, 4))
            move_points(points[on], steps[:count], tracks.smallest_w, moved)
            trial[on] = moved
            going_on.append(on)
        waiting = np.concatenate(going_on)
        if waiting.size == 0:
            break
    return float(cost.sum())


def _place_cluster(
    tracks: Tracks, cluster: Cluster, variables: Variables, points: FloatArray
) -> float:
    """Put a cluster's corners (n_points, 4) where the board has them; returns their cost."""
    assert variables.corners is not None
    away = variables.corners.places[cluster.still, cluster.corner] - cluster.anchors
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    points[:] = np.hstack([away, np.ones_like(distance)]) / np.maximum(distance, 1e-300)
    poses, s, cost = variables.poses(cluster.frames), Scratch(cluster, 0), 0.0
    for active in cluster.chunks(np.arange(cluster.n_points)):
        n = _see(tracks, cluster, variables, poses, active, points, s)
        cost += float(s.costs[:n].sum())
    return cost


def _see(
    tracks: Tracks,
    cluster: Cluster,
    variables: Variables,
    poses: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    active: IntArray,
    points: FloatArray,
    s: Scratch,
) -> int:
    """Project active points (n_points, 4) and weigh their residuals, into s; the number of rows."""
    n = into_cameras(
        active, cluster.begins, cluster.frame, cluster.camera, cluster.anchors, points,
        *poses, s.rows, s.in_rig, s.in_cam,
    )  # fmt: skip
    project_point_many(*variables.lenses, s.rows[:n, 3], s.in_cam[:n], s.pixels[:n], s.by_point[:n])
    _weigh(tracks, cluster, s, n, s.rows[:n, 0])
    return n


def _by_board(cluster: Cluster, variables: Variables, s: Scratch, n: int) -> FloatArray:
    """Rows (n, 2, k) by the board's variables, from those by the frames' places."""
    assert variables.corners is not None and cluster.still is not None
    assert cluster.corner is not None
    world_from_rig = variables.rig_rotation[cluster.frames[s.rows[:n, 2]]]
    point = s.rows[:n, 1]
    by_board = variables.corners.by_board[cluster.still[point], cluster.corner[point]]
    # A frame that moves one way sees what a corner that moves the other way shows.
    result: FloatArray = -s.of_frame[:n, :, 3:] @ world_from_rig.mT @ by_board
    return result


def _weigh(tracks: Tracks, cluster: Cluster, s: Scratch, n: int, row: IntArray | slice) -> None:
    weigh_many(
        LOSS_INDEX[tracks.loss], tracks.loss_scale, s.pixels[:n], cluster.pixels[row],
        cluster.root_information[row], s.residuals[:n], s.weights[:n], s.bends[:n], s.costs[:n],
    )  # fmt: skip


def linearise(
    tracks: Tracks,
    variables: Variables,
    points: FloatArray,
    border: int,
    pool: ThreadPoolExecutor,
    newton: bool = False,
) -> list[tuple[FloatArray, FloatArray]]:
    """Reduced normal equations (H, g) of every cluster: points eliminated, robust weights in.

    H (n, n), upper triangle, and g (n,): columns of the front's frames, six each, then `border`
    more, the rigs' and lenses' first. The cost's gradient is g, its Gauss-Newton Hessian H, with
    the loss's weights or, for `newton`, with its curvature as far as that stays positive.
    """

    def run(cluster: Cluster) -> tuple[FloatArray, FloatArray]:
        of_cluster = points[cluster.points]
        return linearise_cluster(tracks, cluster, variables, of_cluster, border, newton)

    return list(pool.map(run, tracks.clusters))


def linearise_cluster(
    tracks: Tracks,
    cluster: Cluster,
    variables: Variables,
    points: FloatArray,
    border: int,
    newton: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """As `linearise`, of one cluster and its points (n_points, 4)."""
    size = 6 * len(cluster.frames) + border
    H, g = np.zeros((size, size)), np.zeros(size)
    for chunk in rows_of(tracks, cluster, variables, points, newton):
        eliminate_points(*chunk[:-1], *tracks.columns.places, tracks.columns.width, H, g)
        if chunk.of_board is not None:
            _add_board(chunk, chunk.of_board, tracks.columns, H, g)
    return H, g


def _add_board(
    chunk: Rows, of_board: FloatArray, columns: TrackColumns, H: FloatArray, g: FloatArray
) -> None:
    """Add what concerns the board's columns to the normal equations of a cluster."""
    n, start, k = len(chunk.rows), 6 * chunk.n_frames, of_board.shape[2]
    board = start + columns.width + np.arange(k)
    frame, camera = chunk.rows[:, 2], chunk.rows[:, 3]
    for index in np.unique(frame):
        rows = frame == index
        cross = np.tensordot(chunk.of_frame[:n][rows], of_board[rows], ([0, 1], [0, 1]))
        H[6 * index : 6 * index + 6, board] += cross
    for index in np.unique(camera):
        rows, lens, size = camera == index, start + columns.lens[index], columns.n_params[index]
        cross = np.tensordot(chunk.of_lens[:n][rows], of_board[rows], ([0, 1], [0, 1]))
        H[lens : lens + size, board] += cross[:size]
        if columns.rig[index] >= 0:
            rig = start + columns.rig[index]
            cross = np.tensordot(chunk.of_rig[:n][rows], of_board[rows], ([0, 1], [0, 1]))
            H[rig : rig + 6, board] += cross
    H[np.ix_(board, board)] += np.triu(np.tensordot(of_board, of_board, ([0, 1], [0, 1])))
    g[board] += np.tensordot(of_board, chunk.residuals[:n], ([0, 1], [0, 1]))


def rows_of(
    tracks: Tracks,
    cluster: Cluster,
    variables: Variables,
    points: FloatArray,
    newton: bool = False,
) -> Iterator[Rows]:
    """The linearised rows of a cluster, chunk by chunk; the next overwrites their arrays."""
    poses, s = variables.poses(cluster.frames), Scratch(cluster, variables.params.shape[1])
    for active in cluster.chunks(np.arange(cluster.n_points)):
        n = into_cameras(
            active, cluster.begins, cluster.frame, cluster.camera, cluster.anchors, points,
            *poses, s.rows, s.in_rig, s.in_cam,
        )  # fmt: skip
        project_many(
            *variables.lenses, s.rows[:n, 3], s.in_cam[:n], s.pixels[:n], s.by_point[:n],
            s.by_params[:n],
        )  # fmt: skip
        _weigh(tracks, cluster, s, n, slice(int(s.rows[0, 0]), int(s.rows[0, 0]) + n))
        if not newton:
            s.bends[:] = 0.0
        all_rows(
            n, s.rows, cluster.anchors, points, *poses, cluster.root_information, s.by_point,
            s.by_params, s.in_rig, s.in_cam, s.weights, s.bends, s.residuals, s.of_point,
            s.of_frame, s.of_rig,
        )  # fmt: skip
        of_board = None
        if cluster.corner is not None:
            s.of_point[:n] = 0.0  # nothing for a corner to give way to
            of_board = _by_board(cluster, variables, s, n)
        yield Rows(
            active, cluster.begins, s.rows[:n], points, tracks.smallest_w, s.residuals,
            s.of_point, s.of_frame, s.of_rig, s.by_params, len(cluster.frames), of_board,
        )  # fmt: skip

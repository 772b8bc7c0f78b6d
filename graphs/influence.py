"""How far each observation's error moves the calibration, summed over what errs together.

The sums are the contributions to cluster-robust covariances (Liang and Zeger, Biometrika 1986;
over several kinds of clusters at once: Cameron, Gelbach and Miller, JBES 2011).
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from graphs.build import CalibrationGraph
from graphs.clusters import Cluster
from graphs.elimination import SINGULAR_PIVOT, NotPositiveDefiniteError
from graphs.frames import FloatArray
from graphs.gauge import undetermined
from graphs.noise import left_by_frame, left_by_point
from graphs.points import follow_points, respond
from graphs.problem import IntArray
from graphs.system import System
from graphs.tracks import Variables, rows_of

# A smaller pivot has the system examined for directions that nothing determines; in real scans the
# smallest are 1e-6. Without the gauge's distance it is 1e-12, though an eigenvalue is 1e-15.
SUSPICIOUS_PIVOT = 1e-8
CELLS = 8  # a side of each image, over which a lens that does not fit errs the same way


def responses(graph: CalibrationGraph, system: System, columns: IntArray) -> FloatArray:
    """Columns of the inverse normal equations (n_columns, len(columns)).

    Raises ValueError, naming the variable, when they are singular.
    """
    unit = np.zeros((system.elimination.n_columns, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    try:
        factor = system.factorise()
        smallest, column = factor.smallest_pivot()
    except NotPositiveDefiniteError as error:
        factor, smallest, column = None, 0.0, error.column
    if smallest < SUSPICIOUS_PIVOT:
        weakest = column if smallest < SINGULAR_PIVOT else None
        if why := undetermined(graph.problem, graph.layout, system, weakest):
            raise ValueError(why)
    assert factor is not None  # else a column was to blame
    return factor.solve(unit)


class Influence(NamedTuple):
    """A chunk's observations, in the order of their tracks, then of frames."""

    rows: IntArray  # (n_obs, 4) observation, point, frame, camera; all of the cluster
    begins: IntArray  # (n_tracks,) first observation of each track
    moved: FloatArray  # (n_obs, n) how far each residual moves the unknowns
    leverage: FloatArray  # (n_tracks,) squared response to each track


def influences(
    graph: CalibrationGraph,
    cluster: Cluster,
    variables: Variables,
    points: FloatArray,
    response: FloatArray,
) -> Iterator[Influence]:
    """Chunk by chunk, what a cluster's observations do to n unknowns.

    response (n_columns, n): what a unit of each column's gradient does to them.
    """
    layout, n = graph.layout, response.shape[1]
    start = 6 * len(layout.elimination.order)
    frames = 6 * cluster.frames[:, None] + np.arange(6)
    shared = layout.of_tracks.width + layout.of_tracks.board
    place = np.append(frames.ravel(), start + np.arange(shared))
    G = response[place]
    for chunk in rows_of(graph.tracks, cluster, variables, points[cluster.points]):
        n_rows, begins = len(chunk.rows), chunk.begins[chunk.active]
        of_rows, moved = np.empty((n_rows, 2, n)), np.empty((n_rows, n))
        leverage = np.empty(len(begins))
        respond(
            chunk.rows, chunk.of_frame, chunk.of_rig, chunk.of_lens, chunk.n_frames,
            *layout.of_tracks.places, G, of_rows,
        )  # fmt: skip
        if chunk.of_board is not None:
            of_rows += chunk.of_board @ G[len(G) - layout.of_tracks.board :]
        follow_points(
            chunk.active, chunk.begins, chunk.points, chunk.smallest_w, chunk.residuals,
            chunk.of_point, of_rows, moved, leverage,
        )  # fmt: skip
        yield Influence(chunk.rows, begins - begins[0], moved, leverage)


class SharedErrors:
    """Sums of influences over frames, over cells of the image plane, over tracks, and over none.

    Corners of a board are no tracks: what is printed wrongly errs alike in all frames.
    """

    def __init__(self, n_frames: int, n_cameras: int, n: int, n_corners: int = 0) -> None:
        self.by_frame = np.zeros((n_frames, n))
        self.by_cell = np.zeros((n_cameras * CELLS * CELLS, n))
        self.by_track = np.zeros((n, n))  # sum of outer products
        self.n_tracks = 0
        self.by_corner = np.zeros((n_corners, n))
        # Sums of outer products of single observations: of tracks, had their points not been
        # fitted to them, and of corners.
        self.before_fit = np.zeros((n, n))
        self.of_corners = np.zeros((n, n))
        self.alone = 0.0  # sum of squares of all
        self.before_frames = 0.0  # the same, had frames not been fitted to their few corners

    def add(
        self,
        influence: Influence,
        frame: IntArray,
        cell: IntArray,
        weight: FloatArray,
        corner: IntArray | None = None,
        left: FloatArray | float = 1.0,
    ) -> None:
        """`frame`, `cell`, `weight`, `corner`, `left` (n_obs,): of each observation; the last of
        corners alone, the share that their frames leave."""
        moved = influence.moved
        np.add.at(self.by_frame, frame, moved)
        np.add.at(self.by_cell, cell, moved)
        squares = (moved**2).sum(1)
        self.alone += float(squares.sum())
        if corner is not None:
            np.add.at(self.by_corner, corner, moved)
            self.of_corners += moved.T @ moved
            self.before_frames += float((squares / left).sum())
            return
        self.before_frames += float(squares.sum())
        of_tracks = np.add.reduceat(moved, influence.begins)
        self.by_track += of_tracks.T @ of_tracks
        self.n_tracks += len(of_tracks)
        lengths = np.diff(influence.begins, append=len(squares))
        of_track = np.repeat(np.add.reduceat(weight, influence.begins), lengths)
        self.before_fit += moved.T @ (moved / left_by_point(weight, of_track)[:, None])

    def merge(self, other: SharedErrors, frames: IntArray) -> None:
        """Add what other tracks moved; `frames`: which of ours theirs are."""
        self.by_frame[frames] += other.by_frame
        self.by_cell += other.by_cell
        self.by_track += other.by_track
        self.n_tracks += other.n_tracks
        self.by_corner += other.by_corner
        self.before_fit += other.before_fit
        self.of_corners += other.of_corners
        self.alone += other.alone
        self.before_frames += other.before_frames


def shared_errors(
    graph: CalibrationGraph,
    variables: Variables,
    points: FloatArray,
    response: FloatArray,
    pool: ThreadPoolExecutor,
) -> SharedErrors:
    """The influences of all observations on n unknowns; response (n_columns, n)."""
    cameras, n = graph.problem.initial.cameras, response.shape[1]
    board = graph.problem.board
    n_corners = 0 if board is None else len(board.board.corners)
    sizes = np.array([camera.size for camera in cameras])
    order = graph.layout.elimination.order
    in_frame = np.bincount(graph.problem.observations.frame, minlength=len(order))

    def run(cluster: Cluster) -> SharedErrors:
        sums = SharedErrors(len(cluster.frames), len(cameras), n, n_corners)
        for influence in influences(graph, cluster, variables, points, response):
            observation, point, frame, camera = influence.rows.T
            inside = cluster.pixels[observation] / sizes[camera]
            x, y = np.clip((inside * CELLS).astype(np.int64), 0, CELLS - 1).T
            weight = (cluster.root_information[observation] ** 2).sum(1) / 2
            corner = None if cluster.corner is None else cluster.corner[point]
            left = left_by_frame(in_frame[order[cluster.frames[frame]]])
            sums.add(influence, frame, (camera * CELLS + y) * CELLS + x, weight, corner, left)
        return sums

    total = SharedErrors(len(graph.problem.frame_names), len(cameras), n, n_corners)
    clusters = graph.tracks.clusters
    for cluster, sums in zip(clusters, pool.map(run, clusters), strict=True):
        total.merge(sums, cluster.frames)
    return total

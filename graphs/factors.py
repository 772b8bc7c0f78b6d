"""The track factor as GTSAM sees it: a plain factor graph for its optimisers and Marginals.

One `gtsam.CustomFactor` a cluster of tracks, over the frames, cam_from_rig and lenses that see
them. What is left of the cluster after its points are eliminated is a quadratic of rank below its
size; a pivoted Cholesky factor turns it into the Jacobian that GTSAM asks for.

GTSAM 4.3's GncOptimizer copies factors, which its CustomFactor does not allow: it refuses.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import scipy.linalg

from graphs.boards import board_keys
from graphs.build import CalibrationGraph
from graphs.clusters import Cluster, homogeneous
from graphs.frames import FloatArray
from graphs.keys import frame_key, lens_key, rig_key
from graphs.problem import IntArray
from graphs.tracks import TRIANGULATION_TOLERANCE, linearise_cluster, triangulate_cluster

# Of the scaled matrix's largest pivot. Unscaled, a distortion coefficient beside a focal length
# would fall below it and lose its information.
RANK_TOLERANCE = 1e-13

ErrorFunction = Callable[[gtsam.CustomFactor, gtsam.Values, "list[FloatArray] | None"], FloatArray]


def factor_graph(
    graph: CalibrationGraph, points_per_factor: int | None = None
) -> gtsam.NonlinearFactorGraph:
    """All factors of a graph: tracks first, then its other factors.

    points_per_factor: cut clusters further; with 1, each track is a factor of its own.
    """
    factors = gtsam.NonlinearFactorGraph()
    start = homogeneous(graph.tracks, graph.problem.initial.points)
    for cluster in graph.tracks.clusters:
        for part in cluster.parts(points_per_factor or cluster.n_points):
            factors.add(track_factor(graph, part, start[part.points]))
    factors.push_back(graph.others)
    return factors


def track_factor(
    graph: CalibrationGraph, cluster: Cluster, points: FloatArray
) -> gtsam.CustomFactor:
    """One cluster as a factor; `points` (n_points, 4) is where triangulation starts."""
    keys, columns = _variables(graph, cluster)
    size = sum(column.size for column in columns)
    width = graph.layout.of_tracks.width + graph.layout.of_tracks.board
    warm = points.copy()  # where the last linearisation found the points

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        variables = graph.variables(values, cluster.frames)
        found = warm.copy()
        cost = triangulate_cluster(graph.tracks, cluster, variables, found, TRIANGULATION_TOLERANCE)
        if jacobians is None:
            return np.append(np.zeros(size), np.sqrt(2 * cost))
        warm[:] = found
        H, g = linearise_cluster(graph.tracks, cluster, variables, found, width)
        used = np.concatenate(columns)
        A, e = square_root(H[np.ix_(used, used)], g[used], cost)
        ends = np.cumsum([column.size for column in columns])
        for index, block in enumerate(np.split(A, ends[:-1], axis=1)):
            jacobians[index] = np.asfortranarray(block)
        return e

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size + 1), keys, error)


def _variables(graph: CalibrationGraph, cluster: Cluster) -> tuple[list[int], list[IntArray]]:
    """Keys of a cluster's variables, and their columns in its normal equations."""
    layout, of_tracks = graph.layout, graph.layout.of_tracks
    frames = layout.elimination.order[cluster.frames]
    keys = [frame_key(frame) for frame in frames]
    columns = [6 * i + np.arange(6) for i in range(len(frames))]
    start = 6 * len(frames)
    cameras = np.unique(cluster.camera)
    for camera in cameras[of_tracks.rig[cameras] >= 0]:
        keys.append(rig_key(camera))
        columns.append(start + of_tracks.rig[camera] + np.arange(6))
    for lens in sorted({layout.lens_of[camera] for camera in cameras}):
        keys.append(lens_key(lens))
        columns.append(start + of_tracks.lens[lens] + np.arange(of_tracks.n_params[lens]))
    if cluster.corner is not None:
        first = start - layout.size[frame_key(0)] * len(layout.elimination.order)
        for key in board_keys(graph.problem):
            keys.append(key)
            columns.append(first + layout.columns(key))
    return keys, columns


def square_root(H: FloatArray, g: FloatArray, cost: float) -> tuple[FloatArray, FloatArray]:
    """Jacobian A (n + 1, n) and error e (n + 1,) with A^T A = H, A^T e = g, e^T e = 2 cost.

    H (n, n): its upper triangle is read; it may be singular.
    """
    n = len(g)
    diagonal = np.diag(H)
    scale = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = H * scale[:, None] * scale
    root, pivots, rank, _ = scipy.linalg.lapack.dpstrf(scaled, lower=0, tol=RANK_TOLERANCE)
    order = pivots - 1
    root = np.triu(root)[:rank]
    A, e = np.zeros((n + 1, n)), np.zeros(n + 1)
    A[:rank, order] = root
    A[:, scale > 0] /= scale[scale > 0]
    e[:rank] = scipy.linalg.solve_triangular(root[:, :rank], (g * scale)[order[:rank]], trans=1)
    e[n] = max(2 * cost - float(e @ e), 0.0) ** 0.5
    return A, e

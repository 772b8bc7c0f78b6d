"""Joint covariance of all lenses and rig extrinsics, everything else marginalised, labelled.

Points and frames are eliminated exactly; what is left is the information of the calibration. The
model covariance assumes independent observations of the estimated noise; the clustered one
only that observations err independently which share neither their frame nor their track: the
two-way sandwich of Cameron, Gelbach and Miller (JBES 2011). The stated sigma is the larger of
the two, parameter by parameter. On the rendered demo scan, z = error / sigma has an rms of 2.1
with the model's sigma, 1.7 with frames as clusters, and 1.2 with both: a keypoint drifts off
its corner as the view changes, and takes its whole track along.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.linalg

from graphs.build import CalibrationGraph
from graphs.clusters import Cluster, homogeneous
from graphs.elimination import SINGULAR_PIVOT, NotPositiveDefiniteError
from graphs.frames import FloatArray, reported_from_tangent
from graphs.gauge import undetermined
from graphs.keys import lens_key, rig_key
from graphs.noise import loss_moments
from graphs.points import follow_points, respond
from graphs.problem import Estimate, IntArray, residuals_px
from graphs.solve import threads
from graphs.system import System, assemble, jacobian_of
from graphs.tracks import Variables, rows_of

POSE_NAMES = (
    *(f"rotation_{axis}" for axis in "xyz"),
    *(f"translation_{axis}" for axis in "xyz"),
)
# A smaller pivot has the system examined for directions that nothing determines; in real scans the
# smallest are 1e-6. Without the gauge's distance it is 1e-12, though an eigenvalue is 1e-15.
SUSPICIOUS_PIVOT = 1e-8
MIN_CLUSTERS = 5  # fewer frames cannot show how much frames differ


@dataclass(frozen=True)
class Covariance:
    """A covariance that carries its names: `camera.fx`, `camera.rotation_x` (rad), ..."""

    names: tuple[str, ...]
    matrix: FloatArray  # (n, n)

    @property
    def sigma(self) -> dict[str, float]:
        variances = np.maximum(np.diag(self.matrix), 0.0)  # an exact zero may round below
        return dict(zip(self.names, np.sqrt(variances).tolist(), strict=True))

    def of_difference(self, a: str, b: str) -> float:
        """Sigma of parameter `a` minus parameter `b`; one that is not here has none."""
        weights = np.array([(name == a) - (name == b) for name in self.names], dtype=np.float64)
        variance = float(weights @ self.matrix @ weights)
        return max(variance, 0.0) ** 0.5


@dataclass(frozen=True)
class CalibrationCovariance:
    """The stated covariance, and the model's before it was widened."""

    stated: Covariance
    model: Covariance

    @property
    def inflation(self) -> float:
        """Median of stated over model sigma; 1 where nothing is estimated."""
        if not self.model.names:
            return 1.0
        ratio = np.diag(self.stated.matrix) / np.diag(self.model.matrix)
        return float(np.median(np.sqrt(ratio)))


def calibration_covariance(
    graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values
) -> CalibrationCovariance:
    """Covariance of every lens parameter and every cam_from_rig at the optimum.

    Lens parameters that are held fixed and the reference camera are left out.
    Raises ValueError when the problem determines less than it asks for.
    """
    problem = graph.problem
    moments = loss_moments(problem, graph.options, residuals_px(estimate, problem.observations))
    variables = graph.variables(values)
    points = homogeneous(graph.tracks, estimate.points)
    others = graph.others.linearize(values)
    columns, names, to_reported = calibration_columns(graph, estimate)
    if not columns.size:  # everything is held
        nothing = Covariance((), np.zeros((0, 0)))
        return CalibrationCovariance(nothing, nothing)
    with threads() as pool:
        system = assemble(
            graph.tracks, others, graph.layout, variables, points, pool, moments.curvature
        )
        response = responses(graph, system, columns) @ to_reported.T
        of_priors = jacobian_of(others, graph.layout)[0] @ response
        prior_part = of_priors.T @ of_priors
        data_part = (to_reported @ response[columns] - prior_part) / moments.curvature
        model = Covariance(names, moments.score_variance * data_part + prior_part)
        if len(np.unique(problem.observations.frame)) < MIN_CLUSTERS:
            return CalibrationCovariance(model, model)
        clustered = clustered_variance(graph, variables, points, response, pool)
    variance = moments.refit * clustered + np.diag(prior_part)
    return CalibrationCovariance(Covariance(names, _widen(model.matrix, variance)), model)


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


def clustered_variance(
    graph: CalibrationGraph,
    variables: Variables,
    points: FloatArray,
    response: FloatArray,
    pool: ThreadPoolExecutor,
) -> FloatArray:
    """Variances (n,) of unknowns when what shares a frame or a track may err together.

    response (n_columns, n): what a unit of each column's gradient does to them. By frame plus by
    track less what both count, and never less than either alone.
    """
    n_frames, n = len(graph.problem.frame_names), response.shape[1]

    def run(cluster: Cluster) -> ClusterSums:
        sums = ClusterSums(len(cluster.frames), n)
        for frame, begins, moved, _ in influences(graph, cluster, variables, points, response):
            sums.add(moved, frame, begins)
        return sums

    total = ClusterSums(n_frames, n)
    clusters = graph.tracks.clusters
    for cluster, sums in zip(clusters, pool.map(run, clusters), strict=True):
        total.merge(sums, cluster.frames)
    return total.variance()


def influences(
    graph: CalibrationGraph,
    cluster: Cluster,
    variables: Variables,
    points: FloatArray,
    response: FloatArray,
) -> Iterator[tuple[IntArray, IntArray, FloatArray, FloatArray]]:
    """Chunk by chunk: the frame of each observation among the cluster's, where tracks begin, how
    far each residual moves the unknowns (n_obs, n), each track's squared response (n_tracks,)."""
    layout, n = graph.layout, response.shape[1]
    start = 6 * len(layout.elimination.order)
    frames = 6 * cluster.frames[:, None] + np.arange(6)
    place = np.append(frames.ravel(), start + np.arange(layout.of_tracks.width))
    G = response[place]
    for chunk in rows_of(graph.tracks, cluster, variables, points[cluster.points]):
        n_rows, begins = len(chunk.rows), chunk.begins[chunk.active]
        of_rows, moved = np.empty((n_rows, 2, n)), np.empty((n_rows, n))
        leverage = np.empty(len(begins))
        respond(
            chunk.rows, chunk.of_frame, chunk.of_rig, chunk.of_lens, chunk.n_frames,
            *layout.of_tracks.places, G, of_rows,
        )  # fmt: skip
        follow_points(
            chunk.active, chunk.begins, chunk.points, chunk.smallest_w, chunk.residuals,
            chunk.of_point, of_rows, moved, leverage,
        )  # fmt: skip
        yield chunk.rows[:, 2], begins - begins[0], moved, leverage


class ClusterSums:
    """How far the errors of each frame, each track, and each frame of a track move n unknowns."""

    def __init__(self, n_frames: int, n: int) -> None:
        self.by_frame = np.zeros((n_frames, n))
        self.by_track, self.by_both = np.zeros(n), np.zeros(n)  # sums of squares
        self.n_tracks = self.n_both = 0

    def add(self, moved: FloatArray, frame: IntArray, begins: IntArray) -> None:
        """Observations in the order of their tracks, which begin at `begins`, then of frames."""
        starts_track = np.zeros(len(moved), dtype=bool)
        starts_track[begins] = True
        both = np.flatnonzero(starts_track | (np.diff(frame, prepend=-1) != 0))
        self.by_track += (np.add.reduceat(moved, begins) ** 2).sum(0)
        in_frames = np.add.reduceat(moved, both)
        np.add.at(self.by_frame, frame[both], in_frames)
        self.by_both += (in_frames**2).sum(0)
        self.n_tracks += len(begins)
        self.n_both += len(both)

    def merge(self, other: ClusterSums, frames: IntArray) -> None:
        """Add what other tracks moved; `frames`: which of ours theirs are."""
        self.by_frame[frames] += other.by_frame
        self.by_track += other.by_track
        self.by_both += other.by_both
        self.n_tracks += other.n_tracks
        self.n_both += other.n_both

    def variance(self) -> FloatArray:
        """Variances (n,), each count n of clusters corrected by n / (n - 1)."""
        by_frame = (self.by_frame**2).sum(0) * _finite(int(self.by_frame.any(axis=1).sum()))
        by_track = self.by_track * _finite(self.n_tracks)
        by_both = self.by_both * _finite(self.n_both)
        return np.maximum(by_frame + by_track - by_both, np.maximum(by_frame, by_track))


def _finite(count: int) -> float:
    """Correction of a sum over so many clusters for their common mean."""
    return count / max(count - 1, 1)


def _widen(model: FloatArray, variance: FloatArray) -> FloatArray:
    known = np.maximum(np.diag(model), 1e-300)  # what priors alone decide may round below zero
    factor = np.sqrt(np.maximum(variance / known, 1.0)) if len(model) else np.ones(0)
    return model * factor[:, None] * factor[None, :]


def calibration_columns(
    graph: CalibrationGraph, estimate: Estimate
) -> tuple[IntArray, tuple[str, ...], FloatArray]:
    """Columns of the free lens parameters and cam_from_rig, their names, and the Jacobian
    from GTSAM's tangent to the reported parameters."""
    layout = graph.layout
    columns: list[int] = []
    names: list[str] = []
    blocks: list[FloatArray] = []
    for index, camera in enumerate(estimate.cameras):
        lens = layout.lens_of[index]
        free = np.flatnonzero(graph.lens_priors[lens].free)
        columns += layout.columns(lens_key(lens))[free].tolist()
        names += [f"{camera.name}.{camera.names[i]}" for i in free]
        blocks.append(np.eye(len(free)))
    for index, camera in enumerate(estimate.cameras):
        if index == graph.problem.reference:
            continue
        columns += layout.columns(rig_key(index)).tolist()
        names += [f"{camera.name}.{name}" for name in POSE_NAMES]
        blocks.append(reported_from_tangent(estimate.cam_from_rig[index]))
    jacobian = scipy.linalg.block_diag(*blocks) if columns else np.zeros((0, 0))
    return np.array(columns, dtype=np.int64), tuple(names), jacobian

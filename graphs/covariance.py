"""Joint covariance of all lenses and rig extrinsics, everything else marginalised, labelled.

The linearised graph H = A'A is reduced exactly: points by their 3x3 blocks, then frames. The
model covariance assumes independent observations of the estimated noise; the clustered one
(Liang and Zeger 1986; Cameron and Miller 2015) only that different frames err independently.
The stated sigma is the larger of the two, parameter by parameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse

from graphs.build import CalibrationGraph
from graphs.frames import FloatArray, reported_from_tangent
from graphs.keys import frame_key, lens_key, point_key, rig_key
from graphs.noise import loss_moments, redundancy
from graphs.problem import Estimate, IntArray, residuals_px
from graphs.reference import NATIVE_SIZE, native_slots

POSE_NAMES = (
    *(f"rotation_{axis}" for axis in "xyz"),
    *(f"translation_{axis}" for axis in "xyz"),
)
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
        return float(np.sqrt(max(weights @ self.matrix @ weights, 0.0)))


@dataclass(frozen=True)
class CalibrationCovariance:
    """The stated covariance, and the model's before it was widened."""

    stated: Covariance
    model: Covariance

    @property
    def inflation(self) -> float:
        """Median of stated over model sigma."""
        ratio = np.diag(self.stated.matrix) / np.diag(self.model.matrix)
        return float(np.median(np.sqrt(ratio)))


def calibration_covariance(
    graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values
) -> CalibrationCovariance:
    """Covariance of every lens parameter and every cam_from_rig at the optimum.

    Lens parameters that are held fixed and the reference camera are left out.
    """
    problem = graph.problem
    residuals = residuals_px(estimate, problem.observations)
    moments = loss_moments(problem, graph.options, residuals)
    system = linearised_system(graph, values)
    n_rows = 2 * len(problem.observations)
    scale = np.ones(system.jacobian.shape[0])
    scale[:n_rows] = moments.variance_factor**-0.5
    columns, names, to_reported = _calibration_columns(graph, estimate, system.first_column)
    influence = solve_normal_equations(system, scale, columns)
    model = Covariance(names, to_reported @ influence[columns] @ to_reported.T)
    gain = moments.variance_factor**-0.5 / moments.curvature  # on rows already scaled once
    scores = (scipy.sparse.diags_array(scale) @ system.jacobian) @ influence
    frames = problem.observations.frame
    clustered = clustered_covariance(
        scores, system.rhs * np.where(np.arange(len(scale)) < n_rows, gain, 1.0), frames
    )
    clustered *= 1 / redundancy(problem)
    prior_rows = scores[n_rows:]
    clustered = to_reported @ (clustered + prior_rows.T @ prior_rows) @ to_reported.T
    if len(np.unique(frames)) < MIN_CLUSTERS:
        return CalibrationCovariance(model, model)
    return CalibrationCovariance(Covariance(names, _widen(model.matrix, clustered)), model)


@dataclass(frozen=True)
class LinearisedSystem:
    """A whitened Jacobian and right-hand side, and where each variable's columns start."""

    jacobian: scipy.sparse.csr_array  # (n_rows, n_columns), robust weights in it
    rhs: FloatArray  # (n_rows,) minus the weighted whitened residual
    first_column: dict[int, int]  # key -> column
    n_points: int
    first_point: int  # column of the first point


def linearised_system(graph: CalibrationGraph, values: gtsam.Values) -> LinearisedSystem:
    """The graph linearised at `values`, in GTSAM's order of keys; observations come first."""
    linear = graph.factors.linearize(values)
    rows, columns, entries = linear.sparseJacobian_()
    shape = (int(rows.max()), int(columns.max()))
    whole = scipy.sparse.csr_array(
        (entries, (rows.astype(int) - 1, columns.astype(int) - 1)), shape
    )
    start = graph.problem.initial
    sizes = {lens_key(i): NATIVE_SIZE for i in range(len(start.cameras))}
    sizes |= {rig_key(i): 6 for i in range(len(start.cameras))}
    sizes |= {frame_key(i): 6 for i in range(len(start.rig_from_world))}
    sizes |= {point_key(i): 3 for i in range(len(start.points))}
    first_column, offset = {}, 0
    for key in sorted(sizes):
        first_column[key] = offset
        offset += sizes[key]
    return LinearisedSystem(
        whole[:, :offset],
        np.ravel(whole[:, [offset]].toarray()),
        first_column,
        len(start.points),
        first_column[point_key(0)],
    )


def solve_normal_equations(
    system: LinearisedSystem, row_scale: FloatArray, columns: IntArray
) -> FloatArray:
    """Columns of the inverse of A' diag(row_scale)^2 A, (n_columns, len(columns)).

    The points' 3x3 blocks are eliminated first, the rest is dense; scaled to a unit diagonal
    so that pixels, radians and distortion coefficients are inverted equally well.
    """
    scaled = scipy.sparse.diags_array(row_scale) @ system.jacobian
    norms = np.sqrt(np.asarray(scaled.multiply(scaled).sum(0)).ravel())
    scaled = (scaled @ scipy.sparse.diags_array(1 / norms)).tocsc()
    is_point = np.zeros(scaled.shape[1], dtype=bool)
    is_point[system.first_point : system.first_point + 3 * system.n_points] = True
    points, others = np.flatnonzero(is_point), np.flatnonzero(~is_point)
    a_points, a_others = scaled[:, points], scaled[:, others]
    inverse_blocks = _inverse_point_blocks(a_points, system.n_points)
    coupling = (a_points.T @ a_others).tocsr()  # (3 n_points, n_others)
    eliminated = inverse_blocks @ coupling
    reduced = (a_others.T @ a_others).toarray() - (coupling.T @ eliminated).toarray()
    position = np.searchsorted(others, columns)
    rhs = np.zeros((len(others), len(columns)))
    rhs[position, np.arange(len(columns))] = 1.0
    solution = np.zeros((scaled.shape[1], len(columns)))
    factor = scipy.linalg.cho_factor(reduced)
    solution[others] = scipy.linalg.cho_solve(factor, rhs)
    solution[points] = -(eliminated @ solution[others])
    return solution / norms[:, None] / norms[columns][None, :]


def _inverse_point_blocks(
    a_points: scipy.sparse.csc_array, n_points: int
) -> scipy.sparse.bsr_array:
    blocks = (a_points.T @ a_points).tobsr((3, 3))
    blocks.sort_indices()
    inverse = np.linalg.inv(blocks.data)
    return scipy.sparse.bsr_array((inverse, np.arange(n_points), np.arange(n_points + 1)))


def clustered_covariance(scores: FloatArray, rhs: FloatArray, frames: IntArray) -> FloatArray:
    """Sum over frames of the outer product of what each frame's errors do to the estimate.

    scores (n_rows, n): what a unit of each row's error does; rhs (n_rows,): the errors; frames
    (n_obs,): the frame of each observation, two rows each, first.
    """
    moved = (scores * rhs[:, None])[: 2 * len(frames)]
    by_frame = np.zeros((int(frames.max()) + 1, scores.shape[1]))
    np.add.at(by_frame, np.repeat(frames, 2), moved)
    n_frames = len(np.unique(frames))
    return by_frame.T @ by_frame * (n_frames / max(n_frames - 1, 1))


def _widen(model: FloatArray, clustered: FloatArray) -> FloatArray:
    factor = np.sqrt(np.maximum(np.diag(clustered) / np.diag(model), 1.0))
    return model * factor[:, None] * factor[None, :]


def _calibration_columns(
    graph: CalibrationGraph, estimate: Estimate, first_column: dict[int, int]
) -> tuple[IntArray, tuple[str, ...], FloatArray]:
    """Columns of the free lens parameters and cam_from_rig, their names, and the Jacobian
    from GTSAM's tangent to the reported parameters."""
    columns: list[int] = []
    names: list[str] = []
    blocks: list[FloatArray] = []
    for index, camera in enumerate(estimate.cameras):
        start = first_column[lens_key(index)]
        free = graph.lens_priors[index].free
        slots = [slot for slot, is_free in zip(native_slots(camera), free, strict=True) if is_free]
        columns += [start + slot for slot in slots]
        names += [
            f"{camera.name}.{p}" for p, is_free in zip(camera.names, free, strict=True) if is_free
        ]
        blocks.append(np.eye(len(slots)))
    for index, camera in enumerate(estimate.cameras):
        if index == graph.problem.reference:
            continue
        start = first_column[rig_key(index)]
        columns += range(start, start + 6)
        names += [f"{camera.name}.{name}" for name in POSE_NAMES]
        blocks.append(reported_from_tangent(estimate.cam_from_rig[index]))
    return np.array(columns), tuple(names), scipy.linalg.block_diag(*blocks)

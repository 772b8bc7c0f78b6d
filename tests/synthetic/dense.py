"""The tracks' normal equations once more: dense, points explicit, Jacobians by finite differences.

Slow and short. Nothing in common with the kernels but `residuals_px`, which has no derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphs.build import CalibrationGraph
from graphs.frames import FloatArray, from_gtsam_inverse
from graphs.keys import frame_key, lens_key, rig_key
from graphs.problem import Estimate, IntArray, residuals_px
from graphs.system import System

STEP = 1e-6  # of poses in radians and of the scene; of lens parameters relative


def estimate_at(graph: CalibrationGraph, values: gtsam.Values, points: FloatArray) -> Estimate:
    """GTSAM's values and scene points as an Estimate."""
    start = graph.problem.initial
    lens_of = graph.layout.lens_of
    return Estimate(
        tuple(
            replace(camera, params=values.atVector(lens_key(lens)))
            for camera, lens in zip(start.cameras, lens_of, strict=True)
        ),
        tuple(
            from_gtsam_inverse(values.atPose3(rig_key(i))) for i in range(len(start.cam_from_rig))
        ),
        tuple(
            from_gtsam_inverse(values.atPose3(frame_key(i)))
            for i in range(len(start.rig_from_world))
        ),
        points,
    )


def moved(graph: CalibrationGraph, values: gtsam.Values, change: FloatArray) -> gtsam.Values:
    """Values after a step (n_columns,) in GTSAM's tangent."""
    delta = gtsam.VectorValues()
    for key in graph.layout.first_column:
        delta.insert(key, change[graph.layout.columns(key)])
    return values.retract(delta)


def track_columns(graph: CalibrationGraph) -> IntArray:
    """Columns of all frames, all rigs but the reference's, and all lenses."""
    n_frames, n_cameras = len(graph.problem.frame_names), len(graph.problem.initial.cameras)
    keys = [frame_key(i) for i in range(n_frames)]
    keys += [rig_key(i) for i in range(n_cameras) if i != graph.problem.reference]
    keys += [lens_key(i) for i in sorted(set(graph.layout.lens_of))]
    return np.sort(np.concatenate([graph.layout.columns(key) for key in keys]))


def steps(graph: CalibrationGraph, values: gtsam.Values) -> FloatArray:
    """A finite difference's step (n_columns,) of each column."""
    h = np.full(graph.layout.elimination.n_columns, STEP)
    for index in set(graph.layout.lens_of):
        params = values.atVector(lens_key(index))
        h[graph.layout.columns(lens_key(index))] *= np.maximum(np.abs(params), 0.1)
    return h


@dataclass(frozen=True)
class Dense:
    """Whitened residuals of all observations and their derivatives, no loss in them."""

    residuals: FloatArray  # (n_obs, 2)
    by_variables: FloatArray  # (n_obs, 2, n_columns)
    by_point: FloatArray  # (n_obs, 2, 3)
    point: IntArray  # (n_obs,)

    def normal_equations(
        self, weights: FloatArray, curvatures: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """H (n_columns, n_columns), the points eliminated, and the gradient (n_columns,).

        weights (n_obs,) make the gradient, curvatures (n_obs, 2, 2) the Hessian.
        """
        A, B, C = self.by_variables, self.by_point, curvatures
        H = np.einsum("nai,nab,nbj->ij", A, C, A)
        for point in np.unique(self.point):
            own = self.point == point
            W = np.einsum("nai,nab,nbj->ij", B[own], C[own], A[own])
            V = np.einsum("nai,nab,nbj->ij", B[own], C[own], B[own])
            H -= W.T @ np.linalg.pinv(V, 1e-11, hermitian=True) @ W
        return H, np.einsum("nai,na,n->i", A, self.residuals, weights)

    def across_points(self, weights: FloatArray) -> FloatArray:
        """Rows by the variables with the points following them (n_obs, 2, n_columns)."""
        followed = self.by_variables.copy()
        for point in np.unique(self.point):
            own = self.point == point
            A, B, w = self.by_variables[own], self.by_point[own], weights[own]
            W = np.einsum("nai,n,naj->ij", B, w, A)
            V = np.einsum("nai,n,naj->ij", B, w, B)
            followed[own] -= np.einsum(
                "nak,kj->naj", B, np.linalg.pinv(V, 1e-11, hermitian=True) @ W
            )
        return followed


def cov_px(graph: CalibrationGraph) -> FloatArray:
    """Covariance (n_obs, 2, 2) of each observation, as its parts say."""
    seen = graph.problem.observations
    relative = np.ones(len(seen)) if seen.relative_sigma is None else seen.relative_sigma
    shape = np.eye(2) if seen.noise_shape is None else seen.noise_shape
    return (graph.options.sigma_px * relative[:, None, None]) ** 2 * shape


def linearise_dense(graph: CalibrationGraph, values: gtsam.Values, points: FloatArray) -> Dense:
    """Central differences about values and scene points (n_points, 3)."""
    seen = graph.problem.observations
    root = np.linalg.cholesky(np.linalg.inv(cov_px(graph))).mT

    def residuals(at: gtsam.Values, of: FloatArray) -> FloatArray:
        return np.einsum("nij,nj->ni", root, residuals_px(estimate_at(graph, at, of), seen))

    h = steps(graph, values)
    by_variables = np.zeros((len(seen), 2, len(h)))
    for column in track_columns(graph):
        step = h[column] * (np.arange(len(h)) == column)
        ahead, behind = (moved(graph, values, s) for s in (step, -step))
        by_variables[..., column] = residuals(ahead, points) - residuals(behind, points)
        by_variables[..., column] /= 2 * h[column]
    by_point = np.empty((len(seen), 2, 3))
    for axis in range(3):
        step = STEP * (np.arange(3) == axis)
        by_point[..., axis] = residuals(values, points + step) - residuals(values, points - step)
    return Dense(residuals(values, points), by_variables, by_point / (2 * STEP), seen.point)


def whole(system: System) -> FloatArray:
    """A system's matrix (n_columns, n_columns) out of its fronts' upper triangles."""
    plan = system.elimination
    H = np.zeros((plan.n_columns,) * 2)
    for front, matrix in zip(plan.fronts, system.matrices, strict=True):
        columns = plan.columns(front)
        H[np.ix_(columns, columns)] += np.triu(matrix)
    first = plan.n_columns - plan.border
    H[first:, first:] += np.triu(system.border)
    return H + np.triu(H, 1).T


def of_others(graph: CalibrationGraph, values: gtsam.Values) -> FloatArray:
    """The Hessian of everything but the tracks (n_columns, n_columns), by GTSAM."""
    linear = graph.others.linearize(values)
    ordering = gtsam.Ordering()
    columns = []
    for key in sorted(set(linear.keys())):
        ordering.push_back(key)
        columns.append(graph.layout.columns(key))
    place = np.concatenate(columns)
    H = np.zeros((graph.layout.elimination.n_columns,) * 2)
    H[np.ix_(place, place)] = linear.hessian(ordering)[0]
    return H

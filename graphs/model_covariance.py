"""What the model says of the calibration's covariance: independent noise, robust weights in it.

Points and frames are eliminated exactly; what is left is the joint information of all lenses and
cam_from_rig. Lengths of a rig without a measured scale are in units of its longest baseline: the
result's unit, exactly known, and free of the gauge that the solve happened to hold.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.linalg

from graphs.build import CalibrationGraph
from graphs.clusters import homogeneous
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import FloatArray, reported_from_tangent
from graphs.influence import responses
from graphs.keys import lens_key, rig_key
from graphs.noise import LossMoments, loss_moments
from graphs.problem import Estimate, IntArray, Problem, residuals_px
from graphs.system import assemble, jacobian_of
from graphs.threads import threads
from graphs.unit import baseline_unit, unit_jacobian


@dataclass(frozen=True)
class ModelCovariance:
    """The covariance of the reported parameters, by what it is made of."""

    names: tuple[str, ...]
    from_data: FloatArray  # (n, n) from the noise of the observations
    of_priors: FloatArray  # (n_rows, n) what a sigma of each prior and scale source adds to them
    response: FloatArray  # (n_columns, n) what a unit of the cost's gradient does to them
    moments: LossMoments
    unit_camera: int | None  # whose baseline is the unit of length; None: the estimate's own unit
    unit: float  # that baseline in the estimate's unit, else 1

    @property
    def from_priors(self) -> FloatArray:
        """The covariance (n, n) that priors and scale sources bring by being uncertain."""
        result: FloatArray = self.of_priors.T @ self.of_priors
        return result

    @property
    def matrix(self) -> FloatArray:
        return self.from_data + self.from_priors

    @property
    def covariance(self) -> Covariance:
        return Covariance(self.names, self.matrix)


def model_covariance(
    graph: CalibrationGraph,
    estimate: Estimate,
    values: gtsam.Values,
    like: ModelCovariance | None = None,
) -> ModelCovariance:
    """Covariance of every free lens parameter and every cam_from_rig at the optimum.

    Lens parameters that are held fixed and the reference camera are left out. like: whose unit of
    length to take, where the problem has no scale; without it, the longest baseline's.
    Raises ValueError when the problem determines less than it asks for.
    """
    moments = loss_moments(
        graph.problem, graph.options, residuals_px(estimate, graph.problem.observations)
    )
    columns, names, to_reported = calibration_columns(graph, estimate)
    if not columns.size:  # everything is held
        nothing, response = np.zeros((0, 0)), np.zeros((graph.layout.elimination.n_columns, 0))
        return ModelCovariance(names, nothing, np.zeros((0, 0)), response, moments, None, 1.0)
    others = graph.others.linearize(values)
    response = response_at(graph, estimate, values, others, columns, moments.curvature)
    by_tangent, unit = to_reported, 1.0
    unit_camera = None if like is None else like.unit_camera
    if not graph.problem.metric and like is None:
        whole = Covariance(names, to_reported @ response[columns] @ to_reported.T)
        unit_camera = _unit_of_prior(graph.problem)
        if unit_camera is None:
            unit_camera = baseline_unit(estimate, graph.problem.reference, whole)
    if unit_camera is not None:
        unit = float(np.linalg.norm(estimate.cam_from_rig[unit_camera].translation))
        by_tangent = unit_jacobian(names, estimate, unit_camera) @ to_reported
    response = response @ by_tangent.T
    of_priors = jacobian_of(others, graph.layout)[0] @ response
    from_data = (by_tangent @ response[columns] - of_priors.T @ of_priors) / moments.curvature
    return ModelCovariance(
        names, moments.score_variance * from_data, of_priors, response, moments,
        unit_camera, unit,
    )  # fmt: skip


def response_at(
    graph: CalibrationGraph,
    estimate: Estimate,
    values: gtsam.Values,
    others: gtsam.GaussianFactorGraph,
    columns: IntArray,
    curvature: float,
) -> FloatArray:
    """Columns of the inverse normal equations (n_columns, len(columns)) at the optimum.

    others: the graph's other factors, linearised there; curvature: of the loss, in its weights'.
    Raises ValueError when the problem determines less than it asks for.
    """
    with threads() as pool:
        system = assemble(
            graph.tracks,
            others,
            graph.layout,
            graph.variables(values),
            homogeneous(graph.tracks, estimate.points),
            pool,
            curvature,
        )
        return responses(graph, system, columns)


def _unit_of_prior(problem: Problem) -> int | None:
    """The camera whose baseline is an earlier calibration's unit: its lengths stay comparable."""
    if problem.prior is None or problem.prior.unit is None:
        return None
    return [camera.name for camera in problem.initial.cameras].index(problem.prior.unit)


def calibration_columns(
    graph: CalibrationGraph, estimate: Estimate, held: bool = False
) -> tuple[IntArray, tuple[str, ...], FloatArray]:
    """Columns of the free lens parameters and cam_from_rig, their names, and the Jacobian
    from GTSAM's tangent to the reported parameters.

    held: of lens parameters that are held too.
    """
    layout = graph.layout
    columns: list[int] = []
    names: list[str] = []
    blocks: list[FloatArray] = []
    for index, camera in enumerate(estimate.cameras):
        lens = layout.lens_of[index]
        free = np.flatnonzero(graph.lens_priors[lens].free | held)
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

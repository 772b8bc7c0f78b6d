"""How well the size and the bends of a board are determined."""

from __future__ import annotations

import gtsam
import numpy as np

from graphs.build import CalibrationGraph
from graphs.clusters import homogeneous
from graphs.frames import FloatArray
from graphs.influence import responses
from graphs.keys import shape_key
from graphs.noise import loss_moments
from graphs.problem import Estimate, residuals_px
from graphs.system import assemble, jacobian_of
from graphs.threads import threads


def shape_sigmas(
    graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values, inflation: float = 1.0
) -> FloatArray:
    """Sigmas (k,) of a board's shape as `graphs.boards.corners_of` has it.

    inflation: of what the noise of the data brings, over what independent noise would.
    """
    problem = graph.problem
    moments = loss_moments(problem, graph.options, residuals_px(estimate, problem.observations))
    others = graph.others.linearize(values)
    columns = graph.layout.columns(shape_key())
    with threads() as pool:
        points = homogeneous(graph.tracks, estimate.points)
        variables = graph.variables(values)
        system = assemble(
            graph.tracks, others, graph.layout, variables, points, pool, moments.curvature
        )
        response = responses(graph, system, columns)
    of_priors = jacobian_of(others, graph.layout)[0] @ response
    from_priors = of_priors.T @ of_priors
    from_data = (response[columns] - from_priors) * moments.score_variance / moments.curvature
    variance = inflation**2 * np.diag(from_data) + np.diag(from_priors)
    result: FloatArray = np.sqrt(np.maximum(variance, 0.0))
    return result

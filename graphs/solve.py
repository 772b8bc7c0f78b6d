"""Minimise a graph, and say how it went; not converging is data, not an exception."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphs import reference
from graphs.build import CalibrationGraph
from graphs.frames import from_gtsam_inverse
from graphs.keys import frame_key, point_key, rig_key
from graphs.problem import Estimate, Problem

RELATIVE_COST_TOLERANCE = 1e-9  # below it, no parameter moves by a hundredth of its sigma

# Damping at which steps are rounding errors; at an optimum 1e4 was seen. GTSAM gets there when
# it cannot solve the linear system at all, and then reports the unchanged cost.
STUCK_LAMBDA = 1e10


@dataclass(frozen=True)
class SolveSummary:
    """How a solve went; `reason` says in words why it ended."""

    converged: bool
    reason: str
    iterations: int
    initial_cost: float
    cost: float


def solve(
    graph: CalibrationGraph,
    max_iterations: int = 100,
    relative_tolerance: float = RELATIVE_COST_TOLERANCE,
    on_iteration: Callable[[int, float], None] | None = None,
) -> tuple[Estimate, gtsam.Values, SolveSummary]:
    """Levenberg-Marquardt from the graph's start.

    Returns the estimate, the same as GTSAM values (for `covariance`), and a summary.
    """
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph.factors, graph.initial, params)
    initial = cost = optimizer.error()
    reason = f"stopped after {max_iterations} iterations"
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        optimizer.iterate()
        previous, cost = cost, optimizer.error()
        if on_iteration is not None:
            on_iteration(iteration, cost)
        if not np.isfinite(cost):
            reason = "the cost is not finite"
            break
        if optimizer.lambda_() > STUCK_LAMBDA:
            reason = "no step lowers the cost: the linear system cannot be solved"
            break
        if previous - cost <= relative_tolerance * previous:
            reason = "converged"
            break
    summary = SolveSummary(reason == "converged", reason, iteration, initial, cost)
    values = optimizer.values()
    return estimate_from(values, graph.problem), values, summary


def estimate_from(values: gtsam.Values, problem: Problem) -> Estimate:
    """GTSAM's values as an Estimate, in the problem's order."""
    start = problem.initial
    cameras = tuple(
        replace(camera, params=reference.lens_params(values, index, camera))
        for index, camera in enumerate(start.cameras)
    )
    return Estimate(
        cameras,
        tuple(from_gtsam_inverse(values.atPose3(rig_key(i))) for i in range(len(cameras))),
        tuple(
            from_gtsam_inverse(values.atPose3(frame_key(i)))
            for i in range(len(start.rig_from_world))
        ),
        np.array([values.atPoint3(point_key(i)) for i in range(len(start.points))]),
    )

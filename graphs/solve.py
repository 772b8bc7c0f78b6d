"""Minimise a graph, and say how it went; not converging is data, not an exception."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphs.build import CalibrationGraph
from graphs.clusters import euclidean, homogeneous
from graphs.elimination import NotPositiveDefiniteError
from graphs.frames import FloatArray, Transform, from_gtsam_inverse
from graphs.keys import board_key, frame_key, lens_key, rig_key, shape_key
from graphs.problem import Estimate
from graphs.system import System, assemble
from graphs.threads import threads
from graphs.tracks import TRIANGULATION_TOLERANCE, Variables, triangulate

# With n observations no parameter is more than sqrt(2e-9 n) of its sigma from the optimum: 0.01 of
# it at 50,000; near the optimum convergence is quadratic, and far closer.
RELATIVE_COST_TOLERANCE = 1e-9

# Levenberg-Marquardt's damping, of the diagonal: Nielsen's rule (IMM-REP-1999-05).
FIRST_DAMPING = 1e-4
# Near the optimum: in real scans parameters trade against each other to 1e-5 of the diagonal.
NEAR_DAMPING = 1e-8
LEAST_GAIN = 1e-3  # of the predicted decrease: a step that brings less is refused

# Relative gain of a step below which the loss's true curvature is used: before, it overshoots.
NEAR = 1e-2
POINT_SHARE = 1e-3  # of the decrease that a step predicts: what its points may be short of
# Damping at which steps are rounding errors; at an optimum 1e4 was seen.
STUCK_DAMPING = 1e10


@dataclass(frozen=True)
class SolveSummary:
    """How a solve went; `reason` says in words why it ended."""

    converged: bool
    reason: str
    iterations: int
    initial_cost: float
    cost: float


@dataclass(frozen=True)
class State:
    """Values of all variables, the points that suit them best, and the cost of both."""

    values: gtsam.Values
    variables: Variables
    points: FloatArray  # (n_points, 4) as `graphs.clusters.homogeneous` has them
    cost: float


def solve(
    graph: CalibrationGraph,
    max_iterations: int = 100,
    relative_tolerance: float = RELATIVE_COST_TOLERANCE,
    on_iteration: Callable[[int, float], None] | None = None,
    near: bool = False,
) -> tuple[Estimate, gtsam.Values, SolveSummary]:
    """Levenberg-Marquardt from the graph's start, points eliminated.

    near: the start is near the optimum, and the loss's true curvature may be used at once.

    Returns the estimate, the same as GTSAM values (for `covariance`), and a summary. An iteration
    is one trial step, accepted or not.
    """
    with threads() as pool:
        start = homogeneous(graph.tracks, graph.problem.initial.points)
        state = evaluate(graph, graph.initial, start, pool, np.inf)
        initial_cost, reason = state.cost, f"stopped after {max_iterations} iterations"
        damping, growth = NEAR_DAMPING if near else FIRST_DAMPING, 2.0
        system, idle = None, False
        iteration = 0
        for iteration in range(1, max_iterations + 1):
            if system is None:
                system = linearised(graph, state, pool, near)
                idle = bool((system.diagonal == 0).any())
            trial, predicted = step(graph, state, system, damping, pool)
            gained = state.cost - trial.cost
            if on_iteration is not None:
                on_iteration(iteration, min(state.cost, trial.cost))
            accepted = gained > LEAST_GAIN * predicted
            if accepted:
                gain = gained / max(predicted, 1e-300)
                damping *= max(1 / 3, 1 - (2 * min(gain, 2.0) - 1) ** 3)
                near = gained < NEAR * state.cost
                state, growth, system = trial, 2.0, None
            else:
                damping, growth = damping * growth, 2 * growth
            little = relative_tolerance * state.cost
            if damping < 1 and (predicted <= little or (accepted and gained <= little)):
                reason = "some variables are not determined" if idle else "converged"
                break
            if damping > STUCK_DAMPING:
                reason = "no step lowers the cost"
                break
    summary = SolveSummary(reason == "converged", reason, iteration, initial_cost, state.cost)
    return estimate_from(graph, state), state.values, summary


def evaluate(
    graph: CalibrationGraph,
    values: gtsam.Values,
    points: FloatArray,
    pool: ThreadPoolExecutor,
    at_stake: float = 0.0,
    before: Variables | None = None,
) -> State:
    """Triangulate for these values, from `points`, to a small share of the cost `at_stake`.

    before: the variables that `points` belong to.
    """
    variables = graph.variables(values)
    tolerance = max(POINT_SHARE * at_stake / len(points), TRIANGULATION_TOLERANCE)
    points, cost = triangulate(graph.tracks, variables, points, pool, tolerance, before)
    return State(values, variables, points, cost + graph.others.error(values))


def linearised(
    graph: CalibrationGraph, state: State, pool: ThreadPoolExecutor, newton: bool = False
) -> System:
    """The graph's normal equations at a state."""
    return assemble(
        graph.tracks,
        graph.others.linearize(state.values),
        graph.layout,
        state.variables,
        state.points,
        pool,
        newton=newton,
    )


def step(
    graph: CalibrationGraph,
    state: State,
    system: System,
    damping: float,
    pool: ThreadPoolExecutor,
) -> tuple[State, float]:
    """The state one damped step further, and the decrease of the cost that the step predicts."""
    refused = replace(state, cost=np.inf), np.inf
    try:
        change = system.factorise(damping).solve(-system.gradient)
    except NotPositiveDefiniteError:
        return refused
    if not np.isfinite(change).all():
        return refused
    curved = damping * change @ (system.diagonal * change)
    predicted = 0.5 * float(curved - system.gradient @ change)
    delta = gtsam.VectorValues()
    for key in graph.layout.first_column:
        delta.insert(key, change[graph.layout.columns(key)])
    moved = state.values.retract(delta)
    return evaluate(graph, moved, state.points, pool, predicted, state.variables), predicted


def estimate_from(graph: CalibrationGraph, state: State) -> Estimate:
    """A state as an Estimate, in the problem's order."""
    values, start = state.values, graph.problem.initial
    cameras = tuple(
        replace(camera, params=values.atVector(lens_key(lens)))
        for camera, lens in zip(start.cameras, graph.layout.lens_of, strict=True)
    )
    return Estimate(
        cameras,
        tuple(
            Transform.identity()
            if i == graph.problem.reference
            else from_gtsam_inverse(values.atPose3(rig_key(i)))
            for i in range(len(cameras))
        ),
        tuple(
            from_gtsam_inverse(values.atPose3(frame_key(i)))
            for i in range(len(start.rig_from_world))
        ),
        euclidean(graph.tracks, state.points, start.points),
        from_gtsam_inverse(values.atPose3(board_key())).inverse
        if values.exists(board_key())
        else None,
        values.atVector(shape_key()) if values.exists(shape_key()) else None,
    )

"""Solve, learn the noise from the residuals, set gross mismatches aside, and solve again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphs.build import CalibrationGraph, GraphOptions, LossName, build
from graphs.frames import FloatArray
from graphs.noise import robust_sigma_px
from graphs.problem import Estimate, Problem, residuals_px
from graphs.selection import select_tracks, within_budget
from graphs.solve import SolveSummary, solve

# Rough, rough, exact: mismatches are only visible once the lenses are nearly right. Measured on
# fountain: a single solve to 1e-9 takes 68 iterations, these rounds 38, the same within 0.1 sigma.
ROUND_TOLERANCES = (1e-4, 1e-4, 1e-6)
# Whatever the final loss: with 5 % of mismatches in the rough rounds, least squares and Huber
# bend the lens to them (fx 25 and -35 px off, their residuals unremarkable); Cauchy 1 px off.
ROUGH_LOSS: LossName = "cauchy"
# Cauchy at 2.385 sigma leaves an observation at 5 sigma a fifth of its weight; beyond lie
# mismatches, and their bistable weights are what slows convergence.
REJECT_SIGMAS = 5.0
# Two cores take about 1.2 s an iteration for so many; a rendered room gives 250,000.
MAX_OBSERVATIONS = 80000


@dataclass(frozen=True)
class Refinement:
    """The optimum, the graph it is the optimum of, and how it was reached."""

    graph: CalibrationGraph
    estimate: Estimate
    values: gtsam.Values
    summary: SolveSummary
    iterations: int  # of all rounds
    sigma_px: float
    n_rejected: int

    @property
    def problem(self) -> Problem:
        return self.graph.problem


def refine(
    problem: Problem,
    options: GraphOptions,
    min_parallax_deg: float,
    max_observations: int = MAX_OBSERVATIONS,
    on_iteration: Callable[[int, float], None] | None = None,
) -> Refinement:
    """Estimate every variable of a problem whose noise is unknown.

    Raises ValueError when no track is long and wide enough, or the scene has no size.
    """
    before = len(problem.observations)
    problem = within_budget(select_tracks(problem, min_parallax_deg), max_observations)
    n_unused = before - len(problem.observations)
    iterations = 0
    for number, tolerance in enumerate(ROUND_TOLERANCES):
        if number > 0:
            problem = without_mismatches(problem, min_parallax_deg)
        sigma_px = noise_of(problem)
        rough = number < len(ROUND_TOLERANCES) - 1
        loss = ROUGH_LOSS if rough else options.loss
        graph = build(problem, replace(options, sigma_px=sigma_px, loss=loss))
        so_far = iterations

        def report(iteration: int, cost: float, so_far: int = so_far) -> None:
            if on_iteration is not None:
                on_iteration(so_far + iteration, cost)

        estimate, values, summary = solve(graph, relative_tolerance=tolerance, on_iteration=report)
        iterations += summary.iterations
        problem = replace(problem, initial=estimate)
    rejected = before - n_unused - len(problem.observations)
    final = robust_sigma_px(problem, residuals(problem))
    return Refinement(graph, estimate, values, summary, iterations, final, rejected)


# Perfect data has no noise; weights need a scale above rounding.
SMALLEST_SIGMA_PX = 1e-3


def noise_of(problem: Problem) -> float:
    """Robust sigma of the residuals at the problem's start."""
    return max(robust_sigma_px(problem, residuals(problem)), SMALLEST_SIGMA_PX)


def without_mismatches(problem: Problem, min_parallax_deg: float) -> Problem:
    """The problem less observations far beyond the noise, and the tracks that end with them."""
    lengths = np.linalg.norm(residuals(problem), axis=1)
    with np.errstate(invalid="ignore"):
        keep = lengths < REJECT_SIGMAS * noise_of(problem)
    return select_tracks(
        replace(problem, observations=problem.observations.subset(keep)), min_parallax_deg
    )


def residuals(problem: Problem) -> FloatArray:
    """Projected minus observed pixels (n_obs, 2) at the problem's start."""
    return residuals_px(problem.initial, problem.observations)

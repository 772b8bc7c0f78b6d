"""Solve, learn the noise from the residuals, set gross mismatches aside, and solve again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphs.budget import Budget, within_budget
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.frames import FloatArray
from graphs.losses import SCALE_95, LossName
from graphs.noise import (
    SMALLEST_SIGMA_PX,
    NoiseClass,
    adapted,
    noise_classes,
    residual_lengths,
    robust_sigma_px,
    with_class_sigmas,
    with_click_sigma,
)
from graphs.problem import Estimate, KnownSpan, Problem, points_in_cameras, residuals_px
from graphs.selection import MIN_TRACK_LENGTH, select_tracks
from graphs.solve import SolveSummary, solve

# Rough, rough, exact: mismatches are only visible once the lenses are nearly right.
ROUND_TOLERANCES = (1e-4, 1e-4, 1e-8)
ROUGH_STEPS, FINAL_STEPS = 20, 100  # at most: what resists in a rough round is mostly mismatches
# Whatever the final loss: with 5 % of mismatches in the rough rounds, least squares and Huber
# bend the lens to them (fx 25 and -35 px off, their residuals unremarkable); Cauchy 1 px off.
ROUGH_LOSS: LossName = "cauchy"
# Cauchy's loss leaves an observation at 5 sigma a fifth of its weight; beyond lie mismatches.
REJECT_SIGMAS = 5.0
# Of the greatest distance from which a track is seen. Three steps along a street bring a corner
# from 50 m to 1 m; nothing is in focus at 0.3 %.
NEAREST = 0.003
# Two cores take about half a second an iteration for so many; a rendered room gives 250,000.
MAX_OBSERVATIONS = 400_000


@dataclass(frozen=True)
class Refinement:
    """The optimum, the graph it is the optimum of, and how it was reached."""

    graph: CalibrationGraph
    estimate: Estimate
    values: gtsam.Values
    summary: SolveSummary
    iterations: int  # of all rounds
    sigma_px: float
    noise: tuple[NoiseClass, ...]
    n_rejected: int
    budget: Budget | None  # of observations, where there were more than it allows

    @property
    def problem(self) -> Problem:
        return self.graph.problem


def refine(
    problem: Problem,
    options: GraphOptions,
    min_parallax_deg: float,
    max_observations: int = MAX_OBSERVATIONS,
    on_iteration: Callable[[int, float], None] | None = None,
    adaptive: bool = False,
) -> Refinement:
    """Estimate every variable of a problem whose noise is unknown.

    adaptive: in place of the options' loss, the one that suits the residuals best.
    Raises ValueError when no track is long and wide enough, or the scene has no size.
    """
    before = len(problem.observations)
    problem = select_tracks(problem, min_parallax_deg)
    rough = replace(
        options, sigma_px=noise_of(problem), loss=ROUGH_LOSS, loss_scale=SCALE_95[ROUGH_LOSS]
    )
    problem, budget = within_budget(problem, rough, max_observations)
    n_unused = before - len(problem.observations)
    iterations = 0
    for number, tolerance in enumerate(ROUND_TOLERANCES):
        if number > 0:
            problem = without_mismatches(problem, min_parallax_deg)
            problem = with_class_sigmas(problem, residuals(problem), options)
        sigma_px = noise_of(problem, options)
        last = number == len(ROUND_TOLERANCES) - 1
        weighed = replace(options if last else rough, sigma_px=sigma_px)
        if last and adaptive:
            weighed = adapted(problem, weighed, residuals(problem))
        problem = with_click_sigma(problem, weighed.sigma_px)
        graph = build(problem, weighed)
        so_far = iterations

        def report(iteration: int, cost: float, so_far: int = so_far) -> None:
            if on_iteration is not None:
                on_iteration(so_far + iteration, cost)

        estimate, values, summary = solve(
            graph, FINAL_STEPS if last else ROUGH_STEPS, tolerance, on_iteration=report
        )
        iterations += summary.iterations
        problem = replace(problem, initial=estimate)
    rejected = before - n_unused - len(problem.observations)
    left = residuals(problem)
    return Refinement(
        graph, estimate, values, summary, iterations,
        robust_sigma_px(problem, left, options), noise_classes(problem, left, options),
        rejected, budget,
    )  # fmt: skip


def noise_of(problem: Problem, options: GraphOptions | None = None) -> float:
    """Robust sigma of the residuals at the problem's start."""
    return max(robust_sigma_px(problem, residuals(problem), options), SMALLEST_SIGMA_PX)


def without_mismatches(problem: Problem, min_parallax_deg: float) -> Problem:
    """The problem less observations far beyond the noise, and the tracks that end with them.

    Raises ValueError when that leaves too little of an end of a measured distance.
    """
    sigma_px = noise_of(problem)
    problem = with_click_sigma(problem, sigma_px)
    sigmas = residual_lengths(problem, residuals(problem)) / sigma_px
    with np.errstate(invalid="ignore"):
        keep = (sigmas < REJECT_SIGMAS) & ~ends_in_a_camera(problem)
    for source in problem.scales:
        if isinstance(source, KnownSpan):
            _check_ends(problem, source, keep, sigmas)
    return select_tracks(
        replace(problem, observations=problem.observations.subset(keep)), min_parallax_deg
    )


def ends_in_a_camera(problem: Problem) -> NDArray[np.bool_]:
    """Observations (n_obs,) from so near that only a mismatch explains them.

    A track that joins a camera's own place, as others see it, to whatever that camera sees is
    explained perfectly by a point right before its lens, and pins that camera.
    """
    seen = problem.observations
    distance = np.linalg.norm(points_in_cameras(problem.initial, seen), axis=1)
    farthest = np.zeros(len(problem.initial.points))
    np.maximum.at(farthest, seen.point, distance)
    return distance < NEAREST * farthest[seen.point]


def _check_ends(
    problem: Problem, scale: KnownSpan, keep: NDArray[np.bool_], sigmas: FloatArray
) -> None:
    """Raise ValueError where an end keeps fewer observations than a track needs."""
    seen = problem.observations
    for end in scale.points:
        rows = np.flatnonzero(seen.point == end)
        if np.count_nonzero(keep[rows]) < MIN_TRACK_LENGTH:
            worst = rows[np.argmax(np.nan_to_num(sigmas[rows], nan=np.inf))]
            length_px = np.linalg.norm(residuals(problem)[worst])
            image = (
                f"{problem.initial.cameras[seen.camera[worst]].name}/"
                f"{problem.frame_names[seen.frame[worst]]}"
            )
            raise ValueError(
                f"an end of the distance of {scale.length_m:g} m lies {length_px:.1f} px "
                f"({sigmas[worst]:.0f} sigmas) in {image} from where the other images put it, and "
                f"without it fewer than {MIN_TRACK_LENGTH} are left: correct that pixel, or give "
                "the end in more images"
            )


def residuals(problem: Problem) -> FloatArray:
    """Projected minus observed pixels (n_obs, 2) at the problem's start."""
    return residuals_px(problem.initial, problem.observations)

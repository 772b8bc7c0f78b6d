"""Fewer observations: whole tracks, those that say most, everywhere in the images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from graphs.budget import GRID, Budget, within_budget
from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.keys import lens_key, rig_key
from graphs.problem import IntArray, KnownSpan, Problem
from graphs.reference import build_reference, native_slots
from graphs.refine import refine
from graphs.selection import compact
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
OPTIONS = GraphOptions(SIGMA_PX)
# A start near the optimum, as after mapping: leverages are those of the start.
TRACKS = TrackOptions(
    rig="stereo", frames=10, points=1500, max_points_per_image=150, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.1, translation_error_m=0.005, point_error_m=0.01,
)  # fmt: skip


@cache
def problem_of(seed: int = 0) -> Problem:
    return simulate_tracks(TRACKS, np.random.default_rng(seed))[0]


@cache
def kept_of(share: float, seed: int = 0) -> tuple[Problem, Budget]:
    problem = problem_of(seed)
    chosen, budget = within_budget(problem, OPTIONS, int(share * len(problem.observations)))
    assert budget is not None
    return chosen, budget


def native_sigma(problem: Problem) -> FloatArray:
    """Sigmas of all lenses and cam_from_rig (n,) at the start, by GTSAM's own factors."""
    graph = build_reference(problem, OPTIONS)
    marginals = gtsam.Marginals(graph.factors, graph.initial)
    parts = [
        np.diag(marginals.marginalCovariance(lens_key(i)))[native_slots(camera)]
        for i, camera in enumerate(problem.initial.cameras)
    ]
    parts += [np.diag(marginals.marginalCovariance(rig_key(1)))]
    return np.sqrt(np.concatenate(parts))


# ---- what is kept --------------------------------------------------------------------------


def test_a_problem_within_its_budget_stays() -> None:
    problem = problem_of()
    kept, budget = within_budget(problem, OPTIONS, len(problem.observations))
    assert kept is problem and budget is None


@pytest.mark.parametrize("share", [0.15, 0.5, 0.9])
def test_tracks_are_kept_whole_and_the_budget_is_used(share: float) -> None:
    problem, (chosen, budget) = problem_of(), kept_of(share)
    allowed = int(share * len(problem.observations))
    assert budget.available == len(problem.observations)
    assert budget.kept == len(chosen.observations)
    assert 0.99 * allowed < budget.kept <= allowed
    length = dict(
        zip(map(tuple, problem.initial.points), np.bincount(problem.observations.point),
            strict=True)
    )  # fmt: skip
    for point, n in zip(
        map(tuple, chosen.initial.points), np.bincount(chosen.observations.point), strict=True
    ):
        assert length[point] == n


def test_two_runs_keep_the_same() -> None:
    problem, (chosen, budget) = problem_of(), kept_of(0.3)
    again, same = within_budget(problem, OPTIONS, int(0.3 * len(problem.observations)))
    assert same == budget
    np.testing.assert_array_equal(again.observations.pixels, chosen.observations.pixels)
    np.testing.assert_array_equal(again.initial.points, chosen.initial.points)


def test_every_image_keeps_some_and_they_reach_its_corners() -> None:
    """Information alone would leave images out; what remains covers nearly as much as before."""
    problem, (chosen, _) = problem_of(), kept_of(0.3)
    assert chosen.frame_names == problem.frame_names

    def cells(of: Problem) -> dict[int, int]:
        """Cells of each image with an observation in them."""
        seen = of.observations
        cell = np.floor(seen.pixels / TRACKS.size * GRID).astype(int)
        image = seen.frame * len(of.initial.cameras) + seen.camera
        return {i: len(np.unique(cell[image == i], axis=0)) for i in np.unique(image).tolist()}

    before, after = cells(problem), cells(chosen)
    assert before.keys() == after.keys()
    covered = [after[image] / before[image] for image in before]
    assert min(covered) > 0.4 and np.mean(covered) > 0.6


def test_the_ends_of_a_measured_distance_are_kept() -> None:
    """Those that without it would be the first to go."""
    problem, (chosen, _) = problem_of(), kept_of(0.3)
    left = {tuple(point) for point in chosen.initial.points}
    gone = [i for i, p in enumerate(map(tuple, problem.initial.points)) if p not in left]
    a, b = gone[0], gone[-1]
    length_m = float(np.linalg.norm(problem.initial.points[b] - problem.initial.points[a]))
    known = replace(problem, scales=(KnownSpan((a, b), length_m, 0.01),))
    kept, budget = within_budget(known, OPTIONS, int(0.3 * len(problem.observations)))
    (span,) = kept.scales
    assert isinstance(span, KnownSpan) and budget is not None
    np.testing.assert_array_equal(
        kept.initial.points[list(span.points)], problem.initial.points[[a, b]]
    )
    own = np.isin(problem.observations.point, (a, b)).sum()
    assert np.isin(kept.observations.point, span.points).sum() == own


# ---- what it costs -------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.15, 0.5])
def test_the_stated_cost_is_that_of_the_covariances(share: float) -> None:
    chosen, budget = kept_of(share)
    factor = native_sigma(chosen) / native_sigma(problem_of())
    assert budget.sigma_factor == pytest.approx(float(np.median(factor)), rel=1e-3)
    assert budget.worst_sigma_factor == pytest.approx(float(factor.max()), rel=1e-3)
    assert 1 < budget.sigma_factor < budget.worst_sigma_factor


def in_order(problem: Problem, order: IntArray, budget: int) -> Problem:
    """The first tracks of an order, as many as the budget allows."""
    length = np.bincount(problem.observations.point)
    keep = np.zeros(len(length), dtype=bool)
    keep[order[np.cumsum(length[order]) <= budget]] = True
    return compact(problem, problem.observations.subset(keep[problem.observations.point]))


def at_random(problem: Problem) -> IntArray:
    return np.random.default_rng(0).permutation(len(problem.initial.points))


def longest(problem: Problem) -> IntArray:
    return np.argsort(-np.bincount(problem.observations.point), kind="stable")


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("rival", [at_random, longest])
def test_simpler_choices_cost_more(rival: Callable[[Problem], NDArray], seed: int) -> None:
    problem, (chosen, budget) = problem_of(seed), kept_of(0.2, seed)
    other = in_order(problem, rival(problem), budget.kept)
    assert len(other.observations) > 0.95 * budget.kept
    whole = native_sigma(problem)
    cost, rivals_cost = native_sigma(chosen) / whole, native_sigma(other) / whole
    assert np.median(cost) < 0.95 * np.median(rivals_cost)


def test_the_solve_carries_it() -> None:
    problem = problem_of()
    half = len(problem.observations) // 2
    refinement = refine(problem, OPTIONS, 1.0, half)
    assert refinement.budget is not None and refinement.budget.kept <= half
    kept = len(refinement.problem.observations) + refinement.n_rejected
    assert kept == refinement.budget.kept  # what was not chosen is no mismatch
    assert refine(problem, OPTIONS, 1.0).budget is None

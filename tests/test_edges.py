"""Problems at the edge of what can be asked: all held, nothing seen, ends without a place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.problems import small_problem

from graphs.budget import within_budget
from graphs.build import GraphOptions, build
from graphs.frames import Transform
from graphs.priors import PINNED_SIGMA, LensPrior
from graphs.problem import KnownBaseline, Problem
from graphs.refine import refine
from graphs.scale import length_of
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance

OPTIONS = GraphOptions(sigma_px=0.5)


@pytest.mark.parametrize("sigma_m", [1e-7, 1e-5, 1e-3])
def test_a_baseline_has_the_sigma_of_its_measurement_however_long_the_path(sigma_m: float) -> None:
    problem, _ = small_problem("radial", cameras=2)
    measured = KnownBaseline((0, 1), 0.2, sigma_m)
    factor = 0.2 / length_of(measured, problem.initial)
    problem = replace(problem, initial=problem.initial.scaled(factor), scales=(measured,))
    graph = build(problem, OPTIONS)
    estimate, values, _ = solve(graph)
    model = calibration_covariance(graph, estimate, values).model
    names = [f"{estimate.cameras[1].name}.translation_{axis}" for axis in "xyz"]
    at = [model.names.index(name) for name in names]
    along = estimate.cam_from_rig[1].translation
    along = along / np.linalg.norm(along)
    assert along @ model.matrix[np.ix_(at, at)] @ along == pytest.approx(sigma_m**2, rel=1e-3)
    np.testing.assert_array_equal(estimate.cam_from_rig[0].rotation, np.eye(3))
    np.testing.assert_array_equal(estimate.cam_from_rig[0].translation, np.zeros(3))


def test_a_lone_camera_with_everything_held_has_nothing_to_state() -> None:
    problem, true = small_problem("radial", cameras=1)
    params = true.cameras[0].params
    options = replace(OPTIONS, lens_priors=(LensPrior(params, np.full(params.size, PINNED_SIGMA)),))
    found = refine(problem, options, 0.1)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    assert covariance.stated.names == () and covariance.inflation == 1.0
    budget = within_budget(problem, options, len(problem.observations) // 2)[1]
    assert budget is not None and budget.sigma_factor == 1.0


def test_points_that_nothing_sees_do_not_widen_the_sigmas() -> None:
    problem, _ = small_problem("radial")
    start = problem.initial
    more = replace(start, points=np.vstack([start.points, np.ones((1000, 3))]))
    sigmas = []
    for initial in (start, more):
        graph = build(replace(problem, initial=initial), OPTIONS)
        estimate, values, _ = solve(graph)
        sigmas.append(calibration_covariance(graph, estimate, values).stated.matrix)
    np.testing.assert_allclose(sigmas[1], sigmas[0], rtol=1e-6)


def without_a_place(problem: Problem, what: str) -> Problem:
    nowhere = Transform(np.eye(3), np.array([np.nan, 0, 0]))
    start = problem.initial
    if what == "camera":
        start = replace(start, cam_from_rig=(start.cam_from_rig[0], nowhere))
    elif what == "frame":
        start = replace(start, rig_from_world=(nowhere, *start.rig_from_world[1:]))
    elif what == "point":
        start = replace(start, points=np.vstack([[[np.inf, 0, 0]], start.points[1:]]))
    else:
        lens = replace(start.cameras[0], params=start.cameras[0].params * np.nan)
        start = replace(start, cameras=(lens, *start.cameras[1:]))
    return replace(problem, initial=start)


@pytest.mark.parametrize(
    ("what", "complaint"),
    [
        ("camera", "nowhere in the rig"),
        ("frame", "frame .* starts nowhere"),
        ("point", "1 of .* points start nowhere"),
        ("lens", "the lens starts at"),
    ],
)
def test_a_start_without_a_place_is_refused(what: str, complaint: str) -> None:
    problem, _ = small_problem("radial", cameras=2)
    with pytest.raises(ValueError, match=complaint):
        build(without_a_place(problem, what), OPTIONS)


def test_a_camera_in_two_groups_is_refused() -> None:
    problem, _ = small_problem("radial", cameras=3)
    with pytest.raises(ValueError, match="in two groups"):
        build(problem, replace(OPTIONS, shared_lenses=((1, 0), (0, 2))))

"""The freedom that no observation removes: counted, held, and refused when there is no size."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.frames import FloatArray, Transform
from graphs.gauge import GAUGE_SIGMA, Gauge, add_gauge, choose_gauge
from graphs.keys import frame_key, point_key, rig_key
from graphs.problem import KnownBaseline, Observations, Problem
from graphs.solve import solve
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SMALL = TrackOptions(
    rig="stereo", frames=8, points=220, max_points_per_image=60, lens="radial", baseline_sigma_m=0,
    focal_error=0.0, principal_point_error_px=0.0, rotation_error_deg=0.1,
    translation_error_m=0.003, point_error_m=0.005,
)  # fmt: skip


def problem_of(scale: KnownBaseline | None = None, **changes: object) -> Problem:
    problem, _ = simulate_tracks(SMALL.model_copy(update=changes), np.random.default_rng(0))
    return replace(problem, scale=scale)


def spectrum(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> FloatArray:
    """Eigenvalues of the Hessian over every variable, scaled to a unit diagonal, ascending."""
    hessian = factors.linearize(values).hessian()[0]
    scale = 1 / np.sqrt(np.diag(hessian))
    return np.linalg.eigvalsh(hessian * np.outer(scale, scale))


def deficiency(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> int:
    return int((spectrum(factors, values) < 1e-12).sum())


def some_factors(graph: CalibrationGraph, keep: list[int]) -> gtsam.NonlinearFactorGraph:
    some = gtsam.NonlinearFactorGraph()
    for index in keep:
        some.push_back(graph.factors.at(index))
    return some


BASELINE = KnownBaseline((0, 1), 0.2, 0.001)


@pytest.mark.parametrize("scale", [None, BASELINE])
def test_seven_degrees_of_freedom_and_the_reference_camera_are_free_without_the_gauge(
    scale: KnownBaseline | None,
) -> None:
    """At the optimum, where the curvature is the Hessian: 7 + 6, and a baseline is worth one."""
    graph = build(problem_of(scale), GraphOptions(sigma_px=0.5, loss="none"))
    _, values, _ = solve(graph)
    n = graph.factors.size()
    without = list(range(n - 3)) + ([n - 1] if scale else [])
    frame, reference = n - 3, n - 2
    assert deficiency(graph.factors, values) == 0
    assert deficiency(some_factors(graph, without), values) == (12 if scale else 13)
    assert deficiency(some_factors(graph, [*without, reference]), values) == (6 if scale else 7)
    assert deficiency(some_factors(graph, [*without, frame, reference]), values) == (
        0 if scale else 1
    )


def test_the_gauge_moves_nothing_that_is_measured() -> None:
    """The cost at the optimum is that of the observations and priors alone."""
    graph = build(problem_of(), GraphOptions(sigma_px=0.5))
    _, values, _ = solve(graph, relative_tolerance=1e-13)
    measured = some_factors(graph, list(range(graph.factors.size() - 3)))
    assert graph.factors.error(values) == pytest.approx(measured.error(values), rel=1e-9)


def test_the_best_seen_frame_and_the_longest_way_from_it_are_held() -> None:
    problem = problem_of()
    counts = np.bincount(problem.observations.frame)
    gauge = choose_gauge(problem)
    assert counts[gauge.frame] == counts.max()
    centres = np.array([t.inverse.translation for t in problem.initial.rig_from_world])
    far = np.linalg.norm(centres - centres[gauge.frame], axis=1)
    assert gauge.frames == (gauge.frame, int(far.argmax()))
    assert gauge.distance == pytest.approx(far.max())
    assert gauge.cameras is None


def test_a_rig_that_only_turns_has_the_size_of_its_baseline() -> None:
    problem = problem_of(trajectory="panorama", translation_error_m=0.0)
    gauge = choose_gauge(problem)
    baseline = np.linalg.norm(problem.initial.cam_from_rig[1].inverse.translation)
    assert gauge == Gauge(gauge.frame, pytest.approx(baseline), cameras=(0, 1))
    graph = build(problem, GraphOptions(sigma_px=0.5, loss="none"))
    assert deficiency(graph.factors, graph.initial) == 0


def test_images_from_one_point_are_refused() -> None:
    problem = problem_of(rig="mono", trajectory="panorama", translation_error_m=0.0)
    turning = tuple(Transform(t.rotation, np.zeros(3)) for t in problem.initial.rig_from_world)
    problem = replace(problem, initial=replace(problem.initial, rig_from_world=turning))
    with pytest.raises(ValueError, match="all images were taken from one point"):
        build(problem, GraphOptions())


def test_held_things_stay() -> None:
    problem = problem_of()
    estimate, _, summary = solve(build(problem, GraphOptions(sigma_px=0.5)))
    assert summary.converged
    gauge = choose_gauge(problem)
    held, before = estimate.rig_from_world[gauge.frame], problem.initial.rig_from_world[gauge.frame]
    np.testing.assert_allclose(held.rotation, before.rotation, atol=1e-6)
    np.testing.assert_allclose(held.translation, before.translation, atol=1e-6)
    np.testing.assert_allclose(estimate.cam_from_rig[0].rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(estimate.cam_from_rig[0].translation, 0, atol=1e-6)
    assert gauge.frames is not None
    ends = [estimate.rig_from_world[f].inverse.translation for f in gauge.frames]
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(gauge.distance, rel=1e-5)


def test_a_known_baseline_gives_the_size() -> None:
    length = 0.73
    estimate, _, _ = solve(build(problem_of(KnownBaseline((0, 1), length, 1e-4)), GraphOptions()))
    assert np.linalg.norm(estimate.cam_from_rig[1].translation) == pytest.approx(length, rel=1e-5)


def test_another_reference_is_held_instead() -> None:
    problem = replace(problem_of(), reference=1)
    factors = gtsam.NonlinearFactorGraph()
    add_gauge(factors, problem)
    held = {key for i in range(2) for key in tuple(factors.at(i).keys())}
    assert held == {frame_key(choose_gauge(problem).frame), rig_key(1)}


@pytest.mark.parametrize("size", [1e-5, 1e5])
def test_the_unit_of_length_does_not_matter(size: float) -> None:
    """GTSAM makes hard constraints of sigmas below 1e-8, and then cannot move."""
    problem = problem_of()
    scaled = replace(problem, initial=problem.initial.scaled(size))
    assert GAUGE_SIGMA * choose_gauge(problem).distance * 1e-5 < 1e-8
    _, _, summary = solve(build(problem, GraphOptions(sigma_px=0.5)))
    estimate, _, again = solve(build(scaled, GraphOptions(sigma_px=0.5)))
    assert again.converged
    assert again.cost == pytest.approx(summary.cost, rel=1e-6)
    assert np.isfinite(estimate.points).all()


def test_a_hopeless_problem_is_said_not_to_have_converged() -> None:
    """A NaN among the pixels leaves LM without a step that could lower the cost."""
    problem = problem_of()
    pixels = problem.observations.pixels.copy()
    pixels[0] = np.nan
    seen = problem.observations
    broken = replace(
        problem, observations=Observations(pixels, seen.frame, seen.camera, seen.point)
    )
    _, _, summary = solve(build(broken, GraphOptions(sigma_px=0.5)))
    assert not summary.converged
    assert summary.reason != "converged"


def test_a_system_that_cannot_be_solved_is_not_called_converged() -> None:
    """GTSAM's LM raises its lambda to the sky on a hard constraint, and stands still."""
    problem = problem_of()
    graph = build(problem, GraphOptions(sigma_px=0.5))
    hard = gtsam.noiseModel.Constrained.All(3)
    graph.factors.add(gtsam.PriorFactorPoint3(point_key(0), problem.initial.points[0], hard))
    _, _, summary = solve(graph)
    assert not summary.converged
    assert "linear system" in summary.reason

"""The freedom that no observation removes: counted, held, and refused when there is no size."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphs.build import GraphOptions, build
from graphs.factors import factor_graph
from graphs.frames import FloatArray, Transform
from graphs.gauge import GAUGE_SIGMA, Gauge, add_gauge, choose_gauge
from graphs.keys import frame_key, rig_key
from graphs.lenses import LensName
from graphs.problem import KnownBaseline, Problem
from graphs.reference import build_reference, native_values
from graphs.solve import solve
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SMALL = TrackOptions(
    rig="stereo", frames=8, points=220, max_points_per_image=60, lens="radial", baseline_sigma_m=0,
    focal_error=0.0, principal_point_error_px=0.0, rotation_error_deg=0.1,
    translation_error_m=0.003, point_error_m=0.005,
)  # fmt: skip


def problem_of(scale: KnownBaseline | None = None, **changes: object) -> Problem:
    problem, _ = simulate_tracks(SMALL.model_copy(update=changes), np.random.default_rng(0))
    return replace(problem, scales=(scale,) if scale else ())


def nullity(hessian: FloatArray) -> int:
    """Of a Hessian, in columns scaled to a unit diagonal."""
    scale = 1 / np.sqrt(np.diag(hessian))
    return int((np.linalg.eigvalsh(hessian * np.outer(scale, scale)) < 1e-12).sum())


def dense(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> FloatArray:
    return factors.linearize(values).hessian()[0]


def picked(factors: gtsam.NonlinearFactorGraph, keep: list[int]) -> gtsam.NonlinearFactorGraph:
    some = gtsam.NonlinearFactorGraph()
    for index in keep:
        some.push_back(factors.at(index))
    return some


BASELINE = KnownBaseline((0, 1), 0.2, 0.001)
TRACKS_ALONE: list[tuple[str, LensName]] = [
    ("mono", "radial"), ("stereo", "radial"), ("triple", "kannala_brandt"), ("stereo", "eucm"),
]  # fmt: skip


@pytest.mark.parametrize(("rig", "lens"), TRACKS_ALONE)
def test_tracks_leave_seven_degrees_of_freedom(rig: str, lens: LensName) -> None:
    """Where the world is, and how large, at the optimum, where the curvature is the Hessian; the
    reference camera is held at the identity within the tracks, so more cameras add none."""
    problem = problem_of(rig=rig, lens=lens)
    graph = build(problem, GraphOptions(sigma_px=0.5, loss="none"))
    estimate, values, _ = solve(graph, relative_tolerance=1e-14)
    whole = factor_graph(replace(graph, problem=replace(problem, initial=estimate)))
    n_tracks = whole.size() - graph.others.size()
    tracks = picked(whole, list(range(n_tracks)))
    assert rig_key(0) not in set(tracks.keys())
    assert nullity(dense(tracks, values)) == 7
    assert nullity(dense(whole, values)) == 0


@pytest.mark.parametrize("scale", [None, BASELINE])
def test_the_gauge_takes_what_is_free_and_a_baseline_is_worth_one(
    scale: KnownBaseline | None,
) -> None:
    """Counted in the reference, whose points and reference camera are variables: 7 + 6."""
    problem = problem_of(scale)
    options = GraphOptions(sigma_px=0.5, loss="none")
    estimate, _, _ = solve(build(problem, options), relative_tolerance=1e-14)
    values = native_values(replace(problem, initial=estimate))
    factors = build_reference(problem, options).factors
    poses = {frame_key(choose_gauge(problem).frame), rig_key(0)}
    frame, reference = (
        next(i for i in range(factors.size()) if list(factors.at(i).keys()) == [key])
        for key in sorted(poses, reverse=True)
    )
    ranges = [i for i in range(factors.size()) if is_range(factors.at(i))]
    assert len(ranges) == 1  # the held distance, or the measured one
    held = {frame, reference} | (set() if scale else set(ranges))
    without = [i for i in range(factors.size()) if i not in held]
    least = 12 if scale else 13
    assert nullity(dense(factors, values)) == 0
    assert nullity(dense(picked(factors, without), values)) == least
    assert nullity(dense(picked(factors, [*without, reference]), values)) == least - 6
    assert nullity(dense(picked(factors, [*without, frame, reference]), values)) == least - 12


def is_range(factor: gtsam.NonlinearFactor) -> bool:
    return "Range" in type(factor).__name__


def test_the_gauge_moves_nothing_that_is_measured() -> None:
    """The cost at the optimum is that of the observations and priors alone."""
    problem = problem_of()
    graph = build(problem, GraphOptions(sigma_px=0.5))
    _, values, _ = solve(graph, relative_tolerance=1e-13)
    gauge = gtsam.NonlinearFactorGraph()
    add_gauge(gauge, problem)
    assert gauge.size() == 3
    assert gauge.error(values) < 1e-9 * graph.others.error(values)


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
    assert nullity(dense(factor_graph(graph), graph.initial)) == 0


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

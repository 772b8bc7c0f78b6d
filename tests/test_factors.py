"""Tracks among GTSAM's own factors: its optimisers, its marginals, and factors beside ours."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic.dense import of_others, whole
from synthetic.problems import calibration_of, small_problem

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.clusters import homogeneous
from graphs.factors import factor_graph, square_root
from graphs.frames import FloatArray, Transform, from_gtsam_inverse, to_gtsam_inverse
from graphs.keys import frame_key, lens_key, rig_key
from graphs.lenses import LENS_NAMES, LensName
from graphs.losses import LOSS_NAMES, SCALE_95, LossName
from graphs.problem import Estimate, Problem
from graphs.solve import evaluate, linearised, solve
from graphs.threads import threads

SIGMA_PX = 0.5
TIGHT = 1e-13  # relative decrease of the cost


def options_of(loss: LossName = "none", **changes: object) -> GraphOptions:
    return replace(GraphOptions(SIGMA_PX, loss, min(SCALE_95[loss], 1e6)), **changes)  # type: ignore[arg-type]


def optimised(factors: gtsam.NonlinearFactorGraph, start: gtsam.Values, how: str) -> gtsam.Values:
    """By GTSAM's own optimiser."""
    if how == "dogleg":
        params = gtsam.DoglegParams()
    else:
        params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setMaxIterations(300)
    params.setRelativeErrorTol(1e-15)
    params.setAbsoluteErrorTol(1e-13)
    if how == "dogleg":
        return gtsam.DoglegOptimizer(factors, start, params).optimize()
    return gtsam.LevenbergMarquardtOptimizer(factors, start, params).optimize()


def rig_of(values: gtsam.Values, problem: Problem) -> FloatArray:
    """All lens parameters and cam_from_rig in one row."""
    cameras = range(len(problem.initial.cameras))
    lenses = [values.atVector(lens_key(i)) for i in cameras if values.exists(lens_key(i))]
    placed = [values.atPose3(rig_key(i)).matrix()[:3].ravel() for i in cameras]
    return np.concatenate([*lenses, *placed])


def assert_same_rig(ours: gtsam.Values, theirs: gtsam.Values, problem: Problem) -> None:
    np.testing.assert_allclose(rig_of(ours, problem), rig_of(theirs, problem), rtol=1e-5, atol=1e-6)


def columns_of(graph: CalibrationGraph, keys: list[int]) -> np.ndarray:
    return np.concatenate([graph.layout.columns(key) for key in keys])


def dense_inverse(graph: CalibrationGraph, values: gtsam.Values, points: FloatArray) -> FloatArray:
    """Of the whole system at an optimum, inverted after scaling."""
    with threads() as pool:
        state = evaluate(graph, values, homogeneous(graph.tracks, points), pool)
        H = whole(linearised(graph, state, pool))
    scale = 1 / np.sqrt(np.diag(H))
    return np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)


def assert_same_covariance(ours: FloatArray, expected: FloatArray, tolerance: float) -> None:
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(ours / np.outer(sigma, sigma), expected / np.outer(sigma, sigma),
                               rtol=0, atol=tolerance)  # fmt: skip


# ---- the same cost, gradient and Hessian ---------------------------------------------------


@pytest.mark.parametrize("points_per_factor", [None, 7, 1])
@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_the_factors_are_the_graph_however_they_are_cut(
    loss: LossName, points_per_factor: int | None
) -> None:
    """GTSAM adds up the same cost, gradient and Hessian; with one point a factor, a factor each."""
    problem, _ = small_problem("radtan", cameras=3, start_error=0.3, baseline=True)
    graph = build(problem, options_of(loss))
    factors = factor_graph(graph, points_per_factor)
    if points_per_factor == 1:
        assert factors.size() == len(problem.initial.points) + graph.others.size()
    start = homogeneous(graph.tracks, problem.initial.points)
    with threads() as pool:
        state = evaluate(graph, graph.initial, start, pool)
        system = linearised(graph, state, pool)
    assert factors.error(graph.initial) == pytest.approx(state.cost, rel=1e-9)
    linear = factors.linearize(graph.initial)
    keys = sorted(graph.layout.first_column)
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    at = columns_of(graph, keys)
    scale = (1 / np.sqrt(system.diagonal))[at]
    hessian, gradient = linear.hessian(ordering)
    expected = whole(system)[np.ix_(at, at)]
    np.testing.assert_allclose(
        hessian * np.outer(scale, scale), expected * np.outer(scale, scale), atol=1e-7
    )
    np.testing.assert_allclose(-gradient * scale, system.gradient[at] * scale, atol=1e-6)


def test_a_factor_of_one_track_is_over_what_sees_it() -> None:
    problem, _ = small_problem("radial", cameras=3)
    graph = build(problem, options_of(shared_lenses=((0, 1),)))
    factors = factor_graph(graph, 1)
    seen = problem.observations
    for place, point in enumerate(graph.tracks.order):
        own = seen.point == point
        cameras = set(seen.camera[own].tolist())
        keys = {frame_key(f) for f in seen.frame[own]}
        keys |= {rig_key(c) for c in cameras if c != 0}
        keys |= {lens_key(0 if c == 1 else c) for c in cameras}
        assert set(factors.at(place).keys()) == keys


# ---- GTSAM's optimisers and marginals ------------------------------------------------------


@pytest.mark.parametrize("how", ["lm", "dogleg"])
@pytest.mark.parametrize(("lens", "loss"), [
    ("radtan", "none"), ("kannala_brandt", "cauchy"), ("double_sphere", "huber"),
])  # fmt: skip
def test_gtsams_optimisers_find_our_optimum(lens: LensName, loss: LossName, how: str) -> None:
    problem, _ = small_problem(lens, frames=6, points=80, start_error=0.3, baseline=True)
    graph = build(problem, options_of(loss))
    _, values, summary = solve(graph, relative_tolerance=TIGHT)
    theirs = optimised(factor_graph(graph), graph.initial, how)
    assert factor_graph(graph).error(theirs) == pytest.approx(summary.cost, rel=1e-9)
    assert_same_rig(values, theirs, problem)


@pytest.mark.parametrize(("lens", "loss"), list(zip(LENS_NAMES, 3 * LOSS_NAMES, strict=False)))
def test_gtsams_marginals_are_ours(lens: LensName, loss: LossName) -> None:
    """Every sigma and every cross-covariance of lenses and rig, and those of two frames."""
    problem, _ = small_problem(lens, cameras=3, points=60, start_error=0, baseline=True)
    graph = build(problem, options_of(loss))
    estimate, values, _ = solve(graph)
    keys = [*map(lens_key, range(3)), *map(rig_key, (1, 2)), frame_key(1), frame_key(3)]
    inverse = dense_inverse(graph, values, estimate.points)
    at = columns_of(graph, keys)
    at_optimum = replace(problem, initial=replace(problem.initial, points=estimate.points))
    factors = factor_graph(replace(graph, problem=at_optimum))
    joint = gtsam.Marginals(factors, values).jointMarginalCovariance(keys)
    theirs = np.block([[joint.at(a, b) for b in keys] for a in keys])
    assert_same_covariance(theirs, inverse[np.ix_(at, at)], 1e-5)


def with_gross_outliers(problem: Problem, points: list[int]) -> Problem:
    seen, rng = problem.observations, np.random.default_rng(5)
    wrong = np.isin(seen.point, points)
    pixels = seen.pixels.copy()
    pixels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(30, 60, (wrong.sum(), 2))
    return replace(problem, observations=replace(seen, pixels=pixels))


@pytest.mark.xfail(
    raises=RuntimeError, reason="GTSAM 4.3's CustomFactor has no clone(), which GNC calls"
)
def test_gtsams_gnc_rejects_mismatched_tracks() -> None:
    problem, _ = small_problem("radial", frames=5, points=60, start_error=0.3, baseline=True)
    mismatched = [3, 17, 31, 32, 50]
    graph = build(with_gross_outliers(problem, mismatched), options_of())
    factors = factor_graph(graph, points_per_factor=1)
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setKnownInliers(list(range(len(problem.initial.points), factors.size())))
    optimizer = gtsam.GncLMOptimizer(factors, graph.initial, params)
    optimizer.setInlierCostThresholds(20.0)
    values = optimizer.optimize()
    weights = np.asarray(optimizer.getWeights())[: len(problem.initial.points)]
    assert set(graph.tracks.order[weights < 0.5]) == set(mismatched)
    good = ~np.isin(problem.observations.point, mismatched)
    only = replace(problem, observations=problem.observations.subset(good))
    _, ours, _ = solve(build(only, options_of()), relative_tolerance=TIGHT)
    np.testing.assert_allclose(rig_of(values, problem), rig_of(ours, problem), rtol=1e-4)


# ---- factors beside the tracks -------------------------------------------------------------


def chain_problem() -> tuple[Problem, Estimate]:
    """Frames so far apart that the first and the last share no point."""
    problem, true = small_problem("radial", frames=12, points=150, start_error=0.3, baseline=True)
    seen = problem.observations
    assert not set(seen.point[seen.frame == 0]) & set(seen.point[seen.frame == 11])
    return problem, true


def between_frames(a: int, b: int, of: Estimate, sigma: float) -> gtsam.NonlinearFactor:
    poses = [to_gtsam_inverse(of.rig_from_world[frame]) for frame in (a, b)]
    noise = gtsam.noiseModel.Isotropic.Sigma(6, sigma)
    return gtsam.BetweenFactorPose3(frame_key(a), frame_key(b), poses[0].between(poses[1]), noise)


def test_a_factor_between_frames_that_share_no_point(monkeypatch: pytest.MonkeyPatch) -> None:
    """A loop closed by odometry: the system has the entries, and the optimum is GTSAM's."""
    monkeypatch.setattr("graphs.elimination.FRONT_OVERHEAD_FLOP", 0.0)  # many small fronts
    problem, true = chain_problem()
    extra = gtsam.NonlinearFactorGraph()
    extra.add(between_frames(0, 11, true, 1e-4))
    graph, plain = build(problem, options_of(), extra), build(problem, options_of())
    estimate, values, _ = solve(graph, relative_tolerance=TIGHT)
    factors = factor_graph(plain)
    factors.push_back(extra)
    theirs = optimised(factors, graph.initial, "lm")
    assert factors.error(values) <= factors.error(theirs) * (1 + 1e-12)
    assert_same_rig(values, theirs, problem)
    with threads() as pool:
        start = homogeneous(graph.tracks, estimate.points)
        system = linearised(graph, evaluate(graph, values, start, pool), pool)
    cross = np.ix_(graph.layout.columns(frame_key(0)), graph.layout.columns(frame_key(11)))
    expected = of_others(graph, values)[cross]
    assert np.abs(expected).max() > 1e7
    np.testing.assert_allclose(whole(system)[cross], expected, rtol=1e-12)
    step = true.rig_from_world[0].inverse.translation - true.rig_from_world[11].inverse.translation
    ends = [estimate.rig_from_world[frame].inverse.translation for frame in (0, 11)]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(np.linalg.norm(step), rel=1e-4)


def test_a_prior_holds_a_lens() -> None:
    problem, true = small_problem("radtan", start_error=0.3)
    held = true.cameras[1].params + np.array([3.0, 3.0, -2.0, 1.0, 0.01, 0.01, 1e-3, 1e-3])
    extra = gtsam.NonlinearFactorGraph()
    tight = gtsam.noiseModel.Isotropic.Sigma(8, 1e-8)
    extra.add(gtsam.PriorFactorVector(lens_key(1), held, tight))
    estimate, _, summary = solve(build(problem, options_of(), extra))
    assert summary.converged
    np.testing.assert_allclose(estimate.cameras[1].params, held, atol=1e-6)
    assert np.abs(estimate.cameras[0].params[:2] - held[:2]).max() > 0.1


def test_lenses_tied_by_a_factor_are_one_shared_lens() -> None:
    problem, _ = small_problem("radial", cameras=3, frames=6, points=80, start_error=0.3)
    start = problem.initial
    same = tuple(replace(c, params=start.cameras[0].params) for c in start.cameras)
    problem = replace(problem, initial=replace(start, cameras=same))
    tie = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)
    tie.add(gtsam.BetweenFactorVector(lens_key(0), lens_key(2), np.zeros(6), noise))
    shared, _, _ = solve(
        build(problem, options_of(shared_lenses=((0, 2),))), relative_tolerance=TIGHT
    )
    tied, _, _ = solve(build(problem, options_of(), tie), relative_tolerance=TIGHT)
    np.testing.assert_array_equal(shared.cameras[0].params, shared.cameras[2].params)
    assert np.abs(shared.cameras[0].params[:4] - shared.cameras[1].params[:4]).max() > 0.1
    np.testing.assert_allclose(  # the tied lens's weak prior counts twice
        calibration_of(shared), calibration_of(tied), rtol=2e-3, atol=2e-3
    )


def test_one_shared_lens_is_one_variable() -> None:
    problem, _ = small_problem("radial", cameras=3)
    graph = build(problem, options_of(shared_lenses=((1, 2),)))
    assert graph.initial.exists(lens_key(1)) and not graph.initial.exists(lens_key(2))
    apart = build(problem, options_of())
    assert graph.layout.elimination.border == apart.layout.elimination.border - 6
    assert graph.others.size() == apart.others.size() - 1


@pytest.mark.parametrize("change", ["lens", "size"])
def test_unlike_cameras_cannot_share_a_lens(change: str) -> None:
    problem, _ = small_problem("radial")
    first, second = problem.initial.cameras
    longer = np.append(second.params, [0.0, 0.0])
    unlike = {
        "lens": replace(second, lens="radtan", params=longer),
        "size": replace(second, size=(800, 600)),
    }[change]
    problem = replace(problem, initial=replace(problem.initial, cameras=(first, unlike)))
    with pytest.raises(ValueError, match="cannot share one lens"):
        build(problem, options_of(shared_lenses=((0, 1),)))


def test_an_extra_variable_is_solved_with_the_rest() -> None:
    """A board seen by three frames, its pose in the world unknown."""
    problem, true = chain_problem()
    rng = np.random.default_rng(8)
    world_from_board = Transform.exp(rng.standard_normal(3), rng.standard_normal(3))
    board = to_gtsam_inverse(world_from_board.inverse)
    extra, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    for frame in (0, 5, 11):
        seen = to_gtsam_inverse(true.rig_from_world[frame]).between(board)
        measured = seen.retract(1e-3 * rng.standard_normal(6))
        extra.add(gtsam.BetweenFactorPose3(frame_key(frame), B(0), measured, noise))
    start.insert(B(0), board.retract(0.2 * rng.standard_normal(6)))
    graph = build(problem, options_of(), extra, start)
    estimate, values, summary = solve(graph, relative_tolerance=TIGHT)
    assert summary.converged
    factors = factor_graph(graph)
    theirs = optimised(factors, graph.initial, "lm")
    assert factors.error(values) <= factors.error(theirs) * (1 + 1e-12)
    np.testing.assert_allclose(
        values.atPose3(B(0)).matrix(), theirs.atPose3(B(0)).matrix(), atol=1e-6
    )
    found = from_gtsam_inverse(values.atPose3(B(0))).inverse
    assert np.linalg.norm(found.translation - world_from_board.translation) < 0.1
    keys = [B(0), lens_key(0), rig_key(1)]
    at = columns_of(graph, keys)
    inverse = dense_inverse(graph, values, estimate.points)[np.ix_(at, at)]
    joint = gtsam.Marginals(factors, values).jointMarginalCovariance(keys)
    assert_same_covariance(np.block([[joint.at(a, b) for b in keys] for a in keys]), inverse, 1e-5)


def test_a_robust_factor_beside_the_tracks_keeps_its_loss() -> None:
    """One of two odometry factors is a mile off; Cauchy's loss lets it go."""
    problem, true = chain_problem()
    extra = gtsam.NonlinearFactorGraph()
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-2)
    )
    off = to_gtsam_inverse(true.rig_from_world[4]).retract(np.full(6, 0.7))
    extra.add(gtsam.PriorFactorPose3(frame_key(4), off, robust))
    plain, _, without = solve(build(problem, options_of()), relative_tolerance=TIGHT)
    estimate, _, summary = solve(build(problem, options_of(), extra), relative_tolerance=TIGHT)
    assert summary.converged
    assert without.cost < summary.cost < without.cost + 6
    np.testing.assert_allclose(
        calibration_of(estimate), calibration_of(plain), rtol=2e-3, atol=2e-3
    )


# ---- the square root -----------------------------------------------------------------------


@st.composite
def quadratics(draw: st.DrawFn) -> tuple[FloatArray, FloatArray, float]:
    """H (n, n) of any rank, g in its range, and a cost no less than the least."""
    n = draw(st.integers(1, 24))
    rank = draw(st.integers(0, n))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    unit = 10 ** rng.uniform(-9, 9, n)
    unit *= rng.random(n) < 0.9  # some columns that nothing depends on
    J, r = rng.standard_normal((rank, n)) * unit, rng.standard_normal(rank)
    return J.T @ J, J.T @ r, 0.5 * float(r @ r) + draw(st.sampled_from([0.0, 3.0]))


@settings(deadline=None, max_examples=100)
@given(quadratics())
def test_the_square_root_squared_is_the_quadratic(
    quadratic: tuple[FloatArray, FloatArray, float],
) -> None:
    """In columns scaled to a unit diagonal, from 1e-9 to 1e9, whatever the rank."""
    H, g, cost = quadratic
    n = len(g)
    A, e = square_root(np.triu(H), g, cost)
    assert A.shape == (n + 1, n) and e.shape == (n + 1,)
    diagonal = np.diag(H)
    scale = np.divide(1, np.sqrt(diagonal), out=np.zeros(n), where=diagonal > 0)
    A_scaled, g_scaled = A * scale, g * scale
    np.testing.assert_allclose(A_scaled.T @ A_scaled, H * np.outer(scale, scale), atol=1e-10)
    np.testing.assert_allclose(A_scaled.T @ e, g_scaled, atol=1e-5)
    assert e @ e == pytest.approx(2 * cost, rel=1e-6, abs=1e-9)
    assert not A[:, diagonal == 0].any()


def test_a_distortion_coefficient_beside_a_focal_length_keeps_its_information() -> None:
    """Diagonals 1e20 apart: unscaled, the smaller would fall below the rank's tolerance."""
    unit = np.array([1e-8, 1e2, 3e-8, 1e1])
    J = np.random.default_rng(0).standard_normal((3, 4)) * unit
    H, r = J.T @ J, np.array([1.0, -2.0, 0.5])
    A, e = square_root(np.triu(H), J.T @ r, 0.5 * r @ r)
    assert np.linalg.matrix_rank(A / unit, tol=1e-6) == 3
    np.testing.assert_allclose((A / unit).T @ (A / unit), H / np.outer(unit, unit), atol=1e-12)
    np.testing.assert_allclose((A / unit).T @ e, (J.T @ r) / unit, rtol=1e-6)

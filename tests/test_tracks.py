"""The track factor's cost, gradient and Hessian, by finite differences through the whole factor."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from synthetic.dense import linearise_dense, moved, of_others, track_columns, whole
from synthetic.problems import projected, small_problem, with_noise, with_tracks

from graphs import clusters
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import project
from graphs.clusters import euclidean, homogeneous
from graphs.frames import FloatArray
from graphs.lenses import LENS_NAMES, LensName
from graphs.losses import INVALID_SIGMAS, LEAST_CURVATURE, LOSS_NAMES, SCALE_95, LossName
from graphs.problem import Estimate, Observations, Problem, residuals_px
from graphs.rows import bearing_basis
from graphs.solve import State, evaluate, linearised

SIGMA_PX = 0.5
POOL = ThreadPoolExecutor(2)


@dataclass(frozen=True)
class Case:
    """A graph at its start, every point where it costs least."""

    graph: CalibrationGraph
    state: State

    @property
    def points(self) -> FloatArray:
        start = self.graph.problem.initial.points
        return euclidean(self.graph.tracks, self.state.points, start)


def options_of(loss: LossName, **changes: object) -> GraphOptions:
    return replace(GraphOptions(SIGMA_PX, loss, min(SCALE_95[loss], 1e6)), **changes)  # type: ignore[arg-type]


def case_of(problem: Problem, options: GraphOptions) -> Case:
    graph = build(problem, options)
    start = homogeneous(graph.tracks, problem.initial.points)
    return Case(graph, settled(graph, graph.initial, start))


def settled(graph: CalibrationGraph, values: gtsam.Values, points: FloatArray) -> State:
    """Triangulated until the cost is the same to the last bit: a point may need many steps."""
    state = evaluate(graph, values, points, POOL)
    for _ in range(50):
        before, state = state, evaluate(graph, values, state.points, POOL)
        if state.cost == before.cost:
            return state
    raise AssertionError("the points do not come to rest")


def cost_at(case: Case, change: FloatArray) -> float:
    values = moved(case.graph, case.state.values, change)
    return settled(case.graph, values, case.state.points).cost


def assert_gradient_is_right(case: Case, directions: int | None = None) -> None:
    """By central differences along each column of the tracks, or along so many random directions.

    In units of what a sigma of the variable alone would change: all are of one size.
    """
    system = linearised(case.graph, case.state, POOL)
    scale = 1 / np.sqrt(system.diagonal)
    columns = track_columns(case.graph)
    along = np.eye(len(scale))[columns]
    if directions is not None:
        mixed = np.random.default_rng(0).standard_normal((directions, len(columns)))
        along = mixed / np.linalg.norm(mixed, axis=1, keepdims=True) @ along
    expected = []
    for direction in along * scale:
        ends = (cost_at(case, step) for step in (1e-4 * direction, -1e-4 * direction))
        expected.append((next(ends) - next(ends)) / 2e-4)
    ours = along @ (system.gradient * scale)
    assert np.abs(ours).max() > 0.5  # a start that is off
    np.testing.assert_allclose(ours, expected, atol=3e-5, rtol=1e-5)


def assert_same(ours: FloatArray, expected: FloatArray, tolerance: float) -> None:
    """Matrices, scaled to a unit diagonal."""
    scale = 1 / np.sqrt(np.diag(expected))
    np.testing.assert_allclose(ours * np.outer(scale, scale), expected * np.outer(scale, scale),
                               rtol=0, atol=tolerance)  # fmt: skip


# ---- the loss, written once more -----------------------------------------------------------


def rho(loss: LossName, k: float, r: FloatArray) -> FloatArray:
    """Cost of whitened residuals (..., 2), as GTSAM's documentation has it."""
    s = (r**2).sum(-1)
    if loss == "huber":
        return np.where(s <= k * k, s / 2, k * (np.sqrt(s) - k / 2))
    if loss == "cauchy":
        return k * k / 2 * np.log1p(s / k**2)
    if loss == "tukey":
        return k * k / 6 * (1 - np.maximum(1 - s / k**2, 0) ** 3)
    return s / 2 if loss == "none" else k * k * s / (2 * (k * k + s))


def slope_and_curvature(loss: LossName, k: float, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The weight (n,) and the Hessian (n, 2, 2) of rho at r (n, 2), by central differences."""
    h = 1e-4
    x, y = h * np.eye(2)

    def cost(step: FloatArray) -> FloatArray:
        return rho(loss, k, r + step)

    gradient = np.stack([(cost(d) - cost(-d)) / (2 * h) for d in (x, y)], -1)
    xx, yy = ((cost(d) - 2 * cost(0 * d) + cost(-d)) / h**2 for d in (x, y))
    xy = (cost(x + y) + cost(-x - y) - cost(x - y) - cost(y - x)) / (4 * h**2)
    hessian = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    return (gradient * r).sum(-1) / (r**2).sum(-1), hessian


# ---- the gradient --------------------------------------------------------------------------


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_the_gradient_is_the_slope_of_the_cost(lens: LensName) -> None:
    """Along every frame, cam_from_rig and lens, the points following."""
    problem, _ = small_problem(lens, frames=3, points=20, start_error=0.7)
    loss = LOSS_NAMES[LENS_NAMES.index(lens) % len(LOSS_NAMES)]
    assert_gradient_is_right(case_of(problem, options_of(loss)))


@pytest.mark.parametrize("loss", LOSS_NAMES)
@pytest.mark.parametrize("lens", LENS_NAMES)
def test_so_it_is_for_every_lens_with_every_loss(lens: LensName, loss: LossName) -> None:
    """Along six random directions of everything."""
    problem, _ = small_problem(lens, frames=3, points=20, start_error=0.3)
    assert_gradient_is_right(case_of(problem, options_of(loss)), directions=6)


@pytest.mark.parametrize("reference", [0, 2])
def test_so_it_is_with_three_cameras_whichever_is_the_reference(reference: int) -> None:
    problem, _ = small_problem("radtan", cameras=3, points=20, reference=reference, baseline=True)
    assert_gradient_is_right(case_of(problem, options_of("cauchy")))


def test_so_it_is_where_cameras_share_a_lens_and_observations_differ() -> None:
    problem, _ = small_problem("radtan", cameras=3, points=20)
    seen = with_noise(problem.observations)
    options = options_of("cauchy", shared_lenses=((0, 2),))
    assert_gradient_is_right(case_of(replace(problem, observations=seen), options))


def with_points_beyond_infinity(problem: Problem, count: int = 40) -> Problem:
    """Tracks that go along with the camera, as only something behind infinity would seem to."""
    start, frames = problem.initial, len(problem.frame_names)
    forward = start.rig_from_world[0].rotation.T @ [0.0, 0.0, 1.0]
    frame = np.tile(np.arange(frames), count)
    point = np.repeat(np.arange(count), frames)
    centre = start.rig_from_world[0].inverse.translation
    points = centre + forward * np.geomspace(1e2, 1e9, count)[:, None]
    rays = np.array([start.rig_from_world[f].rotation @ forward for f in frame])
    pixels = project(start.cameras[0], rays)
    pixels[:, 0] += 2.0 * frame
    pixels += np.random.default_rng(2).uniform(-100, 100, (count, 2))[point]
    return with_tracks(problem, points, Observations(pixels, frame, 0 * frame, point))


@pytest.mark.parametrize("nudge", [False, True])
@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_so_it_is_where_points_are_as_far_as_they_may_be(loss: LossName, nudge: bool) -> None:
    """They are held at their farthest distance; also those that rounding puts just before it."""
    problem, _ = small_problem("radial", points=20, start_error=0.3)
    case = case_of(with_points_beyond_infinity(problem), options_of(loss))
    limit = case.graph.tracks.smallest_w
    if nudge:
        points = case.state.points.copy()
        points[:, 3] = np.where(points[:, 3] <= limit, np.nextafter(limit, 1), points[:, 3])
        case = replace(case, state=settled(case.graph, case.state.values, points))
    assert (case.state.points[:, 3] <= limit * (1 + 1e-6)).sum() >= 20
    assert np.isfinite(case.points).all()
    assert_gradient_is_right(case)


def with_a_refused_view(problem: Problem, refused: bool) -> Problem:
    """A point right before frame 2, far beyond the edge of the lens of frame 0, which claims it."""
    start = problem.initial
    place = start.rig_from_world[2].inverse @ np.array([[0.02, 0.01, 0.3]])
    frame, camera = np.array([2, 2, 0]), np.array([0, 1, 0])
    pixels = np.array([[330.0, 230.0]] * 3)
    for i in (0, 1):
        in_rig = start.rig_from_world[2] @ place
        pixels[i] = 1 + project(start.cameras[i], start.cam_from_rig[i] @ in_rig)[0]
    added = Observations(pixels, frame, camera, np.zeros(3, int))
    return with_tracks(problem, place, added if refused else added.subset(frame == 2))


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_what_cannot_be_projected_costs_much_and_says_nothing(loss: LossName) -> None:
    problem, _ = small_problem("simple_radial", points=20, start_error=0.7)
    spoilt, plain = (
        case_of(with_a_refused_view(problem, refused), options_of(loss))
        for refused in (True, False)
    )
    at_start = spoilt.graph.problem
    refused = np.isnan(residuals_px(at_start.initial, at_start.observations)).any(axis=1)
    assert refused.sum() == 1
    price = rho(loss, options_of(loss).loss_scale, np.array([INVALID_SIGMAS, 0.0]))
    assert spoilt.state.cost == pytest.approx(plain.state.cost + float(price), rel=1e-12)
    ours, theirs = (linearised(case.graph, case.state, POOL) for case in (spoilt, plain))
    assert_same(whole(ours), whole(theirs), 1e-7)
    unit = 1 / np.sqrt(theirs.diagonal)
    np.testing.assert_allclose(unit * ours.gradient, unit * theirs.gradient, atol=1e-6)


# ---- the points ----------------------------------------------------------------------------


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_points_are_where_they_cost_least(loss: LossName) -> None:
    """From a start a third of a metre off: no worse than the truth, and nothing near is better."""
    problem, true = small_problem("radtan", start_error=0)
    rng = np.random.default_rng(1)
    start = replace(true, points=true.points + 0.2 * rng.standard_normal(true.points.shape))
    case = case_of(replace(problem, initial=start), options_of(loss))
    seen, k = problem.observations, case.graph.options.loss_scale

    def costs(points: FloatArray) -> FloatArray:
        """Of each point (n_points,)."""
        whitened = residuals_px(replace(true, points=points), seen) / SIGMA_PX
        return np.bincount(seen.point, rho(loss, k, whitened))

    least = costs(case.points)
    priors = case.graph.others.error(case.state.values)
    assert case.state.cost == pytest.approx(least.sum() + priors, rel=1e-12)
    if loss in ("none", "huber"):  # the others may have several minima
        assert (least <= costs(true.points)).all()
    for size in (1e-4, 1e-3):
        for _ in range(20):
            near = case.points + size * rng.standard_normal(case.points.shape)
            assert (least < costs(near) + 1e-10).all()


# ---- the Hessian ---------------------------------------------------------------------------


def assert_hessian_is_right(case: Case, newton: bool) -> None:
    """Against J^T C J with every point in it, which are then eliminated by a dense Schur
    complement. C: the loss's weight or, for Newton, its curvature."""
    graph, options = case.graph, case.graph.options
    dense = linearise_dense(graph, case.state.values, case.points)
    weight, curvature = slope_and_curvature(options.loss, options.loss_scale, dense.residuals)
    used = with_least_curvature(curvature, weight) if newton else weight[:, None, None] * np.eye(2)
    H, g = dense.normal_equations(weight, used)
    system = linearised(graph, case.state, POOL, newton)
    assert_same(whole(system), H + of_others(graph, case.state.values), 1e-5)
    scale = 1 / np.sqrt(system.diagonal)
    columns = track_columns(graph)
    of_priors = graph.others.linearize(case.state.values)
    expected = g.copy()
    for key, slope in (
        (k, of_priors.gradientAtZero().at(k)) for k in sorted(set(of_priors.keys()))
    ):
        expected[graph.layout.columns(key)] += slope
    np.testing.assert_allclose(
        (system.gradient * scale)[columns], (expected * scale)[columns], atol=1e-5, rtol=2e-6
    )


def with_least_curvature(curvature: FloatArray, weight: FloatArray) -> FloatArray:
    """Curvatures (n, 2, 2) with no eigenvalue below so much of the weight (n,)."""
    values, vectors = np.linalg.eigh(curvature)
    values = np.maximum(values, LEAST_CURVATURE * weight[:, None])
    return np.einsum("nij,nj,nkj->nik", vectors, values, vectors)


@pytest.mark.parametrize("newton", [False, True])
@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_the_hessian_is_that_of_explicit_points(loss: LossName, newton: bool) -> None:
    problem, _ = small_problem("radtan", cameras=3, baseline=True)
    assert_hessian_is_right(case_of(problem, options_of(loss)), newton)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_the_hessian_is_right_for_every_lens(lens: LensName) -> None:
    problem, _ = small_problem(lens, start_error=0.7)
    assert_hessian_is_right(case_of(problem, options_of("cauchy")), newton=True)


def test_the_hessian_is_right_where_cameras_share_a_lens_and_observations_differ() -> None:
    problem, _ = small_problem("radtan", cameras=3, reference=1)
    seen = with_noise(problem.observations)
    options = options_of("cauchy", shared_lenses=((0, 2),))
    assert_hessian_is_right(case_of(replace(problem, observations=seen), options), newton=False)


@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_newtons_hessian_is_the_curvature_of_the_cost(loss: LossName) -> None:
    """Of the whole factor, by finite differences of its gradient, at residuals so small that the
    lens's own curvature does not matter, and yet robust: the loss's scale is as small."""
    problem, _ = small_problem("radial", frames=3, points=20, sigma_px=1e-3, start_error=0)
    case = case_of(problem, GraphOptions(1e-3, loss, 4.0))  # convex up to 4 sigma
    graph = case.graph
    H = whole(linearised(graph, case.state, POOL, newton=True))
    unit = 1 / np.sqrt(np.diag(H))
    columns = track_columns(graph)
    curvature = np.zeros_like(H)
    for column in columns:
        ends = []
        for sign in (1, -1):
            step = sign * 1e-3 * unit[column] * (np.arange(len(H)) == column)
            at = settled(graph, moved(graph, case.state.values, step), case.state.points)
            ends.append(linearised(graph, at, POOL).gradient)
        curvature[:, column] = (ends[0] - ends[1]) / (2e-3 * unit[column])
    some = np.ix_(columns, columns)
    ours, expected = (m[some] * np.outer(unit, unit)[some] for m in (H, curvature))
    np.testing.assert_allclose(ours, expected, atol=2e-3)
    plain = whole(linearised(graph, case.state, POOL))[some] * np.outer(unit, unit)[some]
    assert (np.abs(plain - expected).max() > 0.05) == (loss != "none")


@pytest.mark.parametrize("distance", [10.0, 100.0])
def test_the_hessian_is_right_where_points_are_far(distance: float) -> None:
    """So far that depth is known 1e4 and 1e8 times less well than direction: nothing is lost."""
    problem, true = small_problem("radtan", cameras=3, start_error=0, sigma_px=0.1)
    centre = true.rig_from_world[1].inverse.translation
    away = replace(true, points=centre + distance * (true.points - centre))
    assert_hessian_is_right(case_of(seen_as(problem, away), options_of("cauchy")), newton=False)


def seen_as(problem: Problem, estimate: Estimate) -> Problem:
    """The same observations of another scene, 0.1 px off, started there."""
    seen = replace(problem.observations, pixels=projected(estimate, problem.observations) + 0.1)
    assert np.isfinite(seen.pixels).all()
    return replace(problem, observations=seen, initial=estimate)


@pytest.mark.parametrize("towards", [1.0, -1.0, -1 + 1e-9])
def test_a_bearing_moves_along_two_directions_across_it(towards: float) -> None:
    """Also straight along z, where a basis must change its sign."""
    across = np.sqrt(1 - towards**2)
    for angle in np.linspace(0, 6, 7):
        d = np.array([across * np.cos(angle), across * np.sin(angle), towards])
        basis = np.empty((2, 3))
        bearing_basis(d, basis)
        axes = np.vstack([basis, d])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


# ---- how the work is cut -------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_the_cut_into_chunks_and_clusters_does_not_matter(
    loss: LossName, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = small_problem("radtan", cameras=3, frames=8, points=60)
    uncut = case_of(problem, options_of(loss))
    monkeypatch.setattr(clusters, "CHUNK", 16)
    monkeypatch.setattr(clusters, "PART_OBSERVATIONS", 100)
    cut = case_of(problem, options_of(loss))
    assert len(cut.graph.tracks.clusters) > len(uncut.graph.tracks.clusters)
    assert cut.state.cost == pytest.approx(uncut.state.cost, rel=1e-12)
    ours, theirs = (linearised(case.graph, case.state, POOL) for case in (cut, uncut))
    assert_same(whole(ours), whole(theirs), 1e-11)
    np.testing.assert_allclose(cut.points, uncut.points, rtol=1e-9)


def test_the_order_of_the_observations_does_not_matter() -> None:
    problem, _ = small_problem("radtan", cameras=3)
    seen = problem.observations
    order = np.random.default_rng(3).permutation(len(seen))
    shuffled = Observations(*(
        getattr(seen, name)[order] for name in ("pixels", "frame", "camera", "point")
    ))  # fmt: skip
    ours = case_of(problem, options_of("cauchy"))
    theirs = case_of(replace(problem, observations=shuffled), options_of("cauchy"))
    assert ours.state.cost == pytest.approx(theirs.state.cost, rel=1e-13)
    np.testing.assert_allclose(ours.points, theirs.points, rtol=1e-12)


def test_a_pool_of_any_size_gives_the_same_to_the_last_bit() -> None:
    problem, _ = small_problem("radtan", cameras=3, frames=8, points=60)
    case = case_of(problem, options_of("cauchy"))
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(7) as seven:
        systems = [linearised(case.graph, case.state, pool) for pool in (one, POOL, seven)]
        for system in systems[1:]:
            np.testing.assert_array_equal(whole(system), whole(systems[0]))
            np.testing.assert_array_equal(system.gradient, systems[0].gradient)

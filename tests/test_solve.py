"""The solver on whole problems: what spoils others, long scans, loops, bad starts, and reasons."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
import scipy.linalg
from synthetic.dense import whole
from synthetic.problems import calibration_of, small_problem, with_tracks

from graphs import solve as solve_module
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import Camera, project
from graphs.clusters import homogeneous
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from graphs.losses import SCALE_95, LossName
from graphs.problem import Estimate, IntArray, Observations, Problem, points_in_cameras
from graphs.refine import refine
from graphs.solve import SolveSummary, evaluate, linearised, solve
from graphs.stated_covariance import calibration_covariance
from graphs.threads import threads
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5


def options_of(loss: LossName = "cauchy") -> GraphOptions:
    return GraphOptions(SIGMA_PX, loss, min(SCALE_95[loss], 1e6))


def lens_sigmas(graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values) -> FloatArray:
    """Model sigmas of all lens parameters, camera by camera."""
    model = calibration_covariance(graph, estimate, values).model
    return np.array([s for name, s in model.sigma.items() if name.split(".")[1][0] in "fckp"])


def lenses_of(estimate: Estimate) -> FloatArray:
    return np.concatenate([camera.params for camera in estimate.cameras])


# ---- tracks that tell nothing, or next to nothing ------------------------------------------


def seen_from(
    true: Estimate, points: FloatArray, rows: IntArray, rng: np.random.Generator
) -> Observations:
    """Noisy observations of points (n, 3) by rows (frame, camera, point) that see them."""
    seen = Observations(np.zeros((len(rows), 2)), *np.ascontiguousarray(rows.T))
    ahead, pixels = points_in_cameras(replace(true, points=points), seen), seen.pixels
    for index, camera in enumerate(true.cameras):
        pixels[seen.camera == index] = project(camera, ahead[seen.camera == index])
    pixels += SIGMA_PX * rng.standard_normal(pixels.shape)
    return seen.subset(np.isfinite(pixels).all(axis=1))


def ahead_of(placed: Transform, distances: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) in the world at these distances ahead of a frame."""
    rays = rng.uniform(-0.25, 0.25, (len(distances), 3))
    rays[:, 2] = 1.0
    return placed.inverse @ (rays * distances[:, None])


def far_points(problem: Problem, true: Estimate, rng: np.random.Generator) -> Problem:
    """Seen by two cameras of four frames from 1e3 to 1e9 times the baseline."""
    points = ahead_of(true.rig_from_world[2], 0.25 * np.geomspace(1e3, 1e9, 20), rng)
    every = np.array([(f, c, j) for j in range(20) for f in (1, 2, 3, 4) for c in (0, 1)])
    return with_tracks(problem, points, seen_from(true, points, every, rng))


def seen_from_one_place(
    problem: Problem, true: Estimate, rng: np.random.Generator, camera: int, times: int
) -> Problem:
    """So many times by one image."""
    points = ahead_of(true.rig_from_world[3], rng.uniform(2, 8, 40), rng)
    rows = np.array([(3, camera, j) for j in range(40) for _ in range(times)])
    return with_tracks(problem, points, seen_from(true, points, rows, rng))


def into_a_camera(problem: Problem, true: Estimate, rng: np.random.Generator) -> Problem:
    """Mismatched tracks: three images see where another camera stands, which sees something."""
    rows, pixels, points = [], [], []
    for j, frame in enumerate(rng.permutation([3, 4, 5])):
        place = true.rig_from_world[frame].inverse
        points.append(place @ np.array([0.0, 0.0, 0.3]))
        rows.append((frame, 0, j))
        pixels.append(rng.uniform(200, 400, 2))
        for other in range(frame - 3, frame):
            ahead = true.rig_from_world[other] @ place.translation
            rows.append((other, 0, j))
            pixels.append(project(true.cameras[0], ahead) + SIGMA_PX * rng.standard_normal(2))
    seen = Observations(np.array(pixels), *np.ascontiguousarray(np.array(rows).T))
    return with_tracks(problem, np.array(points), seen.subset(np.isfinite(seen.pixels).all(axis=1)))


Add = Callable[[Problem, Estimate, np.random.Generator], Problem]


def both(
    add: Add, lens: LensName, loss: LossName, seed: int
) -> tuple[FloatArray, FloatArray, SolveSummary, Estimate, Problem]:
    """Change of all lens parameters by the added tracks, their sigmas without, and the solve."""
    problem, true = small_problem(
        lens, frames=6, points=100, start_error=0.3, baseline=True, seed=seed
    )
    plain = build(problem, options_of(loss))
    before, values, summary = solve(plain)
    assert summary.converged
    spoilt = add(problem, true, np.random.default_rng(seed))
    after, _, summary = solve(build(spoilt, options_of(loss)))
    change = lenses_of(after) - lenses_of(before)
    return change, lens_sigmas(plain, before, values), summary, after, spoilt


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy", "geman_mcclure"])
@pytest.mark.parametrize("seed", [0, 1])
def test_far_points_do_no_harm(loss: LossName, seed: int) -> None:
    """They tell the rotations, and little of the lens; they stay finite and ahead."""
    change, sigma, summary, estimate, problem = both(far_points, "radtan", loss, seed)
    assert summary.converged
    assert np.isfinite(estimate.points).all()
    assert (points_in_cameras(estimate, problem.observations)[:, 2] > 0).all()
    assert np.abs(change / sigma).max() < 2.5


@pytest.mark.parametrize("loss", ["none", "cauchy"])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("camera", "times"), [(0, 1), (1, 1), (0, 2), (1, 2)])
def test_points_without_parallax_do_nothing(
    camera: int, times: int, seed: int, loss: LossName
) -> None:
    add = partial(seen_from_one_place, camera=camera, times=times)
    change, sigma, summary, estimate, problem = both(add, "radtan", loss, seed)
    assert summary.converged
    assert np.isfinite(estimate.points).all()
    assert (points_in_cameras(estimate, problem.observations)[:, 2] > 0).all()
    assert np.abs(change / sigma).max() < 1e-2


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
@pytest.mark.parametrize("lens", ["radial", "kannala_brandt"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_tracks_that_end_in_a_camera_do_no_harm(lens: LensName, loss: LossName, seed: int) -> None:
    """The rounds set them aside: a point right before a camera would explain them perfectly."""
    problem, true = small_problem(
        lens, frames=6, points=100, start_error=0.3, baseline=True, seed=seed
    )
    plain = refine(problem, options_of(loss), 0.1)
    spoilt = refine(
        into_a_camera(problem, true, np.random.default_rng(seed)), options_of(loss), 0.1
    )
    assert spoilt.summary.converged
    assert np.isfinite(spoilt.estimate.points).all()
    change = lenses_of(spoilt.estimate) - lenses_of(plain.estimate)
    sigma = lens_sigmas(plain.graph, plain.estimate, plain.values)
    assert np.abs(change / sigma).max() < 2.5


def test_a_point_that_nothing_sees_stays_where_it_is() -> None:
    problem, _ = small_problem("radial")
    seen = problem.observations
    unseen = replace(problem, observations=seen.subset((seen.point != 7) & (seen.point != 29)))
    estimate, _, summary = solve(build(unseen, options_of()))
    assert summary.converged
    assert estimate.points.shape == problem.initial.points.shape
    np.testing.assert_array_equal(estimate.points[[7, 29]], problem.initial.points[[7, 29]])


def test_an_observation_without_a_pixel_says_nothing() -> None:
    problem, _ = small_problem("radial", start_error=0.3)
    seen, pixels = problem.observations, problem.observations.pixels.copy()
    pixels[[3, 50]] = np.nan
    missing = replace(problem, observations=replace(seen, pixels=pixels))
    known = replace(problem, observations=seen.subset(np.isfinite(pixels).all(axis=1)))
    ours, _, summary = solve(build(missing, options_of()), relative_tolerance=1e-12)
    theirs, _, without = solve(build(known, options_of()), relative_tolerance=1e-12)
    assert summary.converged
    np.testing.assert_allclose(calibration_of(ours), calibration_of(theirs), rtol=1e-6, atol=1e-7)
    price = gtsam.noiseModel.mEstimator.Cauchy.Create(SCALE_95["cauchy"]).loss(1e4)
    assert summary.cost == pytest.approx(without.cost + 2 * price, rel=1e-9)


# ---- the same every time -------------------------------------------------------------------


def assert_identical(a: Estimate, b: Estimate) -> None:
    np.testing.assert_array_equal(calibration_of(a), calibration_of(b))
    np.testing.assert_array_equal(a.points, b.points)
    for ours, theirs in zip(a.rig_from_world, b.rig_from_world, strict=True):
        np.testing.assert_array_equal(ours.rotation, theirs.rotation)
        np.testing.assert_array_equal(ours.translation, theirs.translation)


@pytest.mark.parametrize("size", [1, 5])
def test_the_number_of_threads_does_not_matter(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """To the last bit, also when tracks are cut into many clusters."""
    monkeypatch.setattr("graphs.clusters.PART_OBSERVATIONS", 200)
    problem, _ = small_problem("radtan", cameras=3, frames=8, points=80)
    graph = build(problem, options_of())
    assert len(graph.tracks.clusters) > 3
    first, _, summary = solve(graph)
    monkeypatch.setattr(solve_module, "threads", lambda: ThreadPoolExecutor(size))
    again, _, other = solve(graph)
    assert summary == other
    assert_identical(first, again)


def test_two_graphs_of_one_problem_give_the_same_to_the_last_bit() -> None:
    problem, _ = small_problem("double_sphere", cameras=3)
    runs = [solve(build(problem, options_of())) for _ in range(2)]
    assert runs[0][2] == runs[1][2]
    assert_identical(runs[0][0], runs[1][0])


def test_the_names_of_frames_and_points_do_not_matter() -> None:
    """Frames and points numbered another way: the same optimum."""
    problem, _ = small_problem("radtan", frames=8, points=60, start_error=0.3, baseline=True)
    rng, seen, start = np.random.default_rng(4), problem.observations, problem.initial
    frames, points = rng.permutation(8), rng.permutation(60)
    renamed = replace(
        problem,
        observations=replace(
            seen, frame=np.argsort(frames)[seen.frame], point=np.argsort(points)[seen.point]
        ),
        initial=replace(
            start,
            rig_from_world=tuple(start.rig_from_world[f] for f in frames),
            points=start.points[points],
        ),
    )  # fmt: skip
    ours, _, summary = solve(build(problem, options_of()), relative_tolerance=1e-12)
    theirs, _, other = solve(build(renamed, options_of()), relative_tolerance=1e-12)
    assert summary.cost == pytest.approx(other.cost, rel=1e-9)
    np.testing.assert_allclose(calibration_of(ours), calibration_of(theirs), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(ours.points[points], theirs.points, atol=1e-4)


@pytest.mark.parametrize("shift_m", [1e3, 6e6])
def test_the_worlds_origin_does_not_matter(shift_m: float) -> None:
    """Six thousand kilometres away, as in earth-centred coordinates."""
    problem, _ = small_problem("radtan", start_error=0.3, baseline=True)
    start, shift = problem.initial, shift_m * np.array([1.0, -0.6, 0.3])
    away = Transform(np.eye(3), -shift)
    frames = tuple(t @ away for t in start.rig_from_world)
    moved = replace(start, rig_from_world=frames, points=start.points + shift)
    ours, _, summary = solve(build(replace(problem, initial=moved), options_of()))
    theirs, _, other = solve(build(problem, options_of()))
    assert summary.converged
    assert summary.cost == pytest.approx(other.cost, rel=1e-6)
    np.testing.assert_allclose(calibration_of(ours), calibration_of(theirs), rtol=1e-3, atol=1e-4)


# ---- long scans and loops ------------------------------------------------------------------


def assert_step_is_dense(graph: CalibrationGraph, values: gtsam.Values, points: FloatArray) -> None:
    """The step from here as by LAPACK on the whole matrix."""
    with threads() as pool:
        start = homogeneous(graph.tracks, points)
        system = linearised(graph, evaluate(graph, values, start, pool), pool)
    H, damping = whole(system), 1e-3
    scale = 1 / np.sqrt(np.diag(H))
    scaled = H * np.outer(scale, scale) + damping * np.eye(len(H))
    expected = scipy.linalg.solve(scaled, -system.gradient * scale, assume_a="pos")
    ours = system.factorise(damping).solve(-system.gradient) / scale
    np.testing.assert_allclose(ours, expected, atol=1e-8 * np.abs(expected).max())


def test_a_long_scan_is_sparse_and_solved_as_if_it_were_not() -> None:
    problem, true = small_problem("radial", frames=300, points=900, start_error=0.1, baseline=True)
    graph = build(problem, options_of())
    fronts = graph.layout.elimination.fronts
    assert max(len(front.frames) for front in fronts) < 150
    assert_step_is_dense(graph, graph.initial, problem.initial.points)
    estimate, values, summary = solve(graph, relative_tolerance=1e-6)
    assert summary.converged
    wrong = lenses_of(estimate) - lenses_of(true)
    assert np.abs(wrong / lens_sigmas(graph, estimate, values)).max() < 4


def test_a_loop_that_closes() -> None:
    """Once round the room and on: the last frames see what the first did."""
    options = TrackOptions(
        rig="mono", trajectory="orbit", frames=42, points=1200, max_points_per_image=60,
        max_track_frames=42, focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01,
        point_error_m=0.02,
    )  # fmt: skip
    problem, true = simulate_tracks(options, np.random.default_rng(0))
    seen = problem.observations
    ends = [set(seen.point[np.isin(seen.frame, some)]) for some in ((0, 1, 2), (36, 37, 38))]
    assert len(ends[0] & ends[1]) > 20
    graph = build(problem, options_of())
    assert_step_is_dense(graph, graph.initial, problem.initial.points)
    estimate, values, summary = solve(graph)
    assert summary.converged
    wrong = lenses_of(estimate) - lenses_of(true)
    assert np.abs(wrong / lens_sigmas(graph, estimate, values)).max() < 4


def with_focal_error(problem: Problem, share: float) -> Problem:
    def off(camera: Camera) -> Camera:
        params = camera.params.copy()
        params[:2] *= 1 + share
        return replace(camera, params=params)

    cameras = tuple(map(off, problem.initial.cameras))
    return replace(problem, initial=replace(problem.initial, cameras=cameras))


@pytest.mark.parametrize("share", [-0.3, 0.3])
@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
def test_a_focal_length_that_starts_30_per_cent_off(loss: LossName, share: float) -> None:
    problem, true = small_problem("radial", frames=8, points=150, start_error=1, baseline=True)
    graph = build(with_focal_error(problem, share), options_of(loss))
    estimate, values, summary = solve(graph)
    assert summary.converged
    wrong = lenses_of(estimate) - lenses_of(true)
    assert np.abs(wrong / lens_sigmas(graph, estimate, values)).max() < 4


# ---- how it ends ---------------------------------------------------------------------------


def test_every_iteration_is_reported_and_none_raises_the_cost() -> None:
    problem, _ = small_problem("radtan")
    seen: list[tuple[int, float]] = []
    graph = build(problem, options_of())
    _, _, summary = solve(graph, on_iteration=lambda *pair: seen.append(pair))
    assert [i for i, _ in seen] == list(range(1, summary.iterations + 1))
    costs = [summary.initial_cost, *(cost for _, cost in seen)]
    assert (np.diff(costs) <= 0).all() and costs[-1] == summary.cost
    assert summary.converged and summary.reason == "converged"


@pytest.mark.parametrize("most", [1, 2])
def test_running_out_of_iterations_is_said(most: int) -> None:
    problem, _ = small_problem("radtan")
    _, _, summary = solve(build(problem, options_of()), max_iterations=most)
    assert not summary.converged and summary.iterations == most
    assert summary.reason == f"stopped after {most} iterations"


def test_perfect_data_converge() -> None:
    problem, true = small_problem("radtan", sigma_px=0.0)
    for start in (problem.initial, true):
        _, _, summary = solve(build(replace(problem, initial=start), options_of()))
        assert summary.converged


def test_a_start_that_sees_nothing_is_said_to_be_hopeless() -> None:
    """Every frame turned away from all points: only priors are left to follow."""
    problem, _ = small_problem("radial")
    about_y = Transform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    turned = tuple(about_y @ t for t in problem.initial.rig_from_world)
    hopeless = replace(problem, initial=replace(problem.initial, rig_from_world=turned))
    estimate, _, summary = solve(build(hopeless, options_of()))
    assert not summary.converged and "not determined" in summary.reason
    assert np.isfinite(lenses_of(estimate)).all()


def test_a_variable_that_nothing_ties_is_not_called_converged() -> None:
    problem, _ = small_problem("radial")
    loose = gtsam.Values()
    loose.insert(gtsam.symbol("b", 0), gtsam.Pose3())
    _, _, summary = solve(build(problem, options_of(), None, loose))
    assert not summary.converged and "not determined" in summary.reason

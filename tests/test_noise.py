"""How large the noise is, and what a robust loss does to it: against quadrature and sampling."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.integrate import quad
from synthetic.problems import calibration_of, small_problem

from graphs.build import GraphOptions, build
from graphs.frames import FloatArray
from graphs.losses import LOSS_NAMES, LossName
from graphs.noise import (
    WIDEST_FACTOR,
    loss_moments,
    noise_classes,
    redundancies,
    redundancy,
    robust_sigma_px,
    with_class_sigmas,
)
from graphs.priors import stated_lens_prior, weak_lens_prior
from graphs.problem import KnownBaseline, Observations, Problem, residuals_px
from graphs.selection import compact
from graphs.solve import solve
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
LOSSES: tuple[LossName, ...] = ("none", "huber", "cauchy")
TRACKS = TrackOptions(rig="stereo", frames=12, points=900, max_points_per_image=60)


def problem_of(**changes: object) -> Problem:
    return simulate_tracks(TRACKS.model_copy(update=changes), np.random.default_rng(0))[0]


def weight_of(loss: LossName, k: float, r: float) -> float:
    if loss == "none":
        return 1.0
    return 1 / (1 + (r / k) ** 2) if loss == "cauchy" else min(1.0, k / max(r, 1e-12))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("k", [1.3, 2.385])
def test_loss_moments_are_the_expectations_over_gaussian_noise(loss: LossName, k: float) -> None:
    """By quadrature over a Rayleigh length; by Stein's identity E[psi'] = E[r . psi]."""
    problem = problem_of()
    residuals = SIGMA_PX * np.random.default_rng(0).standard_normal((400_000, 2))
    moments = loss_moments(problem, GraphOptions(SIGMA_PX, loss, k), residuals)

    def mean(of: object) -> float:
        assert callable(of)
        kinks = {"points": [k]} if loss == "huber" else {}
        return quad(lambda r: of(r) * r * np.exp(-(r**2) / 2), 0, 12, **kinks)[0]

    weight = mean(lambda r: weight_of(loss, k, r))
    score = mean(lambda r: (weight_of(loss, k, r) * r) ** 2 / 2)
    slope = mean(lambda r: weight_of(loss, k, r) * r**2 / 2)
    left = redundancy(problem)
    assert moments.curvature == pytest.approx(slope / weight, rel=0.01)
    assert moments.score_variance / moments.refit == pytest.approx(score / weight, rel=0.01)
    efficiency = slope**2 / score
    assert 0.8 < efficiency < 1 + 1e-9
    if loss == "none":
        assert moments.refit == pytest.approx(1 / left)
        assert moments.curvature == 1


def test_the_correction_for_refitting_is_hubers() -> None:
    """K = 1 + p / n var(psi') / E[psi']^2 (Robust Statistics, 1981, equation 6.8 of chapter 7),
    with psi' a 2 x 2 matrix here: sampled with its axes turned at random."""
    problem, k = problem_of(), 2.0
    rng = np.random.default_rng(1)
    residuals = SIGMA_PX * rng.standard_normal((400_000, 2))
    x, y = residuals.T / SIGMA_PX
    r2 = x**2 + y**2
    along_x = 1 / (1 + r2 / k**2) - 2 * x**2 / k**2 / (1 + r2 / k**2) ** 2
    left = redundancy(problem)
    factor = 1 + (1 - left) * along_x.var() / along_x.mean() ** 2
    moments = loss_moments(problem, GraphOptions(SIGMA_PX, "cauchy", k), residuals)
    assert moments.refit == pytest.approx(factor**2 / left, rel=0.01)


def test_sigma_px_is_that_of_the_noise_with_half_of_it_wild() -> None:
    problem = problem_of()
    rng = np.random.default_rng(2)
    shrunk = 0.7 * np.sqrt(redundancy(problem)) * rng.standard_normal((20_000, 2))
    assert robust_sigma_px(problem, shrunk) == pytest.approx(0.7, rel=0.02)
    shrunk[:6000] *= 50
    shrunk[6000:6100] = np.nan
    assert 0.7 < robust_sigma_px(problem, shrunk) < 1.2


def test_sigma_px_is_that_of_a_relative_sigma_of_one() -> None:
    problem, rng = problem_of(), np.random.default_rng(3)
    relative = rng.uniform(0.2, 5, len(problem.observations))
    seen = replace(problem.observations, relative_sigma=relative)
    shrunk = 0.7 * np.sqrt(redundancy(problem)) * rng.standard_normal((len(seen), 2))
    noisy = replace(problem, observations=seen)
    ours = robust_sigma_px(noisy, shrunk * relative[:, None])
    assert ours == pytest.approx(robust_sigma_px(problem, shrunk), rel=1e-12)
    options = GraphOptions(SIGMA_PX, "cauchy")
    moments = loss_moments(noisy, options, shrunk * relative[:, None])
    plain = loss_moments(problem, options, shrunk)
    assert astuple(moments) == pytest.approx(astuple(plain), rel=1e-12)


def test_redundancy_counts_every_unknown() -> None:
    problem = problem_of(baseline_sigma_m=0.0)
    unknowns = 2 * 6 + 6 + 6 * len(problem.frame_names) + 3 * len(problem.initial.points) - 7
    measured = 2 * len(problem.observations)
    assert redundancy(problem) == pytest.approx(1 - unknowns / measured)
    known = replace(problem, scales=(KnownBaseline((0, 1), 1.0, 0.1),))
    assert redundancy(known) == pytest.approx(1 - (unknowns + 1) / measured)


# ---- the noise of single observations, in the solver ----------------------------------------


def test_half_the_variance_is_as_good_as_seeing_twice() -> None:
    problem, _ = small_problem("radtan", start_error=0.3, baseline=True)
    seen = problem.observations
    twice = np.random.default_rng(0).random(len(seen)) < 0.3
    repeated = Observations(*(
        np.concatenate([getattr(seen, name), getattr(seen, name)[twice]])
        for name in ("pixels", "frame", "camera", "point")
    ))  # fmt: skip
    weighted = replace(seen, relative_sigma=np.where(twice, np.sqrt(0.5), 1.0))
    options = GraphOptions(SIGMA_PX, "none")
    graphs = [build(replace(problem, observations=own), options) for own in (repeated, weighted)]
    runs = [solve(graph, relative_tolerance=1e-13) for graph in graphs]
    assert runs[0][2].cost == pytest.approx(runs[1][2].cost, rel=1e-9)
    np.testing.assert_allclose(
        calibration_of(runs[0][0]), calibration_of(runs[1][0]), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_relative_sigmas_are_of_sigma_px(loss: LossName) -> None:
    problem, _ = small_problem("radtan", start_error=0.3)
    halved = replace(problem.observations, relative_sigma=np.full(len(problem.observations), 2.0))
    options = GraphOptions(SIGMA_PX, loss)
    ours = build(replace(problem, observations=halved), replace(options, sigma_px=SIGMA_PX / 2))
    plain = build(problem, options)
    for a, b in zip(ours.tracks.clusters, plain.tracks.clusters, strict=True):
        np.testing.assert_allclose(a.root_information, b.root_information)


# ---- the noise of classes ------------------------------------------------------------------


def sized(problem: Problem, seed: int = 4) -> Problem:
    """Keypoints of three sizes, the coarse ones of the second camera the worst."""
    rng, seen = np.random.default_rng(seed), problem.observations
    size = rng.choice([1.2, 2.4, 9.6], len(seen))
    return replace(problem, observations=replace(seen, feature_scale=size))


def noise_of_size(seen: Observations) -> FloatArray:
    assert seen.feature_scale is not None
    return 0.2 + 0.1 * np.log2(seen.feature_scale) * (1 + seen.camera)


def test_classes_find_the_noise_of_each_camera_and_size() -> None:
    problem = sized(problem_of(frames=20, points=2000, max_points_per_image=150))
    seen, rng = problem.observations, np.random.default_rng(5)
    sigma = noise_of_size(seen) * np.sqrt(redundancies(problem))
    left = sigma[:, None] * rng.standard_normal((len(seen), 2))
    left[rng.random(len(seen)) < 0.05] *= 30
    left[:50] = np.nan
    projected = np.isfinite(left[:, 0])
    classes = noise_classes(problem, left)
    assert [c.camera for c in classes] == [0, 0, 0, 1, 1, 1]
    assert sum(c.count for c in classes) == projected.sum()
    for one in classes:
        assert one.smallest_px == one.largest_px
        rows = projected & (seen.camera == one.camera) & (seen.feature_scale == one.smallest_px)
        assert one.count == rows.sum()
        assert one.sigma_px == pytest.approx(noise_of_size(seen)[rows][0], rel=0.12)


def test_noise_is_that_before_points_were_fitted_to_it() -> None:
    """Solved from tracks of three views, whose points take half of all that was measured."""
    options = TRACKS.model_copy(update={"frames": 30, "points": 6000, "max_points_per_image": 400})
    problem, true = simulate_tracks(options, np.random.default_rng(0))
    seen, rng = problem.observations, np.random.default_rng(9)
    by_track = np.lexsort((rng.random(len(seen)), seen.point))  # by lot within each
    begins = np.cumsum(np.bincount(seen.point)) - np.bincount(seen.point)
    place = np.empty(len(seen), np.int64)
    place[by_track] = np.arange(len(seen)) - begins[seen.point[by_track]]
    seen = seen.subset((place < 3) & (np.bincount(seen.point) >= 3)[seen.point])
    exact = residuals_px(true, replace(seen, pixels=np.zeros((len(seen), 2))))
    seen = replace(seen, pixels=exact + 0.3 * rng.standard_normal(exact.shape))
    problem = compact(replace(problem, initial=true), seen)
    estimate = solve(build(problem, GraphOptions(0.3, "none")), relative_tolerance=1e-6)[0]
    assert redundancy(problem) < 0.5
    classes = noise_classes(problem, residuals_px(estimate, problem.observations))
    # 6 % short: points leave less along epipolar lines than across, which lowers the median
    assert [one.sigma_px for one in classes] == pytest.approx([0.3, 0.3], rel=0.1)


def test_a_class_beyond_belief_is_weighed_as_ten_times_the_others() -> None:
    problem = problem_of(frames=20, points=2000, max_points_per_image=150)
    seen, rng = problem.observations, np.random.default_rng(10)
    size = rng.choice([1.2, 2.4, 9.6], len(seen))
    problem = replace(problem, observations=replace(seen, feature_scale=size))
    spread = 0.3 * np.select([size == 9.6, size == 1.2], [1000.0, 0.001], 1.0)
    left = spread[:, None] * rng.standard_normal((len(seen), 2))
    relative = with_class_sigmas(problem, left).observations.relative_sigma
    assert relative is not None
    np.testing.assert_array_equal(relative[size == 9.6], WIDEST_FACTOR)
    np.testing.assert_array_equal(relative[size == 1.2], 1 / WIDEST_FACTOR)
    np.testing.assert_allclose(relative[size == 2.4], 1, rtol=0.5)


def test_weighing_by_class_leaves_no_class_worse_than_another() -> None:
    problem = sized(problem_of(frames=20, points=2000, max_points_per_image=150))
    seen, rng = problem.observations, np.random.default_rng(6)
    sigma = noise_of_size(seen) * np.sqrt(redundancies(problem))
    left = sigma[:, None] * rng.standard_normal((len(seen), 2))
    weighed = with_class_sigmas(problem, left)
    relative = weighed.observations.relative_sigma
    assert relative is not None
    expected = noise_of_size(seen) / noise_of_size(seen)[0]
    np.testing.assert_allclose(relative / relative[0], expected, rtol=0.15)
    again = with_class_sigmas(weighed, left).observations.relative_sigma
    np.testing.assert_allclose(again, relative, rtol=0.15)  # a fixed point but for redundancies


def test_sigmas_that_were_given_are_kept_within_a_class() -> None:
    """As boards or matching by least squares state them: only the class's own factor is new."""
    problem = problem_of(frames=20, points=2000, max_points_per_image=150)
    rng = np.random.default_rng(7)
    given = rng.uniform(0.5, 2, len(problem.observations))
    seen = replace(problem.observations, relative_sigma=given)
    problem = replace(problem, observations=seen)
    spread = given * (1 + seen.camera) * np.sqrt(redundancies(problem))
    left = 0.3 * spread[:, None] * rng.standard_normal((len(seen), 2))
    relative = with_class_sigmas(problem, left).observations.relative_sigma
    assert relative is not None
    ratio = relative / given
    for camera in (0, 1):
        assert np.ptp(ratio[seen.camera == camera]) < 1e-12
    assert ratio[seen.camera == 1][0] / ratio[seen.camera == 0][0] == pytest.approx(2, rel=0.1)


def test_clicks_have_no_size_and_small_classes_join_others() -> None:
    problem = problem_of(frames=20, points=2000, max_points_per_image=150)
    size = np.full(len(problem.observations), 2.0)
    size[::50], size[3::40] = 20.0, np.nan
    seen = replace(problem.observations, feature_scale=size)
    problem = replace(problem, observations=seen)
    left = 0.3 * np.random.default_rng(8).standard_normal((len(seen), 2))
    classes = noise_classes(problem, left)
    assert [(c.smallest_px, c.largest_px) for c in classes] == [(2.0, 20.0)] * 2
    assert sum(c.count for c in classes) == np.isfinite(size).sum()
    relative = with_class_sigmas(problem, left).observations.relative_sigma
    assert relative is not None and (relative[np.isnan(size)] == 1).all()


def test_data_without_noise_is_left_alone() -> None:
    problem = sized(problem_of())
    assert with_class_sigmas(problem, np.zeros((len(problem.observations), 2))) is problem


def test_redundancies_are_what_each_point_leaves() -> None:
    problem, _ = small_problem("radial", cameras=1, frames=8, points=60)
    ours = redundancies(problem)
    assert ours.mean() == pytest.approx(redundancy(problem))
    twice = np.ones(len(problem.observations))
    twice[problem.observations.frame == 0] = 0.25  # sharper: its point leans on it
    sharp = replace(problem, observations=replace(problem.observations, relative_sigma=twice))
    leaning = redundancies(sharp)
    first = problem.observations.frame == 0
    assert leaning[first].max() < ours[first].min() < leaning[~first].max()


def test_what_is_held_or_shared_takes_no_freedom() -> None:
    problem = problem_of()
    measured = 2 * len(problem.observations)
    held = tuple(
        stated_lens_prior(c, weak_lens_prior(c), c.named(), {}, ("k1", "k2"))
        for c in problem.initial.cameras
    )
    all_free = redundancy(problem)
    fixed = redundancy(problem, GraphOptions(SIGMA_PX, lens_priors=held))
    assert fixed - all_free == pytest.approx(4 / measured)
    one = redundancy(problem, GraphOptions(SIGMA_PX, lens_priors=held, shared_lenses=((0, 1),)))
    assert one - all_free == pytest.approx(8 / measured)

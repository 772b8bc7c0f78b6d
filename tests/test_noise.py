"""How large the noise is, and what a robust loss does to it: against quadrature and sampling."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.integrate import quad
from synthetic.problems import calibration_of, small_problem

from graphs.build import GraphOptions, build
from graphs.losses import LOSS_NAMES, LossName
from graphs.noise import loss_moments, redundancy, robust_sigma_px
from graphs.problem import KnownBaseline, Observations, Problem
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
    known = replace(problem, scale=KnownBaseline((0, 1), 1.0, 0.1))
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

"""The Student t behind the adaptive loss: does it find the noise it is shown?"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_t
from synthetic.problems import small_problem

from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.noise import LEAST_FREEDOM, MOST_FREEDOM, adapted, redundancy, student_t
from graphs.problem import residuals_px

SCALE_PX = 0.4


def noise(freedom: float, count: int = 100_000, seed: int = 0) -> FloatArray:
    """Bivariate t (count, 2): a Gaussian over the root of a chi-squared with its freedom."""
    rng = np.random.default_rng(seed)
    spread = np.sqrt(freedom / rng.chisquare(freedom, count)) if np.isfinite(freedom) else 1.0
    return SCALE_PX * rng.standard_normal((count, 2)) * np.reshape(spread, (-1, 1))


@pytest.mark.parametrize("freedom", [1.5, 3.0, 6.0, 20.0])
def test_scale_and_freedom_are_found(freedom: float) -> None:
    scale, found = student_t(np.linalg.norm(noise(freedom), axis=1))
    assert scale == pytest.approx(SCALE_PX, rel=0.02)
    assert found == pytest.approx(freedom, rel=0.1)


def test_gaussian_noise_has_much_freedom() -> None:
    scale, freedom = student_t(np.linalg.norm(noise(np.inf), axis=1))
    assert freedom > 50
    assert scale == pytest.approx(SCALE_PX, rel=0.02)


def test_freedom_stays_within_bounds() -> None:
    wild = np.exp(10 * np.random.default_rng(0).standard_normal(1000))
    assert student_t(wild)[1] == pytest.approx(LEAST_FREEDOM, rel=1e-3)
    assert student_t(np.full(1000, 0.3))[1] == pytest.approx(MOST_FREEDOM, rel=1e-3)


def test_what_could_not_be_projected_is_passed_by() -> None:
    lengths = np.linalg.norm(noise(4.0), axis=1)
    assert student_t(np.append(lengths, [np.nan, np.nan])) == student_t(lengths)


@pytest.mark.parametrize("freedom", [2.0, 8.0])
def test_nothing_near_is_more_likely(freedom: float) -> None:
    """By scipy's density of the bivariate t."""
    residuals = noise(freedom, 5000)
    scale, found = student_t(np.linalg.norm(residuals, axis=1))

    def likelihood(scale: float, freedom: float) -> float:
        return float(multivariate_t([0, 0], scale**2 * np.eye(2), freedom).logpdf(residuals).sum())

    best = likelihood(scale, found)
    for factor in (0.97, 1.03):
        assert likelihood(scale * factor, found) < best
        assert likelihood(scale, found * factor) < best + 1e-9


def test_the_loss_is_the_likelihoods() -> None:
    """Cauchy's with these numbers is -log p of the t, but for a constant and, as the noise was
    fitted, for the redundancy."""
    problem, _ = small_problem("radtan", frames=6, points=200)
    residuals = noise(4.0, len(problem.observations))
    options = adapted(problem, GraphOptions(), residuals)
    scale, freedom = student_t(np.linalg.norm(residuals, axis=1))
    grown = scale / np.sqrt(redundancy(problem))
    assert options.loss == "cauchy"
    r = np.array([0.0, 0.2, 1.0, 5.0])
    k = options.loss_scale
    cost = k**2 / 2 * np.log1p((r / options.sigma_px / k) ** 2)
    density = multivariate_t([0, 0], grown**2 * np.eye(2), freedom)
    minus_log = -density.logpdf(np.column_stack([r, 0 * r]))
    np.testing.assert_allclose(cost - cost[0], minus_log - minus_log[0], rtol=1e-9)


def test_single_sigmas_are_taken_out_first() -> None:
    problem, true = small_problem("radtan", frames=6, points=200, sigma_px=0.5)
    plain = adapted(problem, GraphOptions(), residuals_px(true, problem.observations))
    doubled = np.random.default_rng(0).random(len(problem.observations)) < 0.5
    relative = np.where(doubled, 2.0, 1.0)
    seen = replace(problem.observations, relative_sigma=relative)
    residuals = relative[:, None] * residuals_px(true, problem.observations)
    weighed = adapted(replace(problem, observations=seen), GraphOptions(), residuals)
    assert weighed == plain

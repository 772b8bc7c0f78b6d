"""The statistics of a drift: many tests at once, few frames, and what could have been found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from graphs.significance import Guess, degrees, detectable, holm, noncentrality, significance


def test_holm_by_hand() -> None:
    # 4 x 0.005, 3 x 0.01 -> 0.03, 2 x 0.03 -> 0.06, then 0.04, no less than the one before
    assert np.allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert np.allclose(holm([0.9, 0.8]), [1.0, 1.0])
    assert holm([]).shape == (0,)


def test_a_direction_without_a_sigma_says_nothing_unless_it_changed() -> None:
    cov = np.diag([4.0, 0.0])
    assert significance(np.array([2.0, 0.0]), cov).dof == 1
    assert significance(np.array([2.0, 0.0]), cov).chi2 == pytest.approx(1.0)
    assert significance(np.array([0.0, 0.5]), cov).p_value == 0.0
    assert significance(np.zeros(2), np.zeros((2, 2))).p_value == 1.0
    assert detectable(np.zeros((2, 2)), 0.05, 0.95) == 0.0


def test_what_is_called_detectable_is_found_as_often_as_promised() -> None:
    """In the worst direction just so, in another more often."""
    rng = np.random.default_rng(0)
    cov = np.array([[1.0, 0.3, 0.0], [0.3, 0.5, 0.1], [0.0, 0.1, 0.2]])
    alpha, power, n = 0.01, 0.95, 2000
    vectors = np.linalg.eigh(cov)[1]
    errors = rng.standard_normal((n, 3)) @ np.linalg.cholesky(cov).T
    size = detectable(cov, alpha, power)
    found = [
        np.mean([significance(size * u + e, cov).p_value < alpha for e in errors])
        for u in (vectors[:, -1], vectors[:, 0])
    ]
    assert found[0] == pytest.approx(power, abs=4 * (power * (1 - power) / n) ** 0.5)
    assert found[1] > found[0]


@pytest.mark.parametrize("nu", [4, 7, 39])
def test_a_covariance_guessed_of_few_frames_is_allowed_for(nu: int) -> None:
    """Its size scatters as that of nu + 1 frames: p-values stay uniform, power as promised."""
    rng, n, alpha, power = np.random.default_rng(nu), 1000, 0.01, 0.9
    size = noncentrality(alpha, 3, power, nu) ** 0.5
    guesses = rng.chisquare(nu, n) / nu
    errors = rng.standard_normal((n, 3))
    apart = [errors, errors + np.array([size, 0.0, 0.0])]
    p, q = (
        [significance(e, g * np.eye(3), nu).p_value for e, g in zip(one, guesses, strict=True)]
        for one in apart
    )
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    found = np.mean(np.array(q) < alpha)
    assert found == pytest.approx(power, abs=4 * (power * (1 - power) / n) ** 0.5)
    assert detectable(4 * np.eye(3), alpha, power, nu) == pytest.approx(2 * size)


def test_many_frames_are_as_good_as_a_known_covariance() -> None:
    for dof in (1, 3, 18):
        known = noncentrality(0.003, dof, 0.95)
        sizes = [noncentrality(0.003, dof, 0.95, nu) for nu in (1, 1.5, 3, 7, 39, 200, 2e4)]
        assert sizes == sorted(sizes, reverse=True)
        assert known < sizes[-2] < 1.12 * known
        assert sizes[-1] == pytest.approx(known, rel=1e-3)
    # Where the series of the noncentral F is not summed any more, it goes on as it was.
    near, far = (noncentrality(alpha, 3, 0.95, 2) for alpha in (0.0031, 0.0029))
    assert near < 3e3 < far or far < 1.1 * near


def test_what_is_known_beside_a_guess_makes_it_matter_less() -> None:
    half, whole = Guess(0.5 * np.eye(3), 10), Guess(np.eye(3), 10)
    assert degrees(np.eye(3), [half]) == pytest.approx(40)
    assert degrees(np.eye(3), [Guess(np.diag([0.5, 1.0, 0.0]), 10)]) == pytest.approx(10)
    assert degrees(np.eye(3), [Guess(np.zeros((3, 3)), 10)]) == np.inf
    assert degrees(np.eye(3), [replace(whole, nu=np.inf)]) == np.inf
    # Two halves of many and of few: the few count.
    assert degrees(np.eye(3), [half, replace(half, nu=90)]) == pytest.approx(36)
    assert degrees(np.eye(3), []) == np.inf

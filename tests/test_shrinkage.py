"""Shrinkage of few samples: its two ends, its formula, and that it helps."""

from __future__ import annotations

import numpy as np
import pytest

from graphs.frames import FloatArray
from graphs.shrinkage import shrunk


def scatter_of(samples: FloatArray) -> FloatArray:
    return samples.T @ samples / len(samples)


def test_many_samples_are_believed() -> None:
    truth = np.diag([1.0, 4.0, 25.0])
    samples = np.random.default_rng(0).multivariate_normal(np.zeros(3), truth, 20_000)
    scatter = scatter_of(samples)
    np.testing.assert_allclose(shrunk(scatter, 20_000), scatter, rtol=0.01, atol=0.01)


def test_a_round_scatter_stays_as_it_is() -> None:
    np.testing.assert_allclose(shrunk(3 * np.eye(4), 5), 3 * np.eye(4))
    np.testing.assert_allclose(shrunk(np.array([[2.0]]), 5), [[2.0]])


def test_the_trace_stays() -> None:
    scatter = scatter_of(np.random.default_rng(1).standard_normal((6, 12)))
    assert np.trace(shrunk(scatter, 6)) == pytest.approx(np.trace(scatter))


def test_the_weight_is_that_of_the_paper() -> None:
    """Chen et al. 2010, equation 23, by hand: n = 2, three samples, eigenvalues 1 and 3."""
    weight = (0 * 10 + 16) / ((3 + 1 - 1) * (10 - 16 / 2))
    assert weight > 1  # so few samples say nothing of the shape
    np.testing.assert_allclose(shrunk(np.diag([1.0, 3.0]), 3), 2 * np.eye(2))
    weight = (0 * 10 + 16) / ((9 + 1 - 1) * (10 - 16 / 2))
    expected = (1 - weight) * np.diag([1.0, 3.0]) + weight * 2 * np.eye(2)
    np.testing.assert_allclose(shrunk(np.diag([1.0, 3.0]), 9), expected)
    # n = 3, nine samples, eigenvalues 1, 2 and 6: one third of tr S^2 counts too
    weight = (1 / 3 * 41 + 81) / ((9 + 1 - 2 / 3) * (41 - 81 / 3))
    assert 0.7 < weight < 0.75
    expected = (1 - weight) * np.diag([1.0, 2, 6]) + weight * 3 * np.eye(3)
    np.testing.assert_allclose(shrunk(np.diag([1.0, 2, 6]), 9), expected)


def test_it_is_nearer_to_the_truth_than_the_scatter() -> None:
    rng, truth = np.random.default_rng(2), np.diag([1.0, 1, 1, 2, 2, 2, 4, 4, 8, 16])
    raw, better = [], []
    for _ in range(200):
        scatter = scatter_of(rng.multivariate_normal(np.zeros(10), truth, 8))
        raw.append(((scatter - truth) ** 2).sum())
        better.append(((shrunk(scatter, 8) - truth) ** 2).sum())
    assert np.mean(better) < 0.8 * np.mean(raw)

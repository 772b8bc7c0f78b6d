"""Noise that each observation states of itself: its size, and in which direction it is larger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.problems import small_problem, with_noise

from graphs.build import GraphOptions, build
from graphs.consider import factors
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.noise import residual_lengths
from graphs.problem import Observations, Problem, joined, residuals_px, whitened
from graphs.refine import refine
from graphs.stated_covariance import calibration_covariance
from graphs.twin import twin_problem
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

TRACKS = TrackOptions(
    rig="stereo", frames=10, points=900, max_points_per_image=100, sigma_px=1e-6, focal_error=0.01,
    rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
)  # fmt: skip


def covariances(seen: Observations) -> FloatArray:
    assert seen.noise_shape is not None and seen.relative_sigma is not None
    return seen.noise_shape * seen.relative_sigma[:, None, None] ** 2


def noise_of(seen: Observations, rng: np.random.Generator) -> FloatArray:
    root = np.linalg.cholesky(covariances(seen))
    return np.einsum("nij,nj->ni", root, rng.standard_normal((len(seen), 2)))


def with_shaped_noise(sigma_px: float, seed: int) -> tuple[Problem, Problem]:
    """A problem whose observations err as they state, in units of this; and the truth."""
    problem, true = simulate_tracks(TRACKS, np.random.default_rng(seed))
    seen = with_noise(problem.observations, seed)
    exact = seen.pixels + residuals_px(true, seen)
    pixels = exact + sigma_px * noise_of(seen, np.random.default_rng([seed, 1]))
    return replace(problem, observations=replace(seen, pixels=pixels)), replace(
        problem, initial=true
    )


def test_whitened_errors_are_round_and_of_one_size() -> None:
    problem, _ = small_problem(points=200)
    seen = with_noise(problem.observations)
    white = np.array([whitened(noise_of(seen, np.random.default_rng(i)), seen.whitening)
                      for i in range(200)])  # fmt: skip
    covariance = np.einsum("tni,tnj->nij", white, white) / len(white)
    assert np.abs(covariance.mean(0) - np.eye(2)).max() < 0.02
    assert np.abs(covariance - np.eye(2)).max() < 0.6  # of each observation, 200 times


def test_a_length_is_that_of_mahalanobis() -> None:
    problem, _ = small_problem(points=50)
    seen = with_noise(problem.observations)
    off = np.random.default_rng(0).standard_normal((len(seen), 2))
    expected = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances(seen)), off) ** 0.5
    got = residual_lengths(replace(problem, observations=seen), off)
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_parts_keep_their_noise_when_they_are_joined_and_split() -> None:
    problem, _ = small_problem(points=20)
    plain, shaped = problem.observations, with_noise(problem.observations)
    shaped = replace(shaped, matched_sigma_px=np.full(len(shaped), 0.03))
    both = joined([plain, shaped])
    assert both.noise_shape is not None and both.matched_sigma_px is not None
    np.testing.assert_array_equal(both.noise_shape[0], np.eye(2))
    assert np.isnan(both.matched_sigma_px[: len(plain)]).all()
    rows = np.arange(len(plain), len(both))
    for part in (both.subset(rows), both.subset(np.isin(np.arange(len(both)), rows))):
        np.testing.assert_array_equal(part.whitening, shaped.whitening)
        np.testing.assert_array_equal(part.matched_sigma_px, shaped.matched_sigma_px)


def test_the_sigmas_hold_of_observations_that_differ_in_every_way() -> None:
    """Squared errors over the model covariance, one a degree of freedom, in 12 scans; and what
    one round sigma for all would lose."""
    nees, errors = [], {True: 0.0, False: 0.0}
    for seed in range(12):
        problem, true = with_shaped_noise(0.2, seed)
        for told in (True, False):
            seen = problem.observations
            seen = seen if told else replace(seen, relative_sigma=None, noise_shape=None)
            start = replace(problem, initial=true.initial, observations=seen)
            found = refine(start, GraphOptions(), 1.0)
            covariance = calibration_covariance(found.graph, found.estimate, found.values)
            names = covariance.model.names
            off = change(true.initial, found.estimate, names)
            if told:
                nees.append(float(((factors(covariance.model.matrix)[1] @ off) ** 2).mean()))
            focal = [i for i, name in enumerate(names) if name.endswith(("fx", "fy"))]
            errors[told] += float((off[focal] ** 2).sum())
    assert 0.8 < np.mean(nees) < 1.25
    assert errors[True] < 0.75 * errors[False]


def matched(problem: Problem, stated_px: FloatArray) -> Problem:
    seen = replace(
        problem.observations,
        relative_sigma=stated_px / np.median(stated_px),
        matched_sigma_px=stated_px,
        feature_scale=np.full(len(stated_px), 2.0),
    )
    return replace(problem, observations=seen)


def test_what_matching_states_too_small_is_found_by_its_size() -> None:
    """The better half errs three times as much as it says: classes are by what is stated."""
    problem, true = with_shaped_noise(1.0, 0)
    seen = replace(problem.observations, relative_sigma=None, noise_shape=None)
    exact = seen.pixels + residuals_px(true.initial, seen)
    rng = np.random.default_rng(1)
    stated = np.where(np.arange(len(seen)) % 2 == 0, 0.02, 0.08)
    actual = np.where(stated < 0.05, 0.06, 0.08)
    pixels = exact + actual[:, None] * rng.standard_normal(exact.shape)
    problem = matched(replace(true, observations=replace(seen, pixels=pixels)), stated)
    found = refine(problem, GraphOptions(), 1.0)
    seen = found.problem.observations
    assert seen.relative_sigma is not None and seen.matched_sigma_px is not None
    small = seen.matched_sigma_px < 0.05
    ratio = np.median(seen.relative_sigma[~small]) / np.median(seen.relative_sigma[small])
    assert ratio == pytest.approx(0.08 / 0.06, rel=0.25)  # 4 as it was stated
    assert {one.kind for one in found.noise} == {"matched"}
    for one in found.noise:
        assert one.sigma_px == pytest.approx(0.06 if one.largest_px < 0.05 else 0.08, rel=0.25)


def test_a_twin_has_noise_of_the_same_shapes() -> None:
    problem, _ = with_shaped_noise(0.3, 3)
    found = refine(problem, GraphOptions(), 1.0)
    seen = found.problem.observations
    twin = twin_problem(found, np.random.default_rng(0))
    noise = residuals_px(found.estimate, twin.observations)
    assert seen.noise_shape is not None
    size, directions = np.linalg.eigh(seen.noise_shape)
    along = np.einsum("nij,ni->nj", directions, noise)
    long = size[:, 1] > 4 * size[:, 0]
    assert long.sum() > 200
    ratio = np.median(np.abs(along[long, 1])) / np.median(np.abs(along[long, 0]))
    expected = np.median(np.sqrt(size[long, 1] / size[long, 0]))
    assert ratio == pytest.approx(expected, rel=0.25)
    white = residual_lengths(found.problem, noise)
    before = residual_lengths(found.problem, residuals_px(found.estimate, seen))
    assert 1.0 < np.median(white) / np.median(before) < 1.25


def test_the_graph_weighs_by_size_and_shape() -> None:
    problem, _ = small_problem(points=10)
    seen = with_noise(problem.observations)
    graph = build(replace(problem, observations=seen), GraphOptions(0.5, "none", 1.0))
    roots = np.concatenate([cluster.root_information for cluster in graph.tracks.clusters])
    W = np.zeros((len(roots), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = roots.T
    told = np.sort(np.linalg.inv(W.mT @ W).reshape(-1, 4), axis=0)
    np.testing.assert_allclose(told, np.sort(0.25 * covariances(seen).reshape(-1, 4), axis=0))

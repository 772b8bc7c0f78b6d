"""Sums of influences over frames, tracks and cells: by hand, and against dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.dense import linearise_dense, of_others
from synthetic.problems import small_problem

from graphs.build import GraphOptions, build
from graphs.clusters import homogeneous
from graphs.frames import FloatArray
from graphs.influence import CELLS, Influence, SharedErrors, shared_errors
from graphs.losses import LossName, weight_and_slope
from graphs.model_covariance import calibration_columns
from graphs.noise import LEAST_REDUNDANCY
from graphs.problem import IntArray
from graphs.solve import solve
from graphs.threads import threads

SIGMA_PX = 0.5
LOSSES: tuple[LossName, ...] = ("none", "huber", "cauchy")


def influence(moved: FloatArray, begins: IntArray) -> Influence:
    nothing = np.zeros((len(moved), 4), np.int64)
    return Influence(nothing, begins, moved, np.zeros(len(begins)))


def test_sums_over_clusters_by_hand() -> None:
    """Two tracks of three and two observations, in two frames and three cells."""
    moved = np.array([[1.0], [10], [3], [2], [5]])
    frame, cell, begins = np.array([0, 0, 1, 1, 1]), np.array([4, 5, 4, 5, 70]), np.array([0, 3])
    together = SharedErrors(2, 2, 1)
    weight = np.array([1.0, 1.0, 1.0, 1.0, 3.0])
    together.add(influence(moved, begins), frame, cell, weight)
    apart = SharedErrors(2, 2, 1)
    for rows in (slice(0, 3), slice(3, 5)):
        one = SharedErrors(2, 2, 1)
        one.add(influence(moved[rows], np.array([0])), frame[rows], cell[rows], weight[rows])
        apart.merge(one, np.arange(2))
    for sums in (together, apart):
        np.testing.assert_allclose(sums.by_frame, [[11], [10]])
        np.testing.assert_allclose(sums.by_cell[[4, 5, 70]], [[4], [12], [5]])
        np.testing.assert_allclose(sums.by_track, [[14**2 + 7**2]])
        assert sums.n_tracks == 2
        assert sums.alone == pytest.approx((moved**2).sum())
        left = np.array([0.5, 0.5, 0.5, 1 - 1.5 / 4, 0.1])  # of two with one's threefold weight
        assert sums.before_fit == pytest.approx((moved[:, 0] ** 2 / left).sum())


def test_frames_of_a_cluster_find_their_place_among_all() -> None:
    """A cluster of two of five frames, in no order."""
    total, part = SharedErrors(5, 1, 2), SharedErrors(2, 1, 2)
    moved, begins = np.array([[1.0, 2], [3, 4], [5, 6]]), np.array([0])
    part.add(influence(moved, begins), np.array([0, 0, 1]), np.zeros(3, np.int64), np.ones(3))
    total.merge(part, np.array([3, 1]))
    np.testing.assert_array_equal(total.by_frame, [[0, 0], [5, 6], [0, 0], [4, 6], [0, 0]])
    total.merge(part, np.array([1, 4]))
    np.testing.assert_array_equal(total.by_frame, [[0, 0], [9, 12], [0, 0], [4, 6], [5, 6]])


@pytest.mark.parametrize("loss", LOSSES)
def test_shared_errors_are_those_of_dense_algebra(
    loss: LossName, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows by finite differences, points eliminated by a dense Schur complement; scores of every
    observation summed by frame, by track, and by cell."""
    monkeypatch.setattr("graphs.clusters.CHUNK", 64)  # several chunks
    problem, _ = small_problem("radtan", cameras=3, frames=7, points=40, baseline=True)
    sigma = np.random.default_rng(0).uniform(0.5, 2, len(problem.observations))
    seen = replace(problem.observations, relative_sigma=sigma)
    graph = build(replace(problem, observations=seen), GraphOptions(SIGMA_PX, loss, 2.0))
    estimate, values, _ = solve(graph)
    dense = linearise_dense(graph, values, estimate.points)
    lengths = np.linalg.norm(dense.residuals, axis=1)
    weights = weight_and_slope(loss, 2.0, lengths)[0]
    H = dense.normal_equations(weights, weights[:, None, None] * np.eye(2))[0]
    H += of_others(graph, values)
    scale = 1 / np.sqrt(np.diag(H))
    inverse = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
    columns = calibration_columns(graph, estimate)[0]
    followed = dense.across_points(weights)
    moved = np.einsum("na,nak,n->nk", dense.residuals, followed, weights) @ inverse[:, columns]
    with threads() as pool:
        points = homogeneous(graph.tracks, estimate.points)
        ours = shared_errors(graph, graph.variables(values), points, inverse[:, columns], pool)

    def summed(label: IntArray, count: int) -> FloatArray:
        sums = np.zeros((count, moved.shape[1]))
        np.add.at(sums, label, moved)
        return sums

    def same(a: FloatArray, b: FloatArray) -> None:
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6 * np.abs(b).max())

    order = graph.layout.elimination.order
    same(ours.by_frame, summed(seen.frame, 7)[order])
    size = np.array([camera.size for camera in estimate.cameras])[seen.camera]
    x, y = np.clip((seen.pixels / size * CELLS).astype(int), 0, CELLS - 1).T
    same(ours.by_cell, summed((seen.camera * CELLS + y) * CELLS + x, 3 * CELLS**2))
    of_tracks = summed(seen.point, 40)
    same(ours.by_track, of_tracks.T @ of_tracks)
    assert ours.alone == pytest.approx((moved**2).sum(), rel=1e-5)
    assert ours.n_tracks == len(np.unique(seen.point))
    # a point takes three coordinates of its track, by the observations' own weights
    of_track = np.bincount(seen.point, sigma**-2)[seen.point]
    left = np.maximum(1 - 1.5 * sigma**-2 / of_track, LEAST_REDUNDANCY)
    expected = ((moved**2).sum(1) / left).sum()
    assert np.trace(ours.before_fit) == pytest.approx(expected, rel=1e-5)

"""How blocks, tracks and cells come together in the stated covariance: hand-made, and on scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.shared_errors import drifting

from graphs.build import GraphOptions, build
from graphs.clusters import homogeneous
from graphs.frames import FloatArray
from graphs.influence import SharedErrors, shared_errors
from graphs.jackknife import Jackknife, delete_group_jackknife
from graphs.model_covariance import model_covariance
from graphs.priors import LensPrior
from graphs.problem import KnownSpan, Problem
from graphs.shrinkage import shrunk
from graphs.solve import solve
from graphs.split_check import split_check
from graphs.stated_covariance import (
    _of_blocks,
    _of_cells,
    _of_data,
    _of_frames,
    _of_tracks,
    calibration_covariance,
    factors,
)
from graphs.threads import threads
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
TRACKS = TrackOptions(
    rig="stereo", frames=20, points=1200, max_points_per_image=80, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
)  # fmt: skip


def problem_of(seed: int = 0, **changes: object) -> Problem:
    return simulate_tracks(TRACKS.model_copy(update=changes), np.random.default_rng(seed))[0]


# ---- the parts, by hand --------------------------------------------------------------------


def jackknife(moved: FloatArray, expected: FloatArray, n_failed: int = 0) -> Jackknife:
    names = tuple(f"cam0.{i}" for i in range(moved.shape[1]))
    return Jackknife(names, moved, expected, (("", ""),) * len(moved), (("", ""),) * n_failed)


def test_the_jackknifes_covariance_is_that_of_all_its_blocks() -> None:
    moved = np.array([[1.0, 0.0], [0.0, 2.0], [2.0, 0.0], [0.0, 1.0]])
    np.testing.assert_allclose(jackknife(moved, np.eye(2)).covariance, 3 / 4 * 5 * np.eye(2))
    # Four that failed would have moved it as far: seven eighths of twice the sum.
    half = jackknife(moved, np.eye(2), n_failed=4)
    np.testing.assert_allclose(half.covariance, 7 / 8 * 2 * 5 * np.eye(2))


def test_blocks_beyond_the_model_by_hand() -> None:
    """Ten blocks, all as long, evenly in two directions: no doubt, and nothing to shrink."""
    angle = 2 * np.pi * np.arange(10) / 10
    moved = 2.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    found = _of_blocks(jackknife(moved, 10 * 0.1 * np.eye(2)), np.eye(2))
    per_direction = 9 / 10 * 10 * 4 / 2 - 9 / 10 * 10 * 0.1
    np.testing.assert_allclose(found, 10 / 8 * per_direction * np.eye(2), rtol=1e-9)


def test_blocks_no_further_than_chance_add_nothing() -> None:
    rng = np.random.default_rng(0)
    moved = rng.standard_normal((10, 3))
    expected = (moved**2).sum() / 3 * np.eye(3)  # just what is there
    assert (_of_blocks(jackknife(moved, expected), np.eye(3)) == 0).all()
    assert (_of_blocks(jackknife(moved, 1.05 * expected), np.eye(3)) == 0).all()
    assert (_of_blocks(jackknife(moved, 0.95 * expected), np.eye(3)) == 0).all()


def test_a_doubtful_excess_is_shrunk_as_james_and_stein_have_it() -> None:
    squares = np.array([0.0, 2.0, 4.0, 6.0])
    moved = np.sqrt(squares)[:, None]
    found = _of_blocks(jackknife(moved, np.array([[1.0]])), np.eye(1))
    mean, error = 3 * squares.mean() - 3 / 4, 3 * squares.std(ddof=1) / 2
    assert found[0, 0] == pytest.approx(4 / 2 * (1 - (error / mean) ** 2) * mean)


def shared(n: int = 2) -> SharedErrors:
    sums = SharedErrors(12, 1, n)
    sums.by_frame[:] = np.random.default_rng(1).standard_normal((12, n))
    sums.by_cell[:40] = np.random.default_rng(2).standard_normal((40, n))
    sums.by_track = np.diag([3.0, 5.0])
    sums.n_tracks, sums.alone, sums.before_frames = 50, 4.0, 5.0
    sums.before_fit = 3.0 * np.eye(2)
    return sums


def test_excesses_are_over_what_independent_observations_sum_to() -> None:
    sums = shared()
    frames, cells = sums.by_frame.T @ sums.by_frame, sums.by_cell.T @ sums.by_cell
    np.testing.assert_allclose(
        _of_frames(sums), 12 / 11 * shrunk(frames, 12) / 2.5 - np.eye(2), rtol=1e-12
    )
    np.testing.assert_allclose(
        _of_cells(sums), 40 / 39 * shrunk(cells, 40) / 2.0 - np.eye(2), rtol=1e-12
    )
    np.testing.assert_allclose(
        _of_tracks(sums), 50 / 49 * shrunk(sums.by_track, 50) / 3.0 - np.eye(2), rtol=1e-12
    )
    sums.by_frame[4:] = 0
    assert (_of_frames(sums) == 0).all()  # of four frames


def test_factors_are_a_root_and_its_inverse() -> None:
    rng = np.random.default_rng(3)
    A = np.diag([1e-5, 1.0, 100.0, 1e-3]) @ rng.standard_normal((4, 3))  # of rank 3
    R, W = factors(A @ A.T)
    np.testing.assert_allclose(R @ R.T, A @ A.T, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(W @ R, np.eye(3), atol=1e-8)


# ---- scans ---------------------------------------------------------------------------------


def test_blocks_tracks_and_cells_are_added_up() -> None:
    """Their sum, as far as it is more than nothing, on top of the model; without the jackknife,
    frames in place of blocks."""
    graph = build(drifting(problem_of(), 2.0, 0), GraphOptions(SIGMA_PX))
    estimate, values, _ = solve(graph)
    covariance = calibration_covariance(graph, estimate, values, min_parallax_deg=1.0)
    assert covariance.jackknife is not None
    root, whiten = _of_data(covariance.basis)
    with threads() as pool:
        sums = shared_errors(
            graph,
            graph.variables(values),
            homogeneous(graph.tracks, estimate.points),
            covariance.basis.response @ whiten.T,
            pool,
        )
    parts = (_of_blocks(covariance.jackknife, whiten), _of_frames(sums))
    for first, stated in zip(parts, (covariance.stated, covariance.robust), strict=True):
        size, axes = np.linalg.eigh(first + _of_tracks(sums) + _of_cells(sums))
        more = root @ (axes * np.maximum(size, 0)) @ axes.T @ root.T
        np.testing.assert_allclose(stated.matrix, covariance.basis.matrix + more, rtol=1e-9)
    assert np.trace(_of_tracks(sums)) > 0.1 * len(whiten)


def test_where_priors_decide_everything_nothing_is_added() -> None:
    problem, true = simulate_tracks(
        TRACKS.model_copy(update={"rig": "mono"}), np.random.default_rng(0)
    )
    camera = true.cameras[0]
    prior = LensPrior(camera.params, np.array([1e-5] * 4 + [1e-8] * 2))
    graph = build(problem, GraphOptions(SIGMA_PX, lens_priors=(prior,)))
    estimate, values, _ = solve(graph)
    covariance = calibration_covariance(graph, estimate, values, min_parallax_deg=1.0)
    assert len(covariance.stated.names) == 6 and covariance.inflation == 1
    assert covariance.stated.sigma["cam0.fx"] == pytest.approx(1e-5, rel=1e-3)


def with_span(problem: Problem) -> Problem:
    """A distance between two points that three frames each see, as three clicks would."""
    seen = problem.observations
    length = np.bincount(seen.point)
    ends = np.flatnonzero(length == 3)[:2].tolist()
    places = problem.initial.points[ends]
    scale = KnownSpan((ends[0], ends[1]), float(np.linalg.norm(places[1] - places[0])), 0.001, 1.0)
    return replace(problem, scales=(scale,))


@pytest.mark.slow
def test_clicks_stay_when_their_frames_are_left_out() -> None:
    problem = with_span(problem_of(max_track_frames=6, points=2500))
    graph = build(problem, GraphOptions(SIGMA_PX))
    estimate, values, _ = solve(graph)
    model = model_covariance(graph, estimate, values)
    found = delete_group_jackknife(graph, estimate, model, 0.0)
    assert found is not None and found.failed == ()
    covariance = calibration_covariance(graph, estimate, values, min_parallax_deg=0.0)
    assert split_check(graph, estimate, covariance, 0.0) is not None

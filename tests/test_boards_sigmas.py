"""What frames, tracks and corners err together in problems with boards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.boards import camera, flat_board, waved
from test_boards_parts import joint

from graphs.build import GraphOptions
from graphs.clusters import homogeneous
from graphs.frames import Transform
from graphs.influence import SharedErrors, shared_errors
from graphs.model_covariance import model_covariance
from graphs.noise import free_dimensions, noise_classes, redundancies, redundancy
from graphs.problem import Problem
from graphs.refine import refine
from graphs.selection import compact
from graphs.stated_covariance import (
    _before_fits,
    _of_cells,
    _of_corners,
    _of_data,
    _of_frames,
    _of_tracks,
    _widened,
    calibration_covariance,
)
from graphs.threads import threads


def errors_of(problem: Problem) -> tuple[SharedErrors, int]:
    """What errs together at the optimum, and how many directions the data decide."""
    found = refine(problem, GraphOptions(), 1.0)
    model = model_covariance(found.graph, found.estimate, found.values)
    whiten = _of_data(model)[1]
    points = homogeneous(found.graph.tracks, found.estimate.points)
    with threads() as pool:
        variables = found.graph.variables(found.values)
        shared = shared_errors(found.graph, variables, points, model.response @ whiten.T, pool)
    return shared, len(whiten)


@pytest.mark.slow
def test_frames_that_see_few_corners_do_not_seem_to_err_together() -> None:
    """Six numbers of each frame are fitted to twenty coordinates."""
    ratios, of_all = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        problem, _ = waved(rng, 30, 0.2, [camera("one")], [Transform.identity()], seen=0.2)
        shared, n = errors_of(problem)
        frames = shared.by_frame[shared.by_frame.any(axis=1)]
        finite = len(frames) / (len(frames) - 1)
        ratios.append(finite * (frames**2).sum() / np.array([shared.before_frames, shared.alone]))
        of_all.append([shared.before_frames / n, shared.alone / n])
    # Frames of many corners say most of the lens, which takes of those more than its share.
    assert 0.7 < np.mean(ratios, axis=0)[0] < 1.05
    assert np.mean(ratios, axis=0)[1] > 1.2 * np.mean(ratios, axis=0)[0]  # of what is left
    np.testing.assert_allclose(np.mean(of_all, axis=0), [0.95, 0.65], atol=0.1)


def test_tracks_and_corners_are_held_against_all_data_before_fits() -> None:
    """Independent errors scatter by one in each direction, whatever was fitted to them."""
    shared, n = errors_of(joint(10, 3))
    assert _before_fits(shared) == pytest.approx(n, rel=0.2)
    assert shared.alone < 0.8 * n
    for excess in (_of_frames(shared), _of_tracks(shared), _of_corners(shared)):
        assert abs(np.trace(excess)) < 0.35 * n


def test_a_board_that_says_nothing_leaves_the_excess_of_tracks_as_it_is() -> None:
    rng = np.random.default_rng(7)
    problem = joint(10, 1, 120)
    seen = problem.observations
    drift = 0.3 * rng.standard_normal((len(problem.initial.points), 2))
    drifting = seen.pixels + np.where(
        problem.known[seen.point, None], 0.0, drift[seen.point] * np.sin(seen.frame)[:, None]
    )
    drifting_seen = replace(seen, pixels=drifting)
    problem = replace(problem, observations=drifting_seen)
    alone = compact(problem, drifting_seen.subset(~problem.known[seen.point]))
    with_a_blurred_board = replace(
        problem,
        observations=replace(
            problem.observations,
            relative_sigma=np.where(problem.known[seen.point], 300.0, 1.0),
        ),
    )
    with_board, without = errors_of(with_a_blurred_board)[0], errors_of(alone)[0]
    trace = [float(np.trace(_of_tracks(shared))) for shared in (with_board, without)]
    assert trace[0] == pytest.approx(trace[1], rel=0.25)


def misprinted(sigma_m: float) -> Problem:
    """Views of a board whose corners are not quite where they are said to be."""
    rng = np.random.default_rng(5)
    board = flat_board()
    off = np.append(sigma_m * rng.standard_normal((48, 2)), np.zeros((48, 1)), axis=1)
    printed = replace(board, corners=board.corners + off)
    problem, _ = waved(rng, 25, 0.1, [camera("one")], [Transform.identity()], printed)
    assert problem.board is not None
    return replace(problem, board=replace(problem.board, board=board))


def test_corners_that_are_printed_wrongly_err_together() -> None:
    wrong, n = errors_of(misprinted(2e-4))
    right, _ = errors_of(misprinted(0.0))
    assert np.trace(_of_corners(wrong)) > 2 * n
    assert abs(np.trace(_of_corners(right))) < n
    assert len(wrong.by_corner) == 48 and wrong.by_corner.any(axis=1).all()


def test_what_corners_share_is_added_to_the_covariance() -> None:
    found = refine(misprinted(2e-4), GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    root, whiten = _of_data(covariance.basis)
    points = homogeneous(found.graph.tracks, found.estimate.points)
    with threads() as pool:
        shared = shared_errors(
            found.graph, found.graph.variables(found.values), points,
            covariance.basis.response @ whiten.T, pool,
        )  # fmt: skip
    parts = _of_frames(shared) + _of_tracks(shared) + _of_corners(shared) + _of_cells(shared)
    expected = _widened(covariance.basis, root, parts).matrix
    np.testing.assert_allclose(covariance.stated.matrix, expected, rtol=1e-9)
    without = _widened(covariance.basis, root, parts - _of_corners(shared))
    assert covariance.stated.sigma["one.fx"] > 1.1 * without.sigma["one.fx"]


def test_numbers_that_boards_leave_to_be_determined() -> None:
    """A board's frames have a world each, its corners are given; a scan's world is free."""
    boards, _ = waved(np.random.default_rng(0), 12)
    lenses_and_rig = 2 * 8 + 6
    assert free_dimensions(boards) == lenses_and_rig + 6 * 12
    problem = joint(10, 3)
    scene = int((~problem.known[np.unique(problem.observations.point)]).sum())
    assert free_dimensions(problem) == lenses_and_rig + 6 * 13 + 3 * scene - 6
    seen = problem.observations
    one = (seen.frame < 10) | (seen.camera == 0)
    alone = replace(problem, observations=seen.subset(one))
    assert free_dimensions(alone) == lenses_and_rig + 6 * 13 + 3 * scene - 7


def test_corners_of_few_in_a_frame_are_fitted_to_more() -> None:
    problem, _ = waved(np.random.default_rng(0), 10, seen=0.3)
    in_frame = np.bincount(problem.observations.frame)[problem.observations.frame]
    left = redundancies(problem)
    np.testing.assert_allclose(left / left[0], (1 - 3 / in_frame) / (1 - 3 / in_frame[0]))
    assert left.mean() == pytest.approx(redundancy(problem))


def test_sizes_of_keypoints_are_no_class_of_corners() -> None:
    problem = joint(8, 3)
    known = problem.known[problem.observations.point]
    size = np.where(known, np.nan, 4.0)
    problem = replace(problem, observations=replace(problem.observations, feature_scale=size))
    classes = noise_classes(problem, np.ones((len(known), 2)))
    assert [(one.camera, one.of_board) for one in classes] == [
        (0, True), (0, False), (1, True), (1, False),
    ]  # fmt: skip
    assert sum(one.count for one in classes if one.of_board) == known.sum()
    assert sum(one.count for one in classes) == len(known)

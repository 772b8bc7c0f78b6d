"""Corners by hand, and the whole normal equations of a board against differences."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from synthetic.boards import SQUARE_M, camera, flat_board, stereo, waved
from test_boards_graph import still_board, vector_values

from graphs.board_problem import SeenCorners, beside, board_problem, observed
from graphs.board_shape import shape_sigmas
from graphs.boards import corners_of
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.clusters import homogeneous
from graphs.frames import FloatArray, Transform
from graphs.keys import board_key, lens_key, rig_key, shape_key
from graphs.noise import loss_moments
from graphs.problem import Board, Problem, residuals_px
from graphs.solve import solve
from graphs.system import System, assemble
from graphs.threads import threads
from graphs.tracks import triangulate

SHAPE = np.array([0.2, 0.004, -0.007])


def test_the_middle_of_a_bent_board_stands_out() -> None:
    """By one bend against the edges left and right, by the other against those above and below."""
    board = flat_board()
    corners = board.corners.reshape(6, 8, 3)
    bent = corners_of(board, SHAPE)[0].reshape(6, 8, 3)
    size = np.exp(0.2)
    np.testing.assert_allclose(bent[..., :2], size * corners[..., :2])
    np.testing.assert_allclose(bent[[0, 0, -1, -1], [0, -1, 0, -1], 2], 0.0, atol=1e-15)
    half = np.array([3.5, 2.5])
    for row, column in ((0, 3), (2, 0), (3, 5)):
        off = (np.array([column, row]) - half) / half
        expected = size * (0.004 * (1 - off[0] ** 2) - 0.007 * (1 - off[1] ** 2))
        assert bent[row, column, 2] == pytest.approx(expected)
    assert np.linalg.norm(bent[0, 1, :2] - bent[0, 0, :2]) == pytest.approx(size * SQUARE_M)


def test_corners_follow_the_shape() -> None:
    board, step = flat_board(), 1e-6
    by_shape = corners_of(board, SHAPE)[1]
    for column in range(3):
        by = step * np.eye(3)[column]
        numeric = (corners_of(board, SHAPE + by)[0] - corners_of(board, SHAPE - by)[0]) / (2 * step)
        np.testing.assert_allclose(by_shape[:, :, column], numeric, atol=1e-9)


def system_at(graph: CalibrationGraph, values: gtsam.Values) -> System:
    with threads() as pool:
        variables = graph.variables(values)
        start = homogeneous(graph.tracks, graph.problem.initial.points)
        points = triangulate(graph.tracks, variables, start, pool, 1e-15)[0]
        others = graph.others.linearize(values)
        return assemble(graph.tracks, others, graph.layout, variables, points, pool)


def exact(which: str) -> Problem:
    """Without noise, at its optimum: there, normal equations are second derivatives."""
    if which != "waved":
        problem, truth = still_board(0.0, SHAPE * [1, 10, 10])
        assert problem.board is not None
        board = replace(problem.board.board, shape_mean=SHAPE * [1, 10, 10])
        start = replace(problem.initial, board_shape=board.shape_mean)
    else:
        one = camera("one")
        both = (one, replace(one, name="two"))
        board = replace(flat_board((1e-2, 1e-2, 1e-2)), shape_mean=SHAPE)
        problem, truth = waved(
            np.random.default_rng(0), 40, 0.0, both, stereo()[1], board, SHAPE.tolist()
        )
        start = truth
    assert problem.board is not None
    problem = replace(problem, initial=start, board=replace(problem.board, board=board))
    return waved_too(problem) if which == "both" else problem


def waved_too(problem: Problem) -> Problem:
    """The board of a scene, all a twentieth of its size, waved before the rig at other times."""
    assert problem.board is not None and problem.initial.board_shape is not None
    big, by = problem.board.board, np.array([1, 0.05, 0.05])
    shape = problem.initial.board_shape * by
    board = Board(big.corners / 20, big.shape_mean * by, big.shape_sigma * by)
    start = replace(problem.initial.scaled(0.05), board_shape=shape)
    problem = replace(problem, initial=start, board=replace(problem.board, board=board))
    boards, _ = waved(
        np.random.default_rng(0), 4, 0.0, start.cameras, start.cam_from_rig, board, shape.tolist()
    )
    return beside(problem, replace(boards, initial=replace(boards.initial, board_shape=shape)))


@pytest.mark.slow
@pytest.mark.parametrize("which", ["still", "waved", "both"])
def test_normal_equations_are_those_of_finite_differences(which: str) -> None:
    """A step by a column of the inverse makes a gradient of one in that column, and in no other:
    more than a chunk of corners, two cameras of one lens, a board that is bent."""
    problem = exact(which)
    shared = ((0, 1),) if which == "waved" else ()
    graph = build(problem, GraphOptions(0.2, "none", np.inf, shared_lenses=shared))
    system = system_at(graph, graph.initial)
    keys = [shape_key(), lens_key(0), rig_key(1)] + ([] if which == "waved" else [board_key()])
    columns = np.concatenate([graph.layout.columns(key) for key in keys])
    unit = np.zeros((len(system.gradient), len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    inverse = system.factorise().solve(unit)
    sigma = np.sqrt(1 / system.diagonal)
    for column, by in zip(columns, inverse.T, strict=True):
        step = 1e-3 / np.abs(by / sigma).max()
        ends = [
            system_at(graph, graph.initial.retract(vector_values(graph, sign * step * by))).gradient
            for sign in (1, -1)
        ]
        gradient = (ends[0] - ends[1]) / (2 * step)
        wanted = np.zeros(len(by))
        wanted[column] = 1.0
        off = (gradient - wanted) * sigma / sigma[column]
        assert np.abs(off).max() < 2e-3


def test_the_sigma_of_the_shape_is_that_of_the_data_and_of_what_is_stated() -> None:
    board = replace(flat_board((2e-3, 5e-4, 1e-2)))
    problem, _ = waved(np.random.default_rng(2), 10, 0.2, board=board)
    graph = build(problem, GraphOptions(0.2, "cauchy", 2.5))
    estimate, values, _ = solve(graph)
    system = system_at(graph, values)
    moments = loss_moments(problem, graph.options, residuals_px(estimate, problem.observations))
    stated, wider = (shape_sigmas(graph, estimate, values, by) for by in (1.0, 2.0))
    assert stated[0] == pytest.approx(2e-3, rel=1e-3)  # a board alone says nothing of its size
    assert wider[0] == pytest.approx(2e-3, rel=1e-2)
    from_data = (wider**2 - stated**2) / 3
    assert from_data[2] == pytest.approx(stated[2] ** 2, rel=0.03)  # nothing else says so much
    assert 0 < from_data[1] < stated[1] ** 2
    # Of the bend that the board's own statement leaves open: all but all is the data's.
    columns = graph.layout.columns(shape_key())
    unit = np.zeros(len(system.gradient))
    unit[columns[2]] = 1.0
    of_model = system.factorise().solve(unit)[columns[2]] ** 0.5
    share = moments.score_variance**0.5 / moments.curvature
    assert stated[2] == pytest.approx(of_model * share, rel=0.03)
    assert share < 0.95 or share > 1.05


def test_corners_are_weighed_among_each_other() -> None:
    """What detection does not tell, all of them share."""
    told, untold = np.array([0.02, 0.04, 0.8]), 0.07
    sigma_px, expected = told, np.hypot(told, untold)
    none = np.zeros(3, np.int64)
    seen = SeenCorners(np.zeros((3, 2)), none, none, np.arange(3), sigma_px)
    assert observed(seen, np.arange(3)).relative_sigma == pytest.approx(expected / expected[1])
    problem = board_problem(
        flat_board(), seen, [camera("one")], [Transform.identity()], [Transform.identity()],
        ["a"], 0,
    )  # fmt: skip
    corners: FloatArray = problem.initial.points[problem.observations.point]
    np.testing.assert_allclose(corners, flat_board().corners[:3])

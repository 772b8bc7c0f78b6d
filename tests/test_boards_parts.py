"""Parts of a problem with a board: blocks of frames, halves, and frames that give the unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.boards import flat_board, waved
from synthetic.problems import small_problem
from test_boards_graph import still_board

from graphs.board_problem import beside
from graphs.build import GraphOptions, build
from graphs.gauge import _name
from graphs.held_out import held_out_costs
from graphs.jackknife import blocks_of, solve_part
from graphs.keys import board_key, shape_key
from graphs.model_covariance import model_covariance
from graphs.problem import KnownBaseline, Problem
from graphs.refine import refine
from graphs.selection import compact
from graphs.solve import solve
from graphs.split_check import split_check
from graphs.stated_covariance import calibration_covariance

METRE = KnownBaseline((0, 1), 0.2, 1e-3)
KEYS = {"size": shape_key(), "place": board_key()}


def joint(n_scan: int, n_boards: int, n_points: int = 60) -> Problem:
    """A scan by two cameras, and views of a board that both see at once."""
    scan, truth = small_problem(
        "radtan", cameras=2, frames=n_scan, points=n_points, sigma_px=0.2, start_error=0.0
    )
    board = flat_board()
    boards, _ = waved(
        np.random.default_rng(5), n_boards, 0.2, truth.cameras, truth.cam_from_rig,
        board=type(board)(4 * board.corners, board.shape_mean, board.shape_sigma),
    )  # fmt: skip
    return beside(scan, boards)


@pytest.mark.parametrize(("n_scan", "n_boards"), [(5, 1), (3, 3), (4, 1), (5, 3), (20, 2)])
def test_no_block_is_empty(n_scan: int, n_boards: int) -> None:
    block = blocks_of(joint(n_scan, n_boards, 30))
    assert set(block) == set(range(block.max() + 1))
    assert (np.diff(block[:n_scan]) >= 0).all() and (np.diff(block[n_scan:]) >= 0).all()


def test_halves_one_of_which_has_no_board_are_compared() -> None:
    """Both lean on the same priors, that on the board's shape among them."""
    problem = joint(14, 2)
    second = blocks_of(problem) % 2 == 1
    assert not second[-2:].any()
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    frames = found.problem.frames_of_scale
    solved = solve_part(found.graph, found.estimate, covariance.basis, second, 1.0)
    assert frames.tolist() == [14, 15] and solved is not None
    part = solved[1]
    assert part.of_priors.shape == covariance.basis.of_priors.shape
    index = covariance.basis.names.index("cam1.translation_x")
    # Metres come from the two frames that both halves keep.
    assert part.matrix[index, index] > 1.05 * covariance.basis.matrix[index, index]
    check = split_check(found.graph, found.estimate, covariance, 1.0)
    assert check is not None and check.agrees


def test_halves_of_a_scan_without_a_metre_need_no_board_in_both() -> None:
    problem = joint(16, 2)
    seen = problem.observations
    apart = (seen.frame < 16) | (seen.camera == seen.frame % 2)  # one camera at a time
    problem = replace(problem, observations=seen.subset(apart))
    assert not problem.metric
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    check = split_check(found.graph, found.estimate, covariance, 1.0)
    assert check is not None and check.agrees


def test_what_tells_the_metre_stays_when_its_block_is_left_out() -> None:
    """Else a part would hold the size where it is, and seem sure of it."""
    problem = joint(16, 2)
    found = refine(problem, GraphOptions(), 1.0)
    model = calibration_covariance(found.graph, found.estimate, found.values).basis
    without = np.arange(18) < 16
    solved = solve_part(found.graph, found.estimate, model, without, 1.0)
    assert solved is not None
    np.testing.assert_allclose(solved[0], 0.0, atol=1e-3)  # nothing was left out after all
    both = solve_part(found.graph, found.estimate, model, np.arange(18) != 16, 1.0)
    assert both is not None and np.abs(both[0]).max() > 1e-3


def test_a_board_that_no_frame_is_left_of_has_no_place() -> None:
    """Its shape is known from other views of it; a place would be determined by nothing."""
    still = still_board()[0]
    camera = still.initial
    waved_too, _ = waved(
        np.random.default_rng(1), 2, 0.2, camera.cameras, camera.cam_from_rig,
        board=still.board.board if still.board else None,
    )  # fmt: skip
    problem = beside(still, waved_too)
    assert problem.board is not None
    seen = problem.observations
    kept = compact(problem, seen.subset(~problem.board.still[seen.point]))
    assert kept.initial.world_from_board is None and kept.initial.board_shape is not None
    assert solve(build(kept, GraphOptions()))[2].converged


def test_one_image_of_a_board_that_stands_gives_no_metre() -> None:
    problem = still_board()[0]
    assert problem.board is not None
    seen = problem.observations
    still = problem.board.still[seen.point]
    one = replace(
        problem,
        observations=seen.subset(~still | ((seen.frame == 2) & (seen.camera == 1))),
    )
    two = replace(problem, observations=seen.subset(~still | (seen.frame == 2)))
    assert problem.metric and two.metric and not one.metric
    assert two.frames_of_scale.tolist() == [2]
    found = refine(one, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    assert covariance.basis.unit_camera == 1


@pytest.mark.parametrize("which", ["still", "waved"])
def test_frames_held_out_see_the_board_where_the_others_have_it(which: str) -> None:
    """Not where their own corners were when all frames were solved for."""
    if which == "still":
        problem, _ = still_board()
    else:
        problem, _ = waved(np.random.default_rng(3), 6, 0.2)
    found = refine(problem, GraphOptions(), 1.0)
    solved, options = replace(found.problem, initial=found.estimate), found.graph.options
    elsewhere = found.estimate.points + np.where(solved.known[:, None], [0.002, 0.0, 0.004], 0.0)
    moved = replace(solved, initial=replace(found.estimate, points=elsewhere))
    costs, others = held_out_costs(solved, options, 3), held_out_costs(moved, options, 3)
    np.testing.assert_allclose(costs, others, rtol=1e-3, atol=1e-3)
    corners = solved.known[solved.observations.point]
    assert np.isfinite(costs[corners]).all()
    assert costs[corners].mean() < 1.6  # halves of squares of two coordinates: 1


def test_what_is_undetermined_of_a_board_is_named() -> None:
    problem, _ = still_board()
    assert problem.board is not None
    seen = problem.observations
    scene = problem.observations.subset(~problem.known[seen.point])
    graph = build(replace(problem, observations=scene, scales=(METRE,)), GraphOptions())
    with pytest.raises(ValueError, match="of the board in the scene"):
        model_covariance(graph, problem.initial, graph.initial)
    place = {name: graph.layout.columns(key)[0] for name, key in KEYS.items()}
    assert _name(problem, graph.layout, place["size"]) == "the size of the board"
    assert _name(problem, graph.layout, place["size"] + 2) == "the bend of the board"
    assert _name(problem, graph.layout, place["place"]) == "the rotation of the board in the scene"

"""Parts of a problem with a board: blocks of frames, halves, and frames that give the unit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic.boards import camera, flat_board, waved
from synthetic.problems import small_problem
from test_boards_graph import still_board

from graphs.board_problem import beside
from graphs.boards import corners_of
from graphs.budget import within_budget
from graphs.build import GraphOptions, build
from graphs.frames import Transform
from graphs.gauge import _name, choose_gauge
from graphs.held_out import held_out_costs
from graphs.jackknife import _of_scale, blocks_of, solve_part
from graphs.keys import board_key, shape_key
from graphs.ladder import thinned
from graphs.model_covariance import model_covariance
from graphs.motion import views_of
from graphs.observability import observe
from graphs.problem import KnownBaseline, KnownPath, Problem, points_in_cameras, residuals_px
from graphs.refine import refine
from graphs.selection import compact, select_tracks
from graphs.solve import solve
from graphs.split_check import split_check
from graphs.stated_covariance import calibration_covariance
from graphs.twin import twin_problem
from sfm_calib.scale_ledger import ledger_of

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
    rig = still.initial
    waved_too, _ = waved(
        np.random.default_rng(1), 2, 0.2, rig.cameras, rig.cam_from_rig,
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


def test_corners_are_kept_where_one_camera_sees_enough_of_them() -> None:
    """Six of one camera place the board for all; five of each of two cameras do not."""
    problem, _ = waved(np.random.default_rng(3), 3, 0.2)
    seen = problem.observations
    number = np.zeros(len(seen), np.int64)
    for frame in range(3):
        for index in range(2):
            rows = np.flatnonzero((seen.frame == frame) & (seen.camera == index))
            number[rows] = np.arange(len(rows))
    most = np.array([[5, 5], [6, 3], [4, 6]])
    few = replace(problem, observations=seen.subset(number < most[seen.frame, seen.camera]))
    kept = select_tracks(few, 1.0)
    assert kept.frame_names == problem.frame_names[1:]
    counts = np.zeros((2, 2), np.int64)
    np.add.at(counts, (kept.observations.frame, kept.observations.camera), 1)
    assert counts.tolist() == [[6, 3], [4, 6]]


@pytest.mark.slow
def test_no_budget_and_no_lot_takes_corners_away() -> None:
    problem = joint(4, 2, 250)
    known = problem.known[problem.observations.point]
    tracks, corners = np.count_nonzero(~known), np.count_nonzero(known)
    same, budget = within_budget(problem, GraphOptions(0.2), int(tracks))
    assert budget is None and same is problem  # corners are beyond the number
    fewer, budget = within_budget(problem, GraphOptions(0.2), int(corners) + 100)
    assert budget is not None and budget.available == len(known)
    thin = thinned(problem, len(known) // 3)
    for part in (fewer, thin):
        left = part.known[part.observations.point]
        assert np.count_nonzero(left) == corners and np.count_nonzero(~left) < tracks


def test_the_lot_draws_no_corners() -> None:
    problem, _ = waved(np.random.default_rng(1), 8, 0.2)
    assert np.bincount(problem.observations.frame).max() > 80  # else frames keep all they have
    thin = thinned(problem, 4 * len(problem.observations) // 5)
    assert len(thin.observations) == len(problem.observations)


def test_the_only_frame_with_a_board_is_not_left_out() -> None:
    problem = joint(10, 1)
    seen = problem.observations
    problem = replace(problem, observations=seen.subset((seen.frame < 10) | (seen.camera == 0)))
    assert not problem.metric
    assert _of_scale(problem).tolist() == [10]
    assert _of_scale(joint(10, 2)).size == 0


def test_views_are_judged_by_the_board_alone_or_by_the_scene_alone() -> None:
    boards, truth = waved(np.random.default_rng(1), 12, 0.2)
    for index, views in enumerate(views_of(boards)):
        rows = boards.observations.camera == index
        away = np.linalg.norm(points_in_cameras(truth, boards.observations)[rows], axis=1)
        assert views.distance == pytest.approx(np.median(away), rel=1e-3)
        assert views.parallax_deg > 30 and views.relief < 1e-9  # one board, seen from all sides
    problem = joint(8, 2)
    scan = compact(problem, problem.observations.subset(problem.observations.frame < 8))
    for mixed, alone in zip(views_of(problem), views_of(scan), strict=True):
        assert mixed.parallax_deg == pytest.approx(alone.parallax_deg)
        assert mixed.distance == pytest.approx(alone.distance)
        assert mixed.relief == pytest.approx(alone.relief)


def test_a_scene_in_other_units_has_a_board_of_another_size() -> None:
    problem, truth = still_board(0.0)
    twice = truth if truth.board_shape is not None else problem.initial
    before = residuals_px(twice, problem.observations)
    scaled = twice.scaled(2.0)
    assert scaled.board_shape is not None and scaled.world_from_board is not None
    assert problem.board is not None
    places = scaled.world_from_board @ corners_of(problem.board.board, scaled.board_shape)[0]
    known = problem.known
    np.testing.assert_allclose(places[problem.board.corner[known]], scaled.points[known])
    np.testing.assert_allclose(residuals_px(scaled, problem.observations), before, atol=1e-9)


def test_the_twins_board_is_stated_with_an_error_of_its_sigma() -> None:
    shape = np.array([0.02, 3e-3, -2e-3])
    sigma = np.array([4e-3, 1e-3, 0.0])
    problem, _ = waved(np.random.default_rng(3), 6, 0.2, board=flat_board(sigma), shape=shape)
    found = refine(replace(problem, initial=replace(problem.initial)), GraphOptions(), 1.0)
    found = replace(found, estimate=replace(found.estimate, board_shape=shape))
    rng = np.random.default_rng(0)
    stated = []
    for _ in range(200):
        board = twin_problem(found, rng).board
        assert board is not None
        stated.append(board.board.shape_mean)
    off = np.array(stated) - shape
    assert np.abs(off.mean(0)).max() < 4 * sigma.max() / 200**0.5
    np.testing.assert_allclose(off.std(0), sigma, rtol=0.2)


def test_every_block_takes_its_share_of_both_kinds() -> None:
    block = blocks_of(joint(20, 10, 30))
    assert np.bincount(block[:20]).tolist() == [2] * 10
    assert np.bincount(block[20:]).tolist() == [1] * 10


def test_the_gauge_holds_frames_of_the_scene() -> None:
    problem = joint(6, 2, 40)
    far = Transform.exp(np.zeros(3), np.array([0.0, 0.0, 100.0]))
    start = problem.initial
    placed = (*start.rig_from_world[:6], *(far @ one for one in start.rig_from_world[6:]))
    gauge = choose_gauge(replace(problem, initial=replace(start, rig_from_world=placed)))
    assert gauge is not None and gauge.distance < 50
    assert gauge.frame < 6 and (gauge.frames is None or max(gauge.frames) < 6)


def test_a_board_cuts_each_front_in_two_at_most() -> None:
    """Each part holds a matrix of the whole front."""
    problem = still_board()[0]
    graph = build(problem, GraphOptions())
    fronts = [cluster.front for cluster in graph.tracks.clusters]
    kinds = [cluster.corner is not None for cluster in graph.tracks.clusters]
    assert len(fronts) == len(set(zip(fronts, kinds, strict=True))) > max(fronts) + 1


@pytest.mark.parametrize("stated", [1.0, 0.95])
def test_squares_and_a_baseline_are_held_against_each_other(stated: float) -> None:
    """Squares stated 5 % too small: by the baseline they are larger, by them it is shorter."""
    problem = joint(8, 4)
    assert problem.board is not None
    length = float(np.linalg.norm(problem.initial.cam_from_rig[1].translation))
    ends = [problem.initial.rig_from_world[frame].inverse.translation for frame in (0, 7)]
    way = float(np.linalg.norm(ends[1] - ends[0]))
    board = problem.board.board
    small = replace(board, corners=stated * board.corners, shape_sigma=np.array([2e-3, 0.0, 0.0]))
    problem = replace(
        problem,
        board=replace(problem.board, board=small),
        scales=(
            KnownBaseline((0, 1), length, 2e-3 * length),
            KnownPath((0, 7), way, 2e-3 * way),
        ),
    )
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    described = SimpleNamespace(board=SimpleNamespace(unit_m=0.12 * stated))
    run = SimpleNamespace(refinement=found, covariance=covariance, board=described)
    ledger = ledger_of(run)  # type: ignore[arg-type]
    baseline, path, squares = ledger.entries
    assert squares.name == f"square of the board ({120 * stated:g} mm)"
    assert squares.measured_m == pytest.approx(0.12 * stated)
    assert squares.sigma_m == pytest.approx(2e-3 * squares.measured_m)
    assert squares.predicted_m == pytest.approx(0.12, rel=0.01)
    assert squares.z is not None and baseline.z is not None and path.z is not None
    if stated < 1:
        assert squares.contradicts and squares.z < -10 and baseline.z > 5 and path.z > 5
        assert ledger.suspects == (2,)
        assert squares.measured_m < squares.estimated_m < 0.12
    else:
        assert not ledger.contradicted


def test_what_one_view_of_a_board_leaves_open_is_for_the_board_to_show() -> None:
    problem, _ = waved(np.random.default_rng(0), 2, 0.2, [camera("one")], [Transform.identity()])
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    told = observe(found.graph, found.estimate, covariance.stated, covariance.model)
    focal = [one for one in told.weak if one.kind.startswith("focal")]
    assert focal and all("tilt the board" in one.remedy for one in focal)

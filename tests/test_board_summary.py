"""What is said of a board: how well its shape is known, its figures, and its row in the ledger."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from synthetic.anchors import BOARD, board_views, outcome_of, places_before, solved_scan
from synthetic.boards import flat_board, stereo, waved
from test_result import rig

from graphs.board_shape import shape_sigmas
from graphs.build import GraphOptions, build
from graphs.factors import factor_graph
from graphs.frames import FloatArray
from graphs.keys import shape_key
from graphs.noise import loss_moments
from graphs.problem import Estimate, KnownBaseline, KnownPath, Problem, residuals_px
from graphs.refine import refine
from graphs.solve import solve
from graphs.system import jacobian_of
from sfm_calib.anchors import SeenBoards, anchored
from sfm_calib.board_record import BoardResult, Without
from sfm_calib.report.board import board_lines, board_section, corners_figure, gains, outline
from sfm_calib.result import Calibration, Noise, Sigmas

SIGMA_PX = 0.3
BEND = 2e-4  # m; noise alone would leave about as much

# ---- how well the shape is known -----------------------------------------------------------


@pytest.mark.parametrize("n_cameras", [1, 2])
@pytest.mark.parametrize(("loss", "scale"), [("none", np.inf), ("cauchy", 1.5)])
def test_a_dense_inverse_has_the_same_sigmas_of_the_shape(loss, scale, n_cameras):
    """H^-1 (4 s D + P) H^-1, H = k D + P, with D of GTSAM's own factors and P of the priors."""
    cameras, cam_from_rig = (some[:n_cameras] for some in stereo())
    rng = np.random.default_rng(0)
    problem, _ = waved(rng, 5, SIGMA_PX, cameras, cam_from_rig, flat_board((1e-3, BEND, BEND)))
    graph = build(problem, GraphOptions(SIGMA_PX, loss, scale))
    estimate, values, _ = solve(graph)
    unweighed = factor_graph(replace(graph, options=GraphOptions(SIGMA_PX, "none", np.inf)))
    first = graph.layout.first_column
    ordering = gtsam.Ordering()
    for key in sorted(first, key=lambda key: first[key]):
        ordering.push_back(key)
    every = unweighed.linearize(values).jacobian(ordering)[0]
    priors = jacobian_of(graph.others.linearize(values), graph.layout)[0].toarray()
    P = priors.T @ priors
    D = every.T @ every - P
    moments = loss_moments(problem, graph.options, residuals_px(estimate, problem.observations))
    inverse = np.linalg.inv(moments.curvature * D + P)
    covariance = inverse @ (4 * moments.score_variance * D + P) @ inverse
    expected = np.sqrt(np.diag(covariance))[graph.layout.columns(shape_key())]
    found = shape_sigmas(graph, estimate, values, inflation=2.0)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert found[0] == pytest.approx(1e-3, rel=1e-3)  # nothing else tells how large it is
    assert 0.2 * BEND < found[1] < 1.2 * BEND  # priors and data both count


@pytest.mark.slow
def test_errors_of_the_shape_are_as_large_as_it_is_said():
    """20 boards bent by chance, size and bends: mean square 1 of 60, to 4 sigmas of that."""
    board, rng, z = flat_board((1e-3, BEND, BEND)), np.random.default_rng(5), []
    for _ in range(20):
        true = board.shape_sigma * rng.standard_normal(3)
        problem, _ = waved(rng, 4, SIGMA_PX, board=board, shape=true.tolist())
        found = refine(problem, GraphOptions(), 1.0)
        sigma = shape_sigmas(found.graph, found.estimate, found.values)
        assert found.estimate.board_shape is not None
        z.append((found.estimate.board_shape - true) / sigma)
    assert np.mean(np.square(z)) == pytest.approx(1, abs=4 * (2 / 60) ** 0.5)


# ---- the report ----------------------------------------------------------------------------


def test_the_outline_is_what_a_band_around_the_points_is():
    inner = np.random.default_rng(0).uniform(1, 3, (50, 2))
    square = np.array([[0.0, 0], [4, 0], [4, 4], [0, 4]])
    along = np.array([[2.0, 0], [4, 1]])  # on its edges
    found = outline(np.concatenate([inner, square, along]))
    np.testing.assert_array_equal(found[0], found[-1])
    assert sorted(map(tuple, found[:-1].tolist())) == sorted(map(tuple, square.tolist()))
    x, y = found.T
    assert abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1])) / 2 == 16


def arrows(problem: Problem, truth: Estimate) -> tuple[FloatArray, FloatArray, float]:
    """Where the arrows start (n, 2), where they end, and their factor."""
    figure, factor = corners_figure(problem, truth)
    lines = np.column_stack([figure.data[0].x, figure.data[0].y]).astype(float)
    ends = lines[np.isfinite(lines[:, 0])].reshape(-1, 2, 2)
    return ends[:, 0], ends[:, 1], factor


def test_arrows_point_to_where_corners_lie():
    problem, truth = waved(np.random.default_rng(1), 6, 0.0)
    assert problem.board is not None
    off = np.zeros((len(problem.board.board.corners), 3))
    off[10] = 5e-4, -2.5e-4, 1e-3
    moved = replace(truth, board_shape=np.concatenate([np.zeros(3), off.ravel()]))
    start, end, factor = arrows(problem, moved)
    np.testing.assert_allclose(start, 1e3 * problem.board.board.corners[:, :2], atol=1e-3)
    np.testing.assert_allclose((end - start)[10] / factor, [0.5, -0.25], rtol=1e-3)
    assert np.abs(np.delete(end - start, 10, axis=0)).max() < 1e-3
    # of 48 arrows one is not zero: the typical one is a seventh of it
    assert 0.02 < np.linalg.norm(end[10] - start[10]) / 48**0.5 / 210 < 0.08


def with_board(**changes: object) -> Calibration:
    board = BoardResult(
        description="a checkerboard", n_images={"left": 4, "right": 0},
        n_corners={"left": 160, "right": 0}, sigma_px={"left": 0.05},
    ).model_copy(update=changes)  # fmt: skip
    names = ("left.fx", "right.rotation_x", "right.translation_y")
    sigmas = {n: Sigmas(model=0.0, robust=0.0, jackknife=None, stated=0.01) for n in names}
    noise = Noise(sigma_px=0.3, inflation=1.0, sigmas=sigmas, by_size={})
    return rig().model_copy(update={"board": board, "noise": noise})


def test_gains_are_told_in_degrees_and_not_without_a_metre():
    without = {
        "left.fx": Without(sigma=0.025, moved=-0.5),
        "right.rotation_x": Without(sigma=0.02, moved=0.01),
        "right.translation_y": Without(sigma=None, moved=None),
        "left.gone": Without(sigma=1.0, moved=0.0),
    }
    focal, turn, move = gains(with_board(without=without))
    assert (focal.name, focal.alone, focal.joint) == ("left.fx", "0.025", "0.010")
    assert focal.gain == "2.5 x" and float(focal.moved) == -0.5
    assert turn.name == "right.rotation_x (deg)" and turn.gain == "2.0 x"
    assert float(turn.alone) == pytest.approx(np.degrees(0.02), rel=0.05)
    assert float(turn.joint) == pytest.approx(np.degrees(0.01), rel=0.05)
    assert float(turn.moved) == pytest.approx(np.degrees(0.01), rel=0.05)
    assert (move.alone, move.gain, move.moved) == ("no metre", "", "")
    assert gains(with_board()) == () and gains(rig()) == ()


def test_lines_tell_what_was_seen_and_a_bend_that_is_noticed():
    (seen,) = board_lines(with_board().board)
    assert seen == "board: a checkerboard, in images of its own: left 4 images with 160 corners " \
        "(0.050 px)"  # fmt: skip
    bent = with_board(bend_mm=(1.5, 0.1), sigma_bend_mm=(0.2, 0.2), in_scan="still").board
    first, second = board_lines(bent)
    assert "standing in the scan" in first
    assert second == "the board is bent by 1.5 +- 0.2 mm between left and right"
    flat = with_board(bend_mm=(0.3, 0.1), sigma_bend_mm=(0.2, 0.1)).board
    assert board_lines(flat)[1:] == ["the board is flat to 0.20 mm"]
    larger = with_board(size=1.01, sigma_size=0.001).board
    assert board_lines(larger)[1:] == ["the board is +1.00 +- 0.10 % larger than stated"]


def test_there_is_a_panel_of_each_camera_that_saw_it():
    problem, truth = waved(np.random.default_rng(1), 4, 0.1)
    section = board_section(with_board(left_out=("left/1: blurred",)), problem, truth)
    assert section is not None and section.left_out == ("left/1: blurred",)
    assert [panel.title for panel in section.panels] == ["Views of left"]
    off = replace(truth, board_shape=np.append(np.zeros(3), 1e-4 * np.ones(truth_corners(problem))))
    section = board_section(with_board(corners_off_mm=0.1), problem, off)
    assert section is not None
    assert [panel.title for panel in section.panels] == ["Where corners lie", "Views of left"]
    assert board_section(rig(), problem, truth) is None


def truth_corners(problem: Problem) -> int:
    assert problem.board is not None
    return int(problem.board.board.corners.size)


# ---- the ledger ----------------------------------------------------------------------------


def calibrated_with(*lengths: KnownBaseline | KnownPath) -> Calibration:
    """A scan with a board in images of its own, and these lengths."""
    scan = solved_scan()
    views = board_views(scan.truth, places_before(8, np.random.default_rng(1)), "abcdefgh")
    nothing = board_views(scan.truth, {}, ())
    problem, use = anchored(scan.alone, BOARD, SeenBoards(nothing, views, ()))
    return outcome_of(scan, replace(problem, scales=lengths), use).calibration


def tape(factor: float) -> KnownBaseline:
    true_m = float(np.linalg.norm(solved_scan().truth.cam_from_rig[1].translation))
    return KnownBaseline((0, 1), factor * true_m, 1e-3 * true_m)


@pytest.mark.slow
def test_of_three_lengths_the_wrong_one_is_named():
    truth = solved_scan().truth
    first, last = (truth.rig_from_world[i].inverse.translation for i in (0, -1))
    way_m = float(np.linalg.norm(last - first))
    path = KnownPath((0, len(truth.rig_from_world) - 1), way_m, 2e-3 * way_m)
    calibration = calibrated_with(tape(1.2), path)
    ledger = calibration.rig.scale.ledger
    assert [one.suspect for one in ledger] == [True, False, False]
    (said,) = [one for one in calibration.verdict.messages if "contradict" in one]
    assert said.startswith("the baseline cam0 to cam1 of") and "without it they agree" in said
    assert "and the square of the board (200 mm): by them it is" in said


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "agree"), [(1.0, True), (1.03, False)])
def test_a_board_stands_beside_other_lengths(factor, agree):
    calibration = calibrated_with(tape(factor))
    true_m = tape(1.0).length_m
    scale = calibration.rig.scale
    assert [one.what for one in scale.ledger] == [
        "baseline cam0 to cam1", "square of the board (200 mm)",
    ]  # fmt: skip
    baseline, square = scale.ledger
    assert scale.contradicted is not agree and baseline.contradicts is not agree
    said = [one for one in calibration.verdict.messages if "contradict" in one]
    assert baseline.predicted_by_others_m == pytest.approx(
        true_m, abs=4 * baseline.sigma_predicted_m
    )
    assert square.predicted_by_others_m == pytest.approx(
        factor * 0.2, abs=4 * square.sigma_predicted_m
    )
    if agree:
        assert said == []
    else:
        (line,) = said
        assert "baseline cam0 to cam1 of" in line and "square of the board (200 mm) of" in line
        assert "measure both again" in line

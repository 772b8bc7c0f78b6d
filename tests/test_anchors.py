"""A board that joins a scan: seen apart, waved, or standing in it, numbered from either end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.anchors import (
    BOARD,
    N_FRAMES,
    NAMES,
    Anchored,
    board_views,
    outcome_of,
    places_before,
    solved_scan,
    standing_before,
    turned_half,
)

from graphs.board_join import place_boards, still_board
from graphs.build import GraphOptions
from graphs.frames import Transform, angle_between
from graphs.jackknife import change
from graphs.problem import Problem
from graphs.refine import refine
from graphs.stated_covariance import CalibrationCovariance, calibration_covariance
from sfm_calib.anchors import OWN_FRAME, SeenBoards, anchored
from sfm_calib.board_use import BoardUse
from sfm_calib.boards.views import BoardViews


@pytest.fixture(scope="module")
def scan() -> Anchored:
    return solved_scan()


def nowhere(scan: Anchored) -> BoardViews:
    return board_views(scan.truth, {}, NAMES)


def joined(
    scan: Anchored, in_scan: BoardViews | None = None, apart: BoardViews | None = None
) -> tuple[Problem, BoardUse]:
    return anchored(scan.alone, BOARD, SeenBoards(in_scan or nowhere(scan), apart, ()))


def off(scan: Anchored, problem: Problem) -> tuple[np.ndarray, CalibrationCovariance]:
    """Every parameter's error at the joint optimum in its stated sigmas."""
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, 1.0)
    truth, estimate = scan.truth, found.estimate
    if not problem.metric:  # both in units of the baseline
        truth = truth.scaled(1 / np.linalg.norm(truth.cam_from_rig[1].translation))
        estimate = estimate.scaled(1 / np.linalg.norm(estimate.cam_from_rig[1].translation))
    error = change(truth, estimate, covariance.basis.names)
    sigma = np.array([covariance.stated.sigma[name] for name in covariance.basis.names])
    return error / sigma, covariance


# ---- in images of its own ------------------------------------------------------------------


@pytest.mark.slow
def test_a_board_that_two_cameras_see_at_once_gives_metres(scan):
    views = board_views(scan.truth, places_before(6, np.random.default_rng(1)), "abcdef")
    problem, use = joined(scan, apart=views)
    assert problem.metric and use.in_scan == "" and use.left_out == ()
    assert problem.frame_names == (*NAMES, *(OWN_FRAME + name for name in "abcdef"))
    assert problem.board_frames.tolist() == [False] * N_FRAMES + [True] * 6
    z, covariance = off(scan, problem)
    assert np.abs(z).max() < 4 and covariance.basis.unit_camera is None
    baseline_m = np.linalg.norm(scan.truth.cam_from_rig[1].translation)
    sigma = covariance.stated.sigma
    assert max(sigma[f"cam1.translation_{axis}"] for axis in "xyz") < 0.05 * baseline_m


@pytest.mark.slow
def test_a_board_that_one_camera_sees_at_a_time_gives_lenses_alone(scan):
    seen_by = {frame: [frame % 2] for frame in range(8)}
    places = places_before(8, np.random.default_rng(2))
    views = board_views(scan.truth, places, "abcdefgh", seen_by)
    problem, use = joined(scan, apart=views)
    assert not problem.metric and use.in_scan == "" and problem.board is not None
    assert problem.initial.cam_from_rig == scan.alone.estimate.cam_from_rig  # in its old unit
    z, covariance = off(scan, problem)
    assert np.abs(z).max() < 4 and covariance.basis.unit_camera == 1
    alone = calibration_covariance(
        scan.alone.graph, scan.alone.estimate, scan.alone.values, 1.0
    ).stated.sigma
    for name in ("cam0.fx", "cam0.cx", "cam1.fy", "cam1.k1"):
        assert covariance.stated.sigma[name] < 0.9 * alone[name]


def test_the_scale_of_a_rig_is_that_of_its_board(scan):
    """Of a scan in units of 2.5 m, and one of two groups of cameras tells nothing."""
    places = places_before(6, np.random.default_rng(1))
    known = BOARD.corners_m, BOARD.symmetries
    both = place_boards(
        scan.alone.estimate, board_views(scan.truth, places, "abcdef").views, *known
    )
    baseline = np.linalg.norm(scan.alone.estimate.cam_from_rig[1].translation)
    true_m = np.linalg.norm(scan.truth.cam_from_rig[1].translation)
    assert both.scale == pytest.approx(true_m / baseline, rel=0.05)
    for placed in both.frames:
        true = places[placed.frame]
        assert np.degrees(angle_between(placed.rig_from_board.rotation, true.rotation)) < 1
        apart_m = np.linalg.norm(placed.rig_from_board.translation - true.translation)
        assert apart_m < 0.02 * np.linalg.norm(true.translation)
    by_one = board_views(scan.truth, places, "abcdef", {frame: [1] for frame in range(6)})
    placed = place_boards(scan.alone.estimate, by_one.views, *known)
    assert placed.scale is None and len(placed.frames) == 6


# ---- in the scan ---------------------------------------------------------------------------


@pytest.mark.slow
def test_a_board_that_is_waved_in_the_scan(scan):
    views = board_views(scan.truth, places_before(N_FRAMES, np.random.default_rng(3)), NAMES)
    problem, use = joined(scan, views)
    assert use.in_scan == "waved" and problem.metric and use.left_out == ()
    assert problem.initial.world_from_board is None
    assert problem.board_frames.sum() == N_FRAMES
    assert np.abs(off(scan, problem)[0]).max() < 4


def check_standing(scan: Anchored, problem: Problem, use: BoardUse) -> None:
    assert use.in_scan == "still" and problem.metric
    assert not problem.board_frames.any() and problem.frame_names == NAMES
    start = problem.initial.world_from_board
    assert start is not None
    places = [
        problem.initial.rig_from_world[frame] @ start @ BOARD.corners_m for frame in range(N_FRAMES)
    ]
    true = [placed @ BOARD.corners_m for placed in standing_before(scan.truth).values()]
    assert (
        min(
            np.abs(np.array(places)[:, order] - np.array(true)).max()
            for order in (slice(None), BOARD.symmetries[0])
        )
        < 0.3
    )  # m, of a board 4.5 m away
    assert np.abs(off(scan, problem)[0]).max() < 4


def test_a_board_that_stands_in_the_scan(scan):
    problem, use = joined(scan, board_views(scan.truth, standing_before(scan.truth), NAMES))
    check_standing(scan, problem, use)


@pytest.mark.parametrize("which", ["a frame", "an image", "every other image"])
def test_a_standing_board_that_is_numbered_from_either_end(scan, which):
    views = board_views(scan.truth, standing_before(scan.truth), NAMES)
    turned = {
        "a frame": lambda i, view: view.frame == views.views[-1].frame,
        "an image": lambda i, view: i == 1,
        "every other image": lambda i, view: i % 2 == 1,
    }[which]
    mixed = [turned_half(v) if turned(i, v) else v for i, v in enumerate(views.views)]
    problem, use = joined(scan, replace(views, views=tuple(mixed)))
    check_standing(scan, problem, use)


def test_a_standing_board_seen_by_one_camera_gives_metres_by_the_way_past_it(scan):
    one = {frame: [0] for frame in range(N_FRAMES)}
    views = board_views(scan.truth, standing_before(scan.truth), NAMES, one)
    problem, use = joined(scan, views)
    check_standing(scan, problem, use)


@pytest.mark.slow
def test_a_board_stands_in_the_scan_and_is_seen_apart(scan):
    """Both tell the scale; the images apart come first."""
    apart = board_views(scan.truth, places_before(5, np.random.default_rng(4)), "abcde")
    standing = board_views(scan.truth, standing_before(scan.truth), NAMES)
    problem, use = joined(scan, standing, apart)
    assert use.in_scan == "still" and problem.metric and problem.board is not None
    assert problem.board_frames.tolist() == [False] * N_FRAMES + [True] * 5
    assert problem.board.still.sum() == len(BOARD.corners_m) * len(
        {view.frame for view in standing.views}
    )
    assert np.abs(off(scan, problem)[0]).max() < 4


def test_frames_that_the_scan_could_not_place_are_named(scan):
    """They would be waved boards of no scan; those that remain keep their own numbers."""
    names = ("lost", *NAMES)
    standing = {frame + 1: place for frame, place in standing_before(scan.truth).items()}
    places = {0: places_before(1, np.random.default_rng(5))[0]} | standing
    problem, use = joined(scan, board_views(scan.truth, places, names))
    assert use.left_out == (
        "cam0/lost: the scan has no place for it",
        "cam1/lost: the scan has no place for it",
    )
    (said,) = use.messages
    assert said.startswith("2 views of the board were left out: cam0/lost")
    check_standing(scan, problem, use)


# ---- whether it stood still ----------------------------------------------------------------


def placed_in(scan: Anchored, places: dict[int, Transform]):
    views = board_views(scan.truth, places, NAMES)
    return place_boards(scan.alone.estimate, views.views, BOARD.corners_m, BOARD.symmetries)


@pytest.mark.parametrize("knows_scale", [True, False])
def test_a_standing_board_has_one_place(scan, knows_scale):
    placed = placed_in(scan, standing_before(scan.truth))
    scale = placed.scale if knows_scale else None
    still = still_board(
        scan.alone.estimate, placed.frames, BOARD.corners_m, BOARD.symmetries, scale
    )
    assert still is not None
    ratio = np.linalg.norm(scan.truth.cam_from_rig[1].translation) / np.linalg.norm(
        scan.alone.estimate.cam_from_rig[1].translation
    )
    assert still.scale == pytest.approx(ratio, rel=0.05)


def _turned(place: Transform, deg: float) -> Transform:
    middle = BOARD.corners_m.mean(axis=0)
    turn = Transform.exp(np.radians(deg) * np.array([0, 1.0, 0]), np.zeros(3))
    about = Transform(turn.rotation, middle - turn.rotation @ middle)
    return place @ about


# From the rig to the board of `standing_before`, along the board's axes; it sways by 0.1 m.
BESIDE = Transform.exp(np.array([0.3, -0.25, 0.2]), np.zeros(3)).rotation.T @ [-0.7, -0.5, 4.5]
SWAY = 0.1 * np.random.default_rng(6).standard_normal((N_FRAMES, 3))
MOVED = {
    "turned in one frame": lambda i, place: _turned(place, 40 if i == 2 else 0),
    "turned in each frame": lambda i, place: _turned(place, 12 * i),
    "carried along": lambda i, place: Transform(place.rotation, np.array([-0.7, -0.4, 4.5])),
    "carried along, level": lambda i, place: Transform(
        place.rotation, place.rotation @ (BESIDE + SWAY[i])
    ),
}


@pytest.mark.parametrize("knows_scale", [True, False])
@pytest.mark.parametrize("how", MOVED)
def test_a_board_that_moved_has_none(scan, how, knows_scale):
    """Carried along by one who walks beside the rig, it faces one way: its places give it away."""
    places = {i: MOVED[how](i, place) for i, place in standing_before(scan.truth).items()}
    placed = placed_in(scan, places)
    assert len(placed.frames) >= 4
    scale = placed.scale if knows_scale else None
    known = BOARD.corners_m, BOARD.symmetries
    assert still_board(scan.alone.estimate, placed.frames, *known, scale) is None


def test_one_frame_shows_nothing(scan):
    placed = placed_in(scan, standing_before(scan.truth))
    known = BOARD.corners_m, BOARD.symmetries
    assert still_board(scan.alone.estimate, placed.frames[:1], *known, placed.scale) is None


# ---- what the board brought ----------------------------------------------------------------


@pytest.mark.slow
def test_the_result_says_what_the_scan_alone_does(scan):
    views = board_views(scan.truth, places_before(6, np.random.default_rng(1)), "abcdef")
    calibration = outcome_of(scan, *joined(scan, apart=views)).calibration
    board, noise = calibration.board, calibration.noise
    assert board is not None and noise is not None and calibration.rig.metric
    assert board.n_images == {"cam0": 6, "cam1": 6} and board.in_scan == ""
    alone = board.without
    assert set(alone) == set(calibration.covariance.names)
    for axis in "xyz":  # without a metre, no length is
        assert alone[f"cam1.translation_{axis}"].sigma is None
        assert alone[f"cam1.translation_{axis}"].moved is None
    before = scan.alone.estimate.cameras[0].named()
    for name in ("fx", "fy", "cx", "cy"):
        one, joint = alone[f"cam0.{name}"], noise.sigmas[f"cam0.{name}"].stated
        assert one.sigma is not None and one.moved is not None and joint < one.sigma
        own = calibration.cameras["cam0"].params[name] - one.moved
        assert abs(own - before[name]) < 0.02 * one.sigma < abs(one.moved)

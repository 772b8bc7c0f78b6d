"""Where board calibration starts with several cameras: who stands where, and what views mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from test_board_start import BOARD, NOISE_PX, View, grid, lens, seen

from graphs.board_start import BoardScene, BoardStart, start_from_board
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform, angle_between, exp_rotation
from graphs.lenses import IntArray

HALF_TURN: IntArray = np.arange(len(BOARD))[::-1]
SIZE = (960, 720)
PLAIN = lens("radtan", SIZE, 700, 700, 485, 352, -0.1, 0.05, 0, 0)
DISTANCE_M = 0.9


def looking_at_middle(angle_deg: float, height_m: float = 0.0) -> Transform:
    """cam_from_hall of a camera on a circle about the hall's origin, which it looks at."""
    angle = np.radians(angle_deg)
    place = np.array([DISTANCE_M * np.sin(angle), height_m, -DISTANCE_M * np.cos(angle)])
    z = -place / np.linalg.norm(place)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return Transform(rotation, -rotation @ place)


def beside(shift_m: float, turn_deg: float) -> Transform:
    """cam_from_hall of a camera beside the first one of a stereo pair."""
    turned = exp_rotation(np.array([0.0, np.radians(turn_deg), 0.0]))
    return Transform(turned, np.array([-shift_m, 0.0, 0.0])) @ looking_at_middle(0.0)


STEREO = (beside(0.0, 0.0), beside(0.12, 1.0))
RING = tuple(looking_at_middle(90.0 * i, 0.1 * (i % 2)) for i in range(4))


def waved(rng: np.random.Generator, towards_deg: float, tilt_deg: float = 35.0) -> Transform:
    """hall_from_board of a board near the origin, shown to a direction on the circle."""
    facing = exp_rotation(np.array([0.0, -np.radians(towards_deg), 0.0]))
    axis = rng.standard_normal(3) * np.array([1.0, 1.0, 0.5])
    tilt = exp_rotation(np.radians(rng.uniform(10, tilt_deg)) * axis / np.linalg.norm(axis))
    rotation = facing @ tilt
    return Transform(rotation, rng.uniform(-0.12, 0.12, 3) - rotation @ BOARD.mean(0))


def rig_views(
    cameras: Sequence[Camera],
    cam_from_hall: Sequence[Transform],
    hall_from_board: Sequence[Transform],
    rng: np.random.Generator,
    noise_px: float = NOISE_PX,
    least: int = 8,
) -> list[View]:
    """All views from before the board, less than 75 degrees off its normal."""
    views = []
    for frame, there in enumerate(hall_from_board):
        for index, (camera, place) in enumerate(zip(cameras, cam_from_hall, strict=True)):
            cam_from_board = place @ there
            middle = cam_from_board @ BOARD.mean(0)
            if cam_from_board.rotation[:, 2] @ middle < 0.26 * np.linalg.norm(middle):
                continue
            corner, pixels = seen(camera, cam_from_board, rng, noise_px=noise_px)
            if len(corner) >= least:
                views.append(View(index, frame, corner, pixels, np.full(len(corner), noise_px)))
    return views


def start(
    views: Sequence[View],
    n_cameras: int,
    symmetric: bool = False,
    known: dict[int, Camera] | None = None,
    reference: int = 0,
    board: FloatArray = BOARD,
) -> BoardStart:
    return start_from_board(
        BoardScene(
            views,
            board,
            [f"cam{i}" for i in range(n_cameras)],
            [SIZE] * n_cameras,
            (HALF_TURN,) if symmetric else (),
            known=known,
            reference=reference,
        )
    )


def check_rig(
    found: BoardStart,
    cam_from_hall: Sequence[Transform],
    reference: int = 0,
    most_deg: float = 2.0,
    most_m: float = 0.03,
) -> None:
    for ours, there in zip(found.cam_from_rig, cam_from_hall, strict=True):
        true = there @ cam_from_hall[reference].inverse
        assert np.degrees(angle_between(ours.rotation, true.rotation)) < most_deg
        assert np.linalg.norm(ours.inverse.translation - true.inverse.translation) < most_m


def turned(views: list[View], which: Sequence[int]) -> list[View]:
    """Some views numbered from the other end."""
    return [
        replace(view, corner=HALF_TURN[view.corner]) if i in which else view
        for i, view in enumerate(views)
    ]


def all_known(count: int) -> dict[int, Camera]:
    return {i: replace(PLAIN, name=f"cam{i}") for i in range(count)}


# ---- rigs ----------------------------------------------------------------------------------


def test_a_stereo_pair_of_which_nothing_is_known() -> None:
    rng = np.random.default_rng(0)
    views = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0) for _ in range(8)], rng)
    found = start(views, 2)
    check_rig(found, STEREO)
    assert found.notes == () and found.dropped == ()
    (only,) = found.links
    assert only.cameras == (0, 1) and only.agreeing == only.frames == 8
    np.testing.assert_array_equal(found.cam_from_rig[0].rotation, np.eye(3))


@pytest.mark.slow
def test_four_cameras_in_a_ring_are_chained_around_it() -> None:
    """Opposite cameras never see the board's face at once."""
    rng = np.random.default_rng(1)
    boards = [waved(rng, 45.0 + 90.0 * (i % 4)) for i in range(24)]
    views = rig_views([PLAIN] * 4, RING, boards, rng)
    found = start(views, 4, reference=2)
    check_rig(found, RING, reference=2)
    assert {link.cameras for link in found.links} <= {(0, 1), (1, 2), (2, 3), (0, 3)}
    assert np.median(list(found.rms_px.values())) < 1.0
    for frame, there in enumerate(boards):
        rig_from_board = RING[2] @ there
        ours = found.rig_from_board[frame]
        assert np.degrees(angle_between(ours.rotation, rig_from_board.rotation)) < 2


def test_cameras_are_linked_through_frames_of_a_third() -> None:
    """0 and 1 at some frames, 1 and 2 at others; 0 and 2 never."""
    rng = np.random.default_rng(2)
    rig = [looking_at_middle(angle) for angle in (-40.0, 0.0, 40.0)]
    views = rig_views([PLAIN] * 3, rig, [waved(rng, 0, 25.0) for _ in range(12)], rng)
    views = [view for view in views if not (view.camera == 2 and view.frame < 6)]
    views = [view for view in views if not (view.camera == 0 and view.frame >= 6)]
    found = start(views, 3)
    check_rig(found, rig)
    assert [link.cameras for link in found.links] == [(0, 1), (1, 2)]


def test_one_shared_frame_links_and_is_said_to_be_weak() -> None:
    rng = np.random.default_rng(3)
    views = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0) for _ in range(9)], rng)
    views = [view for view in views if view.frame == 0 or view.camera == view.frame % 2]
    found = start(views, 2, known=all_known(2))
    check_rig(found, STEREO)
    (note,) = found.notes
    assert note.startswith("where cam1 stands beside cam0 rests on 1 of 1 shared frames alone")


def test_an_unlinked_camera_is_named_with_counts() -> None:
    rng = np.random.default_rng(4)
    views = rig_views(
        [PLAIN] * 3, [*STEREO, beside(0.2, 0.0)], [waved(rng, 0) for _ in range(9)], rng
    )
    views = [view for view in views if (view.camera == 2) == (view.frame >= 5)]
    words = (
        "cam2 never sees the board together with cam0, cam1: 4 frames against 5, none of them "
        "shared; show the board to both at once"
    )
    with pytest.raises(ValueError, match=words):
        start(views, 3, known=all_known(3))


def test_partial_views_of_a_rig() -> None:
    """As a ChArUco board half out of the image or covered: six corners and more."""
    rng = np.random.default_rng(5)
    views = rig_views(
        [PLAIN] * 4, RING, [waved(rng, 45.0 + 90.0 * (i % 4)) for i in range(24)], rng
    )
    cut = []
    for view in views:
        rows = np.sort(rng.permutation(len(view.corner))[: rng.integers(6, 20)])
        cut.append(
            replace(
                view,
                corner=view.corner[rows],
                pixels=view.pixels[rows],
                sigma_px=view.sigma_px[rows],
            )
        )
    check_rig(start(cut, 4), RING, most_deg=4.0, most_m=0.06)
    check_rig(start(cut, 4, known=all_known(4)), RING, most_deg=1.0, most_m=0.02)


# ---- what views mean -------------------------------------------------------------------------


@pytest.mark.parametrize("rig", [STEREO, RING], ids=["stereo", "ring"])
def test_half_turns_of_single_views_are_undone(rig: tuple[Transform, ...]) -> None:
    rng = np.random.default_rng(6)
    step = 0.0 if rig is STEREO else 90.0
    boards = [waved(rng, step / 2 + step * (i % 4)) for i in range(20)]
    plain = rig_views([PLAIN] * len(rig), rig, boards, rng)
    odd = np.flatnonzero(rng.random(len(plain)) < 0.4).tolist()
    views = turned(plain, odd)
    found = start(views, len(rig), symmetric=True)
    check_rig(found, rig)
    assert not any(link.ambiguous for link in found.links)
    for frame in range(20):
        own = [i for i, view in enumerate(views) if view.frame == frame]
        same = {bool(np.array_equal(found.corner[i], plain[i].corner)) for i in own}
        assert len(same) == 1  # all from one end, whichever
    assert np.median(list(found.rms_px.values())) < 1.0


def test_half_turns_are_not_undone_where_the_board_has_an_end() -> None:
    """Without the symmetry such views contradict the others, and are dropped."""
    rng = np.random.default_rng(7)
    views = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0) for _ in range(10)], rng)
    odd = next(i for i, view in enumerate(views) if view.frame == 4 and view.camera == 1)
    found = start(turned(views, [odd]), 2)
    check_rig(found, STEREO)
    (dropped,) = found.dropped
    assert dropped.kind == "disagrees" and views[dropped.view].frame == 4
    assert "not synchronised, or the board moved" in dropped.reason


def test_a_symmetric_board_that_was_held_still_leaves_the_rig_open() -> None:
    rng = np.random.default_rng(8)
    place = waved(rng, 0)
    apart = [looking_at_middle(-20.0), looking_at_middle(20.0)]
    views = rig_views([PLAIN] * 2, apart, [place] * 6, rng)
    found = start(views, 2, symmetric=True, known=all_known(2))
    check_rig(found, apart)  # as numbered, where nothing speaks against it
    (note,) = found.notes
    assert note.startswith("where cam1 stands beside cam0 is a guess")
    assert start(views, 2, known=all_known(2)).notes == ()


def test_tilts_that_one_view_leaves_open_are_settled_by_the_rig() -> None:
    """Small far boards: by rms alone, a fifth of the views is turned over."""
    rng = np.random.default_rng(9)
    wide = lens("radtan", SIZE, 420, 420, 485, 352, 0, 0, 0, 0)
    far = [
        Transform(place.rotation, place.translation + np.array([0.0, 0.0, 2.2]))
        for place in (looking_at_middle(-35.0), looking_at_middle(0.0), looking_at_middle(35.0))
    ]
    boards = [waved(rng, 0, 40.0) for _ in range(25)]
    views = rig_views([wide] * 3, far, boards, rng, noise_px=0.3)
    found = start(views, 3, known=dict.fromkeys(range(3), wide))
    check_rig(found, far, most_deg=2.0, most_m=0.15)
    assert len(found.kept) > 0.95 * len(views)
    wrong = 0
    for frame, ours in found.rig_from_board.items():
        true = far[0] @ boards[frame]
        wrong += np.degrees(angle_between(ours.rotation, true.rotation)) > 10
    assert wrong <= 1


def test_views_of_another_moment_are_dropped() -> None:
    rng = np.random.default_rng(10)
    boards = [waved(rng, 0) for _ in range(14)]
    rig = [looking_at_middle(angle) for angle in (-25.0, 0.0, 25.0)]
    views = rig_views([PLAIN] * 3, rig, boards, rng)
    moved = Transform.exp(np.array([0.03, 0.0, 0.02]), np.array([0.02, 0.0, 0.0]))
    late = rig_views([PLAIN] * 3, rig, [moved @ there for there in boards], rng)
    odd = [i for i, v in enumerate(views) if (v.camera, v.frame) in {(0, 3), (2, 8), (1, 11)}]
    views = [late[i] if i in odd else view for i, view in enumerate(views)]
    found = start(views, 3, known=all_known(3))
    assert [each.view for each in found.dropped] == odd
    assert {each.kind for each in found.dropped} == {"disagrees"}
    check_rig(found, rig, most_deg=0.5, most_m=0.01)


def test_cameras_that_agree_in_no_frame_are_refused_with_counts() -> None:
    """Shared frames, but another place of the board in each camera: nothing to link by."""
    rng = np.random.default_rng(11)
    views = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0) for _ in range(10)], rng)
    other = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0, 60.0) for _ in range(10)], rng)
    mixed = [v for v in views if v.camera == 0] + [v for v in other if v.camera == 1]
    with pytest.raises(ValueError, match=r"cam1 cannot be placed beside cam0: at best 1 of 10"):
        start(mixed, 2, known=all_known(2))


def test_a_board_of_other_proportions_is_renumbered_by_its_own_turn() -> None:
    board = grid(5, 3, 0.05)
    rng = np.random.default_rng(12)
    middle = BOARD.mean(0) - board.mean(0)
    boards = [waved(rng, 0) @ Transform(np.eye(3), middle) for _ in range(10)]
    views = []
    for frame, there in enumerate(boards):
        for camera, place in enumerate(STEREO):
            corner, pixels = seen(PLAIN, place @ there, rng, board)
            if rng.random() < 0.5:
                corner = np.arange(15)[::-1][corner]
            views.append(View(camera, frame, corner, pixels, np.full(len(corner), 0.2)))
    scene = BoardScene(
        views, board, ["a", "b"], [SIZE] * 2, (np.arange(15)[::-1],), known=all_known(2)
    )
    check_rig(start_from_board(scene), STEREO, most_deg=0.5, most_m=0.01)

"""Where board calibration starts with one camera: the lens, the boards, and views left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from graphs.board_start import BoardScene, BoardStart, start_from_board
from graphs.camera import Camera, focal_on_axis, nominal_params, project, unproject
from graphs.frames import FloatArray, Transform, angle_between, exp_rotation
from graphs.lenses import IntArray
from graphs.planar import gather, solve_views

NOISE_PX = 0.2


@dataclass(frozen=True)
class View:
    camera: int
    frame: int
    corner: IntArray
    pixels: FloatArray
    sigma_px: FloatArray


def grid(columns: int = 8, rows: int = 6, square_m: float = 0.03) -> FloatArray:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * square_m


BOARD = grid()


def seen(
    camera: Camera,
    cam_from_board: Transform,
    rng: np.random.Generator,
    board: FloatArray = BOARD,
    noise_px: float = NOISE_PX,
) -> tuple[IntArray, FloatArray]:
    """Corners within the image and where they are in it."""
    pixels = project(camera, cam_from_board @ board)
    with np.errstate(invalid="ignore"):
        inside = (pixels > 0).all(1) & (pixels < np.array(camera.size) - 1.0).all(1)
    corner = np.flatnonzero(inside)
    return corner, pixels[corner] + noise_px * rng.standard_normal((len(corner), 2))


def facing(
    camera: Camera,
    rng: np.random.Generator,
    distance_m: tuple[float, float],
    tilt_deg: tuple[float, float],
    share: float = 0.8,
    board: FloatArray = BOARD,
) -> Transform:
    """cam_from_board of a board somewhere in the image, tilted about some axis."""
    while True:
        pixel = (0.5 + share * rng.uniform(-0.5, 0.5, 2)) * camera.size
        sight = unproject(camera, pixel[None])[0]
        if np.isfinite(sight[0]):
            break
    x = np.cross([0.0, 1.0, 0.0], sight)
    x /= np.linalg.norm(x)
    axis_angle = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.cos(axis_angle), np.sin(axis_angle), 0.0])
    tilt = exp_rotation(np.radians(rng.uniform(*tilt_deg)) * axis)
    turn = exp_rotation(np.array([0.0, 0.0, rng.uniform(-0.5, 0.5)]))
    rotation = np.stack([x, np.cross(sight, x), sight], axis=1) @ tilt @ turn
    return Transform(rotation, sight * rng.uniform(*distance_m) - rotation @ board.mean(0))


def mono_views(
    camera: Camera,
    count: int,
    rng: np.random.Generator,
    distance_m: tuple[float, float] = (0.4, 1.0),
    tilt_deg: tuple[float, float] = (10.0, 45.0),
    share: float = 0.8,
    noise_px: float = NOISE_PX,
) -> tuple[list[View], list[Transform]]:
    views: list[View] = []
    placed: list[Transform] = []
    while len(views) < count:
        cam_from_board = facing(camera, rng, distance_m, tilt_deg, share)
        corner, pixels = seen(camera, cam_from_board, rng, noise_px=noise_px)
        if len(corner) >= 12:
            views.append(View(0, len(views), corner, pixels, np.full(len(corner), noise_px)))
            placed.append(cam_from_board)
    return views, placed


def start(views: list[View], camera: Camera, **known: object) -> BoardStart:
    scene = BoardScene(views, BOARD, [camera.name], [camera.size])
    return start_from_board(replace(scene, **known))  # type: ignore[arg-type]


def lens(name: str, size: tuple[int, int], *params: float) -> Camera:
    return Camera("cam", name, size, np.array(params))  # type: ignore[arg-type]


PINHOLE = lens("pinhole", (640, 480), 600, 600, 322, 236)
BARREL = lens("radtan", (1280, 720), 700, 700, 645, 352, -0.35, 0.12, 0.001, 0.001)
PINCUSHION = lens("radtan", (1280, 720), 640, 640, 657, 333, 0.19, -0.28, 0.001, 0.001)
PORTRAIT = lens("radtan", (1088, 1920), 1680, 1680, 540, 970, -0.1, 0.05, 0, 0)
OFF_CENTRE = lens("radtan", (640, 480), 687, 687, 301, 277, -0.1, 0.1, 0, 0)
TELE = lens("pinhole", (1920, 1080), 6000, 6000, 960, 540)
FISHEYE = lens("kannala_brandt", (1000, 1000), 320, 320, 496, 505, 0.02, -0.01, 0, 0)
SPHERES = lens("double_sphere", (720, 540), 280, 280, 362, 268, -0.2, 0.6)


# ---- lenses --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("camera", "wide"),
    [
        (PINHOLE, False), (BARREL, False), (PINCUSHION, False), (PORTRAIT, False),
        (OFF_CENTRE, False), (FISHEYE, True), (SPHERES, True),
    ],
    ids=["pinhole", "barrel", "pincushion", "portrait", "off centre", "fisheye", "spheres"],
)  # fmt: skip
@pytest.mark.parametrize(("count", "most"), [(3, 0.1), (10, 0.03)])
def test_the_focal_length_is_found(camera: Camera, wide: bool, count: int, most: float) -> None:
    rng = np.random.default_rng(1)
    views, placed = mono_views(camera, count, rng)
    found = start(views, camera)
    focal_px = focal_on_axis(camera)[0]
    assert abs(found.cameras[0].params[0] / focal_px - 1) < most
    assert (found.cameras[0].lens == "kannala_brandt") == wide or count == 3
    assert not found.lenses[0].weak
    assert found.kept == tuple(range(count)) and not found.dropped
    assert max(found.rms_px.values()) < 3 * NOISE_PX
    for frame, there in enumerate(placed):
        ours = found.rig_from_board[frame]
        assert np.degrees(angle_between(ours.rotation, there.rotation)) < (6 if count == 3 else 2)


def test_a_telephoto_lens_is_found() -> None:
    views, _ = mono_views(TELE, 10, np.random.default_rng(0), (2.0, 4.0))
    assert abs(start(views, TELE).cameras[0].params[0] / 6000 - 1) < 0.05


@pytest.mark.parametrize("name", ["pinhole", "brown", "eucm", "division", "kannala_brandt"])
def test_the_result_has_the_lens_that_was_asked_for(name: str) -> None:
    views, _ = mono_views(OFF_CENTRE, 8, np.random.default_rng(2))
    found = start(views, OFF_CENTRE, lens=name).cameras[0]
    assert found.lens == name and found.name == "cam" and found.size == OFF_CENTRE.size
    assert abs(focal_on_axis(found)[0] / 687 - 1) < 0.06


def test_frontal_views_alone_leave_the_focal_length_weak_and_sane() -> None:
    views, _ = mono_views(PINHOLE, 8, np.random.default_rng(3), tilt_deg=(0, 1), share=0.02)
    found = start(views, PINHOLE)
    assert found.lenses[0].weak
    assert 0.4 < found.cameras[0].params[0] / 640 < 2.5
    (note,) = found.notes
    assert note.startswith("the views hardly tell cam's focal length (sigma ")


def test_a_known_camera_is_left_alone() -> None:
    views, placed = mono_views(BARREL, 2, np.random.default_rng(4))
    found = start(views, BARREL, known={0: BARREL})
    assert found.cameras[0] is BARREL
    for frame, there in enumerate(placed):
        assert angle_between(found.rig_from_board[frame].rotation, there.rotation) < 0.01


def test_the_start_is_the_same_every_time() -> None:
    views, _ = mono_views(BARREL, 4, np.random.default_rng(5))
    once, again = start(views, BARREL), start(views, BARREL)
    np.testing.assert_array_equal(once.cameras[0].params, again.cameras[0].params)


# ---- views that are left out ---------------------------------------------------------------


def kinds(found: BoardStart) -> dict[int, str]:
    return {each.view: each.kind for each in found.dropped}


def test_shuffled_corners_are_dropped_and_do_not_mislead_the_lens() -> None:
    rng = np.random.default_rng(6)
    views, _ = mono_views(OFF_CENTRE, 9, rng)
    for odd in (2, 5, 7):
        views[odd] = replace(views[odd], pixels=rng.permutation(views[odd].pixels))
    found = start(views, OFF_CENTRE)
    assert kinds(found) == dict.fromkeys((2, 5, 7), "misdetected")
    assert "do not lie as on a flat board" in found.dropped[0].reason
    assert abs(found.cameras[0].params[0] / 687 - 1) < 0.03


def test_a_view_of_which_a_part_is_wrong_is_dropped_by_its_rms() -> None:
    """One row of corners is found a square further: a flat board still, nearly."""
    views, _ = mono_views(PINHOLE, 9, np.random.default_rng(7), share=0.3)
    pixels = views[4].pixels.copy()
    pixels[:8] += 0.4 * (pixels[1] - pixels[0])
    views[4] = replace(views[4], pixels=pixels)
    found = start(views, PINHOLE)
    assert kinds(found) == {4: "misdetected"}
    assert "times the camera's median" in found.dropped[0].reason
    assert 4 not in found.rig_from_board and 4 not in found.kept


def test_a_noisier_view_is_kept() -> None:
    rng = np.random.default_rng(8)
    views, _ = mono_views(PINHOLE, 9, rng)
    shaken = views[4].pixels + 0.4 * rng.standard_normal(views[4].pixels.shape)
    views[4] = replace(views[4], pixels=shaken)
    assert start(views, PINHOLE).dropped == ()


def test_views_of_few_corners_and_of_one_line_are_dropped() -> None:
    views, _ = mono_views(PINHOLE, 7, np.random.default_rng(9), share=0.2)
    some = [np.arange(5), np.arange(8)]  # five corners; the first row
    for odd, rows in zip((1, 3), some, strict=True):
        of = views[odd]
        views[odd] = replace(
            of, corner=of.corner[rows], pixels=of.pixels[rows], sigma_px=of.sigma_px[rows]
        )
    found = start(views, PINHOLE)
    assert kinds(found) == {1: "few", 3: "line"}
    assert found.dropped[0].reason == "only 5 corners (needs 6)"


def test_a_tiny_view_and_a_steep_one_are_dropped() -> None:
    rng = np.random.default_rng(10)
    views, _ = mono_views(PINHOLE, 7, rng, share=0.3)
    tiny = facing(PINHOLE, rng, (20.0, 20.0), (0, 10), 0.2)
    steep = facing(PINHOLE, rng, (0.4, 0.4), (84.0, 84.0), 0.1)
    for frame, there in ((7, tiny), (8, steep)):
        corner, pixels = seen(PINHOLE, there, rng, noise_px=0.02)
        views.append(View(0, frame, corner, pixels, np.full(len(corner), NOISE_PX)))
    found = start(views, PINHOLE)
    assert kinds(found) == {7: "small", 8: "oblique"}
    assert "degrees from its front" in found.dropped[1].reason


def test_small_far_boards_have_two_solutions_of_which_one_is_right() -> None:
    rng = np.random.default_rng(11)
    views, placed = mono_views(PINHOLE, 30, rng, (4.5, 5.5), (25.0, 40.0), 0.7, noise_px=0.3)
    both = solve_views([PINHOLE], gather(views, BOARD))

    def turns_deg(of: FloatArray) -> FloatArray:
        pairs = zip(of, placed, strict=True)
        return np.degrees([angle_between(ours, there.rotation) for ours, there in pairs])

    first, second = turns_deg(both.first.rotation), turns_deg(both.second.rotation)
    assert (np.minimum(first, second) < 12).all()
    assert 0 < (first > 12).sum() < 15  # some are wrong by their rms
    assert np.isfinite(both.second_rms_px).all()
    assert np.median(both.second_rms_px / both.first_rms_px) < 1.1
    assert (both.first_rms_px <= both.second_rms_px).all()


def test_near_tilted_boards_have_one_solution_that_counts() -> None:
    views, placed = mono_views(
        PINHOLE, 20, np.random.default_rng(12), (0.4, 0.5), (25.0, 45.0), 0.3
    )
    both = solve_views([PINHOLE], gather(views, BOARD))
    assert (both.second_rms_px > 5 * both.first_rms_px).all()
    for ours, there in zip(both.first.rotation, placed, strict=True):
        assert angle_between(ours, there.rotation) < 0.02


def test_ambiguous_views_are_dropped_where_there_are_others() -> None:
    rng = np.random.default_rng(13)
    views, _ = mono_views(PINHOLE, 8, rng, share=0.4)
    far, _ = mono_views(PINHOLE, 4, rng, (5.0, 5.5), (30.0, 40.0), 0.4, noise_px=0.3)
    views += [replace(view, frame=8 + view.frame) for view in far]
    found = start(views, PINHOLE)
    assert kinds(found) == dict.fromkeys(range(8, 12), "ambiguous")
    assert "two tilts of the board" in found.dropped[0].reason
    alone = start([replace(view, frame=i) for i, view in enumerate(far)], PINHOLE)
    assert alone.dropped == () and len(alone.kept) == 4


def test_no_usable_view_is_an_error_with_its_reason() -> None:
    views, _ = mono_views(PINHOLE, 2, np.random.default_rng(14))
    views = [replace(v, corner=v.corner[:4], pixels=v.pixels[:4]) for v in views]
    with pytest.raises(ValueError, match=r"cam has no usable view .* 2 given, .* only 4 corners"):
        start(views, PINHOLE)
    with pytest.raises(ValueError, match="cam has no usable view of the board: 0 given"):
        start([], PINHOLE)


def test_boards_seen_sideways_by_a_fisheye_are_placed() -> None:
    """Beyond 90 degrees off the axis, where z is negative."""
    rng = np.random.default_rng(15)
    wide = Camera(
        "cam", "kannala_brandt", (900, 900), nominal_params("kannala_brandt", (900, 900), 250)
    )
    sight = np.array([np.sin(1.7), 0.0, np.cos(1.7)])
    x = np.array([np.cos(1.7), 0.0, -np.sin(1.7)])
    rotation = np.stack([x, np.cross(sight, x), sight], axis=1) @ exp_rotation(
        np.array([0.5, 0, 0])
    )
    there = Transform(rotation, 0.5 * sight - rotation @ BOARD.mean(0))
    corner, pixels = seen(wide, there, rng)
    assert len(corner) > 20 and ((there @ BOARD)[corner, 2] < 0).sum() > 10
    view = View(0, 0, corner, pixels, np.full(len(corner), NOISE_PX))
    both = solve_views([wide], gather([view], BOARD))
    assert angle_between(both.first.rotation[0], there.rotation) < 0.02

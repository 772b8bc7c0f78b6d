"""The board in a scan: all views of it, and what is said where it is not there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from synthetic.scans import DATA, silent
from test_board_detect import errors, render

from sfm_calib.boards.diagnose import another_board, why_not
from sfm_calib.boards.find import find_board
from sfm_calib.boards.spec import Aprilgrid, Charuco, Checkerboard, Circles
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.images import read_scan

SIZE = (320, 240)
VIEW = {"size": SIZE, "focal_px": 350.0}
CHECKERBOARD = Checkerboard(inner_corners=(6, 4), square_m=0.04)
OTHER = Checkerboard(inner_corners=(7, 5), square_m=0.04)
CHARUCO = Charuco(squares=(5, 4), square_m=0.05, marker_m=0.038)
TILTS = [(20, -15, 5), (-20, 10, 170), (10, 25, 90), (5, 5, -80)]


def seen(board):
    return [render(board, tilt, **VIEW)[0] for tilt in TILTS]


def scan_of(tmp_path, cameras):
    for camera, images in cameras.items():
        folder = tmp_path / "scan" / camera
        folder.mkdir(parents=True)
        for number, image in enumerate(images):
            assert cv2.imwrite(str(folder / f"{number}.png"), image)
    return read_scan(tmp_path / "scan", Cache(tmp_path / "cache"), "stem", 10, silent)


def nothing():
    return np.full(SIZE[::-1], 128, np.uint8)


def test_views_come_by_frame_then_camera(tmp_path):
    images = seen(CHECKERBOARD)
    scan = scan_of(tmp_path, {"left": images[:3], "right": [images[3], nothing(), images[1]]})
    stages = []
    found = find_board(scan, CHECKERBOARD, lambda *stage: stages.append(stage))
    views = found.views
    assert views.cameras == ("left", "right") and views.frames == ("0", "1", "2")
    assert views.sizes == (SIZE, SIZE)
    assert [(view.frame, view.camera) for view in views.views] == [
        (0, 0),
        (0, 1),
        (1, 0),
        (2, 0),
        (2, 1),
    ]
    assert stages == [("looking for the board", done, 6) for done in range(1, 7)]
    assert found.messages == ()
    truth = render(CHECKERBOARD, TILTS[1], **VIEW)[1]
    assert np.abs(errors(views.views[2], CHECKERBOARD, truth)).max() < 0.05


def test_a_camera_without_the_board_is_named(tmp_path):
    images = seen(CHECKERBOARD)
    scan = scan_of(tmp_path, {"left": images, "right": [nothing()] * 4})
    with pytest.raises(CalibrationError, match="4 images of camera right") as error:
        find_board(scan, CHECKERBOARD, silent)
    assert "found in 4 of camera left" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
def test_another_size_is_named(tmp_path):
    scan = scan_of(tmp_path, {"cam": seen(OTHER)})
    with pytest.raises(CalibrationError) as error:
        find_board(scan, CHECKERBOARD, silent)
    assert "in 4 images" in str(error.value)
    assert "7 x 5 inner corners fits 4 of 4" in str(error.value)
    assert "inner_corners: [7, 5]" in str(error.value)


def test_two_boards_in_one_scan_are_told(tmp_path):
    scan = scan_of(tmp_path, {"cam": [*seen(CHECKERBOARD), *seen(OTHER)]})
    found = find_board(scan, CHECKERBOARD, silent)
    assert len(found.views.views) == 4
    (message,) = found.messages
    assert message.startswith("4 of 8 images") and "7 x 5" in message


WRONG = [
    (CHARUCO, {"squares": (4, 5)}, "write 'squares: [5, 4]'"),
    (CHARUCO, {"inverted": True}, "write 'inverted: false'"),
    (CHARUCO, {"dictionary": "DICT_6X6_50"}, "write 'dictionary: DICT_4X4_50'"),
    (CHARUCO, {"legacy": True}, "write 'legacy: false'"),
    (CHARUCO, {"squares": (7, 6)}, "ids up to 9, and the board has 21"),
    (Aprilgrid(tags=(3, 2), tag_m=0.06, spacing=0.3), {"border_bits": 1}, "'border_bits: 2'"),
    (Circles(circles=(4, 7), spacing_m=0.03), {"circles": (7, 4)}, "'circles: [4, 7]'"),
    (CHARUCO, None, "is it a ChArUco board?"),
]


@pytest.mark.parametrize(("shown", "wrong", "said"), WRONG, ids=[said for *_, said in WRONG])
def test_what_was_meant_is_named(shown, wrong, said):
    given = CHECKERBOARD if wrong is None else shown.model_copy(update=wrong)
    assert said in why_not(given, seen(shown)[:3])


def test_mirrored_markers_are_named():
    mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in seen(CHARUCO)[:3]]
    said = why_not(CHARUCO, mirrored)
    assert "3 of 3 images" in said and "mirrored" in said and "two_sided: true" in said


def test_a_wall_is_no_board():
    noise = np.random.default_rng(0).integers(0, 255, SIZE[::-1], np.uint8)
    images = [nothing(), cv2.GaussianBlur(noise, (0, 0), 2)]
    assert another_board(CHECKERBOARD, images) is None
    assert "show all of it" in why_not(CHECKERBOARD, images)


REAL = [
    ("corridor_stereo/boards", Checkerboard(inner_corners=(8, 6), square_m=0.025), 20),
    ("opencv_stereo", Checkerboard(inner_corners=(9, 6), square_m=1.0), 26),
    (
        "mocap_static4/intrinsics/int_cam03_img",
        Checkerboard(inner_corners=(4, 7), square_m=0.06),
        7,
    ),
    ("handeye/data-eye-in-hand", Checkerboard(inner_corners=(9, 6), square_m=0.0236), 8),
]


@pytest.mark.slow
@pytest.mark.parametrize(("folder", "board", "count"), REAL, ids=[folder for folder, *_ in REAL])
def test_real_boards_are_found(folder, board, count, tmp_path):
    if not (DATA / folder).exists():
        pytest.skip(f"../shared/data/{folder} is not on this machine")
    scan = read_scan(DATA / folder, Cache(tmp_path / "cache"), "stem", 10, silent)
    found = find_board(scan, board, silent)
    assert len(found.views.views) == count
    assert 0.005 < np.median(np.concatenate([v.sigma_px for v in found.views.views])) < 0.2

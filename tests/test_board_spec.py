"""Boards in words: counts, corners, symmetries, and files of ours and of Kalibr's."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm_calib.boards.load import board_from, board_yaml, load_board
from sfm_calib.boards.pattern import pattern_of
from sfm_calib.boards.picture import board_image, image_corners
from sfm_calib.boards.spec import Aprilgrid, Charuco, Checkerboard, Circles
from sfm_calib.errors import CalibrationError

CONFIGS = Path(__file__).resolve().parent.parent / "configs" / "boards"
CHECKERBOARD = "type: checkerboard\ninner_corners: [8, 6]\nsquare_m: 0.025\n"
CHARUCO = "type: charuco\nsquares: [5, 4]\nsquare_m: 0.04\nmarker_m: 0.03\n"


def load(tmp_path, text):
    path = tmp_path / "board.yaml"
    path.write_text(text)
    return load_board(path)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
def test_examples_load_and_come_back(path, tmp_path):
    board = load_board(path)
    assert board.type == path.stem
    assert load(tmp_path, board_yaml(board)) == board


def test_there_is_an_example_of_each_type():
    assert {path.stem for path in CONFIGS.glob("*.yaml")} == {
        "checkerboard",
        "charuco",
        "aprilgrid",
        "circles",
    }


def test_corners_run_along_rows_then_down():
    board = Checkerboard(inner_corners=(3, 2), square_m=0.1)
    expected = [[0, 0], [0.1, 0], [0.2, 0], [0, 0.1], [0.1, 0.1], [0.2, 0.1]]
    np.testing.assert_allclose(board.corners_m[:, :2], expected)
    assert not board.corners_m[:, 2].any()


def test_aprilgrid_corners_are_kalibrs():
    """GridCalibrationTargetAprilgrid.cpp: rows of corners from the bottom left, upwards."""
    board = Aprilgrid(tags=(2, 3), tag_m=0.1, spacing=0.3)
    corners = board.corners_m
    assert len(corners) == 4 * 6
    np.testing.assert_allclose(corners[:4, 0], [0, 0.1, 0.13, 0.23])
    np.testing.assert_allclose(corners[::4, 1], [0, -0.1, -0.13, -0.23, -0.26, -0.36])


def test_asymmetric_circles_are_opencvs():
    board = Circles(circles=(4, 11), spacing_m=0.02)
    corners = board.corners_m.reshape(11, 4, 3)
    np.testing.assert_allclose(corners[0, :, 0], [0, 0.04, 0.08, 0.12])
    np.testing.assert_allclose(corners[1, :, 0], [0.02, 0.06, 0.1, 0.14])
    np.testing.assert_allclose(corners[:, 0, 1], 0.02 * np.arange(11))


@pytest.mark.parametrize(("squares", "legacy"), [((5, 4), False), ((5, 4), True), ((4, 5), True)])
def test_charuco_pattern_is_opencvs(squares, legacy):
    board = Charuco(squares=squares, square_m=0.04, marker_m=0.03, legacy=legacy)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    theirs = cv2.aruco.CharucoBoard(squares, 0.04, 0.03, dictionary)
    theirs.setLegacyPattern(legacy)
    expected = theirs.generateImage((squares[0] * 48, squares[1] * 48))
    margin = 24
    ours = board_image(board, 48)[margin:-margin, margin:-margin]
    assert np.mean(ours != expected) < 0.001  # OpenCV rounds the markers to whole pixels
    objects = np.asarray(theirs.getChessboardCorners())
    np.testing.assert_allclose(board.corners_m, objects - objects[0], atol=1e-6)


def test_aprilgrid_pattern_is_kalibrs():
    """kalibr_create_target_pdf: code 0xd5d628584 of tag 0, its first bit at the top left, white
    where it is set, in a frame of two bits; black squares at the corners."""
    board = Aprilgrid(tags=(2, 2), tag_m=0.1, spacing=0.3)
    image = board_image(board, 100)
    x, y = image_corners(board, 100)[0] + 0.5  # bottom left corner of tag 0
    tag = image[round(y) - 100 : round(y), round(x) : round(x) + 100]
    cells = tag.reshape(10, 10, 10, 10)[:, 5, :, 5] > 127
    bits = [(0xD5D628584 >> (35 - place)) & 1 for place in range(36)]
    np.testing.assert_array_equal(cells[2:8, 2:8], np.reshape(bits, (6, 6)))
    assert not cells[:2].any() and not cells[:, :2].any() and not cells[8:].any()
    below = image[round(y) + 5, :]
    assert below[round(x) - 5] == 0 and below[round(x) + 50] == 255


BOARDS_WITH_SYMMETRIES = [
    (Checkerboard(inner_corners=(8, 6), square_m=0.03), 1),
    (Checkerboard(inner_corners=(7, 5), square_m=0.03), 1),
    (Checkerboard(inner_corners=(8, 5), square_m=0.03), 0),
    (Checkerboard(inner_corners=(6, 6), square_m=0.03), 3),
    (Checkerboard(inner_corners=(5, 5), square_m=0.03), 1),
    (Circles(circles=(4, 11), spacing_m=0.02), 0),
    (Circles(circles=(4, 8), spacing_m=0.02), 1),
    (Circles(circles=(5, 10), spacing_m=0.02), 1),
    (Circles(circles=(4, 4), spacing_m=0.02, asymmetric=False), 3),
    (Circles(circles=(5, 4), spacing_m=0.02, asymmetric=False), 1),
    (Charuco(squares=(5, 5), square_m=0.03, marker_m=0.02), 0),
    (Aprilgrid(tags=(3, 3), tag_m=0.03, spacing=0.3), 0),
]


@pytest.mark.parametrize(("board", "count"), BOARDS_WITH_SYMMETRIES)
def test_symmetries_are_the_turns_that_the_picture_shows(board, count):
    """Turning the picture leaves it as it is, and takes corner i where renumbering[i] was."""
    image, corners = board_image(board, 20), image_corners(board, 20)
    found = []
    for turns in (1, 2, 3):
        turned = np.rot90(image, turns)
        if turned.shape != image.shape or np.mean(turned != image) > 0.01:
            continue
        place, (height, width) = corners, image.shape
        for _ in range(turns):  # np.rot90 turns to the left
            place = np.column_stack([place[:, 1], width - 1 - place[:, 0]])
            height, width = width, height
        near = np.linalg.norm(place[:, None] - corners, axis=2).argmin(axis=1)
        found.append(tuple(near))
    assert len(found) == len(board.symmetries) == count
    assert {tuple(each) for each in board.symmetries} == set(found)


def test_shapes_lie_in_their_box():
    board = Circles(circles=(4, 5), spacing_m=0.02, diameter_m=0.01)
    pattern = pattern_of(board)
    assert pattern.box == pytest.approx((-0.005, -0.005, 0.145, 0.085))


def test_sigma_of_lengths():
    board = Checkerboard(inner_corners=(8, 6), square_m=0.025)
    assert board.relative_sigma == 0.001
    measured = board.model_copy(update={"square_sigma_m": 0.0001})
    assert measured.relative_sigma == pytest.approx(0.004)


KALIBR = {
    "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n": (
        Aprilgrid(tags=(6, 5), tag_m=0.088, spacing=0.3)
    ),
    "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\n"
    "colSpacingMeters: 0.06\n": Checkerboard(inner_corners=(6, 7), square_m=0.06),
    "target_type: 'circlegrid'\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.02\n"
    "asymmetricGrid: True\n": Circles(circles=(4, 11), spacing_m=0.02),
    "target_type: 'circlegrid'\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\n": (
        Circles(circles=(6, 7), spacing_m=0.02, asymmetric=False)
    ),
}


@pytest.mark.parametrize("text", KALIBR)
def test_kalibrs_targets_are_read(text, tmp_path):
    assert load(tmp_path, text) == KALIBR[text]


BAD = [
    ("", "describes no board"),
    ("- 1\n", "describes no board"),
    ("inner_corners: [8, 6]\n", "no type"),
    ("type: chekerboard\n", "did you mean 'checkerboard'"),
    (CHECKERBOARD + "squre_sigma_m: 0.1\n", "did you mean 'square_sigma_m'"),
    (CHECKERBOARD.replace("inner_corners", "corners"), "did you mean 'inner_corners'"),
    ("type: checkerboard\ninner_corners: [8, 6]\n", "square_m: is missing"),
    (CHECKERBOARD.replace("[8, 6]", "8"), "takes a list, like [8, 6]"),
    (CHECKERBOARD.replace("[8, 6]", "[8, 1]"), "inner_corners.1"),
    (CHECKERBOARD.replace("0.025", "-1"), "no length; give metres"),
    (CHECKERBOARD.replace("0.025", "250"), "longer than any square; give metres: 0.25 for 250 mm"),
    (CHECKERBOARD.replace("0.025", ".nan"), "square_m"),
    (CHARUCO.replace("0.03", "0.05"), "smaller than a square of 0.04 m"),
    (CHARUCO + "dictionary: DICT_4X4_60\n", "DICT_4X4_50"),
    (CHARUCO.replace("[5, 4]", "[4, 2]"), "3 squares or more"),
    ("type: aprilgrid\ntags: [30, 30]\ntag_m: 0.1\nspacing: 0.3\n", "900 tags"),
    ("type: aprilgrid\ntags: [2, 2]\ntag_m: 0.1\nspacing: 0.3\nfirst_id: 585\n", "ends at 586"),
    ("type: circles\ncircles: [4, 5]\nspacing_m: 0.02\ndiameter_m: 0.03\n", "would touch"),
    ("type: [\n", "not valid YAML"),
    ("target_type: 'chess'\n", "Kalibr has aprilgrid"),
    ("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 1\n", "tagSpacing: is missing"),
    ("target_type: 'aprilgrid'\ntagCol: 6\n", "did you mean 'tagCols'"),
    (
        "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\nrowSpacingMeters: 0.06\n"
        "colSpacingMeters: 0.05\n",
        "only checkerboards of squares",
    ),
    (
        "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: -1\ntagSpacing: 0.3\n",
        "tagSize",
    ),
]


@pytest.mark.parametrize(("text", "said"), BAD, ids=[said for _, said in BAD])
def test_bad_boards_are_refused_in_one_line(text, said, tmp_path):
    with pytest.raises(CalibrationError) as error:
        load(tmp_path, text)
    assert said in str(error.value) and "\n" not in str(error.value)
    assert "board.yaml" in str(error.value)


def test_an_absent_board_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="no such board"):
        load_board(tmp_path / "none.yaml")


def test_boards_are_frozen_and_compared_by_value():
    content = {"type": "charuco", "squares": [5, 4], "square_m": 0.04, "marker_m": 0.03}
    assert board_from(content) == Charuco(squares=(5, 4), square_m=0.04, marker_m=0.03)

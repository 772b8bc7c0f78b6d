"""Boards to print: shapes in mm as the PDF has them, and a picture of them that is found again."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from sfm_calib.boards.detect import detect
from sfm_calib.boards.load import load_board
from sfm_calib.boards.page import PAGES_MM, BoardPrint, board_page, write_board
from sfm_calib.boards.spec import Aprilgrid, Charuco, Checkerboard, Circles
from sfm_calib.errors import CalibrationError

MM = 72 / 25.4
BOARDS = [
    Checkerboard(inner_corners=(6, 5), square_m=0.025),
    Charuco(squares=(6, 4), square_m=0.03, marker_m=0.022),
    Charuco(squares=(5, 4), square_m=0.03, marker_m=0.022, inverted=True),
    Aprilgrid(tags=(4, 3), tag_m=0.04, spacing=0.3),
    Circles(circles=(4, 7), spacing_m=0.018),
]
EACH = pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.described)


def content(page):
    """The page's drawing, in which a user unit is 1 mm, and its width and height in mm."""
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", page)
    stream = re.search(rb"stream\n(.*)\nendstream", page, re.DOTALL).group(1).decode("latin-1")
    first, rest = stream.split("\n", 1)
    np.testing.assert_allclose([float(v) for v in first.split()[:6]], [MM, 0, 0, MM, 0, 0])
    return rest, float(box.group(1)) / MM, float(box.group(2)) / MM


def rectangles(drawing):
    found = re.findall(r"^([\d.-]+) ([\d.-]+) ([\d.-]+) ([\d.-]+) re$", drawing, re.MULTILINE)
    return np.array(found, dtype=float).reshape(-1, 4)


def discs(drawing):
    """Centre and radius of each closed path of four curves."""
    number = r"[\d.-]+"
    path = rf"({number}) ({number}) m\n((?:(?:{number} ){{6}}c\n?){{4}})"
    result = []
    for x, y, curves in re.findall(path, drawing):
        ends = np.array(re.findall(number, curves), dtype=float).reshape(4, 6)[:, 4:]
        centre = (ends[0] + ends[2]) / 2
        radii = np.linalg.norm(ends - centre, axis=1)
        np.testing.assert_allclose(radii, radii[0], atol=1e-4)
        np.testing.assert_allclose(ends[3], [float(x), float(y)], atol=1e-4)
        result.append([*centre, radii[0]])
    return np.array(result).reshape(-1, 3)


def picture(page, pixels_per_mm=5):
    """The page as a printer draws it, without the text."""
    drawing, width, height = content(page)
    image = np.full((round(height * pixels_per_mm), round(width * pixels_per_mm)), 255, np.uint8)
    grey, waiting = 0, []

    def at(x, y):
        return round(x * pixels_per_mm), round((height - y) * pixels_per_mm)

    for line in drawing.split("\n"):
        if line in ("0 g", "1 g"):
            grey = 255 * int(line[0])
        elif line.endswith(" re"):
            waiting.append([float(v) for v in line.split()[:4]])
        elif line == "f":
            for x, y, w, h in waiting:
                (left, top), (right, bottom) = at(x, y + h), at(x + w, y)
                image[top:bottom, left:right] = grey
            waiting = []
    for x, y, radius in discs(drawing):
        cv2.circle(image, at(x, y), round(radius * pixels_per_mm), 0, -1)
    return image


@EACH
def test_the_printed_board_is_found_at_its_size(board):
    """Distances of neighbouring corners in the picture are those of the board."""
    image = picture(board_page(board), 5)
    found = detect(cv2.GaussianBlur(image, (0, 0), 1), board)
    assert found is not None and len(found.corner) == len(board.corners_m)
    moved = found.pixels - found.pixels[0]
    expected = 5000 * (board.corners_m - board.corners_m[found.corner[0]])[found.corner, :2]
    np.testing.assert_allclose(np.hypot(*moved.T), np.hypot(*expected.T), atol=1.0)


def test_squares_are_true_to_scale():
    found = rectangles(content(board_page(BOARDS[0]))[0])
    assert len(found) == 21  # of 7 x 6 squares
    np.testing.assert_allclose(found[:, 2:], 25, atol=1e-4)
    np.testing.assert_allclose(np.ptp(found[:, 0]), 6 * 25, atol=1e-4)


def test_circles_are_true_to_scale():
    board = BOARDS[4].model_copy(update={"diameter_m": 0.015})
    found = discs(content(board_page(board))[0])
    assert len(found) == 28
    np.testing.assert_allclose(found[:, 2], 7.5, atol=1e-4)
    np.testing.assert_allclose(np.ptp(found[:, 0]), 7 * 18, atol=1e-4)


@EACH
@pytest.mark.parametrize("page", ["a3", "auto"])
def test_everything_lies_on_the_page(board, page):
    drawing, width, height = content(board_page(board, page))
    shapes = rectangles(drawing)
    if len(shapes):
        assert shapes[:, :2].min() >= 0
        assert (shapes[:, 0] + shapes[:, 2]).max() <= width
        assert (shapes[:, 1] + shapes[:, 3]).max() <= height
    ticks = np.array(re.findall(r"([\d.]+) [\d.]+ m [\d.]+ [\d.]+ l S", drawing), dtype=float)
    assert ticks.min() > 0 and ticks.max() < width


def test_rulers_are_true_to_scale():
    drawing, _, _ = content(board_page(BOARDS[0]))
    strokes = np.array(
        re.findall(r"^([\d.]+) ([\d.]+) m ([\d.]+) ([\d.]+) l S$", drawing, re.MULTILINE),
        dtype=float,
    )
    upright = strokes[strokes[:, 0] == strokes[:, 2]]
    up, down = upright[upright[:, 3] > upright[:, 1]], upright[upright[:, 3] < upright[:, 1]]
    np.testing.assert_allclose(np.diff(up[:, 0]), 1, atol=1e-4)
    np.testing.assert_allclose(np.diff(down[:, 0]), 25.4 / 8, atol=1e-4)


def test_the_board_is_written_on_the_page():
    drawing, _, _ = content(board_page(BOARDS[1]))
    words = " ".join(re.findall(r"\((.*)\) Tj", drawing)[::-1])
    for part in ("type: charuco", "squares: [6, 4]", "square_m: 0.03", "100 %"):
        assert part in words


def test_the_file_is_a_pdf_whose_table_is_right():
    page = board_page(BOARDS[0], "a4")
    assert page.startswith(b"%PDF-1.4") and page.endswith(b"%%EOF\n")
    start = int(re.search(rb"startxref\n(\d+)", page).group(1))
    assert page[start : start + 4] == b"xref"
    places = [int(each) for each in re.findall(rb"(\d{10}) 00000 n", page)]
    for number, place in enumerate(places, start=1):
        assert page[place:].startswith(b"%d 0 obj" % number)
    length = int(re.search(rb"/Length (\d+)", page).group(1))
    begin = page.index(b"stream\n") + 7
    assert page[begin + length :].startswith(b"\nendstream")


def test_a_page_lies_where_the_board_is_wide():
    wide = Checkerboard(inner_corners=(9, 5), square_m=0.025)
    _, width, height = content(board_page(wide, "a4"))
    assert (width, height) == pytest.approx(PAGES_MM["a4"][::-1], abs=1e-3)


def test_a_board_that_is_too_large_is_refused_with_one_that_fits():
    board = Checkerboard(inner_corners=(8, 6), square_m=0.04)
    with pytest.raises(CalibrationError, match="does not fit a4") as error:
        board_page(board, "a4")
    largest = float(re.search(r"square_m of ([\d.]+) at most", str(error.value)).group(1))
    assert "\n" not in str(error.value)
    board_page(board.model_copy(update={"square_m": largest}), "a4")
    with pytest.raises(CalibrationError):
        board_page(board.model_copy(update={"square_m": largest + 0.0002}), "a4")


def test_a_board_is_written_with_its_yaml(tmp_path):
    options = BoardPrint(type="aprilgrid", tags=(3, 2), tag_m=0.04, spacing=0.3, page="a4")
    pdf, description = write_board(options, tmp_path / "target.pdf")
    assert pdf.read_bytes() == board_page(options.described_board(), "a4")
    assert load_board(description) == Aprilgrid(tags=(3, 2), tag_m=0.04, spacing=0.3)
    again = BoardPrint(board=description)
    assert again.described_board() == options.described_board()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (BoardPrint(type="checkerboard", square_m=0.03), "inner_corners: is missing"),
        (BoardPrint(square_m=0.03), "no type"),
        (BoardPrint(type="circles", circles=(4, 5), square_m=0.02), "unknown key 'square_m'"),
        (BoardPrint(board="board.yaml", square_m=0.02), "give one or the other"),
    ],
)
def test_boards_that_are_not_described_are_refused(options, said, tmp_path):
    with pytest.raises(CalibrationError, match=said):
        write_board(options, tmp_path / "board.pdf")
    assert not list(tmp_path.iterdir())


def test_other_endings_are_refused(tmp_path):
    options = BoardPrint(type="checkerboard", inner_corners=(4, 3), square_m=0.03)
    with pytest.raises(CalibrationError, match=r"board\.pdf"):
        write_board(options, tmp_path / "board.png")

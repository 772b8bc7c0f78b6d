"""What is printed on a board, as rectangles and discs in its own frame.

The one source for pages, pictures and simulated views.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from sfm_calib.boards.spec import Aprilgrid, Board, Charuco, Checkerboard, Circles

GrayImage = NDArray[np.uint8]

TAG_BITS = 6  # along the side of a tag36h11's code
# Of the distance between circles; wide enough to be seen from afar, and none touches another.
DEFAULT_DIAMETER = 0.55


@dataclass(frozen=True)
class Pattern:
    """Shapes in metres in the board's frame (y down): ink on paper, or paper on ink if inverted."""

    rectangles: FloatArray  # (n, 4) left, top, right, bottom
    discs: FloatArray  # (n, 3) centre x, y, diameter
    box: tuple[float, float, float, float]  # left, top, right, bottom of all shapes
    margin_m: float  # that must stay empty around the box
    inverted: bool


def pattern_of(board: Board) -> Pattern:
    """The shapes of a board."""
    discs = np.zeros((0, 3))
    rectangles = np.zeros((0, 4))
    inverted = False
    if isinstance(board, Checkerboard):
        rectangles = _squares(board.columns + 1, board.rows + 1, board.square_m, 0)
        margin_m = board.square_m
        box = _around(board.columns + 1, board.rows + 1, board.square_m)
    elif isinstance(board, Charuco):
        rectangles = _charuco(board)
        margin_m, inverted = board.square_m / 2, board.inverted
        box = _around(*board.squares, board.square_m)
    elif isinstance(board, Aprilgrid):
        rectangles = _aprilgrid(board)
        margin_m, inverted = board.spacing * board.tag_m, board.inverted
        box = _box(rectangles)
    else:
        assert isinstance(board, Circles)
        diameter_m = board.diameter_m or DEFAULT_DIAMETER * board.nearest_m
        centres = board.corners_m[:, :2]
        discs = np.column_stack([centres, np.full(len(centres), diameter_m)])
        margin_m, inverted = board.nearest_m / 2, board.inverted
        box = _box(np.column_stack([centres - diameter_m / 2, centres + diameter_m / 2]))
    return Pattern(rectangles, discs, box, margin_m, inverted)


def _squares(columns: int, rows: int, side_m: float, first: int) -> FloatArray:
    """Every other square (n, 4), from the one at the top left if `first` is 0; corner 0 lies at
    the bottom right of that one."""
    j, i = np.divmod(np.arange(columns * rows), columns)
    black = (i + j) % 2 == first
    left, top = (i[black] - 1) * side_m, (j[black] - 1) * side_m
    result: FloatArray = np.column_stack([left, top, left + side_m, top + side_m])
    return result


def _around(columns: int, rows: int, side_m: float) -> tuple[float, float, float, float]:
    return (-side_m, -side_m, (columns - 1) * side_m, (rows - 1) * side_m)


def _box(rectangles: FloatArray) -> tuple[float, float, float, float]:
    left, top = rectangles[:, :2].min(axis=0)
    right, bottom = rectangles[:, 2:].max(axis=0)
    return float(left), float(top), float(right), float(bottom)


def marker_squares(board: Charuco) -> FloatArray:
    """Top left corners (n, 2) of the squares with markers, in the order of their ids."""
    columns, rows = board.squares
    # OpenCV before 4.6 began with a white square where the rows are even.
    first = 1 if board.legacy and rows % 2 == 0 else 0
    white = _squares(columns, rows, board.square_m, 1 - first)
    return white[:, :2]


def _charuco(board: Charuco) -> FloatArray:
    columns, rows = board.squares
    first = 1 if board.legacy and rows % 2 == 0 else 0
    dictionary = aruco_dictionary(board)
    bits = dictionary.markerSize + 2  # with the black frame
    gap_m = (board.square_m - board.marker_m) / 2
    parts = [_squares(columns, rows, board.square_m, first)]
    for number, corner in enumerate(marker_squares(board)):
        image = dictionary.generateImageMarker(number, bits, None, 1)
        parts.append(_black_cells(image, corner + gap_m, board.marker_m / bits))
    return np.concatenate(parts)


def aruco_dictionary(board: Charuco | Aprilgrid) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a board's markers."""
    name = board.dictionary if isinstance(board, Charuco) else "DICT_APRILTAG_36h11"
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _black_cells(image: GrayImage, corner: FloatArray, cell_m: float) -> FloatArray:
    """Rectangles (n, 4) of the black runs in each row of a picture with one pixel a cell."""
    runs = []
    for row, line in enumerate(image):
        edges = np.flatnonzero(np.diff(np.concatenate([[255], line, [255]]).astype(int)))
        for left, right in edges.reshape(-1, 2):
            runs.append((left, row, right, row + 1))
    cells: FloatArray = np.array(runs, dtype=float) * cell_m
    return cells + np.tile(corner, 2)


def _aprilgrid(board: Aprilgrid) -> FloatArray:
    dictionary = aruco_dictionary(board)
    bits = TAG_BITS + 2 * board.border_bits
    side_m, gap_m = board.tag_m, board.spacing * board.tag_m
    parts = []
    for number in range(board.tags[0] * board.tags[1]):
        row, column = divmod(number, board.tags[0])
        bottom_left = np.array([column, -row]) * (side_m + gap_m)
        code = dictionary.generateImageMarker(
            board.first_id + number, bits, None, board.border_bits
        )
        # OpenCV keeps AprilTags turned by half a turn against their authors, whom Kalibr follows.
        upright = np.rot90(code, 2)
        parts.append(_black_cells(upright, bottom_left - [0, side_m], side_m / bits))
    for row in range(board.tags[1] + 1):
        for column in range(board.tags[0] + 1):
            left = column * (side_m + gap_m) - gap_m
            bottom = -row * (side_m + gap_m) + gap_m
            parts.append(np.array([[left, bottom - gap_m, left + gap_m, bottom]]))
    return np.concatenate(parts)

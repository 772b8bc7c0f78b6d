"""Pictures of a board: flat, and as a camera sees it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from sfm_calib.boards.pattern import Pattern, pattern_of
from sfm_calib.boards.spec import Board

GrayImage = NDArray[np.uint8]

BLACK, WHITE = 0, 255
HALF = np.float32(0.5)  # px
# Samples in a pixel, on a lattice that has each at a row and a column of its own: an edge along
# either is placed to 0.01 px.
SAMPLES, TURNS = 55, 34
# Along the board's unit of length, of the picture that views are sampled from: tags of 8 or 10
# bits and the usual gaps between them end at whole cells.
CELLS = 120
OUTSIDE = 1e5  # px; of the picture, where a ray misses the plane


def board_image(board: Board, pixels_per_square: int) -> GrayImage:
    """The board with its margin, seen straight on: grey levels (height, width), 0 and 255.

    A square (or tag, or distance between rows of circles) is `pixels_per_square` wide.
    """
    return _raster(pattern_of(board), board.unit_m / pixels_per_square)


def image_corners(board: Board, pixels_per_square: int) -> FloatArray:
    """Where board_image shows the board's corners (n, 2)."""
    pattern = pattern_of(board)
    left, top = pattern.box[0] - pattern.margin_m, pattern.box[1] - pattern.margin_m
    pixel_m = board.unit_m / pixels_per_square
    result: FloatArray = (board.corners_m[:, :2] - [left, top]) / pixel_m - 0.5
    return result


def view_image(
    board: Board,
    board_from_pixel: Callable[[FloatArray], FloatArray],
    size: tuple[int, int],
    background: int = 128,
) -> GrayImage:
    """The board as a camera sees it: grey levels (height, width), every pixel the mean over its
    area.

    `board_from_pixel` takes pixels (n, 2) to points (n, 2) on the board's plane in metres.
    """
    pattern = pattern_of(board)
    flat = board_image(board, CELLS)
    corner = np.array([pattern.box[0] - pattern.margin_m, pattern.box[1] - pattern.margin_m])
    width, height = size
    x, y = np.meshgrid(np.arange(width + 1) - 0.5, np.arange(height + 1) - 0.5)
    place = board_from_pixel(np.column_stack([x.ravel(), y.ravel()])) - corner
    place = np.nan_to_num(place / (board.unit_m / CELLS), nan=-OUTSIDE, posinf=OUTSIDE)
    lattice = place.clip(-OUTSIDE, OUTSIDE).astype(np.float32).reshape(height + 1, width + 1, 2)
    total = np.zeros((height, width), np.float32)
    for number in range(SAMPLES):
        right = (np.float32(number) + HALF) / SAMPLES
        down = (np.float32(number * TURNS % SAMPLES) + HALF) / SAMPLES
        rows = (1 - down) * lattice[:-1] + down * lattice[1:]
        # remap takes the pixel whose centre is nearest; a pixel's area begins half before.
        sample = (1 - right) * rows[:, :-1] + right * rows[:, 1:] - HALF
        total += cv2.remap(
            flat, sample, None, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, background
        )
    return np.asarray(np.rint(total / SAMPLES), dtype=np.uint8)


def _raster(pattern: Pattern, pixel_m: float) -> GrayImage:
    left, top, right, bottom = pattern.box
    margin_m = pattern.margin_m
    width = int(np.rint((right - left + 2 * margin_m) / pixel_m))
    height = int(np.rint((bottom - top + 2 * margin_m) / pixel_m))
    x = left - margin_m + (np.arange(width) + 0.5) * pixel_m
    y = top - margin_m + (np.arange(height) + 0.5) * pixel_m
    image = np.full((height, width), BLACK if pattern.inverted else WHITE, np.uint8)
    ink = WHITE if pattern.inverted else BLACK
    for x0, y0, x1, y1 in pattern.rectangles:
        image[_between(y, y0, y1), _between(x, x0, x1)] = ink
    for centre_x, centre_y, diameter in pattern.discs:
        rows = _between(y, centre_y - diameter / 2, centre_y + diameter / 2)
        columns = _between(x, centre_x - diameter / 2, centre_x + diameter / 2)
        squared = (x[columns] - centre_x) ** 2 + (y[rows, None] - centre_y) ** 2
        image[rows, columns][squared < diameter**2 / 4] = ink
    return image


def _between(places: NDArray[np.floating], low: float, high: float) -> slice:
    first, last = np.searchsorted(places, [low, high])
    return slice(int(first), int(last))

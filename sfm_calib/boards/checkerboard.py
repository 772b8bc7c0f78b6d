"""Checkerboards in images: OpenCV finds the grid, its numbering is settled by colours.

OpenCV numbers a checkerboard as it comes, now and then mirrored or turned. Here the numbering is
always that of a board seen from its front; where colours tell the two ends of a board apart, the
square before corner 0 is black.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import IntArray
from sfm_calib.boards.local import full_size, local_maps, reduced
from sfm_calib.boards.saddle import Saddles, fit_saddles
from sfm_calib.boards.spec import Checkerboard
from sfm_calib.boards.views import Detection

GrayImage = NDArray[np.uint8]

SMALL_PX, LARGE_PX = 320_000, 1_100_000
QUADS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
# Without CALIB_CB_ACCURACY, which triples the time: the corners are fitted afterwards.
SECTORS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
CLEAR = 0.45  # of a square: how far around a corner nothing but it is seen
# Of a board's corners, that must turn out as crossings with the colours of a checkerboard.
LEAST_GOOD = 0.75
# A line of squares past those around the outer corners belongs to a larger board if it goes from
# black to white and back with so much of the board's contrast, and does little else.
PAST, LEAST_SWING, LEAST_FOLLOWED = 1.3, 0.4, 0.7


def find_checkerboard(image: GrayImage, board: Checkerboard) -> Detection | None:
    """The board's corners, all or nearly all of them, or None.

    A grid that is part of a larger checkerboard is not this board.
    """
    for grid in grids(image, board.columns, board.rows):
        found = _checked(image, grid)
        if found is not None:
            return found
    return None


def grids(image: GrayImage, columns: int, rows: int) -> Iterator[FloatArray]:
    """Grids (rows, columns, 2) of corners that OpenCV sees, the cheapest way first.

    On 82 photographs of boards its sector detector alone finds 77 at the small size and its quad
    detector 76; together they find 80, and the other two do not show the whole board.
    """
    small, scale = reduced(image, SMALL_PX)
    found, corners = cv2.findChessboardCorners(small, (columns, rows), flags=QUADS)
    if found:
        yield full_size(corners, scale).reshape(rows, columns, 2)
    for pixels in (SMALL_PX, LARGE_PX):
        larger, larger_scale = reduced(image, pixels)
        if pixels > SMALL_PX and larger.size < 1.2 * small.size:
            return
        found, corners = cv2.findChessboardCornersSB(larger, (columns, rows), flags=SECTORS)
        if found:
            yield full_size(corners, larger_scale).reshape(rows, columns, 2)


def _checked(image: GrayImage, grid: FloatArray) -> Detection | None:
    """The corners of a grid (rows, columns, 2) in the board's order, if it is a whole board."""
    grid = _from_front(grid)
    rows, columns = grid.shape[:2]
    saddles = _fit(image, grid)
    signs = np.sign(saddles.contrast).reshape(rows, columns) * _chequers(rows, columns)
    black_first = (signs.ravel() * saddles.good).sum() >= 0
    good = saddles.good & (signs.ravel() == (1 if black_first else -1))
    if good.mean() < LEAST_GOOD or not _is_whole(image, grid) or _is_part(image, grid, saddles):
        return None
    numbers = _numbers(rows, columns, bool(black_first))
    order = np.argsort(numbers[good])
    return Detection(
        numbers[good][order], saddles.pixels[good][order], saddles.sigma_px[good][order]
    )


def _from_front(grid: FloatArray) -> FloatArray:
    """The grid with its columns to the right of each other where its rows go down."""
    right, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    turn = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
    return grid if turn.sum() > 0 else grid[:, ::-1]


def _chequers(rows: int, columns: int) -> IntArray:
    return np.asarray(1 - 2 * (np.add.outer(np.arange(rows), np.arange(columns)) % 2))


def _numbers(rows: int, columns: int, black_first: bool) -> IntArray:
    """The board's number of each corner of a grid (rows * columns,).

    A grid with a white square before its first corner is turned: by half a turn, which swaps the
    colours of an odd sum of columns and rows, or by a quarter, which does in an odd square.
    """
    numbers = np.arange(rows * columns).reshape(rows, columns)
    if not black_first and (rows + columns) % 2:
        numbers = numbers[::-1, ::-1]
    elif not black_first and rows == columns and rows % 2:
        numbers = np.rot90(numbers)
    return numbers.ravel()


def _fit(image: GrayImage, grid: FloatArray) -> Saddles:
    """The corners of a grid (rows, columns, 2), fitted."""
    rows, columns = grid.shape[:2]
    place = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    maps = local_maps(place.reshape(-1, 2).astype(float), grid.reshape(-1, 2))
    assert maps is not None  # two rows and columns at least
    return fit_saddles(image, grid.reshape(-1, 2), maps, CLEAR)


def _is_whole(image: GrayImage, grid: FloatArray) -> bool:
    """Whether the squares between the corners are black and white by turns: no line is left out."""
    middles = (grid[1:, 1:] + grid[1:, :-1] + grid[:-1, 1:] + grid[:-1, :-1]) / 4
    swing, followed = _swing(image, middles)
    return swing != 0 and followed > LEAST_FOLLOWED


def _swing(image: GrayImage, places: FloatArray) -> tuple[float, float]:
    """How far up and down the grey levels at places (rows, columns, 2) go by turns, and the share
    of their variance that this explains."""
    grey = cv2.remap(image, places.astype(np.float32), None, cv2.INTER_LINEAR)
    levels = np.reshape(grey, places.shape[:2]).astype(float)
    chequers = _chequers(*places.shape[:2]).astype(float)
    chequers -= chequers.mean()
    levels -= levels.mean()
    power, total = (chequers**2).sum(), (levels**2).sum()
    if power == 0 or total == 0:
        return 0.0, 0.0
    swing = float((levels * chequers).sum() / power)
    return swing, float(swing**2 * power / total)


def _is_part(image: GrayImage, grid: FloatArray, saddles: Saddles) -> bool:
    """Whether the squares go on beside the grid, as in a larger board.

    The squares around a board's outer corners are its last: past them lies the margin, where those
    of a larger board go on from black to white.
    """
    typical = float(np.median(np.abs(saddles.contrast[saddles.good])))
    for turned in (grid, grid[::-1], grid.transpose(1, 0, 2), grid[:, ::-1].transpose(1, 0, 2)):
        step = turned[0] - turned[1]
        bend = turned[0] - 2 * turned[1] + turned[2] if len(turned) > 2 else 0 * step
        past = turned[0] + PAST * step + PAST * (PAST + 1) / 2 * bend
        middles = (past[1:] + past[:-1]) / 2  # of the squares past the outer ones
        swing, followed = _swing(image, middles[None])
        if abs(swing) > LEAST_SWING * typical and followed > LEAST_FOLLOWED:
            return True
    return False

"""ChArUco boards and AprilGrids in images: OpenCV reads the markers, corners are then fitted."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from graphs.frames import FloatArray
from graphs.problem import IntArray
from sfm_calib.boards.local import full_size, local_maps, misfit, reduced
from sfm_calib.boards.pattern import TAG_BITS, aruco_dictionary
from sfm_calib.boards.saddle import Saddles, fit_saddles
from sfm_calib.boards.spec import Aprilgrid, Board, Charuco
from sfm_calib.boards.views import Detection

GrayImage = NDArray[np.uint8]
Reader = Callable[[GrayImage], tuple[IntArray, FloatArray]]  # numbers and pixels of corners

# Markers are read in about so many pixels, which takes 0.05 s. Where that shows less than half of
# the board they are read again: in all of a larger image, or in a smaller one made twice as large,
# which parts the tags of an AprilGrid from the squares that touch them.
READ_PX = 2_500_000
# Of the way to the nearest other edge: a fit must not see it, and blur carries it closer.
CLEAR = 0.9
# Of the way between neighbouring corners; renders seen at 60 deg stay below 0.1.
MOST_MISFIT = 0.25
GROWTH = 4  # rounds in which corners beside known ones are looked for
REACH, PREDICTORS = 1.6, 4  # how far beside them, in sides of a square or tag; and from how many
# Contrast beside the board's typical corner, at least (and at most its inverse): edges of occluders
# are otherwise. Corners that no marker speaks for must be more alike: with the first limit alone 13
# come into 48 video frames with a hand on the board, some 4 px off; with these 7, all of them good.
LEAST_CONTRAST, GROWN_CONTRAST, GROWN_SIGMA = 0.35, 0.6, 3.0
# Kalibr's corner of a tag (row up, column) for each of OpenCV's four. OpenCV keeps AprilTags turned
# by half a turn, and goes clockwise from the top left: here the bottom right.
TAG_CORNERS = ((0, 1), (0, 0), (1, 0), (1, 1))


def find_charuco(image: GrayImage, board: Charuco) -> Detection | None:
    """The corners that an image shows, of the board in part or whole, or None."""
    detector = _charuco_detector(board)

    def read(picture: GrayImage) -> tuple[IntArray, FloatArray]:
        corners, numbers, _, _ = detector.detectBoard(picture)
        if numbers is None or len(numbers) == 0:
            return _nothing()
        return np.ravel(numbers).astype(np.int64), np.reshape(corners, (-1, 2)).astype(float)

    # The nearest other edge is the marker's corner, which lies in the diagonal of its square.
    clear_m = np.sqrt(0.5) * (board.square_m - board.marker_m)
    return _fitted(image, board, _read(image, board, read), clear_m)


def find_aprilgrid(image: GrayImage, board: Aprilgrid) -> Detection | None:
    """The corners of all tags that an image shows, or None."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = board.border_bits
    detector = cv2.aruco.ArucoDetector(aruco_dictionary(board), parameters)
    n_tags = board.tags[0] * board.tags[1]

    def read(picture: GrayImage) -> tuple[IntArray, FloatArray]:
        found, ids, _ = detector.detectMarkers(picture)
        tags = np.ravel(ids).astype(np.int64) - board.first_id if len(found) else np.zeros(0, int)
        known = (tags >= 0) & (tags < n_tags)
        # A tag that is seen twice is on something else as well.
        once = np.isin(tags, [tag for tag in tags[known] if np.count_nonzero(tags == tag) == 1])
        if not once.any():
            return _nothing()
        row, column = np.divmod(tags[once], board.tags[0])
        up, right = np.array(TAG_CORNERS).T
        numbers = (2 * row[:, None] + up) * board.columns + 2 * column[:, None] + right
        return numbers.ravel(), np.reshape(found, (-1, 4, 2))[once].reshape(-1, 2).astype(float)

    # The next tag's corner, or the first bit of the code inside the frame.
    frame = board.border_bits / (TAG_BITS + 2 * board.border_bits)
    clear_m = min(board.spacing, np.sqrt(2) * frame) * board.tag_m
    return _fitted(image, board, _read(image, board, read), clear_m)


def _nothing() -> tuple[IntArray, FloatArray]:
    return np.zeros(0, np.int64), np.zeros((0, 2))


def _charuco_detector(board: Charuco) -> cv2.aruco.CharucoDetector:
    layout = cv2.aruco.CharucoBoard(
        board.squares, board.square_m, board.marker_m, aruco_dictionary(board)
    )
    layout.setLegacyPattern(board.legacy)
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1  # of the two beside a corner; the fit judges the corner
    return cv2.aruco.CharucoDetector(layout, parameters)


def _read(image: GrayImage, board: Board, read: Reader) -> tuple[IntArray, FloatArray]:
    """Numbers and pixels of the corners, read in the size that shows half the board or most."""
    small, scale = reduced(image, READ_PX)
    numbers, pixels = read(small)
    pixels = full_size(pixels, scale)
    if 2 * len(numbers) >= len(board.corners_m):
        return numbers, pixels
    if small is image:
        other, factor = np.asarray(cv2.resize(image, None, fx=2, fy=2), np.uint8), np.full(2, 2.0)
    else:
        other, factor = image, np.ones(2)
    more, seen = read(other)
    return (more, full_size(seen, factor)) if len(more) > len(numbers) else (numbers, pixels)


def _fitted(
    image: GrayImage, board: Board, found: tuple[IntArray, FloatArray], clear_m: float
) -> Detection | None:
    """The corners that a fit confirms, and those beside them; none if all lie on one line."""
    order = np.argsort(found[0])
    numbers, pixels = found[0][order], found[1][order]
    place = board.corners_m[:, :2]
    maps = local_maps(place[numbers], pixels)
    if maps is None or np.median(np.linalg.det(maps)) <= 0:
        return None
    saddles = fit_saddles(image, pixels, maps, CLEAR * clear_m)
    if np.count_nonzero(saddles.good) < 2 or _is_mixed_up(place[numbers], saddles):
        return None  # markers of another layout
    # Black and white change places from one corner to the next, in both types.
    chequers = _chequers(board)
    level = np.median((saddles.contrast * chequers[numbers])[saddles.good])
    good = saddles.good & _is_like(saddles.contrast * chequers[numbers], level, LEAST_CONTRAST)
    seen = Detection(numbers[good], saddles.pixels[good], saddles.sigma_px[good])
    for _ in range(GROWTH):
        grown = _grown(image, board, seen, clear_m, float(level))
        if grown is None:
            break
        seen = grown
    return seen


def _is_mixed_up(place: FloatArray, saddles: Saddles) -> bool:
    good = saddles.good
    maps = local_maps(place[good], saddles.pixels[good])
    return maps is None or misfit(place[good], saddles.pixels[good], maps) > MOST_MISFIT


def _chequers(board: Board) -> IntArray:
    row, column = np.divmod(np.arange(len(board.corners_m)), board.columns)
    return np.asarray(1 - 2 * ((row + column) % 2))


def _is_like(contrast: FloatArray, level: float, least: float) -> NDArray[np.bool_]:
    share = contrast / level
    return np.asarray((share > least) & (share < 1 / least))


def _grown(
    image: GrayImage, board: Board, seen: Detection, clear_m: float, level: float
) -> Detection | None:
    """The detection with corners beside its own, which it predicts and a fit confirms, if any.

    A tag that cannot be read, for noise or a finger, leaves its corners to be found so.
    """
    place = board.corners_m[:, :2]
    maps = local_maps(place[seen.corner], seen.pixels) if len(seen.corner) else None
    others = np.setdiff1d(np.arange(len(place)), seen.corner)
    if maps is None or not len(others):
        return None
    count = min(PREDICTORS, len(seen.corner))
    far, near = cKDTree(place[seen.corner]).query(place[others], count)
    near, others = near[far[:, 0] < REACH * board.unit_m], others[far[:, 0] < REACH * board.unit_m]
    if not len(others):
        return None
    step = place[others][:, None] - place[seen.corner][near]  # (n, k, 2)
    guesses = seen.pixels[near] + np.einsum("nkab,nkb->nka", maps[near], step)
    guess, guess_map = guesses.mean(axis=1), maps[near].mean(axis=1)
    saddles = fit_saddles(image, guess, guess_map, CLEAR * clear_m)
    spread = np.linalg.norm(saddles.pixels - guess, axis=1)
    closest = clear_m * np.linalg.norm(guess_map, -2, axis=(1, 2))
    good = saddles.good & _is_like(
        saddles.contrast * _chequers(board)[others], level, GROWN_CONTRAST
    )
    good &= spread < CLEAR * closest
    good &= saddles.sigma_px < GROWN_SIGMA * np.median(seen.sigma_px)
    if not good.any():
        return None
    numbers = np.concatenate([seen.corner, others[good]])
    order = np.argsort(numbers)
    pixels = np.concatenate([seen.pixels, saddles.pixels[good]])
    sigma_px = np.concatenate([seen.sigma_px, saddles.sigma_px[good]])
    return Detection(numbers[order], pixels[order], sigma_px[order])

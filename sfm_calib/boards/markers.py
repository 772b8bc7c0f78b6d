"""ChArUco boards and AprilGrids in images: OpenCV reads the markers, corners are then fitted."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import IntArray
from sfm_calib.boards.local import full_size, local_maps, reduced
from sfm_calib.boards.pattern import TAG_BITS, aruco_dictionary
from sfm_calib.boards.saddle import fit_saddles
from sfm_calib.boards.spec import Aprilgrid, Board, Charuco
from sfm_calib.boards.views import Detection

GrayImage = NDArray[np.uint8]
Reader = Callable[[GrayImage], tuple[IntArray, FloatArray]]  # numbers and pixels of corners

# Markers are read in about so many pixels first, which takes 0.05 s, and in all of a larger image
# only if that shows less than half of the board.
READ_PX = 2_500_000
# Of the way to the nearest other edge: a fit must not see it, and blur carries it closer.
CLEAR = 0.9
LEAST_CONTRAST = 0.3  # of the board's typical corner: an occluder's edges are weaker or stronger
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
    """Numbers and pixels of the corners, read in a smaller image where that shows enough."""
    small, scale = reduced(image, READ_PX)
    numbers, pixels = read(small)
    if small is image or 2 * len(numbers) >= len(board.corners_m):
        return numbers, full_size(pixels, scale)
    whole = read(image)
    return whole if len(whole[0]) >= len(numbers) else (numbers, full_size(pixels, scale))


def _fitted(
    image: GrayImage, board: Board, found: tuple[IntArray, FloatArray], clear_m: float
) -> Detection | None:
    """The corners that a fit confirms; none if they all lie on one line."""
    order = np.argsort(found[0])
    numbers, pixels = found[0][order], found[1][order]
    maps = local_maps(board.corners_m[numbers, :2], pixels)
    if maps is None or np.median(np.linalg.det(maps)) <= 0:
        return None
    saddles = fit_saddles(image, pixels, maps, CLEAR * clear_m)
    if not saddles.good.any():
        return None
    typical = float(np.median(np.abs(saddles.contrast[saddles.good])))
    good = saddles.good & (np.abs(saddles.contrast) > LEAST_CONTRAST * typical)
    return Detection(numbers[good], saddles.pixels[good], saddles.sigma_px[good])

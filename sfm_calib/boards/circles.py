"""Grids of circles in images: OpenCV finds the grid, ellipses are fitted to the grey levels.

The centre of a circle's image is not the image of its centre: perspective draws it towards the
near side. The shift follows from a homography and the circle's size, both taken from the image,
and is taken off.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from sfm_calib.boards.disc import fit_discs
from sfm_calib.boards.local import full_size, local_maps, reduced
from sfm_calib.boards.spec import Circles
from sfm_calib.boards.views import Detection

GrayImage = NDArray[np.uint8]

# OpenCV's blobs are 25 to 5000 px large, so that big circles are found in small images only.
SIZES_PX = (320_000, 1_300_000)
LEAST_GOOD = 0.75  # of the circles, that must turn out as discs
REACH = 0.5  # of the distance to the next circle: no fit may see that
LAST_STEPS = 3  # of the correction, each with the homography of the corrected centres
# Of a grid from a homography, in distances of circles: a lens that bends lines makes 0.1, rows that
# are mixed up 0.5.
MOST_MISFIT = 0.3


def find_circles(image: GrayImage, board: Circles) -> Detection | None:
    """The centres of the circles, all or nearly all of them, or None."""
    for size in SIZES_PX:
        small, scale = reduced(image, size)
        if size > SIZES_PX[0] and small.size < 1.2 * SIZES_PX[0]:
            break
        found = _grid(small, board)
        if found is not None:
            return _fitted(image, full_size(found, scale), board)
    return None


def _grid(image: GrayImage, board: Circles) -> FloatArray | None:
    """Rough centres (n, 2) in the board's order as seen from its front."""
    kind = cv2.CALIB_CB_ASYMMETRIC_GRID if board.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    detector = cv2.SimpleBlobDetector.create(_blobs(image))
    for how in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(image, board.circles, flags=how, blobDetector=detector)
        if found:
            return _from_front(np.reshape(centres, (-1, 2)).astype(float), board)
    return None


def _blobs(image: GrayImage) -> cv2.SimpleBlobDetector.Params:
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea = 12.0
    parameters.maxArea = image.size / 50
    parameters.minDistBetweenBlobs = 4.0
    return parameters


def _from_front(centres: FloatArray, board: Circles) -> FloatArray | None:
    """Centres (n, 2) renumbered until they lie as the board's circles do, seen from its front.

    OpenCV numbers some grids mirrored, and asymmetric ones of even rows from the last pair of rows
    to the first.
    """
    numbers = np.arange(len(centres)).reshape(board.rows, board.columns)
    orders = [numbers, numbers[::-1]]
    if board.rows % 2 == 0:
        orders.append(numbers.reshape(-1, 2, board.columns)[::-1].reshape(numbers.shape))
    place = board.corners_m[:, :2]
    best, least = None, MOST_MISFIT
    for order in (*orders, *(order[:, ::-1] for order in orders)):
        placed = centres[order.ravel()]
        maps = local_maps(place, placed)
        if maps is None or np.median(np.linalg.det(maps)) <= 0:
            continue
        spacing_px = board.nearest_m * float(np.median(np.linalg.norm(maps, -2, axis=(1, 2))))
        misfit = float(np.abs(placed - _projected(place, placed)).mean()) / spacing_px
        if misfit < least:
            best, least = placed, misfit
    return best


def _projected(place: FloatArray, pixels: FloatArray) -> FloatArray:
    """Where the homography that fits best takes the places (n, 2)."""
    image_from_board, _ = cv2.findHomography(place / np.ptp(place), pixels)
    seen = cv2.perspectiveTransform((place / np.ptp(place))[None], image_from_board)
    return np.reshape(seen, (-1, 2))


def _fitted(image: GrayImage, pixels: FloatArray, board: Circles) -> Detection | None:
    place = board.corners_m[:, :2]
    maps = local_maps(place, pixels)
    assert maps is not None  # _from_front saw to it
    rough_m = 0.25 * board.nearest_m
    # Large discs are fitted in a smaller image: their pixels are many, and the noise averages.
    discs = fit_discs(image, pixels, maps, REACH * board.nearest_m, rough_m)
    if discs.good.mean() < LEAST_GOOD:
        return None
    radius_m = float(np.median(discs.radius_px / np.sqrt(np.abs(np.linalg.det(maps)))))
    shift = _perspective_shift(place, discs.pixels, discs.good, radius_m)
    good = discs.good
    return Detection(np.flatnonzero(good), (discs.pixels - shift)[good], discs.sigma_px[good])


def _perspective_shift(
    place: FloatArray, seen: FloatArray, good: NDArray[np.bool_], radius_m: float
) -> FloatArray:
    """By how much (n, 2) the centre of a circle's image lies beside the image of its centre.

    The image of a circle is H^-T C H^-1 with its centre where that conic's polar of infinity is.
    """
    centre = place[good].mean(axis=0)
    unit = (place - centre) / radius_m
    shift = np.zeros_like(seen)
    for _ in range(LAST_STEPS):
        image_from_board, _ = cv2.findHomography(unit[good], (seen - shift)[good])
        homogeneous = np.column_stack([unit, np.ones(len(unit))]) @ image_from_board.T
        projected = homogeneous[:, :2] / homogeneous[:, 2:]
        # The dual conic of the unit circle at (x, y); its last column is the ellipse's centre.
        x, y = unit.T
        ones = np.ones_like(x)
        dual = np.array([[x * x - 1, x * y, x], [x * y, y * y - 1, y], [x, y, ones]])
        seen_dual = np.einsum("ab,bcn,dc->nad", image_from_board, dual, image_from_board)
        shift = seen_dual[:, :2, 2] / seen_dual[:, 2, 2, None] - projected
    return shift

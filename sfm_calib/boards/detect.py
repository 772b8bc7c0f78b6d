"""Boards in images: which corners of a board an image shows, where, and how well that is known.

OpenCV finds the pattern; every corner is then fitted to the image's grey levels (saddle.py and
disc.py), which removes the detectors' biases and gives each corner a sigma.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sfm_calib.boards.checkerboard import find_checkerboard
from sfm_calib.boards.circles import find_circles
from sfm_calib.boards.markers import find_aprilgrid, find_charuco
from sfm_calib.boards.spec import Aprilgrid, Board, Charuco, Checkerboard, Circles
from sfm_calib.boards.views import Detection

FEWEST_CORNERS = 6  # a homography takes 4; what is left checks it


def detect(image: NDArray[np.uint8], board: Board) -> Detection | None:
    """The board's corners in an image of grey levels (height, width), or None.

    Pixels are OpenCV's, with integer centres. Checkerboards and circles are seen whole or nearly
    so, the other types in part as well; fewer than 6 corners are none. The numbering is that of a
    board seen from its front, up to `board.symmetries`; only a two-sided board is also found from
    its back.
    """
    if getattr(board, "inverted", False):
        image = 255 - image
    found = _find(np.ascontiguousarray(image), board)
    if getattr(board, "two_sided", False) and not _is_enough(found):
        found = _find(np.ascontiguousarray(image[:, ::-1]), board)
        if found is not None:
            unmirrored = found.pixels * [-1, 1] + [image.shape[1] - 1, 0]
            found = Detection(found.corner, unmirrored, found.sigma_px)
    return found if _is_enough(found) else None


def _is_enough(found: Detection | None) -> bool:
    return found is not None and len(found.corner) >= FEWEST_CORNERS


def _find(image: NDArray[np.uint8], board: Board) -> Detection | None:
    if isinstance(board, Checkerboard):
        return find_checkerboard(image, board)
    if isinstance(board, Charuco):
        return find_charuco(image, board)
    if isinstance(board, Aprilgrid):
        return find_aprilgrid(image, board)
    assert isinstance(board, Circles)
    return find_circles(image, board)

"""The neighbourhoods of observations, cut out of images that are decoded once where memory allows.

A patch whose samples lie far apart is cut out of a smaller image of a pyramid, so that no sample
passes over what lies between.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import BoolArray, IntArray
from sfm_calib.errors import CalibrationError
from sfm_calib.images import read_image
from sfm_calib.patches.warps import Warps

LEVELS = 5  # halvings at most: keypoints of 48 px scale fill whole images
SIDE = 44  # px of a crop: 15 samples up to 1.4 px apart, foreshortened, and room to move
MARGIN = SIDE // 2
MOST_BYTES = 2_000_000_000  # of images in memory


@dataclass
class Images:
    """The images of a scan by number, grey, those used last in memory; for any thread."""

    paths: Sequence[Path]
    most_bytes: int = MOST_BYTES
    _kept: OrderedDict[int, list[NDArray[np.uint8]]] = field(default_factory=OrderedDict)
    bytes_kept: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def pyramid(self, number: int) -> list[NDArray[np.uint8]]:
        """An image and its halvings, down to a size that still holds something; mirrored margins.

        Raises CalibrationError where it cannot be read.
        """
        with self._lock:
            return self._pyramid(number)

    def _pyramid(self, number: int) -> list[NDArray[np.uint8]]:
        if number in self._kept:
            self._kept.move_to_end(number)
            return self._kept[number]
        image = read_image(self.paths[number], cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is None:
            raise CalibrationError(f"{self.paths[number].name} can no longer be read: run again")
        levels = [image]
        while len(levels) <= LEVELS and min(levels[-1].shape) > 2:
            levels.append(cv2.pyrDown(levels[-1]))
        around = (MARGIN, MARGIN, MARGIN, MARGIN, cv2.BORDER_REFLECT_101)
        levels = [np.asarray(cv2.copyMakeBorder(level, *around), np.uint8) for level in levels]
        self._kept[number] = levels
        self.bytes_kept += sum(level.nbytes for level in levels)
        while self.bytes_kept > self.most_bytes and len(self._kept) > 1:
            _, gone = self._kept.popitem(last=False)
            self.bytes_kept -= sum(level.nbytes for level in gone)
        return levels


@dataclass(frozen=True)
class Crops:
    """Neighbourhoods of observations, and the warps in their pixels."""

    pixels: NDArray[np.uint8]  # (n, SIDE, SIDE)
    inside: FloatArray  # (n, 2, 2) first and last column and row of the image in them
    middle: FloatArray  # (n, 2)
    coefficients: FloatArray  # (n, 2, 6)
    px: FloatArray  # (n,) image pixels a crop's pixel


def cut_out(images: Images, number: IntArray, warps: Warps) -> Crops:
    """The crops of observations in their images, of the images by number (n,)."""
    step = np.sqrt(np.abs(np.linalg.det(warps.linear)))
    level = np.clip(np.round(np.log2(np.maximum(step, 1e-3))), 0, LEVELS).astype(np.int64)
    pixels = np.zeros((len(number), SIDE, SIDE), np.uint8)
    corner, size = np.zeros((len(number), 2), np.int64), np.zeros((len(number), 2), np.int64)
    for image in np.unique(number):
        levels = images.pyramid(int(image))
        level[number == image] = np.minimum(level[number == image], len(levels) - 1)
        for used in np.unique(level[number == image]):
            rows = np.flatnonzero((number == image) & (level == used))
            corner[rows] = np.round(warps.middle[rows] / 2.0**used).astype(np.int64) - MARGIN
            size[rows] = np.array(levels[used].shape[::-1]) - 2 * MARGIN
            column, line = corner[rows].T + MARGIN
            pixels[rows] = sliding_window_view(levels[used], (SIDE, SIDE))[line, column]
    px = 2.0**level
    edges = np.stack([np.maximum(-corner, 0), np.minimum(size - 1 - corner, SIDE - 1)], axis=1)
    return Crops(
        pixels,
        edges.astype(np.float64),
        warps.middle / px[:, None] - corner,
        warps.coefficients / px[:, None, None],
        px,
    )


def has_place(warps: Warps, sizes: IntArray) -> BoolArray:
    """Observations (n,) in their image, of size (n, 2), whose warp is known."""
    within = ((warps.middle > 0) & (warps.middle < sizes - 1)).all(1)
    return np.logical_and(within, np.isfinite(warps.coefficients).all((1, 2)))

"""How much the noise of two samples has in common, that are read between the pixels of an image.

Samples closer than a pixel share pixels, and a smaller image of a pyramid has noise whose
neighbours are alike. Whoever counts samples as if each said something of its own states a coarse
view three times too sure.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from graphs.frames import FloatArray
from graphs.problem import IntArray

A_PIXEL = 16  # entries of the table
REACH = 8  # pixels of the level: beyond, nothing is shared
HALVING = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16  # cv2.pyrDown's
# A cubic spline through pixels, halfway between two: what the four pixels on either side add
# (Unser, Aldroubi and Eden, IEEE Transactions on Signal Processing 41, 1993).
POLE = 3**0.5 - 2
SPLINE = 3**0.5 * POLE ** np.abs(np.arange(-5, 7))
HALFWAY = np.convolve(SPLINE, [1 / 48, 23 / 48, 23 / 48, 1 / 48])[3:11]
HALFWAY /= HALFWAY.sum()
KEYS = -0.75  # of torch's bicubic kernel


@cache
def shared_noise(n_levels: int) -> FloatArray:
    """Correlation (n_levels, A_PIXEL * REACH + 1) of samples so many A_PIXEL-ths apart, on one
    axis, by the level of the pyramid that they are read from; the mean over where they lie."""
    kernel = _kernel()
    read = np.convolve(kernel, kernel[::-1]) / A_PIXEL
    middle = len(kernel) - 1
    result = np.empty((n_levels, A_PIXEL * REACH + 1))
    of_pixel = np.array([1.0])  # what a pixel of the level takes of the first level's
    for level in range(n_levels):
        alike = np.correlate(of_pixel, of_pixel, "full")
        alike = alike[len(alike) // 2 % 2**level :: 2**level]
        lags = np.arange(len(alike)) - len(alike) // 2
        at = np.arange(A_PIXEL * REACH + 1)
        parts = [
            share * _at(read, middle + at - A_PIXEL * lag)
            for share, lag in zip(alike, lags, strict=True)
        ]
        result[level] = np.sum(parts, axis=0)
        result[level] /= result[level, 0]
        spread = np.zeros(2**level * (len(HALVING) - 1) + 1)
        spread[:: 2**level] = HALVING
        of_pixel = np.convolve(of_pixel, spread)
    return result


def _kernel() -> FloatArray:
    """What a sample takes of a pixel, A_PIXEL to a pixel: doubled by splines, then bicubic."""
    reach = len(HALFWAY) + 4
    doubled = doubling(reach + 1)[:, reach // 2]
    fine = np.arange(-reach * A_PIXEL // 2, reach * A_PIXEL // 2 + 1) * 2 / A_PIXEL
    far = np.abs(fine[:, None] - (np.arange(len(doubled)) - reach))
    near = (KEYS + 2) * far**3 - (KEYS + 3) * far**2 + 1
    next_to = KEYS * (far**3 - 5 * far**2 + 8 * far - 4)
    result: FloatArray = np.where(far <= 1, near, np.where(far < 2, next_to, 0.0)) @ doubled
    return result


@cache
def doubling(n: int) -> FloatArray:
    """Matrix (2 n - 1, n) from a row of pixels to one with as many between them.

    By cubic splines. torch's bicubic sampling alone (Keys' kernel with a = -0.75) errs by 0.015 px,
    more or less by where between the pixels a sample lies; of the doubled image by half of that.
    """
    result = np.zeros((2 * n - 1, n))
    result[::2] = np.eye(n)
    for row in range(n - 1):
        for k, share in enumerate(HALFWAY, row - len(HALFWAY) // 2 + 1):
            result[2 * row + 1, min(max(k, 0), n - 1)] += share
    return result


def _at(values: FloatArray, index: IntArray) -> FloatArray:
    """Entries of values, and 0 beyond them."""
    inside = (index >= 0) & (index < len(values))
    result: FloatArray = np.where(inside, values[np.clip(index, 0, len(values) - 1)], 0.0)
    return result

"""The inner loops of placing boards, compiled: points through two transforms, normal equations."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from graphs.frames import FloatArray
from graphs.lenses import IntArray

_kernel: Any = njit(cache=True, nogil=True, error_model="numpy")


@_kernel
def transform_rows(
    points: FloatArray, view: IntArray, group: IntArray,
    inner_rotation: FloatArray, inner_translation: FloatArray,
    outer_rotation: FloatArray, outer_translation: FloatArray,
    turned: FloatArray, in_cam: FloatArray,
) -> None:  # fmt: skip
    """Points (n, 3) of views (n,) through their group's inner and their view's outer transform.

    Written: turned (n, 3), the points rotated by the inner one, and in_cam (n, 3).
    """
    middle = np.empty(3)
    for row in range(len(points)):
        v = view[row]
        g = group[v]
        for i in range(3):
            turned[row, i] = 0.0
            for j in range(3):
                turned[row, i] += inner_rotation[g, i, j] * points[row, j]
            middle[i] = turned[row, i] + inner_translation[g, i]
        for i in range(3):
            in_cam[row, i] = outer_translation[v, i]
            for j in range(3):
                in_cam[row, i] += outer_rotation[v, i, j] * middle[j]


@_kernel
def normal_equations(
    view: IntArray, group: IntArray, weight: FloatArray, error: FloatArray,
    by_point: FloatArray, outer_rotation: FloatArray, turned: FloatArray,
    square: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """Add J'WJ to square (n_groups, 6, 6) and J'We to slope (n_groups, 6).

    J: by a turn about the axes of the inner transform's target, and by its translation. by_point
    (n, 2, 3) is in the camera. Only the lower triangle of `square` is written to.
    """
    row_of = np.empty(6)
    for row in range(len(error)):
        v = view[row]
        g = group[v]
        x, y, z = turned[row, 0], turned[row, 1], turned[row, 2]
        for k in range(2):
            for j in range(3):
                row_of[3 + j] = 0.0
                for i in range(3):
                    row_of[3 + j] += by_point[row, k, i] * outer_rotation[v, i, j]
            a, b, c = row_of[3], row_of[4], row_of[5]
            row_of[0], row_of[1], row_of[2] = y * c - z * b, z * a - x * c, x * b - y * a
            for i in range(6):
                weighted = weight[row] * row_of[i]
                slope[g, i] += weighted * error[row, k]
                for j in range(i + 1):
                    square[g, i, j] += weighted * row_of[j]

"""How keypoints err: Gaussian noise, the same for all or larger for coarse ones, and outliers."""

from __future__ import annotations

from typing import Literal

import numpy as np

from graphs.frames import FloatArray
from graphs.problem import IntArray

OutlierKind = Literal["uniform", "heavy"]

HEAVY_SCALE_PX, HEAVY_FREEDOM = 5.0, 2.0  # Student's t: no variance, as mismatches have none
# SIFT's scales: from the finest it looks for, over four octaves; each octave's pyramid level has a
# quarter of the pixels of the one before, and about a quarter of its keypoints.
FINEST_SCALE_PX, COARSEST_SCALE_PX = 1.6, 25.6
# A blob's centre is found to a share of its width, besides what errs in every pixel. The share is
# assumed, not measured: at 0.5 px of noise it makes keypoints of 10 px err by 0.9 px.
SHARE_OF_SCALE = 0.15


def draw_scales(
    point: IntArray, distance_m: FloatArray, n_points: int, rng: np.random.Generator
) -> FloatArray:
    """Scale (n_obs,) of each keypoint in px, as SIFT has them.

    Each point has a size of its own, four times as rare an octave; its keypoints shrink with the
    distance (n_obs,) relative to the track's geometric mean, down to the finest scale there is.
    """
    rarest = (FINEST_SCALE_PX / COARSEST_SCALE_PX) ** 2
    of_point = FINEST_SCALE_PX * rng.uniform(rarest, 1, n_points) ** -0.5
    views = np.maximum(np.bincount(point, minlength=n_points), 1)
    typical = np.exp(np.bincount(point, np.log(distance_m), n_points) / views)
    scales = of_point[point] * typical[point] / distance_m
    return np.clip(scales, FINEST_SCALE_PX, COARSEST_SCALE_PX)


def relative_noise(scale_px: FloatArray) -> FloatArray:
    """Noise (n,) of keypoints of scales (n,), in units of that of an infinitely fine one.

    1.03 at the finest scale, 1.8 at 10 px, 4 at the coarsest.
    """
    return np.sqrt(1 + (SHARE_OF_SCALE * scale_px) ** 2)


def with_outliers(
    pixels: FloatArray,
    share: float,
    kind: OutlierKind,
    size: tuple[int, int],
    rng: np.random.Generator,
) -> FloatArray:
    """Pixels (n_obs, 2) with a share of them wrong.

    uniform: anywhere in the image; heavy: Student's t around the right place.
    """
    count = round(share * len(pixels))
    wrong = rng.choice(len(pixels), count, replace=False)
    pixels = pixels.copy()
    if kind == "uniform":
        pixels[wrong] = rng.uniform(0, 1, (count, 2)) * (np.array(size) - 1.0)
    else:
        pixels[wrong] += HEAVY_SCALE_PX * rng.standard_t(HEAVY_FREEDOM, (count, 2))
    return pixels

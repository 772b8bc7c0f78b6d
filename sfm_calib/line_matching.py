"""Matches along epipolar lines: what a known rig at known places leaves to look through.

Of 2,400 features of a 640 x 480 image some thirty lie within 3 px of a line, so that two images
are matched in a third of the time that all against all take, and wrong matches are rare.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graphs.camera import Camera, focal_on_axis, unproject
from graphs.frames import FloatArray, Transform
from graphs.problem import IntArray
from graphs.threads import threads
from sfm_calib.features import Features
from sfm_calib.pairs import Pair

NEAR_LINE_PX = 3.0  # ten times what solved lenses and places leave
# COLMAP's: the best match is so much closer than the second, and no farther than that.
MOST_RATIO = 0.8
MOST_ANGLE = 0.7  # rad between descriptors


@dataclass(frozen=True)
class Sight:
    """What an image shows, as the kernel takes it."""

    rays: NDArray[np.float32]  # (n, 3) unit; NaN where the lens sees nothing
    descriptors: NDArray[np.int16]  # (n, 128)
    lengths: NDArray[np.float32]  # (n,) of the descriptors
    spots: IntArray  # (n,) as `Features.spots`
    px: float  # angle of a pixel


def sight_of(camera: Camera, features: Features) -> Sight:
    """The features of an image of a camera, without its distortion."""
    descriptors = features.descriptors.astype(np.int16)
    lengths = np.linalg.norm(descriptors.astype(np.float32), axis=1)
    rays = unproject(camera, features.pixels).astype(np.float32)
    px = 1.0 / float(focal_on_axis(camera).mean())
    return Sight(rays, descriptors, np.maximum(lengths, 1e-6), features.spots(), px)


def match_pairs(
    sights: Sequence[Sight | None],
    cam_from_world: Sequence[Transform | None],
    pairs: Sequence[Pair],
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Matches (n, 2) of each pair of images in turn, indices of their features; likeness (n,).

    Pairs are of images that have a place.
    """

    def match(pair: Pair) -> tuple[IntArray, FloatArray]:
        a, b = (sights[i] for i in pair)
        from_a, from_b = (cam_from_world[i] for i in pair)
        assert a is not None and b is not None and from_a is not None and from_b is not None
        return match_along_lines(a, b, from_b @ from_a.inverse)

    with threads() as pool:
        yield from pool.map(match, pairs)


def match_along_lines(a: Sight, b: Sight, b_from_a: Transform) -> tuple[IntArray, FloatArray]:
    """Matches (n, 2) of two images, each the best of both near the lines of the other.

    And their likeness (n,), the cosine between descriptors.
    """
    length = float(np.linalg.norm(b_from_a.translation))
    towards = b_from_a.translation / length if length > 0 else np.array([1.0, 0.0, 0.0])
    turned = (a.rays @ b_from_a.rotation.T).astype(np.float32)
    partner, likeness = _match(
        turned, a.descriptors, a.lengths, a.spots, b.rays, b.descriptors, b.lengths, b.spots,
        towards.astype(np.float32), np.float32(NEAR_LINE_PX * max(a.px, b.px)),
    )  # fmt: skip
    matched = np.flatnonzero(partner >= 0)
    return np.stack([matched, partner[matched]], axis=1), likeness[matched].astype(np.float64)


@njit(cache=True, nogil=True)
def _match(
    rays_a: Any, descriptors_a: Any, lengths_a: Any, spots_a: Any,
    rays_b: Any, descriptors_b: Any, lengths_b: Any, spots_b: Any,
    towards: Any, near: Any,
) -> Any:  # fmt: skip
    """The feature of b (n_a,) that matches each of a, -1: none, and how like it is.

    `rays_a` are turned into b's frame. A point at any depth before a is seen by b between its
    ray's direction, at infinity, and a's place.
    """
    n_a, n_b = len(rays_a), len(rays_b)
    best_a, second_a = np.full(n_a, np.float32(-1)), np.full(n_a, np.float32(-1))
    best_b, second_b = np.full(n_b, np.float32(-1)), np.full(n_b, np.float32(-1))
    of_a, of_b = np.full(n_a, -1), np.full(n_b, -1)
    x, y, z = rays_b[:, 0].copy(), rays_b[:, 1].copy(), rays_b[:, 2].copy()
    tx, ty, tz = towards
    off = np.empty(n_b, np.float32)
    for i in range(n_a):
        dx, dy, dz = rays_a[i]
        nx, ny, nz = ty * dz - tz * dy, tz * dx - tx * dz, tx * dy - ty * dx
        size = np.sqrt(nx * nx + ny * ny + nz * nz)
        if not size > 1e-6:
            continue
        nx, ny, nz = nx / size, ny / size, nz / size
        ux, uy, uz = ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx
        vx, vy, vz = dy * nz - dz * ny, dz * nx - dx * nz, dx * ny - dy * nx
        for j in range(n_b):
            off[j] = abs(nx * x[j] + ny * y[j] + nz * z[j])
        for j in range(n_b):
            if not off[j] < near:
                continue
            if ux * x[j] + uy * y[j] + uz * z[j] < -near:
                continue
            if vx * x[j] + vy * y[j] + vz * z[j] < -near:
                continue
            dot = np.int32(0)
            for k in range(descriptors_a.shape[1]):
                dot += np.int32(descriptors_a[i, k]) * np.int32(descriptors_b[j, k])
            alike = np.float32(dot) / (lengths_a[i] * lengths_b[j])
            if alike > best_a[i]:
                if of_a[i] < 0 or spots_b[of_a[i]] != spots_b[j]:
                    second_a[i] = best_a[i]
                best_a[i], of_a[i] = alike, j
            elif alike > second_a[i] and spots_b[of_a[i]] != spots_b[j]:
                second_a[i] = alike
            if alike > best_b[j]:
                if of_b[j] < 0 or spots_a[of_b[j]] != spots_a[i]:
                    second_b[j] = best_b[j]
                best_b[j], of_b[j] = alike, i
            elif alike > second_b[j] and spots_a[of_b[j]] != spots_a[i]:
                second_b[j] = alike
    for i in range(n_a):
        j = of_a[i]
        if j < 0:
            continue
        clear = _is_clear(best_a[i], second_a[i]) and _is_clear(best_b[j], second_b[j])
        if of_b[j] != i or not clear:
            of_a[i] = -1
    return of_a, best_a


@njit(cache=True, nogil=True)
def _is_clear(best: Any, second: Any) -> Any:
    angle = np.arccos(min(best, np.float32(1)))
    return angle < MOST_ANGLE and angle < MOST_RATIO * np.arccos(min(second, np.float32(1)))

"""How a board lies in the image around each of its corners."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from graphs.frames import FloatArray

GrayImage = NDArray[np.uint8]

NEIGHBOURS = 9  # corners, the own one among them: what a 3 x 3 patch has
FLATTEST = 0.05  # of the spread of the corners across to that along: less is a line


def local_maps(board_m: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """Derivative (n, 2, 2) of pixels by places on the board at corners (n, 2), from neighbours.

    None where the corners lie on one line. Lenses that bend lines leave it right, as a homography
    of the whole board would not.
    """
    if len(board_m) < 3 or _is_line(board_m):
        return None
    count = min(NEIGHBOURS, len(board_m))
    _, near = cKDTree(board_m).query(board_m, count)
    place = board_m[near] - board_m[near].mean(axis=1, keepdims=True)  # (n, k, 2)
    seen = pixels[near] - pixels[near].mean(axis=1, keepdims=True)
    normal = np.einsum("nka,nkb->nab", place, place)
    weakest = np.linalg.eigvalsh(normal)
    flat = weakest[:, 0] < FLATTEST**2 * weakest[:, 1]
    if flat.any():
        whole = board_m - board_m.mean(axis=0)
        mean = np.linalg.lstsq(whole, pixels - pixels.mean(axis=0), rcond=None)[0].T
        normal[flat] = np.eye(2)
    maps = np.einsum("nka,nkb->nab", seen, place) @ np.linalg.inv(normal)
    if flat.any():
        maps[flat] = mean
    result: FloatArray = maps
    return result


def misfit(board_m: FloatArray, pixels: FloatArray, maps: FloatArray) -> float:
    """How far corners typically lie from where their nearest neighbour's map takes them, as a share
    of the distance to it. Neighbours that do not belong together are as far off as apart."""
    _, near = cKDTree(board_m).query(board_m, 2)
    step = board_m[near[:, 1]] - board_m
    seen = pixels[near[:, 1]] - pixels
    mean = (maps + maps[near[:, 1]]) / 2
    expected = np.einsum("nab,nb->na", mean, step)
    off = np.linalg.norm(seen - expected, axis=1)
    return float(np.median(off / np.maximum(np.linalg.norm(seen, axis=1), 1e-9)))


def _is_line(points: FloatArray) -> bool:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] < FLATTEST * spread[0])


def reduced(image: GrayImage, pixels: int) -> tuple[GrayImage, FloatArray]:
    """The image with about so many pixels at most, and how much smaller each side is (2,)."""
    scale = float(np.sqrt(pixels / image.size))
    if scale >= 0.9:  # hardly smaller
        return image, np.ones(2)
    height, width = image.shape
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8), np.array(size) / [width, height]


def full_size(pixels: FloatArray, scale: FloatArray) -> FloatArray:
    """Pixels (n, 2) of an image made smaller, in the image it was made from."""
    result: FloatArray = (np.asarray(pixels, dtype=float).reshape(-1, 2) + 0.5) / scale - 0.5
    return result

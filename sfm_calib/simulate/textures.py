"""Textures in which no two places look alike, and their mip pyramids.

Natural images have about equal contrast in every octave, and edges of every length. Pink noise
gives the first (features at every distance), overlapping shapes of power-law size ("dead
leaves", Lee, Mumford and Huang, IJCV 2001) give the second. Nothing is tiled or reused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

TextureStyle = Literal["collage", "plaster", "stone", "wood"]
Grey = NDArray[np.uint8]
Float32 = NDArray[np.float32]

MIP_LEVELS = 7  # 1/64 of the finest: below a tenth of a cabin wall's texels nothing is left to see
COARSEST_NOISE_M = 0.8  # larger patches would only push whole walls into black or white
SMALLEST_LEAF_M, LARGEST_LEAF_M = 0.008, 0.3
MOST_CORNERS = 8


@dataclass(frozen=True)
class TextureSet:
    """The mip pyramids of all surfaces in one flat buffer, as the render kernel reads them."""

    texels: Grey  # (n_texels,) row after row, level after level, surface after surface
    start: NDArray[np.int64]  # (n_surfaces, MIP_LEVELS) index into texels
    shape: NDArray[np.int32]  # (n_surfaces, MIP_LEVELS, 2) rows, columns


def texture(
    style: TextureStyle, size_m: tuple[float, float], texels_per_m: float, rng: np.random.Generator
) -> Grey:
    """A fresh texture (rows, columns) in grey levels for a surface of `size_m` (width, height)."""
    columns, rows = (max(4, round(length * texels_per_m)) for length in size_m)
    shape = (rows, columns)
    noise = pink_noise(shape, texels_per_m, rng)
    if style == "collage":
        grey = _leaves(np.full(shape, 128, np.uint8), texels_per_m, 140, rng) + 4 * noise
    elif style == "plaster":
        base = np.clip(140 + 9 * noise, 0, 255).astype(np.uint8)
        grey = _leaves(base, texels_per_m, 60, rng) + 3 * pink_noise(shape, texels_per_m, rng)
    elif style == "stone":
        grey = _stones(shape, texels_per_m, rng) + 5 * noise
    else:
        base = np.clip(120 + 12 * _grain(shape, texels_per_m, rng), 0, 255).astype(np.uint8)
        grey = _leaves(base, texels_per_m, 70, rng) + 4 * noise
    return np.clip(grey, 5, 250).astype(np.uint8)


def pink_noise(shape: tuple[int, int], texels_per_m: float, rng: np.random.Generator) -> Float32:
    """Unit-variance noise (rows, columns) with equal contrast in every octave."""
    octaves = max(1, round(np.log2(COARSEST_NOISE_M * texels_per_m)))
    field = np.zeros((1, 1), np.float32)
    for octave in range(octaves, -1, -1):
        rows, columns = (-(-length // 2**octave) for length in shape)
        field = cv2.resize(field, (columns, rows), interpolation=cv2.INTER_CUBIC)
        field = field.reshape(rows, columns) + rng.standard_normal((rows, columns), np.float32)
    return (field - field.mean()) / field.std()


def pack(pictures: list[Grey]) -> TextureSet:
    """Mip pyramids of the pictures: a texel i of level l covers 2^l texels from 2^l i on."""
    chunks: list[Grey] = []
    start = np.zeros((len(pictures), MIP_LEVELS), np.int64)
    shape = np.zeros((len(pictures), MIP_LEVELS, 2), np.int32)
    total, block = 0, 2 ** (MIP_LEVELS - 1)
    for index, picture in enumerate(pictures):
        # Whole blocks only: a halved odd size would shift every coarser level by a part of a texel.
        rows, columns = (-length % block for length in picture.shape)
        level_picture = cv2.copyMakeBorder(picture, 0, rows, 0, columns, cv2.BORDER_REPLICATE)
        for level in range(MIP_LEVELS):
            if level:
                half = (level_picture.shape[1] // 2, level_picture.shape[0] // 2)
                level_picture = cv2.resize(level_picture, half, interpolation=cv2.INTER_AREA)
            level_picture = level_picture.reshape(
                -(-picture.shape[0] // block) * block >> level, -1
            )
            start[index, level], shape[index, level] = total, level_picture.shape
            chunks.append(level_picture.ravel())
            total += level_picture.size
    return TextureSet(np.concatenate(chunks), start, shape)


def _leaves(canvas: Grey, texels_per_m: float, per_m2: float, rng: np.random.Generator) -> Float32:
    """Polygons of power-law size over the canvas, the largest first."""
    rows, columns = canvas.shape
    count = max(8, round(per_m2 * rows * columns / texels_per_m**2))
    # density ~ r^-3, the scale-invariant law, by inverting its distribution function
    inverse_square = rng.uniform(LARGEST_LEAF_M**-2, SMALLEST_LEAF_M**-2, count)
    # the smallest leaves would take nearly all of them: mix with a flatter law
    flat = np.exp(rng.uniform(np.log(SMALLEST_LEAF_M), np.log(LARGEST_LEAF_M), count))
    radii = np.where(rng.random(count) < 0.5, inverse_square**-0.5, flat) * texels_per_m
    corners = rng.integers(3, MOST_CORNERS + 1, count)
    angles = rng.uniform(0, 2 * np.pi, (count, MOST_CORNERS))
    reach = np.sort(radii)[::-1, None] * rng.uniform(0.5, 1.0, (count, MOST_CORNERS))
    centres = rng.uniform((0, 0), (columns, rows), (count, 2))
    greys = rng.uniform(25, 230, count).tolist()
    for leaf in range(count):
        n = corners[leaf]
        around = np.sort(angles[leaf, :n])
        ring = np.stack([np.cos(around), np.sin(around)], axis=1)
        outline = np.round((centres[leaf] + reach[leaf, :n, None] * ring) * 16).astype(np.int32)
        cv2.fillPoly(canvas, [outline], greys[leaf], cv2.LINE_AA, 4)  # in sixteenths of a texel
    return canvas.astype(np.float32)


def _stones(shape: tuple[int, int], texels_per_m: float, rng: np.random.Generator) -> Float32:
    """Irregular stones, each of its own shade, with dark joints."""
    sites = np.full(shape, 255, np.uint8)
    count = max(4, round(60 * shape[0] * shape[1] / texels_per_m**2))
    sites[rng.integers(0, shape[0], count), rng.integers(0, shape[1], count)] = 0
    _, labels = cv2.distanceTransformWithLabels(
        sites, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    shades = rng.uniform(70, 215, labels.max() + 1).astype(np.float32)
    edges = (labels[1:, 1:] != labels[:-1, 1:]) | (labels[1:, 1:] != labels[1:, :-1])
    joints = np.pad(edges, ((1, 0), (1, 0))).astype(np.uint8)
    width = max(1, round(0.008 * texels_per_m))
    joints = cv2.dilate(joints, np.ones((width, width), np.uint8))
    blended = np.where(joints > 0, np.float32(45), shades[labels])
    return cv2.GaussianBlur(blended, (0, 0), 0.8)


def _grain(shape: tuple[int, int], texels_per_m: float, rng: np.random.Generator) -> Float32:
    """Pink noise six times longer along the columns: boards and veneer."""
    squeezed = pink_noise((shape[0], -(-shape[1] // 6)), texels_per_m, rng)
    stretched = cv2.resize(squeezed, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return stretched.reshape(shape)

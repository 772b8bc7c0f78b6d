"""A head-sized surface without a model of anyone: an ellipsoid with a nose, ears, a chin.

Its frame: origin within, x to the right and y down as one looks at the face, which looks along -z.
It is asymmetric, as faces are, so that only one place fits a scan of it.
"""

from __future__ import annotations

import numpy as np

from graphs.frames import FloatArray
from graphs.problem import IntArray

SEMI_AXES_M = (0.076, 0.108, 0.094)  # with all below some 0.17 x 0.23 x 0.21 m
# How far it stands out (m) about a direction, and within what of it: places and widths on the unit
# sphere. By hand, to look like a head.
RELIEF: tuple[tuple[tuple[float, float, float], tuple[float, float, float], float], ...] = (
    ((0.02, 0.13, -1.0), (0.09, 0.12, 0.4), 0.022),  # the nose, bent a little
    ((0.00, -0.13, -1.0), (0.07, 0.16, 0.4), 0.007),
    ((0.00, -0.30, -0.95), (0.40, 0.09, 0.4), 0.006),  # the brow
    ((0.31, -0.13, -0.95), (0.12, 0.09, 0.4), -0.007),  # the eyes
    ((-0.31, -0.13, -0.95), (0.12, 0.09, 0.4), -0.008),
    ((0.01, 0.41, -0.90), (0.17, 0.05, 0.4), 0.005),  # the lips
    ((0.02, 0.51, -0.86), (0.17, 0.05, 0.4), 0.004),
    ((0.03, 0.80, -0.60), (0.22, 0.16, 0.3), 0.014),  # the chin
    ((0.50, 0.20, -0.85), (0.20, 0.16, 0.3), 0.005),  # the cheeks
    ((-0.50, 0.18, -0.85), (0.20, 0.16, 0.3), 0.004),
    ((1.00, 0.03, 0.12), (0.30, 0.22, 0.07), 0.015),  # the ears
    ((-1.00, 0.06, 0.10), (0.30, 0.20, 0.08), 0.017),
    ((0.15, -0.15, 1.00), (0.45, 0.40, 0.5), 0.012),  # the back
    ((0.30, -0.85, 0.30), (0.30, 0.30, 0.3), 0.005),
    ((0.00, 0.80, 0.70), (0.60, 0.25, 0.4), -0.020),  # the nape
)
SUBDIVISIONS = 5  # of an icosahedron: edges of 4 mm


def make_head(subdivisions: int = SUBDIVISIONS) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) in m and triangles (m, 3), anticlockwise as one looks from outside."""
    directions, triangles = icosphere(subdivisions)
    radius = 1 / np.linalg.norm(directions / np.array(SEMI_AXES_M), axis=1)
    for place, width, height_m in RELIEF:
        centre = np.array(place) / np.linalg.norm(place)
        away = (directions - centre) / np.array(width)
        radius = radius + height_m * np.exp(-0.5 * (away**2).sum(axis=1))
    return radius[:, None] * directions, triangles


def icosphere(subdivisions: int) -> tuple[FloatArray, IntArray]:
    """Unit vectors (10 * 4^k + 2, 3) and triangles (20 * 4^k, 3): an icosahedron split k times."""
    golden = (1 + np.sqrt(5)) / 2
    corners = [(a * 1.0, b * golden, 0.0) for a in (-1, 1) for b in (-1, 1)]
    rolled = [np.roll(corner, shift) for shift in range(3) for corner in corners]
    vertices = np.array(rolled) / np.hypot(1, golden)
    gaps = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    near = (gaps > 0) & (gaps < 1.1 * gaps[gaps > 0].min())
    triangles = np.array([
        (i, j, k)
        for i in range(12) for j in range(i + 1, 12) for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ])  # fmt: skip
    a, b, c = (vertices[triangles[:, place]] for place in range(3))
    inwards = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    triangles[inwards] = triangles[inwards][:, [0, 2, 1]]
    for _ in range(subdivisions):
        vertices, triangles = _split(vertices, triangles)
    return vertices, triangles


def _split(vertices: FloatArray, triangles: IntArray) -> tuple[FloatArray, IntArray]:
    """Every triangle as four, their new corners on the sphere."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges, edge = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True)
    middle = vertices[edges].sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    ab, bc, ca = len(vertices) + edge.reshape(3, -1)
    a, b, c = triangles.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    found: IntArray = np.concatenate([np.stack(part, axis=1) for part in parts])
    return np.concatenate([vertices, middle]), found

"""Points looked for in every image that could show them: matches that no pair of images gave.

A point's place is known to a pixel once two views have it, so its features in other images are
found where it projects: after a gap, from another camera at another time, when the scan comes back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial import cKDTree

from graphs.camera import project
from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate, IntArray
from graphs.threads import threads
from sfm_calib.features import Features
from sfm_calib.line_matching import MOST_ANGLE

NEAR_POINT_PX = 2.0  # of where a point projects; solved lenses and places leave tenths
MOST_AT_A_PLACE = 3  # features looked at
MOST_TURN_DEG = 45.0  # between the rays that see a point: farther, its surroundings look different
MOST_SCALING = 2.0  # of a feature, over what its depth makes of it: another blob at its place


def links_to_points(
    start: Estimate,
    images: Sequence[tuple[int, int, int]],
    found: Sequence[Features],
    begins: IntArray,
    feature: IntArray,
    point: IntArray,
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Matches (n, 2) that each image gives in turn, indices of features of all images in a row.

    And their likeness (n,). images: (camera, frame, number in the scan).
    begins: (n_images + 1,) where each image's features begin.
    feature, point: (n_obs,) the observations that there are, sorted by point.
    """
    descriptors = np.concatenate([one.descriptors for one in found])
    scales = np.concatenate([one.scales for one in found])
    owner = np.repeat(np.arange(len(found)), np.diff(begins))[feature]
    places: dict[int, Transform] = {
        number: start.cam_from_rig[camera] @ start.rig_from_world[frame]
        for camera, frame, number in images
    }
    centres = np.full((len(found), 3), np.nan)
    for number, place in places.items():
        centres[number] = place.inverse.translation
    away = start.points[point] - centres[owner]
    depth = np.linalg.norm(away, axis=1)
    away /= depth[:, None]
    unit_scale = scales[feature] * depth  # of a feature at depth one
    first = np.searchsorted(point, np.arange(len(start.points) + 1))

    def look(image: tuple[int, int, int]) -> tuple[IntArray, FloatArray]:
        camera, _, number = image
        pixels = project(start.cameras[camera], places[number] @ start.points)
        near = _near(pixels, found[number].pixels)
        asked, slot = np.nonzero(near >= 0)
        seen_here = near[asked, slot]
        # Each candidate with every observation of its point.
        count = np.diff(first)[asked]
        rows = np.repeat(first[asked], count) + _counted(count)
        which = np.repeat(np.arange(len(asked)), count)
        here = start.points[asked] - centres[number]
        far = np.linalg.norm(here, axis=1)
        turn = (away[rows] * (here / far[:, None])[which]).sum(1)
        scaled = unit_scale[rows] / (found[number].scales[seen_here] * far)[which]
        fits = (turn > np.cos(np.radians(MOST_TURN_DEG))) & (owner[rows] != number)
        fits &= (scaled < MOST_SCALING) & (scaled > 1 / MOST_SCALING)
        rows, which = rows[fits], which[fits]
        alike = _likeness(descriptors[feature[rows]], found[number].descriptors[seen_here[which]])
        good = alike > np.cos(MOST_ANGLE)
        rows, which, alike = rows[good], which[good], alike[good]
        best = _best(alike, asked[which], seen_here[which])
        there = begins[number] + seen_here[which[best]]
        return np.stack([feature[rows[best]], there], axis=1), alike[best].astype(np.float64)

    with threads() as pool:
        yield from pool.map(look, images)


def _near(pixels: FloatArray, features: FloatArray) -> IntArray:
    """Features (n, MOST_AT_A_PLACE) near each pixel, the nearest first, -1: no more."""
    near = np.full((len(pixels), MOST_AT_A_PLACE), -1)
    visible = np.flatnonzero(np.isfinite(pixels).all(1))
    if len(features) and len(visible):
        distance, index = cKDTree(features).query(
            pixels[visible], MOST_AT_A_PLACE, distance_upper_bound=NEAR_POINT_PX
        )
        near[visible] = np.where(np.isfinite(distance), index, -1)
    return near


def _counted(counts: IntArray) -> IntArray:
    """0, 1, ... of each count in a row."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)


def _likeness(a: np.ndarray, b: np.ndarray) -> FloatArray:
    """Cosine (n,) between descriptors (n, 128)."""
    a, b = a.astype(np.float32), b.astype(np.float32)
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.einsum("nk,nk->n", a, b) / np.maximum(lengths, 1e-6)


def _best(alike: FloatArray, point: IntArray, feature: IntArray) -> IntArray:
    """The rows (n,) that are the best of their point, and of their feature too."""
    order = np.lexsort((-alike, point))
    of_point = order[np.unique(point[order], return_index=True)[1]]
    order = of_point[np.lexsort((-alike[of_point], feature[of_point]))]
    best: IntArray = order[np.unique(feature[order], return_index=True)[1]]
    return best

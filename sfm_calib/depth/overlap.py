"""How far two clouds of one surface are apart, across it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.frames import FloatArray
from sfm_calib.depth.cloud import Cloud

ASIDE = 2.0  # spacings of a surface's points: what lies farther aside is beyond its border
LEAST_COSINE = 0.5  # between normals of one surface: the other side of a thin one is none


@dataclass(frozen=True)
class Overlap:
    """Points of one cloud that lie on another surface, and what of that they lie on."""

    points: FloatArray  # (n, 3)
    others: FloatArray  # (n, 3) of the surface, nearest to them
    normals: FloatArray  # (n, 3) of the surface
    facing: (
        FloatArray  # (n, 3) normals of the points themselves; the surface's, where they have none
    )
    share: float  # of the first cloud's points

    @property
    def apart_m(self) -> FloatArray:
        """How far (n,) the points are before the surface, on the side of its normals."""
        return np.einsum("ni,ni->n", self.points - self.others, self.normals)

    @property
    def rms_m(self) -> float:
        """Of `apart_m`; zero where nothing overlaps."""
        return float(np.sqrt(np.mean(self.apart_m**2))) if len(self.points) else 0.0


def overlap(a: Cloud, b: Cloud, within_m: float) -> Overlap:
    """Points of a that lie on b's surface, or up to a distance before or behind it.

    Each has its nearest point of b straight below or above it, with a normal that agrees: what
    lies beside b's border does not count. b has normals; where a has none, any will do.
    """
    assert b.normals is not None
    if not len(a.points) or len(b.points) < 2:
        none = np.zeros((0, 3))
        return Overlap(none, none, none, none, 0.0)
    aside_m = ASIDE * b.spacing_m
    bound = float(np.hypot(within_m, aside_m))
    distance, nearest = b.tree.query(a.points, distance_upper_bound=bound)
    rows = np.flatnonzero(np.isfinite(distance))
    points, others, normals = a.points[rows], b.points[nearest[rows]], b.normals[nearest[rows]]
    across = np.einsum("ni,ni->n", points - others, normals)
    aside = np.sqrt(np.maximum(distance[rows] ** 2 - across**2, 0.0))
    kept = (aside <= aside_m) & (np.abs(across) <= within_m)
    facing = normals if a.normals is None else a.normals[rows]
    kept &= np.einsum("ni,ni->n", facing, normals) > LEAST_COSINE
    share = float(kept.sum()) / len(a.points)
    return Overlap(points[kept], others[kept], normals[kept], facing[kept], share)

"""How far a surface is from a reference: distances both ways, and laying one on the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.frames import FloatArray, Transform
from sfm_calib.depth.surface import Surface
from sfm_calib.errors import CalibrationError
from sfm_calib.record import Record

MOST_STEPS = 200
SETTLED_M = 1e-6  # a step that moves no point farther
# Or one that changes the rms by less of it: what slides, as a sphere turns, never rests.
SETTLED_RMS = 1e-6
LEAST_MATCHED = 10  # points; six tell a place
# Stages of `align_icp`: points farther than so many of the limit do not pull. A wide one first
# finds the place, and what has no counterpart bends the last one least.
STAGES = (4.0, 2.0, 1.0)


@dataclass(frozen=True)
class Distances:
    """From points to a surface."""

    unsigned: FloatArray  # (n,) m
    signed: FloatArray | None  # (n,) m, negative inside; None: the surface has no inside


class DistanceSummary(Record):
    """Distances of one direction, in m."""

    points: int
    mean_m: float
    rms_m: float
    median_m: float
    p95_m: float
    max_m: float
    mean_signed_m: float | None = None


@dataclass(frozen=True)
class Alignment:
    """How a cloud was laid on a surface."""

    transform: Transform  # surface_from_points
    matched: float  # share of the points within the limit
    rms_m: float  # of these, along the normals
    converged: bool


def surface_distance(points: FloatArray, surface: Surface) -> Distances:
    """Distances of points (n, 3) to the nearest point of a surface, in m.

    Of a cloud: to its nearest point, which is farther than the surface between its points.
    """
    nearest, _ = surface.closest(points)
    unsigned = np.linalg.norm(points - nearest, axis=1)
    if not surface.is_closed:
        return Distances(unsigned, None)
    return Distances(unsigned, np.where(surface.inside(points), -unsigned, unsigned))


def summary(
    distances: Distances, corners_m: FloatArray | None = None, within_m: float | None = None
) -> DistanceSummary:
    """Mean, root mean square, median, 95 % and maximum (one direction of Hausdorff's distance).

    corners_m: at a mesh's vertices (k,), which count for the maximum alone, as far as they are
    `within_m`: they lie denser where a mesh is finer.
    """
    d = distances.unsigned
    corners = np.zeros(0) if corners_m is None else corners_m
    most = np.concatenate([d, corners if within_m is None else corners[corners <= within_m]])
    return DistanceSummary(
        points=len(d),
        mean_m=float(d.mean()),
        rms_m=float(np.sqrt((d**2).mean())),
        median_m=float(np.median(d)),
        p95_m=float(np.percentile(d, 95)),
        max_m=float(most.max()),
        mean_signed_m=None if distances.signed is None else float(distances.signed.mean()),
    )


def align_icp(
    points: FloatArray, surface: Surface, start: Transform, max_correspondence_m: float
) -> Alignment:
    """Lay points (n, 3) on a surface by the distances along its normals, from a start nearby.

    Iterated closest points with Chen and Medioni's point-to-plane error (1992), to the nearest
    point of a mesh itself rather than of samples of it. Open3D's own registration adds in the
    order of its threads, so that results differ from run to run.

    max_correspondence_m: points farther from the surface do not pull, in the end.

    Raises CalibrationError where too few points are near it.
    """
    transform, settled = start, False
    for limit in (factor * max_correspondence_m for factor in STAGES):
        before = np.inf
        for _ in range(MOST_STEPS):
            step, moved_m, rms = _step(transform @ points, surface, limit)
            transform = step @ transform
            settled = moved_m < SETTLED_M or abs(before - rms) <= SETTLED_RMS * rms
            if settled:
                break
            before = rms
    at = transform @ points
    nearest, normals = surface.closest(at)
    near = np.linalg.norm(at - nearest, axis=1) <= max_correspondence_m
    along = ((at - nearest) * normals).sum(axis=1)[near]
    rms = float(np.sqrt((along**2).mean())) if near.any() else 0.0
    return Alignment(transform, float(near.mean()), rms, settled)


def _step(at: FloatArray, surface: Surface, limit_m: float) -> tuple[Transform, float, float]:
    """A Gauss-Newton step, how far it moves a point at most, and the rms before it."""
    nearest, normals = surface.closest(at)
    near = np.linalg.norm(at - nearest, axis=1) <= limit_m
    if near.sum() < LEAST_MATCHED:
        raise CalibrationError(
            f"only {near.sum()} of {len(at)} points are within {1e3 * limit_m:.3g} mm of the "
            f"reference, and {LEAST_MATCHED} are needed: begin nearer, or allow more "
            "(--max-correspondence)"
        )
    p, q, n = at[near], nearest[near], normals[near]
    middle = p.mean(axis=0)
    jacobian = np.hstack([np.cross(p - middle, n), n])
    # The least step where the surface lets it slide: a sphere turns, a plane shifts.
    along = ((p - q) * n).sum(axis=1)
    found = np.linalg.lstsq(jacobian, -along, rcond=1e-9)[0]
    turn = Transform.exp(found[:3], np.zeros(3))
    shift = middle - turn @ middle + found[3:]
    step = Transform(turn.rotation, shift)
    moved_m = float(np.linalg.norm(step @ at - at, axis=1).max())
    return step, moved_m, float(np.sqrt((along**2).mean()))

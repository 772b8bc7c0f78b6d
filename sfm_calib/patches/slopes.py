"""How the surfaces around points slope, told by how their patches had to be changed to match."""

from __future__ import annotations

import numpy as np

from graphs.camera import project, unproject
from graphs.frames import FloatArray
from graphs.problem import Estimate, IntArray, Observations
from sfm_calib.patches.warps import by_camera, faced, places, steps_px

FITTED_SIGMA = 0.02  # px a sample, of what patches were fitted
STEEP = 1.0  # tangent of the slope, a sigma of what is yet unknown
SMALL = 1e-4  # of a sample, to project it beside itself
RIGHT_AND_DOWN = np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])


def normals_of(estimate: Estimate, seen: Observations, fitted: FloatArray) -> FloatArray:
    """Normals (n_points, 3) of the planes that make patches look as they were fitted.

    fitted: px a sample (n_obs, 2, 2) of whole tracks; NaN where a patch was not. A plane through a
    point is spanned by what a sample more, right or down, moves on it: d (r' + s r), with r the
    reference's ray to the point at distance d, r' how the ray changes, and s, one number for right
    and one for down, the slope. Pixels a sample in every view are linear in s. NaN where no
    reference was fitted.
    """
    facing, first = faced(estimate, seen)
    used = np.flatnonzero(first >= 0)
    reference = first[used]
    ray, change, distance = _spread(estimate, seen, reference)
    of_point = np.zeros(len(first), np.int64)
    of_point[used] = np.arange(len(used))
    track = of_point[seen.point]

    directions = np.concatenate([change, ray[:, None]], axis=1) * distance[:, None, None]
    right, down, along = _moved(estimate, seen, directions[track])
    looked = _from_reference(fitted, reference[track], steps_px(seen)[reference[track]])
    begin = -np.einsum("nkj,nj->nk", change, facing[used])
    begin /= np.einsum("nj,nj->n", ray, facing[used])[:, None]
    flat = np.stack([right, down], axis=2) + along[..., None] * begin[track, None]
    told = np.einsum("nc,nck->nk", along, looked - flat)
    known = np.isfinite(told).all(1)
    sums, weight = np.zeros((len(used), 2)), np.zeros(len(used))
    np.add.at(sums, track[known], told[known])
    np.add.at(weight, track[known], (along[known] ** 2).sum(1))
    prior = (FITTED_SIGMA / (STEEP * np.linalg.norm(change, axis=2))) ** 2
    slope = begin + sums / (weight[:, None] + prior)

    tangent = change + slope[..., None] * ray[:, None]
    normal = np.cross(tangent[:, 0], tangent[:, 1])
    normal *= np.sign(np.einsum("nj,nj->n", normal, facing[used]))[:, None]
    result = np.full_like(facing, np.nan)
    result[used] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    return result


def _spread(
    estimate: Estimate, seen: Observations, rows: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of observations (n,): the ray (n, 3) to the point, of length 1, in the world; how it changes
    (n, 2, 3) by a sample right and down, as long along itself; and the distance (n,)."""
    rotation, centre = places(estimate, seen)
    rotation, camera = rotation[rows], seen.camera[rows]
    away = estimate.points[seen.point[rows]] - centre[rows]
    distance = np.linalg.norm(away, axis=1)
    ray = away / distance[:, None]
    inside = np.einsum("nij,nj->ni", rotation, ray)[:, None]
    pixels = by_camera(project, estimate, camera, inside, 2)
    around = pixels + RIGHT_AND_DOWN * steps_px(seen)[rows, None, None]
    rays = by_camera(unproject, estimate, camera, around, 3)
    rays = np.einsum("nji,nkj->nki", rotation, rays)
    rays /= np.einsum("nkj,nj->nk", rays, ray)[..., None]
    return ray, (rays[:, ::2] - rays[:, 1::2]) / 2, distance


def _moved(estimate: Estimate, seen: Observations, directions: FloatArray) -> FloatArray:
    """How observations move, px (k, n_obs, 2), as their points do in directions (n_obs, k, 3)."""
    rotation, centre = places(estimate, seen)
    at = (estimate.points[seen.point] - centre)[:, None]
    there = [
        by_camera(
            project, estimate, seen.camera, np.einsum("nij,nkj->nki", rotation, at + small), 2
        )
        for small in (SMALL * directions, -SMALL * directions)
    ]
    result: FloatArray = np.moveaxis((there[0] - there[1]) / (2 * SMALL), 1, 0)
    return result


def _from_reference(fitted: FloatArray, reference: IntArray, step: FloatArray) -> FloatArray:
    """The px a sample of patches as if their reference (n_obs,) were sampled in a square still."""
    with np.errstate(invalid="ignore"):
        flat = ~(np.abs(np.linalg.det(fitted)) > 0)
    fitted = np.where(flat[:, None, None], np.nan, fitted)
    result: FloatArray = fitted @ np.linalg.solve(
        fitted[reference], step[:, None, None] * np.eye(2)
    )
    return result

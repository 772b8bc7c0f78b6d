"""Tracks out of matches between images at known places: joined, placed, and rid of contradictions.

A track that a wrong match made of two scene points is taken apart again: the point that most of
its observations agree with first, then what is left of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from graphs.camera import unproject
from graphs.frames import FloatArray
from graphs.problem import BoolArray, Estimate, IntArray, Observations, joined, residuals_px

GATE_PX = 4.0  # COLMAP's; what is beyond the noise but within, the graph's own rounds reject
ROUNDS = 3  # points that a track is taken apart into, at most
WEIGHINGS = 8
# Angle at which an observation loses half its weight: ten times the noise of a 700 px lens.
ROBUST_ANGLE = 5e-3
PARALLEL = 1e-12  # information that keeps a point finite where all rays are parallel


def join_matches(n_features: int, links: Sequence[IntArray]) -> IntArray:
    """The track (n_features,) of each feature, from matches (n, 2) between features; -1: alone."""
    pairs = np.concatenate([*links, np.zeros((0, 2), dtype=np.int64)])
    linked = coo_array((np.ones(len(pairs), np.int8), pairs.T), (n_features, n_features))
    labels = connected_components(linked, directed=False)[1]
    alone = np.bincount(labels)[labels] < 2
    track = np.full(n_features, -1)
    track[~alone] = np.unique(labels[~alone], return_inverse=True)[1]
    return track


def consistent_tracks(estimate: Estimate, seen: Observations) -> tuple[FloatArray, Observations]:
    """Points (n, 3) of tracks, and the observations that agree with them.

    `seen.point` are tracks, which may show several points and one image several times; the
    estimate's own points are not looked at. Of a point, an image keeps the best observation.
    """
    centres, rays = _rays(estimate, seen)
    left = np.flatnonzero(np.isfinite(rays[:, 0]))
    points, kept, count = [], [], 0
    for _ in range(ROUNDS):
        numbers, track = np.unique(seen.point[left], return_inverse=True)
        if not len(numbers):
            break
        placed = nearest_points(centres[left], rays[left], track)
        trial = replace(seen.subset(left), point=track)
        errors = np.linalg.norm(residuals_px(replace(estimate, points=placed), trial), axis=1)
        good = _best_of_each_image(trial, errors)
        good &= np.bincount(track[good], minlength=len(placed))[track] >= 2
        found, point = np.unique(track[good], return_inverse=True)
        points.append(placed[found])
        kept.append(replace(seen.subset(left[good]), point=point + count))
        count += len(found)
        left = left[~good]
    nothing = seen.subset(np.zeros(len(seen), dtype=bool))
    return np.concatenate([*points, np.zeros((0, 3))]), joined([*kept, nothing])


def _best_of_each_image(seen: Observations, errors: FloatArray) -> BoolArray:
    """Which observations are within the gate, and the nearest that their image has of the point."""
    order = np.argsort(np.nan_to_num(errors, nan=np.inf), kind="stable")
    image = np.stack([seen.point, seen.frame, seen.camera], axis=1)[order]
    best = np.zeros(len(seen), dtype=bool)
    best[order[np.unique(image, axis=0, return_index=True)[1]]] = True
    with np.errstate(invalid="ignore"):
        return best & (errors < GATE_PX)


def _rays(estimate: Estimate, seen: Observations) -> tuple[FloatArray, FloatArray]:
    """Centres and unit directions (n_obs, 3) in the world; NaN where the lens sees nothing."""
    centres, rays = np.empty((len(seen), 3)), np.empty((len(seen), 3))
    for index, camera in enumerate(estimate.cameras):
        rows = np.flatnonzero(seen.camera == index)
        poses = [estimate.cam_from_rig[index] @ one for one in estimate.rig_from_world]
        world_from_cam = np.array([pose.rotation.T for pose in poses])[seen.frame[rows]]
        centres[rows] = np.array([pose.inverse.translation for pose in poses])[seen.frame[rows]]
        rays[rows] = np.einsum("nij,nj->ni", world_from_cam, unproject(camera, seen.pixels[rows]))
    return centres, rays


def nearest_points(centres: FloatArray, rays: FloatArray, track: IntArray) -> FloatArray:
    """The points (n_tracks, 3) nearest to rays (n, 3) from centres (n, 3), by angle and robustly.

    Least squares of the distance across each ray over its depth, weighed anew (Cauchy).
    """
    n = int(track.max(initial=-1)) + 1
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    offset = np.einsum("nij,nj->ni", across, centres)
    weight = np.ones(len(rays))
    points = np.zeros((n, 3))
    for _ in range(WEIGHINGS):
        normal = _summed(weight[:, None] * across.reshape(-1, 9), track, n).reshape(-1, 3, 3)
        scale = np.trace(normal, axis1=1, axis2=2)
        normal += (PARALLEL * scale)[:, None, None] * np.eye(3)
        right = _summed(weight[:, None] * offset, track, n)
        points = np.linalg.solve(normal, right[..., None])[..., 0]
        away = points[track] - centres
        depth = np.maximum((away * rays).sum(1), 1e-12)
        angle = np.linalg.norm(np.cross(away, rays), axis=1) / depth
        weight = 1 / (depth**2 * (1 + (angle / ROBUST_ANGLE) ** 2))
        weight /= np.bincount(track, weights=weight, minlength=n)[track]
    return points


def _summed(values: FloatArray, track: IntArray, n: int) -> FloatArray:
    return np.stack([np.bincount(track, weights=column, minlength=n) for column in values.T], 1)

"""Partial clouds of several cameras, brought into the rig's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphs.frames import FloatArray, Transform
from graphs.problem import IntArray
from sfm_calib.depth.cloud import Cloud, normals_towards
from sfm_calib.depth.registration import Registration, moved, register

__all__ = [
    "Cloud", "Registration", "fuse_clouds", "moved", "oriented", "register", "thinned",
]  # fmt: skip


def fuse_clouds(
    parts: Sequence[FloatArray], cam_from_rig: Sequence[Transform], with_normals: bool = False
) -> Cloud:
    """One cloud in the rig's frame of parts (n, 3), each in m in its own camera's frame.

    with_normals: as `oriented`.
    """
    placed = [t.inverse @ part for t, part in zip(cam_from_rig, parts, strict=True)]
    camera = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    cloud = Cloud(np.concatenate(placed), camera)
    return oriented(cloud, cam_from_rig) if with_normals else cloud


def oriented(cloud: Cloud, cam_from_rig: Sequence[Transform]) -> Cloud:
    """With normals, by Open3D, of each camera's part alone, to that camera.

    Raises CalibrationError where Open3D is missing.
    """
    normals = np.zeros_like(cloud.points)
    for index, transform in enumerate(cam_from_rig):
        rows = cloud.camera == index
        if rows.any():
            centre = transform.inverse.translation
            normals[rows] = normals_towards(cloud.points[rows], centre)
    return replace(cloud, normals=normals)


def thinned(cloud: Cloud, voxel_m: float) -> IntArray:
    """Rows of one point of each camera in each cube of an edge: the nearest to their mean."""
    cubes = np.column_stack([cloud.camera, np.floor(cloud.points / voxel_m)]).astype(np.int64)
    _, cube, count = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
    mean = np.zeros((len(count), 3))
    np.add.at(mean, cube, cloud.points)
    off = np.linalg.norm(cloud.points - (mean / count[:, None])[cube], axis=1)
    first = np.r_[0, np.cumsum(count)[:-1]].astype(np.int64)
    return np.sort(np.lexsort((off, cube))[first])

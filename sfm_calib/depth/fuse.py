"""Partial clouds of several cameras, brought into the rig's frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphs.frames import FloatArray, Transform
from sfm_calib.depth.cloud import Cloud, normals_towards
from sfm_calib.depth.registration import Registration, moved, register

__all__ = ["Cloud", "Registration", "evenly_thinned", "fuse_clouds", "moved", "register"]


def fuse_clouds(
    parts: Sequence[FloatArray], cam_from_rig: Sequence[Transform], with_normals: bool = False
) -> Cloud:
    """One cloud in the rig's frame of parts (n, 3), each in m in its own camera's frame.

    with_normals: by Open3D, of each part alone. Raises CalibrationError where that is missing.
    """
    rig_from_cam = [transform.inverse for transform in cam_from_rig]
    placed = [at @ part for at, part in zip(rig_from_cam, parts, strict=True)]
    camera = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    normals = None
    if with_normals:
        normals = np.concatenate([
            normals_towards(part, at.translation)
            for part, at in zip(placed, rig_from_cam, strict=True)
        ])  # fmt: skip
    return Cloud(np.concatenate(placed), camera, normals)


def evenly_thinned(cloud: Cloud, voxel_m: float) -> Cloud:
    """One point of each camera in each cube of an edge: the one nearest to the cube's mean."""
    cube = np.floor(cloud.points / voxel_m).astype(np.int64)
    key = np.column_stack([cloud.camera, cube])
    _, place, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    mean = np.zeros((len(count), 3))
    np.add.at(mean, place, cloud.points)
    off = np.linalg.norm(cloud.points - (mean / count[:, None])[place], axis=1)
    order = np.lexsort((off, place))
    return cloud.only(np.sort(order[np.r_[0, np.cumsum(count)[:-1]]]))

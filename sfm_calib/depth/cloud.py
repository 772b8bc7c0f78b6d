"""Clouds of points: those that a depth image shows, through the whole lens model."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from graphs.camera import Camera, image_pixels, unproject
from graphs.frames import FloatArray, Transform
from graphs.problem import IntArray
from sfm_calib.errors import CalibrationError
from sfm_calib.open3d_import import import_open3d

DepthKind = Literal["z", "range"]

# A flying pixel lies between what is before an edge and what is behind it: at most the two pixels
# beside it along the edge are at its depth. A pixel on a straight edge of its own has five.
LEAST_NEIGHBOURS = 4  # of eight
SPACED_BY = 2000  # points that tell the spacing of a cloud
NORMAL_NEIGHBOURS = 30  # of a point: enough that millimetres of noise average out


@dataclass(frozen=True)
class Cloud:
    """Points of several cameras in one frame."""

    points: FloatArray  # (n, 3) in m
    camera: IntArray  # (n,) index of the camera that saw it
    normals: FloatArray | None = None  # (n, 3) unit, to the camera that saw it

    def only(self, rows: NDArray[np.bool_] | IntArray) -> Cloud:
        """Some of its points: a mask (n,), or indices."""
        normals = None if self.normals is None else self.normals[rows]
        return Cloud(self.points[rows], self.camera[rows], normals)

    def of(self, *cameras: int) -> Cloud:
        """What some of the cameras saw."""
        return self.only(np.isin(self.camera, cameras))

    def moved(self, transform: Transform) -> Cloud:
        """The whole of it in another frame, or elsewhere."""
        normals = None if self.normals is None else self.normals @ transform.rotation.T
        return Cloud(transform @ self.points, self.camera, normals)

    @cached_property
    def tree(self) -> KDTree:
        """For its points' neighbours."""
        return KDTree(self.points)

    @cached_property
    def spacing_m(self) -> float:
        """Median distance of points to their nearest neighbours; of two points at least."""
        some = self.points[evenly(len(self.points), SPACED_BY)]
        return float(np.median(self.tree.query(some, k=2)[0][:, 1]))


@dataclass(frozen=True)
class DepthLimits:
    """Which measurements become points."""

    near_m: float = 0.0
    far_m: float = np.inf
    # A neighbouring pixel counts as of the same surface where its depth differs by less than this
    # share; too few of them, and the pixel is dropped. 0: all are kept.
    edge: float = 0.0


ALL = DepthLimits()


def depth_points(
    depth_m: FloatArray,
    camera: Camera,
    kind: DepthKind = "z",
    limits: DepthLimits = ALL,
    rays: FloatArray | None = None,
) -> tuple[FloatArray, IntArray]:
    """Points (n, 3) in m in the camera's frame, and their pixels (n, 2): row, column.

    depth_m (h, w): along the optical axis (z), or along the ray (range); zero, negative or not
    finite where nothing was measured. rays: as `image_rays`, where many images share a camera.
    Raises CalibrationError where the image has not the camera's size.
    """
    if depth_m.shape != camera.size[::-1]:
        height, width = depth_m.shape
        raise CalibrationError(
            f"{camera.name}: the depth image is {width} x {height} px and the calibration is for "
            f"{camera.size[0]} x {camera.size[1]} px: give depth as the camera took it, or "
            "calibrate at this size"
        )
    kept = measured(depth_m, limits)
    rays = image_rays(camera) if rays is None else rays
    along = rays[..., 2] if kind == "z" else np.ones_like(depth_m)
    kept &= along > 0  # false of rays that the lens does not know, and of z behind a fisheye
    points = rays[kept] * (depth_m[kept] / along[kept])[:, None]
    return points, np.argwhere(kept)


def image_rays(camera: Camera) -> FloatArray:
    """Unit rays (h, w, 3) of all pixels; NaN where the lens knows none."""
    pixels = image_pixels(camera.size, camera.size)[2]
    return unproject(camera, pixels).reshape(camera.size[1], camera.size[0], 3)


def measured(depth_m: FloatArray, limits: DepthLimits = ALL) -> NDArray[np.bool_]:
    """Pixels (h, w) with a depth within the limits, and not flying between two surfaces."""
    found = np.isfinite(depth_m) & (depth_m > max(limits.near_m, 0.0)) & (depth_m < limits.far_m)
    if limits.edge > 0:
        found &= _neighbours(np.where(found, depth_m, np.nan), limits.edge) >= LEAST_NEIGHBOURS
    return found


def _neighbours(depth_m: FloatArray, share: float) -> IntArray:
    """How many of the eight pixels around each (h, w) are within a share of its depth."""
    height, width = depth_m.shape
    padded = np.pad(depth_m, 1, constant_values=np.nan)
    count = np.zeros(depth_m.shape, dtype=np.int64)
    for row in range(3):
        for column in range(3):
            if (row, column) != (1, 1):
                beside = padded[row : row + height, column : column + width]
                count += np.abs(beside - depth_m) < share * depth_m  # false of NaN
    return count


def normals_towards(points: FloatArray, centre: FloatArray) -> FloatArray:
    """Unit normals (n, 3) of a cloud (n, 3), by Open3D; they point to where it was seen from."""
    open3d = import_open3d("normals of a cloud of points")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
    cloud.orient_normals_towards_camera_location(centre)
    return np.asarray(cloud.normals).copy()


def evenly(n: int, at_most: int) -> IntArray:
    """Indices of at most so many of n rows, spread evenly: the same in every run."""
    return np.linspace(0, n - 1, min(n, at_most)).round().astype(np.int64)

"""Depth images of a surface through the full lens model, with a time-of-flight camera's noise.

The noise is random and independent from pixel to pixel. Real devices err in other ways too, which
are left out: light that arrives by two ways (concave places come out too deep), pixels at an edge
that mix near and far, the wave in depth that a modulation's harmonics make, warming up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from graphs.camera import Camera, project, unproject
from graphs.frames import FloatArray, Transform
from graphs.problem import IntArray
from sfm_calib.errors import CalibrationError
from sfm_calib.open3d_import import import_open3d

STEEPEST_DEG = 80.0  # between a ray and the surface's normal: from beyond too little light returns
BORDER_PX = 2  # about a surface's vertices, between which it may bulge


@dataclass(frozen=True)
class Seen:
    """A surface to look at: its vertices, and Open3D's scene of it."""

    vertices: FloatArray  # (n, 3)
    scene: Any


def to_be_seen(vertices: FloatArray, triangles: IntArray) -> Seen:
    """A surface as rays find it. Raises CalibrationError without Open3D."""
    open3d = import_open3d("simulating depth images")
    scene = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))
    return Seen(vertices, scene)


def depth_image(
    surface: Seen,
    camera: Camera,
    cam_from_surface: Transform,
    rng: np.random.Generator,
    noise: float = 1.0,
) -> FloatArray:
    """Depth z in m (height, width) of what a camera sees of a surface; 0 where that is nothing.

    noise: times a Kinect's. Raises CalibrationError where the surface is not in the picture.
    """
    rows, columns, pixels = _about(surface, camera, cam_from_surface)
    rays = unproject(camera, pixels)
    surface_from_cam = cam_from_surface.inverse
    query = np.zeros((len(rays), 6), np.float32)
    query[:, :3] = surface_from_cam.translation
    query[:, 3:] = np.nan_to_num(rays) @ surface_from_cam.rotation.T
    answer = surface.scene.cast_rays(query)
    distance = answer["t_hit"].numpy().astype(np.float64)
    normal = answer["primitive_normals"].numpy()
    angle = np.arccos(np.clip(np.abs((normal * query[:, 3:]).sum(axis=1)), 0.0, 1.0))
    seen = np.isfinite(distance) & np.isfinite(rays[:, 0]) & (np.degrees(angle) < STEEPEST_DEG)
    depth = np.zeros(len(rays))
    depth[seen] = distance[seen] * rays[seen, 2]
    sigma = noise * depth_sigma_m(depth[seen], angle[seen])
    depth[seen] += sigma * rng.standard_normal(len(sigma))
    image = np.zeros((camera.size[1], camera.size[0]))
    image[rows, columns] = depth.reshape(image[rows, columns].shape)
    return image


def _about(
    surface: Seen, camera: Camera, cam_from_surface: Transform
) -> tuple[slice, slice, FloatArray]:
    """The part of the picture that may show a surface: rows, columns, its pixels (n, 2)."""
    at = project(camera, cam_from_surface @ surface.vertices)
    at = at[np.isfinite(at[:, 0])]
    if not len(at):
        raise CalibrationError(f"{camera.name} does not see the surface: it is not before it")
    low = np.clip(np.floor(at.min(0)).astype(int) - BORDER_PX, 0, camera.size)
    high = np.clip(np.ceil(at.max(0)).astype(int) + BORDER_PX + 1, 0, camera.size)
    if (high <= low).any():
        raise CalibrationError(f"{camera.name} does not see the surface: it is beside the picture")
    u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    return slice(low[1], high[1]), slice(low[0], high[0]), pixels


def depth_sigma_m(depth_m: FloatArray, angle: FloatArray) -> FloatArray:
    """Noise of a Kinect v2's depth, in m; angle: between ray and normal, in rad.

    Fankhauser et al., "Kinect v2 for mobile robot navigation: evaluation and modeling", ICAR 2015,
    indoors: 1.3 mm at 0.7 m seen squarely, 1.9 mm at 2 m.
    """
    oblique = 0.1 * depth_m**1.5 * angle**2 / (np.pi / 2 - angle) ** 2
    result: FloatArray = 1e-3 * (1.5 - 0.5 * depth_m + 0.3 * depth_m**2 + oblique)
    return result

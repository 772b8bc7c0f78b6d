"""Pictures of three textured walls by exact formulas: what every pixel shows is known to rounding.

The texture is a sum of waves, so that it can be had anywhere and has nothing finer than pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from graphs.camera import Camera, project, unproject
from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate, Observations, Problem

# x @ normal = distance: a wall across the view, one to the left and one below that come nearer.
NORMALS = np.array([[0.0, 0.0, 1.0], [-0.8, 0.0, 0.6], [0.0, 0.6, 0.8]])
DISTANCES = np.array([4.0, 2.6, 3.2])
CAMERA = Camera("camera", "radial", (320, 240), np.array([262.0, 265.0, 164.0, 117.0, -0.08, 0.02]))
WAVES = 24


@dataclass(frozen=True)
class Walls:
    """The room, with a texture of one seed; contrast in grey levels."""

    waves: FloatArray  # (3, WAVES, 3) radians a metre
    phases: FloatArray  # (3, WAVES)
    contrast: float = 45.0

    @staticmethod
    def drawn(seed: int = 0, finest_m: float = 0.12) -> Walls:
        """Waves of all directions along each wall, from this length to a metre."""
        rng = np.random.default_rng(seed)
        waves = rng.standard_normal((3, WAVES, 3))
        waves -= (waves @ NORMALS[:, :, None]) * NORMALS[:, None]
        waves /= np.linalg.norm(waves, axis=2, keepdims=True)
        length_m = np.exp(rng.uniform(np.log(finest_m), 0.0, (3, WAVES, 1)))
        return Walls(2 * np.pi * waves / length_m, rng.uniform(0, 2 * np.pi, (3, WAVES)))

    def grey(self, points: FloatArray, wall: FloatArray) -> FloatArray:
        """Grey level (n,) of points (n, 3) on their walls (n,)."""
        result = np.empty(len(points))
        for index in range(3):
            rows = wall == index
            angle = (points[rows] @ self.waves[index].T + self.phases[index]).astype(np.float32)
            result[rows] = np.cos(angle).sum(1)
        return 128 + self.contrast * result / np.sqrt(WAVES / 2)

    def image(self, cam_from_world: Transform) -> FloatArray:
        """What the camera sees (height, width), not rounded, without noise."""
        width, height = CAMERA.size
        return self.grey(*_along(rays_of_pixels(), cam_from_world)).reshape(height, width)


def seen_at(cam_from_world: Transform, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) of the walls at pixels (n, 2), and which wall (n,) each is on."""
    return _along(unproject(CAMERA, pixels), cam_from_world)


@cache
def rays_of_pixels() -> FloatArray:
    """Rays (n, 3) of every pixel of the camera, row by row."""
    width, height = CAMERA.size
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return unproject(CAMERA, np.stack([x.ravel(), y.ravel()], 1))


def _along(rays: FloatArray, cam_from_world: Transform) -> tuple[FloatArray, FloatArray]:
    world_from_cam = cam_from_world.inverse
    rays = rays @ world_from_cam.rotation.T
    origin = world_from_cam.translation
    with np.errstate(divide="ignore"):
        away = (DISTANCES - NORMALS @ origin) / (rays @ NORMALS.T)
    away[~(away > 0)] = np.inf
    wall = away.argmin(1)
    return origin + rays * away.min(1)[:, None], wall


@dataclass(frozen=True)
class Scene:
    """Pictures of the walls, and tracks whose keypoints err."""

    true: Problem  # the truth for a start, and exact pixels
    problem: Problem  # keypoints with noise
    images: list[np.ndarray]  # (height, width) uint8 of each frame


def scene(
    n_frames: int = 6,
    n_points: int = 150,
    noise: float = 1.0,
    keypoint_px: float = 0.4,
    scale: float = 1.5,
    seed: int = 0,
    walls: Walls | None = None,
    far: bool = False,
) -> Scene:
    """Pictures with this sensor noise in grey levels, from places half a metre apart.

    Every point is seen by all frames that have it, four pixels from the border. far: every second
    frame is taken from twice as far.
    """
    rng, walls = np.random.default_rng(seed), walls or Walls.drawn(seed)
    placed = [_place(i, n_frames, 2.0 if far and i % 2 else 1.0) for i in range(n_frames)]
    clean = [walls.image(t) for t in placed]
    images = [
        np.clip(np.round(c + noise * rng.standard_normal(c.shape)), 0, 255).astype(np.uint8)
        for c in clean
    ]
    first = rng.uniform([6, 6], [314, 234], (n_points, 2))
    points, _ = seen_at(placed[0], first)
    rows = [
        (pixel, frame, point)
        for frame, cam_from_world in enumerate(placed)
        for point, pixel in enumerate(project(CAMERA, cam_from_world @ points))
        if (pixel > 4).all() and (pixel < np.array(CAMERA.size) - 5).all()
    ]
    pixels, frame, point = (np.array(column) for column in zip(*rows, strict=True))
    seen = Observations(
        pixels, frame, np.zeros_like(frame), point, feature_scale=np.full(len(pixels), scale)
    )
    estimate = Estimate((CAMERA,), (Transform.identity(),), tuple(placed), points)
    true = Problem(estimate, seen, tuple(f"{i:06d}" for i in range(n_frames)))
    noisy = pixels + keypoint_px * rng.standard_normal(pixels.shape)
    return Scene(true, replace(true, observations=replace(seen, pixels=noisy)), images)


def _place(index: int, n_frames: int, distance: float) -> Transform:
    """Of a frame on an arc, looking at the back wall's middle, a little rolled."""
    angle = 2 * np.pi * index / n_frames
    centre = np.array([0.7 * np.cos(angle), 0.5 * np.sin(angle), 0.25 * np.sin(2 * angle)])
    centre = centre * distance + [0.0, 0.0, DISTANCES[0] * (1 - distance)]
    forward = np.array([0.1, 0.1, 3.6]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross([0.15 * np.sin(3 * angle), 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Transform(rotation, -rotation @ centre)

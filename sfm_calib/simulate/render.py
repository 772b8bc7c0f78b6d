"""Images of a room through the full lens model, anti-aliased, with a sensor's noise.

Each pixel averages a grid of rays, each through the lens model. Embree finds what the pixel
centres see; a kernel continues the other rays of a pixel on the triangles found there, and only
pixels at the edge of an object cast all their rays. Three times as fast as casting every ray;
one pixel in ten thousand, at creases of the relief, then differs by more than the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from graphs.camera import Camera, unproject
from graphs.frames import Transform
from sfm_calib.simulate.room import Room
from sfm_calib.simulate.textures import MIP_LEVELS, Float32, Grey

EDGE_DEPTH_RATIO = 1.03  # neighbours further apart than this may hide something between them
OUTSIDE = 1e-4  # barycentric slack within which a ray counts as inside a triangle
MIDDLE_GREY = 128.0
# Distance to an image of 8 x 8 rays a pixel, in grey levels rms, four views of the room:
# 1 ray 1.4-2.3, 2 x 2 0.4-0.7, 3 x 3 0.2-0.35, 4 x 4 0.15-0.23; the sensor's noise is 2.
SUPERSAMPLING = 3


class RenderOptions(BaseModel):
    """How an image is taken."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    supersampling: int = Field(SUPERSAMPLING, ge=1, le=8)
    """Rays a pixel and axis."""
    noise: float = Field(2.0, ge=0)
    """Sensor noise: sigma at middle grey, in grey levels."""
    lens_blur_px: float = Field(0.4, ge=0)
    """Sigma of the lens's blur; with the pixel's area it makes the 0.5 px that SIFT assumes."""


@dataclass(frozen=True)
class RayTable:
    """Unit directions of a camera's supersampled pixel grid, one pixel wider on every side."""

    camera: Camera
    supersampling: int
    rays: Float32  # ((height + 2) * s, (width + 2) * s, 3); NaN where the lens sees nothing


def ray_table(camera: Camera, supersampling: int = SUPERSAMPLING) -> RayTable:
    """The rays of a camera: a second of work, to be kept for all its images."""
    s = supersampling
    columns, rows = ((np.arange((n + 2) * s) + 0.5) / s - 1.5 for n in camera.size)
    rays = np.empty((len(rows), len(columns), 3), np.float32)
    for first in range(0, len(rows), 64):  # in blocks: the lens model needs many temporaries
        u, v = np.meshgrid(columns, rows[first : first + 64])
        rays[first : first + 64] = unproject(camera, np.stack([u, v], -1))
    return RayTable(camera, s, rays)


def render(
    camera: Camera,
    cam_from_world: Transform,
    room: Room,
    rng: np.random.Generator,
    options: RenderOptions | None = None,
    table: RayTable | None = None,
) -> Grey:
    """The image (height, width) of the room from a camera; black where the lens sees nothing.

    `table` saves computing `ray_table(camera, options.supersampling)` again.
    """
    options = options or RenderOptions()
    table = table or ray_table(camera, options.supersampling)
    samples = _radiance(table, cam_from_world, room)
    return _expose(samples, options, rng)


def _radiance(table: RayTable, cam_from_world: Transform, room: Room) -> Float32:
    """Radiance in grey levels at every sample of the table."""
    s, mesh, textures = table.supersampling, room.mesh, room.textures
    world_from_cam = cam_from_world.inverse
    rotation = world_from_cam.rotation.astype(np.float32)
    origin = world_from_cam.translation.astype(np.float32)
    centres = np.ascontiguousarray(table.rays[s // 2 :: s, s // 2 :: s])
    triangle, distance = _cast(room.scene, centres @ rotation.T, origin)
    edge = _edges(triangle, distance, mesh.surface)
    arrays = (mesh.corner, mesh.edges, mesh.uv, mesh.light, mesh.surface)
    pyramid = (textures.texels, textures.start, textures.shape)
    pixel_rad = np.float32(
        1.0 / (s * math.sqrt(abs(table.camera.params[0] * table.camera.params[1])))
    )
    samples = _shade_all(
        table.rays, rotation, origin, triangle, edge, s, pixel_rad, arrays, pyramid
    )
    rows, columns = np.nonzero(edge)
    if len(rows):
        steps = np.arange(s)
        y = (rows[:, None, None] * s + steps[None, :, None] + 0 * steps).reshape(-1)
        x = (columns[:, None, None] * s + 0 * steps[:, None] + steps).reshape(-1)
        rays = np.ascontiguousarray(table.rays[y, x] @ rotation.T)
        hits, _ = _cast(room.scene, rays, origin)
        samples[y, x] = _shade_list(rays, origin, hits, pixel_rad, arrays, pyramid)
    return samples


def _cast(scene: Any, rays: Float32, origin: Float32) -> tuple[NDArray[np.int32], Float32]:
    """Triangle seen (-1: none) and distance along world rays (..., 3) from one origin."""
    seen = ~np.isnan(rays[..., 0])
    query = np.empty((*rays.shape[:-1], 6), np.float32)
    query[..., :3] = origin
    query[..., 3:] = np.where(seen[..., None], rays, np.float32(0))
    query[~seen, :3] = 1e6  # far outside the room: sees nothing
    query[~seen, 5] = 1.0
    answer = scene.cast_rays(query)
    distance = answer["t_hit"].numpy()
    hit = np.isfinite(distance) & seen
    return np.where(hit, answer["primitive_ids"].numpy().astype(np.int32), -1), distance


def _expose(samples: Float32, options: RenderOptions, rng: np.random.Generator) -> Grey:
    """Lens blur, the mean over each pixel's area, photon and read noise, quantisation."""
    s = options.supersampling
    if options.lens_blur_px:
        samples = cv2.GaussianBlur(samples, (0, 0), options.lens_blur_px * s)
    rows, columns = samples.shape[0] // s, samples.shape[1] // s
    image = samples.reshape(rows, s, columns, s).mean((1, 3))[1:-1, 1:-1]
    # three quarters of the variance at middle grey are photons, the rest is read-out
    sigma = options.noise * np.sqrt(0.25 + 0.75 * np.maximum(image, 0) / MIDDLE_GREY)
    noisy = image + sigma * rng.standard_normal(image.shape, np.float32)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


@njit(cache=True, parallel=True, error_model="numpy")
def _edges(triangle, distance, surface):  # type: ignore[no-untyped-def]
    """True where a pixel's neighbours see another surface, another depth or nothing."""
    rows, columns = triangle.shape
    edge = np.zeros((rows, columns), np.bool_)
    for i in prange(rows):
        for j in range(columns):
            here = triangle[i, j]
            own = surface[here] if here >= 0 else -1
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    y, x = min(max(i + di, 0), rows - 1), min(max(j + dj, 0), columns - 1)
                    other = triangle[y, x]
                    if (surface[other] if other >= 0 else -1) != own:
                        edge[i, j] = True
                    elif own >= 0:
                        ratio = distance[y, x] / distance[i, j]
                        if ratio > EDGE_DEPTH_RATIO or ratio * EDGE_DEPTH_RATIO < 1.0:
                            edge[i, j] = True
    return edge


@njit(cache=True, error_model="numpy")
def _barycentric(origin, dx, dy, dz, corner, edges, tri):  # type: ignore[no-untyped-def]
    """Barycentric a, b and the distance of a ray on a triangle's plane (Moeller, Trumbore 1997)."""
    e1x, e1y, e1z = edges[tri, 0, 0], edges[tri, 0, 1], edges[tri, 0, 2]
    e2x, e2y, e2z = edges[tri, 1, 0], edges[tri, 1, 1], edges[tri, 1, 2]
    px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    determinant = e1x * px + e1y * py + e1z * pz
    if abs(determinant) < 1e-12:
        return np.float32(-9.0), np.float32(-9.0), np.float32(1.0)
    inverse = np.float32(1.0) / determinant
    tx, ty, tz = origin[0] - corner[tri, 0], origin[1] - corner[tri, 1], origin[2] - corner[tri, 2]
    a = (tx * px + ty * py + tz * pz) * inverse
    qx, qy, qz = ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x
    b = (dx * qx + dy * qy + dz * qz) * inverse
    return a, b, (e2x * qx + e2y * qy + e2z * qz) * inverse


@njit(cache=True, error_model="numpy")
def _bilinear(texels, start, rows, columns, x, y):  # type: ignore[no-untyped-def]
    x = min(max(x, np.float32(0.0)), np.float32(columns - 1))
    y = min(max(y, np.float32(0.0)), np.float32(rows - 1))
    j, i = min(int(x), columns - 2), min(int(y), rows - 2)
    fx, fy = x - j, y - i
    at = start + i * columns + j
    top = texels[at] * (1 - fx) + texels[at + 1] * fx
    bottom = texels[at + columns] * (1 - fx) + texels[at + columns + 1] * fx
    return top * (1 - fy) + bottom * fy


@njit(cache=True, error_model="numpy")
def _shade(dx, dy, dz, a, b, t, tri, pixel_rad, arrays, pyramid):  # type: ignore[no-untyped-def]
    """Texture, filtered to the sample's footprint, times the light, at a hit."""
    _, edges, uv, light, surface = arrays
    texels, start, shape = pyramid
    e1x, e1y, e1z = edges[tri, 0, 0], edges[tri, 0, 1], edges[tri, 0, 2]
    e2x, e2y, e2z = edges[tri, 1, 0], edges[tri, 1, 1], edges[tri, 1, 2]
    nx, ny, nz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
    area = math.sqrt(nx * nx + ny * ny + nz * nz)
    cosine = max(abs(dx * nx + dy * ny + dz * nz) / area, np.float32(0.05))
    u1, v1 = uv[tri, 1, 0] - uv[tri, 0, 0], uv[tri, 1, 1] - uv[tri, 0, 1]
    u2, v2 = uv[tri, 2, 0] - uv[tri, 0, 0], uv[tri, 2, 1] - uv[tri, 0, 1]
    texels_per_m = math.sqrt(abs(u1 * v2 - u2 * v1) / area)
    # geometric mean of the footprint's axes: between aliasing along one and blur along the other
    footprint = texels_per_m * t * pixel_rad / math.sqrt(cosine)
    level = np.float32(min(max(math.log2(max(footprint, 1e-6)), 0.0), MIP_LEVELS - 1.001))
    fine = int(level)
    x, y = uv[tri, 0, 0] + a * u1 + b * u2, uv[tri, 0, 1] + a * v1 + b * v2
    own = surface[tri]
    value = np.float32(0.0)
    for step in range(2):
        size = np.float32(1 << (fine + step))
        weight = level - fine if step else 1 - (level - fine)
        rows, columns = shape[own, fine + step, 0], shape[own, fine + step, 1]
        # a coarse texel's centre is the centre of the texels it covers
        xs, ys = (x + np.float32(0.5)) / size - np.float32(0.5), (y + np.float32(0.5)) / size
        ys -= np.float32(0.5)
        if weight > 0:
            at = start[own, fine + step]
            value += weight * _bilinear(texels, at, rows, columns, xs, ys)
    shine = (
        light[tri, 0] + a * (light[tri, 1] - light[tri, 0]) + b * (light[tri, 2] - light[tri, 0])
    )
    return value * shine


@njit(cache=True, parallel=True, error_model="numpy")
def _shade_all(rays, rotation, origin, triangle, edge, s, pixel_rad, arrays, pyramid):  # type: ignore[no-untyped-def]
    """Radiance of all samples of pixels that are no edges; the others stay black."""
    rows, columns = triangle.shape
    corner, edges = arrays[0], arrays[1]
    samples = np.zeros((rows * s, columns * s), np.float32)
    for i in prange(rows):
        for j in range(columns):
            here = triangle[i, j]
            if here < 0 or edge[i, j]:
                continue
            for k in range(s * s):
                y, x = i * s + k // s, j * s + k % s
                cx, cy, cz = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
                dx = rotation[0, 0] * cx + rotation[0, 1] * cy + rotation[0, 2] * cz
                dy = rotation[1, 0] * cx + rotation[1, 1] * cy + rotation[1, 2] * cz
                dz = rotation[2, 0] * cx + rotation[2, 1] * cy + rotation[2, 2] * cz
                best, tri = np.float32(-1e9), here
                a, b, t = np.float32(0), np.float32(0), np.float32(1)
                for n in range(9):  # the pixel's own triangle first, then its neighbours'
                    m = (n + 4) % 9
                    near = triangle[
                        min(max(i + m // 3 - 1, 0), rows - 1),
                        min(max(j + m % 3 - 1, 0), columns - 1),
                    ]
                    if n > 0 and near == here:
                        continue
                    p, q, r = _barycentric(origin, dx, dy, dz, corner, edges, near)
                    inside = min(p, q, 1 - p - q)
                    if inside > best:
                        best, tri, a, b, t = inside, near, p, q, r
                    if best > -OUTSIDE:
                        break
                if not math.isnan(dx):
                    samples[y, x] = _shade(dx, dy, dz, a, b, t, tri, pixel_rad, arrays, pyramid)
    return samples


@njit(cache=True, parallel=True, error_model="numpy")
def _shade_list(rays, origin, triangle, pixel_rad, arrays, pyramid):  # type: ignore[no-untyped-def]
    """Radiance (n,) of world rays (n, 3) whose triangles are known (-1: black)."""
    samples = np.zeros(len(triangle), np.float32)
    for k in prange(len(triangle)):
        tri = triangle[k]
        if tri >= 0:
            dx, dy, dz = rays[k, 0], rays[k, 1], rays[k, 2]
            a, b, t = _barycentric(origin, dx, dy, dz, arrays[0], arrays[1], tri)
            samples[k] = _shade(dx, dy, dz, a, b, t, tri, pixel_rad, arrays, pyramid)
    return samples

"""Virtual pinholes in the place of real cameras: what they show, and where their pixels come from.

A virtual camera may be turned against the real one but never moved: its rays are the real camera's
rays, so that no depth is needed to make its images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera, image_pixels, project, unproject
from graphs.frames import FloatArray

GRID = (65, 49)  # pixels of an image whose rays stand for all: a quarter of a degree apart
MOST_ZOOM = 64.0
ZOOM_STEPS = 40  # of the bisection: to 1e-11
PIXELS_AT_ONCE = 500_000  # 50 MB
NO_PIXEL = -1.0  # in maps; cv2.remap takes it as outside, whatever it interpolates with


@dataclass(frozen=True)
class Turned:
    """A real camera, and how the virtual one is turned against it."""

    camera: Camera
    virtual_from_cam: FloatArray  # (3, 3)


def pinhole(name: str, size: tuple[int, int], focal: FloatArray, centre: FloatArray) -> Camera:
    """A camera without distortion: focal (2,) and principal point (2,) in px."""
    return Camera(name, "pinhole", size, np.concatenate([focal, centre]))


def resized(camera: Camera, focal: FloatArray, size: tuple[int, int]) -> Camera:
    """The camera as a pinhole of focal length (2,), its image resized to fill another size.

    Where the sides differ in proportion, the larger of both factors holds for both.
    """
    factor = max(new / old for new, old in zip(size, camera.size, strict=True))
    middle = (np.array(size) - 1.0) / 2.0
    off_middle = (camera.params[2:4] - camera.centre) * factor
    return pinhole(camera.name, size, focal * factor, middle + off_middle)


def zoomed(virtual: Camera, zoom: float) -> Camera:
    """The same with the focal length so many times as long."""
    params = virtual.params.copy()
    params[:2] *= zoom
    return replace(virtual, params=params)


def field_of_view(virtual: Camera) -> tuple[float, float]:
    """Angles in radians across and down a pinhole's image, from edge to edge."""
    (fx, fy), (cx, cy), (width, height) = virtual.params[:2], virtual.params[2:4], virtual.size
    across = np.arctan((cx + 0.5) / fx) + np.arctan((width - 0.5 - cx) / fx)
    down = np.arctan((cy + 0.5) / fy) + np.arctan((height - 0.5 - cy) / fy)
    return float(across), float(down)


def widest_of(virtual: Camera) -> float:
    """Twice the angle in radians from a pinhole's axis to its farthest corner."""
    corners = image_pixels(virtual.size, (2, 2))[2]
    off_axis = (corners - virtual.params[2:4]) / virtual.params[:2]
    return float(2 * np.arctan(np.linalg.norm(off_axis, axis=1).max()))


def rays_seen(view: Turned) -> FloatArray:
    """Unit rays (n, 3) of a grid over the real image, turned; without those that it cannot see."""
    rays = unproject(view.camera, image_pixels(view.camera.size, GRID)[2])
    return rays[np.isfinite(rays[:, 0])] @ view.virtual_from_cam.T


def widest_seen(views: Sequence[Turned]) -> float:
    """Twice the angle in radians from the virtual axis to the farthest ray that is seen."""
    least = min((float(rays[:, 2].min(initial=1.0)) for rays in map(rays_seen, views)), default=1.0)
    return float(2 * np.arccos(np.clip(least, -1.0, 1.0)))


def whole_zoom(virtual: Camera, views: Sequence[Turned]) -> float:
    """The largest zoom with which a virtual camera shows all that the views see.

    Zero where a ray is 90 degrees or more off its axis, or the axis is outside its image.
    """
    zoom = MOST_ZOOM
    last = np.array(virtual.size) - 1.0
    for view in views:
        rays = rays_seen(view)
        if not (rays[:, 2] > 0).all():
            return 0.0
        off_axis = rays[:, :2] / rays[:, 2:] * virtual.params[:2]
        room = np.where(off_axis > 0, last - virtual.params[2:4], virtual.params[2:4])
        needed = np.maximum(np.abs(off_axis), 1e-12)
        zoom = min(zoom, float((room / needed).min(initial=MOST_ZOOM)))
    return max(zoom, 0.0)


def inside_zoom(virtual: Camera, views: Sequence[Turned]) -> float:
    """The smallest zoom with which every pixel of a virtual camera is whole in every real image.

    The outline of its image stands for all: what a lens sees has no holes. NaN where no zoom does.
    """
    across, down = (np.arange(n + 1) - 0.5 for n in virtual.size)
    sides = [(across, 0 * across + down[end]) for end in (0, -1)]
    sides += [(0 * down + across[end], down) for end in (0, -1)]
    edge = np.concatenate([np.stack(side, axis=-1) for side in sides])

    def sees_all(zoom: float) -> bool:
        return all(
            within(source_pixels(zoomed(virtual, zoom), view, edge), view.camera.size).all()
            for view in views
        )

    if not sees_all(MOST_ZOOM):
        return np.nan
    low, high = -np.log(MOST_ZOOM), np.log(MOST_ZOOM)
    for _ in range(ZOOM_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if sees_all(np.exp(middle)) else (middle, high)
    return float(np.exp(high))


def source_pixels(virtual: Camera, view: Turned, pixels: FloatArray) -> FloatArray:
    """Where pixels (..., 2) of a virtual camera lie in the real image (..., 2); NaN: nowhere."""
    plane = (pixels - virtual.params[2:4]) / virtual.params[:2]
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
    return project(view.camera, rays @ view.virtual_from_cam)  # rows: turned by its transpose


def within(pixels: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which of the pixels (..., 2) lie on an image, its outermost pixels whole."""
    inside = (pixels >= -0.5) & (pixels <= np.array(size) - 0.5)
    return np.asarray(inside.all(axis=-1))


def pixel_maps(virtual: Camera, view: Turned) -> NDArray[np.float32]:
    """Where each pixel of a virtual camera lies in the real image: x and y, (2, height, width).

    NO_PIXEL where the real lens sees nothing.
    """
    width, height = virtual.size
    maps = np.empty((2, height, width), dtype=np.float32)
    rows = max(1, PIXELS_AT_ONCE // width)
    for top in range(0, height, rows):
        y, x = np.mgrid[top : min(top + rows, height), :width].astype(np.float64)
        pixels = source_pixels(virtual, view, np.stack([x, y], axis=-1))
        maps[:, top : top + rows] = np.moveaxis(np.nan_to_num(pixels, nan=NO_PIXEL), -1, 0)
    return maps


def share_shown(virtual: Camera, view: Turned) -> float:
    """How much of the real image a virtual camera shows."""
    rays = unproject(view.camera, image_pixels(view.camera.size, GRID)[2])
    shown = within(project(virtual, rays @ view.virtual_from_cam.T), virtual.size)
    return float(shown.mean())

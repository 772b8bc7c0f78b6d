"""Lens models in OpenCV's parameters: names, projection, its inverse and the valid region.

A lens maps a direction in the camera frame (x right, y down, z forward) to a pixel whose
integer coordinates are pixel centres. Every lens here has a GTSAM counterpart, so the reference
graph can estimate it. Formulas: OpenCV calib3d documentation; Kannala and Brandt, PAMI 2006.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from graphs.frames import FloatArray

LensName = Literal["pinhole", "simple_radial", "radial", "radtan", "kannala_brandt"]
LENS_NAMES: tuple[LensName, ...] = get_args(LensName)

FOCAL_AND_CENTRE = ("fx", "fy", "cx", "cy")
PARAMETER_NAMES: dict[LensName, tuple[str, ...]] = {
    "pinhole": FOCAL_AND_CENTRE,
    "simple_radial": (*FOCAL_AND_CENTRE, "k1"),
    "radial": (*FOCAL_AND_CENTRE, "k1", "k2"),
    "radtan": (*FOCAL_AND_CENTRE, "k1", "k2", "p1", "p2"),
    "kannala_brandt": (*FOCAL_AND_CENTRE, "k1", "k2", "k3", "k4"),
}


@dataclass(frozen=True)
class Camera:
    """One camera: its image size and its lens with parameters in the lens's order."""

    name: str
    lens: LensName
    size: tuple[int, int]  # width, height in px
    params: FloatArray  # (len(PARAMETER_NAMES[lens]),)

    def __post_init__(self) -> None:
        if self.params.shape != (len(PARAMETER_NAMES[self.lens]),):
            raise ValueError(
                f"{self.name}: lens {self.lens} takes {len(PARAMETER_NAMES[self.lens])} "
                f"parameters ({' '.join(PARAMETER_NAMES[self.lens])}), got {self.params.size}"
            )

    @property
    def names(self) -> tuple[str, ...]:
        return PARAMETER_NAMES[self.lens]

    def named(self) -> dict[str, float]:
        return {name: float(value) for name, value in zip(self.names, self.params, strict=True)}

    @property
    def centre(self) -> FloatArray:
        """Centre of the image in px (2,), pixel centres at integers."""
        return (np.array(self.size, dtype=np.float64) - 1.0) / 2.0


def nominal_params(lens: LensName, size: tuple[int, int], focal_px: float) -> FloatArray:
    """Parameters of an undistorted lens with square pixels and a centred principal point."""
    params = np.zeros(len(PARAMETER_NAMES[lens]))
    params[:4] = focal_px, focal_px, (size[0] - 1) / 2, (size[1] - 1) / 2
    return params


def project(camera: Camera, points: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points in the camera frame (..., 3); NaN where the lens cannot see them.

    A point is refused behind the camera and beyond the radius where the distortion folds back
    (d r_distorted / d r <= 0): a mirrored projection there would be wrong, not inaccurate.
    """
    x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64), -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        if camera.lens == "kannala_brandt":
            radius = np.hypot(x, y)
            theta = np.arctan2(radius, z)
            off_axis = radius > 1e-12 * np.abs(z)
            scale = np.where(off_axis, _fisheye_angle(camera, theta) / radius, 1.0 / z)
            a, b = x * scale, y * scale
            valid = (theta <= valid_limit(camera)) & (off_axis | (z > 0))
        else:
            a, b = x / z, y / z
            valid = (z > 0) & (np.hypot(a, b) <= valid_limit(camera))
            a, b = _distort(camera, a, b)
    fx, fy, cx, cy = camera.params[:4]
    pixels = np.stack([fx * a + cx, fy * b + cy], axis=-1)
    return np.where(valid[..., None], pixels, np.nan)


def unproject(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Unit directions (..., 3) in the camera frame of pixels (..., 2); NaN where there are none."""
    fx, fy, cx, cy = camera.params[:4]
    pixels = np.asarray(pixels, dtype=np.float64)
    a, b = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
    if camera.lens == "kannala_brandt":
        rays = _unproject_fisheye(camera, a, b)
    else:
        x, y = _undistort(camera, a, b)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        error_px = np.linalg.norm(project(camera, rays) - pixels, axis=-1)
        return np.where((error_px < UNPROJECT_TOLERANCE_PX)[..., None], rays, np.nan)


UNPROJECT_TOLERANCE_PX = 1e-6  # Newton reaches 1e-10 px inside the valid region
UNPROJECT_ITERATIONS = 20


def valid_limit(camera: Camera) -> float:
    """The largest normalised radius (fisheye: angle in radians) before the lens folds back.

    First positive zero of d r_distorted / d r, a polynomial in r^2 (in 1 / r^2, reversed, its
    leading coefficient is one, however small the last); infinity when there is none.
    """
    if camera.lens == "kannala_brandt":
        coefficients = [
            1.0,
            *(c * k for c, k in zip((3, 5, 7, 9), camera.params[4:8], strict=True)),
        ]
        cap = np.pi  # an angle off the axis is at most half a turn
    else:
        k1, k2 = _radial(camera)
        coefficients, cap = [1.0, 3 * k1, 5 * k2], np.inf
    roots = np.roots(coefficients)
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 1e-12)]
    return float(min(real.max() ** -0.5, cap)) if real.size else float(cap)


def _radial(camera: Camera) -> tuple[float, float]:
    named = camera.named()
    return named.get("k1", 0.0), named.get("k2", 0.0)


def _tangential(camera: Camera) -> tuple[float, float]:
    named = camera.named()
    return named.get("p1", 0.0), named.get("p2", 0.0)


def _distort(camera: Camera, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    (k1, k2), (p1, p2) = _radial(camera), _tangential(camera)
    r2 = a * a + b * b
    d = 1 + r2 * (k1 + r2 * k2)
    return (
        a * d + 2 * p1 * a * b + p2 * (r2 + 2 * a * a),
        b * d + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b,
    )


def _undistort(camera: Camera, a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Newton's method on both coordinates, started inside the valid region."""
    (k1, k2), (p1, p2) = _radial(camera), _tangential(camera)
    limit = valid_limit(camera)
    shrink = np.minimum(1.0, 0.9 * limit / np.maximum(np.hypot(a, b), 1e-300))
    x, y = a * shrink, b * shrink
    for _ in range(UNPROJECT_ITERATIONS):
        r2 = x * x + y * y
        d, dd = 1 + r2 * (k1 + r2 * k2), k1 + 2 * r2 * k2
        da, db = _distort(camera, x, y)
        ea, eb = da - a, db - b
        jxx = d + 2 * x * x * dd + 2 * p1 * y + 6 * p2 * x
        jxy = 2 * x * y * dd + 2 * p1 * x + 2 * p2 * y
        jyy = d + 2 * y * y * dd + 6 * p1 * y + 2 * p2 * x
        determinant = jxx * jyy - jxy * jxy
        determinant = np.where(np.abs(determinant) < 1e-12, np.nan, determinant)
        x = x - (jyy * ea - jxy * eb) / determinant
        y = y - (jxx * eb - jxy * ea) / determinant
    return x, y


def _fisheye_angle(camera: Camera, theta: FloatArray) -> FloatArray:
    k1, k2, k3, k4 = camera.params[4:8]
    t2 = theta * theta
    return theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))


def _unproject_fisheye(camera: Camera, a: FloatArray, b: FloatArray) -> FloatArray:
    k1, k2, k3, k4 = camera.params[4:8]
    radius, limit = np.hypot(a, b), valid_limit(camera)
    theta = np.minimum(radius, 0.9 * limit)
    for _ in range(UNPROJECT_ITERATIONS):
        t2 = theta * theta
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        slope = np.where(np.abs(slope) < 1e-12, np.nan, slope)
        theta = theta - (_fisheye_angle(camera, theta) - radius) / slope
    factor = np.where(radius > 1e-12, np.sin(theta) / np.maximum(radius, 1e-300), 1.0)
    return np.stack([a * factor, b * factor, np.cos(theta)], axis=-1)

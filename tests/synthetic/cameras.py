"""A camera of every lens, and the lenses' formulas once more: written from the papers, unoptimised.

The formulas take complex numbers: the imaginary part of f(x + ih) / h is the derivative of f to
rounding (complex-step differentiation), with no code in common with the Jacobians it judges.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera
from graphs.frames import FloatArray
from graphs.lenses import LENSES, LensName

SIZE = (640, 480)
# Sizes of real lenses and beyond; every number different, so that no two can change places.
COEFFICIENTS: dict[LensName, tuple[float, ...]] = {
    "pinhole": (),
    "simple_radial": (-0.21,),
    "radial": (-0.28, 0.09),
    "radtan": (-0.31, 0.11, 0.004, -0.007),
    "brown": (-0.31, 0.13, 0.004, -0.007, -0.021),
    "rational": (0.23, 0.07, 0.004, -0.007, -0.011, 0.52, 0.19, 0.005),
    "thin_prism": (0.23, 0.07, 0.004, -0.007, -0.011, 0.52, 0.19, 0.005, 3e-3, -2e-3, 5e-3, 1e-3),
    "kannala_brandt": (-0.031, 0.012, -0.008, 0.0015),
    "division": (-0.17,),
    "eucm": (0.61, 1.12),
    "double_sphere": (-0.22, 0.58),
}


def wide(lens: LensName) -> bool:
    """Whether the lens sees sideways."""
    return LENSES[lens].wide


def camera_of(lens: LensName, coefficients: tuple[float, ...] | None = None) -> Camera:
    """A 640 x 480 camera with these coefficients, or real ones."""
    focal = 300.0 if wide(lens) else 520.0
    if coefficients is None:
        coefficients = COEFFICIENTS[lens]
    return Camera("cam", lens, SIZE, np.array([focal, focal + 9, 330.0, 231.0, *coefficients]))


def points_ahead(count: int = 200, spread: float = 0.8) -> FloatArray:
    """Points (count, 3) in front of a camera, up to `spread` off its axis at depth one."""
    rng = np.random.default_rng(5)
    depth = rng.uniform(0.2, 30, count)
    return np.column_stack([rng.uniform(-spread, spread, (count, 2)) * depth[:, None], depth])


def rays_at(angles: FloatArray, around: float | FloatArray = 0.0) -> FloatArray:
    """Unit rays (n, 3) at these angles off the axis."""
    around = np.broadcast_to(around, np.shape(angles))
    across = np.sin(angles)[:, None] * np.stack([np.cos(around), np.sin(around)], axis=-1)
    return np.column_stack([across, np.cos(angles)])


Complex = NDArray[np.complex128]


def formula(lens: LensName, params: Complex, points: Complex) -> Complex:
    """Pixels (n, 2) by the lens's published formula, wherever that leads."""
    fx, fy, cx, cy, *k = params
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    a, b = _sideways(lens, k, x, y, z) if wide(lens) else _on_plane(lens, k, x / z, y / z)
    return np.stack([fx * a + cx, fy * b + cy], axis=-1)


def _on_plane(lens: LensName, k: list, x: Complex, y: Complex) -> tuple[Complex, Complex]:
    """OpenCV's calib3d documentation, with the coefficients that a lens lacks at zero."""
    order = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"]
    have = dict.fromkeys(order, 0.0) | dict(zip(LENSES[lens].coefficients, k, strict=True))
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (have[name] for name in order)
    r = np.sqrt(x**2 + y**2)
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    a = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2) + s1 * r**2 + s2 * r**4
    b = y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y + s3 * r**2 + s4 * r**4
    return a, b


def _sideways(
    lens: LensName, k: list, x: Complex, y: Complex, z: Complex
) -> tuple[Complex, Complex]:
    rho = np.sqrt(x**2 + y**2)
    if lens == "kannala_brandt":
        theta = np.arctan(rho / z) + np.pi * (z.real < 0)
        powers = sum(one * theta ** (2 * i + 3) for i, one in enumerate(k))
        return (theta + powers) * x / rho, (theta + powers) * y / rho
    if lens == "division":
        # r / (1 + k r^2) = rho / z, the root that is rho / z for k = 0
        r = 2 * rho / (z + np.sqrt(z**2 - 4 * k[0] * rho**2))
        return r * x / rho, r * y / rho
    if lens == "eucm":
        alpha, beta = k
        d = np.sqrt(beta * (x**2 + y**2) + z**2)
        return x / (alpha * d + (1 - alpha) * z), y / (alpha * d + (1 - alpha) * z)
    xi, alpha = k
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return x / below, y / below


STEP = 1e-30


def complex_step(
    lens: LensName, params: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the formula's pixels by point (n, 2, 3) and by parameter (n, 2, n_params)."""
    by_point = np.empty((len(points), 2, 3))
    for axis in range(3):
        moved = points + 1j * STEP * (np.arange(3) == axis)
        by_point[..., axis] = formula(lens, params.astype(complex), moved).imag / STEP
    by_params = np.empty((len(points), 2, len(params)))
    for index in range(len(params)):
        moved = params + 1j * STEP * (np.arange(len(params)) == index)
        by_params[..., index] = formula(lens, moved, points.astype(complex)).imag / STEP
    return by_point, by_params

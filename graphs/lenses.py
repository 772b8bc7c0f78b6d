"""Lens models: parameter names, projection with Jacobians, and the region where they hold.

A lens maps a direction in the camera frame (x right, y down, z forward) to a pixel whose integer
coordinates are pixel centres: px = fx a + cx, py = fy b + cy. Each lens is one block below, from
the direction and the lens's coefficients to (a, b) with derivatives. Adding a lens: its name in
`LensName`, and its block.

Everything that numba compiles from the blocks lives in this file: numba's cache on disk notices a
change of the file that a cached function stands in, and of no other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numba import njit
from numpy.typing import NDArray

from graphs.frames import FloatArray

IntArray = NDArray[np.int64]
LensName = Literal[
    "pinhole", "simple_radial", "radial", "radtan", "brown", "rational", "thin_prism",
    "kannala_brandt", "division", "eucm", "double_sphere",
]  # fmt: skip
LENS_NAMES: tuple[LensName, ...] = get_args(LensName)
MODEL_INDEX: dict[LensName, int] = {name: index for index, name in enumerate(LENS_NAMES)}
FOCAL_AND_CENTRE = ("fx", "fy", "cx", "cy")
MAX_PARAMS = 16
SHORTEST = 1e-280  # squared length of a vector whose square is not rounded away
NO_TANGENTIAL, NO_PRISM = (0.0, 0.0), (0.0, 0.0, 0.0, 0.0)

# Not nnan, ninf: a NaN that comes in has to be seen.
_FAST: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "arcp", "reassoc", "nsz"}}
# Left to LLVM's own judgement, calls take ten times as long as the projection itself. Python
# calls none of these functions: without wrappers for it they compile in two thirds the time.
_LEAN: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_inlined: Any = njit(forceinline=True, **_FAST, **_LEAN)
_kernel: Any = njit(cache=True, nogil=True, **_FAST)


@dataclass(frozen=True)
class Lens:
    """One lens: its coefficients beside fx fy cx cy, how it maps, and where it stops."""

    coefficients: tuple[str, ...]
    nominal: tuple[float, ...]  # of a lens of which nothing is known
    limit: Callable[[FloatArray], float]  # of the coefficients; see `valid_limit` in camera.py
    wide: bool  # sees sideways: the limit is an angle, not a radius x / z
    block: Any  # compiled; what it takes and returns depends on `wide`


LENSES: dict[LensName, Lens] = {}


def _lens(
    name: LensName,
    coefficients: str,
    limit: Callable[[FloatArray], float],
    wide: bool = False,
    nominal: tuple[float, ...] = (),
) -> Callable[[Callable[..., Any]], Any]:
    """Enter the block below it under its name; a nominal coefficient is zero unless given."""
    names = tuple(coefficients.split())

    def enter(block: Callable[..., Any]) -> Any:
        LENSES[name] = Lens(names, nominal or (0.0,) * len(names), limit, wide, _inlined(block))
        return LENSES[name].block

    return enter


def _first_zero(*coefficients: float) -> float:
    """First positive s with 1 + c1 s + c2 s^2 + ... = 0; infinity when there is none.

    Solved in 1 / s, whose leading coefficient is one, however small the last.
    """
    roots = np.roots([1.0, *coefficients])
    real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 1e-12)]
    return float(1.0 / real.max()) if real.size else np.inf


# ---- lenses on the plane z = 1: OpenCV's calib3d documentation ------------------------------
# A block takes (u, v) = (x / z, y / z) and r^2. It returns the radial factor d(r^2), its
# derivative, (p1, p2) and (s1, s2, s3, s4); `_on_plane` makes (a, b) of them. It writes the
# derivatives of (a, b) by its coefficients to by_k (2, n_coefficients or more).


@_inlined
def _put(by_k: FloatArray, column: int, a: float, b: float) -> None:
    by_k[0, column] = a
    by_k[1, column] = b


@_inlined
def _put_tangential(by_k: FloatArray, column: int, u: float, v: float, r2: float) -> None:
    _put(by_k, column, 2 * u * v, r2 + 2 * v * v)
    _put(by_k, column + 1, r2 + 2 * u * u, 2 * u * v)


def _polynomial_limit(k1: float = 0.0, k2: float = 0.0, k3: float = 0.0) -> float:
    """Radius where r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing."""
    return float(np.sqrt(_first_zero(3 * k1, 5 * k2, 7 * k3)))


@_lens("pinhole", "", limit=lambda k: np.inf)
def _pinhole(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    return 1.0, 0.0, NO_TANGENTIAL, NO_PRISM


@_lens("simple_radial", "k1", limit=lambda k: _polynomial_limit(k[0]))
def _simple_radial(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    _put(by_k, 0, u * r2, v * r2)
    return 1 + k[0] * r2, k[0], NO_TANGENTIAL, NO_PRISM


@_lens("radial", "k1 k2", limit=lambda k: _polynomial_limit(k[0], k[1]))
def _radial(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    _put(by_k, 0, u * r2, v * r2)
    _put(by_k, 1, u * r2 * r2, v * r2 * r2)
    return 1 + r2 * (k[0] + r2 * k[1]), k[0] + 2 * k[1] * r2, NO_TANGENTIAL, NO_PRISM


@_lens("radtan", "k1 k2 p1 p2", limit=lambda k: _polynomial_limit(k[0], k[1]))
def _radtan(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    _put(by_k, 0, u * r2, v * r2)
    _put(by_k, 1, u * r2 * r2, v * r2 * r2)
    _put_tangential(by_k, 2, u, v, r2)
    return 1 + r2 * (k[0] + r2 * k[1]), k[0] + 2 * k[1] * r2, (k[2], k[3]), NO_PRISM


@_lens("brown", "k1 k2 p1 p2 k3", limit=lambda k: _polynomial_limit(k[0], k[1], k[4]))
def _brown(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    r4, r6 = r2 * r2, r2 * r2 * r2
    _put(by_k, 0, u * r2, v * r2)
    _put(by_k, 1, u * r4, v * r4)
    _put_tangential(by_k, 2, u, v, r2)
    _put(by_k, 4, u * r6, v * r6)
    d = 1 + k[0] * r2 + k[1] * r4 + k[4] * r6
    return d, k[0] + 2 * k[1] * r2 + 3 * k[4] * r4, (k[2], k[3]), NO_PRISM


def _rational_limit(k: FloatArray) -> float:
    """First radius where r N(r^2) / D(r^2) stops growing, or where D is zero."""
    above, below = np.array([1.0, k[0], k[1], k[4]]), np.array([1.0, k[5], k[6], k[7]])
    powers = 2.0 * np.arange(4)  # 2 s d/ds of a polynomial in s = r^2
    slope = np.convolve(above + powers * above, below) - np.convolve(above, powers * below)
    return float(np.sqrt(min(_first_zero(*slope[1:]), _first_zero(*below[1:]))))


@_inlined
def _rational_factor(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    """N / D and its derivative by r^2, and the columns of k1 k2 p1 p2 k3 k4 k5 k6."""
    r4, r6 = r2 * r2, r2 * r2 * r2
    w = 1 / (1 + k[5] * r2 + k[6] * r4 + k[7] * r6)
    d = w * (1 + k[0] * r2 + k[1] * r4 + k[4] * r6)
    for j, power in ((0, r2), (1, r4), (4, r6)):
        _put(by_k, j, u * power * w, v * power * w)
    for j, power in ((5, r2), (6, r4), (7, r6)):
        _put(by_k, j, -u * power * w * d, -v * power * w * d)
    _put_tangential(by_k, 2, u, v, r2)
    above = k[0] + 2 * k[1] * r2 + 3 * k[4] * r4
    below = k[5] + 2 * k[6] * r2 + 3 * k[7] * r4
    return d, w * (above - d * below)


@_lens("rational", "k1 k2 p1 p2 k3 k4 k5 k6", limit=_rational_limit)
def _rational(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    d, d_r2 = _rational_factor(k, u, v, r2, by_k)
    return d, d_r2, (k[2], k[3]), NO_PRISM


@_lens("thin_prism", "k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4", limit=_rational_limit)
def _thin_prism(k: FloatArray, u: float, v: float, r2: float, by_k: FloatArray) -> Any:
    d, d_r2 = _rational_factor(k, u, v, r2, by_k)
    for j, power in ((8, r2), (9, r2 * r2)):
        _put(by_k, j, power, 0.0)
        _put(by_k, j + 2, 0.0, power)
    return d, d_r2, (k[2], k[3]), (k[8], k[9], k[10], k[11])


# ---- lenses that see sideways: a = x s, b = y s with a scale s(rho^2 = x^2 + y^2, z) ---------
# A block returns whether the lens sees this way, s, and its derivatives by rho^2 and by z. It
# writes the derivatives of s by its coefficients to by_k[0].


def _angular_limit(k: FloatArray) -> float:
    return float(min(np.sqrt(_first_zero(3 * k[0], 5 * k[1], 7 * k[2], 9 * k[3])), np.pi))


@_lens("kannala_brandt", "k1 k2 k3 k4", limit=_angular_limit, wide=True)
def _kannala_brandt(k: FloatArray, limit: float, rho2: float, z: float, by_k: FloatArray) -> Any:
    """Kannala and Brandt, PAMI 2006, as OpenCV's fisheye."""
    if rho2 <= 1e-24 * z * z:  # on the axis, to rounding
        for j in range(4):
            by_k[0, j] = 0.0
        return z > 0, 1 / z, 0.0, -1 / (z * z)
    rho = np.sqrt(rho2)
    theta = np.arctan2(rho, z)
    t2 = theta * theta
    power = theta / rho
    for j in range(4):
        power *= t2
        by_k[0, j] = power
    s = theta / rho * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    slope = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    s_z = -slope / (rho2 + z * z)
    return theta < limit, s, -(s + z * s_z) / (2 * rho2), s_z


@_lens("division", "k1", lambda k: np.pi if k[0] < 0 else np.arctan2(0.5, np.sqrt(k[0])), wide=True)
def _division(k: FloatArray, limit: float, rho2: float, z: float, by_k: FloatArray) -> Any:
    """Fitzgibbon, CVPR 2001: the plane point (a, b) is seen along (a, b, 1 + k1 (a^2 + b^2))."""
    q = np.sqrt(z * z - 4 * k[0] * rho2)  # NaN beyond the fold
    s = 2 / (z + q)
    s_q = -0.5 * s * s
    by_k[0, 0] = s_q * -2 * rho2 / q
    return q > 0 and z + q > 0, s, s_q * -2 * k[0] / q, s_q * (1 + z / q)


@_inlined
def _growing(alpha: float) -> float:
    """w, where sin t / (alpha + (1 - alpha) cos t) grows up to cos t = -w."""
    return alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha


def _eucm_limit(k: FloatArray) -> float:
    if k[1] < 0:
        return float(np.arctan(1 / np.sqrt(-k[1])))
    w = _growing.py_func(k[0])
    return float(np.arctan2(np.sqrt(1 - w * w), -w * np.sqrt(k[1])))


# Not alpha = 0, a pinhole, where beta does nothing; EuRoC's and TUM VI's lenses have 0.6 and 1.1.
@_lens("eucm", "alpha beta", limit=_eucm_limit, wide=True, nominal=(0.6, 1.0))
def _eucm(k: FloatArray, limit: float, rho2: float, z: float, by_k: FloatArray) -> Any:
    """Khomutenko, Garcia and Martinet, RA-L 2016."""
    alpha, beta = k[0], k[1]
    d = np.sqrt(beta * rho2 + z * z)
    s = 1 / (alpha * d + (1 - alpha) * z)
    s_d, s_z = -s * s * alpha, -s * s * (1 - alpha)
    by_k[0, 0], by_k[0, 1] = s * s * (z - d), s_d * rho2 / (2 * d)
    return z > -_growing(alpha) * d, s, s_d * beta / (2 * d), s_z + s_d * z / d


def _double_sphere_limit(k: FloatArray) -> float:
    """The angle that seen from the second sphere's centre has the cosine -w.

    The paper's bound swaps the spheres. With xi > 1 the centre is outside the first sphere.
    """
    xi, w = k[0], _growing.py_func(k[1])
    inside = 1 - xi * xi * (1 - w * w)
    cosine = -xi * (1 - w * w) - w * np.sqrt(inside) if inside >= 0 else -1.0
    if xi > 1:
        cosine = max(cosine, -1 / xi)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0))) if xi > -1 else 0.0


# Not xi = 0, where focal length and alpha do all that xi does; those lenses have -0.2 and 0.6.
@_lens("double_sphere", "xi alpha", limit=_double_sphere_limit, wide=True, nominal=(-0.2, 0.6))
def _double_sphere(k: FloatArray, limit: float, rho2: float, z: float, by_k: FloatArray) -> Any:
    """Usenko, Demmel and Cremers, 3DV 2018."""
    xi, alpha = k[0], k[1]
    d1 = np.sqrt(rho2 + z * z)
    h = xi * d1 + z  # depth from the second sphere's centre
    d2 = np.sqrt(rho2 + h * h)
    s = 1 / (alpha * d2 + (1 - alpha) * h)
    s_d2, s_h = -s * s * alpha, -s * s * (alpha * h / d2 + 1 - alpha)
    by_k[0, 0], by_k[0, 1] = s_h * d1, s * s * (h - d2)
    seen = xi > -1 and d1 + xi * z > 0 and h > -_growing(alpha) * d2
    return seen, s, s_d2 / (2 * d2) + s_h * xi / (2 * d1), s_h * (xi * z / d1 + 1)


# ---- all lenses, by number -----------------------------------------------------------------

PARAMETER_NAMES: dict[LensName, tuple[str, ...]] = {
    name: (*FOCAL_AND_CENTRE, *LENSES[name].coefficients) for name in LENS_NAMES
}
_COUNTS = np.array([len(LENSES[name].coefficients) for name in LENS_NAMES])


def _on_plane(block: Any) -> Any:
    """The map of a lens on the plane, refused behind it and where any of its terms fold it."""

    @_inlined
    def maps(k: FloatArray, limit: float, x: float, y: float, z: float, by_k: FloatArray) -> Any:
        u, v = x / z, y / z
        r2 = u * u + v * v
        d, d_r2, (p1, p2), (s1, s2, s3, s4) = block(k, u, v, r2, by_k)
        a = u * d + 2 * p1 * u * v + p2 * (r2 + 2 * u * u) + r2 * (s1 + s2 * r2)
        b = v * d + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v + r2 * (s3 + s4 * r2)
        prism_a, prism_b = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
        across = 2 * (u * v * d_r2 + p1 * u + p2 * v)
        a_u = d + 2 * u * u * d_r2 + 2 * p1 * v + 6 * p2 * u + u * prism_a
        b_v = d + 2 * v * v * d_r2 + 6 * p1 * v + 2 * p2 * u + v * prism_b
        a_v, b_u = across + v * prism_a, across + u * prism_b
        unfolded = a_u * b_v > a_v * b_u and a_u + b_v > 0
        seen = z > 0 and r2 < limit * limit and unfolded
        a_z, b_z = -(a_u * u + a_v * v) / z, -(b_u * u + b_v * v) / z
        return seen, a, b, a_u / z, a_v / z, a_z, b_u / z, b_v / z, b_z

    return maps


def _scaled(block: Any, count: int) -> Any:
    """The map of a lens that sees sideways, with `count` coefficients."""

    @_inlined
    def maps(k: FloatArray, limit: float, x: float, y: float, z: float, by_k: FloatArray) -> Any:
        rho2 = x * x + y * y
        seen, s, s_r2, s_z = block(k, limit, rho2, z, by_k)
        seen = seen and SHORTEST < rho2 + z * z < np.inf
        for j in range(count):
            _put(by_k, j, x * by_k[0, j], y * by_k[0, j])
        a_y = 2 * x * y * s_r2
        a_x, b_y = s + 2 * x * x * s_r2, s + 2 * y * y * s_r2
        return seen, x * s, y * s, a_x, a_y, x * s_z, a_y, b_y, y * s_z

    return maps


def _from(index: int) -> Any:
    """The map of the lenses from `index` on, by number; LLVM makes a switch of it."""
    if index == len(LENS_NAMES):
        unseen = (False, *(np.nan,) * 8)
        return _inlined(lambda model, k, limit, x, y, z, by_k: unseen)
    lens, others = LENSES[LENS_NAMES[index]], _from(index + 1)
    maps = _scaled(lens.block, len(lens.coefficients)) if lens.wide else _on_plane(lens.block)

    @_inlined
    def chosen(model: int, k: Any, limit: float, x: float, y: float, z: float, by_k: Any) -> Any:
        if model == index:
            return maps(k, limit, x, y, z, by_k)
        return others(model, k, limit, x, y, z, by_k)

    return chosen


_map = _from(0)


@_inlined
def _project_one(
    models: IntArray, params: FloatArray, limits: FloatArray, camera: IntArray, points: FloatArray,
    pixels: FloatArray, by_point: FloatArray, by_k: FloatArray, i: int,
) -> tuple[bool, float, float]:  # fmt: skip
    """Write observation i's pixel and its derivatives by point; whether it is seen, a, b."""
    c = camera[i]
    lens = params[c]
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    seen, a, b, a_x, a_y, a_z, b_x, b_y, b_z = _map(models[c], lens[4:], limits[c], x, y, z, by_k)
    if seen:
        fx, fy = lens[0], lens[1]
        pixels[i, 0], pixels[i, 1] = fx * a + lens[2], fy * b + lens[3]
        by_point[i, 0, 0], by_point[i, 0, 1], by_point[i, 0, 2] = fx * a_x, fx * a_y, fx * a_z
        by_point[i, 1, 0], by_point[i, 1, 1], by_point[i, 1, 2] = fy * b_x, fy * b_y, fy * b_z
    else:
        pixels[i] = np.nan
        by_point[i] = 0.0
    return seen, a, b


@_kernel
def project_many(
    models: IntArray, params: FloatArray, limits: FloatArray, camera: IntArray, points: FloatArray,
    pixels: FloatArray, by_point: FloatArray, by_params: FloatArray,
) -> None:  # fmt: skip
    """Project points through their cameras, with Jacobians: the inner loop of the solver.

    models (n_cam,) by MODEL_INDEX, params (n_cam, P or more), limits (n_cam,); camera (n,) and
    points (n, 3) in the cameras' frames, of any length. Written: pixels (n, 2), by_point (n, 2,
    3) and by_params (n, 2, P), zero beyond a lens's own parameters; P is at least the longest
    lens's. Where a projection is refused, the pixel is NaN and both Jacobians are zero.
    """
    by_k = np.zeros((2, MAX_PARAMS - 4))
    for i in range(len(camera)):
        seen, a, b = _project_one(models, params, limits, camera, points, pixels, by_point, by_k, i)
        by_params[i] = 0.0
        if not seen:
            continue
        by_params[i, 0, 0], by_params[i, 1, 1] = a, b
        by_params[i, 0, 2] = by_params[i, 1, 3] = 1.0
        fx, fy = params[camera[i], 0], params[camera[i], 1]
        for j in range(_COUNTS[models[camera[i]]]):
            by_params[i, 0, 4 + j] = fx * by_k[0, j]
            by_params[i, 1, 4 + j] = fy * by_k[1, j]


@_kernel
def project_point_many(
    models: IntArray, params: FloatArray, limits: FloatArray, camera: IntArray, points: FloatArray,
    pixels: FloatArray, by_point: FloatArray,
) -> None:  # fmt: skip
    """`project_many` without the derivatives by parameter, in two thirds of the time."""
    by_k = np.zeros((2, MAX_PARAMS - 4))
    for i in range(len(camera)):
        _project_one(models, params, limits, camera, points, pixels, by_point, by_k, i)

"""A camera: a lens with numbers. Projection, its Jacobians, its inverse, and change of lens."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from graphs.frames import FloatArray
from graphs.lenses import (
    LENSES,
    MODEL_INDEX,
    PARAMETER_NAMES,
    IntArray,
    LensName,
    project_many,
    project_point_many,
)


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
    """Parameters of a lens of which nothing is known: centred, square pixels.

    focal_px: at the centre, where every lens is a pinhole; its fx and fy, but for double_sphere.
    """
    centre = (size[0] - 1) / 2, (size[1] - 1) / 2
    params = np.array([1.0, 1.0, *centre, *LENSES[lens].nominal])
    params[:2] = focal_px / focal_on_axis(Camera("", lens, size, params))
    return params


def focal_on_axis(camera: Camera) -> FloatArray:
    """Pixels per radian (2,) across and down, at the principal point: fx, fy of most lenses."""
    by_point = _project_point(camera, np.array([0.0, 0.0, 1.0]))[1]
    return by_point[[0, 1], [0, 1]]


def valid_limit(camera: Camera) -> float:
    """How far off its axis the lens sees, before it folds back or is infinite.

    A radius at depth one, infinity where there is no end; of wide lenses the angle in radians, at
    most pi. Tangential and prism terms are left out.
    """
    return LENSES[camera.lens].limit(camera.params[4:])


def lens_arrays(cameras: Sequence[Camera]) -> tuple[IntArray, FloatArray, FloatArray]:
    """What `project_many` wants: models (n_cam,), params (n_cam, most), limits (n_cam,)."""
    params = np.zeros((len(cameras), max(camera.params.size for camera in cameras)))
    for row, camera in zip(params, cameras, strict=True):
        row[: camera.params.size] = camera.params
    models = np.array([MODEL_INDEX[camera.lens] for camera in cameras], dtype=np.int64)
    return models, params, np.array([valid_limit(camera) for camera in cameras])


def project(camera: Camera, points: FloatArray) -> FloatArray:
    """Pixels (..., 2) of points in the camera frame (..., 3); NaN where the lens cannot see them.

    A point is refused behind the camera and beyond the radius where the distortion folds back: a
    mirrored projection there would be wrong, not inaccurate.
    """
    return _project_point(camera, points)[0]


def _project_point(camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    points = np.asarray(points, dtype=np.float64)
    rows = _rows(points)
    pixels, by_point = np.empty((len(rows), 2)), np.empty((len(rows), 2, 3))
    one = np.zeros(len(rows), dtype=np.int64)
    project_point_many(*lens_arrays([camera]), one, rows, pixels, by_point)
    shape = points.shape[:-1]
    return pixels.reshape(*shape, 2), by_point.reshape(*shape, 2, 3)


def _rows(points: FloatArray) -> FloatArray:
    # Contiguous and writable, else numba compiles for seconds once more.
    return np.require(points.reshape(-1, 3), requirements=["C", "W"])


def project_jacobian(
    camera: Camera, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (..., 2) as `project`, derivatives by point (..., 2, 3) and parameter (..., 2, n).

    Jacobians are zero where the pixel is NaN.
    """
    points = np.asarray(points, dtype=np.float64)
    rows = _rows(points)
    shape, count = points.shape[:-1], camera.params.size
    pixels, by_point = np.empty((len(rows), 2)), np.empty((len(rows), 2, 3))
    by_params = np.empty((len(rows), 2, count))
    one = np.zeros(len(rows), dtype=np.int64)
    project_many(*lens_arrays([camera]), one, rows, pixels, by_point, by_params)
    return (
        pixels.reshape(*shape, 2),
        by_point.reshape(*shape, 2, 3),
        by_params.reshape(*shape, 2, count),
    )


UNPROJECT_TOLERANCE_PX = 1e-6  # Newton reaches 1e-10 px inside the valid region
UNPROJECT_CONVERGED = 1e-13  # of the focal length and the pixel: rounding
UNPROJECT_ITERATIONS = 20
START_ANGLES = 256  # of the table from which Newton starts, less than a degree off


def unproject(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Unit directions (..., 3) in the camera frame of pixels (..., 2); NaN where there are none.

    Newton's method on the sphere. A step that leaves the valid region or gains nothing is
    shortened.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    wanted = pixels.reshape(-1, 2)
    rays = _start_rays(camera, wanted)
    seen, by_point = _project_point(camera, rays)
    error_px = np.linalg.norm(seen - wanted, axis=-1)
    converged = UNPROJECT_CONVERGED * (camera.params[0] + np.abs(wanted).max(axis=-1))
    length = np.ones(len(wanted))
    for _ in range(UNPROJECT_ITERATIONS):
        rows = np.flatnonzero(error_px > converged)
        if not rows.size:
            break
        step = _newton_step(by_point[rows], seen[rows] - wanted[rows])
        tried = rays[rows] + length[rows, None] * step
        tried /= np.linalg.norm(tried, axis=-1, keepdims=True)
        pixel, jacobian = _project_point(camera, tried)
        left_px = np.linalg.norm(pixel - wanted[rows], axis=-1)
        better = left_px < error_px[rows]  # not so where it is NaN
        length[rows] = np.where(better, 1.0, length[rows] / 4)
        taken = rows[better]
        rays[taken], seen[taken] = tried[better], pixel[better]
        by_point[taken], error_px[taken] = jacobian[better], left_px[better]
    rays[~(error_px < UNPROJECT_TOLERANCE_PX)] = np.nan
    return rays.reshape(*pixels.shape[:-1], 3)


def _start_rays(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Rays (n, 3) of pixels (n, 2) as if the lens mapped as it does along one axis."""
    limit = valid_limit(camera)
    widest = limit if LENSES[camera.lens].wide else np.arctan(limit)
    angles = np.linspace(0, widest, START_ANGLES + 1)[:-1]
    table = project(camera, np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1))
    radii = np.linalg.norm((table - camera.params[2:4]) / camera.params[:2], axis=-1)
    angles, radii = angles[np.isfinite(radii)], radii[np.isfinite(radii)]
    if not angles.size:
        return np.full((len(pixels), 3), np.nan)
    off_axis = (pixels - camera.params[2:4]) / camera.params[:2]
    radius = np.linalg.norm(off_axis, axis=-1, keepdims=True)
    angle = np.interp(radius, radii, angles)
    with np.errstate(invalid="ignore"):  # at infinity
        across = np.sin(angle) * off_axis / np.maximum(radius, 1e-300)
    return np.concatenate([across, np.cos(angle)], axis=-1)


def _newton_step(by_point: FloatArray, error: FloatArray) -> FloatArray:
    """The smallest change (n, 3) of rays that removes pixel errors (n, 2) to first order.

    It is across the ray: a Jacobian (n, 2, 3) is zero along it.
    """
    j_a, j_b = by_point[:, 0], by_point[:, 1]
    aa, ab, bb = (np.einsum("ni,ni->n", p, q) for p, q in ((j_a, j_a), (j_a, j_b), (j_b, j_b)))
    determinant = np.where(aa * bb > ab * ab, aa * bb - ab * ab, np.nan)
    weight_a = (bb * error[:, 0] - ab * error[:, 1]) / determinant
    weight_b = (aa * error[:, 1] - ab * error[:, 0]) / determinant
    return -(weight_a[:, None] * j_a + weight_b[:, None] * j_b)


def image_pixels(
    size: tuple[int, int], shape: tuple[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A grid over an image from corner to corner: x (across,), y (down,), pixels (n, 2) by rows."""
    across, down = (np.linspace(0, n - 1, count) for n, count in zip(size, shape, strict=True))
    return across, down, np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


FIT_GRID = (24, 18)  # pixels across and down the image


def fit_lens(
    camera: Camera, lens: LensName, free: Collection[str] | None = None
) -> tuple[Camera, float]:
    """The camera of another lens that is nearest over the image, and its rms error in px.

    Least squares of the pixels (both coordinates) of a grid of the image's rays. `free`: the
    coefficients that may leave their nominal values; all, where it is not given. A ray that the
    new lens cannot see counts as the image's diagonal. Infinity where the camera sees no ray.
    """
    wanted = image_pixels(camera.size, FIT_GRID)[2]
    rays = unproject(camera, wanted)
    wanted, rays = wanted[np.isfinite(rays[:, 0])], rays[np.isfinite(rays[:, 0])]
    free = LENSES[lens].coefficients if free is None else free
    start = _start_of_fit(camera, lens, free)
    varied = [i for i, name in enumerate(start.names) if i < 4 or name in free]
    if wanted.size < len(varied):
        return start, np.inf
    # All at once may end at a fold, worse than a pinhole; one more at a time, in another valley.
    together = _fit_params(start, varied, rays, wanted)
    fitted, error_px = start, np.inf
    for count in range(4, len(varied) + 1):
        fitted, error_px = _fit_params(fitted, varied[:count], rays, wanted)
    return together if together[1] < error_px else (fitted, error_px)


def _fit_params(
    start: Camera, varied: Sequence[int], rays: FloatArray, pixels: FloatArray
) -> tuple[Camera, float]:
    unseen_px = float(np.hypot(*start.size))

    def with_values(values: FloatArray) -> Camera:
        params = start.params.copy()
        params[varied] = values
        return replace(start, params=params)

    def residuals(values: FloatArray) -> FloatArray:
        error = project(with_values(values), rays) - pixels
        return np.where(np.isnan(error), unseen_px, error).ravel()

    def jacobian(values: FloatArray) -> FloatArray:
        by_params = project_jacobian(with_values(values), rays)[2]
        return by_params[..., varied].reshape(-1, len(varied))

    found = least_squares(residuals, start.params[varied], jacobian, method="lm", x_scale="jac")
    return with_values(found.x), float(np.sqrt(2 * found.cost / len(pixels)))


def carries_over(a: LensName, b: LensName) -> bool:
    """Whether coefficients of one name mean the same in both lenses."""
    return a == b or not (LENSES[a].wide or LENSES[b].wide)


def _start_of_fit(camera: Camera, lens: LensName, free: Collection[str]) -> Camera:
    """Focal length and centre carry over, and free coefficients where they can."""
    params = nominal_params(lens, camera.size, 1.0)
    params[:2] *= focal_on_axis(camera)
    params[2:4] = camera.params[2:4]
    if carries_over(camera.lens, lens):
        known = camera.named()
        for index, name in enumerate(PARAMETER_NAMES[lens]):
            if name in known and (index < 4 or name in free):
                params[index] = known[name]
    return replace(camera, lens=lens, params=params)

"""Points in space from their pixels in several cameras at one instant, and how well they are known.

Units, held parameters and the indices of cameras are as in `graphs.propagation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphs.camera import unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.problem import Estimate
from graphs.propagation import by_reported_pose, cross_covariance, projection

# Nearly Gaussian is inverse depth: three of its sigmas from zero, a point is not at infinity. Of
# depths drawn there, 71 % lie within the stated sigma and 89 % within two, at ten 68 % and 94 %.
MIN_DEPTH_SIGMAS = 3.0
MOST_CONDITION = 1e13  # of a point's normal equations: rays parallel to 1e-6 rad, then rounding
ON_PARALLEL_RAYS = 1e-13  # information that keeps the start finite there
ITERATIONS = 50
CONVERGED_PX = 1e-10
ROUNDING = 1e-11  # of the cost: residuals of a tenth of a px at pixels in the thousands
FIRST_DAMPING, LEAST_DAMPING = 1e-6, 1e-12


@dataclass(frozen=True)
class Triangulation:
    """Points in the rig's frame, and how well the pixels and the calibration determine them.

    Depth is the distance from the first of the cameras. Several points' joint covariance follows
    from `names` and `by_calibration` by `transformed`: they share the calibration.
    """

    points: FloatArray  # (..., 3)
    cov_noise: FloatArray  # (..., 3, 3) from the noise of the pixels
    cov_calibration: FloatArray  # (..., 3, 3) from lenses and cam_from_rig
    depth: FloatArray  # (...)
    sigma_depth_noise: FloatArray  # (...)
    sigma_depth_calibration: FloatArray  # (...)
    residuals_px: FloatArray  # (..., n_cams, 2) projected minus given
    names: tuple[str, ...]  # of the cameras' lenses and cam_from_rig
    by_calibration: FloatArray  # (..., 3, len(names))

    @property
    def cov(self) -> FloatArray:
        """Covariance (..., 3, 3) of the points."""
        return self.cov_noise + self.cov_calibration

    @property
    def sigma_depth(self) -> FloatArray:
        """Sigma (...) of the depth."""
        return np.hypot(self.sigma_depth_noise, self.sigma_depth_calibration)


def triangulated_covariance(
    estimate: Estimate,
    covariance: Covariance,
    cameras: Sequence[int],
    pixels: FloatArray,
    sigma_px: float | FloatArray,
) -> Triangulation:
    """Points from their pixels (..., n_cams, 2) at one instant, as `triangulate`, and covariances.

    With residuals r(x, c) whitened, B = dr/dx and A = dr/dc, least squares moves x by
    -(B'B)^-1 B'A dc when the calibration moves (implicit function theorem, Gauss-Newton's
    Hessian). Raises ValueError as `triangulate`, and where a depth is not MIN_DEPTH_SIGMAS of
    its sigmas: the rays are parallel for all that is known.
    """
    points = triangulate(estimate, cameras, pixels, sigma_px)
    pixels = np.asarray(pixels, dtype=np.float64)
    sigma = np.broadcast_to(sigma_px, pixels.shape[:-1])
    views = [projection(estimate, camera, points) for camera in cameras]
    by_point = np.stack([v.by_point for v in views], axis=-3) / sigma[..., None, None]
    normal = np.einsum("...cki,...ckj->...ij", by_point, by_point)
    _refuse(estimate, cameras, ~(np.linalg.cond(normal) < MOST_CONDITION))
    cov_noise = np.linalg.inv(normal)
    parts = [
        -cov_noise @ by_point[..., i, :, :].mT @ (v.by_calibration / sigma[..., i, None, None])
        for i, v in enumerate(views)
    ]
    by_calibration = np.concatenate(parts, axis=-1)
    names = tuple(name for view in views for name in view.names)
    of_calibration = cross_covariance(covariance, names, names)

    depth, by_place, by_all = _depth(estimate, cameras[0], points, by_calibration)
    found = Triangulation(
        points,
        cov_noise,
        by_calibration @ of_calibration @ by_calibration.mT,
        depth,
        _sigma(by_place, cov_noise),
        _sigma(by_all, of_calibration),
        np.stack([v.pixels for v in views], axis=-2) - pixels,
        names,
        by_calibration,
    )
    _refuse(estimate, cameras, ~(depth > MIN_DEPTH_SIGMAS * found.sigma_depth))
    return found


def _depth(
    estimate: Estimate, camera: int, points: FloatArray, by_calibration: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance (...) of points from a camera, and its derivatives by the point (..., 3) and by the
    calibration (..., n), whose first parameters are that camera's, and move the points too."""
    cam_from_rig = estimate.cam_from_rig[camera]
    in_camera = cam_from_rig @ points
    depth = np.linalg.norm(in_camera, axis=-1)
    along = (in_camera / depth[..., None])[..., None, :]
    by_point = along @ cam_from_rig.rotation
    by_all = by_point @ by_calibration
    n_lens = estimate.cameras[camera].params.size
    by_all[..., n_lens : n_lens + 6] += along @ by_reported_pose(
        in_camera - cam_from_rig.translation
    )
    return depth, by_point[..., 0, :], by_all[..., 0, :]


def _sigma(derivative: FloatArray, cov: FloatArray) -> FloatArray:
    """Sigma (...) of what has the derivative (..., n) by something of covariance (..., n, n)."""
    variance = np.einsum("...i,...ij,...j->...", derivative, cov, derivative)
    return np.sqrt(np.maximum(variance, 0.0))  # an exact zero may round below


def triangulate(
    estimate: Estimate, cameras: Sequence[int], pixels: FloatArray, sigma_px: float | FloatArray
) -> FloatArray:
    """Points (..., 3) in the rig's frame that best explain their pixels (..., n_cams, 2).

    sigma_px: of one pixel coordinate, for all or broadcast to (..., n_cams). Weighted least
    squares of the pixels by Levenberg-Marquardt, from the point nearest to the rays.
    Raises ValueError for fewer than two cameras, for other shapes, for a pixel that the lens does
    not see, and where rays do not meet ahead.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if pixels.shape[-2:] != (len(cameras), 2):
        raise ValueError(f"{len(cameras)} cameras need pixels (..., {len(cameras)}, 2)")
    if len(cameras) < 2 or len(set(cameras)) < len(cameras):
        raise ValueError("a point needs the pixels of two or more cameras, each once")
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), pixels.shape[:-1])
    if not (sigma > 0).all():
        raise ValueError("sigma_px must be positive: give the noise of one pixel coordinate")
    weight = (sigma.min(initial=np.inf) / sigma).reshape(-1, len(cameras))
    wanted = pixels.reshape(-1, len(cameras), 2)
    points, ahead = _nearest_to_rays(estimate, cameras, wanted)
    cost, normal, gradient = _normal_equations(estimate, cameras, points, wanted, weight)
    _refuse(estimate, cameras, (~(ahead & np.isfinite(cost))).reshape(pixels.shape[:-2]))
    damping = np.full(len(points), FIRST_DAMPING)
    for _ in range(ITERATIONS):
        damped = normal + damping[:, None, None] * np.eye(3) * normal
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        if (-(step * gradient).sum(-1) <= CONVERGED_PX**2 + ROUNDING * cost).all():
            break
        tried = _normal_equations(estimate, cameras, points + step, wanted, weight)
        better = tried[0] <= cost  # not so where it is NaN
        damping = np.where(better, np.maximum(damping / 10, LEAST_DAMPING), damping * 10)
        points = np.where(better[:, None], points + step, points)
        cost = np.where(better, tried[0], cost)
        normal = np.where(better[:, None, None], tried[1], normal)
        gradient = np.where(better[:, None], tried[2], gradient)
    return points.reshape(*pixels.shape[:-2], 3)


def _nearest_to_rays(
    estimate: Estimate, cameras: Sequence[int], pixels: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Points (n, 3) nearest to the rays of pixels (n, n_cams, 2), and whether they lie ahead."""
    rays, centres = np.empty((*pixels.shape[:-1], 3)), np.empty((len(cameras), 3))
    for i, camera in enumerate(cameras):
        seen = unproject(estimate.cameras[camera], pixels[:, i])
        for pixel in pixels[np.isnan(seen).any(-1), i]:
            raise ValueError(
                f"{estimate.cameras[camera].name}: its lens sees nothing at pixel "
                f"({pixel[0]:.1f}, {pixel[1]:.1f}): leave this observation out"
            )
        rays[:, i] = seen @ estimate.cam_from_rig[camera].rotation
        centres[i] = estimate.cam_from_rig[camera].inverse.translation
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    normal = across.sum(1) + ON_PARALLEL_RAYS * np.eye(3)
    points = np.linalg.solve(normal, np.einsum("ncij,cj->ni", across, centres)[..., None])[..., 0]
    ahead = ((points[:, None] - centres) * rays).sum(-1) > 0
    return points, ahead.all(-1)


def _normal_equations(
    estimate: Estimate,
    cameras: Sequence[int],
    points: FloatArray,
    pixels: FloatArray,
    weight: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cost (n,) in px^2, B'B (n, 3, 3) and B'r (n, 3), residuals weighted by (n, n_cams)."""
    views = [projection(estimate, camera, points) for camera in cameras]
    residuals = (np.stack([v.pixels for v in views], axis=1) - pixels) * weight[..., None]
    by_point = np.stack([v.by_point for v in views], axis=1) * weight[..., None, None]
    normal = np.einsum("ncki,nckj->nij", by_point, by_point)
    gradient = np.einsum("ncki,nck->ni", by_point, residuals)
    return (residuals**2).sum((1, 2)), normal, gradient


def _refuse(estimate: Estimate, cameras: Sequence[int], bad: NDArray[np.bool_]) -> None:
    """Raise ValueError when any point is bad (...): its rays do not meet."""
    if not np.any(bad):
        return
    which = f"point {np.flatnonzero(bad)[0]}: " if np.ndim(bad) else ""
    names = ", ".join(estimate.cameras[camera].name for camera in cameras)
    raise ValueError(
        f"{which}the rays of {names} do not meet, or are parallel within their sigma: it is too "
        "far away for this baseline, or the pixels show different points. Take cameras that are "
        "farther apart, or leave it out"
    )

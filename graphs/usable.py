"""Whether numbers are certain enough to use: what an application meets of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from graphs.camera import Camera, focal_on_axis
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.image_grid import ImageGrid, image_grid, without_rotation
from graphs.problem import BoolArray, Estimate, Observations

# A focal length of 2 % makes depth 2 % wrong; the worst real scan states 1.1 %.
USABLE_FOCAL_SIGMA = 0.02
# Of any pixel's ray, rms over the image, once the rig turned as suits best: the worst real scan
# states 0.15 deg, degenerate simulated ones 0.5 deg (two cameras straight on) to 100 deg.
USABLE_RAY_SIGMA_DEG = 0.3
# Of the image's longer side, how far from a pixel something must have been seen for its ray to be
# judged. Scans fill their images; boards often leave corners out, where a lens is extrapolated.
NEAR_SEEN = 0.1
MUCH_UNSEEN = 0.1  # of an image: less is its rim


def unusable(
    estimate: Estimate,
    stated: Covariance,
    distances: Sequence[float],
    seen: Observations | None = None,
) -> tuple[str, ...]:
    """Why the numbers are too uncertain to use, in words; empty where they are not.

    Judged is what an application meets: the focal length, and where rays point, of that part of
    the image in which something was `seen`. A principal point that only a prior knows is no
    reason, as long as rays are right: tilt makes up for it.
    """
    reasons, sigma = [], stated.sigma
    for camera in estimate.cameras:
        for name, value in zip(("fx", "fy"), camera.params[:2], strict=True):
            relative = sigma.get(f"{camera.name}.{name}", 0.0) / value
            if not relative <= USABLE_FOCAL_SIGMA:
                reasons.append(
                    f"the sigma of {camera.name}.{name} is {relative:.1%} of it (usable up to "
                    f"{USABLE_FOCAL_SIGMA:.0%})"
                )
    for camera, ray in zip(
        estimate.cameras, ray_sigmas_deg(estimate, stated, distances, seen), strict=True
    ):
        if not ray <= USABLE_RAY_SIGMA_DEG:
            where = "over the image" if seen is None else "where it saw something"
            reasons.append(
                f"rays of {camera.name} are uncertain by {ray:.2g} deg (rms {where}; usable up to "
                f"{USABLE_RAY_SIGMA_DEG:g} deg)"
            )
    return tuple(reasons)


def ray_sigmas_deg(
    estimate: Estimate,
    stated: Covariance,
    distances: Sequence[float],
    seen: Observations | None = None,
) -> tuple[float, ...]:
    """How far off any pixel's ray is by the stated covariance, a camera each, in degrees.

    Rms over the part of its image in which something was `seen`, the whole where not given, once
    the whole rig turned as suits best there.
    """
    if not stated.names:
        return (0.0,) * len(estimate.cameras)
    grid = image_grid(estimate, stated.names, distances)
    near = near_seen(grid, estimate, seen)
    variance = _variances(grid, stated, near)
    return tuple(
        _rms_deg(camera, variance[near & (grid.camera == index)])
        for index, camera in enumerate(estimate.cameras)
    )


def unseen_in_words(
    estimate: Estimate, stated: Covariance, distances: Sequence[float], seen: Observations
) -> tuple[str, ...]:
    """A line for each camera much of whose image saw nothing, and is not known there."""
    if not stated.names:
        return ()
    grid = image_grid(estimate, stated.names, distances)
    near = near_seen(grid, estimate, seen)
    variance, lines = _variances(grid, stated, near), []
    for index, camera in enumerate(estimate.cameras):
        own = grid.camera == index
        share = float(np.mean(~near[own]))
        deg = _rms_deg(camera, variance[own & ~near])
        if share > MUCH_UNSEEN and deg > USABLE_RAY_SIGMA_DEG:
            lines.append(
                f"{share:.0%} of the image of {camera.name} saw nothing, and its rays there are "
                f"uncertain by {deg:.2g} deg: let things, or a board, pass there, or do not use it"
            )
    return tuple(lines)


def near_seen(grid: ImageGrid, estimate: Estimate, seen: Observations | None) -> BoolArray:
    """Pixels of the grid (n,) near which their camera saw something; all, where it saw nothing."""
    near = np.ones(len(grid.camera), dtype=bool)
    if seen is None:
        return near
    for index, camera in enumerate(estimate.cameras):
        own, pixels = grid.camera == index, seen.pixels[seen.camera == index]
        if len(pixels):
            away_px, _ = cKDTree(pixels).query(grid.pixels[own])
            near[own] = away_px < NEAR_SEEN * max(camera.size)
    return near


def _variances(grid: ImageGrid, stated: Covariance, near: BoolArray) -> FloatArray:
    """Variance (n,) in px^2 of where the grid's pixels look, the rig turned as suits `near`."""
    settled = without_rotation(grid.by_rotation, grid.by_calibration, near)
    variance: FloatArray = np.einsum("nij,jk,nik->n", settled, stated.matrix, settled)
    return variance


def _rms_deg(camera: Camera, variances: FloatArray) -> float:
    if not len(variances):
        return 0.0
    sigma_px = np.sqrt(max(float(variances.mean()), 0.0))
    return float(np.degrees(sigma_px / float(np.mean(focal_on_axis(camera)))))

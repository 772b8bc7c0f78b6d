"""What a calibration's covariance costs its user: pixels over the image, and depth over range.

Covariances come from the calibration alone unless said otherwise: what does not average out over
more measurements with the same calibration. Units, held parameters and the indices of cameras are
as in `graphs.propagation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera, image_pixels, project, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.image_grid import ImageGrid, image_grid, without_rotation
from graphs.problem import Estimate
from graphs.propagation import cross_covariance, lens_names
from graphs.triangulation import triangulated_covariance

# Odd: the image's centre is one of the pixels. Twice as many change numbers by 4 % on real scans.
SHAPE = (33, 25)  # pixels across and down
FIT_RADIUS = 1 / 6  # of the image's shorter side: the region of mrcal's `projection_diff`
LEAST_SHARE = 0.01  # of the first image: a smaller common view is the edge of two lenses
NEAREST, FARTHEST, RANGES = 0.5, 200.0, 27  # of a depth curve, in baselines: ten a decade

# ---- over the image ------------------------------------------------------------------------

RelativeTo = Literal["camera", "rig"]
Fit = Literal["image", "centre"]


@dataclass(frozen=True)
class ProjectionMap:
    """How far from the truth the calibration may place a fixed point, all over one image."""

    camera: int
    range: float  # of the points from the camera; inf where it does not matter
    across: FloatArray  # (columns,) px
    down: FloatArray  # (rows,) px
    cov_px: FloatArray  # (rows, columns, 2, 2) px^2; NaN where the lens sees nothing

    @property
    def sigma_px(self) -> FloatArray:
        """Sigma (rows, columns) in px in the worst direction, as mrcal reports it."""
        xx, xy, yy = self.cov_px[..., 0, 0], self.cov_px[..., 0, 1], self.cov_px[..., 1, 1]
        largest = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
        return np.sqrt(np.maximum(largest, 0.0))  # an exact zero may round below

    @property
    def centre_px(self) -> float:
        """Sigma at the image's centre; of an even shape, beside it."""
        rows, columns = self.sigma_px.shape
        return float(self.sigma_px[rows // 2, columns // 2])

    @property
    def rms_px(self) -> float:
        """Root mean square of sigma over what the lens sees of the image."""
        return float(np.sqrt(np.nanmean(self.sigma_px**2)))

    @property
    def corner_px(self) -> float:
        """The largest sigma of the image's corners; where the lens sees none, of the image."""
        corners = self.sigma_px[np.ix_([0, -1], [0, -1])]
        return float(np.nanmax(self.sigma_px if np.isnan(corners).all() else corners))


def projection_maps(
    estimate: Estimate,
    covariance: Covariance,
    distance: float = np.inf,
    relative_to: RelativeTo = "camera",
    fit: Fit = "image",
    shape: tuple[int, int] = SHAPE,
) -> tuple[ProjectionMap, ...]:
    """Covariance of where points at `distance` from each camera are seen, of every camera.

    The point is fixed in the camera's surroundings, the calibration errs. Which way the camera
    looks is not part of it: the rotation that fits best is taken out, for every error its own, by
    least squares over pixels (to first order, hence a projection of the derivatives). This is
    the "projection uncertainty" of mrcal (https://mrcal.secretsauce.net/uncertainty.html), which
    knows that rotation from its boards; without any, it is fitted as in mrcal's `projection_diff`.

    relative_to: "camera": each camera alone, from its lens; the range then does not matter.
    "rig": points fixed in the rig's frame, from lenses and cam_from_rig; one rotation, of the
    whole rig about its origin, is fitted to all cameras. Its translation is not: a point's
    distance counts from the rig's own origin.
    fit: where the rotation is fitted. "image": all over, which leaves the least in the mean.
    "centre": within FIT_RADIUS of the image's centre, for those who aim with the centre; then
    what is left is smallest there by choice, and larger in the corners.
    """
    if relative_to == "rig":
        return _maps(estimate, covariance, covariance.names, None, distance, fit, shape)
    maps: list[ProjectionMap] = []
    for index, camera in enumerate(estimate.cameras):
        names = [name for name in lens_names(camera) if name in covariance.names]
        maps += _maps(estimate, covariance, names, [index], np.inf, fit, shape)
    return tuple(maps)


def _maps(
    estimate: Estimate,
    covariance: Covariance,
    names: Sequence[str],
    cameras: Sequence[int] | None,
    distance: float,
    fit: Fit,
    shape: tuple[int, int],
) -> tuple[ProjectionMap, ...]:
    distances = [distance] * len(estimate.cameras)
    grid = image_grid(estimate, names, distances, cameras, shape)
    left = grid.settled if fit == "image" else _settled_at_centre(grid, estimate)
    cov_px = left @ cross_covariance(covariance, names, names) @ left.mT
    maps = []
    for index in range(len(estimate.cameras)) if cameras is None else cameras:
        rows = grid.camera == index
        across, down, _ = image_pixels(estimate.cameras[index].size, shape)
        column = np.abs(grid.pixels[rows, :1] - across).argmin(1)
        row = np.abs(grid.pixels[rows, 1:] - down).argmin(1)
        whole = np.full((len(down), len(across), 2, 2), np.nan)
        whole[row, column] = cov_px[rows]
        maps.append(ProjectionMap(index, distance, across, down, whole))
    return tuple(maps)


def _settled_at_centre(grid: ImageGrid, estimate: Estimate) -> FloatArray:
    """As `grid.settled`, the rotation fitted to the pixels near the centre of each image."""
    centre = np.array([camera.centre for camera in estimate.cameras])[grid.camera]
    radius = FIT_RADIUS * np.array([min(camera.size) for camera in estimate.cameras])[grid.camera]
    near = np.linalg.norm(grid.pixels - centre, axis=1) <= radius
    return without_rotation(grid.by_rotation, grid.by_calibration, near)


# ---- over range ----------------------------------------------------------------------------


@dataclass(frozen=True)
class DepthSigma:
    """How well two cameras know the depth of one point, against its range.

    Depth is the distance from the first camera. The part of the noise averages out over many
    measurements, the part of the calibration does not.
    """

    cameras: tuple[int, int]
    baseline: float
    ranges: FloatArray  # (n,) of the point from the first camera, ascending
    in_view: NDArray[np.bool_]  # (n,) whether both cameras see a point at this range
    sigma_noise: FloatArray  # (n,) NaN where no depth is determined
    sigma_calibration: FloatArray  # (n,)

    @property
    def sigma(self) -> FloatArray:
        """Of both parts together (n,)."""
        return np.hypot(self.sigma_noise, self.sigma_calibration)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Where (n,) a depth is determined: all points in view from the nearest to some range."""
        return np.isfinite(self.sigma)

    @property
    def determined_to(self) -> float | None:
        """The last range with a depth, where farther points in view have none; 0: none has."""
        if not (self.in_view & ~self.determined).any():
            return None
        return float(self.ranges[self.determined].max(initial=0.0))


def pairs(estimate: Estimate) -> list[tuple[int, int]]:
    """All pairs of cameras, as indices."""
    n = len(estimate.cameras)
    return [(first, second) for first in range(n) for second in range(first + 1, n)]


def baseline(estimate: Estimate, pair: tuple[int, int]) -> float:
    """Distance between the centres of two cameras, in the estimate's unit."""
    first, second = (estimate.cam_from_rig[camera].inverse.translation for camera in pair)
    return float(np.linalg.norm(first - second))


def curve_ranges(estimate: Estimate, pair: tuple[int, int]) -> FloatArray:
    """Ranges (RANGES,) evenly spaced in the logarithm, in the estimate's unit.

    From half a baseline, where cameras that face each other meet, to where depths end.
    """
    length = baseline(estimate, pair)
    return np.geomspace(NEAREST * length, FARTHEST * length, RANGES)


def depth_sigma(
    estimate: Estimate,
    covariance: Covariance,
    pair: tuple[int, int],
    ranges: FloatArray,
    sigma_px: float,
) -> DepthSigma:
    """Depth sigma in the middle of two cameras' common view at `ranges`, ascending.

    sigma_px: of one pixel coordinate in either image. From the nearest on, until a depth is less
    than MIN_DEPTH_SIGMAS of its sigmas, where linear propagation ends (`graphs.triangulation`).
    """
    points, in_view = middle_of_view(estimate, pair, ranges)
    pixels = np.stack(
        [project(estimate.cameras[c], estimate.cam_from_rig[c] @ points[in_view]) for c in pair],
        axis=-2,
    )
    sigma_noise, sigma_calibration = np.full((2, len(ranges)), np.nan)
    seen = np.flatnonzero(in_view)
    # That "the nearest `tried` are determined" holds up to some number: all at once, then halves.
    most, fails, tried = 0, len(seen) + 1, len(seen)
    while most < tried:
        try:
            found = triangulated_covariance(estimate, covariance, pair, pixels[:tried], sigma_px)
        except ValueError:
            fails = tried
        else:
            most = tried
            sigma_noise[seen[:most]] = found.sigma_depth_noise
            sigma_calibration[seen[:most]] = found.sigma_depth_calibration
        tried = (most + fails) // 2
    return DepthSigma(
        pair, baseline(estimate, pair), ranges, in_view, sigma_noise, sigma_calibration
    )


def middle_of_view(
    estimate: Estimate, pair: tuple[int, int], ranges: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Points (n, 3) of the rig's frame in the middle of what two cameras see at each range.

    The mean of the rays of the first camera whose point at that range, counted from its centre,
    lies in the image of the second: range by range, because cameras that converge share less of
    what is far. False (n,), and the point NaN, where they share less than LEAST_SHARE.
    """
    first, second = (estimate.cameras[camera] for camera in pair)
    first_from_rig, second_from_rig = (estimate.cam_from_rig[camera] for camera in pair)
    pixels = image_pixels(first.size, SHAPE)[2]
    rays = unproject(first, pixels)
    rays = rays[np.isfinite(rays[:, 0])] @ first_from_rig.rotation
    centre = first_from_rig.inverse.translation
    ahead = centre + ranges[:, None, None] * rays
    common = _in_image(second, project(second, second_from_rig @ ahead))
    mean = common.astype(np.float64) @ rays
    length = np.linalg.norm(mean, axis=1)
    middle = mean / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    points = centre + ranges[:, None] * middle
    in_view = (common.sum(1) >= LEAST_SHARE * len(pixels)) & (length > 0)
    for camera, cam_from_rig in ((first, first_from_rig), (second, second_from_rig)):
        in_view &= _in_image(camera, project(camera, cam_from_rig @ points))
    points[~in_view] = np.nan
    return points, in_view


def _in_image(camera: Camera, pixels: FloatArray) -> NDArray[np.bool_]:
    """Which of the pixels (..., 2) lie in the image; those that are NaN do not."""
    inside = (pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)
    return np.asarray(inside.all(-1))

"""Two calibrations of a rig, pair of cameras by pair: turn, baseline, and depths; and its lenses.

Depths are those that A finds where B is true: points in the common view, seen by B, triangulated
by A. See `graphs.compare` for the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.camera import (
    FIT_GRID,
    carries_over,
    fit_lens,
    image_pixels,
    project,
    project_jacobian,
    unproject,
)
from graphs.compare import Stated
from graphs.frames import FloatArray, Transform, log_rotation
from graphs.lenses import PARAMETER_NAMES, LensName
from graphs.pose_covariance import relative
from graphs.problem import Estimate
from graphs.propagation import lens_names, replaced
from graphs.triangulation import triangulate
from graphs.uncertainty import SHAPE, depth_sigma, middle_of_view

# Rays that meet beyond so many times the range are parallel: they have no depth.
FARTHEST = 1e3
# Without noise of pixels, for what the calibration alone does to a depth; as `depth_sigma` wants.
NO_NOISE_PX = 1e-6

# ---- lenses --------------------------------------------------------------------------------


def holds(lens: LensName, other: LensName) -> bool:
    """Whether a lens can be what another is, parameter by parameter of the same meaning."""
    names = PARAMETER_NAMES[lens], PARAMETER_NAMES[other]
    return lens == other or (carries_over(lens, other) and set(names[1]) <= set(names[0]))


def as_lens(side: Stated, camera: int, lens: LensName) -> tuple[Stated, float]:
    """A calibration with one camera in another lens, the nearest over the image; rms error in px.

    Covariances go along: a small change of the old parameters makes the new lens follow by least
    squares of the picture. A lens that `holds` the old one is it, to rounding.
    """
    old = side.estimate.cameras[camera]
    if old.lens == lens:
        return side, 0.0
    if holds(lens, old.lens):
        known = old.named()
        params = np.array([known.get(name, 0.0) for name in PARAMETER_NAMES[lens]])
        new, error_px = replace(old, lens=lens, params=params), 0.0
        names = PARAMETER_NAMES[lens]
        by_old = np.array([[float(n == o) for o in old.names] for n in names])
    else:
        new, error_px = fit_lens(old, lens)
        rays = unproject(old, image_pixels(old.size, FIT_GRID)[2])
        rays = rays[np.isfinite(rays[:, 0])]
        J_old, J_new = (project_jacobian(c, rays)[2].reshape(2 * len(rays), -1) for c in (old, new))
        scale = np.maximum(np.linalg.norm(J_new, axis=0), np.finfo(np.float64).tiny)
        by_old = np.linalg.lstsq(J_new / scale, J_old)[0] / scale[:, None]
    cameras = tuple(new if i == camera else c for i, c in enumerate(side.estimate.cameras))
    covariance = replaced(side.covariance, lens_names(new), by_old, lens_names(old))
    return Stated(replace(side.estimate, cameras=cameras), covariance), error_px


# ---- how two cameras sit -------------------------------------------------------------------


@dataclass(frozen=True)
class PairPlace:
    """How camera b sits from camera a: in both calibrations, and the difference B less A."""

    b_from_a: tuple[Transform, Transform]  # of A, of B
    change: FloatArray  # (6,) turn (rad, about the axes of camera b) and translation, B less A
    cov: tuple[FloatArray, FloatArray]  # (6, 6) each, of A's and of B's

    @property
    def turn_deg(self) -> float:
        """The angle between the two rotations."""
        return float(np.degrees(np.linalg.norm(self.change[:3])))

    @property
    def sigma_turn_deg(self) -> float:
        """Combined sigma along that turn; of the largest, where there is none."""
        cov = (self.cov[0] + self.cov[1])[:3, :3]
        angle = np.linalg.norm(self.change[:3])
        if angle == 0:
            return float(np.degrees(max(np.linalg.eigvalsh(cov).max(), 0.0) ** 0.5))
        axis = self.change[:3] / angle
        return float(np.degrees(max(float(axis @ cov @ axis), 0.0) ** 0.5))

    @property
    def baselines(self) -> tuple[float, float]:
        """Distance of the two cameras in A and in B."""
        a, b = (float(np.linalg.norm(t.translation)) for t in self.b_from_a)
        return a, b

    @property
    def sigma_baselines(self) -> tuple[float, float]:
        """Their sigmas."""
        found = []
        for place, cov in zip(self.b_from_a, self.cov, strict=True):
            along = place.translation / max(float(np.linalg.norm(place.translation)), 1e-300)
            found.append(max(float(along @ cov[3:, 3:] @ along), 0.0) ** 0.5)
        return found[0], found[1]


def pair_place(a: Stated, b: Stated, pair: tuple[int, int]) -> PairPlace:
    """How the second camera of a pair sits from the first, in A and in B of the same unit."""
    first, second = pair
    places = [
        s.estimate.cam_from_rig[second] @ s.estimate.cam_from_rig[first].inverse for s in (a, b)
    ]
    turn = log_rotation(places[1].rotation @ places[0].rotation.T)
    change = np.concatenate([turn, places[1].translation - places[0].translation])
    covs = [relative(s.covariance, s.estimate, second, first).matrix for s in (a, b)]
    return PairPlace((places[0], places[1]), change, (covs[0], covs[1]))


# ---- depths --------------------------------------------------------------------------------


@dataclass(frozen=True)
class DepthError:
    """Depths by A of what B sees at one range, relative to it: 0.01 is one per cent too far."""

    range: float  # from the first camera
    n_common: int  # pixels of the grid whose point both cameras of B see
    no_depth: float  # share of them whose rays do not meet for A
    median: float  # NaN where there is none
    worst: float  # the largest in size
    middle: float  # in the middle of the common view
    sigma_middle: float  # of both calibrations together; NaN where linear propagation ends


def depth_errors(
    a: Stated, b: Stated, pair: tuple[int, int], ranges: Sequence[float]
) -> tuple[DepthError, ...]:
    """Over the common view of two cameras, at each range. A and B in one unit of length."""
    of_a, of_b = (_middle_sigma(side, pair, np.array(ranges)) for side in (a, b))
    sigma = np.hypot(of_a, of_b)
    middles, in_view = middle_of_view(b.estimate, pair, np.array(ranges))
    found = []
    for index, distance in enumerate(ranges):
        points = _common_points(b.estimate, pair, distance)
        errors = _errors(a.estimate, b.estimate, pair, points) / distance
        met = errors[np.isfinite(errors)]
        middle = np.nan
        if in_view[index]:
            middle = _errors(a.estimate, b.estimate, pair, middles[[index]])[0] / distance
        found.append(
            DepthError(
                distance,
                len(points),
                1.0 - len(met) / len(points) if len(points) else 0.0,
                float(np.median(met)) if met.size else np.nan,
                float(met[np.abs(met).argmax()]) if met.size else np.nan,
                float(middle),
                float(sigma[index]) / distance,
            )
        )
    return tuple(found)


def _middle_sigma(side: Stated, pair: tuple[int, int], ranges: FloatArray) -> FloatArray:
    if not side.covariance.names:
        return np.zeros(len(ranges))
    order = np.argsort(ranges)
    found = depth_sigma(side.estimate, side.covariance, pair, ranges[order], NO_NOISE_PX)
    sigma = np.empty(len(ranges))
    sigma[order] = found.sigma_calibration
    return sigma


def _common_points(estimate: Estimate, pair: tuple[int, int], distance: float) -> FloatArray:
    """Points (n, 3) of the rig at a distance from the first camera that both see."""
    first, second = pair
    rays = unproject(estimate.cameras[first], image_pixels(estimate.cameras[first].size, SHAPE)[2])
    ahead = distance * rays[np.isfinite(rays[:, 0])]
    points = estimate.cam_from_rig[first].inverse @ ahead
    seen = project(estimate.cameras[second], estimate.cam_from_rig[second] @ points)
    inside = (seen > -0.5) & (seen < np.array(estimate.cameras[second].size) - 0.5)
    return points[np.asarray(inside.all(-1))]


def _errors(a: Estimate, b: Estimate, pair: tuple[int, int], points: FloatArray) -> FloatArray:
    """Distances (n,) by A from the first camera of points (n, 3) of B, less B's; NaN: none."""
    errors = np.full(len(points), np.nan)
    if not len(points):
        return errors
    pixels = np.stack([project(b.cameras[c], b.cam_from_rig[c] @ points) for c in pair], axis=-2)
    meet = _meet(a, pair, pixels, float(np.linalg.norm(points[0] - _centre(b, pair[0]))))
    if meet.any():
        places = _places(a, pair, pixels[meet])
        by_a = np.linalg.norm(places - _centre(a, pair[0]), axis=1)
        by_b = np.linalg.norm(points[meet] - _centre(b, pair[0]), axis=1)
        errors[meet] = by_a - by_b
    return errors


def _places(a: Estimate, pair: tuple[int, int], pixels: FloatArray) -> FloatArray:
    """Points (n, 3) of pixels (n, 2, 2); NaN where least squares of the pixels finds none."""
    try:
        return triangulate(a, pair, pixels, 1.0)
    except ValueError:
        if len(pixels) == 1:
            return np.full((1, 3), np.nan)
    # One refuses them all: which it is, by halves.
    half = len(pixels) // 2
    return np.concatenate([_places(a, pair, part) for part in (pixels[:half], pixels[half:])])


def _centre(estimate: Estimate, camera: int) -> FloatArray:
    return estimate.cam_from_rig[camera].inverse.translation


def _meet(
    a: Estimate, pair: tuple[int, int], pixels: FloatArray, distance: float
) -> NDArray[np.bool_]:
    """Whether (n,) the rays of pixels (n, 2, 2) come nearest ahead of both cameras, and not at
    FARTHEST."""
    first, second = (
        unproject(a.cameras[c], pixels[:, i]) @ a.cam_from_rig[c].rotation
        for i, c in enumerate(pair)
    )
    apart = _centre(a, pair[1]) - _centre(a, pair[0])
    cosine = (first * second).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        sine2 = 1 - cosine**2
        along_first = (first @ apart - cosine * (second @ apart)) / sine2
        along_second = (cosine * (first @ apart) - second @ apart) / sine2
    nearest = np.minimum(along_first, along_second)
    return np.asarray((nearest > 0) & (along_first < FARTHEST * distance))

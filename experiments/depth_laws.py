"""What textbooks say of an error of pixels or calibration in space, and a Monte Carlo of each.

Cameras side by side, b apart; x = X / Z from midway between them, h = b / 2 Z: the cameras see a
point at x + h and x - h. An error of disparity of the ray dx moves a point by dZ = Z^2 / b dx.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from experiments.stereo import PAIR, RADIAL, LensShape, as_estimate, parallel_pair, seen_by_both
from graphs.camera import unproject
from graphs.compare import Stated
from graphs.compare_chance import changed
from graphs.covariance import NOTHING, Covariance
from graphs.frames import FloatArray
from graphs.problem import Estimate
from graphs.propagation import cross_covariance, lens_names, ray_jacobian
from graphs.triangulation import triangulate, triangulated_covariance

Effect = Literal[
    "pixels", "baseline", "rotation", "focal", "focal apart",
    "distortion", "distortion apart", "distortion shared",
]  # fmt: skip
EFFECTS: tuple[Effect, ...] = get_args(Effect)

# What errs, by one sigma: about what a short scan leaves, and small enough for first order.
FOCAL = 0.002  # of the focal length
K1 = 0.0005
BASELINE = 0.001  # of the baseline
ROTATION_DEG = 0.02

DEPTHS_M = np.geomspace(1.0, 8.0, 8)
RADII = np.geomspace(0.2, 0.7, 8)  # x, of the lens without distortion
RADIUS_OF_DEPTHS = 0.4  # x of the points that tell an error of one lens alone over depth
DEPTH_OF_RADII_M = 8.0


@dataclass(frozen=True)
class Pair:
    """The rig of a law."""

    focal_px: float
    baseline_m: float
    shape: LensShape
    sigma_px: float

    @property
    def estimate(self) -> Estimate:
        return as_estimate(parallel_pair(self.focal_px, self.baseline_m, self.shape))

    def undistorted(self, x: FloatArray) -> FloatArray:
        """How much farther from the axis a ray is than its pixel, by derivative, at x."""
        k1, k2 = RADIAL[self.shape]
        slope: FloatArray = 1 / (1 + 3 * k1 * x**2 + 5 * k2 * x**4)
        return slope


# Depth Z, x, h of the points, and the rig -> sigma in m.
ClosedForm = Callable[[FloatArray, FloatArray, FloatArray, Pair], FloatArray]


@dataclass(frozen=True)
class Law:
    """How an error shows in space: of depth by two cameras, or sideways by one at known depth."""

    said: str
    exponent: float
    over: Literal["depth", "radius"]
    errs: tuple[tuple[str, ...], ...]  # parameters that err as one, group by group
    closed: ClosedForm
    sideways: bool = False
    off_axis: bool = False


def _cubic(x: FloatArray, pair: Pair) -> FloatArray:
    return K1 * x**3 * pair.undistorted(x)


LAWS: dict[Effect, Law] = {
    "pixels": Law(
        "sigma_Z = Z^2 / (f b) sigma_d, sigma_d = sqrt(2) sigma_px", 2, "depth", (),
        lambda z, x, h, p: z**2 / (p.focal_px * p.baseline_m) * 2**0.5 * p.sigma_px,
    ),
    "baseline": Law(
        "dZ = Z db / b", 1, "depth", (("cam1.translation_x",),), lambda z, x, h, p: z * BASELINE
    ),
    "rotation": Law(
        "dZ = Z^2 / b da: a turn of one camera against the other", 2, "depth",
        (("cam1.rotation_y",),),
        lambda z, x, h, p: z**2 / p.baseline_m * np.radians(ROTATION_DEG),
    ),
    "focal": Law(
        "dZ = Z df / f: both cameras err alike", 1, "depth",
        (("cam0.fx", "cam0.fy", "cam1.fx", "cam1.fy"),), lambda z, x, h, p: z * FOCAL,
    ),
    "focal apart": Law(
        "dZ = Z^2 / b x df / f: each camera errs alone, off the axis", 2, "depth",
        (("cam0.fx", "cam0.fy"), ("cam1.fx", "cam1.fy")),
        lambda z, x, h, p: z**2 / p.baseline_m * FOCAL * np.hypot(x + h, x - h), off_axis=True,
    ),
    "distortion": Law(
        "dX = Z r^3 dk1: sideways, of one camera", 3, "radius", (("cam0.k1",),),
        lambda z, x, h, p: z * _cubic(x, p), sideways=True,
    ),
    "distortion apart": Law(
        "dZ = Z^2 / b r^3 dk1: each camera errs alone", 3, "radius", (("cam0.k1",), ("cam1.k1",)),
        lambda z, x, h, p: z**2 / p.baseline_m * np.hypot(_cubic(x + h, p), _cubic(x - h, p)),
    ),
    "distortion shared": Law(
        "dZ = 3 Z r^2 dk1: both cameras err alike", 2, "radius", (("cam0.k1", "cam1.k1"),),
        lambda z, x, h, p: z**2 / p.baseline_m * (_cubic(x + h, p) - _cubic(x - h, p)),
    ),
}  # fmt: skip


def directions(law: Law, pair: Pair) -> tuple[tuple[str, ...], FloatArray]:
    """Names (n,) of what errs, and one sigma of each independent error (n_groups, n)."""
    sigma = {
        "fx": FOCAL * pair.focal_px,
        "fy": FOCAL * pair.focal_px,
        "k1": K1,
        "translation_x": BASELINE * pair.baseline_m,
        "rotation_y": np.radians(ROTATION_DEG),
    }
    names = tuple(name for group in law.errs for name in group)
    rows = [[sigma[n.split(".")[1]] if n in group else 0.0 for n in names] for group in law.errs]
    return names, np.array(rows).reshape(len(law.errs), len(names))


@dataclass(frozen=True)
class Errors:
    """How far off points are, against what varies from one to the next."""

    at: FloatArray  # (n,) depths in m, or radii
    rms_m: FloatArray  # (n,) about the truth, of all draws
    bias_m: FloatArray  # (n,) their mean
    propagated_m: FloatArray  # (n,) sigma by our propagation
    closed_m: FloatArray  # (n,) sigma by the textbook


def errors(effect: Effect, pair: Pair, draws: int, rng: np.random.Generator) -> Errors:
    """Draw the errors of an effect, and measure points with each."""
    law, true = LAWS[effect], pair.estimate
    at = DEPTHS_M if law.over == "depth" else RADII
    z, x = np.broadcast_arrays(at, 0.0) if law.over == "depth" else (DEPTH_OF_RADII_M, at)
    if law.off_axis:
        x = np.full(len(at), RADIUS_OF_DEPTHS)
    z = np.broadcast_to(z, at.shape)
    middle = 0.0 if law.sideways else pair.baseline_m / 2
    points = np.column_stack([middle + x * z, np.zeros(len(at)), z])
    pixels = seen_by_both(true, points)
    names, one_sigma = directions(law, pair)
    covariance = Covariance(names, one_sigma.T @ one_sigma) if names else NOTHING
    drawn = rng.standard_normal((draws, len(one_sigma))) @ one_sigma
    if law.sideways:
        found = np.array([_sideways(changed(true, names, d), pixels, z) for d in drawn])
        off, propagated = found - points[:, 0], _sigma_sideways(Stated(true, covariance), pixels, z)
    elif names:
        every = [triangulate(changed(true, names, d), PAIR, pixels, pair.sigma_px) for d in drawn]
        off = np.array(every)[..., 2] - z
        spread = triangulated_covariance(true, covariance, PAIR, pixels, pair.sigma_px)
        propagated = np.sqrt(spread.cov_calibration[:, 2, 2])
    else:
        noise = pair.sigma_px * rng.standard_normal((draws, *pixels.shape))
        off = triangulate(true, PAIR, pixels + noise, pair.sigma_px)[..., 2] - z
        spread = triangulated_covariance(true, covariance, PAIR, pixels, pair.sigma_px)
        propagated = np.sqrt(spread.cov_noise[:, 2, 2])
    closed = law.closed(z, x, pair.baseline_m / 2 / z, pair)
    return Errors(at, np.sqrt((off**2).mean(0)), off.mean(0), propagated, closed)


def _sideways(estimate: Estimate, pixels: FloatArray, depth_m: FloatArray) -> FloatArray:
    """X (n,) at a known depth of what the first camera sees at pixels (n, 2, 2)."""
    rays = unproject(estimate.cameras[0], pixels[:, 0])
    across: FloatArray = depth_m * rays[:, 0] / rays[:, 2]
    return across


def _sigma_sideways(stated: Stated, pixels: FloatArray, depth_m: FloatArray) -> FloatArray:
    """Sigma (n,) of `_sideways`, by our propagation."""
    camera = stated.estimate.cameras[0]
    rays, by_lens = ray_jacobian(camera, pixels[:, 0])
    x, z = rays[:, 0], rays[:, 2]
    by = depth_m[:, None] * (by_lens[:, 0] / z[:, None] - (x / z**2)[:, None] * by_lens[:, 2])
    names = lens_names(camera)
    variance = ((by @ cross_covariance(stated.covariance, names, names)) * by).sum(1)
    return np.sqrt(np.maximum(variance, 0.0))


def exponent(at: FloatArray, size: FloatArray) -> float:
    """Slope of a straight line through the logarithms."""
    return float(np.polyfit(np.log(at), np.log(size), 1)[0])

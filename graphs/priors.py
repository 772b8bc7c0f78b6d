"""Soft knowledge: weak, visible beliefs about lenses and rigs, stated in the result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera, nominal_params
from graphs.frames import FloatArray, Transform

# Real lenses sit a few per cent of the width off the image centre (corridor webcam: 6 %).
# A free principal point drifts by 39 px on forward motion; 3 % of the width holds it.
PRINCIPAL_POINT_SIGMA = 0.03  # of the image width
FOCAL_SIGMA = 1.0  # of the focal length: no knowledge
ASPECT_SIGMA = 0.005  # of fy / fx about 1: pixels are square to a fraction of a per cent
# Square exactly: 1e-4 px of a focal length of 1000. Below it the focal length's own information,
# 1e14 times less, is lost in rounding.
SQUARE_SIGMA = 1e-7
# Radial terms of any lens at a radius of one, where they would double or undo the radius. A real
# k4 to k6 can be larger, but only with k1 to k3 as large, which cancel them: N / D with small ones
# does as well. Tangential and prism terms are elements out of place, p2 = 0.003 in webcams; they
# look like the principal point, which wanders off by 13 px where they are free. EuRoC's and TUM
# VI's lenses have alpha 0.57 to 0.63, beta 1.04 to 1.13, xi -0.17 to -0.24: well within a sigma.
DISTORTION_SIGMA = {
    **dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6"), 1.0),
    **dict.fromkeys(("p1", "p2", "s1", "s2", "s3", "s4"), 1e-3),
    **dict.fromkeys(("alpha", "beta", "xi"), 0.5),
}
# Where a board is seen, which tells p1, p2 from the principal point: they need no such hold, and
# webcams have p2 = 0.0036.
TANGENTIAL_SIGMA_WITH_BOARD = 1e-2
PINNED_SIGMA = 1e-9  # a parameter that is held fixed


@dataclass(frozen=True)
class LensPrior:
    """Independent beliefs in each lens parameter, and one in fy / fx being as in the mean."""

    mean: FloatArray  # (n_params,)
    sigma: FloatArray  # (n_params,)
    aspect_sigma: float = np.inf

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which parameters are not held fixed (n_params,)."""
        return self.sigma > PINNED_SIGMA

    def held(self, params: FloatArray) -> FloatArray:
        """Parameters (n_params,) with those that are held fixed exactly at their values."""
        return np.where(self.free, params, self.mean)

    def information(self) -> FloatArray:
        """Information matrix (n_params, n_params) at the mean, the aspect term included."""
        information = np.diag(self.sigma**-2.0)
        if np.isfinite(self.aspect_sigma):
            # fy - a fx = 0 within aspect_sigma * f, a of the mean: 1 unless a lens is known
            a = self.mean[1] / self.mean[0]
            sigma_px = max(self.aspect_sigma, SQUARE_SIGMA) * self.mean[0]
            information[:2, :2] += np.array([[a * a, -a], [-a, 1.0]]) / sigma_px**2
        return information


@dataclass(frozen=True)
class RigPrior:
    """A belief in where a camera sits: its turn about its own axes, and its centre in the rig."""

    cam_from_rig: Transform
    sigma_rotation: float  # rad, each axis
    sigma_translation: float  # of the centre, units of the rig, each axis


def weak_lens_prior(
    camera: Camera,
    principal_point_sigma: float = PRINCIPAL_POINT_SIGMA,
    aspect_sigma: float = ASPECT_SIGMA,
    with_board: bool = False,
) -> LensPrior:
    """What is believed of any lens before its first image, centred on an ideal one.

    with_board: a board is seen, which is enough to know p1, p2.
    """
    distortion = dict(DISTORTION_SIGMA)
    if with_board:
        distortion |= dict.fromkeys(("p1", "p2"), TANGENTIAL_SIGMA_WITH_BOARD)
    width, focal = camera.size[0], float(camera.params[:2].mean())
    mean = nominal_params(camera.lens, camera.size, focal)
    mean[:2] = focal
    sigma = np.array(
        [FOCAL_SIGMA * focal] * 2
        + [principal_point_sigma * width] * 2
        + [distortion[name] for name in camera.names[4:]]
    )
    return LensPrior(mean, sigma, aspect_sigma)


def stated_lens_prior(
    camera: Camera,
    weak: LensPrior,
    mean: dict[str, float],
    sigma: dict[str, float],
    fixed: Sequence[str],
) -> LensPrior:
    """`weak` with the given means and sigmas in place of its own; `fixed` are held.

    A stated or held focal length replaces the belief in square pixels.
    """
    centre, spread = weak.mean.copy(), weak.sigma.copy()
    for index, name in enumerate(camera.names):
        centre[index] = mean.get(name, centre[index])
        spread[index] = PINNED_SIGMA if name in fixed else sigma.get(name, spread[index])
    stated = {"fx", "fy"} & (set(mean) | set(fixed))
    return LensPrior(centre, spread, np.inf if stated else weak.aspect_sigma)

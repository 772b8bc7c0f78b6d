"""Discs in an image, fitted as ellipses with a blurred edge.

grey = mean + slope . x + contrast * erf(d / s), with d the distance from the ellipse, positive
inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from graphs.frames import FloatArray
from sfm_calib.boards import fit

GrayImage = NDArray[np.uint8]

FIRST_BLUR_PX = 0.7  # as for saddles
SMALLEST_PX = 1.2  # radius: a smaller disc is a dot whose blur cannot be told from its size
TWO_BY_ROOT_PI = float(2 / np.sqrt(np.pi))
LEAST_CONTRAST = 4.0  # grey levels between black and white, halved


@dataclass(frozen=True)
class Discs:
    """Fitted ellipses."""

    pixels: FloatArray  # (n, 2) centres
    sigma_px: FloatArray  # (n,) along the worst direction
    radius_px: FloatArray  # (n,) of the circle of the same area
    good: NDArray[np.bool_]  # (n,) whether there is a dark disc near the start


def fit_discs(
    image: GrayImage, pixels: FloatArray, maps: FloatArray, reach: float, radius: float
) -> Discs:
    """Fit the images of dark circles near `pixels` (n, 2).

    `maps` (n, 2, 2) holds the derivatives of pixels by places on the board; circles have about
    `radius` and nothing else is nearer than `reach`, both in the unit of these places.
    """
    limits = np.maximum(reach * np.linalg.norm(maps, -2, axis=(1, 2)), 2 * SMALLEST_PX)
    shape = np.linalg.inv(maps) / radius  # (n, 2, 2) takes the ellipse to a unit circle
    metric = np.linalg.cholesky(shape.transpose(0, 2, 1) @ shape)  # lower, (n, 2, 2)
    start = np.zeros((len(pixels), 10))
    start[:, 2:5] = np.stack([metric[:, 0, 0], metric[:, 1, 0], metric[:, 1, 1]], axis=1)
    start[:, 5] = np.log(FIRST_BLUR_PX)
    windows, fits, found = fit.fit_centres(_model, 6, image, pixels, limits, start)
    good = found & (fits.parameters[:, 6] < -LEAST_CONTRAST)
    good &= fit.is_explained(windows, fits)
    centres = windows.middle + fits.parameters[:, :2]
    radius_px = np.abs(fits.parameters[:, 2] * fits.parameters[:, 4]) ** -0.5
    sigma_px = fit.centre_sigmas(fits, windows, good)
    return Discs(centres, sigma_px, radius_px, good & (sigma_px < fit.MOST_SIGMA_PX))


def _model(parameters: fit.Values, offsets: fit.Values) -> tuple[fit.Values, fit.Values]:
    """Grey levels (n, p) and their Jacobian (n, p, 10) by the centre, a, b and c, the log of the
    blur, the contrast, the mean and the slope.

    With w = L'x of the lower triangle L = [[a, 0], [b, c]], the ellipse is |w| = 1, and its
    distance about (1 - |w|) |w| / |L w|.
    """
    x, y = np.moveaxis(offsets[None] - parameters[:, None, :2], -1, 0)
    a, b, c = (parameters[:, k, None] for k in (2, 3, 4))
    w0, w1 = a * x + b * y, c * y
    norm = np.sqrt(w0**2 + w1**2) + 1e-9
    g0, g1 = a * w0, b * w0 + c * w1  # L w
    slope = np.sqrt(g0**2 + g1**2) + 1e-9
    distance = (1 - norm) * norm / slope
    width, narrowing = fit.blur_width(parameters[:, 5, None])
    ratio = distance / width
    side = erf(ratio)
    bell = parameters[:, 6, None] * TWO_BY_ROOT_PI * np.exp(-(ratio**2)) / width
    # d distance = (1 - 2 norm) / slope dnorm - distance / slope dslope
    by_norm, by_slope = (1 - 2 * norm) / slope, -distance / slope

    def along(*changes: fit.Values) -> fit.Values:
        d_w0, d_w1, d_g0, d_g1 = changes
        d_norm = (w0 * d_w0 + w1 * d_w1) / norm
        d_slope = (g0 * d_g0 + g1 * d_g1) / slope
        return np.asarray(bell * (by_norm * d_norm + by_slope * d_slope))

    zero = 0 * x
    jacobian = np.empty((*x.shape, 10), parameters.dtype)
    jacobian[..., 0] = along(-a + zero, zero, -a * a + zero, -a * b + zero)
    jacobian[..., 1] = along(-b + zero, -c + zero, -a * b + zero, -b * b - c * c + zero)
    jacobian[..., 2] = along(x, zero, w0 + a * x, b * x)
    jacobian[..., 3] = along(y, zero, a * y, w0 + b * y)
    jacobian[..., 4] = along(zero, y, zero, w1 + c * y)
    jacobian[..., 5] = -narrowing * bell * distance
    jacobian[..., 6] = side
    jacobian[..., 7] = 1
    jacobian[..., 8:] = offsets
    values = parameters[:, 6, None] * side + parameters[:, 7, None]
    return values + parameters[:, 8:] @ offsets.T, jacobian

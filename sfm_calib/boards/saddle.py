"""Corners where black and white meet crosswise, fitted to the image's grey levels.

Two edges cross in a corner: grey = mean + slope . x + contrast * erf(u / s) erf(v / s), where u and
v are the distances from the two edges and s is the width of the blur. The picture looks the same
turned by half a turn about the corner, so that no symmetric blur moves it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from graphs.frames import FloatArray
from sfm_calib.boards import fit

GrayImage = NDArray[np.uint8]

NARROWEST_PX, WIDEST_PX = 2.2, 10.0  # radius of the window: fewer pixels say too little
FIRST_BLUR_PX = 0.7  # sigma; a pixel's own area makes 0.3, lenses and demosaicing the rest
TWO_BY_ROOT_PI = float(2 / np.sqrt(np.pi))
LEAST_CONTRAST = 4.0  # grey levels between black and white, halved


@dataclass(frozen=True)
class Saddles:
    """Fitted corners."""

    pixels: FloatArray  # (n, 2)
    sigma_px: FloatArray  # (n,) along the worst direction
    contrast: FloatArray  # (n,) positive where the sector between the edges' directions is bright
    good: NDArray[np.bool_]  # (n,) whether there is such a corner near the start


def fit_saddles(image: GrayImage, pixels: FloatArray, maps: FloatArray, clear: float) -> Saddles:
    """Fit corners near `pixels` (n, 2), whose edges run along the two axes of the board.

    `maps` (n, 2, 2) holds the derivatives of pixels by places on the board, `clear` says how far
    around a corner the board shows nothing else, in the unit of these places.
    """
    # The least singular value: how many pixels `clear` has along its shortest direction.
    radii = np.clip(clear * np.linalg.norm(maps, -2, axis=(1, 2)), NARROWEST_PX, WIDEST_PX)
    angles = np.arctan2(maps[:, 1], maps[:, 0])  # (n, 2) of the two edges
    start = np.zeros((len(pixels), 9))
    start[:, 2:4], start[:, 4] = angles, np.log(FIRST_BLUR_PX)
    windows, fits, found = fit.fit_centres(_model, 5, image, pixels, radii, start)
    contrast = fits.parameters[:, 5]
    good = found & (np.abs(contrast) > LEAST_CONTRAST)
    good &= fit.is_explained(windows, fits)
    centres = windows.middle + fits.parameters[:, :2]
    sigma_px = fit.centre_sigmas(fits, windows, good)
    return Saddles(centres, sigma_px, contrast, good & (sigma_px < fit.MOST_SIGMA_PX))


def _model(parameters: fit.Values, offsets: fit.Values) -> tuple[fit.Values, fit.Values]:
    """Grey levels (n, p) and their Jacobian (n, p, 9) by the centre, the angles of the edges, the
    log of the blur, the contrast, the mean and the slope."""
    place = offsets[None] - parameters[:, None, :2]  # (n, p, 2)
    width, narrowing = fit.blur_width(parameters[:, 4, None])
    contrast = parameters[:, 5, None]
    sides, bells, across, along = [], [], [], []
    for edge in (2, 3):
        cos, sin = np.cos(parameters[:, edge, None]), np.sin(parameters[:, edge, None])
        across.append(place[..., 1] * cos - place[..., 0] * sin)
        along.append(place[..., 0] * cos + place[..., 1] * sin)
        ratio = across[-1] / width
        sides.append(erf(ratio))
        bells.append(TWO_BY_ROOT_PI * np.exp(-(ratio**2)) / width)
    jacobian = np.empty((*across[0].shape, 9), parameters.dtype)
    per_edge = (contrast * bells[0] * sides[1], contrast * bells[1] * sides[0])
    jacobian[..., 0] = 0
    jacobian[..., 1] = 0
    for edge in (0, 1):
        cos, sin = np.cos(parameters[:, 2 + edge, None]), np.sin(parameters[:, 2 + edge, None])
        jacobian[..., 0] += per_edge[edge] * sin
        jacobian[..., 1] -= per_edge[edge] * cos
        jacobian[..., 2 + edge] = -per_edge[edge] * along[edge]
    jacobian[..., 4] = -narrowing * (per_edge[0] * across[0] + per_edge[1] * across[1])
    jacobian[..., 5] = sides[0] * sides[1]
    jacobian[..., 6] = 1
    jacobian[..., 7:] = offsets
    values = contrast * jacobian[..., 5] + parameters[:, 6, None]
    values = values + parameters[:, 7:] @ offsets.T
    return values, jacobian

"""What lenses of any model have in common: focal length, centre, and what they do to a corner.

Coefficients of one model mean nothing in another, and trade against each other within one. These
numbers do neither, so they can be followed over years.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphs.camera import Camera, focal_on_axis, unproject
from graphs.frames import FloatArray

# px per radian on the axis, in the mean and across and down; px; and px by which distortion moves
# the image's corners off where a lens without any has them: outwards in the mean of the four, and
# all four alike.
SHAPE_NAMES = ("focal", "focal_x", "focal_y", "cx", "cy", "corner", "corner_x", "corner_y")
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
STEP = 1e-5  # of central differences: relative, of coefficients and angles of order one


def lens_shape(camera: Camera, wide: bool) -> tuple[FloatArray, FloatArray]:
    """SHAPE_NAMES of a lens (8,), and their derivatives (8, n) by its parameters.

    wide: a lens without distortion is equidistant (r = f angle), rather than a pinhole. Corners
    are taken as far from the principal point as the image's are from its centre: what they say
    is of the distortion alone. NaN where the lens sees no such corner.
    """
    values, by_params = _shape(camera, wide), np.empty((len(SHAPE_NAMES), camera.params.size))
    for index, value in enumerate(camera.params):
        step = STEP * max(abs(float(value)), 1.0)
        ends = []
        for sign in (1, -1):
            params = camera.params.copy()
            params[index] += sign * step
            ends.append(_shape(replace(camera, params=params), wide))
        by_params[:, index] = (ends[0] - ends[1]) / (2 * step)
    return values, by_params


def _shape(camera: Camera, wide: bool) -> FloatArray:
    focal, centre = focal_on_axis(camera), camera.params[2:4]
    off = CORNERS * camera.centre
    rays = unproject(camera, centre + off)
    across = np.linalg.norm(rays[:, :2], axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        if wide:
            ideal = focal * rays[:, :2] / across * np.arctan2(across, rays[:, 2:])
        else:
            ideal = np.where(rays[:, 2:] > 0, focal * rays[:, :2] / rays[:, 2:], np.nan)
        moved = off - ideal
        outwards = (moved * off).sum(1) / np.linalg.norm(off, axis=1)
    return np.array([focal.mean(), *focal, *centre, outwards.mean(), *moved.mean(0)])

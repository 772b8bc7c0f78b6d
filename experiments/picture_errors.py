"""How far off a calibration is, in pixels over the picture: the one measure for all its lenses.

Of points far away, and once the rotation is undone that explains most: a camera that turned a
little is no worse for it.
"""

from __future__ import annotations

import numpy as np

from graphs.camera import Camera
from graphs.compare import Frames, difference
from graphs.covariance import Covariance
from graphs.frames import Transform
from graphs.image_grid import image_grid
from graphs.problem import Estimate

ACROSS, DOWN = 17, 13  # pixels looked at


def off_px(truth: Camera, found: Camera) -> float:
    """RMS of the distances between where two lenses see the same, over the picture; NaN: nowhere.

    Parts of the picture that one of them does not know are left out.
    """
    frames = Frames(((0,),), (np.inf,), translation=False, scale=False)
    apart = difference(alone(truth), alone(found), frames)
    moved = apart.over_image(0, np.inf, (ACROSS, DOWN))[2]
    squares = (moved**2).sum(-1)
    known = np.isfinite(squares)
    return float(np.sqrt(squares[known].mean())) if known.any() else float("nan")


def stated_px(found: Camera, covariance: Covariance) -> float:
    """The same as a covariance of its lens lets one expect, to first order."""
    grid = image_grid(alone(found), covariance.names, [np.inf], shape=(ACROSS, DOWN))
    moved = grid.settled
    return float(np.sqrt(np.einsum("nki,ij,nkj->n", moved, covariance.matrix, moved).mean()))


def alone(camera: Camera) -> Estimate:
    """A camera that is its own rig."""
    return Estimate((camera,), (Transform.identity(),), (), np.zeros((0, 3)))

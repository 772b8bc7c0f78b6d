"""Covariances that are weak along chosen directions, for tests of observability by hand."""

from __future__ import annotations

import numpy as np

from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.image_grid import image_grid
from graphs.lenses import LensName
from graphs.motion import Views
from graphs.observability import WeakDirection, own_px, weak_directions
from graphs.problem import Estimate
from graphs.propagation import lens_names, pose_names
from synthetic.problems import small_problem

DISTANCE = 5.0
GOOD = Views(
    parallax_deg=30.0,
    turn_deg=60.0,
    axes_deg=30.0,
    roll_deg=20.0,
    turn_axis=(0.0, 1.0, 0.0),
    turn_share=0.5,
    motion_axis=(1.0, 0.0, 0.0),
    motion_share=0.5,
    forward=0.2,
    spread=(0.3, 0.2, 0.1),
    distance=DISTANCE,
    relief=0.3,
    tilt_deg=60.0,
)


def rig(cameras: int = 2, lens: LensName = "radtan") -> Estimate:
    return small_problem(lens, cameras=cameras)[1]


def names_of(estimate: Estimate) -> tuple[str, ...]:
    lenses = [name for camera in estimate.cameras for name in lens_names(camera)]
    poses = [name for camera in estimate.cameras[1:] for name in pose_names(camera.name)]
    return (*lenses, *poses)


def of_directions(
    estimate: Estimate, *directions: dict[str, float], floor_px: float = 0.01
) -> Covariance:
    """One sigma along each direction in own px, and a little of everything."""
    names = names_of(estimate)
    own = own_px(image_grid(estimate, names, (DISTANCE,) * len(estimate.cameras)))
    moves = np.array([[move.get(name, 0.0) for name in names] for move in directions])
    scaled = moves.reshape(-1, len(names)).T @ moves.reshape(-1, len(names))
    scaled += floor_px**2 * np.eye(len(names))
    return Covariance(names, scaled / np.outer(own, own))


def found(
    estimate: Estimate,
    stated: Covariance,
    views: Views | None = None,
    prior: FloatArray | None = None,
    model: Covariance | None = None,
) -> tuple[WeakDirection, ...]:
    n = len(estimate.cameras)
    return weak_directions(
        estimate,
        stated,
        stated if model is None else model,
        np.zeros_like(stated.matrix) if prior is None else prior,
        (DISTANCE,) * n,
        () if views is None else (views,) * n,
    )

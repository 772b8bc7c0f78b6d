"""Small scans by one camera whose motion goes from good to degenerate by one number.

Each is degenerate in the limit of a scale of 0 (Sturm, CVPR 1997; Hartley and Zisserman, Multiple
View Geometry, 2003, chapters 10 and 19). panorama: the camera only turns, and no point has a
distance. forward: it only moves, along its axis, and without distortion any lens explains it.
facing: it sees a plane squarely from one distance, and lens and place cannot be told apart.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from graphs.camera import Camera, project
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.problem import Estimate, Observations, Problem, joined
from graphs.selection import MIN_TRACK_LENGTH, compact

MotionName = Literal["panorama", "forward", "facing"]

TURN_DEG, SHIFT_M = 15.0, 1.0  # of a frame about and along each axis, at most
DISTANCE_M, RELIEF_M = 5.0, 1.5  # of the points, and how far they stand before it and behind
WIDTH = 0.5  # of what the points fill to each side, of their distance


def degenerate_scan(
    motion: MotionName,
    scale: float,
    camera: Camera,
    frames: int,
    points: int,
    sigma_px: float,
    rng: np.random.Generator,
) -> Problem:
    """A scan that starts at its truth; scale: of what is lost in the limit, 1 for a good scan.

    Raises ValueError when no point is in sight often enough.
    """
    turn = np.deg2rad(TURN_DEG) * rng.uniform(-1, 1, (frames, 3))
    centre = SHIFT_M * rng.uniform(-1, 1, (frames, 3))
    placed = rng.uniform(-1, 1, (points, 3))
    placed[:, :2] *= WIDTH * DISTANCE_M
    # The points' middle is the world's: what little is left of relief is not rounded away.
    placed[:, 2] *= RELIEF_M
    if motion == "panorama":
        centre *= scale
    elif motion == "forward":
        turn *= scale
        centre[:, :2] *= scale
    else:  # what is left of it grows with the product of two of these
        turn *= scale**0.5
        centre[:, 2] *= scale**0.5
        placed[:, 2] *= scale**0.5
    rig_from_world = tuple(_placed(t, c) for t, c in zip(turn, centre, strict=True))
    start = Estimate((camera,), (Transform.identity(),), rig_from_world, placed)
    names = tuple(f"{index:06d}" for index in range(frames))
    seen = _seen(start, sigma_px, rng)
    return compact(Problem(start, seen, names), seen)


def _placed(turn: FloatArray, centre: FloatArray) -> Transform:
    """rig_from_world of a frame, from its turn (3,) in rad and its place (3,) about the usual."""
    world_from_rig = Transform(exp_rotation(turn), centre - [0.0, 0.0, DISTANCE_M])
    return world_from_rig.inverse


def _seen(start: Estimate, sigma_px: float, rng: np.random.Generator) -> Observations:
    """Noisy pixels of all that is in sight, of points that are so often enough."""
    camera, parts = start.cameras[0], []
    for index, rig_from_world in enumerate(start.rig_from_world):
        pixels = project(camera, rig_from_world @ start.points)
        with np.errstate(invalid="ignore"):
            point = np.flatnonzero(
                (pixels >= 0).all(1) & (pixels <= np.array(camera.size) - 1).all(1)
            )
        noise = sigma_px * rng.standard_normal(pixels.shape)
        same = np.zeros(len(point), np.int64)
        parts.append(Observations((pixels + noise)[point], same + index, same, point))
    whole = joined(parts)
    often = np.bincount(whole.point, minlength=len(start.points)) >= MIN_TRACK_LENGTH
    if not often.any():
        raise ValueError(f"no point is in sight {MIN_TRACK_LENGTH} times: give more frames")
    return whole.subset(often[whole.point])

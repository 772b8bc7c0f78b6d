"""Named rigs and trajectories with known truth, for rendered and for track-level simulations.

Trajectories keep a constant motion per frame, so that a longer scan sees more instead of
smoother; they circle the pedestal of `room.py` in its free annulus. World: z up, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphs.camera import Camera, fit_lens
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.lenses import PARAMETER_NAMES, LensName

RigName = Literal["mono", "stereo", "triple", "quad"]
TrajectoryName = Literal[
    "handheld", "orbit", "corridor", "sideways", "panorama", "forward", "facing", "nadir", "static"
]

CAMERA_COUNT: dict[RigName, int] = {"mono": 1, "stereo": 2, "triple": 3, "quad": 4}
PRESET_WIDTH, PRESET_HEIGHT = 640, 480  # the size for which the lenses below are written
FISHEYE_FOCAL = 0.55  # of the other lenses' focal length: half a field of view of some 60 deg
SEMI_AXES_M = (1.4, 1.08)  # of the walk round the pedestal, 0.5 m clear of everything


@dataclass(frozen=True)
class LensPreset:
    """One camera's lens at 640 x 480; each lens model takes the coefficients that it has."""

    fx: float
    aspect: float  # fy / fx
    off_centre: tuple[float, float]  # px
    radial: tuple[float, float]
    tangential: tuple[float, float]
    fisheye: tuple[float, float, float, float]


LENSES = (
    LensPreset(532.4, 1.0019, (7.3, -5.1), (-0.162, 0.041), (6e-4, -4e-4), (-0.02, 4e-3, 0.0, 0.0)),
    LensPreset(545.8, 0.9982, (-5.6, 4.4), (-0.138, 0.034), (-5e-4, 7e-4), (-0.015, 2e-3, 0, 0)),
    LensPreset(523.1, 1.0023, (4.2, 6.8), (-0.187, 0.049), (4e-4, 5e-4), (-0.024, 5e-3, 0.0, 0.0)),
    LensPreset(538.6, 0.9985, (-6.1, -3.7), (-0.151, 0.038), (-6e-4, 3e-4), (-0.018, 3e-3, 0, 0)),
)
LIKE: dict[LensName, LensName] = {
    "division": "radial",
    "eucm": "kannala_brandt",
    "double_sphere": "kannala_brandt",
}
# Where the cameras sit in the rig's frame (x right, y down, z forward), and how they look:
# position in m; yaw to the right, pitch up, roll in degrees.
MOUNTS: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.19, 0.015, -0.02), (27.0, 3.0, -2.0)),
    ((-0.165, -0.03, -0.025), (-31.0, -4.0, 3.5)),
)
# One camera to each side: no two see the same thing at once, but with the wide kannala_brandt.
QUAD_MOUNTS = (
    MOUNTS[0],
    ((0.10, 0.012, -0.085), (88.5, 2.0, -1.5)),
    ((0.006, -0.02, -0.17), (178.0, -1.5, 2.0)),
    ((-0.105, 0.015, -0.08), (-91.0, 1.0, 2.5)),
)
STEREO_MOUNT = ((0.20, 0.008, 0.005), (-2.5, 1.0, 0.8))  # the second camera toes in


@dataclass(frozen=True)
class SimulatedRig:
    """Cameras and where they sit; the first is the reference."""

    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Transform, ...]


def make_rig(
    name: RigName,
    lens: LensName = "radial",
    size: tuple[int, int] = (PRESET_WIDTH, PRESET_HEIGHT),
) -> SimulatedRig:
    """A preset rig; focal length and principal point scale with the image's width."""
    count = CAMERA_COUNT[name]
    special = {"stereo": (MOUNTS[0], STEREO_MOUNT), "quad": QUAD_MOUNTS}
    mounts = special.get(name, MOUNTS[:count])
    cameras = tuple(make_camera(f"cam{i}", LENSES[i], lens, size) for i in range(count))
    return SimulatedRig(cameras, tuple(_cam_from_rig(*mount) for mount in mounts))


def make_camera(name: str, preset: LensPreset, lens: LensName, size: tuple[int, int]) -> Camera:
    """A camera with the preset's parameters, as far as the lens model has them.

    A lens with other parameters is the nearest to one that has them: to the fisheye if it is for
    such lenses.
    """
    if lens in LIKE:
        return fit_lens(make_camera(name, preset, LIKE[lens], size), lens)[0]
    scale = size[0] / PRESET_WIDTH
    fx = preset.fx * scale * (FISHEYE_FOCAL if lens == "kannala_brandt" else 1.0)
    cx, cy = ((n - 1) / 2 + d * scale for n, d in zip(size, preset.off_centre, strict=True))
    values = {"fx": fx, "fy": fx * preset.aspect, "cx": cx, "cy": cy}
    if lens == "kannala_brandt":
        values |= dict(zip(("k1", "k2", "k3", "k4"), preset.fisheye, strict=True))
    else:
        values |= dict(
            zip(("k1", "k2", "p1", "p2"), (*preset.radial, *preset.tangential), strict=True)
        )
    params = np.array([values.get(parameter, 0.0) for parameter in PARAMETER_NAMES[lens]])
    return Camera(name, lens, size, params)


def _cam_from_rig(
    position: tuple[float, float, float], angles_deg: tuple[float, float, float]
) -> Transform:
    yaw, pitch, roll = np.deg2rad(angles_deg)
    rotation = exp_rotation(np.array([0.0, yaw, 0.0]))
    rotation = rotation @ exp_rotation(np.array([pitch, 0.0, 0.0]))
    rotation = rotation @ exp_rotation(np.array([0.0, 0.0, roll]))
    return Transform(rotation, np.array(position)).inverse


def make_trajectory(name: TrajectoryName, frames: int, rng: np.random.Generator) -> list[Transform]:
    """rig_from_world of each frame; smooth, and different for every state of `rng`."""
    walk = TRAJECTORIES[name]
    position, yaw, pitch, roll = walk(np.arange(frames, dtype=np.float64), rng)
    return [_looking(p, *angles) for p, *angles in zip(position, yaw, pitch, roll, strict=True)]


def _looking(position: FloatArray, yaw: float, pitch: float, roll: float) -> Transform:
    """rig_from_world of a rig at a position, looking along yaw (from x to y) and pitch (up)."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    world_from_level = np.stack([right, np.cross(forward, right), forward], axis=1)
    world_from_rig = world_from_level @ exp_rotation(np.array([0.0, 0.0, roll]))
    return Transform(world_from_rig, position).inverse


Walk = tuple[FloatArray, FloatArray, FloatArray, FloatArray]  # position (n, 3), angles (n,) in rad


def _sway(frame: FloatArray, period: float, rng: np.random.Generator) -> FloatArray:
    """A smooth wobble (n,) within -1 to 1 of about the period, in frames."""
    periods, weights = period * np.array([1.0, 1.63, 0.71]), np.array([0.6, 0.25, 0.15])
    phases = rng.uniform(0, 2 * np.pi, 3)
    return np.sin(2 * np.pi * frame[:, None] / periods + phases) @ weights


def _ring(angle: FloatArray, reach: FloatArray, height_m: FloatArray) -> FloatArray:
    """Points (n, 3) on the walk round the pedestal; reach is a factor on its semi-axes."""
    x, y = SEMI_AXES_M[0] * np.cos(angle), SEMI_AXES_M[1] * np.sin(angle)
    return np.stack([x * reach, y * reach, height_m], -1)


def _handheld(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """Round the room, looking across it, now more to one wall and now to the next.

    Looks up and down and tilts to both sides, which tells the principal point from the rest.
    Inward views overlap longest and meet the same walls again: of the first 25 frames of 40,
    two in three see a third of what they see again, 15 or more frames later.
    """
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * frame / 34
    position = _ring(angle, 1 + 0.05 * _sway(frame, 15, rng), 1.35 + 0.35 * _sway(frame, 19, rng))
    from_outward_deg = 165 + 46 * np.cos(2 * np.pi * frame / 40) + 8 * _sway(frame, 17, rng)
    pitch = np.deg2rad(-6) + np.deg2rad(20) * _sway(frame, 19, rng)
    roll = np.deg2rad(46) * _sway(frame, 23, rng)
    return position, angle + np.deg2rad(from_outward_deg), pitch, roll


def _orbit(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """A loop round the pedestal, looking at it and at the far walls behind."""
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * frame / 36
    position = _ring(angle, np.ones_like(angle), 1.3 + 0.35 * _sway(frame, 26, rng))
    inward = np.array([0.0, 0.0, 0.9]) - position
    yaw = np.arctan2(inward[:, 1], inward[:, 0])
    pitch = np.arctan2(inward[:, 2], np.hypot(inward[:, 0], inward[:, 1]))
    return position, yaw, pitch, np.deg2rad(10) * _sway(frame, 23, rng)


def _corridor(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """Straight on, as a vehicle goes: 3 m, in steps of 8 cm or less."""
    start, end = np.array([-1.6, -1.05]), np.array([1.4, -1.0])
    along = frame * min(0.08 / 3.0, 1 / max(len(frame) - 1, 1))
    xy = start + along[:, None] * (end - start)
    position = np.concatenate([xy, (1.3 + 0.02 * _sway(frame, 11, rng))[:, None]], axis=1)
    yaw = np.deg2rad(3) * _sway(frame, 17, rng) + np.deg2rad(6)
    pitch = np.deg2rad(2) * _sway(frame, 13, rng)
    return position, yaw, pitch, np.deg2rad(1.5) * _sway(frame, 19, rng)


def _sideways(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """To and fro before the wall at +y, 1.3 to 1.7 m away, looking about and tilting by hand."""
    along = 1.3 * np.sin(rng.uniform(0, 2 * np.pi) + 2 * np.pi * frame / 44)
    away, height = 1.0 + 0.2 * _sway(frame, 23, rng), 1.4 + 0.3 * _sway(frame, 17, rng)
    yaw = np.deg2rad(90) + np.deg2rad(24) * _sway(frame, 21, rng)
    pitch = np.deg2rad(18) * _sway(frame, 19, rng)
    return np.stack([along, away, height], -1), yaw, pitch, np.deg2rad(40) * _sway(frame, 27, rng)


def _panorama(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """Pure rotation of the rig's reference camera, round and round, up and down."""
    position = np.broadcast_to([1.1, 0.6, 1.4], (len(frame), 3))
    yaw = rng.uniform(0, 2 * np.pi) + 2 * np.pi * frame / 33
    pitch = np.deg2rad(22) * _sway(frame, 25, rng)
    return position, yaw, pitch, np.deg2rad(15) * _sway(frame, 29, rng)


def _static(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """A rig that does not move."""
    still = np.ones_like(frame)
    position = np.array([-1.2, -0.6, 1.4]) * still[:, None]
    return position, rng.uniform(0.2, 0.7) * still, -0.1 * still, 0.05 * still


def _forward(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """Straight along the reference camera's optical axis, without any rotation."""
    along = -1.6 + frame * min(0.08, 3.0 / max(len(frame) - 1, 1))
    aside, height = np.array([-1.05, 1.3]) + rng.uniform(-0.05, 0.05, 2)
    still = np.zeros_like(frame)
    return np.stack([along, aside + still, height + still], -1), still, still, still


def _facing(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """To and fro, up and down, 1.5 m before the wall at +y, looking at it squarely all the time."""
    along = 1.3 * np.sin(rng.uniform(0, 2 * np.pi) + 2 * np.pi * frame / 44)
    still = np.zeros_like(frame)
    position = np.stack([along, 1.0 + still, 1.4 + 0.3 * _sway(frame, 17, rng)], -1)
    return position, np.pi / 2 + still, still, still


NADIR_STEP_M, NADIR_LINE, NADIR_LINES = 0.3, 8, 6  # images a line


def _nadir(frame: FloatArray, rng: np.random.Generator) -> Walk:
    """Line after line at one height, as a drone maps a field: straight down, one heading."""
    n_stops = NADIR_LINE * NADIR_LINES
    there_and_back = frame.astype(np.int64) % (2 * n_stops - 2)
    stop = np.minimum(there_and_back, 2 * n_stops - 2 - there_and_back)
    line, along = np.divmod(stop, NADIR_LINE)
    along = np.where(line % 2, NADIR_LINE - 1 - along, along)
    grid = np.stack([along - (NADIR_LINE - 1) / 2, line - (NADIR_LINES - 1) / 2], -1)
    xy = NADIR_STEP_M * grid + 0.03 * rng.standard_normal(grid.shape)
    still = np.ones_like(frame)
    yaw = rng.uniform(0, 2 * np.pi) * still
    position = np.concatenate([xy, 1.8 * still[:, None]], axis=1)
    return position, yaw, -np.pi / 2 * still, 0.0 * still


TRAJECTORIES: dict[TrajectoryName, Callable[[FloatArray, np.random.Generator], Walk]] = {
    "handheld": _handheld,
    "orbit": _orbit,
    "corridor": _corridor,
    "sideways": _sideways,
    "panorama": _panorama,
    "forward": _forward,
    "facing": _facing,
    "nadir": _nadir,
    "static": _static,
}

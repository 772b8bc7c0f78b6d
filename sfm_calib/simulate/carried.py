"""Feature tracks of a papered box that someone turns and carries before a rig that stands still.

What a user of a fixed rig can do without boards: cameras that look at one another see the same
sides of the box one after the other, and the box is the world in which the rig moves. All else in
view is plain, or masked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphs.camera import project
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.problem import Estimate, IntArray, Observations, Problem
from sfm_calib.simulate.keypoints import with_outliers
from sfm_calib.simulate.rigs import SimulatedRig

BOX_M = (0.24, 0.32, 0.20)  # its edges; of 10 kg of paper, and light to carry when empty
NEAREST_M = 0.3  # features closer than this are out of focus
# A feature is found again from where its patch looks much the same: within so much of one direction
# of its own, which is as far as that off the surface's normal at most.
FROM_DEG, OFF_NORMAL_DEG = 40.0, 25.0
STEEPEST_DEG = 65.0  # between line of sight and normal
REACH_M = (0.14, 0.12, 0.13)  # how far the box's middle is carried to every side
TILT_DEG = 40.0
TURN_FRAMES = 33.0  # of a full turn about the vertical


@dataclass(frozen=True)
class CarryOptions:
    """How the box is carried, and what is found on it."""

    frames: int = 60
    points: int = 2400  # of each kind of camera
    seen_share: float = 0.6  # of the features in view, how many are found
    max_points_per_image: int = 120
    sigma_px: float = 0.5
    outlier_share: float = 0.02
    start_deg: float = 1.0  # sigma of the rotation of every frame where a solver starts
    start_m: float = 0.01  # and of every frame's and point's place


def carry_box(
    options: CarryOptions,
    rig: SimulatedRig,
    start: SimulatedRig,
    kinds: Sequence[Sequence[int]],
    middle_m: FloatArray,
    rng: np.random.Generator,
) -> tuple[Problem, Estimate]:
    """Tracks of the box about a place (3,) in the rig's frame, and the truth of every variable.

    start: the rig as a solver has it. kinds: cameras (indices) that find one another's features:
    an infrared image is not matched with a colour image.
    """
    rig_from_box = carried(options.frames, middle_m, rng)
    points, normals, parts, before = [], [], [], 0
    for cameras in kinds:
        of_kind, outward = on_box(options.points, rng)
        parts += _seen(options, rig, cameras, rig_from_box, of_kind, outward, before, rng)
        points.append(of_kind)
        normals.append(outward)
        before += len(of_kind)
    seen = Observations(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    truth = Estimate(rig.cameras, rig.cam_from_rig, rig_from_box, np.concatenate(points))
    initial = replace(
        truth,
        cameras=start.cameras,
        cam_from_rig=start.cam_from_rig,
        rig_from_world=tuple(_off(options, rng) @ placed for placed in rig_from_box),
        points=truth.points + options.start_m * rng.standard_normal(truth.points.shape),
    )
    names = tuple(f"{frame:06d}" for frame in range(options.frames))
    return Problem(initial, seen, names), truth


def carried(frames: int, middle_m: FloatArray, rng: np.random.Generator) -> tuple[Transform, ...]:
    """rig_from_box of each frame: turned about the vertical, tilted, and moved to all sides."""
    frame = np.arange(frames)
    place = middle_m + np.array(REACH_M) * _sway(frame, (23.0, 17.0, 29.0), rng)
    tilt = np.radians(TILT_DEG) * _sway(frame, (19.0, 31.0), rng)
    yaw = rng.uniform(0, 2 * np.pi) + 2 * np.pi * frame / TURN_FRAMES
    return tuple(
        Transform(
            exp_rotation(np.array([x, 0.0, z])) @ exp_rotation(np.array([0.0, turn, 0.0])), at
        )
        for at, (x, z), turn in zip(place, tilt, yaw, strict=True)
    )


def on_box(count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Points (count, 3) on the box's sides, as many a square metre of each, and their normals."""
    half = np.array(BOX_M) / 2
    area = np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
    axis = rng.choice(3, count, p=area / area.sum())
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = rng.choice([-1.0, 1.0], count)
    inside = rng.uniform(-1, 1, (count, 3))
    return np.where(normals != 0, normals, inside) * half, normals


def _seen(
    options: CarryOptions,
    rig: SimulatedRig,
    cameras: Sequence[int],
    rig_from_box: Sequence[Transform],
    points: FloatArray,
    normals: FloatArray,
    before: int,
    rng: np.random.Generator,
) -> list[tuple[FloatArray, IntArray, IntArray, IntArray]]:
    """Pixels, frame, camera and point of what some cameras find, an image at a time."""
    own = _tilted(normals, rng)
    parts = []
    for index in cameras:
        camera = rig.cameras[index]
        images = []
        for frame, placed in enumerate(rig_from_box):
            cam_from_box = rig.cam_from_rig[index] @ placed
            at = cam_from_box @ points
            to_camera = cam_from_box.inverse.translation - points
            distance = np.linalg.norm(to_camera, axis=1)
            to_camera /= distance[:, None]
            pixels = project(camera, at)
            with np.errstate(invalid="ignore"):
                found = ((pixels >= 0) & (pixels <= np.array(camera.size) - 1)).all(1)
            found &= distance > NEAREST_M
            found &= (to_camera * normals).sum(1) > np.cos(np.radians(STEEPEST_DEG))
            found &= (to_camera * own).sum(1) > np.cos(np.radians(FROM_DEG))
            found &= rng.uniform(size=len(points)) < options.seen_share
            kept = np.flatnonzero(found)
            if len(kept) > options.max_points_per_image:
                kept = np.sort(rng.choice(kept, options.max_points_per_image, replace=False))
            images.append((pixels[kept], np.full(len(kept), frame), kept + before))
        exact, frames, which = (np.concatenate(column) for column in zip(*images, strict=True))
        noisy = exact + options.sigma_px * rng.standard_normal(exact.shape)
        noisy = with_outliers(noisy, options.outlier_share, "heavy", camera.size, rng)
        parts.append((noisy, frames, np.full(len(noisy), index), which))
    return parts


def _tilted(normals: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Directions (n, 3) up to OFF_NORMAL_DEG off the normals (n, 3)."""
    across = np.cross(normals, rng.standard_normal(normals.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.radians(OFF_NORMAL_DEG) * np.sqrt(rng.uniform(size=(len(normals), 1)))
    result: FloatArray = np.cos(angle) * normals + np.sin(angle) * across
    return result


def _sway(frame: IntArray, periods: Sequence[float], rng: np.random.Generator) -> FloatArray:
    """Smooth wobbles (n, n_periods) within -1 to 1 of about these periods, in frames."""
    found = []
    for period in periods:
        parts = period * np.array([1.0, 1.63, 0.71])
        phases = rng.uniform(0, 2 * np.pi, 3)
        found.append(
            np.sin(2 * np.pi * frame[:, None] / parts + phases) @ np.array([0.6, 0.25, 0.15])
        )
    return np.stack(found, axis=1)


def _off(options: CarryOptions, rng: np.random.Generator) -> Transform:
    turn = exp_rotation(np.radians(options.start_deg) * rng.standard_normal(3))
    return Transform(turn, options.start_m * rng.standard_normal(3))

"""Small problems of any lens, solved in milliseconds, with the truth of every variable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphs.camera import Camera, project
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from graphs.problem import (
    Estimate,
    IntArray,
    KnownBaseline,
    Observations,
    Problem,
    points_in_cameras,
)
from synthetic.cameras import camera_of

MOST_FRAMES_OF_A_TRACK = 6


def small_problem(
    lens: LensName = "radial",
    *,
    cameras: int = 2,
    frames: int = 4,
    points: int = 30,
    sigma_px: float = 0.5,
    start_error: float = 1.0,
    reference: int = 0,
    baseline: bool = False,
    seed: int = 0,
) -> tuple[Problem, Estimate]:
    """A rig that moves half a metre a frame past points 3 to 7 m ahead of it, and the truth.

    Every point is seen by about four in five of the images of six frames in a row. start_error: 1
    puts the start some pixels off, 0 starts at the truth. baseline: that of the first two cameras
    is measured.
    """
    rng = np.random.default_rng(seed)
    true = _truth(lens, cameras, frames, points, reference, rng)
    rows = _visibility(frames, cameras, points, rng)
    blank = Observations(np.zeros((len(rows), 2)), *np.ascontiguousarray(rows.T))
    pixels = projected(true, blank)
    seen = replace(blank, pixels=pixels + sigma_px * rng.standard_normal(pixels.shape))
    assert np.isfinite(pixels).all()
    names = tuple(f"{frame:06d}" for frame in range(frames))
    scales = (_measured(true),) if baseline else ()
    return Problem(
        perturbed(true, reference, start_error, rng), seen, names, reference, scales
    ), true


def _truth(
    lens: LensName, cameras: int, frames: int, points: int, reference: int, rng: np.random.Generator
) -> Estimate:
    ideal = camera_of(lens)
    own = []
    for index in range(cameras):
        params = ideal.params * (1 + 0.01 * rng.standard_normal(ideal.params.size))
        own.append(Camera(f"cam{index}", lens, ideal.size, params))
    cam_from_rig = [
        Transform.exp(0.1 * rng.standard_normal(3), 0.15 * rng.standard_normal(3))
        if index != reference
        else Transform.identity()
        for index in range(cameras)
    ]
    # a world with no axis or place of its own
    level_from_world = Transform.exp(rng.standard_normal(3), 3 * rng.standard_normal(3))
    rig_from_world, steps = [], 0.25 * rng.standard_normal((frames, 3))
    steps[:, 0] = 0.5 * np.arange(frames)
    for step in steps:
        turn = Transform.exp(0.1 * rng.standard_normal(3), np.zeros(3))
        rig_from_world.append(turn @ Transform(np.eye(3), -step) @ level_from_world)
    depth = rng.uniform(3, 7, points)
    ahead = np.column_stack([rng.uniform(-0.3, 0.3, (points, 2)) * depth[:, None], depth])
    ahead[:, 0] += 0.5 * _middles(frames, points)
    world = level_from_world.inverse @ ahead
    return Estimate(tuple(own), tuple(cam_from_rig), tuple(rig_from_world), world)


def _measured(true: Estimate) -> KnownBaseline:
    """The distance of the first two cameras, 1 % wrong with a sigma of 1 %."""
    first, second = (t.inverse.translation for t in true.cam_from_rig[:2])
    length_m = float(np.linalg.norm(second - first))
    return KnownBaseline((0, 1), 1.01 * length_m, 0.01 * length_m)


def _middles(frames: int, points: int) -> FloatArray:
    """The frame (points,) about which each point is seen."""
    return np.linspace(0, frames - 1, points)


def _visibility(frames: int, cameras: int, points: int, rng: np.random.Generator) -> IntArray:
    """Frame, camera, point (n_obs, 3), three observations a point at least, in no order."""
    rows = []
    for point, middle in enumerate(_middles(frames, points)):
        first = int(np.clip(round(middle) - MOST_FRAMES_OF_A_TRACK // 2, 0, frames - 1))
        near = range(first, min(first + MOST_FRAMES_OF_A_TRACK, frames))
        every = [(frame, camera, point) for frame in near for camera in range(cameras)]
        kept = rng.permutation(len(every))[: max(round(0.8 * len(every)), 3)]
        rows += [every[i] for i in kept]
    return rng.permutation(np.array(rows, dtype=np.int64))


def projected(estimate: Estimate, seen: Observations) -> FloatArray:
    """Pixels (n_obs, 2) of every observation as the estimate has them."""
    in_cameras, pixels = points_in_cameras(estimate, seen), np.empty((len(seen), 2))
    for index, camera in enumerate(estimate.cameras):
        rows = seen.camera == index
        pixels[rows] = project(camera, in_cameras[rows])
    return pixels


def perturbed(true: Estimate, reference: int, error: float, rng: np.random.Generator) -> Estimate:
    """Everything but the reference camera's place moved by a little, `error` times."""

    def moved(b_from_a: Transform) -> Transform:
        step = error * rng.standard_normal(6) * [0.002, 0.002, 0.002, 0.005, 0.005, 0.005]
        return Transform.exp(step[:3], step[3:]) @ b_from_a

    cameras = []
    for camera in true.cameras:
        relative = error * rng.standard_normal(camera.params.size)
        cameras.append(replace(camera, params=camera.params * (1 + 0.005 * relative)))
    placed = tuple(
        t if index == reference else moved(t) for index, t in enumerate(true.cam_from_rig)
    )
    points = true.points + 0.02 * error * rng.standard_normal(true.points.shape)
    return Estimate(tuple(cameras), placed, tuple(map(moved, true.rig_from_world)), points)


def with_tracks(problem: Problem, points: FloatArray, added: Observations) -> Problem:
    """The problem with more points (n, 3); `added.point` counts from the first of them."""
    seen, start = problem.observations, problem.initial
    joined = Observations(
        np.concatenate([seen.pixels, added.pixels]),
        np.concatenate([seen.frame, added.frame]),
        np.concatenate([seen.camera, added.camera]),
        np.concatenate([seen.point, added.point + len(start.points)]),
    )
    together = replace(start, points=np.concatenate([start.points, points]))
    return replace(problem, initial=together, observations=joined)


def calibration_of(estimate: Estimate) -> FloatArray:
    """All lens parameters, then all rotations and translations of cam_from_rig (n,)."""
    placed = [np.append(t.rotation.ravel(), t.translation) for t in estimate.cam_from_rig]
    return np.concatenate([*(camera.params for camera in estimate.cameras), *placed])


def with_noise(seen: Observations, seed: int = 0) -> Observations:
    """The observations with noise of all sizes and shapes stated of them."""
    rng = np.random.default_rng(seed)
    roots = rng.uniform(-1, 1, (len(seen), 2, 2)) + 1.5 * np.eye(2)
    shapes = roots @ roots.mT
    return replace(
        seen,
        relative_sigma=rng.uniform(0.5, 3, len(seen)),
        noise_shape=shapes / np.sqrt(np.linalg.det(shapes))[:, None, None],
    )

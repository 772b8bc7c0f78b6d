"""Hand-eye calibration and the union of two reconstructions, on motions that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from graphs.frames import FloatArray, Transform, angle_between
from graphs.join import hand_eye, join_models
from graphs.problem import Estimate, Observations, residuals_px
from graphs.rig_start import FreeModel
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

B_FROM_A = Transform.exp(np.array([0.2, 1.1, -0.3]), np.array([0.3, -0.1, 0.15]))
SCALE = 2.7  # one unit of b's world is so many of a's
OTHER_FROM_WORLD = Transform.exp(np.array([1.0, -0.4, 0.2]), np.array([3.0, 1.0, -2.0]))


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def two_trajectories(
    turns: FloatArray, positions: FloatArray
) -> tuple[list[Transform], list[Transform]]:
    """Poses of camera a in its world, and of b, fixed to a, in another of its own unit."""
    a_from_world = [
        Transform.exp(turn, position) for turn, position in zip(turns, positions, strict=True)
    ]
    b_from_other = [
        (B_FROM_A @ a @ OTHER_FROM_WORLD.inverse).scaled(1 / SCALE) for a in a_from_world
    ]
    return a_from_world, b_from_other


def wobble(count: int, about: FloatArray, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    """Turns (count, 3) with the given sigmas about the axes, and free positions (count, 3)."""
    free = rng(seed)
    return free.standard_normal((count, 3)) * about, free.standard_normal((count, 3))


def noisy(poses: list[Transform], sigma: float, seed: int) -> list[Transform]:
    free = rng(seed)
    return [
        Transform.exp(sigma * free.standard_normal(3), sigma * free.standard_normal(3)) @ pose
        for pose in poses
    ]


# ---- hand-eye ------------------------------------------------------------------------------


def test_hand_eye_recovers_the_transform_and_the_scale() -> None:
    solved = hand_eye(*two_trajectories(*wobble(6, np.array([0.3, 0.5, 0.2]))))
    assert solved is not None
    b_from_a, scale = solved
    assert scale == pytest.approx(SCALE, rel=1e-9)
    assert angle_between(b_from_a.rotation, B_FROM_A.rotation) < 1e-9
    np.testing.assert_allclose(b_from_a.translation, B_FROM_A.translation, atol=1e-9)


def test_hand_eye_bears_noise() -> None:
    a, b = two_trajectories(*wobble(30, np.array([0.3, 0.5, 0.2])))
    solved = hand_eye(noisy(a, 2e-3, 1), noisy(b, 2e-3, 2))
    assert solved is not None
    b_from_a, scale = solved
    assert scale == pytest.approx(SCALE, rel=5e-3)
    assert angle_between(b_from_a.rotation, B_FROM_A.rotation) < 5e-3
    np.testing.assert_allclose(b_from_a.translation, B_FROM_A.translation, atol=2e-2)


def test_hand_eye_bears_turns_of_more_than_half_a_circle() -> None:
    """At half a turn noise flips the axis: a's rotation vector and b's then point apart."""
    turns, positions = wobble(24, np.array([0.05, 0.05, 0.05]))
    turns[:, 1] += np.pi * (np.arange(24) % 2)
    turns[:, 0] += 0.6 * (np.arange(24) % 3)
    a, b = two_trajectories(turns, positions)
    solved = hand_eye(noisy(a, 1e-3, 1), noisy(b, 1e-3, 2))
    assert solved is not None
    assert angle_between(solved[0].rotation, B_FROM_A.rotation) < 3e-3
    assert solved[1] == pytest.approx(SCALE, rel=3e-3)


@pytest.mark.parametrize(
    ("about", "why"),
    [([0, 0.5, 0], "one axis"), ([0.01, 0.5, 0.01], "hardly a second axis"), ([0, 0, 0], "none")],
)
def test_hand_eye_refuses_turns_about_one_axis(about: list[float], why: str) -> None:
    assert hand_eye(*two_trajectories(*wobble(20, np.array(about)))) is None, why


def test_hand_eye_refuses_three_frames() -> None:
    a, b = two_trajectories(*wobble(4, np.array([0.5, 0.5, 0.5])))
    assert hand_eye(a, b) is not None
    assert hand_eye(a[:3], b[:3]) is None


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_hand_eye_refuses_a_rig_that_turns_about_a_point(noise: float) -> None:
    """On a pan-tilt head every scale explains the motion, with another translation."""
    turns, _ = wobble(20, np.array([0.3, 0.5, 0.2]))
    pivot = np.array([0.1, -0.2, 0.4])  # in camera a
    positions = np.array([pivot - Transform.exp(t, np.zeros(3)) @ pivot for t in turns])
    a, b = two_trajectories(turns, positions)
    assert hand_eye(noisy(a, noise, 1), noisy(b, noise, 2)) is None


# ---- joining -------------------------------------------------------------------------------

TRACKS = TrackOptions(rig="triple", frames=12, points=900, sigma_px=0.0, baseline_sigma_m=0.0)


def models_of_cameras(
    true: Estimate, seen: Observations, groups: list[list[int]]
) -> list[FreeModel]:
    """One reconstruction for each group of cameras; the second in a world of its own, its points
    numbered the other way round."""
    models = []
    for number, group in enumerate(groups):
        own = seen.subset(np.isin(seen.camera, group))
        other = OTHER_FROM_WORLD if number else Transform.identity()
        unit = 1 / SCALE if number else 1.0
        poses = {
            (c, f): (true.cam_from_rig[c] @ rig @ other.inverse).scaled(unit)
            for c in group
            for f, rig in enumerate(true.rig_from_world)
        }
        points = (other @ true.points) * unit
        if number:
            last = len(points) - 1
            points = points[::-1]
            own = Observations(own.pixels, own.frame, own.camera, last - own.point)
        models.append(FreeModel(true.cameras, poses, points, own))
    return models


def free_residuals(model: FreeModel) -> FloatArray:
    """Residuals of a model in which every image has its own pose."""
    images = sorted(model.cam_from_world)
    place = {image: index for index, image in enumerate(images)}
    seen = model.observations
    frame = [place[c, f] for c, f in zip(seen.camera.tolist(), seen.frame.tolist(), strict=True)]
    estimate = Estimate(
        model.cameras,
        tuple(Transform.identity() for _ in model.cameras),
        tuple(model.cam_from_world[image] for image in images),
        model.points,
    )
    return residuals_px(
        estimate, Observations(seen.pixels, np.array(frame), seen.camera, seen.point)
    )


@pytest.mark.parametrize("groups", [[[0], [1]], [[0, 2], [1]], [[0], [1, 2]], [[0, 1], [1, 2]]])
def test_joined_models_project_right(groups: list[list[int]]) -> None:
    problem, true = simulate_tracks(TRACKS, rng())
    main, other = models_of_cameras(true, problem.observations, groups)
    joined = join_models(main, other)
    cameras = set(groups[0]) | set(groups[1])
    assert {camera for camera, _ in joined.cam_from_world} == cameras
    assert len(joined.observations) == np.isin(problem.observations.camera, list(cameras)).sum()
    assert np.abs(free_residuals(joined)).max() < 1e-6
    for camera in cameras:
        for frame, rig in enumerate(true.rig_from_world):
            expected = true.cam_from_rig[camera] @ rig
            ours = joined.cam_from_world[camera, frame]
            assert angle_between(ours.rotation, expected.rotation) < 1e-7
            np.testing.assert_allclose(ours.translation, expected.translation, atol=1e-7)


def test_a_model_that_adds_no_camera_changes_nothing() -> None:
    problem, true = simulate_tracks(TRACKS, rng())
    main, other = models_of_cameras(true, problem.observations, [[0, 1], [1]])
    assert join_models(main, other) is main


def test_models_that_share_too_few_frames_stay_apart() -> None:
    problem, true = simulate_tracks(TRACKS, rng())
    main, other = models_of_cameras(true, problem.observations, [[0], [1]])
    few = {image: pose for image, pose in other.cam_from_world.items() if image[1] < 3}
    assert join_models(main, FreeModel(true.cameras, few, other.points, other.observations)) is main


def test_a_planar_scan_stays_apart() -> None:
    problem, true = simulate_tracks(TRACKS, rng())
    level = tuple(
        Transform.exp(np.array([0.0, 0.3 * f, 0.0]), np.array([0.1 * f, 0.0, 0.2 * f]))
        for f in range(len(true.rig_from_world))
    )
    planar = Estimate(true.cameras, true.cam_from_rig, level, true.points)
    main, other = models_of_cameras(planar, problem.observations, [[0], [1]])
    assert join_models(main, other) is main

"""Scenes, trajectories and rigs of the studies: each is as degenerate as its name says."""

from __future__ import annotations

import numpy as np
import pytest

from graphs.frames import FloatArray, Transform, angle_between
from graphs.problem import points_in_cameras, residuals_px
from sfm_calib.simulate.keypoints import (
    COARSEST_SCALE_PX,
    FINEST_SCALE_PX,
    draw_scales,
    relative_noise,
)
from sfm_calib.simulate.rigs import TrajectoryName, make_rig, make_trajectory
from sfm_calib.simulate.room import ROOM_SIZE_M
from sfm_calib.simulate.scenes import GROUND_RELIEF_M, WALL_RELIEF_M, SceneName, scene_points
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

FRAMES = 40


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def placed(name: TrajectoryName, seed: int = 0, frames: int = FRAMES) -> list[Transform]:
    return make_trajectory(name, frames, rng(seed))


def centres_m(trajectory: list[Transform]) -> FloatArray:
    return np.array([t.inverse.translation for t in trajectory])


def turns(trajectory: list[Transform]) -> FloatArray:
    """Angles in radians from the first frame."""
    return np.array([angle_between(t.rotation, trajectory[0].rotation) for t in trajectory])


# ---- scenes --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene", "axis", "at_m", "relief_m"),
    [
        ("wall", 1, ROOM_SIZE_M[1] / 2 - WALL_RELIEF_M, WALL_RELIEF_M),
        ("plane", 1, ROOM_SIZE_M[1] / 2, 0.0),
        ("ground", 2, 0.0, GROUND_RELIEF_M),
    ],
)
def test_a_single_surface_has_its_relief(
    scene: SceneName, axis: int, at_m: float, relief_m: float
) -> None:
    across = scene_points(scene, 2000, rng())[:, axis]
    assert across.min() == pytest.approx(at_m, abs=1e-3)
    assert np.ptp(across) == pytest.approx(relief_m, rel=0.01)


def test_the_room_has_points_on_every_side() -> None:
    points = scene_points("room", 2000, rng())
    assert points.shape == (2000, 3)
    np.testing.assert_allclose(np.ptp(points, axis=0), ROOM_SIZE_M, rtol=0.01)


# ---- trajectories --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_forward_is_along_the_optical_axis_alone(seed: int) -> None:
    trajectory = placed("forward", seed)
    assert turns(trajectory).max() == 0
    steps = np.diff(centres_m(trajectory), axis=0)
    in_rig = steps @ trajectory[0].rotation.T
    np.testing.assert_allclose(in_rig[:, :2], 0, atol=1e-12)
    assert (in_rig[:, 2] > 0).all()


@pytest.mark.parametrize("seed", range(3))
def test_facing_stays_square_to_the_wall(seed: int) -> None:
    trajectory = placed("facing", seed)
    for frame in trajectory:
        np.testing.assert_allclose(frame.rotation[2], [0, 1, 0], atol=1e-12)  # z in the world
    centres = centres_m(trajectory)
    assert np.ptp(centres[:, 1]) < 1e-12
    assert np.ptp(centres[:, 0]) > 1 and np.ptp(centres[:, 2]) > 0.2
    assert turns(trajectory).max() < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_nadir_views_are_parallel_and_of_one_height(seed: int) -> None:
    trajectory = placed("nadir", seed)
    np.testing.assert_allclose(trajectory[5].rotation[2], [0, 0, -1], atol=1e-12)
    assert turns(trajectory).max() < 1e-6
    centres = centres_m(trajectory)
    assert np.ptp(centres[:, 2]) < 1e-12
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps.min() > 0.1 and steps.max() < 0.5


def test_nadir_lines_go_there_and_back() -> None:
    steps = np.linalg.norm(np.diff(centres_m(placed("nadir", frames=200)), axis=0), axis=1)
    assert steps.max() < 0.5


def test_sideways_tilts_and_rolls_before_the_wall() -> None:
    trajectory = placed("sideways")
    forward = np.array([t.rotation[2] for t in trajectory])
    tilt_deg = np.rad2deg(np.arccos(forward[:, 1]))
    up = np.array([t.rotation[:, 2] for t in trajectory])  # the world's z in the rig
    roll_deg = np.rad2deg(np.arctan2(up[:, 0], -up[:, 1]))
    assert 10 < tilt_deg.max() < 40
    assert np.ptp(roll_deg) > 25
    assert np.ptp(centres_m(trajectory)[:, 0]) > 2
    assert turns(trajectory)[1:].min() < np.deg2rad(15)


@pytest.mark.parametrize(
    ("trajectory", "scene"),
    [
        ("sideways", "wall"),
        ("facing", "plane"),
        ("nadir", "ground"),
        ("forward", "room"),
    ],
)
@pytest.mark.parametrize("rig", ["mono", "stereo"])
def test_every_frame_sees_its_scene(trajectory: str, scene: str, rig: str) -> None:
    options = TrackOptions(
        rig=rig, trajectory=trajectory, scene=scene, points=1500, max_points_per_image=150
    )
    problem, true = simulate_tracks(options, rng())
    assert len(problem.frame_names) == FRAMES
    counts = np.bincount(problem.observations.frame)
    assert counts.min() > 10
    in_camera = points_in_cameras(true, problem.observations)
    assert in_camera[:, 2].min() > 0.3
    pixels = problem.observations.pixels
    assert (np.ptp(pixels, axis=0) > (600, 440)).all()  # up to the corners


# ---- the rig without overlap ---------------------------------------------------------------


def test_cameras_of_the_quad_never_see_the_same_thing_at_once() -> None:
    options = TrackOptions(rig="quad", points=2000, sigma_px=0.0)
    seen = simulate_tracks(options, rng())[0].observations
    together = np.stack([seen.frame, seen.point])
    assert np.unique(together, axis=1).shape[1] == len(seen)


def test_cameras_of_the_quad_see_the_same_things_in_turn() -> None:
    seen = simulate_tracks(TrackOptions(rig="quad", points=2000), rng())[0].observations
    for camera in range(4):
        frames = np.unique(seen.frame[seen.camera == camera])
        assert len(frames) == FRAMES
        own = np.unique(seen.point[seen.camera == camera])
        others = np.unique(seen.point[seen.camera != camera])
        assert np.isin(own, others).mean() > 0.3


def test_the_quad_looks_to_all_sides_from_one_place() -> None:
    rig = make_rig("quad")
    axes = np.array([t.rotation[2] for t in rig.cam_from_rig])
    angles_deg = np.rad2deg(np.arctan2(axes[:, 0], axes[:, 2])) % 360
    np.testing.assert_allclose(angles_deg, [0, 90, 180, 270], atol=3)
    places = np.array([t.inverse.translation for t in rig.cam_from_rig])
    assert np.linalg.norm(places, axis=1).max() < 0.2
    np.testing.assert_array_equal(rig.cam_from_rig[0].rotation, np.eye(3))


# ---- keypoints that err by their scale -----------------------------------------------------


def test_keypoints_are_four_times_as_rare_an_octave() -> None:
    point, distance_m = np.arange(200_000), np.full(200_000, 2.0)
    scale = draw_scales(point, distance_m, len(point), rng())
    assert scale.min() == pytest.approx(FINEST_SCALE_PX, rel=1e-3)
    assert scale.max() == pytest.approx(COARSEST_SCALE_PX, rel=0.01)
    counts = np.histogram(scale, FINEST_SCALE_PX * 2.0 ** np.arange(5))[0]
    np.testing.assert_allclose(counts[:-1] / counts[1:], 4, rtol=0.1)


def test_keypoints_shrink_with_the_distance() -> None:
    point, distance_m = np.zeros(2, np.int64), np.array([1.0, 4.0])
    scales = np.array([draw_scales(point, distance_m, 1, rng(seed)) for seed in range(50)])
    inside = (scales > FINEST_SCALE_PX).all(1) & (scales < COARSEST_SCALE_PX).all(1)
    assert inside.any() and not inside.all()
    np.testing.assert_allclose(scales[inside, 0], 4 * scales[inside, 1])


def test_coarse_keypoints_err_more() -> None:
    options = TrackOptions(rig="stereo", points=4000, sigma_px=0.4, noise_by_scale=True)
    problem, true = simulate_tracks(options, rng())
    seen = problem.observations
    assert seen.feature_scale is not None
    residuals = residuals_px(true, seen)
    for low, high in ((FINEST_SCALE_PX, 2.0), (2, 4), (4, 8), (8, 26)):
        rows = (seen.feature_scale >= low) & (seen.feature_scale < high)
        expected = 0.4 * np.sqrt(np.mean(relative_noise(seen.feature_scale[rows]) ** 2))
        assert residuals[rows].std() == pytest.approx(expected, rel=0.06)
    assert relative_noise(np.array([COARSEST_SCALE_PX]))[0] > 3.5


def test_scales_are_only_known_where_asked_for() -> None:
    options = TrackOptions(rig="stereo", points=500, frames=10)
    assert simulate_tracks(options, rng())[0].observations.feature_scale is None

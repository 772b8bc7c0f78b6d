"""What a scan shows each camera, on problems whose answer is plain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphs.camera import Camera
from graphs.coverage import (
    GRID,
    MIN_IN_CELL,
    coverage,
    image_plane,
    motion_of,
    seen_scene,
    shared_points,
)
from graphs.frames import Transform, exp_rotation
from graphs.problem import Estimate, Observations, Problem
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIZE = (101, 201)
ALL = np.ones((GRID, GRID), dtype=bool)
DEG = np.pi / 180


def everywhere(step=2):
    across, down = (np.arange(0, n, step, dtype=np.float64) for n in SIZE)
    return np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)


# ---- the image plane ---------------------------------------------------------------------------


def test_points_everywhere_cover_the_image():
    plane = image_plane(everywhere(), SIZE, ALL)
    assert plane.covered == 1 and plane.corners == (True,) * 4
    assert plane.radius == pytest.approx(1, abs=0.05)


def test_points_in_the_upper_half_cover_half():
    pixels = everywhere()
    plane = image_plane(pixels[pixels[:, 1] < 100], SIZE, ALL)
    assert plane.covered == pytest.approx(0.5) and plane.corners == (True, True, False, False)


def test_points_in_the_middle_reach_no_corner():
    middle = (np.array(SIZE) - 1) / 2
    pixels = everywhere(1)
    inner = (np.abs(pixels - middle) < 0.3 * np.array(SIZE)).all(1)
    plane = image_plane(pixels[inner], SIZE, ALL)
    assert plane.covered == pytest.approx(0.36) and plane.corners == (False,) * 4
    assert plane.radius == pytest.approx(0.6, abs=0.03)


def test_a_cell_wants_more_than_a_stray_point():
    cell = np.full((MIN_IN_CELL, 2), 15.0)
    assert image_plane(cell, SIZE, ALL).covered == 1 / GRID**2
    assert image_plane(cell[1:], SIZE, ALL).covered == 0


def test_what_the_lens_leaves_dark_does_not_count():
    lit = ALL.copy()
    lit[:2, :2] = False
    pixels = everywhere()
    seen = pixels[(pixels[:, 0] > 20) | (pixels[:, 1] > 40)]
    plane = image_plane(seen, SIZE, lit)
    assert plane.covered == 1 and plane.corners == (None, True, True, True)


def test_nothing_seen_is_nothing_covered():
    plane = image_plane(np.empty((0, 2)), SIZE, ALL)
    assert (plane.covered, plane.radius, plane.corners) == (0, 0, (False,) * 4)


# ---- motion ------------------------------------------------------------------------------------


def turned(*rotation_vectors_deg, places=None):
    """cam_from_world of a camera that turns so much about its own axes, at the places given."""
    steps = len(rotation_vectors_deg)
    places = np.zeros((steps, 3)) if places is None else np.asarray(places, dtype=np.float64)
    return [
        Transform(exp_rotation(DEG * np.array(vector, dtype=np.float64)).T, place).inverse
        for vector, place in zip(rotation_vectors_deg, places, strict=True)
    ]


@pytest.mark.parametrize("axis", range(3))
def test_turns_are_told_apart_by_axis(axis):
    angles = np.linspace(-20, 20, 21)
    motion = motion_of(turned(*(angle * np.eye(3)[axis] for angle in angles)))
    expected = np.zeros(3)
    expected[axis] = 36  # 5 to 95 % of 40
    assert motion.rotation_deg == pytest.approx(expected, abs=1e-6)


def test_turns_do_not_depend_on_the_world():
    world = Transform(exp_rotation(np.array([0.4, -1.1, 2.0])), np.array([3.0, -1.0, 2.0]))
    views = turned(*((angle, 0, 0.5 * angle) for angle in range(-10, 11)))
    moved = motion_of([view @ world for view in views])
    assert moved.rotation_deg == pytest.approx(motion_of(views).rotation_deg, abs=1e-6)


def test_one_wrong_view_hardly_widens_the_spread():
    views = turned(*((0, 0, 0),) * 40, (0, 0, 90))
    assert motion_of(views).rotation_deg == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("axis", range(3))
def test_the_way_is_split_along_the_cameras_own_axes(axis):
    facing = exp_rotation(np.array([0.3, 1.2, -0.5]))
    views = [Transform(facing, step * np.eye(3)[axis]) for step in np.linspace(0, 5, 6)]
    motion = motion_of(views)
    assert motion.path_share == pytest.approx(np.eye(3)[axis])
    assert (motion.extent, motion.straightness) == pytest.approx((5, 1))


def test_a_circle_is_not_straight():
    angle = np.linspace(0, 2 * np.pi, 41)
    places = 2 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    motion = motion_of(turned(*((0, 0, 0),) * 41, places=places))
    assert motion.extent == pytest.approx(4, rel=0.01)
    assert motion.straightness == pytest.approx(0, abs=0.01)


def test_a_camera_that_stays_has_no_way():
    for views in ([], turned((0, 0, 0)), turned((0, 0, 0), (0, 5, 0))):
        motion = motion_of(views)
        assert not motion.path_share.any() and motion.extent == motion.straightness == 0


# ---- what was seen -----------------------------------------------------------------------------


def test_distances_are_in_units_of_the_way():
    distance = np.linspace(1, 10, 91)
    scene = seen_scene(np.eye(3), distance, np.full(3, 5.0), extent=2.0)
    assert (scene.near, scene.far) == pytest.approx((1.45 / 2, 9.55 / 2))
    assert scene.depth_ratio == pytest.approx(9.55 / 1.45)
    assert scene.parallax_deg == pytest.approx(5)


def test_a_wall_is_thin_and_a_room_is_not():
    rng = np.random.default_rng(0)
    room = rng.uniform(-1, 1, (2000, 3))
    facing = exp_rotation(np.array([0.3, 1.2, -0.5]))
    wall = (room * [2, 1, 0.05]) @ facing.T + [5, 1, 2]
    thin, thick = (
        seen_scene(points, np.ones(3), np.ones(3), 1.0).thickness for points in (wall, room)
    )
    assert thin == pytest.approx(0.05, rel=0.1) and thick > 0.9


def test_far_mismatches_do_not_thicken_a_wall():
    rng = np.random.default_rng(0)
    wall = rng.uniform(-1, 1, (1000, 3)) * [2, 1, 0]
    wall[:50] *= 1000
    wall[:50, 2] = 500
    assert seen_scene(wall, np.ones(3), np.ones(3), 1.0).thickness == pytest.approx(0, abs=1e-9)


def test_a_camera_that_saw_nothing_has_no_numbers():
    nothing = np.empty(0)
    scene = seen_scene(np.empty((0, 3)), nothing, nothing, 1.0)
    numbers = [scene.near, scene.far, scene.thickness, scene.depth_ratio, *scene.parallax_deg]
    assert np.isnan(numbers).all()
    still = seen_scene(np.eye(3), np.ones(3), np.full(3, np.nan), extent=0.0)
    assert np.isnan([still.near, still.depth_ratio, *still.parallax_deg]).all()


# ---- whole problems ----------------------------------------------------------------------------


def triangle(seen):
    """Two cameras at one place, three frames along x, a point one unit before the second frame and
    one far away; `seen` are (frame, camera, point)."""
    camera = Camera("cam", "pinhole", SIZE, np.array([50.0, 50.0, 50.0, 100.0]))
    frames = tuple(Transform(np.eye(3), np.array([1.0 - frame, 0, 0])) for frame in range(3))
    start = Estimate(
        (camera, replace(camera, name="other")),
        (Transform.identity(),) * 2,
        frames,
        np.array([[0.0, 0, 1], [0, 0, 1e6]]),
    )
    frame, index, point = np.array(seen).T
    pixels = np.full((len(seen), 2), 30.0)
    return Problem(start, Observations(pixels, frame, index, point), ("a", "b", "c"))


def test_points_in_common_at_once_and_ever():
    problem = triangle([(0, 0, 0), (0, 1, 0), (1, 0, 1), (2, 1, 1), (2, 0, 0), (2, 1, 0)])
    at_once, ever = shared_points(problem.initial, problem.observations)
    assert at_once.tolist() == [[2, 1], [1, 2]] and ever.tolist() == [[2, 2], [2, 2]]


def test_parallax_and_what_is_too_far_to_count():
    problem = triangle([(frame, 0, point) for frame in range(3) for point in range(2)])
    first, second = coverage(problem, min_parallax_deg=1.0).cameras
    assert first.scene.parallax_deg == pytest.approx([4.5, 45, 85.5], abs=0.01)
    assert first.per_image.tolist() == [1, 1, 1] and first.frames.tolist() == [0, 1, 2]
    assert (second.n_images, second.n_observations, second.plane.covered) == (0, 0, 0)
    everything = coverage(problem, min_parallax_deg=0.0).cameras[0]
    assert everything.n_observations == 6
    nothing_useful = coverage(problem, min_parallax_deg=120.0).cameras[0]
    assert nothing_useful.n_observations == 6  # better all than none


def true_coverage(trajectory, rig="mono", frames=40):
    options = TrackOptions(rig=rig, trajectory=trajectory, frames=frames, points=3000)
    problem, true = simulate_tracks(options, np.random.default_rng(0))
    return coverage(replace(problem, initial=true), min_parallax_deg=1.0)


def test_a_corridor_is_walked_along_the_view():
    for camera in true_coverage("corridor", "stereo").cameras:
        assert camera.motion.path_share[2] > 0.95 and camera.motion.straightness > 0.95
        assert camera.motion.rotation_deg.max() < 10


def test_a_handheld_walk_does_everything():
    (camera,) = true_coverage("handheld").cameras
    assert camera.motion.rotation_deg.min() > 30 and camera.motion.path_share[2] < 0.6
    assert camera.plane.covered == 1 and camera.scene.parallax_deg[1] > 5


@pytest.mark.parametrize("trajectory", ["panorama", "static"])
def test_without_motion_there_is_no_parallax(trajectory):
    (camera,) = true_coverage(trajectory).cameras
    assert camera.scene.parallax_deg[2] < 1e-3
    assert camera.motion.extent < 1e-9


def test_a_still_rig_has_the_parallax_of_its_baseline():
    for camera in true_coverage("static", "stereo").cameras:
        assert 1 < camera.scene.parallax_deg[1] < 5 and camera.motion.rotation_deg.max() < 1e-6

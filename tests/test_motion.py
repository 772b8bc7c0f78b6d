from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.directions import GOOD
from synthetic.problems import small_problem

from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.motion import Lack, Views, in_words, shared_lacks, too_little_motion, views_of
from graphs.problem import Problem
from sfm_calib.simulate.rigs import RigName, TrajectoryName
from sfm_calib.simulate.scenes import SceneName
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks


def at_truth(
    trajectory: TrajectoryName, scene: SceneName = "room", rig: RigName = "mono"
) -> Problem:
    options = TrackOptions(rig=rig, trajectory=trajectory, scene=scene, frames=20, points=1000)
    problem, true = simulate_tracks(options, np.random.default_rng(3))
    return replace(problem, initial=true)


def walked(positions: FloatArray, rotations: list[FloatArray]) -> Problem:
    """A small problem's points, seen by one camera from other places."""
    problem, true = small_problem("radial", cameras=1, frames=len(positions), points=60)
    level = [Transform(r, -r @ p) for r, p in zip(rotations, positions, strict=True)]
    points = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 6], true.points.shape)
    return replace(problem, initial=replace(true, rig_from_world=tuple(level), points=points))


def still(count: int = 6) -> list[FloatArray]:
    return [np.eye(3)] * count


def turned_about(lever: list[float], angles: FloatArray) -> Problem:
    """The same, of a camera that sits there in a rig which turns in its place, about its y axis."""
    problem = walked(np.zeros((6, 3)), [exp_rotation(np.array([0.0, a, 0.0])) for a in angles])
    placed = (Transform(np.eye(3), -np.array(lever)),)
    return replace(problem, initial=replace(problem.initial, cam_from_rig=placed))


@pytest.mark.parametrize(
    ("trajectory", "scene", "lacks"),
    [
        ("static", "room", ("static rig",)),
        ("panorama", "room", ("pure rotation",)),
        ("forward", "room", ("pure forward motion",)),
        ("facing", "plane", ("single plane seen head-on", "parallel views")),
        ("facing", "wall", ("single plane seen head-on", "parallel views")),
        ("facing", "room", ("parallel views",)),
        ("nadir", "ground", ("single plane seen head-on", "parallel views")),
        ("sideways", "wall", ()),
        ("orbit", "room", ()),
        ("handheld", "room", ()),
    ],
)
def test_degenerate_scans_have_their_names(
    trajectory: TrajectoryName, scene: SceneName, lacks: tuple[Lack, ...]
) -> None:
    views = views_of(at_truth(trajectory, scene))
    assert shared_lacks(views) == lacks
    for lack in lacks:
        assert in_words(lack, views).startswith(f"{lack}: ")


def test_a_rig_lacks_only_what_all_its_cameras_lack() -> None:
    views = views_of(at_truth("panorama", rig="triple"))
    assert views[0].lacks == ("pure rotation",)  # it stands still, the others circle it
    assert views[1].lacks == ()
    assert shared_lacks(views) == ()
    assert shared_lacks(views_of(at_truth("static", rig="triple"))) == ("static rig",)
    assert shared_lacks(()) == ()


def test_numbers_by_hand() -> None:
    sideways = np.arange(6)[:, None] * [0.2, 0.0, 0.0]
    (views,) = views_of(walked(sideways, still()))
    assert views.forward == pytest.approx(0)
    assert views.motion_share == pytest.approx(1)
    assert np.abs(views.motion_axis) == pytest.approx([1, 0, 0])
    assert views.turn_deg == pytest.approx(0, abs=1e-5)
    assert views.spread == pytest.approx((0.2 * np.arange(6).std() / views.distance, 0, 0))
    assert 1 < views.parallax_deg < np.degrees(1.0 / 4)
    assert views.lacks == ("parallel views",)


def test_turns_have_their_axis() -> None:
    places = np.arange(6)[:, None] * [0.2, 0.0, 0.0]
    for axis, roll in ((0, 0.0), (1, 0.0), (2, 0.1 * np.arange(6).std())):
        turns = [exp_rotation(0.1 * k * np.eye(3)[axis]) for k in range(6)]
        (views,) = views_of(walked(places, turns))
        assert np.abs(views.turn_axis) == pytest.approx(np.eye(3)[axis], abs=1e-6)
        assert views.turn_share == pytest.approx(1)
        assert views.turn_deg == pytest.approx(np.degrees(0.25))
        assert views.roll_deg == pytest.approx(np.degrees(roll), abs=1e-5)


def test_a_camera_that_sits_off_the_axis_of_turning_moves() -> None:
    """On a circle: ahead and back where it sits at the side, sideways where it sits in front."""
    angles = np.linspace(-0.1, 0.1, 6)
    along, across = 0.5 * np.sin(angles).std(), 0.5 * np.cos(angles).std()
    (beside,) = views_of(turned_about([0.5, 0.0, 0.0], angles))
    assert beside.forward == pytest.approx(1, abs=0.01)
    assert beside.spread == pytest.approx(np.array([across, 0, along]) / beside.distance)
    (ahead,) = views_of(turned_about([0.0, 0.0, 0.5], angles))
    assert ahead.forward == pytest.approx(0, abs=0.01)
    assert ahead.spread == pytest.approx(np.array([along, 0, across]) / ahead.distance)
    assert ahead.parallax_deg > 0.5
    (amid,) = views_of(turned_about([0.0, 0.0, 0.0], angles))
    assert amid.forward == 0 and amid.parallax_deg == pytest.approx(0, abs=1e-5)


def scene_of(points: FloatArray) -> Views:
    """What one camera's sideways walk makes of a scene."""
    problem = walked(np.arange(6)[:, None] * [0.2, 0.0, 0.0], still())
    (views,) = views_of(replace(problem, initial=replace(problem.initial, points=points)))
    return views


def test_relief_is_the_sigma_of_depths_off_a_plane() -> None:
    across = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    near, far = (np.column_stack([across, np.full(30, z)]) for z in (4.9, 5.1))
    views = scene_of(np.concatenate([near, far]))
    # median length of the depths: 0.1; that of Gaussian ones is sigma / 1.4826
    assert views.relief == pytest.approx(1.4826 * 0.1 / views.distance, rel=0.01)
    assert views.tilt_deg == pytest.approx(0, abs=1e-3)


def test_a_sky_does_not_hide_that_a_scene_is_flat() -> None:
    wall = np.column_stack([np.random.default_rng(0).uniform(-1, 1, (60, 2)), np.full(60, 5.0)])
    alone = scene_of(wall)
    wall[::10] *= 100 + np.arange(6)[:, None] * [20, 50, 1]
    assert alone.lacks == ("single plane seen head-on", "parallel views")
    views = scene_of(wall)
    assert views.lacks == alone.lacks
    assert views.relief == pytest.approx(0, abs=1e-9) and views.tilt_deg < 1e-3
    assert views.distance == pytest.approx(alone.distance, rel=0.02)


def test_a_drive_with_bends_is_no_pure_forward_motion() -> None:
    level = replace(GOOD, axes_deg=1.0)  # which looks one way
    assert replace(level, forward=0.8).lacks == ("parallel views",)
    assert replace(level, forward=0.98).lacks == ("pure forward motion",)
    assert replace(GOOD, forward=0.98).lacks == ()


def test_how_the_world_is_turned_does_not_matter() -> None:
    problem = at_truth("corridor", rig="stereo")
    world = Transform.exp(np.array([0.5, -1.0, 2.0]), np.array([3.0, 4.0, -5.0]))
    start = problem.initial
    turned = replace(
        start,
        rig_from_world=tuple(t @ world for t in start.rig_from_world),
        points=world.inverse @ start.points,
    )
    for a, b in zip(views_of(problem), views_of(replace(problem, initial=turned)), strict=True):
        for name in ("parallax_deg", "turn_deg", "roll_deg", "forward", "relief", "tilt_deg"):
            assert getattr(a, name) == pytest.approx(getattr(b, name), abs=1e-4)
        assert a.spread == pytest.approx(b.spread)


def test_too_little_motion_is_told_from_other_reasons() -> None:
    assert (why := too_little_motion(at_truth("static"))) and why.startswith("static rig")
    assert (why := too_little_motion(at_truth("panorama"))) and why.startswith("pure rotation")
    assert too_little_motion(at_truth("handheld")) is None


def test_words_carry_numbers() -> None:
    views = views_of(at_truth("nadir", "ground"))
    assert "% of its distance" in in_words("single plane seen head-on", views)
    assert "deg (rms)" in in_words("parallel views", views)
    ahead = views_of(at_truth("forward"))
    assert "100% of the motion" in in_words("pure forward motion", ahead)


def test_one_view_alone_is_no_motion() -> None:
    (views,) = views_of(walked(np.zeros((6, 3)), still()))
    assert isinstance(views, Views)
    assert views.lacks == ("static rig",)
    assert views.forward == 0

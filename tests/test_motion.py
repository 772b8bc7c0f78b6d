from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
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

"""Which tracks and frames a problem keeps, by hand-made scenes."""

from __future__ import annotations

import numpy as np
import pytest

from graphs.camera import Camera, nominal_params
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.problem import Estimate, Observations, Problem, residuals_px
from graphs.selection import MIN_TRACK_LENGTH, compact, parallax_deg, select_tracks
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

CAMERA = Camera("cam", "pinhole", (640, 480), nominal_params("pinhole", (640, 480), 500.0))


def problem_of(
    centres: list[FloatArray], points: FloatArray, seen: list[tuple[int, int]]
) -> Problem:
    """One camera that looks along z from each centre; `seen` are (frame, point)."""
    frames = tuple(Transform(np.eye(3), -np.asarray(c, float)) for c in centres)
    start = Estimate((CAMERA,), (Transform.identity(),), frames, points)
    frame, point = np.array(seen).T
    blank = Observations(np.zeros((len(seen), 2)), frame, np.zeros_like(frame), point)
    pixels = residuals_px(start, blank)
    observations = Observations(pixels, frame, blank.camera, point)
    return Problem(start, observations, tuple(f"f{i}" for i in range(len(frames))))


def every(frames: list[int], point: int) -> list[tuple[int, int]]:
    return [(frame, point) for frame in frames]


def test_parallax_is_the_widest_angle_by_hand() -> None:
    """Seen from -1, 0 and 1 at distance 1: 90 deg between the outer rays."""
    centres = [np.array([x, 0.0, 0.0]) for x in (-1, 0, 1)]
    problem = problem_of(centres, np.array([[0.0, 0, 1], [0, 0, 1e6]]), [
        *every([0, 1, 2], 0), *every([0, 1, 2], 1),
    ])  # fmt: skip
    np.testing.assert_allclose(parallax_deg(problem), [90, np.degrees(2e-6)], rtol=1e-6)


def test_parallax_counts_from_the_cameras_not_from_the_rig() -> None:
    """Two cameras of one frame, 2 apart, see a point 1 away at 90 deg, whatever the rig's turn."""
    rig = Transform(exp_rotation(np.array([0.1, 2.0, -0.4])), np.array([3.0, -1.0, 2.0]))
    second = Transform.exp(np.array([0.3, 0.2, 0.1]), np.zeros(3)) @ Transform(
        np.eye(3), np.array([-2.0, 0, 0])
    )
    point = rig.inverse @ np.array([[1.0, 0.0, 1.0]])
    start = Estimate((CAMERA, CAMERA), (Transform.identity(), second), (rig,), point)
    seen = Observations(np.zeros((2, 2)), np.zeros(2, int), np.array([0, 1]), np.zeros(2, int))
    np.testing.assert_allclose(parallax_deg(Problem(start, seen, ("f",))), [90])


def test_parallax_does_not_depend_on_the_order_of_observations() -> None:
    problem, _ = simulate_tracks(TrackOptions(frames=6, points=300), np.random.default_rng(0))
    order = np.random.default_rng(1).permutation(len(problem.observations))
    seen = problem.observations
    shuffled = Observations(
        seen.pixels[order], seen.frame[order], seen.camera[order], seen.point[order]
    )
    mixed = Problem(problem.initial, shuffled, problem.frame_names)
    np.testing.assert_allclose(parallax_deg(mixed), parallax_deg(problem))


def test_short_tracks_far_points_and_blind_frames_are_left_out() -> None:
    centres = [np.array([0.5 * i, 0.0, 0.0]) for i in range(6)]
    points = np.array([[0.0, 0, 4], [0, 0, 5], [0, 0, 1e5], [1, 0, 4]])
    problem = problem_of(centres, points, [
        *every([0, 1, 3], 0),  # kept
        *every([0, 1], 1),  # too short
        *every([0, 1, 2, 3, 4, 5], 2),  # too far
        *every([5, 3, 1], 3),  # kept
    ])  # fmt: skip
    selected = select_tracks(problem, 1.0)
    assert selected.frame_names == ("f0", "f1", "f3", "f5")
    np.testing.assert_array_equal(selected.initial.points, points[[0, 3]])
    assert len(selected.observations) == 6
    # what is left still looks at the same things
    assert np.abs(residuals_px(selected.initial, selected.observations)).max() < 1e-9
    kept = [(selected.frame_names[f], int(p)) for f, p in zip(
        selected.observations.frame, selected.observations.point, strict=True)]  # fmt: skip
    assert kept == [("f0", 0), ("f1", 0), ("f3", 0), ("f5", 1), ("f3", 1), ("f1", 1)]


def test_a_track_needs_three_views() -> None:
    assert MIN_TRACK_LENGTH == 3
    centres = [np.array([x, 0.0, 0.0]) for x in (0.0, 1.0)]
    problem = problem_of(centres, np.array([[0.0, 0, 3]]), every([0, 1], 0))
    with pytest.raises(ValueError, match=r"none of 1 points is seen 3 times with 2 deg"):
        select_tracks(problem, 2.0)


def test_the_threshold_on_parallax_is_in_degrees() -> None:
    centres = [np.array([x, 0.0, 0.0]) for x in (0.0, 0.05, 0.1)]
    problem = problem_of(centres, np.array([[0.05, 0, 1.0]]), every([0, 1, 2], 0))
    widest = float(np.degrees(2 * np.arctan(0.05)))
    assert len(select_tracks(problem, widest - 0.01).observations) == 3
    with pytest.raises(ValueError, match="move the camera sideways"):
        select_tracks(problem, widest + 0.01)


def test_compacting_with_everything_seen_changes_nothing() -> None:
    problem, _ = simulate_tracks(TrackOptions(frames=6, points=300), np.random.default_rng(0))
    again = compact(problem, problem.observations)
    assert again.frame_names == problem.frame_names and again.scales == problem.scales
    np.testing.assert_array_equal(again.initial.points, problem.initial.points)
    np.testing.assert_array_equal(again.observations.frame, problem.observations.frame)

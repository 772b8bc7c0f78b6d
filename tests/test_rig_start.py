"""One rig out of freely posed images: who agrees, who is named, and cameras that never meet."""

from __future__ import annotations

import numpy as np
import pytest

from graphs.frames import FloatArray, Transform, angle_between
from graphs.problem import Estimate, Observations, Problem, residuals_px
from graphs.rig_start import FreeModel, impose_rig, link_cameras, median_transform
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

TRACKS = TrackOptions(rig="triple", frames=16, points=1500, sigma_px=0.3, baseline_sigma_m=0.0)
FRAMES = tuple(f"{i:03d}" for i in range(TRACKS.frames))


def free_model(
    wrong: dict[tuple[int, int], Transform] | None = None,
    missing: set[tuple[int, int]] = frozenset(),  # type: ignore[assignment]
    noise: float = 1e-3,
) -> tuple[FreeModel, Estimate]:
    """Every image posed by itself, with a little noise; some are `wrong`, some are `missing`.

    `wrong` poses are put in front of the true ones; images are (camera, frame).
    """
    rng = np.random.default_rng(4)
    problem, true = simulate_tracks(TRACKS, rng)
    assert len(problem.frame_names) == TRACKS.frames
    poses = {}
    for frame, rig_from_world in enumerate(true.rig_from_world):
        for camera, cam_from_rig in enumerate(true.cam_from_rig):
            step = Transform.exp(noise * rng.standard_normal(3), noise * rng.standard_normal(3))
            poses[camera, frame] = step @ cam_from_rig @ rig_from_world
    for image, step in (wrong or {}).items():
        poses[image] = step @ poses[image]
    seen = problem.observations
    images = zip(seen.camera.tolist(), seen.frame.tolist(), strict=True)
    keep = np.array([image not in missing for image in images])
    poses = {image: pose for image, pose in poses.items() if image not in missing}
    return FreeModel(true.cameras, poses, true.points, seen.subset(keep)), true


def near(ours: Transform, true: Transform, tolerance: float) -> bool:
    turn = angle_between(ours.rotation, true.rotation)
    return max(turn, float(np.abs(ours.translation - true.translation).max())) < tolerance


ASIDE = Transform.exp(np.array([0.0, 0.4, 0.1]), np.array([0.5, 0.0, 0.2]))


# ---- the rig -------------------------------------------------------------------------------


def test_the_rig_is_the_median_over_frames() -> None:
    model, true = free_model()
    cam_from_rig, missing = link_cameras(model, reference=0)
    assert missing == []
    np.testing.assert_array_equal(cam_from_rig[0].rotation, np.eye(3))
    assert all(near(*pair, 2e-3) for pair in zip(cam_from_rig, true.cam_from_rig, strict=True))


def test_another_reference_gives_the_same_rig_seen_from_there() -> None:
    model, true = free_model()
    cam_from_rig, _ = link_cameras(model, reference=2)
    for ours, there in zip(cam_from_rig, true.cam_from_rig, strict=True):
        assert near(ours, there @ true.cam_from_rig[2].inverse, 3e-3)


def test_wrong_frames_do_not_move_the_rig() -> None:
    wrong = {(1, frame): ASIDE for frame in range(0, 16, 3)}
    model, true = free_model(wrong)
    cam_from_rig, _ = link_cameras(model, 0)
    assert near(cam_from_rig[1], true.cam_from_rig[1], 3e-3)


def test_a_camera_is_linked_through_a_third() -> None:
    """Camera 0 has frames 0-7, camera 2 frames 8-15, camera 1 all: 0 and 2 never meet."""
    missing = {(0, f) for f in range(8, 16)} | {(2, f) for f in range(8)}
    model, true = free_model(missing=missing)
    cam_from_rig, lost = link_cameras(model, 0)
    assert lost == []
    assert all(near(*pair, 4e-3) for pair in zip(cam_from_rig, true.cam_from_rig, strict=True))


def test_the_link_with_most_frames_is_taken() -> None:
    """0-2 meet once, wrongly; 0-1 and 1-2 meet often."""
    missing = {(0, f) for f in range(9, 16)} | {(2, f) for f in range(8)}
    model, true = free_model({(0, 8): ASIDE}, missing)
    cam_from_rig, _ = link_cameras(model, 0)
    assert near(cam_from_rig[2], true.cam_from_rig[2], 4e-3)


def test_cameras_that_share_no_frame_are_named() -> None:
    missing = {(c, f) for c in (0, 1) for f in range(8, 16)} | {(2, f) for f in range(8)}
    model, _ = free_model(missing=missing)
    cam_from_rig, lost = link_cameras(model, 0)
    assert lost == [2]
    assert len(cam_from_rig) == 3


def test_the_median_transform_ignores_a_third_gone_wild() -> None:
    rng = np.random.default_rng(0)
    true = Transform.exp(np.array([0.2, 1.0, -0.5]), np.array([0.3, -0.2, 0.1]))

    def moved(size: float) -> Transform:
        step = Transform.exp(size * rng.standard_normal(3), size * rng.standard_normal(3))
        return step @ true

    mixed = [moved(1e-3) for _ in range(20)] + [moved(1.0) for _ in range(10)]
    assert near(median_transform(mixed), true, 3e-3)


# ---- the frames ----------------------------------------------------------------------------


def lengths(problem: Problem) -> FloatArray:
    return np.linalg.norm(residuals_px(problem.initial, problem.observations), axis=1)


def test_an_undisturbed_model_is_taken_whole() -> None:
    model, true = free_model()
    problem, dropped = impose_rig(model, true.cam_from_rig, FRAMES, 0)
    assert dropped == []
    assert problem.frame_names == FRAMES and problem.reference == 0
    assert len(problem.observations) == len(model.observations)
    assert np.median(lengths(problem)) < 2.0
    placed = zip(problem.initial.rig_from_world, true.rig_from_world, strict=True)
    assert all(near(ours, there, 0.01) for ours, there in placed)


@pytest.mark.parametrize("camera", [0, 1, 2])
def test_images_that_contradict_the_rig_are_outvoted(camera: int) -> None:
    """A wrong pose, even the reference camera's, costs nothing: the frame takes another's."""
    model, true = free_model({(camera, 3): ASIDE, (camera, 11): ASIDE.inverse})
    problem, dropped = impose_rig(model, true.cam_from_rig, FRAMES, 0)
    assert dropped == []
    assert len(problem.observations) == len(model.observations)
    for frame in (3, 11):
        assert near(problem.initial.rig_from_world[frame], true.rig_from_world[frame], 0.01)


def test_images_taken_elsewhere_are_dropped_and_named() -> None:
    """Not only their poses but what they saw: another moment than the rest of the frame."""
    model, true = free_model()
    seen = model.observations
    pixels = seen.pixels.copy()
    odd = {(1, 5), (2, 9)}
    for camera, frame in odd:
        rows = (seen.camera == camera) & (seen.frame == frame)
        pixels[rows] += [120.0, -60.0]
    shifted = Observations(pixels, seen.frame, seen.camera, seen.point)
    model = FreeModel(model.cameras, model.cam_from_world, model.points, shifted)
    problem, dropped = impose_rig(model, true.cam_from_rig, FRAMES, 0)
    assert set(dropped) == odd
    left = set(
        zip(problem.observations.camera.tolist(), problem.observations.frame.tolist(), strict=True)
    )
    assert not left & odd
    assert lengths(problem).max() < 30


def test_frames_keep_their_names_when_others_are_missing() -> None:
    """Frame 2 has no image, frame 7 only camera 1's; dropped images are named by the scan's."""
    missing = {(c, 2) for c in range(3)} | {(0, 7), (2, 7)}
    model, true = free_model(missing=missing)
    seen = model.observations
    pixels = seen.pixels.copy()
    pixels[(seen.camera == 1) & (seen.frame == 9)] += 150.0
    shifted = Observations(pixels, seen.frame, seen.camera, seen.point)
    model = FreeModel(model.cameras, model.cam_from_world, model.points, shifted)
    problem, dropped = impose_rig(model, true.cam_from_rig, FRAMES, 0)
    assert dropped == [(1, 9)]
    assert problem.frame_names == tuple(name for i, name in enumerate(FRAMES) if i != 2)
    seventh = problem.frame_names.index("007")
    assert near(problem.initial.rig_from_world[seventh], true.rig_from_world[7], 0.01)
    np.testing.assert_array_equal(
        np.unique(problem.observations.camera[problem.observations.frame == seventh]), [1]
    )


def test_the_whole_way_with_wrong_images_ends_near_the_truth() -> None:
    wrong = {(1, 0): ASIDE, (0, 4): ASIDE, (2, 8): ASIDE, (1, 12): ASIDE.inverse}
    model, _ = free_model(wrong)
    cam_from_rig, _ = link_cameras(model, 0)
    problem, dropped = impose_rig(model, cam_from_rig, FRAMES, 0)
    assert dropped == []
    assert np.quantile(lengths(problem), 0.99) < 8

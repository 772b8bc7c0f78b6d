"""Simulated tracks: the stated noise, outliers and perturbations, and whole problems only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphs.frames import angle_between
from graphs.lenses import LENS_NAMES, LensName
from graphs.problem import residuals_px
from sfm_calib.errors import CalibrationError
from sfm_calib.result import load_calibration
from sfm_calib.simulate.tracks import (
    MIN_OBSERVATIONS_A_FRAME,
    TrackOptions,
    read_tracks,
    simulate_tracks,
    write_tracks,
)

TRACKS = TrackOptions(rig="stereo", frames=20, points=1500)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_true_residuals_have_the_stated_sigma(lens: LensName) -> None:
    options = TRACKS.model_copy(update={"lens": lens, "sigma_px": 0.7})
    problem, true = simulate_tracks(options, rng())
    residuals = residuals_px(true, problem.observations)
    assert np.isfinite(residuals).all()
    assert residuals.std() == pytest.approx(0.7, rel=0.03)
    assert np.abs(residuals.mean(0)).max() < 0.05


@pytest.mark.parametrize("kind", ["uniform", "heavy"])
def test_outliers_have_the_share_asked_for(kind: str) -> None:
    options = TRACKS.model_copy(
        update={"outlier_share": 0.2, "outlier_kind": kind, "sigma_px": 1e-6}
    )
    problem, true = simulate_tracks(options, rng())
    wrong = np.linalg.norm(residuals_px(true, problem.observations), axis=1) > 1e-3
    assert wrong.mean() == pytest.approx(0.2, abs=1e-3)


def test_the_initial_estimate_is_off_as_stated() -> None:
    problem, true = simulate_tracks(TRACKS, rng())
    for start, camera in zip(problem.initial.cameras, true.cameras, strict=True):
        assert start.params[0] == pytest.approx(1.03 * camera.params[0])
        assert start.params[1] == start.params[0]
        assert np.linalg.norm(start.params[2:4] - camera.params[2:4]) == pytest.approx(6.0)
        assert (start.params[4:] == 0).all()
    placed = list(zip(problem.initial.rig_from_world, true.rig_from_world, strict=True))
    angles = np.array([angle_between(a.rotation, b.rotation) for a, b in placed])
    assert np.rad2deg(np.sqrt(np.square(angles).mean() / 3)) == pytest.approx(1.0, rel=0.4)
    off = (problem.initial.points - true.points).std()
    assert off == pytest.approx(TRACKS.point_error_m, rel=0.1)
    first = problem.initial.cam_from_rig[0]
    np.testing.assert_array_equal(first.rotation, np.eye(3))
    np.testing.assert_array_equal(first.translation, np.zeros(3))
    (scale,) = problem.scales
    true_m = np.linalg.norm(true.cam_from_rig[1].inverse.translation)
    assert 0 < abs(scale.length_m - true_m) < 5 * scale.sigma_m


def test_tracks_keep_their_limits() -> None:
    options = TRACKS.model_copy(
        update={"max_points_per_image": 50, "max_track_frames": 6, "min_track_length": 4}
    )
    problem, true = simulate_tracks(options, rng())
    seen = problem.observations
    images = np.unique(np.stack([seen.frame, seen.camera]), axis=1, return_counts=True)[1]
    assert images.max() <= 50
    assert np.bincount(seen.point, minlength=len(true.points)).min() >= 4
    for point in range(len(true.points)):
        frames = seen.frame[seen.point == point]
        assert frames.max() - frames.min() < 6


def test_frames_that_see_next_to_nothing_are_left_out() -> None:
    options = TRACKS.model_copy(update={"points": 120, "max_track_frames": 5})
    problem, true = simulate_tracks(options, rng(1))
    seen = problem.observations
    assert len(problem.frame_names) == len(true.rig_from_world) < options.frames
    assert len(problem.initial.rig_from_world) == len(true.rig_from_world)
    counts = np.bincount(seen.frame, minlength=len(problem.frame_names))
    assert counts.min() >= MIN_OBSERVATIONS_A_FRAME
    assert np.abs(residuals_px(true, seen)).max() < 6 * options.sigma_px


def test_same_seed_gives_same_tracks(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_tracks(*simulate_tracks(TRACKS, rng(7)), tmp_path / name)
    for name in ("tracks.npz", "truth.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize("rig", ["mono", "triple"])
def test_tracks_survive_the_file(rig: str, tmp_path: Path) -> None:
    problem, true = simulate_tracks(TRACKS.model_copy(update={"rig": rig}), rng())
    write_tracks(problem, true, tmp_path)
    again, true_again = read_tracks(tmp_path)
    np.testing.assert_array_equal(
        residuals_px(true_again, again.observations), residuals_px(true, problem.observations)
    )
    np.testing.assert_array_equal(
        residuals_px(again.initial, again.observations),
        residuals_px(problem.initial, problem.observations),
    )
    assert again.scales == problem.scales
    assert again.frame_names == problem.frame_names
    calibration = load_calibration(tmp_path / "truth.json")
    np.testing.assert_array_equal(calibration.camera("cam0").params, true.cameras[0].params)


def test_tracks_of_old_hold_one_flat_baseline(tmp_path: Path) -> None:
    problem, true = simulate_tracks(TRACKS, rng())
    write_tracks(problem, true, tmp_path)
    with np.load(tmp_path / "tracks.npz") as arrays:
        old = {name: arrays[name] for name in arrays.files}
    for name in ("scale", "scale_cameras"):
        (old[name],) = old[name]
    np.savez_compressed(tmp_path / "tracks.npz", **old)
    assert read_tracks(tmp_path)[0].scales == problem.scales != ()


def test_scales_survive_the_file(tmp_path: Path) -> None:
    problem, true = simulate_tracks(TRACKS.model_copy(update={"noise_by_scale": True}), rng())
    scale = problem.observations.feature_scale
    assert scale is not None and scale.shape == (len(problem.observations),)
    write_tracks(problem, true, tmp_path)
    np.testing.assert_array_equal(read_tracks(tmp_path)[0].observations.feature_scale, scale)
    plain, true = simulate_tracks(TRACKS, rng())
    write_tracks(plain, true, tmp_path)
    assert read_tracks(tmp_path)[0].observations.feature_scale is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 0}, "frames is 0: give 1"),
        ({"points": 0}, "points is 0: give 1"),
        ({"min_track_length": 1}, "min_track_length is 1: give 2"),
        ({"size": (32, 480)}, "32 x 480 px: give"),
        ({"outlier_share": 1.0}, "outlier_share is 1.0: give"),
        ({"sigma_px": -0.5}, "sigma_px is -0.5: give"),
        ({"focal_error": -1.0}, "focal_error is -1.0: give"),
        ({"frames": 1, "rig": "mono"}, "no point of 1500 is seen 3 times in 1 frames: give"),
    ],
)
def test_impossible_tracks_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        simulate_tracks(TRACKS.model_copy(update=change), rng())


@pytest.mark.parametrize("content", [None, b"", b"no tracks at all", b"PK\x03\x04 cut short"])
def test_files_that_hold_no_tracks_are_refused(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "tracks.npz").write_bytes(content)
    with pytest.raises(CalibrationError, match=r"tracks\.npz"):
        read_tracks(tmp_path)

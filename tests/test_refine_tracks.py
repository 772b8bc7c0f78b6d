"""Tracks measured anew: the noise that is left, what is matched again, and what is refused."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic.problems import perturbed, with_tracks
from synthetic.scans import silent
from synthetic.walls import CAMERA, DISTANCES, NORMALS, Scene, scene

import sfm_calib.refine
from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.problem import Observations, Problem, residuals_px
from graphs.refine import refine
from sfm_calib.cache import Cache
from sfm_calib.calibrate import checked_scan
from sfm_calib.cli import main
from sfm_calib.config import Options
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan, ScanImage
from sfm_calib.patches import rounds
from sfm_calib.patches.rounds import (
    BENT,
    Job,
    State,
    load_state,
    match_in_rounds,
    medians,
    to_be_matched,
)
from sfm_calib.patches.warps import HALF, warps_of
from sfm_calib.refine import Refined, images_of, refine_tracks

needs_torch = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("torch", "kornia")),
    reason="torch and kornia are an extra: pip install 'sfm_calib[learned]'",
)
OPTIONS = Options(refine=True)


@cache
def drawn() -> Scene:
    return scene(n_frames=7, n_points=170, noise=2.0, keypoint_px=0.35)


def scan_of(images: list[np.ndarray], folder: Path) -> Scan:
    names = tuple(f"{index:06d}" for index in range(len(images)))
    for name, image in zip(names, images, strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), image)
    return Scan(
        folder, (CAMERA.name,), (CAMERA.size,), names,
        tuple(ScanImage(0, index, f"{name}.png") for index, name in enumerate(names)),
    )  # fmt: skip


def started(one: Scene) -> Problem:
    """The keypoints, from a start some pixels off the truth."""
    rng = np.random.default_rng(0)
    return replace(one.problem, initial=perturbed(one.true.initial, 0, 0.3, rng))


def refined(one: Scene, folder: Path, images: list[np.ndarray] | None = None) -> Refined:
    scan = scan_of(images or one.images, folder)
    return refine_tracks(
        started(one), scan, GraphOptions(), OPTIONS, Cache(folder / "cache"), silent
    )


def errors_of_lens(problem: Problem) -> FloatArray:
    found = refine(problem, GraphOptions(), 1.0).estimate.cameras[0].params
    return found - CAMERA.params


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Refined]:
    folder = tmp_path_factory.mktemp("walls")
    return folder, refined(drawn(), folder)


@needs_torch
def test_tracks_are_sharper_and_so_is_the_lens(once: tuple[Path, Refined]) -> None:
    one, (_, found) = drawn(), once
    before = refine(started(one), GraphOptions(), 1.0)
    after = refine(found.problem, GraphOptions(), 1.0)
    assert before.sigma_px == pytest.approx(0.35, rel=0.15)
    assert after.sigma_px < before.sigma_px / 5
    assert len(found.problem.observations) > 0.95 * found.n_before
    assert found.moved_px == pytest.approx(0.35 * 1.18, rel=0.25)  # as far as keypoints err
    assert f"{found.n_before:,} observations" in found.message
    focal, centre = slice(0, 2), slice(2, 4)
    ours, theirs = errors_of_lens(found.problem), errors_of_lens(started(one))
    for part in (focal, centre):
        assert np.linalg.norm(ours[part]) < 0.5 * np.linalg.norm(theirs[part])
    # each observation says how well it is known, and is
    for noise in after.noise:
        assert noise.kind == "matched"
        assert 0.75 * noise.smallest_px < noise.sigma_px < 1.25 * noise.largest_px


@needs_torch
def test_what_was_matched_is_not_matched_again(
    once: tuple[Path, Refined], monkeypatch: pytest.MonkeyPatch
) -> None:
    one, (folder, first) = drawn(), once

    def never(*arguments: object) -> None:
        raise AssertionError("matched again")

    monkeypatch.setattr(sfm_calib.refine, "run_apart", never)
    again = refined(one, folder)
    np.testing.assert_array_equal(
        first.problem.observations.pixels, again.problem.observations.pixels
    )


@needs_torch
def test_images_of_something_else_are_refused(tmp_path: Path) -> None:
    one = drawn()
    rng = np.random.default_rng(1)
    others = [rng.integers(0, 255, image.shape).astype(np.uint8) for image in one.images]
    with pytest.raises(CalibrationError, match=r"only \d+ of 1,\d+ observations look alike"):
        refined(one, tmp_path, others)


@needs_torch
def test_tracks_that_look_different_now_are_matched_again() -> None:
    one = scene(n_frames=7, n_points=170, scale=9.0)  # what is coarse bends
    seen = one.true.observations
    start, points = one.true.initial, one.true.initial.points
    walls = NORMALS[np.abs(points @ NORMALS.T - DISTANCES).argmin(1)]
    facing, true = (warps_of(start, seen, seen.pixels, of) for of in (None, -walls))
    state = replace(State.before(one.true), bend=true.bend, fitted=true.linear)
    assert len(to_be_matched(state, 0)) == len(seen)
    assert not len(to_be_matched(state, 1))
    # matched as if the walls faced the cameras, and how patches had to be changed tells otherwise
    again = to_be_matched(replace(state, bend=facing.bend), 2)
    off = HALF**2 * np.abs(true.bend - facing.bend).max((1, 2))
    of_track = np.zeros(len(points))
    np.maximum.at(of_track, seen.point, off)
    clearly, hardly = of_track[seen.point] > 1.1 * BENT, of_track[seen.point] < 0.9 * BENT
    assert clearly.mean() > 0.1 and hardly.mean() > 0.1
    assert np.isin(np.flatnonzero(clearly), again).all()
    assert not np.isin(np.flatnonzero(hardly), again).any()
    lost = np.flatnonzero(seen.point == 9)[0]
    good = np.arange(len(seen)) != lost
    again = to_be_matched(replace(state, good=good), 1)
    np.testing.assert_array_equal(again, np.flatnonzero(seen.point == 9))
    assert not len(to_be_matched(replace(state, good=good), 2))  # once is enough


@needs_torch
def test_what_was_lost_is_looked_for_where_the_cameras_then_show_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keypoints eight pixels off are out of reach, until the others have placed the cameras."""
    one, scan = drawn(), scan_of(drawn().images, tmp_path)
    seen = one.problem.observations
    astray = np.arange(len(seen)) % 9 == 4
    pixels = seen.pixels + 8.0 * astray[:, None] * [0.6, -0.8]
    start = perturbed(one.true.initial, 0, 1.5, np.random.default_rng(0))
    rough = replace(one.problem, initial=start, observations=replace(seen, pixels=pixels))
    paths = [scan.root / image.path for image in scan.images]
    job = Job(rough, seen.frame, paths, GraphOptions(), 1.0, "cpu")

    def found(most_rounds: int) -> State:
        monkeypatch.setattr(rounds, "MOST_ROUNDS", most_rounds)
        match_in_rounds(job, 2, tmp_path, silent)
        return load_state(rough, tmp_path)

    first, last = found(1), found(3)
    assert first.good[~astray].mean() > 0.95 and first.good[astray].mean() < 0.3
    assert last.good[astray].mean() > 0.9
    off = np.linalg.norm(last.pixels - one.true.observations.pixels, axis=1)
    assert np.median(off[astray & last.good]) < 0.6  # a track lies where its keypoints lay


@needs_torch
def test_a_spot_with_two_orientations_is_one_track(
    once: tuple[Path, Refined], tmp_path: Path
) -> None:
    one = drawn()
    twins = one.problem.observations.subset(one.problem.observations.point < 20)
    doubled = with_tracks(one.problem, one.true.initial.points[:20], twins)
    again = refined(replace(one, problem=doubled), tmp_path)
    ours, without = again.problem.observations, once[1].problem.observations
    assert len(again.problem.initial.points) == len(once[1].problem.initial.points)
    assert len(ours) == pytest.approx(len(without), abs=3)


def test_an_observation_is_looked_at_in_its_own_image() -> None:
    """Of a rig whose second camera lacks a frame, in a scan with a frame that was not placed."""
    one = drawn()
    images = [(0, 0), (1, 0), (0, 1), (0, 2), (1, 2), (0, 3), (1, 3)]  # camera, frame
    scan = Scan(
        Path(), ("a", "b"), (CAMERA.size,) * 2, ("w", "x", "y", "z"),
        tuple(ScanImage(c, f, f"{c}/{f}.png") for c, f in images),
    )  # fmt: skip
    camera, frame = np.array([0, 1, 0, 1, 1]), np.array([2, 1, 0, 2, 0])
    pixels, point = np.zeros((5, 2)), np.zeros(5, np.int64)
    seen = Observations(pixels, frame, camera, point)
    problem = replace(one.problem, observations=seen, frame_names=("w", "y", "z"))
    named = [scan.images[i].path for i in images_of(problem, scan)]
    assert named == ["0/3.png", "1/2.png", "0/0.png", "1/3.png", "1/0.png"]


def test_a_median_is_that_of_its_label() -> None:
    rng = np.random.default_rng(0)
    values, label = rng.standard_normal(101), rng.integers(0, 9, 101)
    expected = [np.quantile(values[label == k], 0.5, method="lower") for k in label]
    np.testing.assert_allclose(medians(values, label), expected)


def test_measured_pixels_are_those_of_the_match() -> None:
    one = drawn()
    state = State.before(one.true)
    n = len(state.good)
    cov_px = np.broadcast_to(np.array([[4e-4, 1e-4], [1e-4, 9e-4]]), (n, 2, 2))
    good = np.arange(n) % 5 != 0
    state = replace(state, cov_px=cov_px, good=good, pixels=state.pixels + 0.25)
    seen = state.measured().subset(good)
    assert seen.noise_shape is not None and seen.matched_sigma_px is not None
    whole = seen.noise_shape * seen.matched_sigma_px[:, None, None] ** 2
    np.testing.assert_allclose(whole, cov_px[good] + 1e-4 * np.eye(2))
    np.testing.assert_allclose(residuals_px(one.true.initial, seen), -0.25, atol=1e-9)


# ---- without torch --------------------------------------------------------------------------


def test_without_torch_one_line_says_so_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scan").mkdir()
    for index in range(3):
        cv2.imwrite(str(tmp_path / "scan" / f"{index}.png"), np.zeros((40, 40), np.uint8))
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "torch" else find(name)
    )
    out = tmp_path / "out"
    assert main(["calibrate", str(tmp_path / "scan"), "-o", str(out), "--refine"]) == 2
    said = capsys.readouterr().err
    assert "--refine needs torch and kornia: pip install 'sfm_calib[learned]'" in said
    assert "Traceback" not in said and not out.exists()


def test_a_plain_calibration_does_not_ask_for_torch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    scan = scan_of(drawn().images[:3], tmp_path)
    from sfm_calib.calibrate import Stopwatch
    from sfm_calib.config import RigConfig

    read = checked_scan(scan.root, RigConfig(), Cache(tmp_path / "cache"), silent, Stopwatch())
    assert len(read.images) == 3

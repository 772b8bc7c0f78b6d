"""Tracks measured anew: the noise that is left, what is matched again, and what is refused."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic.problems import perturbed
from synthetic.scans import silent
from synthetic.walls import CAMERA, Scene, scene

import sfm_calib.refine
from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.problem import Problem, residuals_px
from graphs.refine import refine
from sfm_calib.cache import Cache
from sfm_calib.calibrate import checked_scan
from sfm_calib.cli import main
from sfm_calib.config import Options
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan, ScanImage
from sfm_calib.patches.rounds import State, medians, to_be_matched
from sfm_calib.patches.warps import warps_of
from sfm_calib.refine import Refined, refine_tracks

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
    one, seen = drawn(), drawn().true.observations
    state = replace(
        State.before(one.true),
        bend=warps_of(one.true.initial, seen, seen.pixels).bend,
    )
    assert len(to_be_matched(state, 0)) == len(seen)
    assert not len(to_be_matched(state, 1))
    points = one.true.initial.points.copy()
    points[5] *= 0.8  # a fifth nearer: seen from other sides
    moved = replace(one.true, initial=replace(one.true.initial, points=points))
    again = to_be_matched(replace(state, now=moved), 2)
    np.testing.assert_array_equal(again, np.flatnonzero(seen.point == 5))
    lost = np.flatnonzero(seen.point == 9)[0]
    good = np.arange(len(seen)) != lost
    again = to_be_matched(replace(state, good=good), 1)
    np.testing.assert_array_equal(again, np.flatnonzero(seen.point == 9))
    assert not len(to_be_matched(replace(state, good=good), 2))  # once is enough


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

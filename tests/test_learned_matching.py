"""Learned features and their matches in COLMAP's database, and what may not be asked for."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from synthetic.networks import random_lightglue, random_weights
from synthetic.scans import picture, silent

from graphs.frames import Transform
from graphs.noise import noise_classes, with_class_sigmas
from sfm_calib import colmap, colmap_matches, mapping, torch_import
from sfm_calib.cache import Cache
from sfm_calib.cli import main
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import read_scan
from sfm_calib.learned import extract, matching
from sfm_calib.learned.choice import check_choice, check_torch_of, choose
from sfm_calib.learned.extract import LearnedFeatures
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

needs_torch = pytest.mark.skipif(
    any(torch_import.importlib.util.find_spec(name) is None for name in torch_import.PACKAGES),
    reason="the extra `learned` is not installed",
)


def features(n, width=16, seed=0):
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(n, width)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return LearnedFeatures(rng.uniform(0, 60, (n, 2)), descriptors)


@needs_torch
@pytest.mark.parametrize("at_once", [2048, 7])
def test_the_nearest_match_where_they_are_each_others_and_clearly_so(at_once, monkeypatch):
    monkeypatch.setattr(matching, "ROWS_AT_ONCE", at_once)
    a = features(40)
    order = np.random.default_rng(1).permutation(30)
    b = LearnedFeatures(a.pixels[order], a.descriptors[order])
    match = matching.nearest_matcher("cpu")
    found = match(a, b, (64, 64), (64, 64))
    np.testing.assert_array_equal(found, np.stack([np.sort(order), np.argsort(order)], 1))
    for ratio, count in ((0.88, 1), (0.92, 0)):  # of how far the nearest is, and the next
        angles = np.array([0.2 * ratio, -0.2])
        two = np.stack([np.cos(angles), np.sin(angles)], 1).astype(np.float32)
        one = LearnedFeatures(np.ones((2, 2)), np.array([[1, 0], [-1, 0]], np.float32))
        candidates = LearnedFeatures(np.ones((2, 2)), two)
        assert len(match(one, candidates, (64, 64), (64, 64))) == count
    assert match(a, a.strongest(1), (64, 64), (64, 64)).shape == (0, 2)
    assert match(a.strongest(0), a, (64, 64), (64, 64)).shape == (0, 2)


@needs_torch
def test_lightglue_takes_the_strongest_and_answers_in_their_numbers(tmp_path, monkeypatch):
    monkeypatch.setattr(matching, "LIGHTGLUE_FEATURES", 20)
    path = random_lightglue("xfeat", tmp_path)
    match = matching.lightglue_matcher("xfeat", path, "cpu")
    a = features(30, 64)
    found, again = (match(a, a, (64, 64), (64, 64)) for _ in range(2))
    np.testing.assert_array_equal(found, again)
    assert found.shape[1] == 2 and found.dtype == np.int64 and (found < 20).all()
    assert match(a, a.strongest(0), (64, 64), (64, 64)).shape == (0, 2)


def panning(place, n=3, step=13, size=(160, 128)):
    """A scan whose views are of one texture, each `step` px to the right of the one before."""
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 255, (size[1], size[0] + n * step, 3)).astype(np.uint8)
    wide = cv2.normalize(cv2.GaussianBlur(wide, (0, 0), 1.5), None, 0, 255, cv2.NORM_MINMAX)
    place.mkdir()
    for i in range(n):  # a blank in a name, which COLMAP's lists of pairs do not take
        cv2.imwrite(str(place / f"view {i}.png"), wide[:, i * step : i * step + size[0]])
    return read_scan(place, Cache(place.parent / "none"), "stem", 10, silent)


@needs_torch
def test_features_and_matches_reach_colmaps_database(tmp_path):
    scan, place, matches = panning(tmp_path / "scan"), tmp_path / "features", tmp_path / "matches"
    weights = random_weights("disk", tmp_path)
    config = RigConfig(features="disk", weights=weights, max_features=200, pairs="all")
    learned = choose(config)
    for folder in (place, matches):
        folder.mkdir()
    mapping._extract(scan, config, ["radtan"], {}, learned, place, silent)
    said = []
    mapping._match(scan, config, place, learned, matches, lambda *step: said.append(step))
    database = matches / mapping.DATABASE
    assert not (matches / extract.FOLDER).exists()
    with pycolmap.Database.open(database) as db:
        assert [image.name for image in db.read_all_images()] == [i.path for i in scan.images]
        assert not db.read_all_cameras()[0].has_prior_focal_length
        stored = [db.read_keypoints(number) for number in (1, 2, 3)]
    for index, keypoints in enumerate(stored):
        found = extract.load(place, index)
        assert 100 < len(found) <= 200
        np.testing.assert_allclose(keypoints, found.pixels + 0.5, atol=1e-4)
    counts = colmap_matches.match_counts(scan, database)
    assert set(counts) == {(0, 1), (0, 2), (1, 2)} and min(counts.values()) > 30
    assert [step for step in said if step[1] == step[2]] == [
        ("matching", 3, 3),
        ("verifying matches", 3, 3),
    ]
    with pycolmap.Database.open(database) as db:
        kept = db.read_two_view_geometry(1, 2).inlier_matches
    moved = stored[0][kept[:, 0]] - stored[1][kept[:, 1]]
    np.testing.assert_allclose(np.median(moved, 0), [13, 0], atol=0.05)


def test_verification_drops_what_no_geometry_explains_and_sizes_are_unknown(tmp_path):
    scan = panning(tmp_path / "scan")
    database = tmp_path / "database.db"
    colmap.import_images(scan, ["pinhole"], {}, database)
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (60, 3))
    moved = Transform.exp(np.array([0.0, 0.1, 0.0]), np.array([0.5, 0.0, 0.1]))
    views = [p[:, :2] / p[:, 2:] * 150 + [80, 64] for p in (points, moved @ points)]
    views[1][40:] = rng.uniform([0, 0], [160, 128], (20, 2))
    with colmap.keypoint_writer(database) as write:
        for image, pixels in zip(scan.images, views, strict=False):
            write(image.path, pixels)
    with colmap_matches.match_writer(database) as write_matches:
        paths = [image.path for image in scan.images]
        write_matches(*paths[:2], np.stack([np.arange(60)] * 2, 1))
    colmap_matches.verify_matches(scan, [(0, 1)], database, 0, silent)
    with pycolmap.Database.open(database) as db:
        kept = np.asarray(db.read_two_view_geometry(1, 2).inlier_matches)[:, 0]
    assert set(range(40)) <= set(kept.tolist()) and len(kept) < 50
    assert all(np.isnan(sizes).all() for sizes in colmap.keypoint_scales(database).values())


def test_keypoints_of_unknown_size_are_one_class_of_noise():
    problem, _ = simulate_tracks(TrackOptions(frames=6, points=300), np.random.default_rng(0))
    seen = problem.observations
    unknown = replace(problem, observations=replace(seen, feature_scale=np.full(len(seen), np.nan)))
    residuals = np.random.default_rng(0).normal(0, 0.3, (len(seen), 2))
    classes = noise_classes(unknown, residuals)
    assert len(classes) == len(problem.initial.cameras)
    assert all((c.smallest_px, c.largest_px) == (0.0, np.inf) for c in classes)
    assert sum(c.count for c in classes) == len(seen)
    relative = with_class_sigmas(unknown, residuals).observations.relative_sigma
    assert np.isfinite(relative).all()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (
            {"matcher": "lightglue"},
            "matcher lightglue is for learned features, and features is sif",
        ),
        (
            {"weights": "xfeat.pt"},
            "weights xfeat.pt is given, and features is sift, which needs no",
        ),
    ],
    ids=["matcher", "weights"],
)
def test_what_does_not_go_together_is_refused(asked, said):
    with pytest.raises(CalibrationError, match=said):
        check_choice(RigConfig(**asked))
    check_choice(RigConfig(matcher="nearest", device="cuda"))


@pytest.mark.parametrize("missing", ["torch", "kornia"])
def test_without_the_extra_one_line_says_what_to_install(missing, monkeypatch):
    there = torch_import.importlib.util.find_spec
    monkeypatch.setattr(
        torch_import.importlib.util, "find_spec", lambda n: None if n == missing else there("os")
    )
    with pytest.raises(
        CalibrationError, match=r"features disk needs torch and kornia: pip install"
    ):
        check_choice(RigConfig(features="disk"))
    check_choice(RigConfig())


def refusal(arguments, capsys):
    assert main([str(argument) for argument in arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("sfm-calib: ")
    return error


def scan_of_noise(place):
    for number in range(3):
        picture(place / "scan" / f"{number}.png", (64, 48), seed=number)
    return place / "scan"


def test_commands_say_what_they_cannot_do(tmp_path, capsys):
    scan, out = scan_of_noise(tmp_path), tmp_path / "out"
    line = refusal(["calibrate", scan, "-o", out, "--matcher", "lightglue"], capsys)
    assert "add --features aliked" in line
    old = tmp_path / "old.yaml"
    old.write_text(
        "cam0:\n  camera_model: pinhole\n  intrinsics: [60, 60, 32, 24]\n"
        "  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [64, 48]\n"
    )
    line = refusal(["recalibrate", old, scan, "-o", out, "--features", "xfeat"], capsys)
    assert "recalibrate tracks SIFT features alone, and features is xfeat" in line


@needs_torch
def test_weights_that_are_no_weights_are_one_line(tmp_path, capsys):
    scan, out = scan_of_noise(tmp_path), tmp_path / "out"
    ask = ["calibrate", scan, "-o", out, "--features", "xfeat", "--weights"]
    assert "there is no such file or folder" in refusal([*ask, tmp_path / "gone.pt"], capsys)
    (tmp_path / "text.pt").write_text("not weights")
    assert "text.pt holds no weights that torch can" in refusal(
        [*ask, tmp_path / "text.pt"], capsys
    )


@needs_torch
@pytest.mark.parametrize(
    ("change", "first"),
    [
        ({}, None),
        ({"loss": "huber"}, None),
        ({"features": "disk"}, "_extract"),
        ({"features": "sift", "weights": None}, "_extract"),
        ({"weights": "other.pt"}, "_extract"),
        ({"device": "cuda"}, "_extract"),
        ({"matcher": "lightglue"}, "_match"),
        ({"matcher": "nearest"}, None),
    ],
    ids=str,
)
def test_stages_know_what_made_them(tmp_path, monkeypatch, change, first):
    scan = read_scan(scan_of_noise(tmp_path), Cache(tmp_path / "none"), "stem", 10, silent)
    for name in ("one.pt", "other.pt", "xfeat-lighterglue.pt"):
        (tmp_path / name).write_text(name)
    monkeypatch.setattr(mapping, "run_apart", lambda work, *_: done.append(work.__name__))
    monkeypatch.setattr(mapping.colmap, "read_models", lambda place: [][0])
    monkeypatch.setattr(
        "sfm_calib.learned.choice.find_matcher", lambda *_: tmp_path / "xfeat-lighterglue.pt"
    )
    asked = {"features": "xfeat", "weights": "one.pt"}
    for options in (asked, asked | change):
        done = []
        given = options["weights"]
        config = RigConfig(**options | {"weights": given and tmp_path / given})
        with pytest.raises(IndexError):
            mapping.map_scan(scan, config, ["radtan"], {}, Cache(tmp_path / "cache"), silent)
    every = ["_extract", "_match", "map_matched"]
    assert done == (every[every.index(first) :] if first else [])


def test_sift_imports_no_torch():
    code = (
        "import sys, sfm_calib.cli, sfm_calib.worker, sfm_calib.mapping, sfm_calib.guided\n"
        "from sfm_calib.learned.choice import choose; from sfm_calib.config import RigConfig\n"
        "assert choose(RigConfig()) is None\n"
        "assert not {'torch', 'kornia'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@needs_torch
def test_learned_features_leave_the_main_process_without_torch(tmp_path):
    """Networks run in a worker, as COLMAP does."""
    path = tmp_path / "xfeat.pt"
    path.write_bytes(b"weights")
    code = (
        "import sys, pathlib; from sfm_calib.learned.choice import choose\n"
        "from sfm_calib.config import RigConfig\n"
        f"asked = RigConfig(features='xfeat', weights=pathlib.Path({str(path)!r}))\n"
        "assert choose(asked).features_from\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_device_that_nothing_asks_for_or_nobody_has_is_one_line():
    with pytest.raises(CalibrationError, match="nothing asks for torch: add --refine"):
        check_torch_of(RigConfig(device="cuda"))
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    for asked in ({"refine": True}, {"features": "xfeat"}):
        with pytest.raises(CalibrationError, match="finds no GPU that it can use here"):
            check_torch_of(RigConfig(device="cuda", **asked))

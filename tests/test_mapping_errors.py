"""Scans that cannot be mapped: which camera, how few matches, what to do; and what is reused."""

import shutil

import cv2
import pytest
from synthetic.scans import QUICK, blank, panning_frames, picture, silent, simulation

from sfm_calib import mapping, pairs
from sfm_calib.cache import Cache
from sfm_calib.cli import main
from sfm_calib.config import RigConfig
from sfm_calib.images import read_scan
from sfm_calib.mapping import map_scan


def refusal(scan, out, capsys):
    assert main(["calibrate", str(scan), "-o", str(out), *QUICK]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and not (out / "calibration.json").exists()
    *progress, last = printed.err.splitlines()
    assert last.startswith("sfm-calib: ") and not any("sfm-calib" in line for line in progress)
    return last


@pytest.fixture
def good(tmp_path):
    shutil.copytree(simulation() / "scan", tmp_path / "scan")
    for path in tmp_path.glob("scan/*/00000[567].png"):
        path.unlink()
    return tmp_path / "scan"


@pytest.mark.slow
def test_a_camera_that_never_registers_is_named(tmp_path, good, capsys):
    for number, path in enumerate(sorted((good / "cam1").iterdir())):
        picture(path, size=(320, 240), seed=number)
    message = refusal(good, tmp_path / "out", capsys)
    assert "camera cam1 could not be placed" in message and "0 of its 5 images" in message
    assert "at most 0 matches among its own images and 0 with other cameras" in message


@pytest.mark.slow
def test_a_blank_reference_camera_is_named_and_not_the_good_one(tmp_path, good, capsys):
    for path in (good / "cam0").iterdir():
        blank(path)
    message = refusal(good, tmp_path / "out", capsys)
    assert "camera cam0 could not be placed" in message and "0 of its 5 images" in message


def test_images_that_do_not_overlap(tmp_path, capsys):
    blank(tmp_path / "scan" / "0.png")
    for number in (1, 2, 3):
        picture(tmp_path / "scan" / f"{number}.png", size=(320, 240), seed=number)
    message = refusal(tmp_path / "scan", tmp_path / "out", capsys)
    assert "no two of the 4 images overlap: the best pair has 0" in message
    assert not (tmp_path / "out" / "cache" / "matches").exists()


@pytest.mark.slow
def test_a_camera_that_does_not_move(tmp_path, good, capsys):
    (tmp_path / "static").mkdir()
    for number in range(4):
        shutil.copy(good / "cam0" / "000000.png", tmp_path / "static" / f"{number}.png")
    message = refusal(tmp_path / "static", tmp_path / "out", capsys)
    assert "none of 4 images could be placed" in message and "6 pairs match" in message
    assert "move the camera sideways" in message


def test_it_is_said_where_likely_pairs_alone_were_matched(tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "OWN_STEPS", (1,))
    monkeypatch.setattr(pairs, "RANKS", (0,))
    (tmp_path / "scan").mkdir()
    for number, image in enumerate(panning_frames(6, size=(160, 120))):
        assert cv2.imwrite(str(tmp_path / "scan" / f"{number}.png"), image)
    scan = read_scan(tmp_path / "scan", Cache(tmp_path / "cache"), "stem", 10, silent)
    folders = [tmp_path / name for name in ("features", "selected", "all")]
    for folder in folders:
        folder.mkdir()
    config = RigConfig(max_features=200)
    mapping._extract(scan, config, ["radtan"], {}, None, folders[0], silent)
    for folder in folders[1:]:
        chosen = config.model_copy(update={"pairs": folder.name})
        mapping._match(scan, chosen, folders[0], None, folder, silent)
    (said,) = mapping._unmatched(scan, folders[1])
    n_pairs = int(said.split()[0])
    assert 5 <= n_pairs < 15 and "of 15 pairs" in said and "--pairs all" in said
    assert mapping._unmatched(scan, folders[2]) == ()


@pytest.mark.parametrize(
    ("change", "first"),
    [
        ({}, None),
        ({"loss": "huber", "min_parallax_deg": 2.0, "aspect_sigma": 0.1}, None),
        ({"reference": "right"}, None),
        ({"seed": 1}, "_match"),
        ({"pairs": "all"}, "_match"),
        ({"max_features": 500}, "_extract"),
        ("lens", "_extract"),
        ("image", "_extract"),
        ("touched image", None),
        ("image gone", "_extract"),
        ("fresh", "_extract"),
    ],
    ids=str,
)
def test_stages_are_redone_exactly_when_their_inputs_changed(tmp_path, monkeypatch, change, first):
    for camera in ("left", "right"):
        for number in range(3):
            picture(tmp_path / "scan" / camera / f"{number}.png", seed=number)

    def read():
        return read_scan(tmp_path / "scan", Cache(tmp_path / "other"), "stem", 10, silent)

    def reach_the_models(config, lens, fresh=False):
        done = []
        monkeypatch.setattr(mapping, "run_apart", lambda work, *_: done.append(work.__name__))
        monkeypatch.setattr(mapping.colmap, "read_models", lambda place: [][0])
        with pytest.raises(IndexError):
            map_scan(read(), config, [lens] * 2, {}, Cache(tmp_path / "cache", fresh), silent)
        return done

    assert reach_the_models(RigConfig(), "radtan") == ["_extract", "_match", "map_matched"]
    lens, image = "radtan", tmp_path / "scan" / "left" / "1.png"
    if change == "lens":
        lens = "pinhole"
    elif change == "image":
        picture(image, seed=9)
    elif change == "touched image":
        image.write_bytes(image.read_bytes())
    elif change == "image gone":
        image.unlink()
    config = RigConfig(**change) if isinstance(change, dict) else RigConfig()
    every = ["_extract", "_match", "map_matched"]
    expected = every[every.index(first) :] if first else []
    assert reach_the_models(config, lens, change == "fresh") == expected

"""`sfm-calib check`: says what it finds, keeps what it made, and nothing is asked twice."""

from __future__ import annotations

import json
import re
import shutil
import tempfile

import cv2
import pytest
from synthetic.scans import QUICK, panning_frames, picture, silent, simulation

from sfm_calib import check
from sfm_calib.cache import Cache
from sfm_calib.check import check_scan
from sfm_calib.cli import main
from sfm_calib.config import Options, RigConfig
from sfm_calib.errors import BrokenDownError, CalibrationError

# ---- the story ---------------------------------------------------------------------------------


@pytest.fixture
def pan(tmp_path):
    """A scan of one camera whose views shift sideways."""
    for number, view in enumerate(panning_frames(4)):
        path = tmp_path / "scan" / f"{number}.png"
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), view)
    return tmp_path / "scan"


def failing(monkeypatch, stage, message, cause=None, kind=CalibrationError):
    def fail(*_):
        raise kind(message) from cause

    monkeypatch.setattr(check, stage, fail)


def test_a_scan_that_cannot_be_mapped_is_judged_by_its_images(tmp_path, pan, monkeypatch):
    failing(monkeypatch, "map_scan", "no two of the 4 images overlap; take them closer together")
    found = check_scan(pan, RigConfig(), Cache(tmp_path / "cache"), silent)
    assert found.verdict == found.cameras["camera"].verdict == "cannot"
    assert found.cameras["camera"].seen is None and found.cameras["camera"].edge_px is not None
    first = found.findings[0]
    assert (first.topic, first.what) == ("mapping", "no two of the 4 images overlap")
    assert first.remedy == "take them closer together"
    assert len(found.findings) == 1


@pytest.mark.parametrize(
    ("message", "what", "remedy"),
    [
        (
            "none of 9 points is seen: move the camera",
            "none of 9 points is seen",
            "move the camera",
        ),
        ("a: b; c: d", "a: b", "c: d"),
        ("nothing else", "nothing else", ""),
    ],
)
def test_a_failure_keeps_its_words(message, what, remedy):
    said = check._failure("solve", CalibrationError(message))
    assert (said.what, said.remedy, said.severity) == (what, remedy, "cannot")


def test_a_full_disk_is_not_the_scans_fault(tmp_path, pan, monkeypatch):
    failing(monkeypatch, "map_scan", "cannot write cache: no space", OSError(28, "no space"))
    with pytest.raises(CalibrationError, match="no space"):
        check_scan(pan, RigConfig(), Cache(tmp_path / "cache"), silent)


def test_a_machine_that_breaks_down_is_not_the_scans_fault(tmp_path, pan, monkeypatch):
    failing(monkeypatch, "map_scan", "COLMAP was killed: run again", kind=BrokenDownError)
    with pytest.raises(BrokenDownError, match="killed"):
        check_scan(pan, RigConfig(), Cache(tmp_path / "cache"), silent)


# ---- the command -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """OUT of a check with its cache. Copy before you change it."""
    out = tmp_path_factory.mktemp("checked") / "out"
    assert main(["check", str(simulation() / "scan"), "-o", str(out), *QUICK]) == 0
    return out


@pytest.mark.slow
def test_a_calibration_after_a_check_reuses_its_stages(tmp_path, checked, capfd):
    out = tmp_path / "out"
    shutil.copytree(checked, out)
    assert sorted(path.name for path in out.iterdir()) == ["cache", "check.json"]
    assert main(["calibrate", str(simulation() / "scan"), "-o", str(out), *QUICK]) == 0
    stages = {line.split(" ")[0] for line in capfd.readouterr().err.splitlines()}
    assert "solving" in stages and not {"extracting", "matching", "mapping"} & stages


@pytest.mark.slow
def test_json_is_all_of_stdout(tmp_path, checked, capfd):
    out = tmp_path / "out"
    shutil.copytree(checked, out)
    arguments = ["check", str(simulation() / "scan"), "-o", str(out), *QUICK]
    assert main([*arguments, "--json"]) == 0
    printed = json.loads(capfd.readouterr().out)
    assert printed == json.loads((out / "check.json").read_text())
    assert printed == json.loads((checked / "check.json").read_text())
    assert printed["format"] == "sfm_calib_check/1" and set(printed["cameras"]) == {"cam0", "cam1"}
    cam0 = printed["cameras"]["cam0"]
    assert cam0["n_images"] == 8 and cam0["seen"]["shared_at_once"]["cam1"] > 50
    assert main(arguments) == 0
    text = capfd.readouterr().out
    assert "images placed" in text and "rolled" in text and "doubtful: images" in text
    assert text.splitlines()[-2].startswith("verdict: ") and "check.json written" in text


def test_nothing_is_kept_without_out(tmp_path, pan, monkeypatch, capfd):
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    failing(monkeypatch, "map_scan", "no two of the 4 images overlap; take them closer together")
    assert main(["check", str(pan)]) == 0
    printed = capfd.readouterr()
    assert list(place.iterdir()) == [] and sorted(pan.parent.iterdir()) == [pan, place]
    assert "-> take them closer together" in printed.out and "written" not in printed.out
    assert printed.out.splitlines()[-1].startswith("verdict: cannot: this scan cannot")
    assert [line.split(" ")[0] for line in printed.err.splitlines()] == ["reading", "looking"]


def test_flags_go_before_the_file(pan, monkeypatch, tmp_path):
    asked = []

    def remember(scan, config, cache, progress):
        asked.append((config, cache.fresh))
        raise CalibrationError("enough")

    monkeypatch.setattr("sfm_calib.cli.check_scan", remember)
    (pan / "rig.yaml").write_text("max_features: 500\nlens: pinhole")
    assert main(["check", str(pan), "--max-features", "700", "--fresh"]) == 2
    assert main(["check", str(pan), "-o", str(tmp_path / "out")]) == 2
    assert [(c.max_features, c.lens, fresh) for c, fresh in asked] == [
        (700, "pinhole", True),
        (500, "pinhole", False),
    ]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kept", [[], ["-o", "out"]])
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda scan: None, "no such scan"),
        (lambda scan: scan.mkdir(), "holds no images"),
        (lambda scan: picture(scan / "0.png"), "holds 1 readable image,"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capfd, make, message, kept):
    monkeypatch.chdir(tmp_path)
    make(tmp_path / "scan")
    assert main(["check", "scan", *kept]) == 2
    printed = capfd.readouterr()
    *_, last = printed.err.splitlines()
    assert printed.out == "" and last.startswith("sfm-calib: ") and message in last
    assert not (tmp_path / "out").exists()


def test_every_flag_is_explained(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["check", "--help"])
    text = capsys.readouterr().out
    assert caught.value.code == 0 and "{None}" not in text
    words = " ".join(line.strip("│╭╮╰╯─ ") for line in text.splitlines())
    assert not re.search(r"--[a-z-]+( [A-Z{]\S*)* \(", words), "a flag without an explanation"
    assert all(f"--{name.replace('_', '-')}" in text for name in Options.model_fields)

"""`sfm-calib recalibrate`: what it writes and prints, its exit status, and what it leaves alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from synthetic.recalibrations import (
    already_mapped,
    deployed,
    moved,
    pictures,
    written,
)
from synthetic.scans import QUICK, simulation

from graphs.covariance import NOTHING
from sfm_calib import recalibrate as story
from sfm_calib.cli import main
from sfm_calib.errors import CalibrationError
from sfm_calib.files import calibration_sha256
from sfm_calib.result import load_calibration

# ---- the command -----------------------------------------------------------------------------


def run(*arguments: object) -> int:
    return main(["recalibrate", *map(str, arguments)])


@pytest.mark.slow
def test_two_runs_print_and_write_the_same_and_name_what_they_replace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a scan that lacks a camera, which the truth has."""
    already_mapped(monkeypatch)
    old, scan = written(deployed(), tmp_path / "old"), pictures(("cam0", "cam1"))
    truth = written(replace(deployed(), covariance=NOTHING), tmp_path / "truth")
    seen = []
    for out in (tmp_path / "one", tmp_path / "two"):
        given = [old, scan, "-o", out, "--json", "--exit-code"]
        assert run(*given, "--truth", truth / "calibration.json") == 0
        content = json.loads(capsys.readouterr().out)
        assert content == json.loads((out / "calibration.json").read_text())
        assert content["recalibration"]["drift"]["verdict"] == "keep"
        for record in (content["provenance"]["replaces"], content["recalibration"]["old"]):
            assert record["sha256"] == calibration_sha256(old)
            assert record["path"] == str(old / "calibration.json")
        del content["provenance"]["created"], content["provenance"]["command"]
        del content["solve"]["seconds"]
        seen.append(content)
        page = (out / "report.html").read_text()
        assert "not in the scan: kept as the old calibration has it" in page
    assert seen[0] == seen[1]


@pytest.mark.slow
def test_the_verdict_is_the_exit_status_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    already_mapped(monkeypatch)
    old = written(moved(deployed(), "cam1", turn_deg=1.0), tmp_path / "old")
    scan = pictures(("cam0", "cam1"))
    assert run(old, scan, "-o", tmp_path / "out", "--exit-code") == 3
    printed = capsys.readouterr().out
    assert "verdict: Replace: cam1" in printed
    assert "cam2: radtan, 640 x 480 px, not in the scan: kept" in printed
    unsure = ["--exit-code", "--matters-px", "0.01"]
    assert run(old, pictures(("cam2",)), "-o", tmp_path / "out", *unsure) == 4
    capsys.readouterr()
    assert run(old, scan, "-o", tmp_path / "out", "--free", "cam9") == 2
    assert run(tmp_path / "gone", scan, "-o", tmp_path / "out") == 2
    assert run(old, scan, "-o", tmp_path / "out", "--free") == 2
    errors = capsys.readouterr().err
    assert "Traceback" not in errors and "did you mean 'cam" in errors


def test_an_old_calibration_is_replaced_only_where_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    already_mapped(monkeypatch)
    old, scan = written(deployed(), tmp_path / "old"), pictures(("cam1",))
    content, was = (old / "calibration.json").read_bytes(), calibration_sha256(old)
    assert run(old, scan, "-o", old) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert sorted(p.name for p in old.iterdir()) == ["calibration.json"]

    def broken(*_: object) -> None:
        raise CalibrationError("no optimum")

    with monkeypatch.context() as failing:
        failing.setattr(story, "solve_problem", broken)
        assert run(old, scan, "-o", old, "--overwrite") == 2
        assert run(old, scan, "-o", tmp_path / "out") == 2
    assert (old / "calibration.json").read_bytes() == content
    assert not (old / "report.html").exists() and not list((tmp_path / "out").glob("*.*"))

    assert run(old, scan, "-o", old, "--overwrite") == 0
    new = load_calibration(old / "calibration.json")
    assert new.provenance.replaces and new.provenance.replaces.sha256 == was
    assert calibration_sha256(old) != was


def test_a_truth_of_other_cameras_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = written(deployed(), tmp_path / "old")
    truth = written(deployed().only(["cam0"]), tmp_path / "truth") / "calibration.json"
    scan = pictures(("cam0", "cam1"))
    assert run(old, scan, "-o", tmp_path / "out", "--truth", truth) == 2
    assert "the truth is of" in capsys.readouterr().err


@pytest.mark.slow
def test_from_images_to_a_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A small simulated scan: the truth is not contradicted, a focal length 5 % off is found."""
    made = simulation()
    truth, out = made / "truth.json", tmp_path / "out"
    given = [made / "scan", "-o", out, "--exit-code", *QUICK]
    assert run(truth, *given) in (0, 4)
    content = json.loads(truth.read_text())
    for name in ("fx", "fy"):
        content["cameras"]["cam1"]["params"][name] *= 1.05
    (tmp_path / "old.json").write_text(json.dumps(content))
    assert run(tmp_path / "old.json", *given) == 3
    assert "verdict: Replace: cam1 has another focal length" in capsys.readouterr().out

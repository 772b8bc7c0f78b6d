"""The calibrations of a rig over time: what is found, in which order, and how it is compared."""

from __future__ import annotations

import json
import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_partial import NAMES, in_baseline, result_of, true_rig, uncertain

from graphs.frames import Transform, exp_rotation
from graphs.pose_covariance import rereferenced
from sfm_calib.cli import main
from sfm_calib.drift import DriftOptions, judge
from sfm_calib.errors import CalibrationError
from sfm_calib.files import calibration_sha256
from sfm_calib.formats import CameraRig
from sfm_calib.history import HistoryOptions, history_of
from sfm_calib.history_record import History, HistoryEntry, Quantity
from sfm_calib.provenance import Provenance, Replaced
from sfm_calib.recalibration_record import OldFile, Recalibration
from sfm_calib.report.history import render_history
from sfm_calib.result import Calibration, save_calibration

WITHOUT_DEPTHS = DriftOptions(depth_ranges=())
DAY = datetime(2026, 1, 1, 12, tzinfo=UTC)


def written(
    made_rig: CameraRig, path: Path, day: int | None = 0, reference: str = "a", **more: object
) -> Calibration:
    """A calibration.json of a day; None: it does not say of which."""
    created = None if day is None else DAY + timedelta(days=day)
    made = Provenance(version="1", created=created, replaces=more.pop("replaces", None))
    whole = result_of(made_rig, reference).model_copy(update={"provenance": made} | more)
    save_calibration(whole, path)
    return whole


def rig_of_day(seed: int = 0, names: tuple[str, ...] = NAMES, reference: str = "a") -> CameraRig:
    return uncertain(true_rig(names, reference), reference, seed)


def by_name(entry: HistoryEntry) -> dict[str, Quantity]:
    return {one.name: one for one in entry.quantities}


def notes_of(record: History) -> str:
    return "\n".join(f"#{e.number} {note}" for e in record.entries for note in e.notes)


# ---- what is found -------------------------------------------------------------------------


def test_calibrations_are_ordered_by_when_they_were_written(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "b" / "calibration.json", 1)
    written(rig_of_day(1), tmp_path / "a" / "calibration.json", 2)
    written(rig_of_day(2), tmp_path / "old.json", None)  # from before `created`
    os.utime(tmp_path / "old.json", (0, (DAY - timedelta(days=9)).timestamp()))
    record = history_of(tmp_path)
    assert [entry.path for entry in record.entries] == [
        *("old.json", "b/calibration.json", "a/calibration.json")
    ]
    assert [entry.when_from for entry in record.entries] == ["file", "created", "created"]
    assert record.entries[0].when == DAY - timedelta(days=9)
    assert record.cameras == NAMES and record.reference == "a"
    left = history_of(tmp_path, HistoryOptions(since="2026-01-03"))
    assert [entry.path for entry in left.entries] == ["a/calibration.json"] and left.n_older == 2


def test_what_is_no_calibration_is_skipped_and_counted(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "out" / "calibration.json")
    (tmp_path / "out" / "check.json").write_text('{"cameras": {}}')
    (tmp_path / "out" / "rig.yaml").write_text("lens: radtan\n")
    (tmp_path / "notes.txt").write_text("not even looked at")
    (tmp_path / "broken.json").write_bytes(b"\xff\x00{")
    save_calibration(result_of(rig_of_day(4), "a"), tmp_path / "truth.json")
    for name in ("cache", "exports"):  # steps to the result, and copies of it
        written(rig_of_day(5), tmp_path / "out" / name / "model.json")
    record = history_of(tmp_path)
    assert [entry.path for entry in record.entries] == ["out/calibration.json"]
    assert record.n_skipped == 3


def test_files_of_one_content_are_listed_once(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "calibration.json")
    (tmp_path / "z").mkdir()
    shutil.copy(tmp_path / "calibration.json", tmp_path / "z" / "current.json")
    (entry,) = history_of(tmp_path).entries
    assert (entry.path, entry.also) == ("calibration.json", ("z/current.json",))


def test_what_replaces_what_is_known_by_hash(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "first.json")
    old = calibration_sha256(tmp_path / "first.json")
    (tmp_path / "first.json").rename(tmp_path / "moved.json")
    drift = judge(rig_of_day().stated, rig_of_day(1).stated, "m", WITHOUT_DEPTHS).record
    recalibration = Recalibration(
        old=OldFile(path="first.json", sha256=old, format="ours"), prior="full", freed=("all",),
        kept=("d",), drift=drift.model_copy(update={"verdict": "replace"}),
    )  # fmt: skip
    made = result_of(rig_of_day(1), "a")
    kept = made.cameras | {"d": made.cameras["d"].model_copy(update={"kept_from": old})}
    written(
        rig_of_day(1), tmp_path / "second.json", 1, cameras=kept, recalibration=recalibration,
        replaces=Replaced(path="first.json", sha256=old),
    )  # fmt: skip
    written(rig_of_day(2), tmp_path / "third.json", 2, replaces=Replaced(path="x", sha256="0" * 64))
    record = history_of(tmp_path)
    assert [entry.replaces for entry in record.entries] == [None, 1, None]
    second = record.entries[1]
    assert (second.drift, second.kept, second.usable) == ("replace", ("d",), True)
    assert "#2 d copied from first.json" in notes_of(record)
    assert "had first.json as a prior" in notes_of(record)


def test_formats_of_others(tmp_path: Path) -> None:
    written(rig_of_day(0, ("a", "b")), tmp_path / "calibration.json")
    chain = {
        f"cam{i}": {
            "camera_model": "pinhole", "distortion_model": "radtan", "resolution": [640, 480],
            "intrinsics": [520.0 + i, 529.0, 330.0, 231.0],
            "distortion_coeffs": [-0.28, 0.09, 0.0, 0.0],
        }
        for i in range(2)
    }  # fmt: skip
    placed = np.eye(4)
    placed[0, 3] = -0.3
    chain["cam1"]["T_cn_cnm1"] = placed.tolist()
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    os.utime(tmp_path / "camchain.yaml", (0, (DAY + timedelta(days=1)).timestamp()))
    model = tmp_path / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    os.utime(model / "cameras.txt", (0, (DAY + timedelta(days=2)).timestamp()))
    record = history_of(tmp_path)
    assert [entry.path for entry in record.entries] == [
        "calibration.json",
        "camchain.yaml",
        "model",
    ]
    assert "#2 cameras are called otherwise: matched by their order, a = cam0, b = cam1" in (
        notes_of(record)
    )
    told = by_name(record.entries[1])
    assert told["b.focal_x"].value == pytest.approx(521.0)
    assert told["b.focal_x"].sigma is None and told["b.focal_x"].z is None
    assert told["b.focal_x"].change == pytest.approx(1.0) and told["b.focal_x"].compared
    assert "#2 a is radtan, before it was radial" in notes_of(record)
    assert "#2 states no sigmas" in notes_of(record)


# ---- how it is compared --------------------------------------------------------------------


def test_changes_are_in_combined_sigmas(tmp_path: Path) -> None:
    first = rig_of_day()
    written(first, tmp_path / "1.json", 0)
    assert first.cam_from_rig
    cameras = list(first.cameras)
    params = cameras[1].params.copy()
    params[:4] += [0.5, 0.0, -0.25, 0.0]
    cameras[1] = type(cameras[1])("b", cameras[1].lens, cameras[1].size, params)
    second = type(first)(
        first.path, first.format, tuple(cameras), first.cam_from_rig, "m", first.covariance
    )
    written(second, tmp_path / "2.json", 1)
    told = by_name(history_of(tmp_path).entries[1])
    sigma = first.covariance.sigma["b.cx"]
    assert told["b.cx"].sigma == pytest.approx(sigma)
    assert told["b.cx"].change == told["b.cx"].since_first == pytest.approx(-0.25)
    assert told["b.cx"].z == pytest.approx(-0.25 / (sigma * 2**0.5))
    assert told["b.rotation_x"].change == pytest.approx(0.0, abs=1e-9)
    of_focal = first.covariance.sigma["b.fx"], first.covariance.sigma["b.fy"]
    assert told["b.focal_x"].sigma == pytest.approx(of_focal[0], rel=1e-6)
    assert told["b.focal"].change == pytest.approx(0.25)
    assert told["b.corner_x"].sigma == 0.0 and told["b.corner_x"].z is None  # it has no p1, p2


def test_another_reference_is_the_same_rig(tmp_path: Path) -> None:
    rig = rig_of_day()
    written(rig, tmp_path / "1.json", 0)
    estimate, covariance = rereferenced(rig.stated.estimate, rig.covariance, 2)
    other = CameraRig(
        rig.path, rig.format, estimate.cameras, estimate.cam_from_rig, "m", covariance
    )
    written(other, tmp_path / "2.json", 1, "c")
    record = history_of(tmp_path)
    assert record.reference == "c"  # the newest's
    first, second = (by_name(entry) for entry in record.entries)
    assert set(first) == set(second) and "a.rotation_x" in first
    for name, one in second.items():
        assert one.change == pytest.approx(0.0, abs=1e-9), name
        assert one.sigma == pytest.approx(first[name].sigma, rel=1e-6), name


def test_turns_are_about_the_axes_of_the_camera(tmp_path: Path) -> None:
    rig = rig_of_day()
    written(rig, tmp_path / "1.json", 0)
    assert rig.cam_from_rig
    placed = list(rig.cam_from_rig)
    turn = exp_rotation(np.radians([0.02, -0.03, 0.1]))
    placed[1] = Transform(turn @ placed[1].rotation, placed[1].translation)
    second = CameraRig(rig.path, "", rig.cameras, tuple(placed), "m", rig.covariance)
    written(second, tmp_path / "2.json", 1)
    told = by_name(history_of(tmp_path).entries[1])
    changes = [told[f"b.rotation_{axis}"].change for axis in "xyz"]
    assert changes == pytest.approx([0.02, -0.03, 0.1], abs=1e-9)
    sigma = np.degrees(rig.covariance.sigma["b.rotation_z"])
    assert told["b.rotation_z"].z == pytest.approx(0.1 / sigma / 2**0.5)


def test_lengths_without_metres_are_marked_and_not_compared(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "1.json", 0)
    loose = in_baseline(rig_of_day(1))
    whole = result_of(loose, "a")
    far = NAMES[int(np.argmax([np.linalg.norm(t.translation) for t in loose.cam_from_rig or ()]))]
    source = whole.rig.scale.model_copy(update={"source": f"none: unit is the baseline a to {far}"})
    rig = whole.rig.model_copy(update={"metric": False, "scale": source})
    for day in (1, 2):
        written(loose, tmp_path / f"{day + 1}.json", day, rig=rig)
    record = history_of(tmp_path)
    first, second, third = (by_name(entry) for entry in record.entries)
    name = f"a to {far}.baseline"
    assert first[name].compared and first[name].unit == "m"
    assert not second[name].compared and second[name].change is None
    assert second[name].value == pytest.approx(1.0) and second[name].sigma == 0.0
    assert third["b.translation_x"].change == 0.0  # of one unit
    assert third["b.rotation_x"].compared
    assert "#2 lengths in no metres: not compared" in notes_of(record)
    assert "#1 lengths" not in notes_of(record)


def test_cameras_that_come_and_go_and_other_sizes(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "1.json", 0)
    some = rig_of_day(1, ("b", "c"), "b")
    small = tuple(type(c)(c.name, c.lens, (320, 240), c.params) for c in some.cameras)
    written(
        CameraRig(some.path, "", small, some.cam_from_rig, "m", some.covariance),
        tmp_path / "2.json", 1, "b",
    )  # fmt: skip
    written(rig_of_day(2), tmp_path / "3.json", 2)
    record = history_of(tmp_path)
    said = notes_of(record)
    assert "#2 lacks a, d" in said and "#3 has a, d besides" in said
    assert "#2 lacks the reference a: how its cameras sit is told by baselines alone" in said
    assert "#2 b has 320 x 240 px: not compared in pixels" in said
    second, third = (by_name(entry) for entry in record.entries[1:])
    assert not second["b.cx"].compared and "b.rotation_x" not in second
    assert second["b to c.baseline"].compared
    assert third["b.cx"].change == 0.0  # since the first: of the same size


def test_what_is_listed_may_be_chosen(tmp_path: Path) -> None:
    written(rig_of_day(), tmp_path / "1.json", 0)
    options = HistoryOptions(camera=("b",), parameters=("focal", "baseline"))
    names = {one.name for one in history_of(tmp_path, options).entries[0].quantities}
    assert names == {
        *("b.focal", "b.focal_x", "b.focal_y"),
        *("a to b.baseline", "b to c.baseline", "b to d.baseline"),
    }


# ---- refusals, pages -----------------------------------------------------------------------


def test_what_cannot_be_listed_is_said(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"holds no calibration; 0 files .*: give"):
        history_of(tmp_path)
    written(rig_of_day(), tmp_path / "1.json", 0)
    with pytest.raises(CalibrationError, match=r"is no folder: give"):
        history_of(tmp_path / "1.json")
    with pytest.raises(CalibrationError, match=r"--camera q: no calibration has it: .*a, b, c, d"):
        history_of(tmp_path, HistoryOptions(camera=("q",)))
    with pytest.raises(CalibrationError, match=r"--since May: no date; write"):
        history_of(tmp_path, HistoryOptions(since="May"))
    with pytest.raises(CalibrationError, match=r"none of the 1 calibrations .* 2026-01-01"):
        history_of(tmp_path, HistoryOptions(since="2027-01-01"))


def test_the_command_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for day in range(2):
        written(rig_of_day(day), tmp_path / "rig" / f"{day}.json", day)
    out = tmp_path / "out"
    assert main(["history", str(tmp_path / "rig"), "-o", str(out), "--camera", "a", "b"]) == 0
    text = capsys.readouterr().out
    for part in (
        "#2",
        "1.json",
        "2026-01-02",
        "usable",
        "a to b",
        "2 calibrations in",
        "rot x deg",
    ):
        assert part in text
    assert "…" not in text
    record = History.model_validate_json((out / "history.json").read_text())
    assert record == history_of(tmp_path / "rig", HistoryOptions(camera=("a", "b")))
    page = (out / "history.html").read_text()
    assert page.count('class="plotly-graph-div"') == 3 + 5 + 1  # a is the reference
    assert main(["history", str(tmp_path / "rig"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "sfm_calib/history/1"


def test_names_are_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    rig = rig_of_day(0, ("a", "b"))
    text = (tmp_path / "x.json", written(rig, tmp_path / "x.json"))[1].model_dump_json()
    folder = tmp_path / "<b>bold<"
    folder.mkdir()
    (folder / "x.json").write_text(text.replace('"a', f'"{evil}'))
    (tmp_path / "x.json").unlink()
    record = history_of(tmp_path)
    page = render_history(record)
    assert evil in record.cameras
    assert evil not in page and "<b>bold<" not in page and "&lt;b&gt;bold&lt;" in page

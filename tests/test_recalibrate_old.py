"""What a recalibration makes of an old file: sigmas, names, sizes, and what rig.yaml adds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic.recalibrations import (
    already_mapped,
    deployed,
    larger,
    pictures,
    recalibrated,
    scan_of,
)

from graphs.camera import fit_lens
from graphs.covariance import NOTHING
from graphs.frames import Transform
from graphs.propagation import pose_names
from sfm_calib import recalibrate as story
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import read_calibration
from sfm_calib.formats.convert import FORMATS, FormatName, exported
from sfm_calib.formats.reading import NO_SIZE
from sfm_calib.recalibrate import recalibrate

# ---- what a file states ----------------------------------------------------------------------


def test_assumed_sigmas_are_said_to_be(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    already_mapped(monkeypatch)
    old, scan = replace(deployed(), covariance=NOTHING), pictures(("cam0", "cam1"))
    done = recalibrated(old, tmp_path, scan, free=("intrinsics",))
    assert done.drift.old_sigma_px == 0.2
    assert any("states no sigmas" in note and "0.2 px" in note for note in done.drift.notes)
    calibration = done.outcome.calibration
    assert calibration.verdict and calibration.cameras["cam2"].sigma["fx"] > 0
    assert "the old calibration states no sigmas" in calibration.verdict.messages[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "metric"), [("kalibr", True), ("opencv", True), ("ros", True), ("colmap", False)]
)
def test_an_old_calibration_may_be_in_any_format(
    name: FormatName, metric: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each keeps the lens that the format has; none states sigmas, and not all of them metres."""
    already_mapped(monkeypatch)
    export = exported(deployed().only(["cam0", "cam1"]), name)
    for path, content in export.files.items():
        place = tmp_path / (path or FORMATS[name].name)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
    old = read_calibration(tmp_path if len(export.files) > 1 else place)
    done = recalibrate(
        old, pictures(("cam0", "cam1")), story.RigConfig(), story.RecalibrateOptions(),
        story.DriftOptions(depth_ranges=()), story.Cache(tmp_path / "cache"), lambda *_: None,
    )  # fmt: skip
    calibration = done.outcome.calibration
    assert done.drift.verdict == "keep" and calibration.rig.metric == metric
    assert [c.lens for c in calibration.cameras.values()] == [c.lens for c in old.cameras]
    assert any("states no covariance" in note for note in done.drift.notes)


@pytest.mark.slow
def test_assumed_sigmas_are_in_a_cameras_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file whose rig frame is none of its cameras' is the same rig."""
    old = replace(deployed(), covariance=NOTHING)
    frame = Transform.exp(np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 3.0]))
    assert old.cam_from_rig
    elsewhere = replace(old, cam_from_rig=tuple(t @ frame for t in old.cam_from_rig))
    already_mapped(monkeypatch)
    records = []
    for rig in (old, elsewhere):
        monkeypatch.setattr(story, "calibration_sha256", lambda path: "0" * 64)
        done = story.recalibrate(
            rig, pictures(), story.RigConfig(), story.RecalibrateOptions(free=("cam2",)),
            story.DriftOptions(), story.Cache(tmp_path), lambda *_: None,
        )  # fmt: skip
        record = done.outcome.calibration.recalibration
        assert record
        records.append(record.contributions)
    for name, one in records[0].items():
        assert one.sigma_old == pytest.approx(records[1][name].sigma_old, rel=1e-6), name


@pytest.mark.slow
def test_what_rig_yaml_says_goes_before_the_old_calibration_and_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    already_mapped(monkeypatch)
    config = {"cameras": {"cam1": {"params": {"k1": -0.14}, "sigma": {"k1": 1e-5}}}}
    scan = pictures(("cam0", "cam1"))
    calibration = recalibrated(deployed(), tmp_path, scan, config=config).outcome.calibration
    assert calibration.cameras["cam1"].params["k1"] == pytest.approx(-0.14, abs=5e-4)
    assert calibration.verdict
    assert any("cam1: k1 as rig.yaml has it" in one for one in calibration.verdict.messages)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["start", "weak"])
def test_what_rig_yaml_holds_without_a_value_is_held_at_the_old_one(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    already_mapped(monkeypatch)
    config = {"cameras": {"cam1": {"fixed": ["k2"]}}}
    done = recalibrated(deployed(), tmp_path, pictures(("cam0", "cam1")), config=config, prior=mode)
    calibration = done.outcome.calibration
    assert calibration.cameras["cam1"].params["k2"] == deployed().cameras[1].named()["k2"]
    assert done.drift.verdict == "keep" and calibration.verdict
    assert "cam1: k2 held at the old" in calibration.verdict.messages[0]


@pytest.mark.parametrize(
    "config", [{}, {"lens": "radial"}, {"cameras": {"cam0": {"lens": "radial"}}}]
)
def test_lenses_too_simple_are_widened_but_of_kept_cameras_and_where_the_lens_is_said(
    config: dict[str, object],
) -> None:
    old, said = deployed(), story.RigConfig.model_validate(config)
    simple = replace(old, cameras=tuple(fit_lens(c, "radial")[0] for c in old.cameras),
                     covariance=NOTHING)  # fmt: skip
    scan = scan_of(("cam0", "cam1"))
    told = story.old_calibration(simple, scan, said, (), story.DriftOptions())
    first = "radial" if config else "radtan"
    second = "radial" if "lens" in config else "radtan"
    assert [c.lens for c in told.rig.cameras] == [first, second, "radial"]
    assert len(told.notes) == [first, second].count("radtan")
    lenses = story.with_lenses(said, told.rig, scan.cameras).cameras
    assert [lenses[name].lens for name in scan.cameras] == [first, second]


@pytest.mark.slow
def test_an_old_calibration_with_no_lengths_is_judged_by_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    already_mapped(monkeypatch)
    old = larger(replace(deployed(), covariance=NOTHING, unit="unknown"), 0.0)
    drift = recalibrated(old, tmp_path).drift
    assert drift.verdict == "keep"
    assert not [test for test in drift.tests if test.group == "translation"]


@pytest.mark.slow
def test_a_scan_that_cannot_replace_what_does_not_hold_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lenses without distortion fit the pictures so badly that the result is not usable."""
    already_mapped(monkeypatch)
    old = replace(
        deployed(), cameras=tuple(fit_lens(c, "pinhole")[0] for c in deployed().cameras),
        covariance=NOTHING,
    )  # fmt: skip
    scan = pictures(("cam0", "cam1"))
    done = recalibrated(old, tmp_path, scan, config={"lens": "pinhole"})
    verdict = done.outcome.calibration.verdict
    assert done.drift.verdict == "replace" and verdict and not verdict.usable
    told = "the old calibration does not hold, but this scan cannot replace it: the sigma of cam0"
    assert verdict.messages[0].startswith(told) and done.drift.lines[-1].startswith(told)


@pytest.mark.parametrize(
    ("change", "config", "why"),
    [
        ({}, {"lens": "eucm"}, "^--lens eucm: .* has cam0 in the lens radtan"),
        ({}, {"cameras": {"cam1": {"lens": "eucm"}}}, "rig.yaml gives cam1 the lens eucm"),
        ({"size": (320, 240)}, {}, r"images of 640 x 480 px, and .* 320 x 240 px"),
        ({"name": "left"}, {"reference": "cam0"}, r"--reference cam0: .* has no such camera"),
    ],
)
def test_what_contradicts_the_old_calibration_is_refused(
    change: dict[str, object], config: dict[str, object], why: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    already_mapped(monkeypatch)
    old = deployed()
    first = replace(old.cameras[0], **change)  # type: ignore[arg-type]
    rig = replace(old, cameras=(first, *old.cameras[1:]), covariance=NOTHING)
    with pytest.raises(CalibrationError, match=why) as error:
        recalibrated(rig, tmp_path, config=config)
    assert "\n" not in str(error.value)


def test_a_camera_of_neither_size_nor_images_has_the_others_size_or_is_refused() -> None:
    old, scan = deployed(), scan_of(("cam0", "cam1"))
    rig = replace(old, cameras=tuple(replace(c, size=NO_SIZE) for c in old.cameras))
    told = story.old_calibration(rig, scan, story.RigConfig(), (), story.DriftOptions())
    assert [c.size for c in told.rig.cameras] == [(640, 480)] * 3
    assert told.notes == ("images of cam2 are taken to be of 640 x 480 px, as the scan's",)
    two_sizes = replace(scan, sizes=((640, 480), (320, 240)))
    with pytest.raises(CalibrationError, match="how large the images of cam2 are"):
        story.old_calibration(rig, two_sizes, story.RigConfig(), (), story.DriftOptions())


# ---- cameras called otherwise ----------------------------------------------------------------


def old_of(names: tuple[str, ...], *cameras: str) -> story.OldCalibration:
    return story.old_calibration(
        deployed(), scan_of(names), story.RigConfig(), cameras, story.DriftOptions()
    )


def test_cameras_are_matched_as_told_or_by_order() -> None:
    by_order = old_of(("a", "b", "c"))
    assert by_order.rig.names == ("a", "b", "c")
    assert "matched by their order, cam0 = a, cam1 = b, cam2 = c" in by_order.notes[-1]
    told = old_of(("a", "cam1"), "cam2=a")
    assert told.rig.names == ("cam0", "cam1", "a") and not told.notes
    assert set(pose_names("a")) <= set(told.rig.covariance.names)


@pytest.mark.parametrize(
    ("names", "cameras", "why"),
    [
        (("a", "b"), (), r"none is in both; say which are the same: --cameras cam0=a"),
        (("a", "b"), ("cam0",), "--cameras cam0: say NAME"),
        (("a", "b"), ("cam0=q",), "the scan has no camera 'q'"),
        (("a", "b"), ("q=a",), "calibration has no camera 'q'|has no camera 'q'"),
        (
            ("cam0", "cam1"),
            ("cam0=cam1",),
            "two cameras of OLD are cam1 of the scan, cam0 and cam1: say",
        ),
    ],
)
def test_names_that_do_not_match_are_refused(
    names: tuple[str, ...], cameras: tuple[str, ...], why: str
) -> None:
    with pytest.raises(CalibrationError, match=why) as error:
        old_of(names, *cameras)
    assert "\n" not in str(error.value)

"""`sfm-calib convert`: what it writes, prints and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from synthetic.calibrations import apart_px, put, rig_of
from synthetic.refusals import written

from sfm_calib.cli import main
from sfm_calib.files import sha256
from sfm_calib.formats import read_calibration
from sfm_calib.formats.convert import exported

RIG = rig_of("radtan", "radtan", "radtan", names=("left", "right", "back"))


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    return put(exported(RIG, "sfm_calib"), tmp_path / "calibration.json")


def convert(*arguments: object) -> int:
    return main(["convert", *map(str, arguments)])


def error_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    capsys.readouterr()
    assert convert(*arguments) == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith("sfm-calib: ") and err.count("\n") == 1
    return err


def in_folder(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_file_is_written_and_what_was_lost_is_said(
    ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "camchain.yaml"
    assert convert(ours, out) == 0
    printed = capsys.readouterr().out
    assert f"{out} written: Kalibr camchain, 3 cameras, left, right, back" in printed
    assert "note: Kalibr numbers its cameras: cam0 is left, cam1 is right, cam2 is back" in printed
    assert apart_px(RIG, read_calibration(out)) < 1e-9
    assert in_folder(out.parent).keys() == {"camchain.yaml"}


def test_the_new_file_tells_what_it_came_from(ours: Path, tmp_path: Path) -> None:
    assert convert(ours, tmp_path / "camchain.yaml") == 0
    assert convert(tmp_path / "camchain.yaml", tmp_path / "b.json", "--to", "sfm_calib") == 0
    provenance = json.loads((tmp_path / "b.json").read_text())["provenance"]
    assert provenance["input_hashes"] == {"camchain.yaml": sha256(tmp_path / "camchain.yaml")}


def test_some_cameras_go_into_a_folder(ours: Path, tmp_path: Path) -> None:
    out = tmp_path / "ros"
    assert convert(ours, out, "--to", "ros", "--camera", "right", "left") == 0
    assert in_folder(out).keys() == {"left.yaml", "right.yaml"}
    assert read_calibration(out).names == ("right", "left")


def test_one_camera_of_a_format_with_folders_is_a_file_where_out_is(
    ours: Path, tmp_path: Path
) -> None:
    out = tmp_path / "left.cameramodel"
    assert convert(ours, out, "--camera", "left") == 0 and out.is_file()
    assert convert(ours, tmp_path / "models", "--to", "mrcal", "--camera", "left") == 0
    assert in_folder(tmp_path / "models").keys() == {"left.cameramodel"}


def test_nothing_is_overwritten_unless_told(
    ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = in_folder(tmp_path)
    assert "--overwrite" in error_of(capsys, ours, ours)
    assert "--overwrite" in error_of(capsys, ours, written(tmp_path / "a.xml", "mine"))
    assert in_folder(tmp_path) == before | {"a.xml": b"mine"}
    assert convert(ours, tmp_path / "a.xml", "--overwrite") == 0
    assert read_calibration(tmp_path / "a.xml").names == RIG.names
    assert convert(ours, ours, "--overwrite") == 0
    assert read_calibration(ours).names == RIG.names
    folder = tmp_path / "photos"
    folder.mkdir()
    written(folder / "one.jpg", "")
    assert "is there already" in error_of(capsys, ours, folder, "--to", "ros")
    assert "other files too" in error_of(capsys, ours, folder, "--to", "ros", "--overwrite")
    assert "is a folder" in error_of(capsys, ours, folder, "--to", "opencv", "--overwrite")
    assert "goes into a folder" in error_of(capsys, ours, ours, "--to", "ros", "--overwrite")
    assert in_folder(folder) == {"one.jpg": b""}


def test_a_refused_conversion_leaves_the_old_file(
    ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    brown = put(exported(rig_of("brown"), "sfm_calib"), tmp_path / "brown.json")
    out = written(tmp_path / "camchain.yaml", "old")
    assert "no brown lens" in error_of(capsys, brown, out, "--overwrite")
    assert out.read_text() == "old"
    assert convert(brown, out, "--overwrite", "--max-error-px", "1") == 0
    assert "is refitted as radtan, off by 0.055 px rms and 0.39 px" in capsys.readouterr().out


def test_what_is_missing_can_be_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kitti = "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n"
    source = written(tmp_path / "calib.txt", kitti)
    out = tmp_path / "camchain.yaml"
    assert "--size" in error_of(capsys, source, out)
    assert convert(source, out, "--size", 1241, 376, "--metres", 0.001) == 0
    read = read_calibration(out)
    assert read.cameras[0].size == (1241, 376)
    assert read.cam_from_rig is not None
    assert read.cam_from_rig[1].translation == pytest.approx([-0.00054, 0, 0])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["x.yaml"], "say --to"),
        (["x.xml", "--camera", "lefd"], "did you mean 'left'?"),
        (["x.xml", "--camera", "left", "left"], "twice"),
        (["x.xml", "--metres", "-1"], "--metres -1 must be above 0"),
        (["x.xml", "--metres", "nan"], "must be above 0"),
        (["x.xml", "--metres", "1e300"], "beyond"),
        (["x.xml", "--max-error-px", "0"], "must be above 0"),
        (["x.xml", "--size", "0", "5"], "0 x 5 px"),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str], said: str, ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, *flags = arguments
    assert said in error_of(capsys, ours, tmp_path / name, *flags)
    assert in_folder(tmp_path).keys() == {"calibration.json"}


def test_missing_places_are_one_line(
    ours: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "No such file" in error_of(capsys, tmp_path / "no.yaml", tmp_path / "x.xml")
    told = error_of(capsys, ours, ours / "x.xml")  # a file is no folder: room would not help
    assert "cannot write" in told and "choose another output folder" in told and "free" not in told

"""OLD stays as it was: refusals to overwrite it, whatever it is called, and failures halfway."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from test_result import rig

from sfm_calib.errors import CalibrationError
from sfm_calib.files import calibration_sha256, refuse_overwrite
from sfm_calib.result import save_calibration


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "old" / "calibration.json"
    save_calibration(rig(), path)
    return path


def linked_folder(root: Path, old: Path) -> tuple[Path, Path]:
    (root / "out").symlink_to(old.parent)
    return old, root / "out"


def linked_file(root: Path, old: Path) -> tuple[Path, Path]:
    (root / "current.json").symlink_to(old)
    return root / "current.json", old.parent


def link_in_out(root: Path, old: Path) -> tuple[Path, Path]:
    (root / "out").mkdir()
    (root / "out" / "calibration.json").symlink_to(old)
    return old, root / "out"


def hard_link(root: Path, old: Path) -> tuple[Path, Path]:
    (root / "out").mkdir()
    os.link(old, root / "out" / "calibration.json")
    return old, root / "out"


def linked_sub_folder(root: Path, old: Path) -> tuple[Path, Path]:
    (root / "out").mkdir()
    (root / "out" / "exports").symlink_to(old.parent)
    return old, root / "out"


def other_words(root: Path, old: Path) -> tuple[Path, Path]:
    return old, root / "elsewhere" / ".." / "old"


def model(root: Path, old: Path) -> tuple[Path, Path]:
    (root / "model").mkdir()
    (root / "model" / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    return root / "model", root / "model" / "cameras.txt"


Places = Callable[[Path, Path], tuple[Path, Path]]
SAME: dict[str, Places] = {
    "the file itself": lambda _, old: (old, old),
    "its folder": lambda _, old: (old, old.parent),
    "a folder above": lambda root, old: (old, root),
    "OLD as a folder": lambda _, old: (old.parent, old.parent),
    "a link to its folder": linked_folder,
    "OLD is a link": linked_file,
    "a link in OUT": link_in_out,
    "a hard link in OUT": hard_link,
    "a linked folder in OUT": linked_sub_folder,
    "by way of another folder": other_words,
    "a file of a model": model,
}


@pytest.mark.parametrize("places", SAME.values(), ids=SAME)
def test_old_is_not_overwritten_unless_told(tmp_path: Path, old: Path, places: Places) -> None:
    before = old.read_bytes()
    given, out = places(tmp_path, old)
    with pytest.raises(CalibrationError, match=r"would be overwritten .*: choose .*--overwrite$"):
        refuse_overwrite(given, out, overwrite=False)
    refuse_overwrite(given, out, overwrite=True)
    assert old.read_bytes() == before


@pytest.mark.parametrize("out", ["new", "old/new", "old/calibration.json.bak", "old/report"])
def test_elsewhere_may_be_written(tmp_path: Path, old: Path, out: str) -> None:
    refuse_overwrite(old, tmp_path / out, overwrite=False)


def test_the_copy_of_a_calibration_is_another_file(tmp_path: Path, old: Path) -> None:
    save_calibration(rig(), tmp_path / "new" / "calibration.json")
    refuse_overwrite(old, tmp_path / "new", overwrite=False)


@pytest.mark.parametrize("fails", ["fsync", "replace"])
def test_a_write_that_fails_leaves_old_as_it_was(
    old: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    before = old.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, fails, fail)
    with pytest.raises(CalibrationError, match="No space left on device"):
        save_calibration(rig(("top",)), old)
    assert old.read_bytes() == before
    assert [path.name for path in old.parent.iterdir()] == ["calibration.json"]


# ---- hashes --------------------------------------------------------------------------------


def test_the_hash_of_a_file_is_that_of_its_bytes(old: Path) -> None:
    expected = hashlib.sha256(old.read_bytes()).hexdigest()
    assert calibration_sha256(old) == expected
    (old.parent / "report.html").write_text("new")
    assert calibration_sha256(old.parent) == expected  # of its calibration.json


def test_the_hash_of_a_model_changes_with_its_files_alone(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text("")
    first = calibration_sha256(tmp_path)
    (tmp_path / "0.png").write_bytes(b"a picture")
    assert calibration_sha256(tmp_path) == first
    (tmp_path / "images.txt").write_text("\n")
    second = calibration_sha256(tmp_path)
    (tmp_path / "images.txt").rename(tmp_path / "frames.txt")
    assert len({first, second, calibration_sha256(tmp_path)}) == 3


def test_what_is_not_there_has_no_hash(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"cannot read .*: No such file"):
        calibration_sha256(tmp_path / "gone.json")

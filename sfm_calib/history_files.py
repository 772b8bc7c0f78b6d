"""The calibrations in a folder, by what their files hold, each with its time."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from sfm_calib.errors import CalibrationError
from sfm_calib.files import RESULT_FILE, calibration_files, calibration_sha256
from sfm_calib.formats import CameraRig, read_calibration
from sfm_calib.formats.detect import COLMAP_FILES, YAML_SUFFIXES
from sfm_calib.formats.file_storage import EXTRINSICS, INTRINSICS
from sfm_calib.formats.mrcal import SUFFIX
from sfm_calib.formats.ours import rig_of
from sfm_calib.formats.rig_config import NAME as RIG_CONFIG
from sfm_calib.provenance import to_the_second
from sfm_calib.result import Calibration, load_calibration

SUFFIXES = (".json", *YAML_SUFFIXES, ".xml", ".toml", SUFFIX)
ONE_A_CAMERA = ((SUFFIX,), YAML_SUFFIXES)  # of formats that have a file a camera: mrcal's, ROS's
OF_A_MODEL = (".txt", ".bin")  # COLMAP's
TEXTS = ("calib", ".qca.")  # in the names of text files that are calibrations
NOT_CALIBRATED = ("truth.json",)  # what a simulation knows: no calibration
# Folders beside a calibration.json whose calibrations are steps to it, or copies of it.
OF_A_RESULT = ("cache", "exports", "scan")


@dataclass(frozen=True)
class FoundCalibration:
    """A calibration, and what its file tells beside the numbers."""

    path: Path  # of the file; of the folder, where that is the calibration
    read: CameraRig
    result: Calibration | None  # None: of another format
    sha256: str
    when: datetime
    when_from: Literal["created", "file"]
    also: tuple[Path, ...] = ()  # the same content in other places


def find_calibrations(folder: Path) -> tuple[list[FoundCalibration], int]:
    """All in a folder and below, the oldest first, and how many files were none after all.

    Files of the same content are one calibration. Raises CalibrationError for what is no folder,
    and where there is none.
    """
    if not folder.is_dir():
        raise CalibrationError(f"{folder} is no folder: give one that holds calibrations")
    found: dict[str, FoundCalibration] = {}
    skipped = 0
    for path in candidates(folder):
        try:
            one = read_found(path)
        except CalibrationError:
            skipped += 1
            continue
        known = found.get(one.sha256)
        found[one.sha256] = one if known is None else replace(known, also=(*known.also, path))
    if not found:
        raise CalibrationError(
            f"{folder} holds no calibration; {skipped} files could have been one by their names: "
            "give the folder that holds the calibration.json files of the rig"
        )
    return sorted(found.values(), key=lambda one: (one.when, os.fspath(one.path))), skipped


def read_found(path: Path) -> FoundCalibration:
    """One calibration with its time: when it was written, else when its files were changed last.

    Raises CalibrationError when it is none.
    """
    digest = calibration_sha256(path)
    result = load_calibration(path) if _is_ours(path) else None
    read = read_calibration(path) if result is None else rig_of(result, path)
    if result is not None and result.provenance.created is not None:
        return FoundCalibration(path, read, result, digest, result.provenance.created, "created")
    changed = max(file.stat().st_mtime for file in calibration_files(path))
    when = to_the_second(datetime.fromtimestamp(changed, UTC))
    return FoundCalibration(path, read, result, digest, when, "file")


def _is_ours(path: Path) -> bool:
    """Whether it is read as our own file: other programs write no such JSON."""
    if path.suffix != ".json" or not path.is_file():
        return False
    return read_calibration(path).format.startswith("sfm_calib/")


def candidates(folder: Path) -> Iterator[Path]:
    """What may be a calibration by its name: files, and folders that are one together.

    A folder's calibration.json comes first, and nothing from its cache and exports.
    """
    for place, folders, files in os.walk(folder):
        if RESULT_FILE in files:
            folders[:] = [name for name in folders if name not in OF_A_RESULT]
        folders.sort()
        names = sorted(files, key=lambda name: (name != RESULT_FILE, name))
        if any(name in files for name in COLMAP_FILES):
            yield Path(place)
            names = [n for n in names if not n.endswith(OF_A_MODEL) and n != RIG_CONFIG]
        elif RESULT_FILE not in files:
            for suffixes in ONE_A_CAMERA:
                if _are_one_rig(Path(place), names, suffixes):
                    yield Path(place)
                    names = [name for name in names if not name.endswith(suffixes)]
        yield from (Path(place, name) for name in names if _is_plausible(name, names))


def _is_plausible(name: str, beside: Sequence[str]) -> bool:
    if name in NOT_CALIBRATED or name.startswith("."):
        return False
    if EXTRINSICS in name and name.replace(EXTRINSICS, INTRINSICS) in beside:
        return False  # read together with the intrinsics
    is_text = name.endswith(".txt") and any(word in name for word in TEXTS)
    return name.endswith(SUFFIXES) or is_text


def _are_one_rig(place: Path, names: Sequence[str], suffixes: tuple[str, ...]) -> bool:
    """Whether these files of a folder, one a camera, say together how the cameras sit."""
    if sum(name.endswith(suffixes) for name in names) < 2:
        return False
    try:
        read = read_calibration(place)
    except CalibrationError:
        return False
    if read.path != place or read.cam_from_rig is None:
        return False
    return any((t.translation != read.cam_from_rig[0].translation).any() for t in read.cam_from_rig)

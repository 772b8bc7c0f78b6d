"""A finished calibration in the formats of other programs, beside its calibration.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_folder_atomically
from sfm_calib.formats.convert import FORMATS, FormatName, exported
from sfm_calib.formats.ours import rig_of
from sfm_calib.result import Calibration

FOLDER = "exports"


def write_exports(
    calibration: Calibration, formats: Sequence[FormatName], out: Path
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Write each format to a folder of its name in OUT/exports; what was written, with notes, and
    what was refused, which hinders no other."""
    said: list[str] = []
    refused: list[str] = []
    rig = rig_of(calibration, out / "calibration.json")
    for name in dict.fromkeys(formats):
        place = out / FOLDER / name
        try:
            export = exported(rig, name)
            files = {path or FORMATS[name].name: data for path, data in export.files.items()}
            write_folder_atomically(place, files)
        except CalibrationError as error:
            refused.append(f"--export {name}: {error}")
            continue
        said += [f"{place} written", *(f"  note: {note}" for note in export.notes)]
    return tuple(said), tuple(refused)

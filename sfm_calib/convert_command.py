"""`sfm-calib convert`: its arguments, and what it writes and prints."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically, write_folder_atomically
from sfm_calib.formats import NO_SIZE, CameraRig, read_calibration
from sfm_calib.formats.convert import FORMATS, MOST_ERROR_PX, FormatName, exported, format_of
from sfm_calib.formats.reading import image_size
from sfm_calib.formats.writing import Export
from sfm_calib.terminal import print_line, result_console


@dataclass(frozen=True)
class Convert:
    """Write a calibration in the format of another program, and say what of it that cannot hold.

    IN is a calibration.json, or a file or folder of another program, as `compare` reads them. OUT
    is a file, or a folder where the format has one.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(name="in", metavar="IN")]
    """A calibration: a file, or a folder that holds one."""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Where to write; its name tells the format where it can: calibration.json, camchain.yaml,
    FILE.xml."""
    to: FormatName | None = None
    """The format, where OUT's name does not tell it."""
    max_error_px: float = MOST_ERROR_PX
    """A lens that the format does not have is refitted; refused, where the nearest is off by more
    anywhere in the image."""
    camera: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME")] = None
    """Only these cameras, in this order."""
    metres: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """How many metres IN's unit of length is: 0.001 of a file in mm."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Image size in px of cameras for which IN states none."""
    overwrite: bool = False
    """Replace OUT."""


def run_convert(command: Convert) -> None:
    """Read, convert, write and print.

    Raises CalibrationError as `read_calibration`, `exported` and the writing of files do, and where
    OUT is there already.
    """
    to = format_of(command.out, command.to)
    rig = _as_told(read_calibration(command.source), command)
    export = exported(rig, to, _positive("--max-error-px", command.max_error_px))
    _write(command, export)
    console = result_console()
    count = len(rig.cameras)
    cameras = f"{count} camera{'s' if count > 1 else ''}, {', '.join(rig.names)}"
    print_line(console, f"{command.out} written: {FORMATS[to].title}, {cameras}")
    for note in (*rig.notes, *export.notes):
        print_line(console, f"note: {note}")


def _as_told(rig: CameraRig, command: Convert) -> CameraRig:
    if command.camera:
        rig = rig.only(command.camera)
    if command.metres is not None:
        rig = rig.metric(_positive("--metres", command.metres)).checked()
    if command.size:
        size = image_size("--size", *command.size)
        cameras = (replace(c, size=size) if c.size == NO_SIZE else c for c in rig.cameras)
        rig = replace(rig, cameras=tuple(cameras))
    return rig


def _positive(flag: str, value: float) -> float:
    if not 0 < value < np.inf:
        raise CalibrationError(f"{flag} {value:g} must be above 0")
    return value


def _write(command: Convert, export: Export) -> None:
    out, files = command.out, export.files
    is_file = len(files) == 1 and Path(*files).suffix in ("", out.suffix)  # or a folder with one
    empty = out.is_dir() and not any(out.iterdir())
    if is_file and out.is_dir():
        raise CalibrationError(f"{out} is a folder: name a file in it")
    if not is_file and out.exists() and not out.is_dir():
        raise CalibrationError(f"{out} is a file, and what is written goes into a folder")
    if os.path.lexists(out) and not command.overwrite and not empty:
        raise CalibrationError(f"{out} is there already: choose another name, or --overwrite")
    if is_file:
        write_atomically(out, *files.values())
    else:
        write_folder_atomically(out, files)

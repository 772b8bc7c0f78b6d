"""`sfm-calib compare`: its arguments, and what it writes and prints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from sfm_calib.compare import CompareOptions, compare_files
from sfm_calib.compare_terminal import print_compared
from sfm_calib.files import write_atomically
from sfm_calib.report.comparison import write_comparison
from sfm_calib.terminal import result_console


@dataclass(frozen=True)
class Compare:
    """Say how two calibrations differ: parameters, pixels, depths, and whether by chance.

    A and B are calibration.json, or files of OpenCV, ROS, COLMAP, Kalibr, Caliscope, Qualisys or
    KITTI. With -o, writes OUT/compare.json and OUT/compare.html.
    """

    a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")]
    """A calibration: a file, or a folder that holds one."""
    b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")]
    """The other; differences are B less A."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None
    """Folder for compare.json and compare.html; default: nothing is written."""
    options: Annotated[CompareOptions, tyro.conf.arg(name="")] = field(
        default_factory=CompareOptions
    )
    json: bool = False
    """Print compare.json on stdout instead of the tables."""


def run_compare(command: Compare) -> None:
    """Compare, write and print; OUT has to be there (`output.output_folder`).

    Raises CalibrationError as `compare_files`, and where OUT cannot be written.
    """
    compared = compare_files(command.a, command.b, command.options)
    text = compared.record.model_dump_json(indent=1)
    if command.out:
        write_comparison(compared.record, compared.found, command.out / "compare.html")
        write_atomically(command.out / "compare.json", text + "\n")
    if command.json:
        print(text)
        return
    console = result_console()
    print_compared(compared.record, console)
    if command.out:
        written = f"{command.out / 'compare.json'} and {command.out / 'compare.html'} written"
        console.print(written, soft_wrap=True)

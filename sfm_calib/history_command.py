"""`sfm-calib history`: its arguments, and what it writes and prints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from sfm_calib.files import write_atomically
from sfm_calib.history import HistoryOptions, history_of
from sfm_calib.history_terminal import PIPED_WIDTH, print_history
from sfm_calib.report.history import write_history
from sfm_calib.terminal import result_console


@dataclass(frozen=True)
class HistoryCommand:
    """List the calibrations of one rig over time, and how far each is from the one before.

    DIR is searched, with all folders in it, for calibrations of any format that can be read. With
    -o, writes OUT/history.html and OUT/history.json.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder that holds the calibrations."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None
    """Folder for history.html and history.json; default: nothing is written."""
    options: Annotated[HistoryOptions, tyro.conf.arg(name="")] = field(
        default_factory=HistoryOptions
    )
    json: bool = False
    """Print history.json on stdout instead of the tables."""


def run_history(command: HistoryCommand) -> None:
    """List, write and print; OUT has to be there (`output.output_folder`).

    Raises CalibrationError as `history_of`, and where OUT cannot be written.
    """
    record = history_of(command.folder, command.options)
    text = record.model_dump_json(indent=1)
    if command.out:
        write_history(record, command.out / "history.html")
        write_atomically(command.out / "history.json", text + "\n")
    if command.json:
        print(text)
        return
    console = result_console(PIPED_WIDTH)
    print_history(record, console)
    if command.out:
        written = f"{command.out / 'history.json'} and {command.out / 'history.html'} written"
        console.print(written, soft_wrap=True)

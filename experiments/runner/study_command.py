"""`sfm-calib study`: its arguments, and what it writes and prints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from experiments.runner.answer_page import write_page
from experiments.runner.answer_terminal import print_answer
from experiments.runner.cells import csv_of
from experiments.runner.index import write_index
from experiments.runner.verdict import Answered, answered
from sfm_calib.files import write_atomically
from sfm_calib.output import output_folder
from sfm_calib.terminal import print_line, result_console

ANSWER_FOLDER, PAGE_FILE, VERDICT_FILE = "answer", "answer.html", "verdict.json"
PIPED_WIDTH = 120


@dataclass(frozen=True)
class StudyCommand:
    """Draw what a study found: figures, tables, and the verdict beside what was expected.

    RESULTS is a folder that `run` wrote, or is writing: what has finished counts. Writes
    RESULTS/answer/answer.html, verdict.json and a CSV file a table.
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    """Folder that `sfm-calib run ... -o` wrote."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None
    """Folder for the answer; default: RESULTS/answer."""
    index: Annotated[Path | None, tyro.conf.arg(metavar="FILE.md")] = None
    """Also put the verdict into an index of studies, such as experiments/README.md."""
    json: bool = False
    """Print verdict.json on stdout instead of the tables."""

    def run(self, arguments: Sequence[str]) -> int:
        """Write and print; the exit code is 0 whatever the verdict.

        Raises CalibrationError as `answered` and `write_index`, and where OUT cannot be written.
        """
        found = answered(self.results)
        out = self.out or self.results / ANSWER_FOLDER
        with output_folder(out):
            text = write_answer(found, out)
        if self.index:
            write_index(found, self.index)
        if self.json:
            print(text)
            return 0
        console = result_console(PIPED_WIDTH)
        print_answer(found, console)
        names = ", ".join([VERDICT_FILE, *found.record.tables])
        index = f", {self.index}" if self.index else ""
        print_line(console, f"{out / PAGE_FILE}, {names}{index} written")
        return 0


def write_answer(found: Answered, out: Path) -> str:
    """Write tables, page and verdict.json, whose text is returned."""
    for name in _earlier_tables(out / VERDICT_FILE) - set(found.record.tables):
        (out / name).unlink(missing_ok=True)
    for table, name in zip(found.answer.tables, found.record.tables, strict=True):
        write_atomically(out / name, csv_of(table))
    write_page(found, out / PAGE_FILE)
    text = found.record.model_dump_json(indent=1)
    write_atomically(out / VERDICT_FILE, text + "\n")
    return text


def _earlier_tables(path: Path) -> set[str]:
    """CSV files that an earlier answer wrote beside its verdict.json."""
    names: list[object] = []
    with suppress(OSError, ValueError, KeyError, TypeError):
        names = list(json.loads(path.read_text("utf-8"))["tables"])
    return {n for n in names if isinstance(n, str) and n.endswith(".csv") and Path(n).name == n}

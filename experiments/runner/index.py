"""The index of studies in experiments/README.md: question, command, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.runner.sweep import StudyConfig, load_study, trials_of
from experiments.runner.verdict import Answered
from sfm_calib.errors import CalibrationError
from sfm_calib.files import read_text, write_atomically

BEGIN, END = "<!-- studies -->", "<!-- end of studies -->"
HEADING = ("| file | question | run | verdict |", "|---|---|---|---|")


def write_index(answered: Answered, path: Path) -> None:
    """Put a study's row in its place in the index; all other text stays as it is.

    Raises CalibrationError where the rows are not all that the indexed command makes, and where
    the file has no index.
    """
    text = read_text(path, "give a Markdown file")
    _check_whole(answered, path)
    write_atomically(path, with_row(text, row_of(answered), path))


def row_of(answered: Answered) -> tuple[str, str, str, str]:
    """File, question, command and verdict: the cells of the index, in Markdown."""
    said, record = answered.said, answered.record
    return (
        f"`{record.study}.py`",
        _escaped(said.question),
        f"`{said.command}`",
        _escaped(record.line),
    )


def with_row(text: str, row: Sequence[str], path: Path) -> str:
    """The file's text with this row in place of the one of the same file, else as the last."""
    before, begin, rest = text.partition(BEGIN)
    inside, end, after = rest.partition(END)
    if not begin or not end:
        raise CalibrationError(
            f"{path} has no index of studies: put the lines {BEGIN} and {END} where it shall be"
        )
    lines = inside.splitlines()
    if len(_table(lines)) < len(HEADING):
        lines = ["", *HEADING]
    table, line = _table(lines), f"| {' | '.join(row)} |"
    same = [k for k in table[len(HEADING) :] if _cells(lines[k])[0] == row[0]]
    if same:
        lines[same[0]] = line
    else:
        lines.insert(table[-1] + 1, line)
    return before + begin + "\n".join(lines) + "\n" + end + after


def indexed(text: str) -> dict[str, tuple[str, ...]]:
    """The rows of the index by their first cell; empty where there is none."""
    lines = text.partition(BEGIN)[2].partition(END)[0].splitlines()
    rows = [_cells(lines[k]) for k in _table(lines)[len(HEADING) :]]
    return {cells[0]: cells for cells in rows}


def _table(lines: Sequence[str]) -> list[int]:
    """Which lines are those of the Markdown table, its heading first."""
    return [k for k, line in enumerate(lines) if line.startswith("|")]


def _cells(line: str) -> tuple[str, ...]:
    bar = "\0"
    cells = line.replace(r"\|", bar).strip().strip("|").split("|")
    return tuple(cell.strip().replace(bar, r"\|") for cell in cells)


def _escaped(text: str) -> str:
    """Text from outside in a cell of a Markdown table."""
    text = " ".join(text.split()).replace("\\", "\\\\").replace("|", r"\|")
    return text.replace("<", "&lt;")


def _check_whole(answered: Answered, path: Path) -> None:
    """Raises CalibrationError unless the command in the index makes exactly these rows."""
    said, record = answered.said, answered.record
    if record.trials.finished < record.trials.asked:
        raise CalibrationError(
            f"{record.trials.finished} of {record.trials.asked} trials of {record.study} are "
            "finished, and the index is for whole studies: finish the run first"
        )
    if record.trials.broken:
        raise CalibrationError(
            f"{record.trials.broken} trials of {record.study} were broken off by the machine: run "
            "it again, which does these anew"
        )
    if not said.command:
        raise CalibrationError(
            f"the docstring of {record.study} does not say its command: add 'Run: sfm-calib run "
            "configs/studies/NAME.yaml -o out/NAME'"
        )
    config = _config(said.config, path)
    if [t.key for t in trials_of(config)] != [t.key for t in answered.results.trials]:
        raise CalibrationError(
            f"the rows are not those of {said.config}, whose command the index has: run it as it "
            "is, without --set"
        )


def _config(name: str, path: Path) -> StudyConfig:
    """The config that a command names, from the index's folder or one above it."""
    for folder in path.resolve().parents:
        if (folder / name).is_file():
            return load_study(folder / name)
    raise CalibrationError(f"{name} is in no folder above {path}: the index has its command")

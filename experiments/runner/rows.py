"""Rows of finished trials: a Parquet file each, and one of all when a run ends.

RESULTS/study.yaml     the config, with all that was set by hand
RESULTS/trials.json    the trials that it asks for, in order
RESULTS/rows/KEY.parquet   a trial, written when it has finished; those of earlier configs stay
RESULTS/rows.parquet   the rows of this config, in its order
"""

from __future__ import annotations

import importlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import yaml

from experiments.runner.protocol import Cell, Finished
from experiments.runner.registry import study_of
from experiments.runner.sweep import StudyConfig, Trial, load_study
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically

STUDY_FILE, TRIALS_FILE = "study.yaml", "trials.json"
ROWS_FOLDER, ROWS_FILE = "rows", "rows.parquet"
OPTIONS, META = "options.", "trial."  # what columns begin with that a trial did not measure


# refused: its input, by a message; failed: by a bug; broken: the machine did it, and another run
# may do better.
Ending = Literal["done", "refused", "failed", "broken"]


@dataclass(frozen=True)
class StoredRow:
    """A finished trial with what is known of how it ran."""

    key: str
    seed: int
    ending: Ending
    row: dict[str, Cell]  # empty unless done
    error: str | None
    traceback: str | None  # of a failure that is no refusal
    seconds: float
    created: datetime
    version: str  # of sfm_calib
    versions: dict[str, str]  # of libraries
    git: str  # state of the code, "" where it is no repository
    host: str


@dataclass(frozen=True)
class Results:
    """A study's config, the trials it asks for, and the rows there are."""

    config: StudyConfig
    trials: list[Trial]
    finished: dict[str, StoredRow]

    @property
    def in_order(self) -> list[Finished[Any]]:
        """The finished trials as the study's answer takes them."""
        return [
            Finished(trial.options, trial.seed, one.row, one.seconds, one.error)
            for trial in self.trials
            if (one := self.finished.get(trial.key))
        ]


def arrow() -> Any:
    """pyarrow, its Parquet loaded. Raises CalibrationError where it is not installed."""
    try:
        importlib.import_module("pyarrow.parquet")
        return importlib.import_module("pyarrow")
    except ImportError as error:
        raise CalibrationError(
            "studies keep their rows in Parquet files, which need pyarrow: "
            "pip install 'sfm_calib[studies]'"
        ) from error


# ---- one row -------------------------------------------------------------------------------


def write_row(results: Path, trial: Trial, stored: StoredRow) -> None:
    """Write a trial's row: whole, or not at all."""
    columns: dict[str, Cell] = {META + "key": stored.key, META + "study": trial.study}
    for name, value in trial.options.model_dump(mode="json").items():
        columns[OPTIONS + name] = cell(value)
    columns |= stored.row
    columns |= {
        META + "seed": stored.seed,
        META + "ending": stored.ending,
        META + "error": stored.error,
        META + "traceback": stored.traceback,
        META + "seconds": stored.seconds,
        META + "created": stored.created.isoformat(),
        META + "version": stored.version,
        META + "git": stored.git,
        META + "host": stored.host,
        META + "versions": json.dumps(stored.versions),
        META + "measured": json.dumps(list(stored.row)),
    }
    table = arrow().Table.from_pylist([columns])
    write_atomically(results / ROWS_FOLDER / f"{stored.key}.parquet", _bytes(table))


def check_cells(row: Mapping[str, Cell]) -> None:
    """Raises what Parquet raises where it cannot hold them, such as lists of texts and numbers."""
    arrow().Table.from_pylist([dict(row)])


def cell(value: Any) -> Any:
    """As Parquet holds it: what is nested becomes JSON, and numpy's numbers Python's."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return json.dumps(value)
    if isinstance(value, list | tuple):
        plain = [item.item() if hasattr(item, "item") else item for item in value]
        nested = any(isinstance(item, dict | list | tuple) for item in plain)
        return json.dumps(plain) if nested else plain
    return value


def _bytes(table: Any) -> bytes:
    buffer = io.BytesIO()
    arrow().parquet.write_table(table, buffer)
    return buffer.getvalue()


def read_row(path: Path) -> StoredRow:
    """A trial's row. Raises CalibrationError for a file that is none."""
    try:
        (columns,) = arrow().parquet.ParquetFile(path).read().to_pylist()
        if columns[META + "key"] != path.stem:
            raise ValueError(f"it is that of trial {columns[META + 'key']}")
        return StoredRow(
            key=columns[META + "key"],
            seed=columns[META + "seed"],
            ending=columns[META + "ending"],
            row={name: columns[name] for name in json.loads(columns[META + "measured"])},
            error=columns[META + "error"],
            traceback=columns[META + "traceback"],
            seconds=columns[META + "seconds"],
            created=datetime.fromisoformat(columns[META + "created"]),
            version=columns[META + "version"],
            versions=json.loads(columns[META + "versions"]),
            git=columns[META + "git"],
            host=columns[META + "host"],
        )
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise CalibrationError(
            f"{path} is not its trial's row ({error_line(error)}): run the study again, which "
            "makes it anew"
        ) from error


def error_line(error: BaseException) -> str:
    """The first line of what an error says, or its kind where it says nothing."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return line.encode("utf-8", "replace").decode()  # names of files may hold what Parquet cannot


# ---- all rows ------------------------------------------------------------------------------


def read_rows(results: Path, trials: Sequence[Trial], strict: bool = True) -> dict[str, StoredRow]:
    """The rows there are of these trials, by key.

    Raises CalibrationError for files that hold none, unless not `strict`: then they are not there.
    """
    folder = results / ROWS_FOLDER
    there = {path.stem for path in folder.glob("*.parquet")}
    wanted = [trial.key for trial in trials if trial.key in there]
    rows, unreadable = {}, []
    for key in wanted:
        try:
            rows[key] = read_row(folder / f"{key}.parquet")
        except CalibrationError as error:
            unreadable.append(error)
    if unreadable and strict:
        more = f" ({len(unreadable)} files are so)" if len(unreadable) > 1 else ""
        raise CalibrationError(f"{unreadable[0]}{more}")
    return rows


def read_results(results: Path) -> Results:
    """A study that was run, or is running.

    Raises CalibrationError where there is none.
    """
    if not (results / STUDY_FILE).exists():
        raise CalibrationError(
            f"{results} holds no study ({STUDY_FILE} is missing): give the folder that "
            "`sfm-calib run ... -o` wrote"
        )
    config = load_study(results / STUDY_FILE)
    trials = _read_trials(results / TRIALS_FILE, config.study)
    return Results(config, trials, read_rows(results, trials))


def forget(results: Path, trials: Sequence[Trial]) -> None:
    """Remove the rows of trials that are done again: whatever interrupts that, none is old."""
    for trial in trials:
        (results / ROWS_FOLDER / f"{trial.key}.parquet").unlink(missing_ok=True)


def write_config(results: Path, config: StudyConfig, trials: Sequence[Trial]) -> None:
    """Write what the rows of RESULTS are of: to read them, no file that trials read is needed."""
    listed = [
        {"key": t.key, "seed": t.seed, "options": t.options.model_dump(mode="json")} for t in trials
    ]
    write_atomically(results / TRIALS_FILE, json.dumps(listed))
    content = config.model_dump(mode="json", exclude_defaults=True)
    write_atomically(results / STUDY_FILE, yaml.safe_dump(content, sort_keys=False))


def _read_trials(path: Path, study: str) -> list[Trial]:
    options = study_of(study).options
    try:
        listed = json.loads(path.read_text(encoding="utf-8"))
        return [
            Trial(study, options.model_validate(t["options"]), t["seed"], t["key"]) for t in listed
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CalibrationError(
            f"{path} is not there, or of another release ({error_line(error)}): run the study again"
        ) from error


def write_all(results: Path, trials: Sequence[Trial]) -> None:
    """Put the rows of these trials, in their order, into one file."""
    folder = results / ROWS_FOLDER
    paths = (folder / f"{trial.key}.parquet" for trial in trials)
    tables = [arrow().parquet.ParquetFile(path).read() for path in paths if path.exists()]
    if tables:
        write_atomically(results / ROWS_FILE, _bytes(_joined(tables)))


def _joined(tables: Sequence[Any]) -> Any:
    """One table; a column that is of several kinds, in several rows, becomes JSON texts."""
    pyarrow = arrow()
    try:
        return pyarrow.concat_tables(tables, promote_options="permissive")
    except (pyarrow.ArrowTypeError, pyarrow.ArrowInvalid):
        rows = [row for table in tables for row in table.to_pylist()]
        kinds: dict[str, set[str]] = {}
        for row in rows:
            for name, value in row.items():
                kinds.setdefault(name, set()).update(_kind(value))
        mixed = {name for name, of in kinds.items() if len(of) > 1}
        texts = [{n: json.dumps(v) if n in mixed else v for n, v in row.items()} for row in rows]
        return pyarrow.concat_tables(
            [pyarrow.Table.from_pylist([row]) for row in texts], promote_options="permissive"
        )


def _kind(value: object) -> tuple[str, ...]:
    """What a column may hold one of, besides nothing."""
    if value is None:
        return ()
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return ("number" if number else type(value).__name__,)


def now() -> datetime:
    """In UTC."""
    return datetime.now(UTC)

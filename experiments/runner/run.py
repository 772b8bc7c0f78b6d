"""Run the trials of a study that are not finished yet."""

from __future__ import annotations

import fcntl
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.runner.attempt import Job
from experiments.runner.cluster import run_on
from experiments.runner.pool import run_here
from experiments.runner.registry import study_of
from experiments.runner.rows import (
    STUDY_FILE,
    StoredRow,
    forget,
    read_rows,
    write_all,
    write_config,
    write_row,
)
from experiments.runner.sweep import StudyConfig, Trial, load_study
from sfm_calib.errors import CalibrationError

LOCK_FILE = ".lock"
FEWEST_TIMED = 5  # trials: the first ones take longer, for what workers load
Told = Callable[[StoredRow], None]


@dataclass(frozen=True)
class Plan:
    """The trials of a config, and the rows that there are of them already."""

    config: StudyConfig
    trials: Sequence[Trial]
    finished: dict[str, StoredRow]
    processes: int  # on this machine
    again: bool = False  # rows that are there are made anew

    @property
    def todo(self) -> list[Trial]:
        return [trial for trial in self.trials if trial.key not in self.finished]

    @property
    def seconds(self) -> float | None:
        """How long the rest takes on this machine; None: nothing is known of it."""
        groups: dict[str, list[float]] = {}
        for trial in self.trials:
            if trial.key in self.finished:
                groups.setdefault(_combination(trial), []).append(self.finished[trial.key].seconds)
        every = [seconds for some in groups.values() for seconds in some]
        otherwise = statistics.median(every) if every else self.config.seconds
        total = 0.0
        for trial in self.todo:
            some = groups.get(_combination(trial))
            expected = statistics.median(some) if some else otherwise
            if expected is None:
                return None
            total += expected
        return total / self.processes


def _combination(trial: Trial) -> str:
    return trial.options.model_dump_json()


def plan(
    config: StudyConfig,
    trials: Sequence[Trial],
    out: Path,
    processes: int | None = None,
    retry: bool = False,
    fresh: bool = False,
) -> Plan:
    """What is there and what is to be done. Rows that the machine broke are done again.

    processes: default, as many as the cores allow. retry: all that failed again; fresh: everything.

    Raises CalibrationError where OUT holds another study.
    """
    check_study(out, config)
    for path in {path for one in trials for path in study_of(one.study).inputs(one.options)}:
        if out.exists() and path.is_dir() and path.resolve() == out.resolve():
            raise CalibrationError(f"-o {out} is what trials read: choose another folder")
    rows = {} if fresh else read_rows(out, trials, strict=False)
    again = ("broken", "failed", "refused") if retry else ("broken",)
    rows = {key: row for key, row in rows.items() if row.ending not in again}
    cores = len(os.sched_getaffinity(0))
    threads = cores if config.threads == "all" else config.threads
    return Plan(config, trials, rows, processes or max(1, cores // threads), retry or fresh)


def check_study(out: Path, config: StudyConfig) -> None:
    """Raises CalibrationError where OUT holds another study."""
    if (out / STUDY_FILE).exists():
        try:
            other = load_study(out / STUDY_FILE).study
        except CalibrationError:  # it is written anew; rows know their study
            return
        if other != config.study:
            raise CalibrationError(
                f"{out} holds results of the study {other!r}: choose another folder with -o"
            )


def run(plan: Plan, out: Path, client: Any, told: Told) -> dict[str, StoredRow]:
    """Run what is to be done; every row is written as it finishes. All rows, by key.

    client: of a Dask scheduler (`connected`); None: this machine.

    told: called with each row after it was written.

    Raises CalibrationError where another run writes to OUT, and as `run_on`.
    """
    with locked(out):
        check_study(out, plan.config)
        done = (
            read_rows(out, plan.todo, strict=False) if not plan.again else {}
        )  # by a run that has just ended
        rows = {**plan.finished, **{k: r for k, r in done.items() if r.ending != "broken"}}
        todo = {trial.key: trial for trial in plan.trials if trial.key not in rows}
        forget(out, list(todo.values()))
        write_config(out, plan.config, plan.trials)
        jobs = (job_of(trial, plan.config, out) for trial in todo.values())
        try:
            for row in run_on(client, jobs) if client else run_here(jobs, plan.processes):
                write_row(out, todo[row.key], row)
                rows[row.key] = row
                told(row)
        finally:
            write_all(out, plan.trials)
    return rows


def job_of(trial: Trial, config: StudyConfig, out: Path) -> Job:
    """The trial as it is sent to where it runs."""
    options = json.dumps(trial.options.model_dump(mode="json"))
    results = os.fspath(out.resolve())
    return Job(trial.key, trial.study, options, trial.seed, config.threads, results)


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """OUT for this run alone. Raises CalibrationError where another has it.

    The lock ends with its process, however it ends; the file stays.
    """
    with (out / LOCK_FILE).open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise CalibrationError(
                f"another run is writing to {out}: wait for it, or choose another folder with -o"
            ) from error
        yield


class Pace:
    """How long the rest will take, from the trials that this run has finished."""

    def __init__(self, total: int, done: int) -> None:
        self.total, self.done, self.failed = total, done, 0
        self._before, self._began = done, time.monotonic()

    def count(self, row: StoredRow) -> None:
        self.done += 1
        self.failed += row.error is not None

    @property
    def seconds_left(self) -> float | None:
        ours = self.done - self._before
        if ours < FEWEST_TIMED:
            return None
        return (time.monotonic() - self._began) / ours * (self.total - self.done)

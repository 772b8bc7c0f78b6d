"""One trial, run here: on this machine's worker process, or on a cluster's."""

from __future__ import annotations

import os
import platform
import subprocess
import threading
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import sfm_calib
from experiments.runner.protocol import Cell
from experiments.runner.registry import study_of
from experiments.runner.rows import Ending, StoredRow, cell, check_cells, error_line, now
from graphs.threads import at_most
from sfm_calib.errors import BrokenDownError, CalibrationError

LIBRARIES = ("numpy", "scipy", "numba", "gtsam", "pycolmap", "opencv-contrib-python-headless")
GIT = "git"  # the name of the code's own state among versions
TRIALS_FOLDER = "trials"
ONE_AT_A_TIME = threading.Lock()  # kernels of one process cannot be used by two of its threads

Threads = int | Literal["all"]


@dataclass(frozen=True)
class Job:
    """A trial as it is sent to where it runs: nothing but plain values."""

    key: str
    study: str
    options: str  # JSON
    seed: int
    threads: Threads
    results: str  # the folder, absolute


def attempt(job: Job) -> StoredRow:
    """Run a trial; whatever it raises becomes its row."""
    with ONE_AT_A_TIME, at_most(None if job.threads == "all" else job.threads):
        began = time.perf_counter()
        try:
            study = study_of(job.study)
            options = study.options.model_validate_json(job.options)
            folder = {"folder": trial_folder(Path(job.results), job.key)} if study.folder else {}
            row = {
                name: cell(value)
                for name, value in study.trial(options, job.seed, **folder).items()
            }
            check_cells(row)
        except (Exception, SystemExit) as error:
            return failed(job, error, time.perf_counter() - began)
        return stored(job, "done", time.perf_counter() - began, row=row)


def failed(job: Job, error: BaseException, seconds: float) -> StoredRow:
    """The row of a trial that raised an error: a refusal, the machine's fault, or a bug."""
    message, trace = error_line(error), "".join(traceback.format_exception(error))
    if isinstance(error, BrokenDownError | MemoryError):
        return stored(job, "broken", seconds, error=message)
    if isinstance(error, CalibrationError):
        return stored(job, "refused", seconds, error=message)
    if isinstance(error, ValueError):
        return stored(job, "refused", seconds, error=message, trace=trace)
    return stored(job, "failed", seconds, error=f"{type(error).__name__}: {message}", trace=trace)


def stored(
    job: Job,
    ending: Ending,
    seconds: float,
    *,
    row: dict[str, Cell] | None = None,
    error: str | None = None,
    trace: str | None = None,
) -> StoredRow:
    """The row with what is known of how it was made."""
    return StoredRow(
        key=job.key,
        seed=job.seed,
        ending=ending,
        row=row or {},
        error=error,
        traceback=trace,
        seconds=seconds,
        created=now(),
        version=sfm_calib.__version__,
        versions=library_versions(),
        git=git_state(),
        host=platform.node(),
    )


def trial_folder(results: Path, key: str) -> Path:
    """Where a trial leaves files."""
    return results / TRIALS_FOLDER / key


@cache
def library_versions() -> dict[str, str]:
    """Python's, and of the libraries that decide numbers."""
    known = {"python": platform.python_version(), "sfm_calib": sfm_calib.__version__}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):  # OpenCV comes under several names
            known[name] = version(name)
    return known


def code_state() -> dict[str, str]:
    """What rows depend on beside their options: it must be alike wherever trials run."""
    return {**library_versions(), GIT: git_state()}


@cache
def git_state() -> str:
    """The commit of the code that runs, and whether it was changed since; "" where unknown."""
    here = Path(__file__).parent
    try:
        said = subprocess.run(
            ["git", "-C", os.fspath(here), "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    return said.stdout.strip()

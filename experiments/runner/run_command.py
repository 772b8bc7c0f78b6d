"""`sfm-calib run`: its arguments, and what it prints."""

from __future__ import annotations

import shlex
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from experiments.runner.cluster import connected
from experiments.runner.registry import study_of
from experiments.runner.rows import StoredRow, arrow
from experiments.runner.run import Pace, Plan, plan, run
from experiments.runner.sweep import Trial, in_words, load_study, trials_of
from sfm_calib.errors import CalibrationError
from sfm_calib.output import output_folder
from sfm_calib.terminal import print_line, result_console

EXIT_NONE_DONE = 1
MOST_SHOWN = 20  # trials of a dry run
MOST_NAMES = 60  # options
SECONDS_BETWEEN_LINES = 5.0


@dataclass(frozen=True)
class RunCommand:
    """Run a study: every trial of its YAML, a row each; finished trials are not run again.

    Rows go to OUT/rows as they finish, and together to OUT/rows.parquet. A run that was interrupted
    goes on where it was. `sfm-calib study OUT` draws the answer. Exits with 1 where no trial was
    done: all were refused (their input, by a message), failed (a bug), or broken (the machine).
    """

    config: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="YAML")]
    """The study, as in configs/studies."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None
    """Folder for the rows; default: out/NAME, as the YAML is called."""
    set: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")
    ] = ()
    """In place of what the YAML says: seeds=5, options.points=300, 'grid.rig=[mono, stereo]'."""
    jobs: Annotated[int | None, tyro.conf.arg(aliases=("-j",), metavar="N")] = None
    """Trials at a time on this machine; default: as many as it has cores for."""
    cluster: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Run on the Dask cluster whose scheduler is there, such as tcp://10.0.0.1:8786, or which its
    scheduler file describes."""
    dry_run: bool = False
    """Print the trials and the time they will take, and run none."""
    retry: bool = False
    """Run trials again that were refused or failed; broken ones always are."""
    fresh: bool = False
    """Run all trials again."""

    def run(self, arguments: Sequence[str]) -> int:
        """Plan, run, and say how it went; the exit code."""
        if self.jobs is not None and self.jobs < 1:
            raise CalibrationError(f"--jobs {self.jobs}: give 1 or more")
        arrow()  # now rather than after the first trial
        config = load_study(self.config, self.set)
        trials = trials_of(config)
        out = self.out or Path("out") / self.config.stem
        planned = plan(config, trials, out, self.jobs, self.retry, self.fresh)
        console = result_console()
        _print_missing(planned.todo)
        if self.dry_run:
            _print_plan(planned, out, console)
            return 0
        with (
            output_folder(out),
            connected(self.cluster) as client,
            _progress(planned, self.cluster) as told,
        ):
            rows = run(planned, out, client, told)
        _print_end(planned, rows, out, console)
        return 0 if any(row.ending == "done" for row in rows.values()) else EXIT_NONE_DONE


def _print_missing(trials: Sequence[Trial]) -> None:
    """Say on stderr what trials will refuse for."""
    read = dict.fromkeys(p for one in trials for p in study_of(one.study).inputs(one.options))
    for path in (path for path in read if not path.exists()):
        print(f"note: {path} is not there; trials that read it will be refused", file=sys.stderr)


def _print_plan(planned: Plan, out: Path, console: Console) -> None:
    todo = planned.todo
    for trial in todo[:MOST_SHOWN]:
        print_line(console, f"{trial.key}  {in_words(trial, planned.config)}")
    if len(todo) > MOST_SHOWN:
        print_line(console, f"... and {len(todo) - MOST_SHOWN} more")
    done = len(planned.trials) - len(todo)
    finished = f", {done} of them finished in {out}" if done else ""
    seconds = planned.seconds
    if seconds is None:
        took = "how long one takes is not known: run some, or say it (seconds: in the YAML)"
    else:
        many = f"{planned.processes} at a time" if planned.processes > 1 else "one at a time"
        took = f"about {duration(seconds)} on this machine, {many}"
    names = ", ".join(sorted(study_of(planned.config.study).options.model_fields)[:MOST_NAMES])
    print_line(console, f"options of {planned.config.study}: {names}")
    print_line(console, f"{len(planned.trials)} trials{finished}; {took}")


def _print_end(planned: Plan, rows: dict[str, StoredRow], out: Path, console: Console) -> None:
    endings = Counter(row.ending for row in rows.values())
    said = ", ".join(f"{count} {ending}" for ending, count in endings.items())
    print_line(console, f"{len(planned.trials)} trials: {said}; rows in {out}")
    errors = Counter(row.error for row in rows.values() if row.error is not None)
    for error, count in errors.most_common(MOST_SHOWN):
        print_line(console, f"  {count} x {error}")
    print_line(console, f"sfm-calib study {shlex.quote(str(out))} draws the answer")


def duration(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} min"
    return f"{seconds / 3600:.1f} h"


@contextmanager
def _progress(planned: Plan, cluster: str | None) -> Iterator[Callable[[StoredRow], None]]:
    """A bar with the time left; plain lines where stderr is no terminal."""
    total, left = len(planned.trials), len(planned.todo)
    pace = Pace(total, total - left)
    where = f"on {cluster}" if cluster else f"{planned.processes} at a time"
    if pace.done == total:
        print(f"all {total} trials are finished already", file=sys.stderr)
    elif pace.done:
        print(f"{pace.done} of {total} trials are finished already", file=sys.stderr)
    console = Console(stderr=True)
    if not (left and console.is_terminal):
        printed = time.monotonic()

        def line(row: StoredRow) -> None:
            nonlocal printed
            pace.count(row)
            if time.monotonic() - printed > SECONDS_BETWEEN_LINES:
                printed = time.monotonic()
                print(f"trials {pace.done} of {total}{_how(pace)}", file=sys.stderr, flush=True)

        if left:
            print(f"trials {pace.done} of {total}, {where}", file=sys.stderr, flush=True)
        yield line
        return
    columns: Any = (
        TextColumn("trials"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[how]}"),
    )
    with Progress(*columns, console=console) as bars:
        task = bars.add_task("trials", total=total, completed=pace.done, how=where)

        def advance(row: StoredRow) -> None:
            pace.count(row)
            bars.update(task, completed=pace.done, how=_how(pace).removeprefix(", "))

        yield advance


def _how(pace: Pace) -> str:
    failed = f", {pace.failed} failed" if pace.failed else ""
    left = pace.seconds_left
    if left is None or pace.done == pace.total:
        return failed
    return f"{failed}, about {duration(left)} left"

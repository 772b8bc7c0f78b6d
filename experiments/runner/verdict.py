"""What a study answers, and what its answer rests on: verdict.json."""

from __future__ import annotations

import os
import re
import shlex
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from experiments.runner.cells import one_line
from experiments.runner.docstring import Said, said
from experiments.runner.protocol import Answer
from experiments.runner.registry import about, study_of
from experiments.runner.rows import (
    ROWS_FOLDER,
    STUDY_FILE,
    Ending,
    Results,
    StoredRow,
    read_results,
)
from experiments.runner.sweep import Trial, in_words
from sfm_calib.errors import CalibrationError
from sfm_calib.record import Record

DIRTY = "-dirty"  # as `git describe` says it
DASH = "–"
NUMBER = re.compile(r"-?\d+(\.\d+)?(e[-+]?\d+)?")

Holds = Literal["as expected", "not as expected", "no verdict"]


class Failure(Record):
    """Trials that failed in one way: their errors differ in numbers alone."""

    error: str  # of the first
    count: int
    first: str  # its seed, and what of its options was swept
    ending: Ending
    traceback: str | None


class Counts(Record):
    """Of trials."""

    asked: int
    finished: int  # those that failed among them
    failed: int  # in whatever way
    broken: int  # by the machine, those of them
    elsewhere: int  # rows of the folder that this config does not ask for


class Origin(Record):
    """Where and when the rows were made; how many of each."""

    versions: dict[str, int]
    libraries: dict[str, dict[str, int]]
    git: dict[str, int]
    hosts: dict[str, int]
    seconds: float  # of all trials in sum
    first: datetime | None
    last: datetime | None


class Verdict(Record):
    """verdict.json."""

    format: Literal["sfm_calib_study/1"] = "sfm_calib_study/1"
    study: str
    question: str
    verdict: str
    holds: bool | None
    said: Holds
    trials: Counts
    warnings: tuple[str, ...]
    failures: tuple[Failure, ...]
    tables: tuple[str, ...]  # file names
    config: dict[str, Any]
    origin: Origin

    @property
    def line(self) -> str:
        """The verdict as it is printed, and as the index has it."""
        return f"{self.said} {DASH} {self.verdict}"


MOST_FAILED = 0.05  # of the finished trials: with more no expectation is met


@dataclass(frozen=True)
class Answered:
    """A study's answer with all that is said beside it."""

    said: Said
    answer: Answer
    record: Verdict
    results: Results


def answered(folder: Path) -> Answered:
    """What the rows in RESULTS answer: all there are, also while the study runs.

    Raises CalibrationError where there is no study, and where its answer cannot be drawn.
    """
    results = read_results(folder)
    words = said(about(results.config.study))
    answer = _answer(results)
    stored = [results.finished[t.key] for t in results.trials if t.key in results.finished]
    there = sum(1 for _ in (folder / ROWS_FOLDER).glob("*.parquet"))
    counts = Counts(
        asked=len(results.trials),
        finished=len(stored),
        failed=sum(one.error is not None for one in stored),
        broken=sum(one.ending == "broken" for one in stored),
        elsewhere=max(there - len(stored), 0),
    )
    origin = _origin(stored)
    # A study that refuses its hard part is no proof; one that counts refusals says no by itself.
    proves = counts.failed <= MOST_FAILED * counts.finished or not answer.holds
    holds = None if answer.holds is None or not proves else bool(answer.holds)
    record = Verdict(
        study=results.config.study,
        question=words.question,
        verdict=one_line(answer.verdict),
        holds=holds,
        said={True: "as expected", False: "not as expected", None: "no verdict"}[holds],
        trials=counts,
        warnings=tuple(map(one_line, _warnings(folder, counts, origin))),
        failures=_failures(results),
        tables=tuple(table_files(answer)),
        config=results.config.model_dump(mode="json", exclude_defaults=True),
        origin=origin,
    )
    return Answered(words, answer, record, results)


def _answer(results: Results) -> Answer:
    """As the study gives it: an error in it is named by its place, not by a traceback."""
    study = results.config.study
    try:
        answer: Answer = study_of(study).answer(results.in_order)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise CalibrationError(
            f"the answer of {study} cannot be drawn from {len(results.finished)} of "
            f"{len(results.trials)} trials: {type(error).__name__}: {error} "
            f"({Path(place.filename).name}, line {place.lineno})"
        ) from error
    return answer


def table_files(answer: Answer) -> list[str]:
    """The name of each table's CSV; no two are the same."""
    names: list[str] = []
    for table in answer.tables:
        name = re.sub(r"[^\w-]+", "_", table.name, flags=re.ASCII).strip("_") or "table"
        while f"{name}.csv" in names:
            name += "_"
        names.append(f"{name}.csv")
    return names


# ---- failures ------------------------------------------------------------------------------


def _failures(results: Results) -> tuple[Failure, ...]:
    """The ways in which trials failed, the most frequent first."""
    ways: dict[tuple[str, str], list[tuple[Trial, StoredRow]]] = {}
    for trial in results.trials:
        one = results.finished.get(trial.key)
        if one is not None and one.error is not None:
            ways.setdefault((one.ending, NUMBER.sub("#", one.error)), []).append((trial, one))
    found = [
        Failure(
            error=rows[0][1].error or "",
            count=len(rows),
            first=in_words(rows[0][0], results.config),
            ending=rows[0][1].ending,
            traceback=rows[0][1].traceback,
        )
        for rows in ways.values()
    ]
    return tuple(sorted(found, key=lambda failure: -failure.count))


# ---- where rows come from ------------------------------------------------------------------


def _origin(stored: Sequence[StoredRow]) -> Origin:
    names = dict.fromkeys(name for one in stored for name in one.versions)
    moments = [one.created for one in stored]
    return Origin(
        versions=dict(Counter(one.version for one in stored)),
        libraries={
            name: dict(Counter(one.versions[name] for one in stored if name in one.versions))
            for name in names
        },
        git=dict(Counter(one.git for one in stored)),
        hosts=dict(Counter(one.host for one in stored)),
        seconds=sum(one.seconds for one in stored),
        first=min(moments, default=None),
        last=max(moments, default=None),
    )


def _warnings(folder: Path, counts: Counts, origin: Origin) -> list[str]:
    """Why the answer may not be what one fresh run of the whole study would say."""
    found = []
    if counts.finished < counts.asked:
        found.append(
            f"{counts.finished} of {counts.asked} trials: the rest are not run yet; run again "
            f"with: {again(folder)}"
        )
        if counts.elsewhere:
            found.append(
                f"{counts.elsewhere} more rows in {folder / ROWS_FOLDER} are of another config, "
                "another version or other inputs, and do not count"
            )
    if counts.broken:
        found.append(
            f"{counts.broken} trials were broken off by the machine, which says nothing of them; "
            f"run again with: {again(folder)}"
        )
    mixed = {"versions of sfm_calib": origin.versions, "states of the code": origin.git}
    mixed |= {f"versions of {name}": held for name, held in origin.libraries.items()}
    for what, held in mixed.items():
        if len(held) > 1:
            listed = ", ".join(f"{name or 'unknown'} ({count})" for name, count in held.items())
            found.append(f"rows come from {len(held)} {what}: {listed}")
    if dirty := sum(count for state, count in origin.git.items() if state.endswith(DIRTY)):
        found.append(
            f"{dirty} of {counts.finished} rows: their code was changed and not committed, so that "
            "no commit makes them again"
        )
    return found


def again(folder: Path) -> str:
    """The command that runs what is missing."""
    return shlex.join(["sfm-calib", "run", os.fspath(folder / STUDY_FILE), "-o", os.fspath(folder)])

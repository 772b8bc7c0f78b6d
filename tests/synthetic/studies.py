"""Small studies, and what runs of them leave."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from experiments.runner.rows import StoredRow, read_results
from experiments.runner.run import Plan, plan, run
from experiments.runner.sweep import load_study, trials_of

STUDY = "study: example\ngrid: {draws: [2, 5]}\nseeds: 4\n"


def study(folder: Path, text: str = STUDY) -> Path:
    path = folder / "some.yaml"
    path.write_text(text)
    return path


def rows_of(out: Path) -> dict[str, dict[str, object]]:
    """What was measured, by trial; no times."""
    return {key: dict(stored.row) for key, stored in read_results(out).finished.items()}


def planned(path: Path, out: Path, **kinds: bool) -> Plan:
    config = load_study(path)
    out.mkdir(exist_ok=True)
    return plan(config, trials_of(config), out, 2, **kinds)


def here(path: Path, out: Path, **kinds: bool) -> list[StoredRow]:
    """The rows that this run made."""
    made: list[StoredRow] = []
    run(planned(path, out, **kinds), out, None, made.append)
    return made


def command(path: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "sfm_calib", "run", str(path), "-o", str(out), *more]


def wait_for(path: Path) -> None:
    wait_until(path.exists)


def wait_until(true: Callable[[], bool], seconds: float = 120.0) -> None:
    until = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < until, "it did not come"
        time.sleep(0.02)

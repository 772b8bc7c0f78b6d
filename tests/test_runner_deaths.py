"""Runs of studies whose runner, workers or cluster die."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow.parquet
import pytest
from synthetic.studies import command, here, planned, rows_of, study, wait_for, wait_until

from experiments.runner.attempt import Job
from experiments.runner.cluster import _check_alike, connected
from experiments.runner.pool import Slot
from experiments.runner.rows import StoredRow, read_row
from experiments.runner.run import run
from sfm_calib.errors import CalibrationError

KILLS = 20


# ---- deaths --------------------------------------------------------------------------------


def children(pid: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_worker_that_dies_takes_its_own_trial_alone(tmp_path: Path) -> None:
    """And the next run does that trial again."""
    path = study(tmp_path, "study: example\ngrid: {pause_s: [0, 0.01, 0.02, 3]}\n")
    out, made, killed = tmp_path / "out", [], []

    def told(row: StoredRow) -> None:
        made.append(row)
        if len(made) == 3:
            killed.extend(workers())
            for pid in killed:
                os.kill(pid, signal.SIGKILL)

    run(planned(path, out), out, None, told)
    assert killed
    assert sorted(row.ending for row in made) == ["broken", "done", "done", "done"]
    assert [row.ending for row in here(path, out)] == ["done"]
    assert len(rows_of(out)) == 4


def workers() -> list[int]:
    """Processes of ours that run trials."""
    spawned = (pid for pid in children(os.getpid()))
    return [p for p in spawned if b"spawn_main" in Path(f"/proc/{p}/cmdline").read_bytes()]


def kill_and_resume(folder: Path, kills: int, seeds: int, rng: random.Random) -> None:
    """Kill the runner at random moments; in the end there are exactly the rows of a whole run."""
    text = f"study: example\ngrid: {{draws: [1, 2, 5], pause_s: [0.05]}}\nseeds: {seeds}\n"
    path, out, whole = study(folder, text), folder / "out", folder / "whole"
    rows = out / "rows"
    for kill in range(kills):
        before = len(list(rows.glob("*.parquet")))
        with subprocess.Popen(command(path, out), stderr=subprocess.DEVNULL) as process:
            if kill % 4 == 3:  # while it starts
                time.sleep(rng.uniform(0.0, 2.0))
            else:
                wait_until(lambda: len(list(rows.glob("*.parquet"))) > before)  # noqa: B023
                time.sleep(rng.uniform(0.0, 0.3))
            own = children(process.pid)
            assert process.poll() is None
            process.kill()
        wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in own))  # noqa: B023
        for row in rows.glob("*.parquet"):
            read_row(row)
    assert 0 < len(list(rows.glob("*.parquet"))) < 3 * seeds
    subprocess.run(command(path, out), check=True, capture_output=True)
    subprocess.run(command(path, whole), check=True, capture_output=True)
    assert rows_of(out) == rows_of(whole)
    table = pyarrow.parquet.read_table(out / "rows.parquet")
    assert table.num_rows == len(set(table["trial.key"].to_pylist())) == 3 * seeds


def test_killed_and_resumed(tmp_path: Path) -> None:
    kill_and_resume(tmp_path, 1, 8, random.Random(0))


@pytest.mark.slow
def test_killed_twenty_times_and_resumed(tmp_path: Path) -> None:
    kill_and_resume(tmp_path, KILLS, 250, random.Random(1))


def test_a_worker_that_dies_at_rest_is_replaced(tmp_path: Path) -> None:
    slot = Slot()
    try:
        job = Job("k", "example", "{}", 0, 1, str(tmp_path))
        assert slot.send(job)
        slot.sent[0][1].result()
        (pid,) = slot._executor._processes
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: bool(slot._executor._broken))
        assert not slot.send(job), "a row waits to be collected"
        assert [row.ending for row in slot.collect()[0]] == ["done"]
        assert slot.send(job)
        assert slot.sent[0][1].result().ending == "done"
    finally:
        slot.end()


# ---- on a cluster --------------------------------------------------------------------------


@contextmanager
def cluster(folder: Path, n_workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A real scheduler and its workers, as people start them: the address, and the workers."""
    dask = [sys.executable, "-m", "dask"]
    known = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": folder}
    processes = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
             "--scheduler-file", str(known)], **quiet  # type: ignore[call-overload]
        )
    ]  # fmt: skip
    try:
        wait_for(known)
        place = ["--scheduler-file", str(known), "--no-dashboard", "--nthreads", "1"]
        started = [*dask, "worker", *place, "--no-nanny", "--local-directory", str(folder)]
        workers = [subprocess.Popen(started, **quiet) for _ in range(n_workers)]  # type: ignore[call-overload]
        processes += workers
        yield str(known), workers
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_a_cluster_gives_the_same_rows_though_a_worker_is_killed(tmp_path: Path) -> None:
    path = study(tmp_path, "study: example\ngrid: {draws: [1, 2], pause_s: [0.1]}\nseeds: 30\n")
    alone, spread, made = tmp_path / "alone", tmp_path / "spread", []
    here(path, alone)
    with cluster(tmp_path, 2) as (known, workers):

        def told(row: StoredRow) -> None:
            made.append(row)
            if len(made) == 15:
                workers[0].kill()

        with connected(known) as client:
            run(planned(path, spread), spread, client, told)
        assert workers[0].wait() == -signal.SIGKILL
    assert rows_of(spread) == rows_of(alone)
    assert len(made) == 60
    assert {row.ending for row in made} == {"done", "refused"}


def test_workers_of_another_release_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = {"sfm_calib": "1", "git": "abc"}
    monkeypatch.setattr("experiments.runner.cluster.code_state", lambda: ours)
    _check_alike("worker", ours)
    _check_alike("worker", {**ours, "git": ""})  # installed, it knows no commit
    for other in ({**ours, "git": "abd"}, {**ours, "sfm_calib": "2"}, {"git": "abc"}):
        with pytest.raises(CalibrationError, match=r"worker has .*, and here it is"):
            _check_alike("worker", other)


def test_no_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.runner.cluster.CONNECT_S", 0.5)
    refused = pytest.raises(CalibrationError, match="no Dask scheduler answers at tcp")
    with refused, connected("tcp://127.0.0.1:1"):
        pass

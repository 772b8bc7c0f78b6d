"""Trials on a Dask cluster that is there: a worker that dies loses nothing."""

from __future__ import annotations

import importlib
import logging
import re
import sys
import uuid
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from experiments.runner.attempt import GIT, Job, attempt, code_state, failed, stored
from experiments.runner.rows import StoredRow, error_line
from sfm_calib.errors import CalibrationError

CONNECT_S = 10
AHEAD = 4  # trials submitted for each worker: none waits for us, and none is sent far too early
# Workers that may die under one trial before it is to blame; Dask's own default.
DEATHS = 3


def distributed() -> Any:
    """dask.distributed. Raises CalibrationError where it is not installed."""
    try:
        return importlib.import_module("distributed")
    except ImportError as error:
        raise CalibrationError(
            "--cluster needs Dask: pip install 'sfm_calib[cluster]', or leave it away to run on "
            "this machine"
        ) from error


@contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of its file; None of none.

    Raises CalibrationError when there is no scheduler, and when its workers do not have this
    project.
    """
    if address is None:
        yield None
        return
    dask = distributed()
    is_file = address.endswith(".json")
    if is_file and not Path(address).is_file():
        raise CalibrationError(f"--cluster {address}: there is no such scheduler file")
    if not is_file and not re.fullmatch(r"([a-z]+://)?[^:/\s]+:\d+", address):
        raise CalibrationError(
            f"--cluster {address} is no address: give one such as tcp://10.0.0.1:8786, as "
            "`dask scheduler` prints it"
        )
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # our own message says it
    try:
        place = "scheduler_file" if is_file else "address"
        client = dask.Client(**{place: address}, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise CalibrationError(
            f"no Dask scheduler answers at {address} within {CONNECT_S} s: start one with "
            "`dask scheduler`, and give the address it prints, or its --scheduler-file"
        ) from error
    with closing(client):
        _check_workers(client, address)
        yield client


def run_on(client: Any, jobs: Iterable[Job]) -> Iterator[StoredRow]:
    """Rows as they finish, from the workers of a scheduler.

    Raises CalibrationError when it is lost, and for workers of another release that came later.
    """
    dask = distributed()
    try:
        yield from _rows(dask, client, iter(jobs))
    except (dask.comm.CommClosedError, dask.CancelledError, OSError) as error:
        raise CalibrationError(
            f"the scheduler was lost ({error_line(error)}); finished trials are kept: run again "
            "to go on"
        ) from error


def _check_workers(client: Any, address: str) -> None:
    """Raises CalibrationError where workers would run another release than this one."""
    if not client.nthreads():
        print(
            f"{address} has no workers yet: waiting for some (`dask worker {address}`)",
            file=sys.stderr,
        )
        return
    try:
        theirs = client.run(code_state)
    except Exception as error:
        raise CalibrationError(
            f"workers of {address} cannot run studies ({type(error).__name__}: {error}): install "
            "sfm_calib where they run, in the same release"
        ) from error
    for worker, state in theirs.items():
        _check_alike(f"worker {worker}", state)


def _check_alike(worker: str, state: dict[str, str]) -> None:
    """Raises CalibrationError where rows would depend on where they ran."""
    for name, here in code_state().items():
        there = state.get(name, "none")
        if there != here and (name != GIT or (here and there)):  # installed, it knows no commit
            raise CalibrationError(
                f"{worker} has {name} {there}, and here it is {here}: rows would depend on where "
                "they ran; install what is here, from requirements/dev.lock"
            )


def _rows(dask: Any, client: Any, jobs: Iterator[Job]) -> Iterator[StoredRow]:
    run = uuid.uuid4().hex  # keys of this run: those of another are other tasks
    sent: dict[str, Job] = {}
    finished = dask.as_completed(loop=client.loop)

    def send(count: int) -> None:
        for _, job in zip(range(count), jobs, strict=False):
            future = client.submit(attempt, job, key=f"{run}-{job.key}", pure=False)
            sent[future.key] = job
            finished.add(future)

    send(AHEAD * max(1, len(client.nthreads())))
    for future in finished:
        job = sent.pop(future.key)
        try:
            row = future.result()
            # Of a worker that came after the first look.
            _check_alike(f"the worker on {row.host}", {**row.versions, GIT: row.git})
        except dask.KilledWorker:
            row = stored(job, "broken", 0.0, error=f"{DEATHS} workers died of it")
        except (CalibrationError, OSError, dask.CancelledError, dask.comm.CommClosedError):
            raise
        except Exception as error:  # of the way there or back
            row = failed(job, error, 0.0)
        future.release()
        send(AHEAD * max(1, len(client.nthreads())) - len(sent))
        yield row

"""Trials in processes of this machine: one that dies takes its own trial with it and no other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import connection

from experiments.runner.attempt import Job, attempt, stored
from experiments.runner.rows import StoredRow

WAITING = 1  # trials sent to a process beyond the one it works on, so that it never idles
DIED = "its process died: out of memory, or a library that aborted"


class Slot:
    """A process, and the trials that were sent to it, first the one it works on."""

    def __init__(self) -> None:
        self.sent: deque[tuple[Job, Future[StoredRow]]] = deque()
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # kernels' threads do not survive a fork
        self._executor = ProcessPoolExecutor(1, context, initializer=prepare_worker)

    def send(self, job: Job) -> bool:
        """Whether it could be sent: not to a process that has died with trials to collect."""
        try:
            future = self._executor.submit(attempt, job)
        except BrokenProcessPool:
            if self.sent:
                return False
            self._start()
            future = self._executor.submit(attempt, job)
        self.sent.append((job, future))
        return True

    def end(self) -> None:
        """Kill the process, whatever it does."""
        for process in list((self._executor._processes or {}).values()):
            process.kill()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def collect(self) -> tuple[list[StoredRow], list[Job]]:
        """Rows that are there, and trials that must be sent anew because the process died."""
        rows: list[StoredRow] = []
        while self.sent and self.sent[0][1].done():
            job, future = self.sent.popleft()
            try:
                rows.append(future.result())
            except BrokenProcessPool:
                rows.append(stored(job, "broken", 0.0, error=DIED))
                self._executor.shutdown(wait=False)
                again = [job for job, _ in self.sent]
                self.sent.clear()
                self._start()
                return rows, again
        return rows, []


def run_here(jobs: Iterable[Job], processes: int) -> Iterator[StoredRow]:
    """Rows as they finish. What is still running when the caller leaves is killed."""
    todo = deque(jobs)
    slots = [Slot() for _ in range(min(processes, len(todo)))]
    try:
        while todo or any(slot.sent for slot in slots):
            for turn in range(1 + WAITING):
                for slot in slots:
                    if todo and len(slot.sent) <= turn and slot.send(todo[0]):
                        todo.popleft()
            wait((slot.sent[0][1] for slot in slots if slot.sent), return_when=FIRST_COMPLETED)
            for slot in slots:
                rows, again = slot.collect()
                todo.extendleft(reversed(again))
                yield from rows
    finally:
        for slot in slots:
            slot.end()


def prepare_worker() -> None:
    """Leave interrupts to the runner, and end with it, however it ends."""
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)

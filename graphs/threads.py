"""How many threads the kernels use."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

from threadpoolctl import threadpool_limits

_MOST: ContextVar[int | None] = ContextVar("most_threads", default=None)


def thread_count() -> int:
    """How many cores this process may use, as far as `at_most` lets it."""
    cores, most = len(os.sched_getaffinity(0)), _MOST.get()
    return cores if most is None else min(cores, most)


def threads() -> ThreadPoolExecutor:
    """A thread for each of them."""
    return ThreadPoolExecutor(thread_count())


@contextmanager
def at_most(count: int | None) -> Iterator[None]:
    """Let kernels and linear algebra called here use so many threads; None: every core.

    The numbers that come out are the same: sums do not depend on who adds them.
    """
    token = _MOST.set(count)
    try:
        with threadpool_limits(count):
            yield
    finally:
        _MOST.reset(token)

"""Work in a process of its own: what kills that becomes an error here, and Ctrl-C ends it at once.

COLMAP's threads abort their whole process when the disk is full or memory runs out.
"""

from __future__ import annotations

import errno
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from typing import IO, Any

from sfm_calib import colmap
from sfm_calib.errors import BrokenDownError, CalibrationError
from sfm_calib.images import Progress

LOG_LINES = 200  # of the worker's stderr are kept for its epitaph
# How C++ says why it aborts: an uncaught exception's what(), or a fatal line of glog.
EPITAPHS = (r"what\(\):\s*(?:\[[^\]]*\]\s*)?(.+)", r"^F\d{8} [^\]]*\]\s*(.+)")
DISK_FULL = ("disk is full", "No space left on device")


def run_apart(
    work: Callable[..., None], arguments: Sequence[object], progress: Progress, who: str = "COLMAP"
) -> None:
    """Call `work(*arguments, progress)` in another process; a function of a module, and values.

    who: does the work, as messages begin.
    Raises what `work` raises, OSError when it died of a full disk, and BrokenDownError when it
    died of anything else.
    """
    reading, writing = os.pipe()
    job = (work, tuple(arguments), colmap.is_verbose())
    search = os.pathsep.join(path for path in sys.path if path)
    with os.fdopen(reading, "rb") as messages:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "sfm_calib.worker", str(writing)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=(writing,),
            env={**os.environ, "PYTHONPATH": search},
        )
        os.close(writing)
        try:
            outcome = _supervise(process, job, messages, progress, who)
        finally:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stderr):
                _close(stream)
    if isinstance(outcome, BaseException):
        raise outcome


def _close(stream: IO[bytes] | None) -> None:
    try:
        if stream is not None:
            stream.close()
    except BrokenPipeError:
        pass


def _supervise(
    process: subprocess.Popen[bytes],
    job: object,
    messages: IO[bytes],
    progress: Progress,
    who: str,
) -> BaseException | None:
    """Pass progress on until the worker says how it ended, or ends without a word."""
    assert process.stdin is not None and process.stderr is not None
    log: list[str] = []
    listener = threading.Thread(target=_listen, args=(process.stderr, log), daemon=True)
    listener.start()
    try:
        pickle.dump(job, process.stdin)
        process.stdin.flush()  # and left open: its end tells the worker that we are gone
        while True:
            kind, content = pickle.load(messages)
            if kind == "end":
                return content
            progress(*content)
    except (EOFError, BrokenPipeError, pickle.UnpicklingError):
        process.wait()
        listener.join(1)
        return _cause_of_death(process.returncode, log, who)


def _listen(stream: IO[bytes], log: list[str]) -> None:
    for line in stream:
        text = line.decode(errors="replace").rstrip()
        log.append(text)
        del log[:-LOG_LINES]
        if colmap.is_verbose():
            print(text, file=sys.stderr)


def _cause_of_death(code: int, log: list[str], who: str) -> BaseException:
    matches = (re.search(pattern, line) for line in log for pattern in EPITAPHS)
    reason = next((match.group(1).strip() for match in matches if match), "")
    if any(sign in reason for sign in DISK_FULL):
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    if code == -signal.SIGKILL:
        return BrokenDownError(
            f"{who} was killed, most likely because memory ran out: give a smaller "
            "--max-features, or use a machine with more memory"
        )
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return BrokenDownError(
        f"{who} broke down ({how}{': ' + reason if reason else ''}): run again with -v to see "
        "its log"
    )


def _work(channel: int) -> None:
    """The worker's side: read the job, do it, and say how it ended."""
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, signal.SIG_IGN)  # whoever started us is told too, and ends us
    work, arguments, verbose = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    colmap.quiet(verbose)
    with os.fdopen(channel, "wb") as messages:

        def tell(kind: str, content: Any) -> None:
            messages.write(pickle.dumps((kind, content)))
            messages.flush()

        try:
            work(*arguments, lambda *step: tell("progress", step))
        except BaseException as error:
            tell("end", _portable(error))
        else:
            tell("end", None)


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # nothing ever comes: it returns when the parent is gone
    os._exit(1)


def _portable(error: BaseException) -> BaseException:
    """The error itself where it can be sent; a bug's with the traceback that only we know."""
    if isinstance(error, CalibrationError):
        return error
    if any(sign in str(error) for sign in DISK_FULL):
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    text = "".join(traceback.format_exception(error))
    error.add_note(f"In the worker process:\n{text}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(text)
    return error


if __name__ == "__main__":
    _work(int(sys.argv[1]))

"""Work in a process of its own: results, errors, deaths and interruptions."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from synthetic import jobs

from sfm_calib.errors import CalibrationError
from sfm_calib.worker import run_apart

ABORT = "  what():  [database_sqlite.cc:1737] SQLite error: database or disk is full"
GLOG = "F20261122 07:07:33.120 123 pose.cc:31] Check failed: a > b"


def run(work, *arguments):
    steps = []
    run_apart(work, arguments, lambda *step: steps.append(step))
    return steps


def is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split(") ")[1][0] != "Z"


def ends(pid, seconds=3.0):
    begin = time.monotonic()
    while is_alive(pid) and time.monotonic() - begin < seconds:
        time.sleep(0.02)
    return not is_alive(pid)


def test_work_is_done_elsewhere_and_its_progress_is_told_here(tmp_path):
    assert run(jobs.write, tmp_path / "Käm era") == [("writing", 1, 2), ("writing", 2, 2)]
    assert int((tmp_path / "Käm era").read_text()) != os.getpid()


@pytest.mark.slow
def test_errors_come_back_as_they_were():
    with pytest.raises(CalibrationError, match=r"^cam2 matched 3 of 50 frames: scan more slowly$"):
        run(jobs.refuse)
    with pytest.raises(OSError, match="No space left") as caught:
        run(jobs.fill_disk)
    assert caught.value.errno == 28


def test_a_bug_comes_back_with_its_traceback():
    with pytest.raises(KeyError, match="a bug") as caught:
        run(jobs.have_a_bug)
    assert "in have_a_bug" in caught.value.__notes__[0]
    with pytest.raises(RuntimeError, match="in raise_what_cannot_be_sent"):
        run(jobs.raise_what_cannot_be_sent)


@pytest.mark.parametrize(
    ("how", "words", "error", "message"),
    [
        (signal.SIGABRT, ABORT, OSError, "No space left on device"),
        (signal.SIGABRT, GLOG, CalibrationError, r"\(SIGABRT: Check failed: a > b\): run again"),
        (signal.SIGSEGV, "", CalibrationError, r"broke down \(SIGSEGV\): run again with -v"),
        (signal.SIGKILL, "", CalibrationError, "memory ran out: give a smaller --max-features"),
    ],
    ids=["disk full", "fatal check", "crash", "out of memory"],
)
def test_a_death_becomes_an_error(how, words, error, message):
    with pytest.raises(error, match=message):
        run(jobs.die, how, words)


def test_leaving_without_a_word():
    with pytest.raises(CalibrationError, match="exit code 3"):
        run(jobs.leave)


def test_the_worker_leaves_interrupts_to_us():
    assert run(jobs.is_interruptible) == [("SIGINT ignored", 1, 0)]


@pytest.mark.slow
def test_an_interrupt_here_ends_the_worker_at_once():
    pids = []

    def interrupt(stage, pid, total):
        pids.append(pid)
        raise KeyboardInterrupt

    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_apart(jobs.hang, (), interrupt)
    assert not is_alive(pids[0]) and time.monotonic() - begin < 20


@pytest.mark.slow
def test_a_worker_does_not_outlive_us():
    script = (
        "from synthetic import jobs; from sfm_calib.worker import run_apart\n"
        "run_apart(jobs.hang, (), lambda stage, pid, total: print(pid, flush=True))"
    )
    search = os.pathsep.join(filter(None, sys.path))
    parent = subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": search},
    )
    with parent:
        pid = int(parent.stdout.readline())
        assert is_alive(pid)
        parent.kill()
    assert ends(pid)

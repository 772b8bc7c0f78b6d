"""Work for `run_apart`: what a worker process may do, or suffer."""

import os
import signal
import sys
import time

from sfm_calib.errors import CalibrationError


def write(path, progress):
    progress("writing", 1, 2)
    path.write_text(str(os.getpid()))
    progress("writing", 2, 2)


def refuse(progress):
    raise CalibrationError("cam2 matched 3 of 50 frames: scan more slowly")


def fill_disk(progress):
    raise OSError(28, "No space left on device", "/somewhere")


def have_a_bug(progress):
    raise KeyError("a bug")


def raise_what_cannot_be_sent(progress):
    class LocalError(Exception):
        pass

    raise LocalError("local")


def die(signal_number, last_words, progress):
    print(last_words, file=sys.stderr, flush=True)
    os.kill(os.getpid(), signal_number)


def leave(progress):
    os._exit(3)


def hang(progress):
    progress("hanging", os.getpid(), 0)
    time.sleep(600)


def is_interruptible(progress):
    progress("SIGINT ignored", int(signal.getsignal(signal.SIGINT) == signal.SIG_IGN), 0)

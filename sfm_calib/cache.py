"""Stages that need not run twice: a stage's files are kept with the key of all that made them."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically

DISK_IS_FULL = 1_000_000  # bytes free
KEY_IN_NAME = 16  # hex digits


@dataclass(frozen=True)
class Cache:
    """A folder beside the result. `fresh` ignores what earlier runs left.

    shared: runs that go on at once use it together. A stage is then kept for each of its inputs,
    never made twice, and what one run makes the others wait for; `fresh` is not for it.
    """

    folder: Path
    fresh: bool = False
    shared: bool = False

    def stage(self, name: str, inputs: object, make: Callable[[Path], None]) -> Path:
        """The stage's folder, filled by `make(folder)` unless `inputs` are those of last time.

        The key is written last, so a run cut short leaves nothing that looks complete; a stage
        that fails is removed, because it may be what fills the disk.
        Raises CalibrationError when the disk is full.
        """
        key = key_of(inputs)
        place = self.folder / (f"{name}.{key[:KEY_IN_NAME]}" if self.shared else name)
        with self.held(place):
            self._fill(place, key, make)
        return place

    @contextmanager
    def held(self, place: Path) -> Iterator[None]:
        """A stage of a shared cache for this run alone: COLMAP aborts where two open a database.

        The lock goes with the process that has it.
        """
        if not self.shared:
            yield
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(_beside(place, "lock"), os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        finally:
            os.close(lock)

    def _fill(self, place: Path, key: str, make: Callable[[Path], None]) -> None:
        key_file = _beside(place, "key")
        if not self.fresh and _text(key_file) == key + _sizes(place):
            return
        try:
            key_file.unlink(missing_ok=True)
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            make(place)
            write_atomically(key_file, key + _sizes(place))
        except BaseException as error:
            reason = _disk_trouble(place, error)
            self._drop(place)
            if reason is None:
                raise
            raise CalibrationError(
                f"cannot write {place}: {reason}; free some space or choose another output folder"
            ) from error

    def _drop(self, place: Path) -> None:
        """Remove an unfinished stage, and the cache's folder where nothing else is in it."""
        shutil.rmtree(place, ignore_errors=True)
        with suppress(OSError):
            self.folder.rmdir()


def _beside(place: Path, what: str) -> Path:
    return place.with_name(f"{place.name}.{what}")


def _sizes(place: Path) -> str:
    """The size of every file of a stage: readers of a shortened model hang rather than fail."""
    files = sorted(path for path in place.rglob("*") if path.is_file())
    sizes = [
        f"{path.relative_to(place).as_posix()} {path.stat().st_size}"
        for path in files
        if not path.name.endswith(("-wal", "-shm"))  # SQLite's own, there while it is open
    ]
    return "\n" + "\n".join(sizes)


def _disk_trouble(place: Path, error: BaseException) -> str | None:
    """What the disk did wrong; None when it is not to blame."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, Exception) and place.exists():
        free = shutil.disk_usage(place).free
        if free < DISK_IS_FULL:  # libraries say this in many ways, or not at all
            return f"only {free / 1e6:.1f} MB are free"
    return None


def _text(path: Path) -> str | None:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return None


def key_of(inputs: object) -> str:
    """A digest of anything JSON can hold."""
    text = json.dumps(inputs, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()

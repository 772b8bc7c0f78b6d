"""Stages that need not run twice: a stage's files are kept with the key of all that made them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sfm_calib.errors import CalibrationError


@dataclass(frozen=True)
class Cache:
    """A folder beside the result. `fresh` ignores what earlier runs left."""

    folder: Path
    fresh: bool = False

    def stage(self, name: str, inputs: object, make: Callable[[Path], None]) -> Path:
        """The stage's folder, filled by `make(folder)` unless `inputs` are those of last time.

        The key is written last, so a run cut short leaves nothing that looks complete.
        Raises CalibrationError when the disk is full.
        """
        place, key_file = self.folder / name, self.folder / f"{name}.key"
        key = key_of(inputs)
        if not self.fresh and key_file.exists() and key_file.read_text() == key:
            return place
        try:
            key_file.unlink(missing_ok=True)
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            make(place)
            key_file.write_text(key)
        except OSError as error:
            raise CalibrationError(
                f"cannot write {place}: {error.strerror}; free some space or choose another "
                "output folder"
            ) from error
        return place


def key_of(inputs: object) -> str:
    """A digest of anything JSON can hold."""
    text = json.dumps(inputs, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()

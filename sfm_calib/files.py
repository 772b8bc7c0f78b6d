"""Files: read with a reason where they cannot be, and written whole or not at all."""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

from sfm_calib.errors import CalibrationError


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write `content` beside `path`, then rename it into place.

    Raises CalibrationError when it cannot be written; the old file, if any, is untouched.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise CalibrationError(
            f"cannot write {path}: {error.strerror or error}; free some space or choose another "
            "output folder"
        ) from error
    finally:
        if temporary and os.path.exists(temporary):
            os.unlink(temporary)


def read_text(path: Path, remedy: str, encoding: str = "utf-8") -> str:
    """A text file. Raises CalibrationError when it cannot be read, or is no text: with a remedy."""
    try:
        return path.read_text(encoding)
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise CalibrationError(
            f"{path} is no text: byte {error.start} is not UTF-8; {remedy}"
        ) from error


def sha256(path: Path) -> str:
    """Hex digest of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

"""Files: read with a reason where they cannot be, and written whole or not at all."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Mapping
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


def write_folder_atomically(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write `files`, by their paths in it, as a whole folder; one that is there is replaced.

    It is replaced only where it holds nothing but files of these names. Raises CalibrationError
    otherwise, and when it cannot be written; the old folder is then as it was.
    """
    others = [
        path
        for path in (folder.rglob("*") if folder.is_dir() else ())
        if path.is_symlink() or not path.is_dir()
        if path.relative_to(folder).as_posix() not in files
    ]
    if others:
        raise CalibrationError(
            f"{folder} holds other files too, such as {others[0].relative_to(folder)}: choose "
            "another folder"
        )
    temporary = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        new, old = temporary / "new", temporary / "old"
        new.mkdir()
        for name, content in files.items():
            write_atomically(new / name, content)
        if folder.exists():
            folder.rename(old)
        try:
            new.rename(folder)
        except OSError:
            if old.exists():
                old.rename(folder)
            raise
    except OSError as error:
        raise CalibrationError(
            f"cannot write {folder}: {error.strerror or error}; free some space or choose another "
            "output folder"
        ) from error
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


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

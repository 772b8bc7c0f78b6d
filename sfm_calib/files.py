"""Files: read with a reason where they cannot be, and written whole or not at all."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from sfm_calib.errors import CalibrationError

RESULT_FILE: Final = "calibration.json"
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
# Files that formats of calibrations have; a folder's others (pictures, reports) are none of it.
CALIBRATION_SUFFIXES = (
    ".json", ".yaml", ".yml", ".xml", ".toml", ".txt", ".bin", ".cameramodel",
)  # fmt: skip


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
        raise CalibrationError(f"cannot write {path}: {_trouble(error)}") from error
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
        raise CalibrationError(f"cannot write {folder}: {_trouble(error)}") from error
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


def _trouble(error: OSError) -> str:
    """Why a file could not be written, and what to do about it: room helps a full disk alone."""
    remedy = "free some space or choose" if error.errno in DISK_FULL else "choose"
    return f"{error.strerror or error}; {remedy} another output folder"


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


# ---- calibrations --------------------------------------------------------------------------


def calibration_sha256(path: Path) -> str:
    """Hex digest of a calibration: of a file its bytes; of a folder its calibration.json's, else
    the names and digests of the files directly in it that could hold one.

    Raises CalibrationError when it cannot be read.
    """
    try:
        files = calibration_files(path)
        if len(files) == 1:
            return sha256(files[0])
        listed = "".join(f"{sha256(file)}  {file.name}\n" for file in files)
        return hashlib.sha256(listed.encode("utf-8", "surrogateescape")).hexdigest()
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error


def calibration_files(path: Path) -> list[Path]:
    """The files that a calibration, a file or a folder, may be made of, in order of their names."""
    if not path.is_dir():
        return [path]
    if (path / RESULT_FILE).is_file():
        return [path / RESULT_FILE]
    return sorted(p for p in path.iterdir() if p.suffix in CALIBRATION_SUFFIXES and p.is_file())


def refuse_overwrite(old: Path, out: Path, overwrite: bool) -> None:
    """Raises CalibrationError where writing to `out`, a file or a folder and whatever is in it,
    could change the calibration `old`; nothing where `overwrite` says that it may.

    Links of both kinds are followed: it is the same file under any of its names.
    """
    if overwrite:
        return
    files = calibration_files(old)
    inodes = {_inode(file): file for file in files}
    for place in _places(out):
        inside = (file for file in files if file.resolve().is_relative_to(place.resolve()))
        hit = next(inside, None) or inodes.get(_inode(place) or (-1, -1))
        if hit is not None:
            where = f"{place} is the same file" if place != out else f"{out} holds it"
            raise CalibrationError(
                f"the old calibration {hit} would be overwritten ({where}): choose another place "
                "with -o, or say --overwrite"
            )


def _places(out: Path) -> Iterator[Path]:
    """`out`, and in it every file, and every link to a folder."""
    yield out
    for folder, folders, files in os.walk(out):
        below = (Path(folder, name) for name in (*folders, *files))
        yield from (path for path in below if path.is_symlink() or path.is_file())


def _inode(path: Path) -> tuple[int, int] | None:
    """Device and inode of what a path leads to; None where it leads nowhere."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino

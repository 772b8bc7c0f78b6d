"""Files of a size that a calibration can have."""

from __future__ import annotations

from pathlib import Path

from sfm_calib.errors import CalibrationError

MOST_BYTES = 50_000_000  # of a calibration; beyond, it is something else


def bounded_bytes(path: Path) -> bytes:
    """What is in a file. Raises CalibrationError where it cannot be read, or is too large."""
    try:
        size = path.stat().st_size
        if size <= MOST_BYTES:
            return path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error
    raise CalibrationError(f"{path} is too large for a calibration: {size / 1e6:.0f} MB")

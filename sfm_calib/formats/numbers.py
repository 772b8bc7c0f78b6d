"""Numbers of files that anyone wrote: finite, of the right shape, or refused in one line."""

from __future__ import annotations

import numpy as np

from graphs.frames import FloatArray
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import MOST_NUMBER


def numbers(what: str, entry: object, *shape: int) -> FloatArray:
    """An entry as finite numbers of this shape; -1 is any length.

    Raises CalibrationError, which never repeats the entry: it may be as long as the file.
    """
    try:
        found = np.asarray(entry, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise CalibrationError(f"{what} holds something else than numbers") from error
    wanted = " x ".join("any" if n < 0 else str(n) for n in shape) or "one"
    if found.ndim != len(shape) or any(
        n >= 0 and n != m for n, m in zip(shape, found.shape, strict=True)
    ):
        raise CalibrationError(f"{what} has {found.size} numbers, not {wanted}")
    if not (np.abs(found) < MOST_NUMBER).all():  # nor where it is NaN
        raise CalibrationError(f"{what} holds numbers beyond {MOST_NUMBER:.0e}, or not finite")
    return found


def number(what: str, entry: object) -> float:
    """One finite number. Raises CalibrationError."""
    return float(numbers(what, entry))

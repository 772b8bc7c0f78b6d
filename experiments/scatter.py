"""Means over trials, with standard errors by the scatter of the trials."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments.runner.protocol import Row
from experiments.standard_errors import jackknifed, mean_and_error
from graphs.frames import FloatArray

STANDARD_ERRORS = 3.0  # within which a value may miss what is expected
FEWEST = 8  # trials: of fewer, their own scatter is known to less than a quarter

Value = tuple[float, float | None]  # and its standard error; None: of one trial


def stacked(rows: Sequence[Row], key: str) -> FloatArray:
    """One column of all rows (n_rows, ...)."""
    values: list[Any] = [row[key] for row in rows]
    return np.array(values, dtype=np.float64)


def mean_of(values: FloatArray) -> Value:
    """Mean of values (n,)."""
    mean, error = mean_and_error(values)
    return mean, error if len(values) > 1 else None


def root_of(squares: FloatArray) -> Value:
    """Root of the mean of squares (n,); its standard error to first order."""
    mean, error = mean_of(squares)
    root = max(mean, 0.0) ** 0.5
    return root, None if error is None else error / (2 * max(root, np.finfo(np.float64).tiny))


def ratio_of(pairs: FloatArray) -> Value:
    """Ratio of the two means of pairs (n, 2); its standard error with one left out at a time."""
    ratio, error = jackknifed(lambda some: float(some[:, 0].sum() / some[:, 1].sum()), pairs)
    return ratio, error if len(pairs) > 1 else None


def within(value: Value, low: float, high: float) -> bool:
    """Whether a value lies between the two, chance allowed for."""
    room = STANDARD_ERRORS * (value[1] or 0.0)
    return low - room <= value[0] <= high + room


def in_digits(value: Value, digits: int = 2) -> str:
    """As `1.02 ± 0.05`."""
    bar = "" if value[1] is None else f" ± {value[1]:.{digits}f}"
    return f"{value[0]:.{digits}f}{bar}"

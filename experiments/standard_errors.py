"""Means, roots and ratios over independent trials, with the standard errors of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from graphs.frames import FloatArray

WITHIN_95 = 1.959964  # sigmas that 95 % of normal errors stay within


def jackknifed(
    statistic: Callable[[FloatArray], float], trials: Sequence[Sequence[float]] | FloatArray
) -> tuple[float, float]:
    """A statistic of trials (n, k) and its standard error, by leaving out one after the other.

    NaN of no trial; an infinite error of a single one. (Efron and Stein, Ann. Stat. 9, 1981.)
    """
    values = np.asarray(trials, dtype=float)
    n = len(values)
    if n == 0:
        return float("nan"), float("inf")
    whole = statistic(values)
    if n == 1:
        return whole, float("inf")
    left_out = np.array([statistic(np.delete(values, index, axis=0)) for index in range(n)])
    spread = float(((left_out - left_out.mean()) ** 2).sum())
    return whole, float(np.sqrt((n - 1) / n * spread))


def mean_and_error(values: Sequence[float] | FloatArray) -> tuple[float, float]:
    """Mean and its standard error, infinite of a single value."""
    n = len(values)
    return float(np.mean(values)), float(np.std(values, ddof=1) / n**0.5) if n > 1 else float("inf")


def rms(values: Sequence[float] | FloatArray) -> float:
    """Root mean square of values of any shape."""
    return float(np.sqrt(np.mean(np.square(values))))

"""Numbers as the page prints them: as many digits as their sigma lets mean something."""

from __future__ import annotations

import math

MAX_DECIMALS = 9


def decimals_for(sigma: float) -> int | None:
    """Decimals that show two digits of sigma; None when there is no sigma to go by."""
    if not math.isfinite(sigma) or sigma <= 0:
        return None
    return min(max(1 - math.floor(math.log10(sigma)), 0), MAX_DECIMALS)


def number(value: float, decimals: int | None) -> str:
    """A number with fixed decimals, or with six digits where no sigma says how many count."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.6g}" if decimals is None else f"{value:.{decimals}f}"


def short(value: float) -> str:
    """Two digits, never as a power of ten."""
    return number(value, decimals_for(abs(value)))

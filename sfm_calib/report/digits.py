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


def with_digits(value: float, sigma: float, sign: str = "") -> str:
    """A value to the second digit of its sigma, which is as far as it means something."""
    decimals = _decimals(sigma)
    if decimals is None:
        return f"{value:{sign}.6g}"
    text = f"{value:{sign}.{decimals}f}"
    return text if float(text) or value >= 0 else text.replace("-", "+" if sign else "", 1)


def sigma_text(sigma: float) -> str:
    """A sigma to two digits, aligned with its value."""
    decimals = _decimals(sigma)
    return "fixed" if decimals is None else f"{sigma:.{decimals}f}"


def _decimals(sigma: float) -> int | None:
    """Decimals that show two digits of a sigma, or None where there is no sigma."""
    if not (math.isfinite(sigma) and sigma > 0):
        return None
    exponent = int(f"{sigma:.1e}".split("e")[1])  # after rounding: 0.0996 is 1.0e-01
    return max(0, 1 - exponent)


def at_range(distance: float | None, unit: str | None) -> str:
    """A range in words."""
    if unit is None:
        return "any range"
    words = "baselines" if unit == "baseline" else unit
    return "infinity" if distance is None else f"{distance:g} {words}"


def signed_percent(value: float) -> str:
    """Per cent with a sign and two digits."""
    return f"{'-' if value < 0 else '+'}{short(abs(value))} %"

"""The cells of an answer's tables: as text to read, and as CSV with every digit."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import Any

from experiments.runner.protocol import AnswerTable

NOTHING = "–"
DIGITS = 4  # of the largest number of a column
FEWEST_DIGITS = 1  # of the smallest
WIDEST = 1e7  # beyond it, and where digits of the smallest would be more decimals than
MOST_DECIMALS = 6  # these, each number is written by itself: as a power of ten at need


def csv_of(table: AnswerTable) -> bytes:
    """RFC 4180 in UTF-8: what was not measured is empty, truths are true and false."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)  # its lines end as the RFC wants them
    writer.writerow(table.columns)
    writer.writerows([[_exact(cell) for cell in row] for row in table.rows])
    return text.getvalue().encode("utf-8", "replace")


def _exact(cell: Any) -> str:
    value = plain_value(cell)
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else repr(value) if isinstance(value, float) else str(value)


def plain_value(cell: Any) -> Any:
    """Python's own number or truth for numpy's, and anything else as it is."""
    return cell.item() if hasattr(cell, "item") else cell


def one_line(text: str) -> str:
    """Any text as a line that a file can hold: names of files need not be UTF-8."""
    return " ".join(text.encode("utf-8", "replace").decode().split())


def is_numeric(cells: Sequence[Any]) -> bool:
    """Whether a column holds nothing but numbers, and some."""
    values = [plain_value(cell) for cell in cells]
    told = [value for value in values if value is not None]
    return bool(told) and all(
        isinstance(value, int | float) and not isinstance(value, bool) for value in told
    )


def column_texts(cells: Sequence[Any]) -> list[str]:
    """A column to read: numbers of one column have the same decimals, and no more than count."""
    values = [plain_value(cell) for cell in cells]
    decimals = _decimals([value for value in values if isinstance(value, float)])
    return [_text(value, decimals) for value in values]


def _text(value: Any, decimals: int | None) -> str:
    if value is None:
        return NOTHING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return one_line(str(value))
    if not math.isfinite(value):
        return str(value)
    return f"{value:.{DIGITS}g}" if decimals is None else f"{value:.{decimals}f}"


def _decimals(values: Sequence[float]) -> int | None:
    """That all numbers of a column can be read with; None: each has its own."""
    sizes = [abs(value) for value in values if value and math.isfinite(value)]
    if not sizes:
        return 0
    if max(sizes) >= WIDEST:
        return None
    whole = max(DIGITS - 1 - _exponent(max(sizes)), FEWEST_DIGITS - 1 - _exponent(min(sizes)), 0)
    short = max(_written(size) for size in sizes)
    least = min(whole, short)
    return int(least) if least <= MOST_DECIMALS else None


def _exponent(size: float) -> int:
    return math.floor(math.log10(size))


def _written(size: float) -> float:
    """Decimals of a number that was given with few, such as an option's 0.25; inf: with many."""
    text = f"{size:.{MOST_DECIMALS}f}"
    return len(text.rstrip("0").partition(".")[2]) if float(text) == size else math.inf

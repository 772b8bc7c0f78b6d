"""The one error a user can cause: its message names the cause, the number and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

MOST_LISTED = 12  # parameters of the longest lens; frames can be thousands


class CalibrationError(Exception):
    """Bad input or an impossible request. The CLI prints it as one line and exits with 2."""


class BrokenDownError(CalibrationError):
    """What the machine did rather than the input: memory that ran out, a library that aborted."""


def nearest(name: str, valid: Sequence[str]) -> str:
    """The valid name most like a wrong one, and all of them, or their ends where they are many."""
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}? " if close else ""
    if len(valid) > MOST_LISTED:
        return f"{hint}it has {len(valid)}, {valid[0]} to {valid[-1]}"
    return f"{hint}it has {', '.join(valid)}"

"""What a person sees of an answer: question, tables, failures, and the verdict at the end."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from experiments.runner.cells import column_texts, is_numeric
from experiments.runner.protocol import AnswerTable
from experiments.runner.verdict import Answered, Failure, Verdict, table_files
from sfm_calib.terminal import print_line

MOST_ROWS = 40  # more than a screen is read in the page or the CSV
MOST_FAILURES = 8
WIDEST_TEXT = 40  # characters of a column of words, before it is folded
LEAST_TEXT = 12
BORDER = 3  # characters a column takes beside its text
STYLES = {"as expected": "bold green", "not as expected": "bold red", "no verdict": "bold yellow"}


def print_answer(answered: Answered, console: Console) -> None:
    """Question, tables, failures, warnings and the verdict."""
    record = answered.record
    console.print(record.question, style="bold", soft_wrap=not console.is_terminal)
    for table, file in zip(answered.answer.tables, table_files(answered.answer), strict=True):
        console.print()
        print_line(console, table.title)
        for part in tables_of(table, console.width):
            console.print(part)
        if len(table.rows) > MOST_ROWS:
            print_line(console, f"{len(table.rows) - MOST_ROWS} more rows in {file}")
    console.print()
    print_failures(record, console)
    for warning in record.warnings:
        print_line(console, f"warning: {warning}")
    console.print(record.line, style=STYLES[record.said], soft_wrap=not console.is_terminal)


def print_failures(record: Verdict, console: Console) -> None:
    """How many trials failed, and of what."""
    if not record.failures:
        return
    print_line(console, f"{record.trials.failed} of {record.trials.finished} trials failed:")
    for failure in record.failures[:MOST_FAILURES]:
        print_line(console, f"  {failure_text(failure)}")
    if others := record.failures[MOST_FAILURES:]:
        print_line(console, f"  {sum(one.count for one in others)}x of other errors")


def failure_text(failure: Failure) -> str:
    """One way of failing, in a line."""
    first = "first: " if failure.count > 1 else ""
    return f"{failure.count}x {failure.error!r} ({first}{failure.first})"


def tables_of(table: AnswerTable, width: int) -> list[Table]:
    """A table, in parts below each other where it is wider than the terminal.

    Every part begins with the columns that tell the rows apart.
    """
    texts = [column_texts([row[k] for row in table.rows]) for k in range(len(table.columns))]
    numeric = [is_numeric([row[k] for row in table.rows]) for k in range(len(table.columns))]
    taken = [
        _width(title, column, number)
        for title, column, number in zip(table.columns, texts, numeric, strict=True)
    ]
    parts = []
    for columns in column_parts(taken, _leading(table), width - 1):
        shown = Table()
        for k in columns:
            words = not numeric[k]
            shown.add_column(
                table.columns[k],
                justify="left" if words else "right",
                no_wrap=not words,
                overflow="fold",
                min_width=None if words else max(map(len, texts[k]), default=0),
            )
        for row in range(min(len(table.rows), MOST_ROWS)):
            shown.add_row(*(texts[k][row] for k in columns))
        parts.append(shown)
    return parts


def _width(title: str, texts: Sequence[str], numeric: bool) -> int:
    """Characters that a column needs to be read, its border among them."""
    word = max((len(one) for one in title.split()), default=0)
    longest = max((len(text) for text in texts), default=0)
    return BORDER + max(word, longest if numeric else min(longest, WIDEST_TEXT))


def _leading(table: AnswerTable) -> int:
    """How many of the first columns tell all rows apart; one at least."""
    for count in range(1, len(table.columns)):
        if len({repr(row[:count]) for row in table.rows}) == len(table.rows):
            return count
    return 1


def column_parts(widths: Sequence[int], leading: int, width: int) -> list[list[int]]:
    """Which columns go side by side in `width` characters: the leading ones in every part."""
    while leading > 1 and 2 * sum(widths[:leading]) > width:
        leading -= 1
    first = list(range(min(leading, len(widths))))
    parts = [list(first)]
    for k in range(len(first), len(widths)):
        taken = sum(widths[i] for i in parts[-1])
        if taken + widths[k] > width and len(parts[-1]) > len(first):
            parts.append(list(first))
        parts[-1].append(k)
    return parts

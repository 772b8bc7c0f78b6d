"""What a person sees of an answer: question, tables, failures, and the verdict at the end."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console, JustifyMethod
from rich.table import Table

from experiments.runner.cells import column_texts, is_numeric
from experiments.runner.protocol import AnswerTable
from experiments.runner.verdict import Answered, Failure, Verdict, table_files
from sfm_calib.terminal import print_line

MOST_ROWS = 60  # more than a screen is read in the page or the CSV
MOST_FAILURES = 8
WIDEST_TEXT = 40  # characters of a column of words, before it is folded
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
    return f"{failure.count}x {failure.ending}: {failure.error!r} ({first}{failure.first})"


def tables_of(table: AnswerTable, width: int) -> list[Table]:
    """A table, in parts below each other where it is wider than the terminal.

    Every part begins with the columns that tell the rows apart.
    """
    cells = [[row[k] for row in table.rows] for k in range(len(table.columns))]
    texts = [column_texts(column) for column in cells]
    numeric = [is_numeric(column) for column in cells]
    longest = [max(map(len, column), default=0) for column in texts]
    words = [max(map(len, title.split()), default=0) for title in table.columns]
    least = [
        max(word, long if number else min(long, WIDEST_TEXT), 1)
        for word, long, number in zip(words, longest, numeric, strict=True)
    ]
    parts = []
    for columns in column_parts([one + BORDER for one in least], _leading(table), width - 1):
        spare = max(width - 1 - sum(least[k] + BORDER for k in columns), 0)
        shown = Table()
        for k in columns:
            more = min(spare, max(longest[k], len(table.columns[k])) - least[k])
            spare -= more
            side: JustifyMethod = "right" if numeric[k] else "left"
            shown.add_column(table.columns[k], justify=side, overflow="fold", width=least[k] + more)
        for row in range(min(len(table.rows), MOST_ROWS)):
            shown.add_row(*(texts[k][row] for k in columns))
        parts.append(shown)
    return parts


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

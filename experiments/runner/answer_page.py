"""The page of an answer: verdict, figures, tables, failures, and where its rows come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import plotly.graph_objects as go
import yaml
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from experiments.runner.cells import column_texts, is_numeric
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable
from experiments.runner.run_command import duration
from experiments.runner.verdict import Answered, Origin, table_files
from sfm_calib.files import write_atomically
from sfm_calib.report.theme import Panel, figure_html, page_template, styled

PACKAGE = "experiments.runner"
MOST_ROWS = 1000  # of a table: a browser lays out 10,000 in seconds, and nobody reads them
OPEN_ROWS = 30  # a longer table scrolls in a box of its own
MUCH = 40  # characters of a cell, which is broken beyond
DEFAULT_HEIGHT = 380
SMALL = 480  # pixels: two such figures go side by side on a wide screen
BANNERS = {"as expected": "good", "not as expected": "bad", "no verdict": "doubtful"}
TIME = "%Y-%m-%d %H:%M:%S UTC"


@dataclass(frozen=True)
class TableCells:
    """A table, ready to print."""

    title: str
    file: str
    columns: tuple[str, ...]
    numeric: tuple[bool, ...]
    rows: tuple[tuple[str, ...], ...]
    left_out: int
    long: bool


def write_page(answered: Answered, path: Path) -> None:
    """Write the page as one HTML file that loads nothing from anywhere.

    Raises CalibrationError when the file cannot be written; then nothing is left.
    """
    write_atomically(path, render_page(answered).encode("utf-8", "replace"))


def render_page(answered: Answered) -> str:
    """The page as text."""
    record, answer = answered.record, answered.answer
    return page_template("answer.html", PACKAGE).render(
        title=f"{record.study}: {record.question}",
        record=record,
        paragraphs=answered.said.paragraphs,
        much=MUCH,
        banner=BANNERS[record.said],
        figures=figure_groups(answer),
        tables=[
            table_cells(table, file)
            for table, file in zip(answer.tables, table_files(answer), strict=True)
        ],
        command=answered.said.command,
        config=yaml.safe_dump(
            record.config, sort_keys=False, allow_unicode=True, default_flow_style=None
        ),
        provenance=provenance(record.origin),
        plotly_js=Markup(get_plotlyjs()),
    )


# ---- figures -------------------------------------------------------------------------------


def figure_groups(answer: Answer) -> list[list[Panel]]:
    """Figures in their order: small ones that follow each other are one group, side by side."""
    drawn = [
        (-1 if _is_small(one.figure) else index, _panel(one, f"figure-{index}"))
        for index, one in enumerate(answer.figures)
    ]
    grouped = groupby(drawn, key=lambda pair: pair[0])
    return [[panel for _, panel in group] for _, group in grouped]


def _is_small(figure: go.Figure) -> bool:
    return (figure.layout.height or DEFAULT_HEIGHT) <= SMALL


def _panel(one: AnswerFigure, key: str) -> Panel:
    """As wide as its place; in the reports' style where the study gave it none."""
    figure = go.Figure(one.figure)
    if figure.layout.height is None:
        styled(figure, DEFAULT_HEIGHT)
    figure.update_layout(width=None, autosize=True)
    return Panel(one.title, one.caption, figure_html(figure, key))


# ---- tables --------------------------------------------------------------------------------


def table_cells(table: AnswerTable, file: str) -> TableCells:
    """The first rows of a table as text."""
    columns = list(range(len(table.columns)))
    texts = [column_texts([row[k] for row in table.rows]) for k in columns]
    shown = min(len(table.rows), MOST_ROWS)
    return TableCells(
        title=table.title,
        file=file,
        columns=table.columns,
        numeric=tuple(is_numeric([row[k] for row in table.rows]) for k in columns),
        rows=tuple(tuple(texts[k][row] for k in columns) for row in range(shown)),
        left_out=len(table.rows) - shown,
        long=shown > OPEN_ROWS,
    )


def provenance(origin: Origin) -> list[tuple[str, str]]:
    """Where the rows come from, as terms and texts."""
    if origin.first is None or origin.last is None:
        return []
    return [
        ("sfm_calib", _counted(origin.versions)),
        ("code", _counted(origin.git)),
        ("machine", _counted(origin.hosts)),
        ("libraries", ", ".join(f"{n} {_counted(held)}" for n, held in origin.libraries.items())),
        ("trials took", f"{duration(origin.seconds)} in sum"),
        ("finished", _span([origin.first.strftime(TIME), origin.last.strftime(TIME)])),
    ]


def _counted(held: Mapping[str, int]) -> str:
    """The one there is, or each with how many rows have it."""
    if len(held) == 1:
        return next(iter(held)) or "unknown"
    return ", ".join(f"{name or 'unknown'} ({count} rows)" for name, count in held.items())


def _span(ends: Sequence[str]) -> str:
    return " to ".join(dict.fromkeys(ends))

"""What a docstring says of its study, and an answer's tables as CSV and as text."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments.runner.answer_terminal import column_parts, tables_of
from experiments.runner.cells import NOTHING, column_texts, csv_of
from experiments.runner.docstring import said
from experiments.runner.protocol import AnswerTable

NAN = math.nan


def table(*columns: Sequence[object], name: str = "t") -> AnswerTable:
    rows = tuple(zip(*columns, strict=True))
    return AnswerTable(name, "Title", tuple(f"c{k}" for k in range(len(columns))), rows)


# ---- the docstring -------------------------------------------------------------------------


def test_a_docstring_comes_apart_at_its_labels() -> None:
    words = said(
        "Is it so?\n\nMore on this,\non two lines.\n\nMethod: we try,\nand look.\n- once\n- twice\n"
        "Source: Smith 2020: a book\nRun: sfm-calib run configs/studies/a.yaml -o out/a\n"
    )
    assert words.question == "Is it so?"
    assert [(p.label, p.text) for p in words.paragraphs] == [
        ("", "More on this, on two lines."),
        ("Method", "we try, and look."),
        ("", "- once"),
        ("", "- twice"),
        ("Source", "Smith 2020: a book"),
    ]
    assert words.command == "sfm-calib run configs/studies/a.yaml -o out/a"
    assert words.config == "configs/studies/a.yaml"


def test_a_docstring_that_says_little() -> None:
    assert said("").question == "" and said("").command == ""
    assert said("Why?\nRun: python -m experiments.bench").config == ""


# ---- cells ---------------------------------------------------------------------------------


@given(
    st.lists(
        st.tuples(
            st.text(st.characters(exclude_categories=["Cs"])),
            st.floats(),
            st.integers(),
            st.booleans() | st.none(),
        ),
        min_size=1,
    )
)
def test_csv_keeps_every_digit_and_every_character(rows: list[tuple[object, ...]]) -> None:
    written = csv_of(AnswerTable("t", "", ("text", 'say "x", y', "n", "flag"), tuple(rows)))
    head, *read = csv.reader(io.StringIO(written.decode("utf-8"), newline=""))
    assert head == ["text", 'say "x", y', "n", "flag"]
    for (text, number, count, flag), cells in zip(rows, read, strict=True):
        assert cells[0] == text and int(cells[2]) == count
        assert float(cells[1]) == number or (math.isnan(number) and cells[1] == "nan")
        assert cells[3] == {True: "true", False: "false", None: ""}[flag]


def test_csv_ends_its_lines_as_the_rfc_wants() -> None:
    made = csv_of(table([np.float64(0.1), np.float32(0.5)], [np.int64(3), None], [np.True_, "ü"]))
    assert made == "c0,c1,c2\r\n0.1,3,true\r\n0.5,,ü\r\n".encode()


@pytest.mark.parametrize(
    ("cells", "texts"),
    [
        ([0.95234, 1.04, 10.3], ["0.95", "1.04", "10.30"]),
        ([0.5, 1.0, 2.0], ["0.5", "1.0", "2.0"]),
        ([100.0, 200.0], ["100", "200"]),
        ([1e-9, 0.5], ["1e-09", "0.5"]),
        ([1e-12], ["1e-12"]),
        ([12345678.9, 1.0], ["1.235e+07", "1"]),
        ([12345.678], ["12346"]),
        ([0.0, -0.25], ["0.00", "-0.25"]),
        ([None, NAN, -math.inf, 2.5], [NOTHING, "nan", "-inf", "2.5"]),
        ([True, np.False_, None], ["yes", "no", NOTHING]),
        ([3, np.int64(4), 2.5], ["3", "4", "2.5"]),
        (["two\nlines", ""], ["two lines", ""]),
        ([], []),
    ],
)
def test_numbers_of_a_column_are_written_alike(cells: list[object], texts: list[str]) -> None:
    assert column_texts(cells) == texts


@given(st.lists(st.floats(-1e12, 1e12).filter(lambda x: x == 0 or abs(x) > 1e-12), min_size=1))
def test_numbers_stay_what_they_are(values: list[float]) -> None:
    shown = [float(text) for text in column_texts(values)]
    most = max(abs(value) for value in values)
    for value, number in zip(values, shown, strict=True):
        assert abs(number - value) <= 0.5001 * abs(value)  # one digit at the very least
        assert abs(number - value) <= 6e-4 * most


# ---- tables in the terminal ----------------------------------------------------------------


@given(
    st.lists(st.integers(4, 40), min_size=1, max_size=20), st.integers(1, 4), st.integers(60, 160)
)
def test_parts_of_a_table_fit_and_hold_all(widths: list[int], leading: int, width: int) -> None:
    parts = column_parts(widths, leading, width)
    assert sorted({k for part in parts for k in part}) == list(range(len(widths)))
    if len(parts) > 1:
        first = [k for k in parts[0] if all(k in part for part in parts)]
        assert first and all(part[: len(first)] == first for part in parts)
        own = [k for part in parts for k in part if k not in first]
        assert own == sorted(set(own))  # each once, in order
    for part in parts:
        assert sum(widths[k] for k in part) <= width or len(part) <= max(leading, 2)


@pytest.mark.parametrize("width", [80, 120, 160])
def test_a_wide_table_is_printed_whole(width: int) -> None:
    rng = np.random.default_rng(0)
    shape = [name for name in ("corridor", "orbit", "a quite long name") for _ in range(4)]
    noise = [0.1, 0.5, 2.0, 4.0] * 3
    values = rng.lognormal(0.0, 2.0, (12, 15))
    remark = ["words that go on for a while and then some more " * 2] * 12
    columns = (shape, noise, *(values[:, k].tolist() for k in range(15)), remark)
    names = ("shape", "noise px", *[f"sigma of c{k}, px" for k in range(15)], "remark")
    wide = AnswerTable("t", "", names, tuple(zip(*columns, strict=True)))
    console = Console(width=width, file=io.StringIO(), record=True)
    for part in tables_of(wide, width):
        console.print(part)
    lines = console.export_text().splitlines()
    assert max(map(len, lines)) <= width
    cells = {cell.strip() for line in lines for cell in line.split("│")}
    for k in range(15):
        assert set(column_texts(values[:, k].tolist())) <= cells
    heads = sum("┏" in line for line in lines)
    assert heads == sum("a quite long name" in line for line in lines) / 4 > 1

"""`sfm-calib study`: an answer's files, page and printed lines, and the index of studies."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from experiments import example
from experiments.runner.answer_page import figure_groups, render_page
from experiments.runner.answer_terminal import column_parts, tables_of
from experiments.runner.cells import NOTHING, column_texts, csv_of
from experiments.runner.docstring import said
from experiments.runner.index import BEGIN, END, HEADING, indexed, with_row
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from experiments.runner.registry import about
from experiments.runner.rows import StoredRow, write_config, write_row
from experiments.runner.study_command import StudyCommand
from experiments.runner.sweep import load_study, trials_of
from experiments.runner.verdict import answered, table_files
from sfm_calib.errors import CalibrationError

ROOT = Path(__file__).parents[1]
CONFIGS = sorted((ROOT / "configs/studies").glob("*.yaml"))
EXAMPLE = ROOT / "configs/studies/example.yaml"
BEGAN = datetime(2026, 5, 1, 12, tzinfo=UTC)
SMALL = ("grid.draws=[2, 10]", "seeds=6")
NAN = math.nan


def run_study(
    folder: Path,
    settings: Sequence[str] = SMALL,
    share: float = 1.0,
    change: Callable[[int, StoredRow], StoredRow] = lambda _, row: row,
) -> Path:
    """RESULTS of the example, as far as it has come."""
    pytest.importorskip("pyarrow")
    config = load_study(EXAMPLE, settings)
    trials = trials_of(config)
    write_config(folder, config, trials)
    for index, one in enumerate(trials[: round(share * len(trials))]):
        row = StoredRow(
            key=one.key, seed=one.seed, ending="done", row={}, error=None, traceback=None,
            seconds=0.5, created=BEGAN + timedelta(seconds=index), version="1.2",
            versions={"numpy": "2.4"}, git="abc123", host="here",
        )  # fmt: skip
        try:
            row = replace(row, row=dict(example.trial(one.options, one.seed)))
        except ValueError as error:
            row = replace(row, ending="refused", error=str(error), traceback="Traceback ...")
        write_row(folder, one, change(index, row))
    return folder


def answer_with(
    monkeypatch: pytest.MonkeyPatch, made: Answer | Callable[[Sequence[Finished]], Answer]
) -> None:
    """Let the example answer so."""
    answer = made if callable(made) else lambda trials: made
    monkeypatch.setattr(example, "STUDY", replace(example.STUDY, answer=answer))


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


# ---- what an answer rests on ---------------------------------------------------------------


def test_a_whole_study_is_answered(tmp_path: Path) -> None:
    found = answered(run_study(tmp_path))
    record = found.record
    assert (record.study, record.question) == ("example", said(about("example")).question)
    assert record.holds is True and record.line.startswith("as expected – yes: RMS")
    assert record.trials.model_dump() == {
        "asked": 12, "finished": 12, "failed": 0, "broken": 0, "elsewhere": 0,
    }  # fmt: skip
    assert record.warnings == () and record.failures == () and record.tables == ("ratios.csv",)
    assert record.config == {"study": "example", "grid": {"draws": [2, 10]}, "seeds": 6}
    origin = record.origin
    assert origin.seconds == pytest.approx(6.0) and origin.git == {"abc123": 12}
    assert origin.first == BEGAN and origin.last == BEGAN + timedelta(seconds=11)


def test_failures_are_counted_by_what_they_say(tmp_path: Path) -> None:
    def change(index: int, row: StoredRow) -> StoredRow:
        if index == 4:
            return replace(row, ending="failed", row={}, error="KeyError: 'x'", traceback="T")
        if index % 3 == 1:
            error = f"cam{index} has {index} frames of -1.5e-3"
            return replace(row, ending="refused", row={}, error=error)
        return row

    record = answered(run_study(tmp_path, change=change)).record
    assert (record.trials.finished, record.trials.failed) == (12, 4)
    assert [(f.error, f.count, f.first, f.ending) for f in record.failures] == [
        ("cam1 has 1 frames of -1.5e-3", 3, "draws=10, seed=0", "refused"),
        ("KeyError: 'x'", 1, "draws=2, seed=2", "failed"),
    ]
    assert record.warnings == ()


def test_a_run_that_goes_on_is_answered_from_what_is_there(tmp_path: Path) -> None:
    record = answered(run_study(tmp_path, share=0.5)).record
    assert (record.trials.asked, record.trials.finished) == (12, 6)
    (warning,) = record.warnings
    command = f"sfm-calib run {tmp_path}/study.yaml -o {tmp_path}"
    assert warning.startswith("6 of 12 trials: the rest are not run yet") and command in warning
    run_study(tmp_path, ("grid.draws=[3]", "seeds=2"), share=0.0)
    record = answered(tmp_path).record
    assert record.said == "no verdict" and record.holds is None
    assert record.trials.elsewhere == 6 and record.origin.first is None
    assert "6 more rows" in record.warnings[1]


def test_rows_of_different_code_are_warned_of(tmp_path: Path) -> None:
    def change(index: int, row: StoredRow) -> StoredRow:
        if index == 0:
            return replace(row, git="abc123-dirty", versions={"numpy": "2.3"})
        return replace(row, ending="broken", error="killed", row={}) if index == 1 else row

    warnings = answered(run_study(tmp_path, change=change)).record.warnings
    assert [warning.split(":")[0] for warning in warnings] == [
        "1 trials were broken off by the machine, which says nothing of them; run again with",
        "rows come from 2 states of the code",
        "rows come from 2 versions of numpy",
        "1 of 12 rows",
    ]
    assert "abc123-dirty (1), abc123 (11)" in warnings[1]


def test_an_answer_that_breaks_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answer_with(monkeypatch, lambda trials: Answer(str(trials[99]), None))
    run_study(tmp_path)
    with pytest.raises(CalibrationError, match=r"from 12 of 12 trials: IndexError.*line \d+\)$"):
        answered(tmp_path)


def test_tables_have_files_of_their_own() -> None:
    names = ("a", "../a", "a b", "", "é/..", "a")
    files = table_files(Answer("", None, tuple(table([1], name=name) for name in names)))
    assert len(set(files)) == len(names) and files[0] == "a.csv"
    assert all(re.fullmatch(r"[\w-]+\.csv", file) for file in files)


# ---- the command ---------------------------------------------------------------------------


def test_the_command_writes_and_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "answer"
    assert StudyCommand(run_study(tmp_path, share=0.75)).run([]) == 0
    record = json.loads((out / "verdict.json").read_text())
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == record["question"]
    assert lines[-2] == f"as expected – {record['verdict']}"  # as the index has it
    assert lines[-1] == f"{out}/answer.html, verdict.json, ratios.csv written"
    assert f"warning: {record['warnings'][0]}" in lines  # whole, however long
    assert sorted(path.name for path in out.iterdir()) == [
        *("answer.html", "ratios.csv", "verdict.json")
    ]
    with (out / "ratios.csv").open(newline="") as file:
        shown = list(csv.DictReader(file))
    assert [row["draws"] for row in shown] == ["2", "10"]


def test_json_alone_and_another_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results, out = run_study(tmp_path / "results"), tmp_path / "other"
    StudyCommand(results, out=out, json=True).run([])
    printed = capsys.readouterr().out
    assert printed == (out / "verdict.json").read_text()
    assert json.loads(printed)["holds"] is True
    assert not (results / "answer").exists()


def test_the_same_rows_give_the_same_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = StudyCommand(run_study(tmp_path))
    command.run([])
    first = {path.name: path.read_bytes() for path in (tmp_path / "answer").iterdir()}
    command.run([])
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "answer").iterdir()}
    # A table that the answer has no more does not stay; what we did not write does.
    (tmp_path / "answer/mine.csv").write_text("kept")
    answer_with(monkeypatch, Answer("nothing", None, (table([1], name="new"),)))
    command.run([])
    assert {path.name for path in (tmp_path / "answer").iterdir()} == {
        *("answer.html", "verdict.json", "new.csv", "mine.csv")
    }


def test_what_is_no_study_is_said(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="holds no study"):
        StudyCommand(tmp_path).run([])
    run_study(tmp_path / "results", share=0.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(CalibrationError, match="it is a file"):
        StudyCommand(tmp_path / "results", out=tmp_path / "file").run([])


# ---- the page ------------------------------------------------------------------------------


def page_of(folder: Path) -> str:
    """Without plotly.js, which is nine tenths of it."""
    text = render_page(answered(folder))
    return re.sub(r"<script>/\*\*.*?</script>", "", text, count=1, flags=re.DOTALL)


def test_outside_text_is_escaped_and_nothing_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = "<script>alert(1)</script>&\udcff"
    figure = AnswerFigure(bad, bad, bad, go.Figure(go.Scatter(x=[1, 2], y=[NAN, 1.0], name=bad)))
    made = AnswerTable(bad, bad, (bad, "b"), ((bad, NAN), (None, 1.0)))
    answer_with(monkeypatch, Answer(f"no: {bad}", False, (made,), (figure,)))

    def change(index: int, row: StoredRow) -> StoredRow:
        named = replace(row, host="<script>host")
        return replace(named, ending="failed", error="<script>error", traceback="<script>trace")

    text = page_of(run_study(tmp_path, change=change))
    assert len(text) < 100_000 and "<script>alert" not in text and "<script>host" not in text
    assert "<script>error" not in text and "<script>trace" not in text
    assert "no: &lt;script&gt;alert(1)&lt;/script&gt;&amp;" in text and "Not as expected" in text
    assert not re.search(r"""(src|href)=["'](?!#)""", text) and "default-src 'none'" in text
    StudyCommand(tmp_path).run([])  # lone surrogates and all
    assert (tmp_path / "answer/answer.html").stat().st_size > 1_000_000


def test_the_page_says_what_was_asked_and_what_is_missing(tmp_path: Path) -> None:
    text = page_of(run_study(tmp_path, ("grid.draws=[1, 2]", "seeds=6"), share=0.5))
    words = said(about("example"))
    for paragraph in words.paragraphs:
        assert f"<dt>{paragraph.label}</dt><dd>" in text
    assert "6 of 12 trials: the rest are not run yet" in text
    assert '<a href="#failures">3 of them failed</a>' in text
    assert "one number has no scatter" in text and "Traceback ..." in text
    assert "draws: [1, 2]" in text and "abc123" in text and words.command in text
    assert "2026-05-01 12:00:00 UTC to 2026-05-01 12:00:05 UTC" in text


def test_small_figures_stand_side_by_side() -> None:
    heights = (300, None, 900, 700, 300, 800)
    figures = [AnswerFigure("", str(h), "", go.Figure(layout_height=h)) for h in heights]
    groups = figure_groups(Answer("", None, (), tuple(figures)))
    titles = [[panel.title for panel in group] for group in groups]
    assert titles == [["300", "None"], ["900"], ["700"], ["300"], ["800"]]


def test_figures_are_as_wide_as_their_place() -> None:
    fixed = go.Figure(layout={"width": 2000, "height": 300})
    ((panel,),) = figure_groups(Answer("", None, (), (AnswerFigure("", "", "", fixed),)))
    assert '"width":2000' not in panel.figure and fixed.layout.width == 2000


def test_long_tables_are_cut_in_the_page_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = table(list(range(1234)), name="many")
    answer_with(monkeypatch, Answer("x", None, (many,)))
    StudyCommand(run_study(tmp_path)).run([])
    assert "234 more rows in many.csv" in (tmp_path / "answer/answer.html").read_text()
    assert (tmp_path / "answer/many.csv").read_bytes().count(b"\r\n") == 1235


# ---- the index -----------------------------------------------------------------------------


def index_with(rows: Sequence[str] = ()) -> str:
    return "\n".join(["# Title", "| a | table |", BEGIN, *HEADING, *rows, END, "", "| after |", ""])


def test_a_row_takes_the_place_of_the_one_before() -> None:
    old = ["| `a.py` | A? | `run a` | yes \\| no |", "| `b.py` | B? | `run b` | old |"]
    row = ("`a.py`", "A?", "`run`", "new")
    text = with_row(index_with(old), row, Path("x"))
    assert text == index_with(["| `a.py` | A? | `run` | new |", old[1]])
    assert indexed(index_with(old))["`a.py`"] == ("`a.py`", "A?", "`run a`", "yes \\| no")
    added = with_row(index_with(old), ("`c.py`", "C?", "`c`", "c"), Path("x"))
    assert added == index_with([*old, "| `c.py` | C? | `c` | c |"])
    bare = with_row(f"{BEGIN}\n{END}\n", row, Path("x"))
    assert indexed(bare) == {"`a.py`": row} and with_row(bare, row, Path("x")) == bare


def test_no_index_is_said() -> None:
    with pytest.raises(CalibrationError, match="no index of studies"):
        with_row("# Title\n", ("", "", "", ""), Path("x.md"))


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A folder with the example's config and an index."""
    (tmp_path / "configs/studies").mkdir(parents=True)
    small = EXAMPLE.read_text().replace("seeds: 100", "seeds: 3")
    (tmp_path / "configs/studies/example.yaml").write_text(small)
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments/README.md").write_text(index_with())
    return tmp_path


def test_the_index_has_the_verdict_that_is_printed(
    repository: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer_with(monkeypatch, Answer("no: a|b <i>\\ 5 %\n twice", False))
    index = repository / "experiments/README.md"
    StudyCommand(run_study(repository / "out", ["seeds=3"]), index=index).run([])
    words = said(about("example"))
    assert indexed(index.read_text())["`example.py`"] == (
        "`example.py`",
        words.question,
        f"`{words.command}`",
        "not as expected – no: a\\|b &lt;i>\\\\ 5 % twice",
    )
    assert "not as expected – no: a|b <i>\\ 5 % twice" in capsys.readouterr().out.splitlines()


def test_the_index_takes_whole_studies_of_its_command_alone(repository: Path) -> None:
    index = repository / "experiments/README.md"
    before = index.read_text()
    part = run_study(repository / "part", ["seeds=3"], share=0.5)
    with pytest.raises(CalibrationError, match="4 of 9 trials of example are finished"):
        StudyCommand(part, index=index).run([])
    other = run_study(repository / "other")
    with pytest.raises(CalibrationError, match=r"are not those of configs/studies/example\.yaml"):
        StudyCommand(other, index=index).run([])
    assert index.read_text() == before


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_is_indexed_as_its_study_says(path: Path) -> None:
    config = load_study(path)
    words = said(about(config.study))
    assert path.read_text().splitlines()[0] == f"# {words.question}"
    assert words.config == path.relative_to(ROOT).as_posix()
    rows = indexed((ROOT / "experiments/README.md").read_text())
    assert f"`{config.study}.py`" in rows, "sfm-calib study RESULTS --index experiments/README.md"
    _, question, command, verdict = rows[f"`{config.study}.py`"]
    assert question == words.question and command == f"`{words.command}`"
    assert verdict.startswith(("as expected", "not as expected", "no verdict"))

"""`sfm-calib study`: an answer's files, page and printed lines, and the index of studies."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import plotly.graph_objects as go
import pytest

from experiments import example
from experiments.runner.answer_page import figure_groups, render_page
from experiments.runner.docstring import said
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from experiments.runner.registry import about
from experiments.runner.rows import StoredRow, write_config, write_row
from experiments.runner.study_command import StudyCommand
from experiments.runner.sweep import load_study, trials_of
from experiments.runner.verdict import answered, table_files
from sfm_calib.errors import CalibrationError

ROOT = Path(__file__).parents[1]
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
    assert record.config == {
        "study": "example",
        "grid": {"draws": [2, 10]},
        "seeds": 6,
        "seconds": 0.001,
    }
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

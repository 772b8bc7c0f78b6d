"""The index of studies in experiments/README.md: it holds what studies print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from test_study_command import EXAMPLE, ROOT, answer_with, run_study

from experiments.runner.docstring import said
from experiments.runner.index import BEGIN, END, HEADING, indexed, with_row
from experiments.runner.protocol import Answer
from experiments.runner.registry import about
from experiments.runner.study_command import StudyCommand
from experiments.runner.sweep import load_study
from sfm_calib.errors import CalibrationError

CONFIGS = sorted((ROOT / "configs/studies").glob("*.yaml"))


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

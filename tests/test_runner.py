"""Runs of studies: rows as they finish, resumed after any end, the same wherever they run."""

from __future__ import annotations

import signal
import subprocess
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet
import pytest
from synthetic.studies import STUDY, command, here, planned, rows_of, study, wait_for

from experiments import example
from experiments.runner.attempt import Job, attempt
from experiments.runner.rows import StoredRow, read_results, read_row, write_row
from experiments.runner.run import Plan, plan, run
from experiments.runner.run_command import RunCommand, duration
from experiments.runner.sweep import StudyConfig, load_study, trials_of
from graphs.threads import at_most, threads
from sfm_calib.cli import main
from sfm_calib.errors import CalibrationError


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials run in this process, where nothing rests on the processes of their own."""
    monkeypatch.setattr(
        "experiments.runner.run.run_here", lambda jobs, processes: map(attempt, jobs)
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of all trials, one of which refuses."""
    folder = tmp_path_factory.mktemp("whole")
    out = folder / "out"
    assert (
        main(["run", str(study(folder, STUDY.replace("[2, 5]", "[1, 2, 5]"))), "-o", str(out)]) == 0
    )
    return out


# ---- rows ----------------------------------------------------------------------------------


def test_every_trial_is_a_row(whole: Path) -> None:
    results = read_results(whole)
    assert len(results.trials) == len(results.finished) == len(results.in_order) == 12
    table = pyarrow.parquet.read_table(whole / "rows.parquet").to_pylist()
    assert [row["trial.key"] for row in table] == [trial.key for trial in results.trials]
    assert [(row["options.draws"], row["trial.seed"]) for row in table] == [
        (draws, seed) for seed in range(4) for draws in (1, 2, 5)
    ]
    for row in table:
        assert row["trial.seconds"] >= 0 and row["trial.version"] and row["trial.created"]
        assert "numpy" in row["trial.versions"]


def test_a_trial_that_refuses_is_a_row_with_its_error(whole: Path) -> None:
    refused = [f for f in read_results(whole).in_order if f.error is not None]
    assert [f.options.draws for f in refused] == [1] * 4
    assert all("give 2 draws" in str(f.error) and not f.row for f in refused)


def test_a_row_comes_back_as_it_was(tmp_path: Path) -> None:
    (trial,) = trials_of(load_study(study(tmp_path, "study: example")))
    job = Job(trial.key, trial.study, trial.options.model_dump_json(), trial.seed, 1, str(tmp_path))
    stored = replace(
        attempt(job),
        row={"a": 1.5, "b": [1.0, float("nan")], "c": None, "d": "x", "e": True, "f": ["p", "q"]},
    )
    write_row(tmp_path, trial, stored)
    again = read_row(tmp_path / "rows" / f"{trial.key}.parquet")
    assert repr(again) == repr(stored)


def test_bugs_keep_their_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(draws: int) -> None:
        raise KeyError("no such thing")

    monkeypatch.setattr("numpy.random.default_rng", broken)
    row = attempt(Job("k", "example", "{}", 0, 1, str(tmp_path)))
    assert row.ending == "failed"
    assert row.error == "KeyError: 'no such thing'"
    assert row.traceback and "in broken" in row.traceback


def test_a_file_that_is_no_row_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.parquet"
    path.write_text("no Parquet")
    with pytest.raises(
        CalibrationError, match=r"x\.parquet is not its trial's row .*run the study again"
    ):
        read_row(path)


@pytest.mark.usefixtures("at_once")
def test_rows_that_cannot_be_read_are_made_anew(tmp_path: Path) -> None:
    """Those cut short, and those of another trial under its name."""
    path, out = study(tmp_path), tmp_path / "out"
    here(path, out)
    first, second, third, *_ = sorted((out / "rows").glob("*.parquet"))
    first.write_bytes(b"")
    second.write_bytes(third.read_bytes())
    with pytest.raises(CalibrationError, match=r"is not its trial's row .*\(2 files are so\)"):
        read_results(out)
    assert {row.key for row in here(path, out)} == {first.stem, second.stem}
    assert read_row(second).key == second.stem


# ---- resuming ------------------------------------------------------------------------------


@pytest.mark.usefixtures("at_once")
def test_finished_trials_are_not_run_again(tmp_path: Path) -> None:
    path, out = study(tmp_path), tmp_path / "out"
    first = here(path, out)
    assert len(first) == 8
    assert not here(path, out)
    for gone in list((out / "rows").glob("*.parquet"))[:3]:
        gone.unlink()
    again = here(path, out)
    assert len(again) == 3
    assert {row.key: row.row for row in again}.items() <= {r.key: r.row for r in first}.items()
    longer = study(tmp_path, STUDY.replace("seeds: 4", "seeds: 5"))
    assert {row.seed for row in here(longer, out)} == {4}
    assert len(here(longer, out, fresh=True)) == 10


@pytest.mark.usefixtures("at_once")
def test_rows_of_an_earlier_config_wait_for_its_return(tmp_path: Path) -> None:
    out = tmp_path / "out"
    here(study(tmp_path), out)
    here(study(tmp_path, STUDY.replace("seeds: 4", "seeds: 2")), out)
    assert len(rows_of(out)) == 4
    assert pyarrow.parquet.read_table(out / "rows.parquet").num_rows == 4
    assert not here(study(tmp_path), out)


@pytest.mark.usefixtures("at_once")
def test_what_failed_is_run_again_where_that_is_said(tmp_path: Path) -> None:
    path, out = study(tmp_path, "study: example\ngrid: {draws: [1, 2]}\n"), tmp_path / "out"
    here(path, out)
    assert not here(path, out)
    assert [row.ending for row in here(path, out, retry=True)] == ["refused"]


@pytest.mark.parametrize("row", [{"a": [1.0, "x"]}, {"a": 2**70}, {"a": "\udcff"}])
def test_what_no_file_can_hold_is_a_failed_trial(
    row: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(example, "STUDY", replace(example.STUDY, trial=lambda options, seed: row))
    stored = attempt(Job("k", "example", "{}", 0, 1, str(tmp_path)))
    assert stored.ending in ("failed", "refused") and not stored.row
    (trial,) = trials_of(load_study(study(tmp_path, "study: example")))
    write_row(tmp_path, trial, stored)
    assert read_row(tmp_path / "rows/k.parquet").error == stored.error


@pytest.mark.usefixtures("at_once")
def test_columns_of_several_kinds_are_texts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trial(options: object, seed: int) -> dict[str, object]:
        return {"a": (1, "one", None, 2.5)[seed], "b": (1, 2.5, None, 3)[seed]}

    monkeypatch.setattr(example, "STUDY", replace(example.STUDY, trial=trial))
    out = tmp_path / "out"
    here(study(tmp_path, "study: example\nseeds: 4"), out)
    table = pyarrow.parquet.read_table(out / "rows.parquet")
    assert table["a"].to_pylist() == ["1", '"one"', "null", "2.5"]
    assert table["b"].to_pylist() == [1, 2.5, None, 3]


@pytest.mark.usefixtures("at_once")
def test_what_is_done_anew_leaves_nothing_old_behind(tmp_path: Path) -> None:
    """Though it is interrupted."""
    path, out = study(tmp_path), tmp_path / "out"
    here(path, out)

    def interrupt(row: StoredRow) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(planned(path, out, fresh=True), out, None, interrupt)
    assert len(rows_of(out)) == 1
    assert len(here(path, out)) == 7


@pytest.mark.usefixtures("at_once")
def test_a_run_that_waited_does_not_repeat_what_another_did(tmp_path: Path) -> None:
    path, out = study(tmp_path), tmp_path / "out"
    late, made = planned(path, out), []
    here(path, out)
    assert len(run(late, out, None, made.append)) == 8
    assert not made


@pytest.mark.usefixtures("at_once")
def test_a_changed_key_is_run_again(tmp_path: Path) -> None:
    config = StudyConfig(study="example")
    (trial,) = trials_of(config)
    out = tmp_path / "out"
    out.mkdir()
    run(plan(config, [trial], out, 1), out, None, lambda row: None)
    assert not plan(config, [trial], out).todo
    assert plan(config, [replace(trial, key="0" * 16)], out).todo


@pytest.mark.usefixtures("at_once")
def test_another_study_is_not_mixed_in(tmp_path: Path) -> None:
    out = tmp_path / "out"
    here(study(tmp_path), out)
    other = load_study(study(tmp_path)).model_copy(update={"study": "drift"})
    with pytest.raises(CalibrationError, match="holds results of the study 'example'"):
        plan(other, [], out)


def test_two_runs_do_not_write_to_one_folder(tmp_path: Path) -> None:
    path, out = study(tmp_path, "study: example\noptions: {pause_s: 20}\n"), tmp_path / "out"
    with subprocess.Popen(command(path, out), stderr=subprocess.DEVNULL) as first:
        wait_for(out / "study.yaml")
        with pytest.raises(CalibrationError, match="another run is writing"):
            here(path, out)
        first.send_signal(signal.SIGTERM)
        assert first.wait(20) == 130
    assert not rows_of(out)


# ---- the command ---------------------------------------------------------------------------


def test_a_dry_run_runs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = study(tmp_path, STUDY + "seconds: 60\n"), tmp_path / "out"
    assert main(["run", str(path), "-o", str(out), "--dry-run", "-j", "4"]) == 0
    said = capsys.readouterr().out
    assert "8 trials; about 2 min on this machine, 4 at a time" in said
    assert "draws=5, seed=3" in said
    assert not out.exists()


@pytest.mark.usefixtures("at_once")
def test_time_is_estimated_from_rows_that_are_there(tmp_path: Path) -> None:
    path, out = study(tmp_path, "study: example\ngrid: {draws: [2, 3]}\n"), tmp_path / "out"
    rows = here(path, out)
    slow = {row.key: replace(row, seconds=7.0 + row.row["error"] * 0) for row in rows}  # type: ignore[operator]
    config = load_study(path, ["seeds=3"])
    later = Plan(config, trials_of(config), slow, processes=2)
    assert len(later.todo) == 4
    assert later.seconds == pytest.approx(14.0)
    assert Plan(config, trials_of(config), {}, 2).seconds is None


def test_its_end_is_told(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = study(tmp_path, STUDY.replace("[2, 5]", "[1, 2, 5]"))
    assert main(["run", str(path), "-o", str(whole)]) == 0
    said = capsys.readouterr()
    assert "12 trials: 4 refused, 8 done" in said.out
    assert "4 x one number has no scatter" in said.out
    assert "all 12 trials are finished already" in said.err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--set", "options.drws=2"], "did you mean 'draws'"),
        (["--jobs", "0"], "--jobs 0: give 1 or more"),
        (["--cluster", "nonsense"], "--cluster nonsense is no address: give one such as tcp"),
        (["--cluster", "no.json"], "--cluster no.json: there is no such scheduler file"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    out = tmp_path / "out"
    assert main(["run", str(study(tmp_path)), "-o", str(out), *more]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1
    assert not out.exists()


@pytest.mark.usefixtures("at_once")
@pytest.mark.usefixtures("at_once")
def test_a_run_of_which_nothing_came_says_so_to_scripts(tmp_path: Path) -> None:
    path = study(tmp_path, "study: example\ngrid: {draws: [1, 2]}")
    assert main(["run", str(path), "-o", str(tmp_path / "a")]) == 0
    path = study(tmp_path, "study: example\noptions: {draws: 1}")
    assert main(["run", str(path), "-o", str(tmp_path / "b")]) == 1


def test_what_is_missing_is_said_before_and_refused_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """And no results go among what trials read."""
    scan = tmp_path / "scan"
    scan.mkdir()
    text = "study: calibrations\noptions: {command: calibrate}\n"
    path = study(tmp_path, f"{text}list: [{{scan: {scan}}}, {{scan: {tmp_path / 'none'}}}]")
    assert main(["run", str(path), "-o", str(tmp_path / "out"), "--dry-run"]) == 0
    said = capsys.readouterr()
    assert f"note: {tmp_path / 'none'} is not there" in said.err and "2 trials" in said.out
    keys = {trial.key for trial in trials_of(load_study(path))}
    (tmp_path / "none").mkdir()
    assert len(keys & {trial.key for trial in trials_of(load_study(path))}) == 1
    assert main(["run", str(path), "-o", str(scan), "--dry-run"]) == 2
    assert "is what trials read" in capsys.readouterr().err


def test_results_go_where_the_file_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert RunCommand(study(tmp_path, "study: example"), jobs=1).run([]) == 0
    assert (tmp_path / "out/some/rows.parquet").exists()


def test_times_are_told_as_people_say_them() -> None:
    assert [duration(s) for s in (0.2, 61, 100, 5400)] == ["1 s", "61 s", "2 min", "1.5 h"]


def test_threads_can_be_fewer() -> None:
    with threads() as free:
        most = free._max_workers
    with at_most(1), threads() as one:
        assert one._max_workers == 1
    with at_most(None), threads() as every:
        assert every._max_workers == most

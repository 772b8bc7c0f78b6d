"""What a person reads: as many digits as mean something, tables that fit 80 columns."""

import io
import itertools

import pytest
from rich.console import Console
from synthetic.problems import small_problem
from test_result import rig

from sfm_calib import terminal
from sfm_calib.comparison import compare_with_truth
from sfm_calib.report.headline import key_figures
from sfm_calib.result import Noise, Selection, Solve, Verdict, WeakDirection
from sfm_calib.terminal import print_comparison, print_result, sigma_text, with_digits


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (686.1234, 0.6, ("686.12", "0.60")),
        (686.1234, 0.0996, ("686.12", "0.10")),
        (686.1234, 25.0, ("686", "25")),
        (686.1234, 251.0, ("686", "251")),
        (-0.0123456, 0.00097, ("-0.01235", "0.00097")),
        (-0.00001, 0.0012, ("0.0000", "0.0012")),
        (500.0, 0.0, ("500", "fixed")),
        (0.123456789, 0.0, ("0.123457", "fixed")),
        (1.0, float("nan"), ("1", "fixed")),
    ],
)
def test_digits(value, sigma, shown):
    assert (with_digits(value, sigma), sigma_text(sigma)) == shown


def test_errors_carry_their_sign():
    assert [with_digits(e, 0.2, "+") for e in (0.31, -0.31, -0.001)] == ["+0.31", "-0.31", "+0.00"]


def finished(**changes):
    solve = Solve(
        converged=True, reason="", iterations=9, rms_px=0.3, n_frames=50, n_images=100,
        n_points=12345, n_observations=123456, n_rejected=1234,
    )  # fmt: skip
    weak = WeakDirection(what="left.cx", effect_px=3.0, remedy="turn the camera about its axis")
    verdict = Verdict(usable=True, weak=(weak,), messages=("left/7.png is unreadable: skipped",))
    changes = {"solve": solve, "noise": Noise(sigma_px=0.31), "verdict": verdict} | changes
    return rig().model_copy(update=changes)


def printed(calibration, terminal_width=None):
    file = io.StringIO()
    console = Console(
        file=file, width=terminal_width or 80, force_terminal=terminal_width is not None,
        markup=False, emoji=False, highlight=False, color_system=None,
    )  # fmt: skip
    print_result(calibration, console)
    print_comparison(compare_with_truth(calibration, rig()), console)
    return file.getvalue().splitlines()


def test_everything_is_said():
    text = "\n".join(printed(finished()))
    for part in (
        "left: radtan, 640 x 480 px, 0 images, 0 observations",
        "cam_from_rig: reference left, scale simulation",
        "100 images in 50 frames, 12345 points, 123456 observations",
        "1234 mismatches set aside; noise 0.31 px, sigmas widened 1.0 x",
        "weak: left.cx is decided by its prior; turn the camera",
        "note: left/7.png is unreadable: skipped",
        "right.translation_x",
        "11.4592",  # rotation_y of the rig in degrees
    ):
        assert part in text
    assert "NOT USABLE" not in text
    assert "NOT USABLE" in "\n".join(printed(finished(verdict=Verdict(usable=False))))


def test_what_a_budget_cost_is_said():
    chosen = Selection(available=91000, kept=40000, sigma_factor=1.214, worst_sigma_factor=1.4)
    solve = finished().solve.model_copy(update={"selection": chosen})
    assert (
        "40000 of 91000 observations chosen (max_observations): model sigmas 1.21 x those of "
        "all, at worst 1.40 x"
    ) in printed(finished(solve=solve))
    assert "max_observations" not in "\n".join(printed(finished()))
    problem, _ = small_problem()
    remarks = [figure.remark for figure in key_figures(finished(solve=solve), problem)]
    assert "of 12,345 scene points; 40,000 of 91,000 were chosen, sigmas × 1.21 for it" in remarks


@pytest.mark.parametrize("width", [None, 80])
def test_tables_fit_eighty_columns(width):
    lines = printed(finished(), width)
    tables = [line for line in lines if line and line[0] in "┏┃┡│└├"]
    assert len(tables) > 40 and max(map(len, tables)) <= 80 and not any("…" in t for t in tables)


def test_lines_in_a_file_are_not_broken():
    long = Verdict(usable=True, messages=("a long remark " * 20,))
    assert "note: " + "a long remark " * 20 in printed(finished(verdict=long))
    assert max(map(len, printed(finished(verdict=long), 80))) <= 80


def test_names_are_not_markup():
    names = ("[red]", ":smile:")
    file = io.StringIO()
    console = terminal.result_console()
    console.file = file
    print_result(rig(names), console)
    assert "[red]: radtan" in file.getvalue() and ":smile: │ x" in file.getvalue()


def test_a_reader_that_has_read_enough_is_no_exit():
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    console = terminal.result_console()
    console.file = Closed()
    with pytest.raises(BrokenPipeError):
        print_result(rig(), console)


def test_plain_progress_is_sparing(capsys, monkeypatch):
    clock = itertools.count(0.0, 0.5)
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(clock))
    with terminal.progress_bars() as report:
        for done in range(1, 13):
            report("matching", done, 12)
        report("solving", 1, 0)
        report("covariance", 0, 0)
    assert capsys.readouterr().err.splitlines() == [
        *("matching 1 of 12", "matching 5 of 12", "matching 9 of 12", "solving 1", "covariance")
    ]


def test_bars_in_a_terminal(monkeypatch):
    file = io.StringIO()
    monkeypatch.setattr(
        terminal, "Console", lambda stderr: Console(file=file, force_terminal=True, width=100)
    )
    with terminal.progress_bars() as report:
        report("scanning [red].mp4", 1, 2)
        report("solving", 3, 0)
    assert "scanning [red].mp4" in file.getvalue() and "3/?" in file.getvalue()

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
from sfm_calib.result import (
    Certificate,
    LensChoice,
    Noise,
    Rung,
    Scale,
    Selection,
    Sigmas,
    Solve,
    Split,
    Verdict,
    WeakDirection,
)
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
    truth = rig(tuple(calibration.cameras))
    print_comparison(compare_with_truth(calibration, truth), console)
    return file.getvalue().splitlines()


def test_everything_is_said():
    text = "\n".join(printed(finished()))
    for part in (
        "left: radtan, 640 x 480 px, 0 images, 0 observations",
        "cam_from_rig: reference left, scale simulation",
        "100 images in 50 frames, 12345 points, 123456 observations",
        "1234 mismatches set aside; noise 0.31 px, sigmas 1.0 x those of noise alone (median)",
        "weak: left.cx: up to 3 px in the image; turn the camera",
        "note: left/7.png is unreadable: skipped",
        "right.translation_x",
        "11.4592",  # rotation_y of the rig in degrees
    ):
        assert part in text
    assert "NOT USABLE" not in text
    assert "NOT USABLE" in "\n".join(printed(finished(verdict=Verdict(usable=False))))


def test_checks_of_the_sigmas_are_said():
    split = Split(difference_px=1.4, expected_px=3.21, p_value=0.73, agrees=True)
    twins = Certificate(
        trials=9, failed=1, nees=1.2, nees_standard_error=0.12, model_nees=2.5, coverage=0.94,
        least_covered="right.k2", least_coverage=2 / 3, holds=True,
    )  # fmt: skip
    good = Verdict(usable=True, split=split, certificate=twins)
    text = "\n".join(printed(finished(verdict=good)))
    assert (
        "Two halves of the frames: calibrated alone, they project 1.40 px apart (rms), and their "
        "sigmas predict 3.21 px (p = 0.73): they agree"
    ) in text
    assert (
        "9 simulated twins of the scan: squared errors are 1.20 times what the sigmas say "
        "(standard error 0.12), and 95 % intervals hold 94 % of the truths (right.k2: 6 of 9); 1 "
        "more could not be solved: the sigmas hold for this geometry and noise"
    ) in text
    bad = Verdict(
        usable=True,
        split=split.model_copy(update={"agrees": False}),
        certificate=twins.model_copy(update={"holds": False}),
    )
    text = "\n".join(printed(finished(verdict=bad)))
    assert "they DISAGREE" in text and "the sigmas DO NOT HOLD" in text
    assert "twins" not in "\n".join(printed(finished()))


def choice(chosen=1, **rung):
    first = Rung(
        lens="kannala_brandt", held=("k3", "k4"), held_out_px=0.5436, against=0, gain_px=0.0,
        gain_sigmas=0.0, shift_focal_px=0.0, shift_centre_px=0.0, sigma={}, weak=(),
        verdict="the first rung",
    )  # fmt: skip
    changes = {"held": (), "gain_px": 0.0231, "shift_centre_px": 103.5, "weak": ("a", "b")} | rung
    rungs = (first, first.model_copy(update=changes))
    reason = "kannala_brandt: removes 0.023 px"
    return LensChoice(chosen=chosen, reason=reason, n_frames=50, n_observations=9, rungs=rungs)


def test_the_ladder_fits_and_shows_what_was_chosen():
    lines = printed(finished(lens_choice=choice()))
    assert "lens by frames held out (50, in turn): kannala_brandt: removes 0.023 px" in lines
    rows = [line for line in lines if "kannala" in line and line[0] == "│"]
    assert [line.split("│")[1].strip() for line in rows] == [
        "kannala_brandt without k3, k4", "> kannala_brandt"
    ]  # fmt: skip
    cells = [cell.strip() for cell in rows[1].split("│")[2:-1]]
    assert cells == ["0.5436", "+0.0231", "103.5 px", "2"]
    assert max(map(len, rows)) <= 80 and not any("…" in line for line in rows)
    unjudged = printed(finished(lens_choice=choice(chosen=0, held_out_px=None)))
    assert "│   kannala_brandt                │        - │         │" in "\n".join(unjudged)


def parameter_rows(calibration):
    """The last cell of every row by its first: of lenses, and of the rig by axis."""
    lines = printed(calibration)
    end = next(i for i, line in enumerate(lines) if line.startswith("against"))
    cells = [[c.strip() for c in line.split("│")[1:-1]] for line in lines[:end] if line[:1] == "│"]
    return [(cell[0], cell[1], cell[-1]) for cell in cells]


def test_weak_parameters_are_marked():
    weak = WeakDirection(
        what="w", effect_px=1.0, remedy="r", parameters=("left.cx", "left.k2", "right.rotation_y")
    )
    lens = WeakDirection(
        what="l", effect_px=None, remedy="r", kind="choice of the lens",
        parameters=("left.k1", "left.cx"),
    )  # fmt: skip
    calibration = finished(verdict=Verdict(usable=True, weak=(lens, weak)))
    left = calibration.cameras["left"].model_copy(
        update={"sigma": {"k2": 0.1, "cx": 2.0}, "prior_share": {"k2": 0.9, "cx": 0.1, "p1": 1.0}}
    )
    calibration = calibration.model_copy(update={"cameras": calibration.cameras | {"left": left}})
    rows = parameter_rows(calibration)
    marks = {first: mark for first, _, mark in rows[:8]}
    assert marks == {
        "fx": "", "fy": "", "cx": "weak", "cy": "", "k1": "lens", "k2": "prior", "p1": "", "p2": ""
    }  # fmt: skip
    assert [mark for _, axis, mark in rows if axis in "xyz"] == ["", "weak", ""]
    assert "weak: l; r" in printed(calibration)


def test_the_sigma_of_noise_alone_stands_beside_the_stated():
    one = Sigmas(model=0.0511, robust=0.2, jackknife=None, stated=0.31)
    noise = Noise(sigma_px=0.3, sigmas={"left.fx": one})
    calibration = finished(noise=noise)
    left = calibration.cameras["left"].model_copy(update={"sigma": {"fx": 0.31}})
    cameras = calibration.cameras | {"left": left}
    lines = printed(calibration.model_copy(update={"cameras": cameras}))
    (row, *_) = [line for line in lines if line.startswith("│ fx")]
    assert [cell.strip() for cell in row.split("│")[2:5]] == ["500.00", "0.31", "0.05"]


def test_a_rig_without_scale_says_its_unit_once():
    scale = Scale(source="none: unit is the baseline left to right")
    none = rig().rig.model_copy(update={"metric": False, "scale": scale})
    lines = printed(finished(rig=none))
    assert "cam_from_rig: reference left, unit is the baseline left to right" in lines


def test_long_names_are_folded_not_cut():
    name = "a_camera_with_a_name_" * 3
    lines = printed(rig(("left", name)))
    assert not any("…" in line for line in lines)
    assert max(len(line) for line in lines if line and line[0] in "┏┃┡│└├") <= 80


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

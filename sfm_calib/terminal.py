"""What a person sees in the terminal: progress on stderr, the result as tables on stdout."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table

from graphs.frames import log_rotation
from graphs.lenses import PARAMETER_NAMES
from sfm_calib.images import Progress as Report
from sfm_calib.report.board import board_lines, gains
from sfm_calib.report.checks import checks_of
from sfm_calib.report.digits import sigma_text, with_digits
from sfm_calib.report.lens_ladder import rung_label
from sfm_calib.report.rows import TruthRow
from sfm_calib.report.weak import Mark, marks_of
from sfm_calib.result import PRIOR_DECIDES_SHARE, Calibration

SUSPICIOUS_Z = 4.0
PIPED_WIDTH = 80
SECONDS_BETWEEN_LINES = 2.0


@contextmanager
def progress_bars() -> Iterator[Report]:
    """A bar a stage; plain lines where stderr is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _plain_progress()
        return
    columns = (
        TextColumn("{task.description:<26}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            for name, task in tasks.items():
                if name != stage:
                    bars.stop_task(task)
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None)
            bars.update(tasks[stage], completed=done, total=total or None)

        yield report


def _plain_progress() -> Report:
    """A line as each stage begins, and one every few seconds."""
    current, printed = "", 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal current, printed
        now = time.monotonic()
        if stage == current and now - printed < SECONDS_BETWEEN_LINES:
            return
        current, printed = stage, now
        how_far = f" {done} of {total}" if total else f" {done}" if done else ""
        print(f"{stage}{how_far}", file=sys.stderr, flush=True)

    return report


class ResultConsole(Console):
    """A console that lets its caller know when nobody reads any more."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def result_console(piped_width: int = PIPED_WIDTH) -> Console:
    """Stdout; names are printed as they are, whatever brackets or colons they hold."""
    width = None if sys.stdout.isatty() else piped_width
    return ResultConsole(width=width, markup=False, emoji=False, highlight=False)


def print_result(calibration: Calibration, console: Console) -> None:
    """The parameters with their sigmas, and what is to be said of them."""
    marks = marks_of(calibration)
    for name, camera in calibration.cameras.items():
        print_line(
            console,
            f"{name}: {camera.lens}, {camera.size[0]} x {camera.size[1]} px, "
            + (
                "not in the scan: kept as the old calibration has it"
                if camera.kept_from
                else f"{camera.n_images} images, {camera.n_observations} observations"
            ),
        )
        table = table_of("", "value", "sigma", "of noise alone", "from priors", "")
        for parameter in PARAMETER_NAMES[camera.lens]:
            value, sigma = camera.params[parameter], camera.sigma.get(parameter, 0.0)
            share = camera.prior_share.get(parameter, 0.0)
            table.add_row(
                parameter,
                with_digits(value, sigma),
                sigma_text(sigma),
                _model_sigma(calibration, f"{name}.{parameter}", sigma),
                f"{share:.0%}",
                "prior"
                if sigma > 0 and share > PRIOR_DECIDES_SHARE
                else _word(marks.get(f"{name}.{parameter}", ())),
            )
        console.print(table)
    if len(calibration.cameras) > 1:
        _print_rig(calibration, console)
    _print_ledger(calibration, console)
    _print_lens_choice(calibration, console)
    _print_board(calibration, console)
    _print_basis(calibration, console)
    _print_verdict(calibration, console)


def _print_lens_choice(calibration: Calibration, console: Console) -> None:
    """The ladder of lenses, a rung a row."""
    if (choice := calibration.lens_choice) is None:
        return
    print_line(console, f"lens by frames held out ({choice.n_frames}, in turn): {choice.reason}")
    table = table_of("", "error px", "gain px", "centre moves", "weak")
    for index, rung in enumerate(choice.rungs):
        first = index == 0
        table.add_row(
            ("> " if index == choice.chosen else "  ") + rung_label(rung),
            "-" if rung.held_out_px is None else f"{rung.held_out_px:.4f}",
            "" if first or rung.held_out_px is None else f"{rung.gain_px:+.4f}",
            "" if first else f"{rung.shift_centre_px:.1f} px",
            str(len(rung.weak)),
        )
    console.print(table)


def _print_board(calibration: Calibration, console: Console) -> None:
    if calibration.board is None:
        return
    for line in board_lines(calibration.board):
        print_line(console, line)
    if rows := gains(calibration):
        table = table_of("", "sigma of the scan", "with the board", "gain", "moved")
        for row in rows:
            table.add_row(row.name, row.alone, row.joint, row.gain, row.moved)
        console.print(table)


def _word(marks: Sequence[Mark]) -> str:
    """What a row says of a parameter that is weak, or hangs on the choice of the lens."""
    words = [mark.word for mark in marks]
    return "weak" if "weak" in words else words[0] if words else ""


def _model_sigma(calibration: Calibration, name: str, sigma: float) -> str:
    """The sigma if all observations were independent, to the digits of the stated one."""
    sigmas = calibration.noise.sigmas.get(name) if calibration.noise else None
    return "" if sigmas is None or not sigma > 0 else with_digits(sigmas.model, sigma)


def _print_basis(calibration: Calibration, console: Console) -> None:
    """What the numbers rest on."""
    solve, noise = calibration.solve, calibration.noise
    if solve and noise:
        print_line(
            console,
            f"{solve.n_images} images in {solve.n_frames} frames, {solve.n_points} points, "
            f"{solve.n_observations} observations",
        )
        print_line(
            console,
            f"{solve.n_rejected} mismatches set aside; noise {noise.sigma_px:.2f} px, "
            f"sigmas {noise.inflation:.1f} x those of noise alone (median)",
        )
    if solve and (chosen := solve.selection):
        print_line(
            console,
            f"{chosen.kept} of {chosen.available} observations chosen (max_observations): model "
            f"sigmas {chosen.sigma_factor:.2f} x those of all, at worst "
            f"{chosen.worst_sigma_factor:.2f} x",
        )


def _print_verdict(calibration: Calibration, console: Console) -> None:
    """Checks of the sigmas, what is weak, and whether to use the result."""
    if (verdict := calibration.verdict) is None:
        return
    for check in checks_of(verdict):
        print_line(console, f"{check.title}: {check.text}")
    for weak in verdict.weak:
        sizes = f": {weak.sizes}" if weak.sizes else ""
        print_line(console, f"weak: {weak.what}{sizes}; {weak.remedy}")
    for message in verdict.messages:
        print_line(console, f"note: {message}")
    if not verdict.usable:
        print_line(console, "NOT USABLE: see the notes above")


def print_line(console: Console, text: str) -> None:
    """A line that a terminal breaks between words, and a file holds whole."""
    console.print(text, soft_wrap=not console.is_terminal)


def table_of(*columns: str) -> Table:
    """A table: names, whole, in the first column; numbers below titles, words below none."""
    table = Table()
    for column in columns:
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    first = table.columns[0]
    first.justify, first.no_wrap, first.overflow = "left", False, "fold"
    return table


def _print_rig(calibration: Calibration, console: Console) -> None:
    """cam_from_rig of every camera but the reference, an axis a row."""
    rig = calibration.rig
    scale = f"scale {rig.scale.source}" if rig.metric else rig.scale.source.removeprefix("none: ")
    print_line(console, f"cam_from_rig: reference {rig.reference}, {scale}")
    table = table_of(
        "",
        "",
        "rotation deg",
        "sigma",
        "translation m" if rig.metric else "translation",
        "sigma",
        "",
    )
    marks = marks_of(calibration)
    for name, entry in rig.cam_from_rig.items():
        if name == rig.reference:
            continue
        turn = np.degrees(log_rotation(calibration.cam_from_rig(name).rotation))
        for axis, letter in enumerate("xyz"):
            turned, moved = entry.sigma_rotation_deg[axis], entry.sigma_translation[axis]
            table.add_row(
                name if axis == 0 else "",
                letter,
                with_digits(float(turn[axis]), turned),
                sigma_text(turned),
                with_digits(entry.translation[axis], moved),
                sigma_text(moved),
                _word(
                    [
                        mark
                        for kind in ("rotation", "translation")
                        for mark in marks.get(f"{name}.{kind}_{letter}", ())
                    ]
                ),
                end_section=axis == 2,
            )
    console.print(table)


def _print_ledger(calibration: Calibration, console: Console) -> None:
    """Measured lengths that test each other, a source a row."""
    ledger = calibration.rig.scale.ledger
    if len(ledger) < 2:
        return
    wrong = calibration.rig.scale.contradicted
    print_line(
        console, f"{len(ledger)} measured lengths {'CONTRADICT each other' if wrong else 'agree'}"
    )
    table = table_of("", "measured m", "sigma", "found", "by the others", "sigma", "z")
    for entry in ledger:
        predicted, sigma = entry.predicted_by_others_m, entry.sigma_predicted_m
        told = predicted is not None and sigma is not None
        table.add_row(
            entry.what,
            with_digits(entry.measured_m, entry.sigma_m),
            sigma_text(entry.sigma_m),
            with_digits(entry.estimated_m, entry.sigma_m),
            with_digits(predicted or 0.0, sigma or 0.0) if told else "-",
            sigma_text(sigma or 0.0) if told else "-",
            "-" if entry.z is None else f"{entry.z:+.1f}",
            style="bold red" if entry.contradicts else "",
        )
    console.print(table)


def print_comparison(rows: Sequence[TruthRow], console: Console) -> None:
    """Estimate, truth, error, sigma and z of each parameter."""
    print_line(console, "against the truth")
    table = table_of("", "estimate", "truth", "error", "sigma", "z")
    for row in rows:
        table.add_row(
            row.name,
            with_digits(row.estimate, row.sigma),
            with_digits(row.truth, row.sigma),
            with_digits(row.error, row.sigma, "+"),
            sigma_text(row.sigma),
            f"{row.z:+.1f}" if math.isfinite(row.z) else "-",
            style="bold red" if abs(row.z) > SUSPICIOUS_Z else "",
        )
    console.print(table)

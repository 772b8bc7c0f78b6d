"""The folder that a command writes to, and how a finished calibration is written and printed."""

from __future__ import annotations

import os
import shlex
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from sfm_calib.calibrate import Outcome
from sfm_calib.errors import CalibrationError
from sfm_calib.exports import write_exports
from sfm_calib.formats.convert import FormatName
from sfm_calib.provenance import now
from sfm_calib.report.page import write_report
from sfm_calib.report.rows import TruthRow
from sfm_calib.result import save_calibration
from sfm_calib.terminal import print_comparison, print_line, print_result, result_console

LEAST_FREE = 20_000_000  # bytes: the report alone takes 5 MB


def check_apart(scan: Path, out: Path) -> None:
    """Raises CalibrationError where results would go among the images."""
    if out.exists() and out.resolve() == scan.resolve():
        raise CalibrationError(
            f"-o {out} is the scan itself: choose another folder, so that results do not lie among "
            "its images"
        )


@contextmanager
def output_folder(out: Path) -> Iterator[None]:
    """OUT, made where it is missing, and gone again where nothing was written to it.

    Raises CalibrationError now rather than after the work when OUT cannot be written.
    """
    missing = [path for path in (out, *out.parents) if not path.exists()]
    try:
        try:
            out.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=out):
                pass
            free = shutil.disk_usage(out).free
        except OSError as error:
            reason = "it is a file" if out.is_file() else error.strerror
            raise CalibrationError(
                f"cannot write to {out}: {reason}; choose another output folder with -o"
            ) from error
        if free < LEAST_FREE:
            raise CalibrationError(
                f"only {free / 1e6:.1f} MB are free in {out}, and results need "
                f"{LEAST_FREE / 1e6:.0f} MB at least: free some space or choose another output "
                "folder with -o"
            )
        yield
    finally:
        with suppress(OSError):  # as soon as one of them holds something
            for path in missing:
                path.rmdir()


def finish(
    outcome: Outcome,
    out: Path,
    rows: Sequence[TruthRow],
    as_json: bool,
    formats: Sequence[FormatName] = (),
) -> None:
    """Write calibration.json and report.html, both or none, then exports; print the result.

    Raises CalibrationError at the end, where a format refused.
    """
    outcome = dated(outcome)
    calibration = outcome.calibration
    write_results(outcome, out, rows)
    console = result_console()
    if as_json:
        print(calibration.model_dump_json(indent=1))
    else:
        print_result(calibration, console)
        if rows:
            print_comparison(rows, console)
        print_line(console, f"{out / 'calibration.json'} and {out / 'report.html'} written")
    written, refused = write_exports(calibration, formats, out)
    for line in () if as_json else written:
        print_line(console, line)
    if refused:
        raise CalibrationError("; ".join(refused) + f" ({out / 'calibration.json'} is written)")


def dated(outcome: Outcome) -> Outcome:
    """With the moment of writing in its provenance."""
    provenance = outcome.calibration.provenance.model_copy(update={"created": now()})
    calibration = outcome.calibration.model_copy(update={"provenance": provenance})
    return replace(outcome, calibration=calibration)


def write_results(outcome: Outcome, out: Path, rows: Sequence[TruthRow]) -> None:
    """The report is written under another name until calibration.json is in its place."""
    refinement = outcome.refinement
    scaled = refinement.estimate.scaled(outcome.unit)
    report = out / ".report.html"
    try:
        write_report(outcome.calibration, refinement.problem, scaled, report, rows)
        save_calibration(outcome.calibration, out / "calibration.json")
        os.replace(report, out / "report.html")
    finally:
        report.unlink(missing_ok=True)


def told(arguments: Sequence[str]) -> str:
    """The command line, for the result to tell."""
    return shlex.join(["sfm-calib", *arguments]).encode(errors="backslashreplace").decode()

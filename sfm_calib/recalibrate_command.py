"""`sfm-calib recalibrate`: its arguments, and what it writes and prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from sfm_calib.cache import Cache
from sfm_calib.colmap import quiet
from sfm_calib.comparison import check_same_cameras, compare_in_both
from sfm_calib.config import Options, RigConfig
from sfm_calib.drift import EXIT_STATUS, DriftOptions
from sfm_calib.drift_terminal import print_drift
from sfm_calib.files import refuse_overwrite
from sfm_calib.formats import read_calibration
from sfm_calib.formats.convert import FormatName
from sfm_calib.images import camera_names
from sfm_calib.output import check_apart, finish, output_folder, told
from sfm_calib.recalibrate import RecalibrateOptions, recalibrate
from sfm_calib.result import load_calibration
from sfm_calib.terminal import progress_bars, result_console


@dataclass(frozen=True)
class Recalibrate:
    """Say whether an old calibration still holds by an ordinary scan, and calibrate the rig anew.

    The verdict is keep, replace or inconclusive; OUT/calibration.json is the new calibration
    whichever it is, OUT/report.html shows both, OUT/cache is for the next run. OLD stays as it is.
    """

    old: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OLD")]
    """The rig's calibration so far, in any format that `convert` reads: a file or a folder."""
    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Folder with a sub-folder of images per camera, or of one camera's images, or a video."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
    """Folder for the results."""
    recalibration: Annotated[RecalibrateOptions, tyro.conf.arg(name="")] = field(
        default_factory=RecalibrateOptions
    )
    drift: Annotated[DriftOptions, tyro.conf.arg(name="")] = field(default_factory=DriftOptions)
    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    exit_code: bool = False
    """Exit with the verdict: 0 keep, 3 replace, 4 inconclusive (2 is bad input)."""
    truth: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A truth.json to compare with, as `simulate` writes it."""
    export: Annotated[tuple[FormatName, ...], tyro.conf.arg(metavar="FORMAT")] = ()
    """Formats of other programs to write into OUT/exports as well, as `convert` does."""
    overwrite: bool = False
    """Let OUT replace OLD, where they are in one place."""
    fresh: bool = False
    """Ignore what earlier runs left in OUT/cache."""
    json: bool = False
    """Print calibration.json on stdout instead of the tables."""
    verbose: Annotated[bool, tyro.conf.arg(aliases=("-v",))] = False
    """Show COLMAP's own log."""


def run_recalibrate(command: Recalibrate, config: RigConfig, arguments: Sequence[str]) -> int:
    """Recalibrate, write and print; the exit code.

    Raises CalibrationError as `recalibrate`, and where OUT would replace OLD.
    """
    check_apart(command.scan, command.out)
    refuse_overwrite(command.old, command.out, command.overwrite)
    old = read_calibration(command.old)
    truth = load_calibration(command.truth) if command.truth else None
    if truth:
        own = camera_names(command.scan)
        check_same_cameras([*own, *(n for n in truth.cameras if n in old.names)], truth)
    quiet(command.verbose)
    with output_folder(command.out):
        with progress_bars() as progress:
            cache = Cache(command.out / "cache", command.fresh)
            done = recalibrate(
                old, command.scan, config, command.recalibration, command.drift, cache, progress,
                told(arguments),
            )  # fmt: skip
        if not command.json:
            print_drift(done.drift, result_console())
        rows = compare_in_both(done.outcome.calibration, truth) if truth else []
        finish(done.outcome, command.out, rows, command.json, command.export)
    return EXIT_STATUS[done.drift.verdict] if command.exit_code else 0

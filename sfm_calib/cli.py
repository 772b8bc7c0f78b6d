"""The command line: `sfm-calib calibrate`, `simulate`, `simulate-tracks`, `demo`."""

from __future__ import annotations

import os
import shlex
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from pydantic import ValidationError
from rich.console import Console

import sfm_calib
from sfm_calib.cache import Cache
from sfm_calib.calibrate import Outcome, calibrate
from sfm_calib.colmap import quiet
from sfm_calib.comparison import compare_with_truth
from sfm_calib.config import RIG_FILE, Options, RigConfig, first_problem, load_rig_config
from sfm_calib.errors import CalibrationError
from sfm_calib.report import TruthRow, write_report
from sfm_calib.result import load_calibration, save_calibration
from sfm_calib.simulate.scan import SimulateOptions, simulate_scan
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks, write_tracks
from sfm_calib.terminal import print_comparison, print_result, progress_bars

Out = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
Verbose = Annotated[bool, tyro.conf.arg(aliases=("-v",))]
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # as a shell says it of Ctrl-C


@dataclass(frozen=True)
class Calibrate:
    """Calibrate the cameras of a scan, and the rig they sit on.

    Writes OUT/calibration.json and OUT/report.html; OUT/cache holds features, matches and the
    reconstruction for the next run.
    """

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Folder with a sub-folder of images per camera, or of one camera's images, or a video."""
    out: Out
    """Folder for the results."""
    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    truth: Path | None = None
    """A truth.json to compare with, as `simulate` writes it."""
    fresh: bool = False
    """Ignore what earlier runs left in OUT/cache."""
    json: bool = False
    """Print calibration.json on stdout instead of the table."""
    verbose: Verbose = False
    """Show COLMAP's own log."""


@dataclass(frozen=True)
class Simulate:
    """Render a scan of a textured room with known truth: OUT/scan and OUT/truth.json."""

    out: Out
    """Folder for the scan and its truth."""
    options: Annotated[SimulateOptions, tyro.conf.arg(name="")] = field(
        default_factory=SimulateOptions
    )
    overwrite: bool = False
    """Replace an earlier simulation in OUT."""


@dataclass(frozen=True)
class SimulateTracks:
    """Simulate feature tracks with known truth: OUT/tracks.npz and OUT/truth.json."""

    out: Out
    """Folder for the tracks and their truth."""
    options: Annotated[TrackOptions, tyro.conf.arg(name="")] = field(default_factory=TrackOptions)
    seed: int = 0
    """Seed of points, trajectory, noise and outliers."""


@dataclass(frozen=True)
class Demo:
    """Simulate a three-camera scan, calibrate it, and hold the result against the truth."""

    out: Out = Path("out/demo")
    """Folder for scan, truth.json, calibration.json and report.html."""
    seed: int = 0
    """Seed of the room, the trajectory, the noise and the solver."""
    verbose: Verbose = False
    """Show COLMAP's own log."""


Command = Calibrate | Simulate | SimulateTracks | Demo


def parse(argv: Sequence[str], options: Options | None = None) -> Command:
    """The command line as a command; `options` are the defaults that a rig.yaml gives."""
    default = Calibrate(tyro.MISSING, tyro.MISSING, options or Options())
    calibrate_type = Annotated[Calibrate, tyro.conf.subcommand("calibrate", default=default)]
    commands: Any = (
        calibrate_type
        | Annotated[Simulate, tyro.conf.subcommand("simulate")]
        | Annotated[SimulateTracks, tyro.conf.subcommand("simulate-tracks")]
        | Annotated[Demo, tyro.conf.subcommand("demo")]
    )
    return tyro.cli(  # type: ignore[no-any-return]
        commands,
        prog="sfm-calib",
        args=list(argv),
        description=f"{sfm_calib.__doc__} Version {sfm_calib.__version__}.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Exit codes: 0 done, 2 bad input, 130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    try:
        run(parse(arguments), arguments)
    except CalibrationError as error:
        print(f"sfm-calib: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except ValidationError as error:
        print(f"sfm-calib: {first_problem(error)}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as error:
        print(f"sfm-calib: {error.filename or ''} {error.strerror or error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("sfm-calib: interrupted; finished stages are kept for the next run", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def run(command: Command, arguments: Sequence[str]) -> None:
    """Do what a parsed command asks for."""
    if isinstance(command, Calibrate):
        run_calibrate(command, arguments)
    elif isinstance(command, Simulate):
        with progress_bars() as progress:
            simulate_scan(command.options, command.out, progress, command.overwrite)
        print(f"{command.out / 'scan'} and {command.out / 'truth.json'} written")
    elif isinstance(command, SimulateTracks):
        problem, truth = simulate_tracks(command.options, np.random.default_rng(command.seed))
        write_tracks(problem, truth, command.out)
        print(f"{len(problem.observations)} observations written to {command.out}")
    else:
        run_demo(command)


def run_calibrate(command: Calibrate, arguments: Sequence[str]) -> None:
    """Calibrate a scan; flags go before rig.yaml, and rig.yaml before the defaults."""
    from_file = load_rig_config(rig_file(command.scan))
    again = parse(arguments, from_file.options())
    assert isinstance(again, Calibrate)
    config = from_file.with_options(again.options)
    truth = load_calibration(command.truth) if command.truth else None
    outcome = calibrate_into(
        command.out, command.scan, config, command.fresh, command.verbose, arguments
    )
    rows = compare_with_truth(outcome.calibration, truth) if truth else []
    finish(outcome, command.out, rows, command.json)


def rig_file(scan: Path) -> Path:
    """Where rig.yaml of a scan is: in its folder, or beside a video."""
    return (scan.parent if scan.is_file() else scan) / RIG_FILE


def calibrate_into(
    out: Path,
    scan: Path,
    config: RigConfig,
    fresh: bool,
    verbose: bool,
    arguments: Sequence[str],
) -> Outcome:
    """Calibrate with the cache in OUT/cache, under progress bars."""
    check_writable(out)
    quiet(verbose)
    command = shlex.join(["sfm-calib", *arguments])
    with progress_bars() as progress:
        return calibrate(scan, config, Cache(out / "cache", fresh), progress, command)


def check_writable(out: Path) -> None:
    """Raises CalibrationError now rather than after the work when OUT cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise CalibrationError(
            f"cannot write to {out}: {error.strerror}; choose another output folder with -o"
        ) from error


def finish(outcome: Outcome, out: Path, rows: Sequence[TruthRow], as_json: bool) -> None:
    """Write calibration.json and report.html, and print the result."""
    refinement, calibration = outcome.refinement, outcome.calibration
    scaled = refinement.estimate.scaled(outcome.unit)
    save_calibration(calibration, out / "calibration.json")
    write_report(calibration, refinement.problem, scaled, out / "report.html", rows)
    if as_json:
        print(calibration.model_dump_json(indent=1))
        return
    console = Console(width=None if sys.stdout.isatty() else 120)
    print_result(calibration, console)
    if rows:
        print_comparison(rows, console)
    console.print(f"{out / 'calibration.json'} and {out / 'report.html'} written", soft_wrap=True)


def run_demo(command: Demo) -> None:
    """The main job on a scan whose truth is known."""
    check_writable(command.out)
    options = SimulateOptions(lens="radtan", seed=command.seed)
    with progress_bars() as progress:
        truth = simulate_scan(options, command.out, progress, overwrite=True)
    scan = command.out / "scan"
    config = load_rig_config(scan / RIG_FILE).model_copy(update={"seed": command.seed})
    arguments = ["demo", "-o", os.fspath(command.out), "--seed", str(command.seed)]
    outcome = calibrate_into(command.out, scan, config, False, command.verbose, arguments)
    finish(outcome, command.out, compare_with_truth(outcome.calibration, truth), False)


if __name__ == "__main__":
    sys.exit(main())

"""The command line of `sfm-calib`: which command was given, and what it does."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import tyro
from pydantic import ValidationError

import sfm_calib
from sfm_calib.__main__ import EXIT_INTERRUPTED
from sfm_calib.anchors import calibrate_with_board
from sfm_calib.boards.load import load_board
from sfm_calib.boards.page import write_board
from sfm_calib.boards.spec import Board
from sfm_calib.cache import Cache
from sfm_calib.calibrate import Outcome, calibrate
from sfm_calib.check import check_scan
from sfm_calib.check_terminal import print_check
from sfm_calib.colmap import quiet
from sfm_calib.commands import (
    BoardCommand,
    Calibrate,
    Check,
    Command,
    Demo,
    Simulate,
    SimulateTracks,
    Target,
)
from sfm_calib.compare_command import Compare, run_compare
from sfm_calib.comparison import check_same_cameras, compare_with_truth
from sfm_calib.config import RIG_FILE, RigConfig, first_problem, load_rig_config
from sfm_calib.convert_command import Convert, run_convert
from sfm_calib.depth.distance_command import SurfaceDistance, run_surface_distance
from sfm_calib.depth.fuse_command import Fuse, run_fuse
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically
from sfm_calib.history_command import HistoryCommand, run_history
from sfm_calib.images import camera_names, check_exists
from sfm_calib.output import check_apart, finish, output_folder, told
from sfm_calib.recalibrate_command import Recalibrate, run_recalibrate
from sfm_calib.result import load_calibration
from sfm_calib.simulate.scan import SimulateOptions, simulate_scan
from sfm_calib.simulate.tracks import simulate_tracks, write_tracks
from sfm_calib.target import calibrate_target
from sfm_calib.terminal import progress_bars, result_console
from sfm_calib.undistort_command import Rectify, Undistort, run_rectify, run_undistort

EXIT_BAD_INPUT = 2
# Packages above this one, such as experiments, bring commands of their own under this name: frozen
# dataclasses with run(arguments) -> exit code.
ENTRY_POINTS = "sfm_calib.commands"
DEMO_FRAMES = 24
DEMO_FEATURES = 1500  # the room has 4000 an image: four times the matching, the same result


def parse(argv: Sequence[str], config: RigConfig | None = None) -> Command:
    """The command line as a command; a rig.yaml's `config` gives the defaults."""
    config = config or RigConfig()
    default = Calibrate(tyro.MISSING, tyro.MISSING, config.options())
    calibrate_type = Annotated[Calibrate, tyro.conf.subcommand("calibrate", default=default)]
    target_default = Target(tyro.MISSING, tyro.MISSING, tyro.MISSING, config.target_options())
    recalibrate_default = Recalibrate(
        tyro.MISSING, tyro.MISSING, tyro.MISSING, options=config.options()
    )
    check_default = Check(tyro.MISSING, None, config.options())
    commands: Any = (
        calibrate_type
        | Annotated[Recalibrate, tyro.conf.subcommand("recalibrate", default=recalibrate_default)]
        | Annotated[Target, tyro.conf.subcommand("target", default=target_default)]
        | Annotated[BoardCommand, tyro.conf.subcommand("board")]
        | Annotated[Compare, tyro.conf.subcommand("compare")]
        | Annotated[Convert, tyro.conf.subcommand("convert")]
        | Annotated[HistoryCommand, tyro.conf.subcommand("history")]
        | Annotated[Check, tyro.conf.subcommand("check", default=check_default)]
        | Annotated[Undistort, tyro.conf.subcommand("undistort")]
        | Annotated[Rectify, tyro.conf.subcommand("rectify")]
        | Annotated[Fuse, tyro.conf.subcommand("fuse")]
        | Annotated[SurfaceDistance, tyro.conf.subcommand("surface-distance")]
        | Annotated[Simulate, tyro.conf.subcommand("simulate")]
        | Annotated[SimulateTracks, tyro.conf.subcommand("simulate-tracks")]
        | Annotated[Demo, tyro.conf.subcommand("demo")]
    )
    for name, brought in brought_commands().items():
        commands = commands | Annotated[brought, tyro.conf.subcommand(name)]
    command: Command = tyro.cli(
        commands,
        prog="sfm-calib",
        args=list(argv),
        description=f"{sfm_calib.__doc__} Version {sfm_calib.__version__}; --version prints it.",
        config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    return command


@cache
def brought_commands() -> dict[str, Any]:
    """Commands of packages above this one, by name."""
    return {point.name: point.load() for point in entry_points(group=ENTRY_POINTS)}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command. Exit codes: 0 done, 2 bad input, 130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments == ["--version"]:
        print(f"sfm-calib {sfm_calib.__version__}")
        return 0
    quiet_decoders()
    end_as_interrupted()
    try:
        return run(parse(arguments), arguments)
    except CalibrationError as error:
        print(f"sfm-calib: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except ValidationError as error:
        print(f"sfm-calib: {first_problem(error, flag)}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except BrokenPipeError:  # `| head` has read enough, and the results are written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        print(f"sfm-calib: {place}{error.strerror or error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        print("sfm-calib: interrupted; finished stages are kept for the next run", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def flag(option: str) -> str:
    """How an option is called on the command line."""
    return f"--{option.replace('_', '-')}"


def end_as_interrupted() -> None:
    """SIGTERM (`kill`, `timeout`, a service that stops) ends us as Ctrl-C does: by itself, glog,
    which pycolmap loads, would print a C++ stack trace."""
    if threading.current_thread() is threading.main_thread():  # no other may set handlers
        signal.signal(signal.SIGTERM, signal.default_int_handler)


def quiet_decoders() -> None:
    """What OpenCV says of damaged files is said better by our own message."""
    cv2.utils.logging.setLogLevel(0)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def run(command: Command, arguments: Sequence[str]) -> int:
    """Do what a parsed command asks for; the exit code."""
    if isinstance(command, tuple(brought_commands().values())):
        brought: Any = command
        return int(brought.run(arguments))
    if isinstance(command, Recalibrate):
        return run_recalibrate(command, config_of(command.scan, arguments), arguments)
    if isinstance(command, Calibrate):
        run_calibrate(command, arguments)
    elif isinstance(command, Target):
        run_target(command, arguments)
    elif isinstance(command, BoardCommand):
        run_board(command)
    elif isinstance(command, Compare):
        with output_folder(command.out) if command.out else nullcontext():
            run_compare(command)
    elif isinstance(command, Convert):
        run_convert(command)
    elif isinstance(command, HistoryCommand):
        with output_folder(command.out) if command.out else nullcontext():
            run_history(command)
    elif isinstance(command, Check):
        run_check(command, arguments)
    elif isinstance(command, Undistort):
        with output_folder(command.out):
            run_undistort(command, told(arguments))
    elif isinstance(command, Rectify):
        with output_folder(command.out):
            run_rectify(command, told(arguments))
    elif isinstance(command, Fuse):
        with output_folder(command.out):
            run_fuse(command, told(arguments))
    elif isinstance(command, SurfaceDistance):
        run_surface_distance(command, arguments)
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
    return 0


def run_calibrate(command: Calibrate, arguments: Sequence[str]) -> None:
    """Calibrate a scan, and compare with the truth where it is given."""
    check_apart(command.scan, command.out)
    config = config_of(command.scan, arguments)
    if command.board_images and not command.board:
        raise CalibrationError("--board-images needs --board YAML: say what board they show")
    board = load_board(command.board) if command.board else None
    truth = load_calibration(command.truth) if command.truth else None
    if truth:
        check_same_cameras(camera_names(command.scan), truth)  # now rather than after the work
    with output_folder(command.out):
        outcome = calibrate_into(
            command.out, command.scan, config, command.fresh, command.verbose, arguments,
            board, command.board_images,
        )  # fmt: skip
        rows = compare_with_truth(outcome.calibration, truth) if truth else []
        finish(outcome, command.out, rows, command.json, command.export)


def run_target(command: Target, arguments: Sequence[str]) -> None:
    """Calibrate from a board, and compare with the truth where it is given."""
    board = load_board(command.board)
    from_file = load_rig_config(rig_file(command.images))
    again = parse(arguments, from_file)
    assert isinstance(again, Target)
    config = from_file.with_options(again.options)
    truth = load_calibration(command.truth) if command.truth else None
    if truth:
        check_same_cameras(camera_names(command.images), truth)  # now rather than after the work
    with output_folder(command.out):
        with progress_bars() as progress:
            cache = Cache(command.out / "cache", command.fresh)
            outcome = calibrate_target(
                command.images, board, again.options, config, cache, progress, told(arguments)
            )
        rows = compare_with_truth(outcome.calibration, truth) if truth else []
        finish(outcome, command.out, rows, command.json, command.export)


def run_board(command: BoardCommand) -> None:
    """Write a board's page and its YAML."""
    command.options.described_board()  # what is wrong with it, before what is in the way
    description = command.out.with_suffix(".yaml")
    taken = [path for path in (command.out, description) if path.exists()]
    if taken and not command.overwrite:
        raise CalibrationError(f"{taken[0]} is there already: choose another name, or --overwrite")
    with output_folder(command.out.parent):
        page, description = write_board(command.options, command.out)
    print(f"{page} and {description} written; print at 100 % and check the rulers")


def run_check(command: Check, arguments: Sequence[str]) -> None:
    """Check a scan, in a cache that is kept where -o says so."""
    config = config_of(command.scan, arguments)
    quiet(command.verbose)
    with check_folder(command.out) as place:
        with progress_bars() as progress:
            cache = Cache(place / "cache", command.fresh)
            check = check_scan(command.scan, config, cache, progress)
        text = check.model_dump_json(indent=1)
        if command.out:
            write_atomically(place / "check.json", text)
    if command.json:
        print(text)
        return
    console = result_console()
    print_check(check, console)
    if command.out:
        console.print(f"{command.out / 'check.json'} written", soft_wrap=True)


@contextmanager
def check_folder(out: Path | None) -> Iterator[Path]:
    """OUT as `output_folder`, or a temporary folder, gone afterwards."""
    if out:
        with output_folder(out):
            yield out
    else:
        with tempfile.TemporaryDirectory(prefix="sfm_calib.") as temporary:
            yield Path(temporary)


def config_of(scan: Path, arguments: Sequence[str]) -> RigConfig:
    """What is asked of a scan: flags go before rig.yaml, and rig.yaml before the defaults."""
    check_exists(scan)
    from_file = load_rig_config(rig_file(scan))
    again = parse(arguments, from_file)
    assert isinstance(again, Calibrate | Check | Recalibrate)
    return from_file.with_options(again.options)


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
    board: Board | None = None,
    board_images: Path | None = None,
) -> Outcome:
    """Calibrate with the cache in OUT/cache, under progress bars."""
    quiet(verbose)
    with progress_bars() as progress:
        cache, line = Cache(out / "cache", fresh), told(arguments)
        if board is None:
            return calibrate(scan, config, cache, progress, line)
        return calibrate_with_board(scan, board, board_images, config, cache, progress, line)


def run_demo(command: Demo) -> None:
    """The main job on a scan whose truth is known."""
    out = command.out
    if (out / "scan").exists() and not (out / "truth.json").exists():
        raise CalibrationError(
            f"{out / 'scan'} is no simulation, and the demo would replace it: choose another "
            "output folder with -o"
        )
    options = SimulateOptions(lens="radtan", frames=DEMO_FRAMES, seed=command.seed)
    with output_folder(out):
        with progress_bars() as progress:
            truth = simulate_scan(options, out, progress, overwrite=True)
        scan = out / "scan"
        config = load_rig_config(scan / RIG_FILE).model_copy(
            update={"seed": command.seed, "max_features": DEMO_FEATURES}
        )
        arguments = ["demo", "-o", os.fspath(out), "--seed", str(command.seed)]
        outcome = calibrate_into(out, scan, config, False, command.verbose, arguments)
        finish(outcome, out, compare_with_truth(outcome.calibration, truth), False)


if __name__ == "__main__":
    sys.exit(main())

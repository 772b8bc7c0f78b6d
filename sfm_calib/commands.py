"""The arguments of each command of `sfm-calib`, as its --help tells them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from sfm_calib.boards.page import BoardPrint
from sfm_calib.compare_command import Compare
from sfm_calib.config import Options, TargetOptions
from sfm_calib.convert_command import Convert
from sfm_calib.depth.distance_command import SurfaceDistance
from sfm_calib.depth.fuse_command import Fuse
from sfm_calib.formats.convert import FormatName
from sfm_calib.history_command import HistoryCommand
from sfm_calib.recalibrate_command import Recalibrate
from sfm_calib.simulate.scan import SimulateOptions
from sfm_calib.simulate.tracks import TrackOptions
from sfm_calib.undistort_command import Rectify, Undistort

Out = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
Verbose = Annotated[bool, tyro.conf.arg(aliases=("-v",))]


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
    board: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None
    """A board to look for, in the scan and in --board-images: it gives metres, and pins what the
    scan leaves open."""
    board_images: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Images of the board by the same cameras, in folders as the scan's."""
    truth: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A truth.json to compare with, as `simulate` writes it."""
    export: Annotated[tuple[FormatName, ...], tyro.conf.arg(metavar="FORMAT")] = ()
    """Formats of other programs to write into OUT/exports as well, as `convert` does."""
    fresh: bool = False
    """Ignore what earlier runs left in OUT/cache."""
    json: bool = False
    """Print calibration.json on stdout instead of the table."""
    verbose: Verbose = False
    """Show COLMAP's own log."""


@dataclass(frozen=True)
class Target:
    """Calibrate cameras, and the rig they sit on, from images or videos of a board.

    Writes OUT/calibration.json and OUT/report.html, as `calibrate` does.
    """

    images: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES")]
    """Folder with a sub-folder of images per camera, of one camera's images, or of videos."""
    board: Annotated[Path, tyro.conf.arg(metavar="YAML")]
    """The board: our YAML, as `sfm-calib board` writes it, or Kalibr's."""
    out: Out
    """Folder for the results."""
    options: Annotated[TargetOptions, tyro.conf.arg(name="")] = field(default_factory=TargetOptions)
    truth: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A truth.json to compare with."""
    export: Annotated[tuple[FormatName, ...], tyro.conf.arg(metavar="FORMAT")] = ()
    """Formats of other programs to write into OUT/exports as well, as `convert` does."""
    fresh: bool = False
    """Ignore what earlier runs left in OUT/cache."""
    json: bool = False
    """Print calibration.json on stdout instead of the table."""


@dataclass(frozen=True)
class Check:
    """Say whether a scan can calibrate its rig, and what to add, before the full solve.

    Takes as long as features, matches and mapping do. With -o, OUT/cache keeps these for
    `calibrate -o OUT`, and OUT/check.json the numbers. The exit code is 0 whatever is found.
    """

    scan: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
    """Folder with a sub-folder of images per camera, or of one camera's images, or a video."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None
    """Folder for cache and check.json; default: nothing is kept."""
    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    fresh: bool = False
    """Ignore what earlier runs left in OUT/cache."""
    json: bool = False
    """Print check.json on stdout instead of the table."""
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


@dataclass(frozen=True)
class BoardCommand:
    """Print a board true to scale: FILE.pdf, with rulers to check it by, and FILE.yaml.

    Give the YAML to `target --board` and `calibrate --board`. Measure the printed board, and
    correct the YAML where it is off.
    """

    out: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="FILE.pdf")]
    """Where to write the page; the board's YAML goes beside it."""
    options: Annotated[BoardPrint, tyro.conf.arg(name="")] = field(default_factory=BoardPrint)
    overwrite: bool = False
    """Replace files that are there."""


Command = (
    Calibrate | Recalibrate | Target | Compare | HistoryCommand | Convert | BoardCommand | Check
    | Undistort | Rectify | Fuse | SurfaceDistance | Simulate | SimulateTracks | Demo
)  # fmt: skip

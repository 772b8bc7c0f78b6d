"""`sfm-calib undistort` and `sfm-calib rectify`: their arguments, and what they print."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from graphs.virtual import field_of_view
from sfm_calib.formats import read_calibration
from sfm_calib.rectify import Rectified, rectify
from sfm_calib.row_check import RowCheck
from sfm_calib.terminal import print_line, progress_bars, result_console, table_of
from sfm_calib.undistort import Remade, undistort
from sfm_calib.views import ViewOptions

RANGES_M = (1.0, 2.0, 5.0, 10.0)
RANGES_IN_BASELINES = (5.0, 10.0, 20.0, 50.0, 100.0)
# Of real pairs, calibrated well: medians of 0.00 to 0.2 px, robust sigmas of 0.3 to 0.6.
MOST_MEDIAN_PX, MOST_SIGMA_PX = 0.5, 1.0
MOST_NEGATIVE = 0.5  # of the matches: by chance, or by mismatches, far fewer

Calibration = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CALIBRATION")]
Input = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
Out = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]


@dataclass(frozen=True)
class Undistort:
    """Make images or videos free of distortion, with any calibration.

    Writes them into OUT under their own names, and OUT/calibration.json: the pinholes that would
    have taken them, in the places that the cameras have on the rig.
    """

    calibration: Calibration
    """A calibration of any format that `compare` reads."""
    input: Input
    """An image, a video, a folder of either, or a folder with a sub-folder per camera."""
    out: Out
    """Folder for the new images."""
    camera: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The calibration's camera that took everything; default: the only one, or by folder name."""
    options: Annotated[ViewOptions, tyro.conf.arg(name="")] = field(default_factory=ViewOptions)
    overwrite: bool = False
    """Replace files that are there."""


@dataclass(frozen=True)
class Rectify:
    """Make the images of two cameras a rectified pair: a point lies in one row of both.

    Which is left is found out. Writes the images into OUT, OUT/calibration.json of the new pair,
    and OUT/rectification.yml with R1, R2, P1, P2, Q as OpenCV has them. Cameras that sit one above
    the other become a vertical pair, with columns for rows.
    """

    calibration: Calibration
    """A calibration of any format that `compare` reads, with the places of both cameras."""
    input: Input
    """A folder with a sub-folder of images, or a video, per camera."""
    out: Out
    """Folder for the new images."""
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="LEFT RIGHT")] = ()
    """Two cameras, as CAMERA or CAMERA=FOLDER; default: those of both names, or by order."""
    options: Annotated[ViewOptions, tyro.conf.arg(name="")] = field(default_factory=ViewOptions)
    no_check: bool = False
    """Do not match features of ten pairs to see whether rows agree."""
    overwrite: bool = False
    """Replace files that are there."""


def run_undistort(command: Undistort, told: str) -> None:
    """Write and print; OUT has to be there (`output.output_folder`)."""
    rig = read_calibration(command.calibration)
    with progress_bars() as progress:
        done = undistort(
            rig, command.input, command.out, command.options, command.camera, command.overwrite,
            progress, told,
        )  # fmt: skip
    console = result_console()
    for remade in done.remade:
        print_line(console, line_of(remade))
    for note in done.notes:
        print_line(console, f"note: {note}")
    written = ", ".join(str(path) for path in done.written)
    console.print(f"{written} written", soft_wrap=True)


def line_of(remade: Remade) -> str:
    """One camera: how many files, from what to what, and what is seen."""
    kind = "video" if remade.source.is_video else "image"
    count = len(remade.source.paths)
    virtual = remade.virtual
    across, down = np.degrees(field_of_view(virtual))
    fx, fy, cx, cy = virtual.params
    black = f", {remade.black:.1%} black" if remade.black > 0 else ""
    return (
        f"{virtual.name}: {count} {kind}{'s' * (count != 1)}, {remade.camera.lens} "
        f"{remade.camera.size[0]} x {remade.camera.size[1]} px to pinhole {virtual.size[0]} x "
        f"{virtual.size[1]} px, f {fx:.2f} {fy:.2f}, c {cx:.2f} {cy:.2f}, {across:.1f} x "
        f"{down:.1f} degrees; shows {remade.shown:.1%} of the original{black}"
    )


def run_rectify(command: Rectify, told: str) -> None:
    """Write and print; OUT has to be there (`output.output_folder`)."""
    rig = read_calibration(command.calibration)
    with progress_bars() as progress:
        done = rectify(
            rig, command.input, command.out, command.options, command.cameras,
            not command.no_check, command.overwrite, progress, told,
        )  # fmt: skip
    console = result_console()
    vertical = done.geometry.is_vertical
    for place, remade in zip(("upper", "lower") if vertical else ("left", "right"), done.pair,
                             strict=True):  # fmt: skip
        print_line(console, f"{place} camera {line_of(remade)}")
    unit = {"m": " m", "baseline": " long"}.get(done.unit, " in the calibration's unit")
    print_line(
        console,
        f"baseline {done.geometry.baseline:.6g}{unit}; the axes were "
        f"{np.degrees(done.geometry.angle_apart):.2f} degrees apart",
    )
    table = table_of("depth m" if done.unit == "m" else "depth in baselines", "disparity px")
    length = done.geometry.baseline if done.unit == "m" else 1.0
    for depth in RANGES_M if done.unit == "m" else RANGES_IN_BASELINES:
        table.add_row(f"{depth:g}", f"{done.virtual.params[0] * length / depth:.2f}")
    console.print(table)
    if done.rows:
        print_line(console, rows_line(done.rows, "columns" if vertical else "rows"))
    for note in notes_of(done):
        print_line(console, f"note: {note}")
    written = ", ".join(str(path) for path in done.written)
    console.print(f"{written} written", soft_wrap=True)


def rows_line(rows: RowCheck, called: str) -> str:
    """What matched features say."""
    if not rows.is_enough:
        return f"{called}: {rows.n_matches} features matched in {rows.n_pairs} pairs: too few"
    return (
        f"{called}: {rows.n_matches} features matched in {rows.n_pairs} pairs differ by "
        f"{rows.median_px:+.2f} px (median), sigma {rows.sigma_px:.2f} px"
    )


def notes_of(done: Rectified) -> list[str]:
    """What is to be said, and what matched features make doubtful."""
    notes = list(done.notes)
    rows = done.rows
    if not (rows and rows.is_enough):
        return notes
    if abs(rows.median_px) > MOST_MEDIAN_PX or rows.sigma_px > MOST_SIGMA_PX:
        notes.append(
            f"rows should agree to {MOST_MEDIAN_PX:g} px, with a sigma of {MOST_SIGMA_PX:g} px at "
            "most: is this the calibration of these cameras, and were the images of a pair taken "
            "at one moment?"
        )
    if rows.negative > MOST_NEGATIVE:
        notes.append(
            f"{rows.negative:.0%} of the matches lie behind the cameras: the images of both "
            "cameras are exchanged; say which is which with --cameras CAMERA=FOLDER"
        )
    return notes

"""`sfm-calib fuse`: its arguments, and what it prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from sfm_calib.depth.fuse_images import fuse_images
from sfm_calib.depth.fuse_options import FuseOptions
from sfm_calib.depth.fuse_record import FuseRecord
from sfm_calib.formats import read_calibration
from sfm_calib.terminal import print_line, progress_bars, result_console, table_of

NONE = "–"
PIPED_WIDTH = 100  # of the table of overlaps


@dataclass(frozen=True)
class Fuse:
    """Make one cloud of points of the depth images of several cameras, with any calibration.

    Each pixel goes through its whole lens model, distortion inverted, and into the rig's frame.
    Writes OUT/fused.ply, of several frames OUT/fused/FRAME.ply, with normals towards the cameras,
    and OUT/fuse.json: how far the cameras' parts are apart where they overlap, beside what the
    calibration's sigmas let expect.
    """

    calibration: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CALIBRATION")]
    """A calibration of any format that `compare` reads, with the places of the cameras."""
    depths: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEPTHS")]
    """A folder with a sub-folder of depth images per camera, files of one stem being one frame;
    or with one image a camera, called as it. 16-bit PNG, TIFF, PGM; npy, TIFF, EXR in metres."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
    """Folder for the clouds."""
    options: Annotated[FuseOptions, tyro.conf.arg(name="")] = field(default_factory=FuseOptions)
    json: bool = False
    """Print fuse.json on stdout instead of the tables."""
    overwrite: bool = False
    """Replace files that are there."""


def run_fuse(command: Fuse, told: str) -> None:
    """Write and print; OUT has to be there (`output.output_folder`)."""
    rig = read_calibration(command.calibration)
    with progress_bars() as progress:
        done = fuse_images(
            rig, command.depths, command.out, command.options, command.overwrite, progress, told
        )
    if command.json:
        print(done.record.model_dump_json(indent=1))
        return
    console = result_console(PIPED_WIDTH)
    print_fused(done.record, console)
    written = ", ".join(str(path) for path in done.written[:2])
    more = f" and {len(done.written) - 2} more" if len(done.written) > 2 else ""
    console.print(f"{written}{more} written", soft_wrap=True)


def print_fused(record: FuseRecord, console: Console) -> None:
    """Cameras, overlaps and registrations, over all frames; then what is to be said."""
    n_points = sum(frame.n_points for frame in record.frames)
    count = len(record.frames)
    where = f"the frame of {record.reference}" if record.reference else "the rig's own frame"
    print_line(console, f"{n_points} points in {count} frame{'s' * (count != 1)}, in {where}")
    _print_parts(record, console)
    _print_overlaps(record, console)
    for note in record.notes:
        print_line(console, f"note: {note}")


def _print_parts(record: FuseRecord, console: Console) -> None:
    table = table_of("", "measured", "points", "median depth m", "sigma mm")
    parts = [part for frame in record.frames for part in frame.parts]
    for camera in dict.fromkeys(part.camera for part in parts):
        own = [part for part in parts if part.camera == camera]
        table.add_row(
            camera,
            str(sum(part.n_measured for part in own)),
            str(sum(part.n_points for part in own)),
            _middle([part.median_depth_m for part in own], 1.0),
            _middle([part.sigma_m for part in own]),
        )
    console.print(table)
    if any(part.sigma_m is not None for part in parts):
        print_line(
            console, "sigma of a point, by the calibration alone (rms): the depth is its own"
        )


def _print_overlaps(record: FuseRecord, console: Console) -> None:
    """Medians over the frames."""
    frames = record.frames
    rows = {one.cameras for frame in frames for one in frame.overlaps}
    if not rows:
        return
    limit = f"within {1e3 * record.within_m:g} mm"
    print_line(console, f"overlaps ({limit}): the same surface by two cameras, across it")
    table = table_of(
        "", "points", "share", "median mm", "rms mm", "offset mm", "sigma mm",
        *(("after ICP",) if record.registration != "none" else ()),
    )  # fmt: skip
    for pair in sorted(rows):
        own = [one for frame in frames for one in frame.overlaps if one.cameras == pair]
        after = [one for frame in frames for one in frame.overlaps_registered
                 if one.cameras == pair]  # fmt: skip
        table.add_row(
            " and ".join(pair),
            str(sum(one.n_points for one in own)),
            f"{np.median([one.share for one in own]):.0%}",
            _middle([one.median_m for one in own]),
            _middle([one.rms_m for one in own]),
            _middle([one.offset_m for one in own]),
            _middle([one.sigma_m for one in own]),
            *((_middle([one.rms_m for one in after]),) if after else ()),
        )
    console.print(table)
    if all(one.rms_m is None for frame in frames for one in frame.overlaps):
        print_line(console, "note: no two cameras see one surface: nothing tells how well they fit")


def _middle(values: Sequence[float | None], unit: float = 1e3) -> str:
    """Median of those that there are."""
    known = [value for value in values if value is not None]
    return f"{unit * float(np.median(known)):.3f}" if known else NONE

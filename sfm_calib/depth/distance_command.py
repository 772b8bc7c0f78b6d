"""`sfm-calib surface-distance`: its arguments, and what it writes and prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from pydantic import Field

import sfm_calib
from graphs.frames import Transform
from sfm_calib.depth.surface import Surface, load_surface, painted
from sfm_calib.depth.surface_distance import (
    Distances,
    DistanceSummary,
    align_icp,
    summary,
    surface_distance,
)
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256, write_atomically
from sfm_calib.output import output_folder, told
from sfm_calib.provenance import Provenance, now
from sfm_calib.record import Record
from sfm_calib.report.distance import colours_of, write_distance_page
from sfm_calib.terminal import print_line, progress_bars, result_console, table_of

SAMPLES = 100_000  # on a mesh, besides its vertices: 1.2 mm apart on a head
SEED = 0
PAINTED_FILE, RECORD_FILE, PAGE_FILE = "painted.ply", "distance.json", "distance.html"
# A scan of rooms has tens of metres; a model in mm that is taken for metres has hundreds.
MOST_LIKELY_M = 100.0
NAMES = {"a_to_b": "A to B", "b_to_a": "B to A"}

Place = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]


@dataclass(frozen=True)
class SurfaceDistance:
    """Measure how far a mesh or cloud of points A is from a reference B, and paint it on A.

    Mean, root mean square, median, 95 % and maximum of the distances from A to B and from B to A
    (the larger maximum is Hausdorff's distance). Writes OUT/distance.json, OUT/distance.html and
    OUT/painted.ply: A, laid on B, each point in the colour of its distance.
    """

    a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")]
    """What is measured: PLY, OBJ, STL, OFF, glTF, PCD, XYZ."""
    b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")]
    """The reference. Of a cloud the nearest point counts, which is farther than the surface."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]
    """Folder for the results."""
    align: Literal["none", "icp", "centroid"] = "none"
    """Lay A on B first: icp, from where it is; centroid: from where the middles of both meet."""
    max_correspondence: Annotated[float, Field(gt=0)] = 0.02
    """Points of A farther from B than this, in m, do not pull when it is laid on."""
    crop: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Leave out points farther than this, in m: what the other side does not have."""
    metres_per_unit: float = 1.0
    """Of the coordinates of A and B: 0.001 where they are millimetres."""
    paint_to: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Distance with the last colour, in m; default: that of 95 % of A's points."""


class Laid(Record):
    """How A was laid on B."""

    rotation_wxyz: tuple[float, ...]
    translation_m: tuple[float, ...]  # b_from_a
    matched: float
    rms_m: float
    converged: bool


class DistanceRecord(Record):
    """distance.json."""

    format: Literal["sfm_calib/distance/1"] = "sfm_calib/distance/1"
    a_to_b: DistanceSummary
    b_to_a: DistanceSummary
    hausdorff_m: float
    aligned: Laid | None  # None: A was taken as it lies
    left_out: dict[str, int]  # points beyond --crop, by direction
    painted_to_m: float
    notes: tuple[str, ...]
    provenance: Provenance


def run_surface_distance(command: SurfaceDistance, arguments: Sequence[str]) -> None:
    """Measure, write and print.

    Raises CalibrationError for files that are no surfaces, and for surfaces that are apart.
    """
    _check(command)
    with output_folder(command.out), progress_bars() as progress:
        progress("reading", 0, 0)
        a, b = (load_surface(path, command.metres_per_unit) for path in (command.a, command.b))
        progress("measuring", 0, 0)
        laid, a = _laid(a, b, command)
        (forth, left_forth), (back, left_back) = (
            _cropped(surface_distance(one.sampled(SAMPLES, SEED), other), command.crop)
            for one, other in ((a, b), (b, a))
        )
        on_a, on_b = (surface_distance(one.vertices, of).unsigned for one, of in ((a, b), (b, a)))
        a_to_b, b_to_a = summary(forth, on_a, command.crop), summary(back, on_b, command.crop)
        record = DistanceRecord(
            a_to_b=a_to_b, b_to_a=b_to_a, hausdorff_m=max(a_to_b.max_m, b_to_a.max_m),
            aligned=laid, left_out={"a_to_b": left_forth, "b_to_a": left_back},
            painted_to_m=command.paint_to or float(np.percentile(forth.unsigned, 95)),
            notes=tuple(_notes(a, b, command)), provenance=_provenance(command, arguments),
        )  # fmt: skip
        progress("writing", 0, 0)
        content = painted(a, colours_of(on_a, record.painted_to_m))
        write_atomically(command.out / PAINTED_FILE, content)
        write_distance_page(record, a, on_a, forth.unsigned, command.out / PAGE_FILE)
        write_atomically(command.out / RECORD_FILE, record.model_dump_json(indent=1) + "\n")
    _print(record, command.out)


def _check(command: SurfaceDistance) -> None:
    written = {(command.out / name).resolve() for name in (PAINTED_FILE, RECORD_FILE, PAGE_FILE)}
    for path in (command.a, command.b):
        if path.resolve() in written:
            raise CalibrationError(
                f"{path} would be overwritten by the result: choose another folder with -o"
            )
    for name in ("max_correspondence", "crop", "metres_per_unit", "paint_to"):
        value = getattr(command, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            option = name.replace("_", "-")
            raise CalibrationError(f"--{option} {value:g}: give a length above 0, in metres")


def _laid(a: Surface, b: Surface, command: SurfaceDistance) -> tuple[Laid | None, Surface]:
    if command.align == "none":
        return None, a
    points, start = a.sampled(SAMPLES // 4, SEED), Transform.identity()
    if command.align == "centroid":
        to = b.sampled(SAMPLES // 4, SEED).mean(axis=0)
        start = Transform(np.eye(3), to - points.mean(axis=0))
    found = align_icp(points, b, start, command.max_correspondence)
    laid = Laid(
        rotation_wxyz=tuple(found.transform.rotation_wxyz.tolist()),
        translation_m=tuple(found.transform.translation.tolist()),
        matched=found.matched, rms_m=found.rms_m, converged=found.converged,
    )  # fmt: skip
    return laid, a.moved(found.transform)


def _cropped(found: Distances, crop: float | None) -> tuple[Distances, int]:
    """Those within reach, and how many are not."""
    if crop is None:
        return found, 0
    near = found.unsigned <= crop
    if not near.any():
        raise CalibrationError(
            f"all {len(near)} points are farther than --crop {crop:g} m from the other surface, "
            f"the nearest {found.unsigned.min():.3g} m: crop less, or lay A on B (--align)"
        )
    signed = None if found.signed is None else found.signed[near]
    return Distances(found.unsigned[near], signed), int((~near).sum())


def _notes(a: Surface, b: Surface, command: SurfaceDistance) -> list[str]:
    notes = []
    for path, surface in ((command.a, a), (command.b, b)):
        size = float(np.ptp(surface.vertices, axis=0).max())
        if size > MOST_LIKELY_M:
            notes.append(
                f"{path.name} is {size:.0f} m large: if its unit is mm, say --metres-per-unit 0.001"
            )
        if not surface.is_mesh:
            notes.append(
                f"{path.name} is a cloud: distances to it are to its nearest point, farther than "
                "to the surface between its points"
            )
    return notes


def _provenance(command: SurfaceDistance, arguments: Sequence[str]) -> Provenance:
    return Provenance(
        version=sfm_calib.__version__,
        command=told(arguments),
        seed=SEED,
        input_hashes={str(path): sha256(path) for path in (command.a, command.b)},
        created=now(),
    )


def _print(record: DistanceRecord, out: Path) -> None:
    console = result_console()
    table = table_of("", "mean", "RMS", "median", "95 %", "max", "points")
    for key, name in NAMES.items():
        one: DistanceSummary = getattr(record, key)
        lengths = (one.mean_m, one.rms_m, one.median_m, one.p95_m, one.max_m)
        table.add_row(name, *(f"{1e3 * length:.3f}" for length in lengths), f"{one.points}")
    console.print(table)
    print_line(console, f"in mm; Hausdorff distance {1e3 * record.hausdorff_m:.3f} mm")
    if record.a_to_b.mean_signed_m is not None:
        print_line(console, f"A lies {1e3 * record.a_to_b.mean_signed_m:+.3f} mm outside of B")
    if record.aligned:
        state = "" if record.aligned.converged else "; it did not come to rest"
        print_line(
            console,
            f"laid on B: {100 * record.aligned.matched:.0f} % of the points match, "
            f"{1e3 * record.aligned.rms_m:.3f} mm rms along its normals{state}",
        )
    for key, count in record.left_out.items():
        if count:
            print_line(console, f"{NAMES[key]}: {count} points beyond --crop are left out")
    for note in record.notes:
        print_line(console, f"note: {note}")
    print_line(console, f"{out / PAGE_FILE}, {PAINTED_FILE}, {RECORD_FILE} written")

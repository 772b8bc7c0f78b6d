"""Ours beside OpenCV and mrcal, on the same corners: `python -m experiments.target_peers`.

For each data set: every parameter with the sigma that each program states, and how far it lies from
OpenCV's in OpenCV's sigmas; what each calibration predicts of views that it has not seen; how far
two halves of the views lie apart, and how far by the stated sigmas; and what the residuals hold
beside noise. mrcal is left out, with the reason, where it is not installed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from experiments.peers import mrcal, ours
from experiments.peers.calibrations import PeerCalibration
from experiments.peers.halves import Apart, apart, splits, z_scores
from experiments.peers.held_out import Calibrate, HeldOut, held_out
from experiments.peers.misfit import Misfit, misfits
from experiments.peers.opencv import calibrate_camera, calibrate_pair
from experiments.peers.ours import OurOptions
from experiments.peers.sightings import (
    DATA_SETS,
    DataSet,
    Detector,
    common,
    consistent,
    frames_of,
    of_camera,
    of_frames,
    sightings,
)
from graphs.lenses import LensName
from sfm_calib.boards.spec import Board
from sfm_calib.boards.views import BoardViews

REFERENCE = "OpenCV, refined"
# Beliefs for boards: bends of up to 2 % of half the board; lenses' p1, p2 reach 0.004.
BEND_SIGMA, TANGENTIAL_SIGMA = 0.02, 0.01
TABLE_WIDTH = 160


@dataclass(frozen=True)
class PeersOptions:
    """Target-based calibration: ours beside OpenCV and mrcal."""

    names: tyro.conf.Positional[tuple[str, ...]] = tuple(DATA_SETS)
    """Data sets."""
    data: Path = Path("../shared/data")
    """The folder that has them."""
    lens: LensName = "brown"
    """Lens of every camera."""
    detector: Detector = "ours"
    """Whose corners all of them get."""
    folds: int = 0
    """Folds of the frames to leave out; 0: one frame at a time."""
    random_halves: int = 6
    """Random splits into halves, beside every second frame."""


@dataclass(frozen=True)
class Row:
    """One program on one data set."""

    found: PeerCalibration
    held_out: HeldOut
    apart: list[list[Apart]]  # by split, then by camera; every second frame first
    z: list[list[float]]  # by split, then by parameter


def main(options: PeersOptions) -> dict[str, dict[str, Row]]:
    """Print the tables of every data set; the rows by data set and program.

    Raises KeyError for a data set that is not known, FileNotFoundError where it is not there.
    """
    console = Console(width=TABLE_WIDTH)
    rows: dict[str, dict[str, Row]] = {}
    for name in options.names:
        views, n_turned = numbered(options.data, DATA_SETS[name], options.lens, options.detector)
        board = DATA_SETS[name].board
        n_frames = len(frames_of(views))
        console.rule(f"{name}: {n_frames} frames, {len(views.views)} images, {n_turned} turned")
        programs, why_less = programs_of(board, options.lens)
        rows[name] = {
            program: measured(views, board, calibrate, options)
            for program, calibrate in programs.items()
        }
        console.print(parameter_table(rows[name]))
        console.print(quality_table(rows[name]))
        console.print(misfit_table(misfits(rows[name][REFERENCE].found, views, board.corners_m)))
        if why_less:
            console.print(f"without mrcal: {why_less}")
    return rows


def numbered(
    data: Path, data_set: DataSet, lens: LensName, detector: Detector = "ours"
) -> tuple[BoardViews, int]:
    """Views of the frames that all cameras see, numbered alike, and how many were turned."""
    views = sightings(data, data_set, detector)
    corners, n_cameras = data_set.board.corners_m, len(data_set.cameras)
    views = common(views)  # detected whole or not at all, however they are numbered
    alone = [calibrate_camera(of_camera(views, index), corners, lens) for index in range(n_cameras)]
    placed = [alone[view.camera].rig_from_board[view.frame] for view in views.views]
    return consistent(views, data_set.board, placed)


def programs_of(board: Board, lens: LensName) -> tuple[dict[str, Calibrate], str | None]:
    """Every program by its name, and why mrcal is not among them.

    All but OpenCV's own start from OpenCV's refined pair.
    """
    corners = board.corners_m

    def by_us(options: OurOptions, views: BoardViews) -> PeerCalibration:
        return ours.calibrate(views, corners, calibrate_pair(views, corners, lens, True), options)

    def by_mrcal(options: mrcal.MrcalOptions, views: BoardViews) -> PeerCalibration:
        return mrcal.calibrate(views, board, calibrate_pair(views, corners, lens, True), options)

    alike = OurOptions(like_opencv=True)
    usual = OurOptions(tangential_sigma=TANGENTIAL_SIGMA)
    programs: dict[str, Calibrate] = {
        "OpenCV": lambda views: calibrate_pair(views, corners, lens, refined=False),
        REFERENCE: lambda views: calibrate_pair(views, corners, lens, refined=True),
        "ours, alike": partial(by_us, alike),
        "ours, alike, bent": partial(by_us, replace(alike, bend_sigma=BEND_SIGMA)),
        "ours": partial(by_us, usual),
        "ours, bent": partial(by_us, replace(usual, bend_sigma=BEND_SIGMA)),
    }
    why_not = "it has no such lens" if lens not in mrcal.LENS_MODELS else mrcal.why_not()
    if why_not is None:
        quick = mrcal.MrcalOptions(uncertainty=False)
        flat = mrcal.MrcalOptions(bends=False, reject=False, regularise=False, uncertainty=False)
        programs["mrcal, alike"] = partial(by_mrcal, flat)
        programs["mrcal"] = partial(by_mrcal, quick)
    return programs, why_not


def measured(views: BoardViews, board: Board, calibrate: Calibrate, options: PeersOptions) -> Row:
    """All that is asked of one program."""
    frames = frames_of(views)
    pairs = [
        tuple(calibrate(of_frames(views, half)) for half in halves)
        for halves in splits(frames, options.random_halves)
    ]
    cameras = range(len(views.cameras))
    return Row(
        calibrate(views),
        held_out(views, board.corners_m, calibrate, options.folds or len(frames)),
        [[apart(a, b, camera) for camera in cameras] for a, b in pairs],
        [list(z_scores(a, b).values()) for a, b in pairs],
    )


def parameter_table(rows: Mapping[str, Row]) -> Table:
    """Each parameter with its sigma, and in brackets its distance from OpenCV's in its sigmas."""
    reference = rows[REFERENCE].found
    table = Table(title="value ± sigma (less OpenCV's, in its sigmas)", box=box.SIMPLE_HEAD)
    table.add_column("")
    for program in rows:
        table.add_column(program, justify="right")
    for name, value in reference.values.items():
        cells = []
        for row in rows.values():
            sigma = row.found.covariance.sigma.get(name)
            own, of_opencv = row.found.values[name], reference.covariance.sigma.get(name)
            cell = f"{own:.5g}" + ("" if sigma is None else f" ± {sigma:.2g}")
            if of_opencv and row.found is not reference:
                cell += f" ({(own - value) / of_opencv:+.2f})"
            cells.append(cell)
        table.add_row(name, *cells)
    return table


def quality_table(rows: Mapping[str, Row]) -> Table:
    """How well each program predicts, and whether its halves agree as its sigmas say."""
    table = Table(title="px; halves: projections far away", box=box.SIMPLE_HEAD)
    for column in (
        "", "rms", "left out", "held out\nrms", "median", "mean square less OpenCV's,\n1e-3 px²",
        "halves apart:\nevery second", "expected", "random", "expected", "rms z\nevery second",
        "random", "s",
    ):  # fmt: skip
        table.add_column(column, justify="right" if column else "left")
    for program, row in rows.items():
        less, error = row.held_out.less(rows[REFERENCE].held_out)
        table.add_row(
            program,
            f"{row.found.rms_px:.4f}",
            f"{row.found.n_left_out}",
            f"{row.held_out.rms_px:.4f}",
            f"{row.held_out.median_px:.4f}",
            f"{1e3 * less:+.2f} ± {1e3 * error:.2f}",
            *_of_splits(row.apart[:1]),
            *_of_splits(row.apart[1:]),
            _rms(row.z[:1]),
            _rms(row.z[1:]),
            f"{row.found.seconds:.2f}",
        )
    return table


def _of_splits(found: list[list[Apart]]) -> tuple[str, str]:
    flat = [each for split in found for each in split]
    return _rms([[each.rms_px for each in flat]]), _rms([[each.expected_px for each in flat]])


def _rms(values: list[list[float]]) -> str:
    flat = np.array([value for row in values for value in row])
    return f"{np.sqrt((flat**2).mean()):.2f}" if flat.size else "-"


def misfit_table(found: list[Misfit]) -> Table:
    """What OpenCV's residuals hold beside noise."""
    table = Table(title="what errs together in OpenCV's residuals", box=box.SIMPLE_HEAD)
    for column in ("", "directions", "F", "p", "share of squares"):
        table.add_column(column, justify="right" if column else "left")
    for each in found:
        table.add_row(
            each.cause, f"{each.n_directions}", f"{each.f:.1f}", f"{each.p_value:.0e}",
            f"{each.share:.1%}",
        )  # fmt: skip
    return table


if __name__ == "__main__":
    main(tyro.cli(PeersOptions))

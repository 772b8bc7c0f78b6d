"""How many views of a board does a camera need, how tilted, and how far into the corners?

Method: views of a board held at random before one camera (`views`, `tilt_deg`, `coverage`), or a
scan of a room by the same camera (`frames`), calibrated from nothing with the stated covariance, as
`sfm-calib target` and `calibrate` do it. The common measure is the error of the lens over the
picture in px, RMS over trials; beside it what the stated covariance has it be, and the normalised
squared error (NEES). Power laws are fitted to the errors over the number.
Expectation: the handbooks' 20 to 30 images, tilted by up to 45 degrees, over the whole picture, are
no threshold: from 10 views on the error falls as 1 / sqrt(n), 20 to 30 views gain 18 %, and the
stated covariance is not too small in any case, be they too few, too flat or too central: the error
is at most 1.4 times what is stated, the median NEES at most 2, within two standard errors.
Source: "20 to 30 images" is folklore (10 to 20 in MathWorks' and OpenCV's pages); 1 / sqrt(n) holds
for independent views. Corner noise and scans as measured (see CORNER_PX, FEATURE_PX).
Run: sfm-calib run configs/studies/views_needed.yaml -o out/views_needed
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from experiments.coverage import MIN_PARALLAX_DEG, nees
from experiments.picture_errors import off_px, stated_px
from experiments.runner.protocol import Answer, Cell, Finished, Row, Study, TrialOptions
from experiments.views_needed_answer import answered
from graphs.build import GraphOptions
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.losses import SCALE_95
from graphs.priors import weak_lens_prior
from graphs.problem import Estimate
from graphs.refine import refine
from graphs.stated_covariance import calibration_covariance
from sfm_calib.boards.spec import Checkerboard
from sfm_calib.config import RigConfig
from sfm_calib.simulate.board_views import (
    PLAIN_BOARD,
    BoardViewOptions,
    calibrate_views,
    simulate_boards,
)
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

CORNER_PX = 0.1  # five real sets of boards have residuals of 0.05 to 0.16 px
FEATURE_PX = 0.5  # as in `coverage`: SIFT on real scans has 0.3 to 0.8 px
# An office print: its corners off by 2 thousandths of a square, bent by a thousandth.
PRINTED_BOARD = Checkerboard(inner_corners=(9, 6), square_m=0.03)
# Points of the room that a scan can see at any time; a picture has 150 of them, as in `coverage`.
POINTS_AT_ONCE, LIFE_FRAMES, POINTS_SEEN = 900, 30, 150
CELLS = (12, 9)  # of the picture, of which the share with a corner is counted


class ViewsOptions(TrialOptions):
    """One set of views of a board, or one scan."""

    source: Literal["board", "scan"] = "board"
    """What is seen."""
    views: Annotated[int, Field(ge=3, le=500)] = 20
    """Views of the board, or frames of the scan."""
    tilt_deg: Annotated[float, Field(ge=0, le=80)] = 45.0
    """Of a board against the image plane, at most."""
    coverage: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Share of the picture in which the board's middle lies; 0: in the centre."""
    distance_m: Annotated[float, Field(gt=0.1, le=100)] = 0.6
    """Of the board of 24 cm, at most; half of it at least."""
    printed: bool = False
    """Whether the board is an office print, instead of an exact one."""


# ---- one calibration -----------------------------------------------------------------------


def trial(options: ViewsOptions, seed: int) -> Row:
    """Simulate, calibrate, and compare with the truth."""
    rng = np.random.default_rng([seed, 0 if options.source == "board" else 1])
    make = of_board if options.source == "board" else of_scan
    truth, estimate, covariance, pixels, warned = make(options, rng)
    true, found = truth.cameras[0], estimate.cameras[0]
    error = change(truth, estimate, covariance.names)
    off = found.params - true.params
    row: dict[str, Cell] = {
        "off_px": off_px(true, found),
        "stated_px": stated_px(found, covariance),
        "nees": nees(error, covariance.matrix),
        "focal_px": float(np.sqrt((off[:2] ** 2).mean())),
        "centre_px": float(np.linalg.norm(off[2:4])),
        "sigma_focal_px": covariance.sigma["cam0.fx"],
        "seen": share_seen(pixels, true.size),
        "n_corners": len(pixels),
        "warned": warned,
    }
    return row


def of_board(
    options: ViewsOptions, rng: np.random.Generator
) -> tuple[Estimate, Estimate, Covariance, FloatArray, bool | None]:
    """Truth, estimate, its covariance, pixels (n, 2) of the corners that were used, and whether
    the views were said to tell the focal length hardly."""
    how = BoardViewOptions(
        views=options.views,
        tilt_deg=(0.0, options.tilt_deg),
        coverage=options.coverage,
        distance_m=(options.distance_m / 2, options.distance_m),
        sigma_px=CORNER_PX,
    )
    board = PRINTED_BOARD if options.printed else PLAIN_BOARD
    made = simulate_boards(how, rng, board=board)
    found = calibrate_views(made.views, made.board, RigConfig(lens="radtan"))
    pixels = found.refinement.problem.observations.pixels
    return made.truth, found.estimate, found.covariance, pixels, bool(found.start.notes)


def of_scan(
    options: ViewsOptions, rng: np.random.Generator
) -> tuple[Estimate, Estimate, Covariance, FloatArray, bool | None]:
    """The same of a scan's features; None: that is not judged here."""
    how = TrackOptions(
        rig="mono", lens="radtan", frames=options.views, sigma_px=FEATURE_PX,
        max_track_frames=LIFE_FRAMES, max_points_per_image=POINTS_SEEN,
        points=POINTS_AT_ONCE * (options.views + LIFE_FRAMES - 1) // LIFE_FRAMES,
    )  # fmt: skip
    problem, truth = simulate_tracks(how, rng)
    priors = tuple(weak_lens_prior(camera) for camera in problem.initial.cameras)
    graph = GraphOptions(loss="cauchy", loss_scale=SCALE_95["cauchy"], lens_priors=priors)
    found = refine(problem, graph, MIN_PARALLAX_DEG)
    covariance = calibration_covariance(
        found.graph, found.estimate, found.values, MIN_PARALLAX_DEG
    ).stated
    return truth, found.estimate, covariance, found.problem.observations.pixels, None


def share_seen(pixels: FloatArray, size: tuple[int, int]) -> float:
    """Of the picture's cells, those with a corner."""
    cell = np.floor(pixels / size * CELLS).astype(int).clip(0, np.array(CELLS) - 1)
    return len(np.unique(cell, axis=0)) / (CELLS[0] * CELLS[1])


def answer(trials: Sequence[Finished[ViewsOptions]]) -> Answer:
    """How the error falls, and whether the stated sigma tells."""
    return answered(trials, ViewsOptions())


STUDY = Study(ViewsOptions, trial, answer)

"""Our calibration from the same corners: like OpenCV's, and as we would do it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np

from experiments.peers.calibrations import (
    SHAPE_NAMES,
    PeerCalibration,
    gauss_newton_covariance,
    residuals_of,
    rms,
)
from experiments.peers.opencv import place_board
from experiments.peers.sightings import frames_of
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.losses import LossName
from graphs.noise import free_dimensions
from graphs.priors import LensPrior, weak_lens_prior
from graphs.problem import Board, BoardPoints, Estimate, Observations, Problem, residuals_px
from graphs.refine import noise_of, refine
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from sfm_calib.boards.views import BoardViews

# Of the width; focal length, centre and coefficients that are left to the data alone.
NO_BELIEF_PX, NO_BELIEF = 1e5, 1e4
EXACT_STEPS, EXACT_TOLERANCE = 200, 1e-12
MIN_PARALLAX_DEG = 1.0  # of no matter to corners of a board

SigmaKind = Literal["model", "stated"]


@dataclass(frozen=True)
class OurOptions:
    """How we calibrate."""

    like_opencv: bool = False  # least squares of all corners, no priors, the size as stated
    bend_sigma: float = 0.0  # of the board's bends, of half its longer side; 0: flat
    corner_sigma_m: float = 0.0  # of where its corners lie; 0: as stated
    size_sigma: float = 0.0  # of the board's size, relative
    loss: LossName = "cauchy"  # where not like OpenCV
    tangential_sigma: float | None = None  # of the prior on p1 and p2; None: as for scans
    blocks: bool = True  # whether the jackknife is made
    sigmas: SigmaKind = "stated"


def calibrate(
    views: BoardViews, corners: FloatArray, start: PeerCalibration, options: OurOptions
) -> PeerCalibration:
    """Cameras, rig and bends from views of a board with corners (n, 3), from a peer's result.

    Frames that the start does not place start by PnP.
    """
    begin = time.perf_counter()
    problem = problem_of(views, corners, start, options)
    if options.like_opencv:
        graph, estimate, values = least_squares(problem)
        n_left_out, kept = 0, problem
    else:
        priors = tuple(believing(camera, options) for camera in start.cameras)
        graph_options = GraphOptions(loss=options.loss, lens_priors=priors)
        refinement = refine(problem, graph_options, MIN_PARALLAX_DEG)
        graph, estimate, values = refinement.graph, refinement.estimate, refinement.values
        n_left_out, kept = refinement.n_rejected, refinement.problem
    covariance = calibration_covariance(
        graph, estimate, values, MIN_PARALLAX_DEG if options.blocks else None
    )
    chosen = covariance.stated if options.sigmas == "stated" else covariance.model
    frame_of = {name: index for index, name in enumerate(views.frames)}
    placed = {
        frame_of[name]: t for name, t in zip(kept.frame_names, estimate.rig_from_world, strict=True)
    }
    shape = np.zeros(3) if estimate.board_shape is None else estimate.board_shape
    found = PeerCalibration(
        "ours", estimate.cameras, estimate.cam_from_rig, placed, shape, chosen, 0.0, n_left_out,
        seconds=time.perf_counter() - begin,
    )  # fmt: skip
    return replace(found, rms_px=rms(residuals_of(found, views, corners)))


def with_bends_sigma(
    found: PeerCalibration, views: BoardViews, corners: FloatArray
) -> dict[str, float]:
    """Sigma of each bend, of independent noise, as if lenses had no priors."""
    free = [*found.covariance.names, *SHAPE_NAMES[1:]]
    sigma = gauss_newton_covariance(found, views, corners, free).sigma
    return {name: sigma[name] for name in SHAPE_NAMES[1:]}


def least_squares(problem: Problem) -> tuple[CalibrationGraph, Estimate, gtsam.Values]:
    """The optimum of all corners alike and no belief in the lenses."""
    priors = tuple(unbelieving(camera) for camera in problem.initial.cameras)
    options = GraphOptions(loss="none", lens_priors=priors, sigma_px=noise_of(problem))
    for _ in range(2):  # the first brings the noise
        graph = build(problem, options)
        estimate, values, _ = solve(graph, EXACT_STEPS, EXACT_TOLERANCE)
        problem = replace(problem, initial=estimate)
        options = replace(options, sigma_px=_rms_sigma(problem, options))
    return graph, estimate, values


def _rms_sigma(problem: Problem, options: GraphOptions) -> float:
    left = residuals_px(problem.initial, problem.observations)
    spare = left.size - free_dimensions(problem, options)
    return float(np.sqrt((left**2).sum() / spare))


def unbelieving(camera: Camera) -> LensPrior:
    """A prior so weak that it does nothing, about the camera's own values."""
    n = len(camera.params)
    sigma = np.full(n, NO_BELIEF)
    sigma[:4] = NO_BELIEF_PX
    return LensPrior(camera.params.copy(), sigma)


def believing(camera: Camera, options: OurOptions) -> LensPrior:
    """Our weak prior, its belief in tangential terms perhaps another."""
    weak = weak_lens_prior(camera)
    if options.tangential_sigma is None:
        return weak
    tangential = np.isin(camera.names, ("p1", "p2"))
    return replace(weak, sigma=np.where(tangential, options.tangential_sigma, weak.sigma))


def problem_of(
    views: BoardViews, corners: FloatArray, start: PeerCalibration, options: OurOptions
) -> Problem:
    """The views as a problem: a point for each frame and corner, a frame for each place."""
    frames = frames_of(views)
    place = {frame: index for index, frame in enumerate(frames)}
    n, n_frames = len(corners), len(frames)
    half = float(np.ptp(corners, axis=0).max()) / 2
    bends = options.bend_sigma * half
    sigma = np.array([options.size_sigma, bends, bends])
    if options.corner_sigma_m > 0:
        sigma = np.concatenate([sigma, np.full(corners.size, options.corner_sigma_m)])
    board = Board(corners, np.zeros(len(sigma)), sigma)
    observations = Observations(
        np.concatenate([view.pixels for view in views.views]),
        np.concatenate([np.full(len(view.corner), place[view.frame]) for view in views.views]),
        np.concatenate([np.full(len(view.corner), view.camera) for view in views.views]),
        np.concatenate([place[view.frame] * n + view.corner for view in views.views]),
    )
    rig_from_board = tuple(_placed(views, corners, start, frame) for frame in frames)
    estimate = Estimate(
        start.cameras, start.cam_from_rig, rig_from_board, np.tile(corners, (n_frames, 1)), None,
        board.shape_mean,
    )  # fmt: skip
    of_board = BoardPoints(
        board, np.tile(np.arange(n), n_frames), np.zeros(n * n_frames, dtype=bool)
    )
    names = tuple(views.frames[frame] for frame in frames)
    return Problem(estimate, observations, names, 0, board=of_board)


def _placed(
    views: BoardViews, corners: FloatArray, start: PeerCalibration, frame: int
) -> Transform:
    if frame in start.rig_from_board:
        return start.rig_from_board[frame]
    view = next(view for view in views.views if view.frame == frame)
    cam_from_board = place_board(start.cameras[view.camera], view, corners)
    return start.cam_from_rig[view.camera].inverse @ cam_from_board

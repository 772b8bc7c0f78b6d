"""Problems with a board: seen by a rig that it is waved before, or standing in a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphs.boards import corners_of
from graphs.camera import Camera, nominal_params
from graphs.frames import FloatArray, Transform
from graphs.problem import Board, BoardPoints, Estimate, Observations, Problem
from sfm_calib.simulate.board_views import corners_seen
from sfm_calib.simulate.rigs import SimulatedRig

COLUMNS, ROWS, SQUARE_M = 8, 6, 0.03


def flat_board(sigma: Sequence[float] = (1e-3, 0.0, 0.0)) -> Board:
    """8 x 6 corners 30 mm apart; sigma (3,) of its size and its bends."""
    x, y = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    corners = SQUARE_M * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return Board(corners, np.zeros(3), np.array(sigma))


def camera(name: str, lens: str = "radtan", focal_px: float = 600.0) -> Camera:
    params = nominal_params(lens, (640, 480), focal_px)  # type: ignore[arg-type]
    params[2:4] += [6.0, -4.0]
    if lens == "radtan":
        params[4:8] = [-0.12, 0.05, 0.0005, -0.0008]
    return Camera(name, lens, (640, 480), params)  # type: ignore[arg-type]


def stereo(lens: str = "radtan") -> tuple[tuple[Camera, ...], tuple[Transform, ...]]:
    """Two cameras 12 cm apart that look the same way but for a few degrees."""
    turned = Transform.exp(np.array([0.01, -0.08, 0.02]), np.array([-0.12, 0.004, 0.003]))
    return (camera("left", lens), camera("right", lens, 640.0)), (Transform.identity(), turned)


def waved(
    rng: np.random.Generator,
    n_frames: int = 12,
    noise_px: float = 0.1,
    cameras: Sequence[Camera] | None = None,
    cam_from_rig: Sequence[Transform] | None = None,
    board: Board | None = None,
    shape: Sequence[float] = (0.0, 0.0, 0.0),
    seen: float = 1.0,
) -> tuple[Problem, Estimate]:
    """A board before a rig, in another place each frame, and the truth.

    shape (3,): its true one; seen: share of the corners that each image has.
    """
    if cameras is None or cam_from_rig is None:
        cameras, cam_from_rig = stereo()
    board = board or flat_board()
    true_corners = corners_of(board, np.array(shape))[0]
    rig_from_board = tuple(_before_the_rig(rng, true_corners.mean(0)) for _ in range(n_frames))
    n = len(true_corners)
    points = np.tile(true_corners, (n_frames, 1))
    truth = Estimate(
        tuple(cameras), tuple(cam_from_rig), rig_from_board, points, None, np.array(shape)
    )
    views = corners_seen(
        SimulatedRig(tuple(cameras), tuple(cam_from_rig)), rig_from_board, true_corners, noise_px,
        rng, seen,
    )  # fmt: skip
    of = [np.full(len(view.corner), 1) for view in views]
    observations = Observations(
        np.concatenate([view.pixels for view in views]),
        np.concatenate([view.frame * one for view, one in zip(views, of, strict=True)]),
        np.concatenate([view.camera * one for view, one in zip(views, of, strict=True)]),
        np.concatenate([view.frame * n + view.corner for view in views]),
    )
    of_board = BoardPoints(
        board, np.tile(np.arange(n), n_frames), np.zeros(n * n_frames, dtype=bool)
    )
    names = tuple(f"board{frame:03d}" for frame in range(n_frames))
    start = replace(truth, board_shape=board.shape_mean)
    return Problem(start, observations, names, 0, board=of_board), truth


def _before_the_rig(rng: np.random.Generator, middle: FloatArray) -> Transform:
    """rig_from_board somewhere in view, tilted by up to 40 degrees."""
    turn = Transform.exp(rng.uniform(-0.7, 0.7, 3) * [1, 1, 2], np.zeros(3)).rotation
    place = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.35, 0.7)])
    return Transform(turn, place - turn @ middle)


def misprinted(rng: np.random.Generator, sigma_m: float) -> tuple[Board, FloatArray]:
    """A board whose corners are off by `sigma_m`, and its true shape."""
    flat = flat_board()
    sigma = np.concatenate([flat.shape_sigma, np.full(flat.corners.size, sigma_m)])
    board = Board(flat.corners, np.zeros(len(sigma)), sigma)
    return board, sigma * rng.standard_normal(len(sigma))

"""Boards in the graph: points whose place is known but for the board's size, bend and place.

A board that is waved, or that only a frame of its own sees, is the world of that frame:
`rig_from_world` is then rig_from_board, and its corners are fixed points. A board that stays put
in a scan has its place in the scan's world as a variable. Either way its corners are points of
tracks that are not triangulated but placed, and their rows have columns of the board.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from graphs.frames import NOT_SMART, FloatArray, skew, to_gtsam_inverse
from graphs.keys import board_key, shape_key
from graphs.problem import Board, Estimate, Problem

N_WHOLE = 3  # of a board's shape, what concerns it as a whole: size and bends
N_PLACE = 6
LEAST_SIGMA = 1e-9  # of a shape that is held: relative, and in units of the board


@dataclass(frozen=True)
class Corners:
    """All corners of a board somewhere, and how they follow its variables."""

    places: FloatArray  # (2, n, 3) in the board's own frame, and in the scan's world
    by_board: FloatArray  # (2, n, 3, k) by `board_keys`' variables, in their order


def corners_of(board: Board, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners (n, 3) in the board's frame, and derivatives (n, 3, k) by its shape.

    shape (k,): logarithm of the size over the stated one; by how much the middle stands out
    against the edges left and right, and above and below (mrcal's two-parameter bend); then,
    unless they are where they are stated to be, how far off each corner is in x, y, z.
    """
    middle = (board.corners.max(0) + board.corners.min(0)) / 2
    half = (board.corners.max(0) - board.corners.min(0)) / 2
    off = (board.corners - middle)[:, :2] / np.maximum(half[:2], 1e-300)
    arch = 1 - off**2  # (n, 2)
    bent = board.corners.copy()
    bent[:, 2] += arch @ shape[1:N_WHOLE]
    size, n = float(np.exp(shape[0])), len(bent)
    by_shape = np.zeros((n, 3, len(shape)))
    if len(shape) > N_WHOLE:
        bent += shape[N_WHOLE:].reshape(n, 3)
        own = N_WHOLE + np.arange(3 * n).reshape(n, 3)
        by_shape[np.arange(n)[:, None], np.arange(3), own] = size
    by_shape[:, :, 0] = size * bent
    by_shape[:, 2, 1:N_WHOLE] = size * arch
    return size * bent, by_shape


def shape_length(board: Board) -> int:
    """Variables of a board's shape."""
    return len(board.shape_mean)


def place_corners(board: Board, values: gtsam.Values) -> Corners:
    """The corners for GTSAM's values."""
    own, by_shape = corners_of(board, values.atVector(shape_key()))
    if not values.exists(board_key()):
        return Corners(np.array([own, own]), np.array([by_shape, by_shape]))
    world_from_board = values.atPose3(board_key())
    rotation = world_from_board.rotation().matrix()
    in_world = own @ rotation.T + np.asarray(world_from_board.translation())
    # Pose3 moves on the right: x = R Exp(w) (p + v) + t
    by_turn = -np.einsum("nk,kij->nij", own, np.array([skew(axis) for axis in np.eye(3)]))
    by_place = rotation @ np.concatenate(
        [by_turn, np.broadcast_to(np.eye(3), by_turn.shape), by_shape], axis=2
    )
    waved = np.concatenate([np.zeros((len(own), 3, N_PLACE)), by_shape], axis=2)
    return Corners(np.array([own, in_world]), np.array([waved, by_place]))


def board_keys(problem: Problem) -> list[int]:
    """The board's variables, in the order of their columns."""
    if problem.board is None:
        return []
    still = problem.initial.world_from_board is not None
    return [board_key(), shape_key()] if still else [shape_key()]


def board_width(problem: Problem) -> int:
    """Columns of the board's variables."""
    if problem.board is None:
        return 0
    of_shape = shape_length(problem.board.board)
    return sum(N_PLACE if key == board_key() else of_shape for key in board_keys(problem))


def insert_board(values: gtsam.Values, problem: Problem) -> None:
    """The start of the board's variables."""
    start = problem.initial
    if problem.board is None:
        return
    values.insert(shape_key(), shape_of(start, problem.board.board))
    if start.world_from_board is not None:
        values.insert(board_key(), to_gtsam_inverse(start.world_from_board.inverse))


def shape_of(estimate: Estimate, board: Board) -> FloatArray:
    """The board's shape (k,), as stated where nothing was estimated."""
    return board.shape_mean if estimate.board_shape is None else estimate.board_shape


def shape_prior_factor(board: Board) -> gtsam.NonlinearFactor:
    """What is known of the size and the flatness of a board as GTSAM's factor."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.maximum(board.shape_sigma, LEAST_SIGMA), NOT_SMART)
    return gtsam.PriorFactorVector(shape_key(), board.shape_mean, noise)

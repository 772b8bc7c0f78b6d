"""Problems from views of a board, alone or beside a scan of the same cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphs.boards import corners_of
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.problem import (
    Board,
    BoardPoints,
    Estimate,
    IntArray,
    Observations,
    Problem,
    joined,
)

# Of the residuals of corners what the sigmas of their detection do not explain: 0.05 to 0.1 px on
# five real sets, 0.16 px on a sixth.
UNTOLD_PX = 0.07


@dataclass(frozen=True)
class SeenCorners:
    """Corners of a board in images; row i is one corner in one image."""

    pixels: FloatArray  # (n, 2)
    frame: IntArray  # (n,)
    camera: IntArray  # (n,)
    corner: IntArray  # (n,) index into Board.corners
    sigma_px: FloatArray  # (n,) of one coordinate, as detection has it


def board_problem(
    board: Board,
    seen: SeenCorners,
    cameras: Sequence[Camera],
    cam_from_rig: Sequence[Transform],
    rig_from_board: Sequence[Transform],
    frame_names: Sequence[str],
    reference: int,
) -> Problem:
    """The problem whose every frame has the board as its world.

    rig_from_board: one a frame; frames without corners are not to be among them.
    """
    n, n_frames = len(board.corners), len(frame_names)
    points = np.tile(corners_of(board, board.shape_mean)[0], (n_frames, 1))
    start = Estimate(
        tuple(cameras), tuple(cam_from_rig), tuple(rig_from_board), points,
        board_shape=board.shape_mean,
    )  # fmt: skip
    of_board = BoardPoints(
        board, np.tile(np.arange(n), n_frames), np.zeros(n * n_frames, dtype=bool)
    )
    return Problem(
        start, observed(seen, seen.frame * n + seen.corner), tuple(frame_names), reference,
        board=of_board,
    )  # fmt: skip


def observed(seen: SeenCorners, point: IntArray) -> Observations:
    """Corners as observations of points (n,), weighed among each other as detection has it.

    What their sigmas do not tell, such as where paint ran, all corners share alike.
    """
    sigma_px = np.hypot(seen.sigma_px, UNTOLD_PX)
    relative = sigma_px / np.median(sigma_px) if len(sigma_px) else sigma_px
    return Observations(seen.pixels, seen.frame, seen.camera, point, relative)


def beside(scan: Problem, boards: Problem) -> Problem:
    """One problem of a scan and of a board that its cameras saw at other times, or waved.

    Both have the same cameras, in one order, and the same unit of length: lenses and rig start as
    the scan has them.
    """
    assert boards.board is not None
    a, b = scan.initial, boards.initial
    n_points, n_frames = len(a.points), len(scan.frame_names)
    other = boards.observations
    moved = replace(other, point=other.point + n_points, frame=other.frame + n_frames)
    return replace(
        scan,
        initial=replace(
            a,
            rig_from_world=(*a.rig_from_world, *b.rig_from_world),
            points=np.concatenate([a.points, b.points]),
            board_shape=b.board_shape,
        ),
        observations=joined([scan.observations, moved]),
        frame_names=(*scan.frame_names, *boards.frame_names),
        board=_behind(n_points, boards.board, scan.board),
    )


def standing_in(
    scan: Problem, board: Board, seen: SeenCorners, world_from_board: Transform
) -> Problem:
    """The scan with a board that stands still in it; `seen.frame` counts the scan's frames."""
    a, n_points = scan.initial, len(scan.initial.points)
    n = len(board.corners)
    frames, frame = np.unique(seen.frame, return_inverse=True)
    places = world_from_board @ corners_of(board, board.shape_mean)[0]
    of_board = BoardPoints(
        board, np.tile(np.arange(n), len(frames)), np.ones(n * len(frames), dtype=bool)
    )
    corners = observed(seen, n_points + frame * n + seen.corner)
    return replace(
        scan,
        initial=replace(
            a,
            points=np.concatenate([a.points, np.tile(places, (len(frames), 1))]),
            world_from_board=world_from_board,
            board_shape=board.shape_mean,
        ),
        observations=joined([scan.observations, corners]),
        board=_behind(n_points, of_board),
    )


def _behind(n_points: int, board: BoardPoints, before: BoardPoints | None = None) -> BoardPoints:
    """The board's points after so many others, of the scene or of the same board."""
    corner = np.full(n_points, -1) if before is None else before.corner
    still = np.zeros(n_points, dtype=bool) if before is None else before.still
    return replace(
        board,
        corner=np.concatenate([corner, board.corner]),
        still=np.concatenate([still, board.still]),
    )

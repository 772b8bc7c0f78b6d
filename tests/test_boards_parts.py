"""Parts of a problem with a board: blocks of frames, halves, and frames that give the unit."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic.boards import flat_board, waved
from synthetic.problems import small_problem

from graphs.board_problem import beside
from graphs.jackknife import blocks_of
from graphs.problem import Problem


def joint(n_scan: int, n_boards: int, n_points: int = 60) -> Problem:
    """A scan by two cameras, and views of a board that both see at once."""
    scan, truth = small_problem(
        "radtan", cameras=2, frames=n_scan, points=n_points, sigma_px=0.2, start_error=0.0
    )
    board = flat_board()
    boards, _ = waved(
        np.random.default_rng(5), n_boards, 0.2, truth.cameras, truth.cam_from_rig,
        board=type(board)(4 * board.corners, board.shape_mean, board.shape_sigma),
    )  # fmt: skip
    return beside(scan, boards)


@pytest.mark.parametrize(("n_scan", "n_boards"), [(5, 1), (3, 3), (4, 1), (5, 3), (20, 2)])
def test_no_block_is_empty(n_scan: int, n_boards: int) -> None:
    block = blocks_of(joint(n_scan, n_boards, 30))
    assert set(block) == set(range(block.max() + 1))
    assert (np.diff(block[:n_scan]) >= 0).all() and (np.diff(block[n_scan:]) >= 0).all()

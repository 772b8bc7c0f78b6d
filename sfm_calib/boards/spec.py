"""The description of a calibration target: its pattern, its size, and how well that is known."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from graphs.frames import FloatArray
from graphs.problem import IntArray

BoardType = Literal["checkerboard", "charuco", "aprilgrid", "circles"]
# Of a length on the board: office printers are off by 0.1 to 0.5 %, good boards by less.
DEFAULT_RELATIVE_SIGMA = 0.001


class Board(BaseModel):
    """A flat target. Its frame: origin in corner 0, x along a row, y down a column, z into it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    type: BoardType
    columns: int = Field(ge=2)  # of corners, squares or tags: see each type
    rows: int = Field(ge=2)
    square_m: float = Field(gt=0)  # side of a square; of circles half the distance within a row
    square_sigma_m: float | None = Field(default=None, gt=0)
    warp: bool = True  # whether the board may be bent a little

    @property
    def relative_sigma(self) -> float:
        """Of every length on the board, relative."""
        if self.square_sigma_m is None:
            return DEFAULT_RELATIVE_SIGMA
        return self.square_sigma_m / self.square_m

    @property
    def corners_m(self) -> FloatArray:
        """Corners (n, 3) in the board's frame, row by row; z = 0."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        grid = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
        result: FloatArray = grid * self.square_m
        return result

    @property
    def symmetries(self) -> tuple[IntArray, ...]:
        """Renumberings (n,) of the corners under which the pattern looks the same, the identity
        left out: corner i may as well be corner renumbering[i]."""
        # The half turn of a checkerboard with an odd sum of inner corners swaps black and white.
        if self.type == "checkerboard" and (self.columns + self.rows) % 2 == 0:
            return (np.arange(self.columns * self.rows)[::-1],)
        return ()

"""What was seen of a board: its corners in the images of some cameras."""

from __future__ import annotations

from dataclasses import dataclass

from graphs.frames import FloatArray
from graphs.problem import IntArray


@dataclass(frozen=True)
class Detection:
    """The corners of the board that are seen in an image."""

    corner: IntArray  # (n,) index into Board.corners_m, rising
    pixels: FloatArray  # (n, 2)
    sigma_px: FloatArray  # (n,) of one coordinate, as the image itself shows it


@dataclass(frozen=True)
class BoardView:
    """The corners of the board that were found in one image."""

    camera: int  # index into BoardViews.cameras
    frame: int  # index into BoardViews.frames
    corner: IntArray  # (n,) index into Board.corners_m
    pixels: FloatArray  # (n, 2)
    sigma_px: FloatArray  # (n,) of one coordinate, as the image itself shows it


@dataclass(frozen=True)
class BoardViews:
    """All views of one board, by frame, then by camera."""

    cameras: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]  # width, height of each camera
    frames: tuple[str, ...]
    views: tuple[BoardView, ...]

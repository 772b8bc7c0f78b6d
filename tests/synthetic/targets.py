"""Pictures of a board by a rig whose lenses and places are known, as folders of PNGs.

Lenses are OpenCV's here: no formula is shared with the code that calibrates them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray, Transform
from sfm_calib.boards.picture import view_image
from sfm_calib.boards.spec import Board, Charuco, Checkerboard

GrayImage = NDArray[np.uint8]
GREY_SIGMA = 3.0  # of a camera's noise, in grey levels
CHECKERBOARD = Checkerboard(inner_corners=(8, 5), square_m=0.03)
CHARUCO = Charuco(squares=(7, 5), square_m=0.035, marker_m=0.026)
# Of the board's middle in the image (shares of its size), its distance (m), and its tilts (deg).
PLACES = (
    (0.40, 0.42, 0.36, (30, 5, 4)),
    (0.62, 0.40, 0.40, (-8, 34, 0)),
    (0.38, 0.60, 0.42, (-32, 8, 92)),
    (0.60, 0.62, 0.38, (4, -36, -3)),
    (0.50, 0.50, 0.30, (6, -4, 0)),
    (0.66, 0.36, 0.52, (28, 26, 60)),
    (0.34, 0.66, 0.50, (-26, -28, -30)),
)


@dataclass(frozen=True)
class Eye:
    """A camera: its lens as OpenCV has it, and where it sits in the rig."""

    focal_px: tuple[float, float] = (560.0, 562.0)
    centre_px: tuple[float, float] = (326.0, 235.0)
    distortion: tuple[float, float, float, float] = (-0.11, 0.04, 0.0006, -0.0009)
    size: tuple[int, int] = (640, 480)
    cam_from_rig: Transform = Transform.identity()  # noqa: RUF009 - it is frozen

    @property
    def matrix(self) -> FloatArray:
        """K (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    @property
    def truth(self) -> dict[str, float]:
        """Every parameter of `radtan`, by name."""
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
        values = (*self.focal_px, *self.centre_px, *self.distortion)
        return dict(zip(names, values, strict=True))

    def smaller(self, factor: float) -> Eye:
        """The same camera with fewer pixels."""
        width, height = (round(side * factor) for side in self.size)
        fx, fy = (one * factor for one in self.focal_px)
        cx, cy = ((one + 0.5) * factor - 0.5 for one in self.centre_px)
        return Eye((fx, fy), (cx, cy), self.distortion, (width, height), self.cam_from_rig)


LEFT = Eye()
RIGHT = Eye(
    (590.0, 588.0), (313.0, 243.0), (-0.09, 0.02, -0.0005, 0.0007),
    cam_from_rig=Transform.exp(np.array([0.01, -0.12, 0.02]), np.array([-0.10, 0.004, 0.003])),
)  # fmt: skip


def in_view(board: Board, place: tuple[float, float, float, Sequence[float]]) -> Transform:
    """rig_from_board with the board where one of PLACES has it in the image of LEFT."""
    along, down, distance_m, tilt_deg = place
    rotation = cv2.Rodrigues(np.radians(np.array(tilt_deg, dtype=float)))[0]
    pixel = np.array([along * LEFT.size[0], down * LEFT.size[1], 1.0])
    middle = (board.corners_m.min(axis=0) + board.corners_m.max(axis=0)) / 2
    at = distance_m * np.linalg.solve(LEFT.matrix, pixel)
    return Transform(rotation, at - rotation @ middle)


def image_of(
    board: Board, eye: Eye, rig_from_board: Transform, rng: np.random.Generator
) -> GrayImage:
    """The board as a camera with noise sees it."""
    cam_from_board = eye.cam_from_rig @ rig_from_board
    rotation, origin = cam_from_board.rotation, cam_from_board.translation

    def board_from_pixel(pixels: FloatArray) -> FloatArray:
        at = cv2.undistortPoints(
            pixels.reshape(-1, 1, 2), eye.matrix, np.array(eye.distortion),
        ).reshape(-1, 2)  # fmt: skip
        rays = np.column_stack([at, np.ones(len(at))])
        depth = (rotation[:, 2] @ origin) / (rays @ rotation[:, 2])
        return ((rays * depth[:, None] - origin) @ rotation)[:, :2]

    flat = view_image(board, board_from_pixel, eye.size).astype(float)
    noisy = flat + GREY_SIGMA * rng.standard_normal(flat.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def views_of(
    board: Board,
    eye: Eye,
    places: Sequence[tuple[float, float, float, Sequence[float]]] = PLACES,
    seed: int = 0,
) -> list[GrayImage]:
    """A camera's images of the board at these places."""
    rng = np.random.default_rng(seed)
    return [image_of(board, eye, in_view(board, place), rng) for place in places]


def without_board(size: tuple[int, int]) -> GrayImage:
    """A grey wall, a little noisy."""
    noise = np.random.default_rng(9).normal(128, GREY_SIGMA, size[::-1])
    return np.clip(np.rint(noise), 0, 255).astype(np.uint8)


def folder_of(root: Path, cameras: Mapping[str, Sequence[GrayImage | None]]) -> Path:
    """PNGs of each camera, numbered by frame; None: that camera has no such image."""
    for camera, images in cameras.items():
        folder = root / camera
        folder.mkdir(parents=True, exist_ok=True)
        for number, image in enumerate(images):
            if image is not None:
                assert cv2.imwrite(str(folder / f"{number:02d}.png"), image)
    return root

"""Target images on disk as views of a board, and the half turns that a symmetric board leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray, Transform, angle_between
from graphs.problem import BoolArray, IntArray
from graphs.selection import MIN_CORNERS
from sfm_calib.boards.detect import detect
from sfm_calib.boards.spec import Board, Checkerboard
from sfm_calib.boards.views import BoardView, BoardViews, Detection

Detector = Literal["ours", "opencv"]
GrayImage = NDArray[np.uint8]

IMAGES = ("*.png", "*.jpg")
DETECTOR_FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
CORNER_SIGMA_PX = 0.1  # of every corner: all are weighed alike


@dataclass(frozen=True)
class DataSet:
    """Images of a board: one folder a camera, files of one number are one frame."""

    folder: str  # below the data
    cameras: tuple[str, ...]
    board: Board


DATA_SETS = {
    "opencv_stereo": DataSet(
        "opencv_stereo",
        ("left", "right"),
        Checkerboard(inner_corners=(9, 6), square_m=1.0),  # unit squares
    ),
    "corridor_stereo": DataSet(
        "corridor_stereo/boards",
        ("left", "right"),
        Checkerboard(inner_corners=(8, 6), square_m=0.025),
    ),
}


def sightings(data: Path, data_set: DataSet, detector: Detector = "ours") -> BoardViews:
    """All views of the board, as our detector finds it, or OpenCV's where that finds all corners.

    Raises FileNotFoundError where a camera has no image.
    """
    found: dict[str, dict[int, Detection]] = {}
    sizes: list[tuple[int, int]] = []
    for index, name in enumerate(data_set.cameras):
        folder = data / data_set.folder / name
        paths = sorted(path for pattern in IMAGES for path in folder.glob(pattern))
        if not paths:
            raise FileNotFoundError(f"{folder} has no images: give the folder that has the data")
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            seen = _seen(image, data_set.board, detector)
            if len(sizes) == index:
                sizes.append((image.shape[1], image.shape[0]))
            if seen is not None:
                found.setdefault(_number(path.stem), {})[index] = seen
    frames = sorted(found)
    views = tuple(
        BoardView(camera, frame, seen.corner, seen.pixels, seen.sigma_px)
        for frame in range(len(frames))
        for camera, seen in sorted(found[frames[frame]].items())
    )
    names = tuple(frames)
    return BoardViews(data_set.cameras, tuple(sizes), names, views)


def _number(stem: str) -> str:
    """What is left of a file's name without its camera's: left07 and right07 are one frame."""
    return "".join(character for character in stem if character.isdigit())


def corners_in(image: GrayImage, board: Board) -> FloatArray | None:
    """All corners (n, 2) of a chessboard in a grey image, row by row; None: not all are seen."""
    size = (board.columns, board.rows)
    seen, pixels = cv2.findChessboardCornersSB(image, size, flags=DETECTOR_FLAGS)
    return pixels.reshape(-1, 2).astype(np.float64) if seen else None


def _seen(image: GrayImage, board: Board, detector: Detector) -> Detection | None:
    if detector == "ours":
        return detect(image, board)
    pixels = corners_in(image, board)
    if pixels is None:
        return None
    return Detection(np.arange(len(pixels)), pixels, np.full(len(pixels), CORNER_SIGMA_PX))


def of_frames(views: BoardViews, frames: Sequence[int]) -> BoardViews:
    """The views of some frames; frames keep their numbers."""
    chosen = set(frames)
    return replace(views, views=tuple(view for view in views.views if view.frame in chosen))


def of_camera(views: BoardViews, camera: int) -> BoardViews:
    """The views of one camera, as if there were no other; frames keep their numbers."""
    kept = tuple(replace(view, camera=0) for view in views.views if view.camera == camera)
    return BoardViews((views.cameras[camera],), (views.sizes[camera],), views.frames, kept)


def common(views: BoardViews) -> BoardViews:
    """Of each frame that all cameras see, the corners that all of them see."""
    by_frame = {
        frame: [view for view in views.views if view.frame == frame] for frame in frames_of(views)
    }
    kept = []
    for seen in by_frame.values():
        corner = reduce(np.intersect1d, [view.corner for view in seen])
        if len(seen) == len(views.cameras) and len(corner) >= MIN_CORNERS:
            kept += [_chosen(view, np.isin(view.corner, corner)) for view in seen]
    return replace(views, views=tuple(kept))


def _chosen(view: BoardView, rows: BoolArray | IntArray) -> BoardView:
    return replace(
        view, corner=view.corner[rows], pixels=view.pixels[rows], sigma_px=view.sigma_px[rows]
    )


def frames_of(views: BoardViews) -> list[int]:
    """Frames that have a view."""
    return sorted({view.frame for view in views.views})


def consistent(
    views: BoardViews, board: Board, cam_from_board: Sequence[Transform]
) -> tuple[BoardViews, int]:
    """The views with corners so numbered that the cameras agree, and how many were renumbered.

    cam_from_board: of each view, as numbered now. A symmetric board may be numbered either way
    round in each image; between the first camera and another one, the turn must be the same in all
    frames. The first camera's numbers stay. Frames that a camera shares with none stay, too.
    """
    if not board.symmetries:
        return views, 0
    half_turn = _half_turn(board)
    renumbered, count = list(views.views), 0
    place = {(view.camera, view.frame): index for index, view in enumerate(views.views)}
    for camera in range(1, len(views.cameras)):
        shared = [frame for (other, frame) in place if other == camera and (0, frame) in place]
        options = []
        for frame in shared:
            first = cam_from_board[place[0, frame]].inverse
            own = cam_from_board[place[camera, frame]]
            options.append((own @ first, own @ half_turn @ first))
        for frame, turned in zip(shared, _agreeing(options), strict=True):
            if turned:
                index = place[camera, frame]
                view = renumbered[index]
                corner = board.symmetries[0][view.corner]
                renumbered[index] = _chosen(replace(view, corner=corner), np.argsort(corner))
                count += 1
    return replace(views, views=tuple(renumbered)), count


def _half_turn(board: Board) -> Transform:
    """board_from_board that takes each corner to the one it may be mistaken for."""
    middle = board.corners_m.mean(0)
    turn = np.diag([-1.0, -1.0, 1.0])
    return Transform(turn, middle - turn @ middle)


def _agreeing(options: Sequence[tuple[Transform, Transform]]) -> list[bool]:
    """Which of two transforms to take of each, so that all are most alike in their rotation."""

    def off(truth: Transform, option: tuple[Transform, Transform]) -> list[float]:
        return [angle_between(truth.rotation, each.rotation) for each in option]

    candidates = [each for option in options for each in option]
    sums = [sum(min(off(truth, option)) for option in options) for truth in candidates]
    best = candidates[int(np.argmin(sums))]
    return [bool(np.argmin(off(best, option)) == 1) for option in options]

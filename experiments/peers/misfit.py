"""What the residuals of a calibration hold beside noise: tests of what could err together.

Each cause is a set of directions in which residuals could lie; what the calibration itself can
follow is taken out of them. F compares the mean square along them with that of the rest: 1 where
there is nothing but independent noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import stats

from experiments.peers.calibrations import PeerCalibration, linearised
from graphs.camera import project_jacobian
from graphs.frames import FloatArray
from graphs.problem import IntArray
from sfm_calib.boards.views import BoardViews

INDEPENDENT = 1e-6  # of the longest singular value: shorter directions are none


@dataclass(frozen=True)
class Misfit:
    """How much one cause explains."""

    cause: str
    n_directions: int
    f: float
    p_value: float
    share: float  # of the residuals' sum of squares


@dataclass(frozen=True)
class _Seen:
    """A view, and how its pixels (n, 2) move with its corners in the board's frame (n, 2, 3)."""

    frame: int
    corner: IntArray  # (n,)
    pixels: FloatArray  # (n, 2)
    by_corner: FloatArray  # (n, 2, 3)
    start: int  # of its residuals among all


def misfits(calibration: PeerCalibration, views: BoardViews, corners: FloatArray) -> list[Misfit]:
    """Tests of a flat board's corners (n, 3), of each frame's board and of each image."""
    free = [name for name in calibration.covariance.names if not name.startswith("board.")]
    jacobian, residual = linearised(calibration, views, corners, free)
    basis = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))[0]
    rest = residual - basis @ (basis.T @ residual)
    spare = len(residual) - jacobian.shape[1]
    seen = list(_seen(calibration, views, corners))
    found = []
    for cause, directions in CAUSES.items():
        columns = np.array([_column(len(rest), parts) for parts in directions(seen, corners)]).T
        columns -= basis @ (basis.T @ columns)
        length = np.linalg.norm(columns, axis=0)
        u, size, _ = np.linalg.svd(columns / np.where(length > 0, length, 1), full_matrices=False)
        u = u[:, size > INDEPENDENT * size[0]]
        n = u.shape[1]
        along, whole = float(((u.T @ rest) ** 2).sum()), float(rest @ rest)
        f = along / n / ((whole - along) / (spare - n))
        p_value = float(stats.f.sf(f, n, spare - n))
        found.append(Misfit(cause, n, f, p_value, along / whole))
    return found


def _seen(calibration: PeerCalibration, views: BoardViews, corners: FloatArray) -> Iterator[_Seen]:
    start = 0
    for view in views.views:
        cam_from_board = (
            calibration.cam_from_rig[view.camera] @ calibration.rig_from_board[view.frame]
        )
        camera = calibration.cameras[view.camera]
        pixels, by_point, _ = project_jacobian(camera, cam_from_board @ corners[view.corner])
        yield _Seen(view.frame, view.corner, pixels, by_point @ cam_from_board.rotation, start)
        start += 2 * len(pixels)


Part = tuple[_Seen, FloatArray]  # moves (n, 2) of a view's pixels
Directions = Callable[[list[_Seen], FloatArray], list[list[Part]]]


def _column(n: int, parts: list[Part]) -> FloatArray:
    column = np.zeros(n)
    for view, moves in parts:
        column[view.start : view.start + moves.size] = moves.ravel()
    return column


def _moved(seen: list[_Seen], corner_moves: FloatArray) -> list[Part]:
    """What moves of the corners (n, 3) in the board's frame do to all views."""
    return [
        (view, np.einsum("nij,nj->ni", view.by_corner, corner_moves[view.corner])) for view in seen
    ]


def _places(corners: FloatArray) -> FloatArray:
    """Of corners (n, 3) on the board, -1 to 1 either way (n, 2)."""
    middle, half = (corners.max(0) + corners.min(0)) / 2, np.ptp(corners, axis=0) / 2
    result: FloatArray = (corners - middle)[:, :2] / half[:2]
    return result


def _bends(corners: FloatArray) -> list[FloatArray]:
    up = np.array([0.0, 0.0, 1.0])
    return [(1 - along**2)[:, None] * up for along in _places(corners).T]


def _bent(seen: list[_Seen], corners: FloatArray) -> list[list[Part]]:
    return [_moved(seen, bend) for bend in _bends(corners)]


def _bent_in_a_frame(seen: list[_Seen], corners: FloatArray) -> list[list[Part]]:
    frames = {view.frame for view in seen}
    return [
        _moved([view for view in seen if view.frame == frame], bend)
        for frame in sorted(frames)
        for bend in _bends(corners)
    ]


def _aspect(seen: list[_Seen], corners: FloatArray) -> list[list[Part]]:
    x, y = _places(corners).T
    zero = 0 * x
    return [_moved(seen, np.stack([x, zero, zero], 1)), _moved(seen, np.stack([zero, y, zero], 1))]


def _each_corner(seen: list[_Seen], corners: FloatArray) -> list[list[Part]]:
    units = np.eye(corners.size).reshape(corners.size, len(corners), 3)
    return [_moved(seen, unit) for unit in units]


def _rows_of_an_image(seen: list[_Seen], corners: FloatArray) -> list[list[Part]]:
    """A shutter that rolls over a board that moves shifts each row by its place in the image."""
    return [
        [(view, (view.pixels[:, 1] - view.pixels[:, 1].mean())[:, None] * axis)]
        for view in seen
        for axis in np.eye(2)
    ]


CAUSES: dict[str, Directions] = {
    "board bent": _bent,
    "board bent anew in each frame": _bent_in_a_frame,
    "board longer one way": _aspect,
    "corners not where stated": _each_corner,
    "rows of an image shifted": _rows_of_an_image,
}

"""How well a calibration predicts views that it has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from experiments.peers.calibrations import PeerCalibration, flat
from experiments.peers.opencv import place_board
from experiments.peers.sightings import frames_of, of_frames
from graphs.boards import corners_of
from graphs.camera import project
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.problem import IntArray
from sfm_calib.boards.views import BoardView, BoardViews

Calibrate = Callable[[BoardViews], PeerCalibration]


@dataclass(frozen=True)
class HeldOut:
    """Lengths of the residuals of all corners, each of a calibration without its frame."""

    lengths_px: FloatArray  # (n,)
    frame: IntArray  # (n,) of each

    @property
    def rms_px(self) -> float:
        return float(np.sqrt((self.lengths_px**2).mean()))

    @property
    def median_px(self) -> float:
        return float(np.median(self.lengths_px))

    def less(self, other: HeldOut) -> tuple[float, float]:
        """Mean square (px^2) of this less another's of the same views, and its standard error.

        Frames are independent, corners of a frame are not.
        """
        frames = np.unique(self.frame)
        squares = [
            [float((each.lengths_px[each.frame == frame] ** 2).mean()) for frame in frames]
            for each in (self, other)
        ]
        change = np.array(squares[0]) - np.array(squares[1])
        return float(change.mean()), float(change.std(ddof=1) / len(frames) ** 0.5)


def held_out(views: BoardViews, corners: FloatArray, calibrate: Calibrate, n_folds: int) -> HeldOut:
    """Residuals of every frame under a calibration of the others, in folds of every n-th frame.

    The board is placed in a frame left out by least squares, at once for all its cameras; its
    bends are the calibration's.
    """
    frames = frames_of(views)
    lengths, owner = [], []
    for fold in range(n_folds):
        out = frames[fold::n_folds]
        found = calibrate(of_frames(views, [frame for frame in frames if frame not in out]))
        board = corners_of(flat(corners), found.shape)[0]
        for frame in out:
            seen = [view for view in views.views if view.frame == frame]
            left = residuals_of_frame(found, seen, board)
            lengths.append(np.linalg.norm(left, axis=1))
            owner.append(np.full(len(left), frame))
    return HeldOut(np.concatenate(lengths), np.concatenate(owner))


def residuals_of_frame(
    found: PeerCalibration, seen: list[BoardView], board: FloatArray
) -> FloatArray:
    """Residuals (n, 2) of all views of a frame, with the board where they are smallest."""
    first = seen[0]
    start = found.cam_from_rig[first.camera].inverse @ place_board(
        found.cameras[first.camera], first, board
    )

    def residuals(move: FloatArray) -> FloatArray:
        turned = exp_rotation(move[:3]) @ start.rotation
        rig_from_board = Transform(turned, start.translation + move[3:])
        parts = []
        for view in seen:
            in_camera = found.cam_from_rig[view.camera] @ (rig_from_board @ board[view.corner])
            parts.append(project(found.cameras[view.camera], in_camera) - view.pixels)
        return np.nan_to_num(np.concatenate(parts), nan=1e3).ravel()

    best = least_squares(residuals, np.zeros(6), method="lm", x_scale="jac", xtol=1e-10)
    result: FloatArray = best.fun.reshape(-1, 2)
    return result

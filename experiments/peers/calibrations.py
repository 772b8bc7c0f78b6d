"""What every peer's calibration is reduced to, and what its corners say of its covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from graphs.boards import N_WHOLE, corners_of
from graphs.camera import Camera, project, project_jacobian
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import FloatArray, Transform, log_rotation, skew
from graphs.problem import Board
from sfm_calib.boards.views import BoardViews

SHAPE_NAMES = ("board.size", "board.bend_x", "board.bend_y")


@dataclass(frozen=True)
class PeerCalibration:
    """Cameras, rig and board as one program sees them, with the sigmas that it states."""

    program: str
    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Transform, ...]  # the first is the identity
    rig_from_board: dict[int, Transform]  # by frame
    shape: FloatArray  # (3,) of the board, as `graphs.boards.corners_of` takes it
    covariance: Covariance
    rms_px: float  # of the distances between seen and projected corners
    n_left_out: int = 0  # corners
    seconds: float = field(default=0.0, compare=False)

    @property
    def values(self) -> dict[str, float]:
        """Every parameter of which a sigma may be stated, by its name in the covariance.

        Of rotations the values are rotation vectors of cam_from_rig in radians.
        """
        found = {
            f"{camera.name}.{name}": value
            for camera in self.cameras
            for name, value in camera.named().items()
        }
        for camera, placed in list(zip(self.cameras, self.cam_from_rig, strict=True))[1:]:
            numbers = [*log_rotation(placed.rotation), *placed.translation]
            found |= {
                f"{camera.name}.{name}": float(number)
                for name, number in zip(POSE_NAMES, numbers, strict=True)
            }
        return found | dict(zip(SHAPE_NAMES, self.shape[: len(SHAPE_NAMES)].tolist(), strict=True))


def flat(corners: FloatArray) -> Board:
    """A board of corners (n, 3) that is as flat and as large as stated."""
    return Board(corners, np.zeros(N_WHOLE), np.zeros(N_WHOLE))


def residuals_of(
    calibration: PeerCalibration, views: BoardViews, corners: FloatArray
) -> list[FloatArray]:
    """Projected minus seen pixels (n, 2) of each view, in a frame that the calibration places."""
    board = corners_of(flat(corners), calibration.shape)[0]
    found = []
    for view in views.views:
        in_rig = calibration.rig_from_board[view.frame] @ board[view.corner]
        in_camera = calibration.cam_from_rig[view.camera] @ in_rig
        found.append(project(calibration.cameras[view.camera], in_camera) - view.pixels)
    return found


def rms(residuals: Sequence[FloatArray]) -> float:
    """Root mean square length of residuals (n, 2) of several views."""
    return float(np.sqrt((np.concatenate(list(residuals)) ** 2).sum(1).mean()))


def gauss_newton_covariance(
    calibration: PeerCalibration,
    views: BoardViews,
    corners: FloatArray,
    free: Sequence[str],
    sigma_px: float | None = None,
) -> Covariance:
    """(J'J)^-1 times the noise, of corners all alike, at a calibration's own optimum.

    free: names of the parameters that were estimated, as `PeerCalibration.values` has them;
    places of boards always were. sigma_px: of a coordinate; estimated from the residuals, less
    the unknowns, where it is not given.
    """
    jacobian, residual = linearised(calibration, views, corners, free)
    if sigma_px is None:
        sigma_px = float(np.sqrt(residual @ residual / (len(residual) - jacobian.shape[1])))
    scale = np.linalg.norm(jacobian, axis=0)
    information = (jacobian / scale).T @ (jacobian / scale)
    whole = np.linalg.inv(information) / np.outer(scale, scale) * sigma_px**2
    n = len(free)
    return Covariance(tuple(free), whole[:n, :n])


def linearised(
    calibration: PeerCalibration, views: BoardViews, corners: FloatArray, free: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Jacobian (n, m) and residuals (n,); columns: `free`, then the places of the frames."""
    column = {name: index for index, name in enumerate(free)}
    frames = sorted({view.frame for view in views.views})
    bent, by_shape = corners_of(flat(corners), calibration.shape)
    rows, residuals = [], []
    for view in views.views:
        camera = calibration.cameras[view.camera]
        cam_from_rig = calibration.cam_from_rig[view.camera]
        rig_from_board = calibration.rig_from_board[view.frame]
        in_rig = rig_from_board @ bent[view.corner]
        in_camera = cam_from_rig @ in_rig
        pixels, by_point, by_params = project_jacobian(camera, in_camera)
        J = np.zeros((len(pixels), 2, len(free) + 6 * len(frames)))

        def put(names: Sequence[str], block: FloatArray, J: FloatArray = J) -> None:
            for name, values in zip(names, np.moveaxis(block, -1, 0), strict=True):
                if name in column:
                    J[:, :, column[name]] = values

        put([f"{camera.name}.{name}" for name in camera.names], by_params)
        by_own = by_point @ _by_turn_and_shift(in_camera - cam_from_rig.translation)
        put([f"{camera.name}.{name}" for name in POSE_NAMES], by_own)
        by_rig_point = by_point @ cam_from_rig.rotation
        start = len(free) + 6 * frames.index(view.frame)
        placed = _by_turn_and_shift(in_rig - rig_from_board.translation)
        J[:, :, start : start + 6] = by_rig_point @ placed
        put(SHAPE_NAMES, by_rig_point @ rig_from_board.rotation @ by_shape[view.corner])
        rows.append(J.reshape(-1, J.shape[-1]))
        residuals.append((pixels - view.pixels).ravel())
    return np.concatenate(rows), np.concatenate(residuals)


def _by_turn_and_shift(turned: FloatArray) -> FloatArray:
    """Derivatives (n, 3, 6) of Exp(w) R x + t by w and by t, for R x (n, 3)."""
    by_turn = np.array([-skew(one) for one in turned])
    shift = np.broadcast_to(np.eye(3), by_turn.shape)
    return np.concatenate([by_turn, shift], axis=2)

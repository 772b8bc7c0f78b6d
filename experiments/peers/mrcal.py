"""mrcal's calibration of a rig from the corners of a board, where mrcal is installed.

mrcal is no package of ours: it comes with the system (Debian's `python3-mrcal`), for the system's
Python, which is asked for one calibration at a time.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.peers.calibrations import (
    SHAPE_NAMES,
    PeerCalibration,
    residuals_of,
    rms,
)
from experiments.peers.sightings import frames_of
from graphs.camera import Camera, image_pixels
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import FloatArray, Transform, exp_rotation, log_rotation
from graphs.image_grid import GRID
from graphs.lenses import LensName
from sfm_calib.boards.spec import Board
from sfm_calib.boards.views import BoardViews

PYTHON = "/usr/bin/python3"  # Debian's own
SCRIPT = Path(__file__).with_name("mrcal_solve.py")
LENS_MODELS: dict[LensName, str] = {
    "pinhole": "LENSMODEL_PINHOLE",
    "radtan": "LENSMODEL_OPENCV4",
    "brown": "LENSMODEL_OPENCV5",
    "rational": "LENSMODEL_OPENCV8",
}
NEAR_BOARDS = 4.0  # of the board's longer side: about 1 m


@dataclass(frozen=True)
class MrcalOptions:
    """As mrcal calls them; by default what its own tool does."""

    bends: bool = True
    reject: bool = True
    regularise: bool = True
    uncertainty: bool = True  # of projection; seconds


@dataclass(frozen=True)
class MrcalCalibration(PeerCalibration):
    """With mrcal's projection uncertainty, rms over the image of each camera (px)."""

    at_infinity_px: tuple[float, ...] = ()
    near_px: tuple[float, ...] = ()  # at NEAR_BOARDS


def why_not() -> str | None:
    """Why mrcal cannot be asked; None where it can."""
    if shutil.which(PYTHON) is None:
        return f"there is no {PYTHON}"
    asked = subprocess.run([PYTHON, "-c", "import mrcal"], capture_output=True, check=False)
    return None if asked.returncode == 0 else "mrcal is not installed: apt install python3-mrcal"


def calibrate(
    views: BoardViews,
    board: Board,
    start: PeerCalibration,
    options: MrcalOptions | None = None,
) -> MrcalCalibration:
    """Cameras, rig and bends from a start that places all frames of the views.

    Sigmas are mrcal's Jacobian's, with the noise of the corners that it kept.
    Raises RuntimeError with mrcal's words when it fails.
    """
    options = options or MrcalOptions()
    begin = time.perf_counter()
    frames = frames_of(views)
    answer = _asked(_question(views, board, start, options))
    cameras = tuple(
        replace(camera, params=np.array(params))
        for camera, params in zip(start.cameras, answer["intrinsics"], strict=True)
    )
    placed = [_transform(row) for row in answer["cam_from_rig"]]
    found = MrcalCalibration(
        "mrcal", cameras, (Transform.identity(), *placed),
        dict(zip(frames, map(_transform, answer["rig_from_board"]), strict=True)),
        np.array([0.0, *answer["bends"]]),
        _covariance(cameras, placed, np.array(answer["covariance"])), 0.0, answer["n_left_out"],
        seconds=time.perf_counter() - begin,
        at_infinity_px=tuple(each["infinity"] for each in answer["uncertainty"]),
        near_px=tuple(each["near"] for each in answer["uncertainty"]),
    )  # fmt: skip
    return replace(found, rms_px=rms(residuals_of(found, views, board.corners_m)))


def _question(
    views: BoardViews, board: Board, start: PeerCalibration, options: MrcalOptions
) -> dict[str, Any]:
    frames = frames_of(views)
    pixels = []
    for view in views.views:
        seen = np.full((board.rows * board.columns, 2), np.nan)
        seen[view.corner] = view.pixels
        pixels.append(seen.reshape(board.rows, board.columns, 2).tolist())
    return {
        "intrinsics": [camera.params.tolist() for camera in start.cameras],
        "cam_from_rig": [_row(placed) for placed in start.cam_from_rig[1:]],
        "rig_from_board": [_row(start.rig_from_board[frame]) for frame in frames],
        "pixels": pixels,
        # The reference camera's place is no variable: -1.
        "indices": [
            [frames.index(view.frame), view.camera, view.camera - 1] for view in views.views
        ],
        "lensmodel": LENS_MODELS[start.cameras[0].lens],
        "sizes": [list(size) for size in views.sizes],
        "square": board.unit_m,
        "grid": image_pixels(views.sizes[0], GRID)[2].tolist(),
        "distance": NEAR_BOARDS * float(np.ptp(board.corners_m, axis=0).max()),
        "bends": options.bends,
        "reject": options.reject,
        "regularise": options.regularise,
        "uncertainty": options.uncertainty,
    }


def _asked(question: dict[str, Any]) -> Any:
    done = subprocess.run(
        [PYTHON, "-I", str(SCRIPT)],  # without the script's folder, whose mrcal.py is this file
        input=json.dumps(question), capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise RuntimeError(f"mrcal failed: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)


def _row(placed: Transform) -> list[float]:
    return [*log_rotation(placed.rotation).tolist(), *placed.translation.tolist()]


def _transform(row: list[float]) -> Transform:
    return Transform(exp_rotation(np.array(row[:3])), np.array(row[3:]))


def _covariance(
    cameras: tuple[Camera, ...], placed: list[Transform], matrix: FloatArray
) -> Covariance:
    """mrcal's covariance with our names: rotation vectors become small turns."""
    names = [f"{camera.name}.{name}" for camera in cameras for name in camera.names]
    jacobian = np.eye(len(matrix))
    for camera, cam_from_rig in zip(cameras[1:], placed, strict=True):
        start = len(names)
        jacobian[start : start + 3, start : start + 3] = _left_jacobian(
            log_rotation(cam_from_rig.rotation)
        )
        names += [f"{camera.name}.{name}" for name in POSE_NAMES]
    names += SHAPE_NAMES[1:][: len(matrix) - len(names)]
    return Covariance(tuple(names), jacobian @ matrix @ jacobian.T)


def _left_jacobian(vector: FloatArray, step: float = 1e-6) -> FloatArray:
    """d log(Exp(vector + v) Exp(-vector)) / dv at zero (3, 3), by differences."""
    columns = [
        log_rotation(exp_rotation(vector + one) @ exp_rotation(vector - one).T) / (2 * step)
        for one in step * np.eye(3)
    ]
    return np.array(columns).T

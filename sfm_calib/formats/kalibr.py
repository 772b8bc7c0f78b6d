"""Kalibr's camchain: a camera an entry, chained by T_cn_cnm1 (this camera from the one before).

Pixel centres are at integers, as in OpenCV, and lengths in metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import CameraRig, image_size, opencv_camera, transform

FORMAT = "Kalibr camchain"
PINHOLE_DISTORTION = {"radtan": False, "equidistant": True, "equi": True, "none": False}

OWN = {"eucm": 2, "ds": 2, "omni": 1}  # intrinsics before the focal lengths


def read_kalibr(path: Path, content: Mapping[str, Any]) -> CameraRig:
    """Raises CalibrationError for a model that no lens here is."""
    entries = {
        str(n): e for n, e in content.items() if isinstance(e, Mapping) and "intrinsics" in e
    }
    try:
        cameras = tuple(_camera(path, name, entry) for name, entry in entries.items())
        rig = _chain(path, entries)
    except (ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise CalibrationError(f"{path} is no whole Kalibr camchain: {error!r}") from error
    notes: tuple[str, ...] = ()
    if not rig and len(cameras) > 1:
        notes += (f"{path} has no T_cn_cnm1: no rig",)
    if any("T_cam_imu" in entry for entry in entries.values()):
        notes += (f"{path}: where the IMU sits, and its time shift, are left out",)
    return CameraRig(path, FORMAT, cameras, rig, "m", notes=notes)


def _camera(path: Path, name: str, entry: Mapping[str, Any]) -> Camera:
    name = str(entry.get("camera_name") or name)
    width, height = entry["resolution"]
    size = image_size(name, width, height)
    model = str(entry["camera_model"])
    distortion = str(entry.get("distortion_model", "none")).lower()
    k = np.array(entry.get("distortion_coeffs") or [], dtype=np.float64)
    numbers = np.array(entry["intrinsics"], dtype=np.float64)
    own, focal = numbers[:-4], numbers[-4:]
    if numbers.size != 4 + OWN.get(model, 0):
        raise CalibrationError(
            f"{path}: {name} is {model} with {numbers.size} intrinsics, not {4 + OWN.get(model, 0)}"
        )
    if model == "pinhole" and distortion in PINHOLE_DISTORTION:
        matrix = np.array([[focal[0], 0, focal[2]], [0, focal[1], focal[3]], [0, 0, 1]])
        k = k if distortion != "none" else np.zeros(0)
        return opencv_camera(name, size, matrix, k, PINHOLE_DISTORTION[distortion])
    if model in ("eucm", "ds", "omni") and (distortion == "none" or not k.any()):
        if model == "eucm":
            return Camera(name, "eucm", size, np.array([*focal, *own]))
        if model == "ds":
            return Camera(name, "double_sphere", size, np.array([*focal, *own]))
        # The unified model: eucm with beta = 1, its focal length counted from the other plane.
        xi = float(own[0])
        both = [*(focal[:2] / (1 + xi)), *focal[2:], xi / (1 + xi), 1.0]
        return Camera(name, "eucm", size, np.array(both))
    raise CalibrationError(
        f"{path}: {name} is {model}-{distortion}, which no lens here is: of Kalibr's there are "
        "pinhole-radtan, pinhole-equi, eucm-none, ds-none and omni-none"
    )


def _chain(path: Path, entries: Mapping[str, Mapping[str, Any]]) -> tuple[Transform, ...] | None:
    """cam_from_rig, the first camera's frame the rig's; by the IMU where there is no chain."""
    whole = list(entries.values())
    if all("T_cn_cnm1" in entry for entry in whole[1:]):
        placed = [Transform.identity()]
        for name, entry in list(entries.items())[1:]:
            placed.append(_matrix(path, name, entry["T_cn_cnm1"]) @ placed[-1])
        return tuple(placed)
    if all("T_cam_imu" in entry for entry in whole):
        return tuple(_matrix(path, name, e["T_cam_imu"]) for name, e in entries.items())
    return None


def _matrix(path: Path, name: str, entry: object) -> Transform:
    matrix: FloatArray = np.asarray(entry, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise CalibrationError(f"{path}: a transform of {name} is no 4 x 4 matrix")
    return transform(f"{path}: {name}", matrix[:3, :3], matrix[:3, 3])

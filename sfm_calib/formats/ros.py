"""ROS's camera_info YAML: one camera a file; of a rectified pair, P tells how the two sit.

X_right_rectified = X_left_rectified + (P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0), in metres, and R
takes a camera's own frame to its rectified one (sensor_msgs/CameraInfo).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphs.frames import FloatArray, Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import CameraRig, image_size, opencv_camera, transform

FORMAT = "ROS camera_info"
FISHEYE = ("equidistant", "fisheye", "kannala_brandt")
KNOWN = ("plumb_bob", "rational_polynomial", "thin_prism", "none", "", *FISHEYE)


def read_ros(path: Path, content: Mapping[str, Any]) -> CameraRig:
    """One camera. Raises CalibrationError where its model is not known."""
    size = image_size(path.name, content["image_width"], content["image_height"])
    model = str(content.get("distortion_model", "")).lower()
    if model not in KNOWN:
        raise CalibrationError(
            f"{path}: distortion_model {model!r} is not known: of ROS's there are "
            f"{', '.join(name for name in KNOWN if name)}"
        )
    distortion = _numbers(path, content.get("distortion_coefficients", {"data": []}))
    camera = opencv_camera(
        str(content.get("camera_name") or path.stem),
        size,
        _matrix(path, content["camera_matrix"], 3, 3),
        distortion if model not in ("none",) else [],
        model in FISHEYE,
    )
    return CameraRig(path, FORMAT, (camera,), None)


def read_ros_pair(paths: tuple[Path, ...], contents: tuple[Mapping[str, Any], ...]) -> CameraRig:
    """The cameras of several files; how two of a rectified pair sit, where R and P say so."""
    reads = [read_ros(path, content) for path, content in zip(paths, contents, strict=True)]
    cameras = tuple(read.cameras[0] for read in reads)
    if len({camera.name for camera in cameras}) < len(cameras):  # drivers call them all "camera"
        cameras = tuple(replace(c, name=p.stem) for c, p in zip(cameras, paths, strict=True))
    rig = None
    if len(contents) == 2 and all(
        "projection_matrix" in c and "rectification_matrix" in c for c in contents
    ):
        rig = _rectified(paths, contents)
    if rig and rig[0].translation.any() and not rig[1].translation.any():
        cameras, rig = cameras[::-1], rig[::-1]  # files come by name; the left one is the first
    return CameraRig(paths[0].parent, FORMAT, cameras, rig, "m" if rig else "unknown")


def _rectified(
    paths: tuple[Path, ...], contents: tuple[Mapping[str, Any], ...]
) -> tuple[Transform, ...] | None:
    """cam_from_rig of two cameras in the frame that their rectified images share; None: no pair."""
    placed = []
    for path, content in zip(paths, contents, strict=True):
        P = _matrix(path, content["projection_matrix"], 3, 4)
        R = transform(path.name, _matrix(path, content["rectification_matrix"], 3, 3), np.zeros(3))
        if not (P[0, 0] > 0 and P[1, 1] > 0):
            return None
        shift = Transform(np.eye(3), np.array([P[0, 3] / P[0, 0], P[1, 3] / P[1, 1], 0.0]))
        placed.append(R.inverse @ shift)
    apart = np.linalg.norm(placed[0].inverse.translation - placed[1].inverse.translation)
    return tuple(placed) if apart > 0 else None


def _matrix(path: Path, entry: object, rows: int, columns: int) -> FloatArray:
    numbers = _numbers(path, entry)
    if numbers.size != rows * columns:
        raise CalibrationError(f"{path}: a matrix has {numbers.size} numbers, not {rows * columns}")
    return numbers.reshape(rows, columns)


def _numbers(path: Path, entry: object) -> FloatArray:
    data = entry.get("data", []) if isinstance(entry, Mapping) else entry
    try:
        return np.asarray(data, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise CalibrationError(f"{path}: a matrix holds something else than numbers") from error

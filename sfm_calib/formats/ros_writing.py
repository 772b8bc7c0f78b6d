"""ROS's camera_info YAML, a camera a file; of two cameras, R and P rectify them as a pair."""

from __future__ import annotations

import cv2
import numpy as np
import yaml

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import (
    Export,
    Format,
    camera_matrix,
    file_names,
    of_camera,
    of_sigmas,
)

MODELS: dict[LensName, str] = {  # sensor_msgs/distortion_models.hpp
    "brown": "plumb_bob",
    "rational": "rational_polynomial",
    "kannala_brandt": "equidistant",
}
HEAD = "# Pixel centres are at integers, as in OpenCV.\n"
HEAD_OF_PAIR = (
    HEAD + "# R and P rectify this camera as one of a pair; P's last column is in metres.\n"
)
NO_PLACES = (
    "camera_info holds no places, but of a stereo pair: export them as urdf, or choose a pair "
    "with --camera"
)
ALL_PIXELS_VALID = 0.0  # ROS's own choice (camera_calibration, set_alpha)
LEAST_AHEAD = (
    0.5  # cosine of a camera's turn to be rectified: beyond 60 degrees, no picture is left
)


def write_ros(rig: CameraRig) -> Export:
    """One file of one camera, else a folder with one of each."""
    cameras, notes, head = rig.cameras, of_sigmas(rig), HEAD
    rectified = [(np.eye(3), np.column_stack([camera_matrix(c), np.zeros(3)])) for c in cameras]
    if len(cameras) == 2 and rig.cam_from_rig is not None:
        places, of_frame = of_camera(rig)
        if not places[1].translation.any():
            notes += ("the two cameras sit in one place: R and P tell of no pair",)
        else:
            rectified, of_pair = _pair(cameras, places[1])
            notes, head = (*of_frame, *of_pair, *notes), HEAD_OF_PAIR
    elif len(cameras) > 1:
        notes += (NO_PLACES,)
    files = [
        (head + _text(camera, R, P)).encode()
        for camera, (R, P) in zip(cameras, rectified, strict=True)
    ]
    if len(files) == 1:
        return Export({"": files[0]}, notes)
    return Export(dict(zip(file_names(rig.names, ".yaml"), files, strict=True)), notes)


def _text(camera: Camera, R: FloatArray, P: FloatArray) -> str:
    entries = {
        "image_width": camera.size[0],
        "image_height": camera.size[1],
        "camera_name": camera.name,
        "camera_matrix": _entry(camera_matrix(camera)),
        "distortion_model": MODELS[camera.lens],
        "distortion_coefficients": _entry(camera.params[None, 4:]),
        "rectification_matrix": _entry(R),
        "projection_matrix": _entry(P),
    }
    return yaml.safe_dump(entries, sort_keys=False, allow_unicode=True, default_flow_style=None)


def _entry(matrix: FloatArray) -> dict[str, object]:
    rows, columns = matrix.shape
    return {"rows": rows, "cols": columns, "data": matrix.ravel().tolist()}


def _pair(
    cameras: tuple[Camera, ...], second_from_first: Transform
) -> tuple[list[tuple[FloatArray, FloatArray]], tuple[str, ...]]:
    """R (3, 3) and P (3, 4) of each of two cameras, as ROS's own calibrator makes them."""
    K1, K2 = (camera_matrix(c) for c in cameras)
    fisheye = [c.lens == "kannala_brandt" for c in cameras]
    d1, d2 = (np.zeros(4) if f else c.params[4:] for c, f in zip(cameras, fisheye, strict=True))
    turn, move = second_from_first.rotation, second_from_first.translation[:, None]
    size = cameras[0].size
    R1, R2, P1, P2 = cv2.stereoRectify(
        K1, d1, K2, d2, size, turn, move, flags=cv2.CALIB_ZERO_DISPARITY, alpha=ALL_PIXELS_VALID
    )[:4]
    if all(fisheye):  # of OpenCV's fisheye module: pixels; how they turn is the same
        R1, R2, P1, P2 = cv2.fisheye.stereoRectify(
            K1, cameras[0].params[4:], K2, cameras[1].params[4:], size, turn, move,
            flags=cv2.CALIB_ZERO_DISPARITY, balance=ALL_PIXELS_VALID,
        )[:4]  # fmt: skip
    notes: tuple[str, ...] = ()
    if not (np.isfinite(P2).all() and P1[0, 0] > 0 and min(R1[2, 2], R2[2, 2]) > LEAST_AHEAD):
        own = float(np.mean([K1[0, 0], K1[1, 1], K2[0, 0], K2[1, 1]]))
        K = np.array([[own, 0, (size[0] - 1) / 2], [0, own, (size[1] - 1) / 2], [0, 0, 1.0]])
        P1, P2 = np.column_stack([K, np.zeros(3)]), np.column_stack([K, K @ R2 @ move])
        notes = ("the two look apart: R and P tell how they sit, but rectify no common picture",)
    if cameras[0].size != cameras[1].size:
        notes += ("their images differ in size: P is that of the first's",)
    return [(R1, P1), (R2, P2)], notes


ROS_FORMAT = Format("ROS camera_info", tuple(MODELS), "two", "", write_ros, metres=True, apart=True)

"""Qualisys' .qca.txt: XML with lenses in 1/64 px and cameras placed in millimetres.

A row of `transform` is an axis of the camera in the world, x right, y up, z backwards; x, y, z is
its centre. Distortion is OpenCV's k1 k2 p1 p2 k3, not scaled: the boards of a scan fit so
(0.42 px), and neither with other signs of k (0.63 px) nor with a 64th of it (0.50 px). The file
counts pixels of the whole sensor, in 1/64 px, from an origin that it does not state; it is taken as
the centre of the first pixel, as Pose2Sim does. Counted from that pixel's corner, cx and cy would
be half a pixel less.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from graphs.camera import Camera
from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import CameraRig, image_size, opencv_camera, transform

FORMAT = "Qualisys qca"
SUBPIXELS = 64.0
M_PER_MM = 1e-3
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])  # y down, z forward
HALF_A_PIXEL = (
    "its pixels are taken to be counted from the centre of the first; from its corner, cx and cy "
    "would be 0.5 px less"
)


def read_qualisys(path: Path, root: ElementTree.Element) -> CameraRig:
    """Raises CalibrationError where an entry is not whole."""
    cameras: list[Camera] = []
    placed: list[Transform] = []
    for entry in root.iterfind("cameras/camera"):
        name = entry.get("serial", f"cam{len(cameras) + 1}")
        try:
            cameras.append(_camera(name, entry))
            placed.append(_cam_from_world(name, entry))
        except (KeyError, ValueError, TypeError) as error:
            raise CalibrationError(f"{path}: {name} is not whole: {error!r}") from error
    if not cameras:
        raise CalibrationError(f"{path} is a Qualisys file without cameras")
    return CameraRig(
        path, FORMAT, tuple(cameras), tuple(placed), "m", notes=(f"{path}: {HALF_A_PIXEL}",)
    )


def _part(entry: ElementTree.Element, name: str) -> dict[str, str]:
    found = entry.find(name)
    if found is None:
        raise KeyError(name)
    return dict(found.attrib)


def _camera(name: str, entry: ElementTree.Element) -> Camera:
    lens = {key: float(value) for key, value in _part(entry, "intrinsic").items()}
    field = entry.find("fov_video")
    edges = {k: float(v) for k, v in (field.attrib if field is not None else {}).items()}
    left, top = edges.get("left", 0.0), edges.get("top", 0.0)
    right = edges.get("right", lens["sensorMaxU"] // SUBPIXELS)
    bottom = edges.get("bottom", lens["sensorMaxV"] // SUBPIXELS)
    fx, fy, cx, cy, skew = (
        lens[key] / SUBPIXELS
        for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
    )
    matrix = np.array([[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]])
    k = [
        lens[f"{kind}Distortion{number}"]
        for kind, number in (
            ("radial", 1), ("radial", 2), ("tangental", 1), ("tangental", 2), ("radial", 3),
        )
    ]  # fmt: skip
    size = image_size(name, round(right - left + 1), round(bottom - top + 1))
    return opencv_camera(name, size, matrix, k)


def _cam_from_world(name: str, entry: ElementTree.Element) -> Transform:
    numbers = {key: float(value) for key, value in _part(entry, "transform").items()}
    axes = np.array([[numbers[f"r{row}{column}"] for column in (1, 2, 3)] for row in (1, 2, 3)])
    centre_m = M_PER_MM * np.array([numbers[axis] for axis in "xyz"])
    rotation = transform(name, OPENCV_AXES @ axes, np.zeros(3)).rotation
    return Transform(rotation, -rotation @ centre_m)

"""OpenCV's FileStorage, in YAML, XML or JSON: one camera, or the two of its stereo sample.

R and T of a stereo file take points of the first camera to the second. The unit of T is that of
the board's squares, which the file does not say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from graphs.frames import FloatArray, Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import NO_SIZE, CameraRig, opencv_camera, transform

FORMAT = "OpenCV FileStorage"
MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M")
DISTORTION = (
    "distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs",
    "distortion", "D",
)  # fmt: skip
MATRIX_OF = ("M{}", "K{}", "cameraMatrix{}", "camera_matrix{}", "camera_matrix_{}")
DISTORTION_OF = ("D{}", "distCoeffs{}", "dist_coeffs{}", "distortion{}", "dist_coeffs_{}")
WIDTH, HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
SIZE = ("image_size", "imageSize", "size")
ROTATION, TRANSLATION = ("R", "rotation"), ("T", "t", "translation")
FISHEYE = ("fisheye_model", "fisheye", "useFisheye")
INTRINSICS, EXTRINSICS = "intrinsics", "extrinsics"  # names of the stereo sample's two files


@dataclass(frozen=True)
class Storage:
    """The top-level entries of a file: matrices, numbers and texts."""

    path: Path
    matrices: dict[str, FloatArray]
    texts: dict[str, str]

    def matrix(self, names: Sequence[str]) -> FloatArray | None:
        """The first of these that is there."""
        return next((self.matrices[name] for name in names if name in self.matrices), None)

    def number(self, names: Sequence[str]) -> float | None:
        found = self.matrix(names)
        return None if found is None or found.size != 1 else float(found.flat[0])


def load_storage(path: Path) -> Storage:
    """Raises CalibrationError where OpenCV cannot read the file."""
    try:
        storage = cv2.FileStorage(
            path.read_text("utf-8", "replace"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
        )
        root = storage.root()
        keys = list(root.keys()) if root.isMap() else []
    except (cv2.error, SystemError) as error:
        said = str(error).strip().splitlines()[-1]
        raise CalibrationError(
            f"{path} is no OpenCV FileStorage that can be read: {said}"
        ) from error
    matrices: dict[str, FloatArray] = {}
    texts: dict[str, str] = {}
    for key in keys:
        node = storage.getNode(key)
        if node.isInt() or node.isReal():
            matrices[key] = np.array([float(node.real())])
        elif node.isString():
            texts[key] = node.string()
        elif node.isSeq():
            numbers = [node.at(i) for i in range(node.size())]
            if all(n.isInt() or n.isReal() for n in numbers):
                matrices[key] = np.array([float(n.real()) for n in numbers])
        else:
            found = node.mat()
            if found is not None:
                matrices[key] = np.asarray(found, dtype=np.float64)
    storage.release()
    return Storage(path, matrices, texts)


def read_file_storage(path: Path) -> CameraRig:
    """One camera, or two with R and T; of the stereo sample's two files, either or their folder.

    Raises CalibrationError where there is no camera matrix.
    """
    storage = load_storage(path)
    if storage.matrix([name.format(1) for name in MATRIX_OF]) is None and (
        EXTRINSICS in path.stem and (beside := _other(path, EXTRINSICS, INTRINSICS))
    ):
        storage = load_storage(beside)
    if (first := storage.matrix([name.format(1) for name in MATRIX_OF])) is not None:
        return _stereo(storage, first)
    matrix = storage.matrix(MATRIX)
    if matrix is None:
        raise CalibrationError(
            f"{path} holds no camera: of camera_matrix, K or M1 and M2 it has none"
        )
    distortion = storage.matrix(DISTORTION)
    model = storage.texts.get("distortion_model", storage.texts.get("camera_model", "")).lower()
    fisheye = bool(storage.number(FISHEYE)) or model in ("fisheye", "equidistant", "kannala_brandt")
    name = storage.texts.get("camera_name", path.stem)
    camera = opencv_camera(
        name, _size(storage), matrix, np.zeros(0) if distortion is None else distortion, fisheye
    )
    notes = () if distortion is not None else (f"{path} states no distortion: taken as none",)
    return CameraRig(path, FORMAT, (camera,), None, notes=notes)


def _other(path: Path, what: str, wanted: str) -> Path | None:
    other = path.with_name(path.name.replace(what, wanted))
    return other if other.is_file() and other != path else None


def _size(storage: Storage) -> tuple[int, int]:
    width, height = storage.number(WIDTH), storage.number(HEIGHT)
    both = storage.matrix(SIZE)
    if both is not None and both.size == 2:
        width, height = float(both.flat[0]), float(both.flat[1])
    return (int(width), int(height)) if width and height else NO_SIZE


def _stereo(storage: Storage, first: FloatArray) -> CameraRig:
    second = storage.matrix([name.format(2) for name in MATRIX_OF])
    if second is None:
        raise CalibrationError(f"{storage.path} has M1 but no M2: give both cameras")
    fisheye = bool(storage.number(FISHEYE))
    cameras = []
    for number, matrix in ((1, first), (2, second)):
        k = storage.matrix([name.format(number) for name in DISTORTION_OF])
        distortion = np.zeros(0) if k is None else k
        cameras.append(opencv_camera(f"cam{number}", _size(storage), matrix, distortion, fisheye))
    place, notes = storage, (f"{storage.path}: T is counted in units that it does not state",)
    if storage.matrix(ROTATION) is None and (
        beside := _other(storage.path, INTRINSICS, EXTRINSICS)
    ):
        place = load_storage(beside)
    R, T = place.matrix(ROTATION), place.matrix(TRANSLATION)
    if R is None or T is None:
        notes = (f"{storage.path} has no R and T, and no {EXTRINSICS} file lies beside it",)
        return CameraRig(storage.path, FORMAT, tuple(cameras), None, notes=notes)
    second_from_first = transform("R, T", R, T)
    rig = (Transform.identity(), second_from_first)
    return CameraRig(storage.path, FORMAT, tuple(cameras), rig, notes=notes)

"""OpenCV's FileStorage, in YAML, XML or JSON: one camera, or the two of its stereo sample.

R and T of a stereo file take points of the first camera to the second. The unit of T is that of
the board's squares, which the file does not say, unless we wrote it. More cameras are as OpenCV's
multi-camera sample has them (samples/python/multiview_calibration.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from graphs.frames import FloatArray, Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import (
    NO_SIZE,
    OPENCV_LENSES,
    CameraRig,
    LengthUnit,
    image_size,
    opencv_camera,
    transform,
)
from sfm_calib.formats.trees import json_tree, text_of, xml_root, yaml_tree

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
# Ours: what OpenCV's own files do not tell.
NAME_OF, UNIT = "camera_name{}", "length_unit"
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


def load_storage(path: Path, text: str | None = None) -> Storage:
    """Its entries that are numbers or texts, without OpenCV, whose parser trusts what it reads.

    Raises CalibrationError where it is no whole FileStorage.
    """
    text = text_of(path) if text is None else text
    start = text.lstrip()
    tree: object
    if start.startswith("<"):
        tree = _of_xml(xml_root(path, start))
    else:  # JSON is YAML too, but for tabs; and OpenCV's JSON of old has numbers like "1."
        tree = yaml_tree(path, text) or json_tree(path, text)
    if not isinstance(tree, Mapping):
        raise CalibrationError(f"{path} is no OpenCV FileStorage that can be read: no entries")
    matrices: dict[str, FloatArray] = {}
    texts: dict[str, str] = {}
    for key, entry in tree.items():
        numbers = entry.get("data") if isinstance(entry, Mapping) else entry
        if isinstance(numbers, str):
            texts[str(key)] = numbers
            numbers = numbers.split()
        try:
            found = np.array(numbers, dtype=np.float64)
        except (TypeError, ValueError):
            continue
        matrices[str(key)] = found.reshape(_shape(entry, found.size))
    return Storage(path, matrices, texts)


def _shape(entry: object, size: int) -> tuple[int, ...]:
    """Rows and columns where a matrix states them and has so many numbers; else a flat one."""
    if isinstance(entry, Mapping):
        rows, columns = str(entry.get("rows", "")), str(entry.get("cols", ""))
        if rows.isdecimal() and columns.isdecimal() and int(rows) * int(columns) == size:
            return int(rows), int(columns)
    return (size,)


def _of_xml(element: ElementTree.Element) -> object:
    children = list(element)
    if not children:
        return (element.text or "").strip().removeprefix('"').removesuffix('"')
    if all(child.tag == "_" for child in children):
        return [_of_xml(child) for child in children]
    return {child.tag: _of_xml(child) for child in children}


def read_file_storage(path: Path, text: str | None = None) -> CameraRig:
    """One camera, or two with R and T; of the stereo sample's two files, either or their folder.

    Raises CalibrationError where there is no camera matrix.
    """
    storage = load_storage(path, text)
    if storage.matrix([name.format(1) for name in MATRIX_OF]) is None and (
        EXTRINSICS in path.stem and (beside := _other(path, EXTRINSICS, INTRINSICS))
    ):
        storage = load_storage(beside)
    if (first := storage.matrix([name.format(1) for name in MATRIX_OF])) is not None:
        return _stereo(storage, first)
    if "Ks" in storage.matrices:
        return _several(storage)
    matrix = storage.matrix(MATRIX)
    if matrix is None:
        raise CalibrationError(
            f"{path} holds no camera: of camera_matrix, K or M1 and M2 it has none"
        )
    distortion = storage.matrix(DISTORTION)
    model = storage.texts.get("distortion_model", storage.texts.get("camera_model", "")).lower()
    fisheye = bool(storage.number(FISHEYE)) or model in ("fisheye", "equidistant", "kannala_brandt")
    name = storage.texts.get("camera_name") or path.stem
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
    if not width or not height:
        return NO_SIZE
    return image_size(f"{storage.path}", width, height)


def _stereo(storage: Storage, first: FloatArray) -> CameraRig:
    second = storage.matrix([name.format(2) for name in MATRIX_OF])
    if second is None:
        raise CalibrationError(f"{storage.path} has M1 but no M2: give both cameras")
    fisheye = bool(storage.number(FISHEYE))
    cameras = []
    for number, matrix in ((1, first), (2, second)):
        k = storage.matrix([name.format(number) for name in DISTORTION_OF])
        distortion = np.zeros(0) if k is None else k
        name = storage.texts.get(NAME_OF.format(number)) or f"cam{number}"
        cameras.append(opencv_camera(name, _size(storage), matrix, distortion, fisheye))
    place = storage
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
    unit, of_unit = _unit(storage, "T is")
    return CameraRig(storage.path, FORMAT, tuple(cameras), rig, unit, notes=of_unit)


def _unit(storage: Storage, what: str) -> tuple[LengthUnit, tuple[str, ...]]:
    stated = storage.texts.get(UNIT, "")
    if stated == "m":
        return "m", ()
    if stated == "baseline":
        return "baseline", ()
    return "unknown", (f"{storage.path}: {what} counted in units that it does not state",)


def _several(storage: Storage) -> CameraRig:
    """As OpenCV's multi-camera sample writes them: all cameras' matrices in one, rvecs and Ts."""
    try:
        Ks = storage.matrices["Ks"].reshape(-1, 3, 3)
        n = len(Ks)
        k = storage.matrices["distortions"].reshape(n, -1)
        sizes = storage.matrices["image_sizes"].reshape(n, 2)
        turns = storage.matrices["rvecs"].reshape(n, 3)
        moves = storage.matrices["Ts"].reshape(n, 3)
        fisheye = storage.matrices.get("is_fisheye", np.zeros(n)).ravel()
        ids = storage.texts.get("cam_ids", "").split(",")
        ids = ids if len(ids) == n else [str(i) for i in range(n)]
        names = [storage.texts.get(NAME_OF.format(i + 1)) or ids[i] for i in range(n)]
        cameras = tuple(
            opencv_camera(
                names[i], image_size(names[i], *sizes[i]), Ks[i],
                _shortest(k[i]) if not fisheye[i] else k[i, :4], bool(fisheye[i]),
            )
            for i in range(n)
        )  # fmt: skip
        rig = tuple(transform(names[i], turns[i], moves[i]) for i in range(n))
    except (KeyError, IndexError, ValueError) as error:
        raise CalibrationError(
            f"{storage.path}: its cameras are not whole (Ks, distortions, image_sizes, rvecs and "
            f"Ts must tell of as many): {error}"
        ) from error
    unit, notes = _unit(storage, "Ts are")
    return CameraRig(storage.path, FORMAT, cameras, rig, unit, notes=notes)


def _shortest(k: FloatArray) -> FloatArray:
    """Distortion coefficients (k,) without zeros that only fill a matrix of several cameras."""
    used = int(np.flatnonzero(k)[-1]) + 1 if k.any() else 4
    return k[: next((n for n in OPENCV_LENSES if n >= max(used, 4)), k.size)]

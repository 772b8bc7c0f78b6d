"""OpenCV's FileStorage, written by OpenCV: one camera, its stereo sample's two, or more.

See `file_storage` for what it says.
"""

from __future__ import annotations

import json
from functools import partial
from typing import Literal
from xml.sax.saxutils import escape

import cv2
import numpy as np

from graphs.camera import Camera
from graphs.frames import Transform, log_rotation
from graphs.lenses import LensName
from sfm_calib.formats.file_storage import NAME_OF, UNIT
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import Export, Format, camera_matrix, of_camera, of_sigmas

Kind = Literal["yaml", "xml", "json"]
KINDS: dict[Kind, int] = {
    "yaml": cv2.FILE_STORAGE_FORMAT_YAML,
    "xml": cv2.FILE_STORAGE_FORMAT_XML,
    "json": cv2.FILE_STORAGE_FORMAT_JSON,
}
LENSES: tuple[LensName, ...] = ("radtan", "brown", "rational", "thin_prism", "kannala_brandt")
FISHEYE = "fisheye_model"
WHERE: dict[int, str] = {
    1: "Pixel centres are at integers.",
    2: "Pixel centres are at integers. R, T take points of camera 1 to camera 2.",
    3: "Pixel centres are at integers. rvecs, Ts take points of the first camera to each.",
}


def write_file_storage(rig: CameraRig, kind: Kind) -> Export:
    """One file whose keys are those of OpenCV's samples, for as many cameras as there are."""
    storage = cv2.FileStorage(
        f"calibration.{kind}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | KINDS[kind]
    )
    cameras, notes = rig.cameras, of_sigmas(rig)
    alike = len({(c.size, c.lens == "kannala_brandt") for c in cameras}) == 1
    layout = min(len(cameras), 3) if alike or len(cameras) == 1 else 3
    if kind != "json":  # which has no comments
        storage.writeComment(WHERE[layout])
    if layout == 1:
        storage.write(NAME_OF.format(""), _text(cameras[0].name, kind))
        _write_lens(storage, cameras[0], "camera_matrix", "distortion_coefficients")
    else:
        places, of_frame = of_camera(rig)
        for number, camera in enumerate(cameras):
            storage.write(NAME_OF.format(number + 1), _text(camera.name, kind))
        storage.write(UNIT, rig.unit)
        notes = (*of_frame, *_unit_note(rig), *notes)
        if layout == 2:
            _write_pair(storage, cameras, places[1])
        else:
            _write_several(storage, cameras, places)
    return Export({"": storage.releaseAndGetString().encode()}, notes)


def _text(text: str, kind: Kind) -> str:
    """Ready for OpenCV, which takes a text between two like quotes for one that is quoted already.

    A single quote begins and ends with it too.
    """
    if text[:1] not in ('"', "'") or text[0] != text[-1]:
        return text
    if kind == "xml":
        return f'"{escape(text, {chr(34): "&quot;", chr(39): "&apos;"})}"'
    return json.dumps(text, ensure_ascii=False)


def _unit_note(rig: CameraRig) -> tuple[str, ...]:
    said = {
        "m": "lengths are in metres",
        "baseline": "lengths are in the longest baseline",
        "unknown": "lengths are in units that are not known",
    }[rig.unit]
    return (f"{said}; {UNIT} says so, which OpenCV itself does not read",)


def _write_lens(storage: cv2.FileStorage, camera: Camera, matrix: str, distortion: str) -> None:
    """What cameras share is written with the first of them."""
    if not matrix.endswith("2"):
        storage.write("image_width", camera.size[0])
        storage.write("image_height", camera.size[1])
        if camera.lens == "kannala_brandt":
            storage.write(FISHEYE, 1)
    storage.write(matrix, camera_matrix(camera))
    storage.write(distortion, camera.params[None, 4:])


def _write_pair(
    storage: cv2.FileStorage, cameras: tuple[Camera, ...], second_from_first: Transform
) -> None:
    for number, camera in enumerate(cameras, 1):
        _write_lens(storage, camera, f"M{number}", f"D{number}")
    storage.write("R", second_from_first.rotation)
    storage.write("T", second_from_first.translation[:, None])


def _write_several(
    storage: cv2.FileStorage, cameras: tuple[Camera, ...], places: tuple[Transform, ...]
) -> None:
    most = max(camera.params.size for camera in cameras) - 4
    distortions = [np.pad(c.params[4:], (0, most - c.params.size + 4)) for c in cameras]
    fisheye = [int(camera.lens == "kannala_brandt") for camera in cameras]
    storage.write("cam_ids", ",".join(camera.name.replace(",", "_") for camera in cameras))
    storage.write("image_sizes", np.array([c.size for c in cameras], dtype=np.int32))
    storage.write("is_fisheye", np.array(fisheye, dtype=np.int32))
    storage.write("Ks", np.array([camera_matrix(camera) for camera in cameras]))
    storage.write("distortions", np.array(distortions))
    storage.write("rvecs", np.array([log_rotation(place.rotation) for place in places]))
    storage.write("Ts", np.array([place.translation for place in places]))


def _format(kind: Kind) -> Format:
    return Format(
        f"OpenCV FileStorage ({kind.upper()})", LENSES, "any", f"calibration.{kind}",
        partial(write_file_storage, kind=kind),
    )  # fmt: skip


OPENCV_FORMATS: dict[Kind, Format] = {kind: _format(kind) for kind in KINDS}

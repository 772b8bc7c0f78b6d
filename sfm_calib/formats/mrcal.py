"""mrcal's .cameramodel: a camera a file, and a folder of them is a rig.

A file is the text of a Python dict. It is parsed as a literal and never run. `extrinsics` is
rt_fromref: a rotation vector in radians and a translation, which take points of a reference frame
that all files share to the camera's (mrcal 2.2, mrcal/cameramodel.py). Pixel centres are at
integers, and the coefficients of its OpenCV lenses are in OpenCV's order.
"""

from __future__ import annotations

import ast
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from graphs.camera import Camera
from graphs.frames import Transform, log_rotation
from graphs.lenses import LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.contents import camera_name, file_name, places, unheld
from sfm_calib.formats.numbers import numbers
from sfm_calib.formats.reading import CameraRig, image_size, opencv_camera, transform
from sfm_calib.formats.writing import Export, Format

FORMAT = "mrcal cameramodel"
SUFFIX = ".cameramodel"
# Characters without the solve. A splined lens of 30 x 20 knots takes 20,000; the worst text of this
# length takes Python's parser 100 MB and 0.3 s, and a few more characters of them a thousand times.
LONGEST = 200_000
# The solve is a compressed archive in base 85, which has neither quotes nor backslashes.
SOLVE = re.compile(r"""['"]optimization_inputs['"]\s*:\s*b(['"])[^'"\\\n]*\1\s*,?""")
LOOKS = re.compile(
    r"""['"](lensmodel|lens_model|distortion_model)['"]\s*:\s*['"](LENSMODEL|DISTORTION)_"""
)
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
COUNT_OF_MODEL = {"PINHOLE": 0, "OPENCV4": 4, "OPENCV5": 5, "OPENCV8": 8, "OPENCV12": 12}
MODEL_OF_LENS: dict[LensName, str] = {
    "pinhole": "PINHOLE",
    "simple_radial": "OPENCV4",
    "radial": "OPENCV4",
    "radtan": "OPENCV4",
    "brown": "OPENCV5",
    "rational": "OPENCV8",
    "thin_prism": "OPENCV12",
}


def looks_like_mrcal(text: str) -> bool:
    """Whether there is an entry of mrcal's lens model in it."""
    return LOOKS.search(text) is not None


def read_mrcal(path: Path, text: str) -> CameraRig:
    """One camera, named as its file is.

    Raises CalibrationError for text that is no literal, and for a lens that none here is.
    """
    content, notes = _literal(path, text)
    name = camera_name(path.name.removesuffix(SUFFIX))
    camera = _camera(path, name, content)
    rt = numbers(f"{path}: extrinsics", content.get("extrinsics"), 6)
    if "valid_intrinsics_region" in content:
        notes += (f"{path}: its valid_intrinsics_region is left out",)
    return CameraRig(path, FORMAT, (camera,), (transform(name, rt[:3], rt[3:]),), notes=notes)


def read_mrcal_files(texts: Mapping[Path, str]) -> CameraRig:
    """The rig of the files of a folder. Raises CalibrationError as `read_mrcal`."""
    reads = [read_mrcal(path, text) for path, text in texts.items()]
    return CameraRig(
        reads[0].path.parent,
        FORMAT,
        tuple(read.cameras[0] for read in reads),
        tuple(place for read in reads for place in places(read)),
        notes=tuple(note for read in reads for note in read.notes),
    )


def _literal(path: Path, text: str) -> tuple[Mapping[str, Any], tuple[str, ...]]:
    rest, solves = SOLVE.subn("", text)
    if len(rest) > LONGEST:
        raise CalibrationError(
            f"{path} is too long for a camera model: {len(rest)} characters beside its "
            f"optimization_inputs, of {LONGEST}"
        )
    try:
        with warnings.catch_warnings():  # of odd escapes: what is meant is the same
            warnings.simplefilter("ignore")
            content = ast.literal_eval(rest.lstrip("\ufeff \t\r\n"))
    except (SyntaxError, ValueError, TypeError, MemoryError, RecursionError) as error:
        raise CalibrationError(
            f"{path} is no mrcal camera model: it is not the literal of a Python dict"
        ) from error
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} is no mrcal camera model: it is no Python dict")
    notes = (f"{path}: its optimization_inputs, and the sigmas they imply, are not read",)
    return content, notes if solves else ()


def _camera(path: Path, name: str, content: Mapping[str, Any]) -> Camera:
    models = (content.get(key) for key in ("lensmodel", "lens_model", "distortion_model"))
    model = str(next((m for m in models if isinstance(m, str)), "?"))[:80]
    kind = model.replace("DISTORTION_", "LENSMODEL_").removeprefix("LENSMODEL_")
    kind = "PINHOLE" if kind == "NONE" else kind  # as mrcal 1 called it
    if kind not in COUNT_OF_MODEL:
        raise CalibrationError(
            f"{path} is {' '.join(model.split())}, which no lens here is: of mrcal's there are "
            f"{', '.join(COUNT_OF_MODEL)}; make one with `mrcal-convert-lensmodel "
            f"LENSMODEL_OPENCV8 {path.name}`"
        )
    values = numbers(f"{path}: intrinsics", content.get("intrinsics"), 4 + COUNT_OF_MODEL[kind])
    sides = numbers(f"{path}: imagersize", content.get("imagersize"), 2)
    fx, fy, cx, cy = values[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return opencv_camera(name, image_size(f"{path}: imagersize", *sides), matrix, values[4:])


def write_mrcal(rig: CameraRig) -> Export:
    """A file a camera, named as the camera is."""
    files = {
        file_name(camera.name) + SUFFIX: _text(camera, place).encode()
        for camera, place in zip(rig.cameras, places(rig), strict=True)
    }
    return Export(files, unheld(rig, "mrcal's cameramodel"))


def _text(camera: Camera, cam_from_rig: Transform) -> str:
    model, named = MODEL_OF_LENS[camera.lens], camera.named()
    names = ("fx", "fy", "cx", "cy", *COEFFICIENTS[: COUNT_OF_MODEL[model]])
    rt = [*log_rotation(cam_from_rig.rotation).tolist(), *cam_from_rig.translation.tolist()]
    return (
        "{\n"
        f"    'lensmodel': 'LENSMODEL_{model}',\n"
        f"    # {' '.join(names)}\n"
        f"    'intrinsics': {[named.get(name, 0.0) for name in names]!r},\n"
        "    # rt_fromref: the camera from the frame that the rig's files share\n"
        f"    'extrinsics': {rt!r},\n"
        f"    'imagersize': {list(camera.size)!r},\n"
        "}\n"
    )


MRCAL = Format(FORMAT, tuple(MODEL_OF_LENS), "any", "", write_mrcal)

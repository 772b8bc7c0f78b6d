"""NeRF's transforms.json, of instant-ngp and nerfstudio: here a frame a camera.

`transform_matrix` is rig_from_camera in OpenGL's axes: x right, y up, z back. Pixels are counted
from the corner of the first, as in COLMAP: nerfstudio shoots the ray of a pixel through its number
plus a half (Cameras.get_image_coords) and takes half a pixel off before it asks OpenCV; instant-ngp
does likewise. nerfstudio reads camera_model at the top alone, and k1 k2 k3 p1 p2, of a fisheye
k1 to k4, of each frame (nerfstudio_dataparser.py).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from graphs.camera import Camera
from graphs.frames import Transform
from graphs.lenses import PARAMETER_NAMES, LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.colmap_model import PIXEL_OFFSET
from sfm_calib.formats.contents import camera_name, file_path, places, unheld
from sfm_calib.formats.numbers import number, numbers
from sfm_calib.formats.reading import CameraRig, image_size, transform
from sfm_calib.formats.writing import Export, Format

FORMAT = "NeRF transforms.json"
NAME = "transforms.json"
OPENGL_AXES = np.diag([1.0, -1.0, -1.0])  # y up, z back
FISHEYE = "OPENCV_FISHEYE"
PERSPECTIVES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
LENSES: tuple[LensName, ...] = ("pinhole", "simple_radial", "radial", "radtan", "brown")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
OWN = ("fl_x", "fl_y", "cx", "cy", "k1")  # of a frame with a lens of its own
NAMES = {"fx": "fl_x", "fy": "fl_y"}


def looks_like_nerf(content: object) -> TypeGuard[Mapping[str, Any]]:
    """Whether it has frames, and a focal length at the top or in the first."""
    frames = content.get("frames") if isinstance(content, Mapping) else None
    return isinstance(frames, list) and any(
        isinstance(frame, Mapping) and "transform_matrix" in frame for frame in frames[:1]
    )


def read_nerf(path: Path, content: Mapping[str, Any]) -> CameraRig:
    """Frames with a lens of their own are cameras of a rig; frames that share one are its images.

    Raises CalibrationError for lenses that are none here and for what is not whole.
    """
    frames = [frame for frame in content["frames"] if isinstance(frame, Mapping)]
    if len(frames) != len(content["frames"]):
        raise CalibrationError(f"{path}: a frame of its list is none")
    if not any(key in frame for frame in frames for key in OWN):
        name = path.stem if path.stem != "transforms" else "camera"
        notes = (f"{path}: its {len(frames)} frames share one lens: they are one camera's images",)
        return CameraRig(path, FORMAT, (_camera(path, name, content),), None, notes=notes)
    names = [_name(frame, number) for number, frame in enumerate(frames)]
    if len(set(names)) < len(names):
        raise CalibrationError(f"{path}: two of its {len(names)} frames have one file_path")
    cameras = [
        _camera(path, name, {**content, **frame}) for name, frame in zip(names, frames, strict=True)
    ]
    placed = [_place(path, n, frame) for n, frame in enumerate(frames)]
    return CameraRig(path, FORMAT, tuple(cameras), tuple(placed))


def _name(frame: Mapping[str, Any], number: int) -> str:
    found = frame.get("file_path")
    return camera_name(found) if isinstance(found, str) and found else f"frame{number}"


def _camera(path: Path, name: str, entry: Mapping[str, Any]) -> Camera:
    values = {
        key: number(f"{path}: {key}", entry[key])
        for key in ("fl_x", "fl_y", "cx", "cy", *COEFFICIENTS)
        if key in entry
    }
    if "fl_x" not in values or "w" not in entry or "h" not in entry:
        raise CalibrationError(f"{path} does not state all of fl_x, w and h: add them")
    size = image_size(f"{path}: w and h", entry["w"], entry["h"])
    found = {
        "fx": values["fl_x"],
        "fy": values.get("fl_y", values["fl_x"]),
        "cx": values.get("cx", size[0] / 2) - PIXEL_OFFSET,
        "cy": values.get("cy", size[1] / 2) - PIXEL_OFFSET,
        **{key: values[key] for key in COEFFICIENTS if key in values},
    }
    if not (found["fx"] > 0 and found["fy"] > 0):
        raise CalibrationError(f"{path}: a focal length is not positive")
    lens = _lens(path, entry, found)
    params = [found.get(name, 0.0) for name in PARAMETER_NAMES[lens]]
    return Camera(name, lens, size, np.array(params))


def _lens(path: Path, entry: Mapping[str, Any], found: Mapping[str, float]) -> LensName:
    """The first lens that has every coefficient which the file states; zeros do not matter."""
    model = entry.get("camera_model", FISHEYE if entry.get("is_fisheye") is True else "OPENCV")
    lenses: tuple[LensName, ...] = ("kannala_brandt",) if model == FISHEYE else LENSES
    if model != FISHEYE and model not in PERSPECTIVES:
        known = ", ".join((*PERSPECTIVES, FISHEYE))
        raise CalibrationError(
            f"{path}: its camera_model is none that a lens here is: there are {known}"
        )
    stated = [key for key in COEFFICIENTS if key in found]
    needed = [key for key in stated if found[key]]
    for keys in (stated, needed):
        for lens in lenses:
            if set(keys) <= set(PARAMETER_NAMES[lens]):
                return lens
    raise CalibrationError(
        f"{path}: no lens here has {' '.join(needed)} as {model} has: give a lens of k1 k2 k3 p1 "
        "p2, or a fisheye of k1 to k4"
    )


def _place(path: Path, frame_number: int, frame: Mapping[str, Any]) -> Transform:
    what = f"{path}: transform_matrix of frame {frame_number}"
    matrix = numbers(what, frame.get("transform_matrix"), -1, 4)
    if len(matrix) not in (3, 4) or (len(matrix) == 4 and matrix[3].tolist() != [0, 0, 0, 1]):
        raise CalibrationError(f"{what} is none: 4 rows, the last 0 0 0 1")
    return transform(what, matrix[:3, :3] @ OPENGL_AXES, matrix[:3, 3]).inverse


def write_nerf(rig: CameraRig) -> Export:
    """One file; nerfstudio takes one camera_model for all of it.

    Raises CalibrationError for a rig of fisheyes and other lenses.
    """
    wide = {camera.lens == "kannala_brandt" for camera in rig.cameras}
    if len(wide) > 1:
        raise CalibrationError(
            f"{rig.path} has fisheyes beside other lenses, and transforms.json has one "
            "camera_model for all frames: write them to two files"
        )
    plain = all(camera.lens == "pinhole" for camera in rig.cameras)
    model = FISHEYE if wide == {True} else "PINHOLE" if plain else "OPENCV"
    content: dict[str, Any] = {
        "camera_model": model,
        "frames": [
            _frame(camera, place) for camera, place in zip(rig.cameras, places(rig), strict=True)
        ],
    }
    if model == FISHEYE:
        content["is_fisheye"] = True  # instant-ngp's name for it
    notes = (
        "file_path of a frame is the camera's name: put an image's path there",
        *(
            [f"{FORMAT}: instant-ngp reads no k3 of a lens that is no fisheye"]
            if any(camera.lens == "brown" for camera in rig.cameras)
            else []
        ),
        *unheld(rig, FORMAT),
    )
    return Export({"": (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()}, notes)


def _frame(camera: Camera, cam_from_rig: Transform) -> dict[str, Any]:
    rig_from_cam = cam_from_rig.inverse
    matrix = np.eye(4)
    matrix[:3, :3] = rig_from_cam.rotation @ OPENGL_AXES
    matrix[:3, 3] = rig_from_cam.translation
    named = camera.named()
    named |= {key: named[key] + PIXEL_OFFSET for key in ("cx", "cy")}
    return {
        "file_path": file_path(camera.name),
        "w": camera.size[0],
        "h": camera.size[1],
        **{NAMES.get(key, key): value for key, value in named.items()},
        "transform_matrix": matrix.tolist(),
    }


NERF = Format(FORMAT, (*LENSES, "kannala_brandt"), "any", NAME, write_nerf)

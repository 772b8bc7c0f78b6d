"""Caliscope's camera_array.toml, and the like of Pose2Sim and anipose: cam_from_world in metres.

Pixel centres are at integers, as in OpenCV; rotation is a matrix or a rotation vector.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from graphs.camera import Camera
from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import CameraRig, image_size, opencv_camera, transform

FORMAT = "Caliscope camera_array"


def cameras_in(content: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The entries that are cameras, by name; empty where there are none."""
    nested = content.get("cameras")
    tables = nested if isinstance(nested, Mapping) else content
    found = {}
    for key, entry in tables.items():
        if isinstance(entry, Mapping) and "matrix" in entry:
            number = entry.get("cam_id", entry.get("port", key))
            name = str(entry.get("name", key if nested is None else f"cam_{number}"))
            found[name] = entry
    return found


def read_caliscope(path: Path, content: Mapping[str, Any]) -> CameraRig:
    """Raises CalibrationError where an entry is not whole."""
    cameras: list[Camera] = []
    placed: list[Transform | None] = []
    for name, entry in cameras_in(content).items():
        try:
            width, height = entry["size"]
            camera = opencv_camera(
                name, image_size(name, width, height), entry["matrix"],
                entry.get("distortions", []), bool(entry.get("fisheye", False)),
            )  # fmt: skip
            whole = "rotation" in entry and "translation" in entry
            placed.append(
                transform(name, entry["rotation"], entry["translation"]) if whole else None
            )
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationError(f"{path}: {name} is not whole: {error!r}") from error
        cameras.append(camera)
    known = [t for t in placed if t is not None]
    rig = tuple(known) if len(known) == len(cameras) else None
    notes = () if rig else (f"{path} does not say how all its cameras sit: no rig",)
    return CameraRig(path, FORMAT, tuple(cameras), rig, "m", notes=notes)

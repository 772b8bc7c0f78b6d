"""COLMAP's rig_config.json: a rig's cameras by the prefix of their images' names.

What `colmap rig_configurator` reads (src/colmap/scene/rig.cc): quaternions wxyz, no image sizes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from graphs.camera import Camera
from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.colmap_model import model_camera, read_colmap
from sfm_calib.formats.contents import LONGEST_NAME
from sfm_calib.formats.numbers import numbers
from sfm_calib.formats.reading import NO_SIZE, CameraRig
from sfm_calib.formats.trees import json_tree, text_of

FORMAT = "COLMAP rig_config.json"
NAME = "rig_config.json"


def looks_like_rig_config(content: object) -> TypeGuard[list[Any]]:
    """Whether it is a list that starts with a rig."""
    return isinstance(content, list) and any(
        isinstance(rig, Mapping) and "cameras" in rig for rig in content[:1]
    )


def read_rig_config(path: Path, content: list[Any]) -> CameraRig:
    """The cameras of the one rig of a list that `looks_like_rig_config`.

    Raises CalibrationError for several rigs, and for one that is not whole.
    """
    if len(content) != 1:
        raise CalibrationError(f"{path} holds {len(content)} rigs: give a file of one")
    entries = content[0]["cameras"]
    if (
        not isinstance(entries, list)
        or not entries
        or not all(
            isinstance(entry, Mapping) and isinstance(entry.get("image_prefix"), str)
            for entry in entries
        )
    ):
        raise CalibrationError(f"{path}: its rig has no list of cameras with an image_prefix each")
    names = [entry["image_prefix"].removesuffix("/") for entry in entries]
    if any(len(name) > LONGEST_NAME for name in names):
        raise CalibrationError(f"{path}: an image_prefix is longer than {LONGEST_NAME} characters")
    if len(set(names)) < len(names):
        raise CalibrationError(f"{path}: two of its {len(names)} cameras have one image_prefix")
    pairs = list(zip(names, entries, strict=True))
    cameras = tuple(_camera(path, name, entry) for name, entry in pairs)
    placed = [_place(path, name, entry) for name, entry in pairs]
    known = tuple(place for place in placed if place is not None)
    if len(known) == len(cameras):
        return CameraRig(path, FORMAT, cameras, known)
    notes = (f"{path} does not say how all its cameras sit: no rig",)
    return CameraRig(path, FORMAT, cameras, None, notes=notes)


def _camera(path: Path, name: str, entry: Mapping[str, Any]) -> Camera:
    model, params = entry.get("camera_model_name"), entry.get("camera_params")
    if not isinstance(model, str) or params is None:
        raise CalibrationError(
            f"{path} has no camera_model_name and camera_params of {name}: give the model's folder"
        )
    values = numbers(f"{path}: camera_params of {name}", params, -1).tolist()
    return model_camera(path, name, model, NO_SIZE, values)


def _place(path: Path, name: str, entry: Mapping[str, Any]) -> Transform | None:
    if entry.get("ref_sensor") in (True, "true"):
        return Transform.identity()
    wxyz, xyz = (entry.get(f"cam_from_rig_{part}") for part in ("rotation", "translation"))
    if wxyz is None or xyz is None:
        return None
    try:
        return Transform.from_wxyz(
            numbers(f"{path}: cam_from_rig_rotation of {name}", wxyz, 4).tolist(),
            numbers(f"{path}: cam_from_rig_translation of {name}", xyz, 3).tolist(),
        )
    except ValueError as error:
        raise CalibrationError(f"{path}: {name}: {error}") from error


def read_colmap_folder(folder: Path) -> CameraRig:
    """A model; its cameras have the names of the rig_config.json beside it where that is its own.

    It is where it holds the same lenses in the same order: COLMAP's models have no names.
    """
    rig = read_colmap(folder)
    path = folder / NAME
    if not path.is_file():
        return rig
    try:
        content = json_tree(path, text_of(path))
        stated = read_rig_config(path, content) if looks_like_rig_config(content) else None
    except (CalibrationError, ValueError):
        stated = None
    if stated is None or not _same(stated.cameras, rig.cameras):
        note = f"{path} is of other lenses: the cameras are called by their numbers"
        return replace(rig, notes=(*rig.notes, note))
    named = (replace(c, name=s.name) for c, s in zip(rig.cameras, stated.cameras, strict=True))
    return replace(rig, cameras=tuple(named))


def _same(a: tuple[Camera, ...], b: tuple[Camera, ...]) -> bool:
    return len(a) == len(b) and all(
        one.lens == other.lens and np.array_equal(one.params, other.params)
        for one, other in zip(a, b, strict=True)
    )

"""How a calibration goes into another program's files: what each format holds, and its writer."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from sfm_calib.formats.reading import CameraRig


@dataclass(frozen=True)
class Export:
    """The files of one calibration in one format."""

    files: dict[str, bytes]  # by path inside the folder OUT; of one file, under the name ""
    notes: tuple[str, ...] = ()  # what had to be converted, and what could not be held


@dataclass(frozen=True)
class Format:
    """What a format holds, and who writes it.

    `write` gets a rig whose lenses are all among `lenses`, whose image sizes are known, and which
    has places (`cam_from_rig`) where `cameras` is not "one". What of it the format cannot hold,
    such as covariances, it tells in the notes of its Export.
    """

    title: str  # in words
    lenses: tuple[LensName, ...]
    cameras: Literal["one", "two", "any"]  # in one file or folder, with how they sit
    name: str  # of the file, or "" where OUT is a folder
    write: Callable[[CameraRig], Export]
    metres: bool = False  # its lengths are in metres by definition: another unit would be wrong
    # More cameras than `cameras` go into a file each, without how they sit: then it may be None.
    apart: bool = False


def of_camera(rig: CameraRig, reference: int = 0) -> tuple[tuple[Transform, ...], tuple[str, ...]]:
    """How each camera sits from one of them, and a note where the file had a frame of its own."""
    assert rig.cam_from_rig is not None
    rig_from_reference = rig.cam_from_rig[reference].inverse
    places = [place @ rig_from_reference for place in rig.cam_from_rig]
    places[reference] = Transform.identity()  # exactly
    if rig.referenced()[0] is rig:
        return tuple(places), ()
    return tuple(places), (
        f"the file's own frame is not held: places are counted from {rig.names[reference]}",
    )


def camera_matrix(camera: Camera) -> FloatArray:
    """K (3, 3) of a lens, as OpenCV and ROS write it."""
    fx, fy, cx, cy = camera.params[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def of_sigmas(rig: CameraRig) -> tuple[str, ...]:
    """The note of a format without sigmas, where there are any."""
    return ("sigmas and covariance are not held",) if rig.states_sigmas else ()


def file_names(names: tuple[str, ...], suffix: str) -> tuple[str, ...]:
    """A file for each camera: its name without what a path or a shell reads into it."""
    stems: list[str] = []
    for name in names:
        stem = plain = re.sub(r"[^\w.+-]", "_", name).lstrip(".-") or "camera"
        number = 1
        while stem.lower() in (s.lower() for s in stems):
            number += 1
            stem = f"{plain}_{number}"
        stems.append(stem)
    return tuple(f"{stem}{suffix}" for stem in stems)

"""How a calibration goes into another program's files: what each format holds, and its writer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

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

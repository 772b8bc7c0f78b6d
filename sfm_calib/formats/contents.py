"""What of a rig goes into another program's files, and in words what does not."""

from __future__ import annotations

import re
from urllib.parse import quote, unquote

from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import of_sigmas

LONGEST_NAME = 200  # bytes of a file's name without its suffix; file systems hold 255
UNITS = {
    "m": "metres",
    "baseline": "lengths of the longest baseline, not metres",
    "unknown": "in a unit that it does not state",
}


def places(rig: CameraRig) -> tuple[Transform, ...]:
    """cam_from_rig of every camera; of a lone one the identity where it has none.

    Raises CalibrationError where the rig does not say how its cameras sit.
    """
    if rig.cam_from_rig is not None:
        return rig.cam_from_rig
    if len(rig.cameras) == 1:
        return (Transform.identity(),)
    raise CalibrationError(
        f"{rig.path} does not say how its {len(rig.cameras)} cameras sit: give a file that holds "
        "the rig too, or its cameras one by one"
    )


def unheld(rig: CameraRig, format_name: str) -> tuple[str, ...]:
    """What every format here leaves out: sigmas, and the unit of length."""
    notes = of_sigmas(rig)
    if len(rig.cameras) > 1:
        notes += (f"{format_name} does not say its unit of length: here {UNITS[rig.unit]}",)
    return notes


def file_name(name: str) -> str:
    """A camera's name as a file's, the same everywhere and inside its folder; see `camera_name`.

    All but ASCII letters, digits, spaces and _.-~ are percent-encoded, and dots in front.
    Raises CalibrationError for no name and for one that is too long.
    """
    coded = quote(name, safe=" ", errors="surrogatepass")
    coded = re.sub(r"^\.+", lambda dots: "%2E" * len(dots[0]), coded)
    if not coded or len(coded) > LONGEST_NAME:
        raise CalibrationError(
            f"a camera's name of {len(name)} characters can be no file's name: rename it"
        )
    return coded


def file_path(name: str) -> str:
    """A camera's name as a relative path: as it is where it is one, else as one file's name."""
    parts = name.split("/")
    return "/".join(map(file_name, parts)) if all(parts) else file_name(name)


def camera_name(file: str) -> str:
    """The name of which `file_name` or `file_path` made this."""
    return unquote(file, errors="surrogatepass")

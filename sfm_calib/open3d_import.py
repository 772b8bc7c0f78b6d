"""Open3D, which is an extra: imported where it is needed, and missed in one line."""

from __future__ import annotations

from typing import Any

import numba

from sfm_calib.errors import CalibrationError

OPEN3D_REMEDY = (
    "needs open3d: pip install 'sfm_calib[depth]'; "
    "on Debian/Ubuntu also apt-get install libusb-1.0-0 libgl1 libgomp1"
)


def import_open3d(purpose: str = "simulating images") -> Any:
    """The open3d module. Raises CalibrationError when it, or a library it needs, is missing.

    purpose: what cannot be done without, as the message begins.
    """
    # Numba chooses its threads now: Open3D loads a TBB too old for it, and numba would say so.
    numba.get_num_threads()
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: a system library is missing
        cause = str(error).splitlines()[0]
        raise CalibrationError(f"{purpose} {OPEN3D_REMEDY} ({cause})") from error
    return open3d

"""KITTI's calib.txt: a 3 x 4 projection matrix a line, of rectified cameras; or one 3 x 3 matrix.

P = K [I | t] in metres, pixel centres at integers, no distortion. The image size is not stated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import MOST_NUMBER, NO_SIZE, CameraRig, opencv_camera

FORMAT = "KITTI projection matrices"
PLAIN = "camera matrix"
CAMERAS = ("P", "P_rect_")  # what entries of KITTI's files with labels are called, before a number


def matrix_rows(text: str) -> dict[str, list[float]]:
    """Lines of numbers by their label, or their number where they have none; empty: no such file.

    Lines with a label whose rest is not of numbers are left out: KITTI dates its files.
    """
    found: dict[str, list[float]] = {}
    for line in text.splitlines():
        label, colon, rest = line.rpartition(":")
        try:
            numbers = [float(word) for word in (rest if colon else line).split()]
        except ValueError:
            if not colon:
                return {}
            continue
        if numbers:
            found[label.strip() or f"cam{len(found)}"] = numbers
    return found


def looks_like_matrices(text: str) -> bool:
    """Whether there are projection matrices in it, or one camera matrix."""
    rows = matrix_rows(text)
    return _is_plain(rows) or any(len(row) == 12 for row in rows.values())


def _is_plain(rows: dict[str, list[float]]) -> bool:
    return [len(row) for row in rows.values()] == [3, 3, 3]


def read_matrices(path: Path, text: str) -> CameraRig:
    """Raises CalibrationError for a projection matrix that is not of a rectified camera."""
    rows = matrix_rows(text)
    if _is_plain(rows):
        camera = opencv_camera(path.stem, NO_SIZE, list(rows.values()), [])
        return CameraRig(path, PLAIN, (camera,), None)
    labelled = {name: row for name, row in rows.items() if name.startswith(CAMERAS)}
    cameras, placed = [], []
    for name, row in (labelled or rows).items():
        if len(row) != 12:
            continue
        P = np.reshape(row, (3, 4))
        off = np.abs(P[[1, 2, 2], [0, 0, 1]]).max()
        if not (np.abs(P) < MOST_NUMBER).all() or off > 1e-9 or not (P[0, 0] > 0 and P[2, 2] > 0):
            raise CalibrationError(
                f"{path}: {name} is no projection matrix of a rectified camera, K [I | t]"
            )
        P = P / P[2, 2]
        cameras.append(opencv_camera(name, NO_SIZE, P[:, :3], []))
        placed.append(Transform(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3])))
    rig = tuple(placed) if len(placed) > 1 else None
    return CameraRig(path, FORMAT, tuple(cameras), rig, "m")

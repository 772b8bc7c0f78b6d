"""Our own calibration.json and truth.json."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graphs.covariance import NOTHING, Covariance
from graphs.propagation import marginal
from sfm_calib.formats.reading import CameraRig, LengthUnit
from sfm_calib.result import Calibration, load_calibration
from sfm_calib.uncertainty import unit_of


def read_ours(path: Path) -> CameraRig:
    """A calibration.json with its joint covariance; a truth.json has none."""
    return rig_of(load_calibration(path), path)


def rig_of(calibration: Calibration, path: Path) -> CameraRig:
    """A result as if it had been read from a file."""
    names = tuple(calibration.cameras)
    stated = Covariance(calibration.covariance.names, np.array(calibration.covariance.matrix))
    known = [name for name in stated.names if name.rpartition(".")[0] in names]
    unit: LengthUnit = unit_of(calibration) or "unknown"
    return CameraRig(
        path,
        f"{calibration.format}",
        tuple(calibration.camera(name) for name in names),
        tuple(calibration.cam_from_rig(name) for name in names),
        unit,
        marginal(stated, known) if known else NOTHING,
        n_frames=calibration.solve.n_frames if calibration.solve else None,
    )

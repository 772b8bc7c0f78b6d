"""Our own calibration.json from a calibration of any origin."""

from __future__ import annotations

import sfm_calib
from graphs.lenses import LENS_NAMES
from sfm_calib.files import sha256
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import Export, Format, of_camera
from sfm_calib.provenance import Provenance


def write_ours(rig: CameraRig) -> Export:
    """With sigmas and covariance where the rig states them, and the hash of what it came from."""
    hashes = {rig.path.name: sha256(rig.path)} if rig.path.is_file() else {}
    provenance = Provenance(version=sfm_calib.__version__, input_hashes=hashes)
    made = rig.calibration().model_copy(update={"provenance": provenance})
    notes = of_camera(rig)[1]
    if len(rig.cameras) > 1 and rig.unit != "m":
        notes += ("lengths are not in metres: metric is false (--metres says what their unit is)",)
    if rig.format.startswith("sfm_calib"):
        notes += ("of a calibration.json, cameras, rig and covariance alone are carried over",)
    return Export({"": f"{made.model_dump_json(indent=1)}\n".encode()}, notes)


OURS_FORMAT = Format("sfm_calib/1", LENS_NAMES, "any", "calibration.json", write_ours)

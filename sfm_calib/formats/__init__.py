"""Calibrations of any origin: files of other programs, read into one form and written."""

from sfm_calib.formats.detect import read_calibration
from sfm_calib.formats.reading import NO_SIZE, CameraRig, LengthUnit

__all__ = ["NO_SIZE", "CameraRig", "LengthUnit", "read_calibration"]

"""Calibrations of any origin: files of other programs read into one form."""

from sfm_calib.formats.detect import read_calibration
from sfm_calib.formats.reading import NO_SIZE, LengthUnit, Read

__all__ = ["NO_SIZE", "LengthUnit", "Read", "read_calibration"]

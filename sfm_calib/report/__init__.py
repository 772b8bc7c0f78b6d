"""The report: one self-contained HTML page about a calibration."""

from sfm_calib.report.page import write_report
from sfm_calib.report.rows import TruthRow

__all__ = ["TruthRow", "write_report"]

"""Everything a finished calibration knows of itself, for what is said of it."""

from __future__ import annotations

from dataclasses import dataclass

from graphs.ladder import Ladder
from graphs.problem import Problem
from graphs.refine import Refinement
from graphs.scale_ledger import NO_SOURCES, ScaleLedger
from graphs.split_check import SplitCheck
from graphs.stated_covariance import CalibrationCovariance
from graphs.twin import Certificate
from sfm_calib.board_use import BoardUse
from sfm_calib.config import RigConfig
from sfm_calib.images import Scan
from sfm_calib.mapping import Mapped


@dataclass(frozen=True)
class Given:
    """What a calibration starts from, for what is said of it."""

    scan: Scan
    config: RigConfig
    mapped: Mapped
    command: str
    board: BoardUse | None = None
    scan_alone: Problem | None = None  # without the board that joined it


@dataclass(frozen=True)
class Run:
    """Everything a finished calibration knows of itself."""

    scan: Scan
    config: RigConfig
    mapped: Mapped
    refinement: Refinement
    covariance: CalibrationCovariance
    seconds: dict[str, float]
    command: str
    ladder: Ladder | None = None
    split: SplitCheck | None = None
    certificate: Certificate | None = None
    board: BoardUse | None = None
    ledger: ScaleLedger = NO_SOURCES

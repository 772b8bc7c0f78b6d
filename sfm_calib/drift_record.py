"""`drift` in a result: whether the old calibration holds. Differences are new less old."""

from __future__ import annotations

from typing import Final, Literal

from graphs.drift import Verdict
from graphs.drift_tests import Tested
from sfm_calib.compare_record import PairDifference
from sfm_calib.record import Record

FORMAT: Final = "sfm_calib/drift/1"


class DriftChange(Record):
    """One parameter of a group."""

    name: str
    unit: Literal["px", "deg", "m", "baseline", ""]
    change: float
    sigma: float  # by both calibrations, nothing allowed beside it


class DriftTest(Record):
    """One group of one camera. Effects are rms in px over its image."""

    cameras: tuple[str, ...]  # a pair: it cannot be told which of the two; all: the whole rig
    group: Tested
    changes: tuple[DriftChange, ...]
    chi2: float | None  # None: infinite, what was exactly known changed
    dof: int
    nu: float | None = None  # degrees of freedom of the covariance itself; None: it is known
    p_value: float
    p_corrected: float  # Holm's, of all tests
    effect_px: float
    expected_px: float  # by chance, and what is allowed beside it
    detectable_px: float  # an effect that is found wherever it is, with DriftRecord.power
    found: bool
    decisive: bool  # has to be able to find what matters, for the old one to be kept


class DriftRecord(Record):
    """Whether an old calibration still holds, by a new one."""

    format: Literal["sfm_calib/drift/1"] = FORMAT
    verdict: Verdict
    lines: tuple[str, ...]  # the verdict in words, the main line first
    cameras: tuple[str, ...]
    unit: Literal["m", "baseline"]
    tests: tuple[DriftTest, ...]
    drifted: tuple[str, ...]  # cameras that changed, where it can be told
    moved: tuple[tuple[str, ...], ...]  # sets whose moving explains it; several: or, or
    told_by_lens: bool
    detectable_px: float  # the smallest drift that is found wherever it is
    scale_free: bool  # the size of the rig was not judged
    systematic_px: float
    matters_px: float
    alpha: float
    power: float
    range: float  # of points, at which a moved centre is judged
    old_sigma_px: float | None  # assumed of the old calibration; None: it states its own
    pairs: tuple[PairDifference, ...] = ()  # A: old, B: new
    notes: tuple[str, ...] = ()

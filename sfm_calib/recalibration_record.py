"""The result's `recalibration`: what became of an old calibration."""

from __future__ import annotations

from pydantic import Field, model_validator

from graphs.problem import PriorMode
from sfm_calib.drift_record import DriftRecord
from sfm_calib.provenance import Replaced
from sfm_calib.record import Record


class OldFile(Replaced):
    """The calibration that it started from."""

    format: str  # in words


class Contribution(Record):
    """One parameter, named and counted as in the covariance: what OLD said, and what came out."""

    old: float
    sigma_old: float | None  # None: OLD states none, and none was assumed
    new_alone: float | None = None  # of the scan without OLD; None: not solved for
    result: float
    sigma: float  # 0: held
    prior_share: float  # var_posterior / var_prior: 1 OLD alone, 0 the scan alone


class Recalibration(Record):
    """From which calibration, how far it was believed, and what it contributed."""

    old: OldFile
    prior: PriorMode  # OLD as the start alone, a weak belief, or with all that it states
    freed: tuple[str, ...]  # what was estimated anew, in words
    kept: tuple[str, ...] = ()  # cameras that the scan lacks: OLD's values, untouched
    added: tuple[str, ...] = ()  # cameras that OLD lacks
    contributions: dict[str, Contribution] = Field(default_factory=dict)  # by parameter
    drift: DriftRecord | None = None  # None: not tested

    @model_validator(mode="after")
    def _no_camera_is_both_kept_and_added(self) -> Recalibration:
        if both := set(self.kept) & set(self.added):
            raise ValueError(f"{', '.join(sorted(both))} cannot be both kept and added")
        return self

"""Does the old calibration still hold? The drift test with its options, and its record."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import tyro

from graphs.compare import Stated
from graphs.covariance import NOTHING, Covariance
from graphs.drift import Drift, Verdict, drift
from graphs.drift_picture import Group, assumed_covariance
from graphs.drift_tests import Criteria, GroupDrift
from graphs.pose_covariance import rereferenced
from sfm_calib.compare import IN_PX, pair_difference
from sfm_calib.drift_record import DriftChange, DriftRecord, DriftTest
from sfm_calib.drift_verdict import verdict_lines
from sfm_calib.errors import CalibrationError

# For scripts and fleets (`--exit-code`). Not 1, which is a crash, nor 2, which is bad input.
EXIT_STATUS: dict[Verdict, int] = {"keep": 0, "replace": 3, "inconclusive": 4}
Unit = Literal["m", "baseline"]
# Two metres before a rig whose cameras sit 5 cm to half a metre apart.
RANGE: dict[Unit, float] = {"m": Criteria.range, "baseline": 10.0}


@dataclass(frozen=True)
class DriftOptions:
    """By what it is judged whether the old calibration still holds."""

    systematic_px: Annotated[float, tyro.conf.arg(metavar="PX")] = Criteria.systematic_px
    """Difference in the picture, rms, that two good calibrations of an untouched rig may have
    beside their sigmas."""
    matters_px: Annotated[float, tyro.conf.arg(metavar="PX")] = Criteria.matters_px
    """The old calibration is kept only if a drift of so much would have been found."""
    alpha: Annotated[float, tyro.conf.arg(metavar="P")] = Criteria.alpha
    """Chance of finding drift where there is none, in all tests together."""
    old_sigma_px: Annotated[float, tyro.conf.arg(metavar="PX")] = 0.2
    """What an old calibration without a covariance is taken to be right to in the picture, rms."""
    drift_range: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Range at which a moved camera is judged in px; default: 2 m, or 10 baselines without a
    scale."""
    depth_ranges: Annotated[tuple[float, ...], tyro.conf.arg(metavar="M")] = Criteria.depth_ranges
    """Ranges of the depths that are compared."""

    def __post_init__(self) -> None:
        for name in ("matters_px", "old_sigma_px", "drift_range"):
            value = getattr(self, name)
            if value is not None:
                _check(name, value, 0 < value < np.inf, "positive")
        _check("systematic_px", self.systematic_px, 0 <= self.systematic_px < np.inf, "0 or more")
        _check("alpha", self.alpha, 0 < self.alpha < 0.5, "between 0 and 0.5")
        for one in self.depth_ranges:
            _check("depth_ranges", one, 0 < one < np.inf, "positive")

    def criteria(self, unit: Unit) -> Criteria:
        """For calibrations in a unit of length."""
        return Criteria(
            self.systematic_px, self.matters_px, self.alpha,
            range=self.range(unit), depth_ranges=self.depth_ranges,
        )  # fmt: skip

    def range(self, unit: Unit) -> float:
        """At which a change of place is judged."""
        return self.drift_range or RANGE[unit]


def _check(name: str, value: float, right: bool, what: str) -> None:
    if not right:
        raise CalibrationError(f"--{name.replace('_', '-')} {value:g}: it must be {what}")


@dataclass(frozen=True)
class Judged:
    """The record, and the numbers that it was made from."""

    record: DriftRecord
    found: Drift


def judge(
    old: Stated,
    new: Stated,
    unit: Unit,
    options: DriftOptions | None = None,
    *,
    scale_free: bool = False,
    tested: Collection[tuple[str, Group]] | None = None,
    cov_difference: Covariance | None = None,
    n_frames: int | None = None,
    n_frames_old: int | None = None,
    leaning: Mapping[tuple[str, Group], float] | None = None,
    notes: Sequence[str] = (),
) -> Judged:
    """Hold a new calibration against an old one of the same cameras, lenses and unit of length.

    As `graphs.drift.drift`. An old one that names no covariance is given `old_sigma_px`.
    """
    options = options or DriftOptions()
    assumed = not old.covariance.names and cov_difference is None
    if assumed:
        in_first = rereferenced(old.estimate, NOTHING, 0)[0]
        covariance = assumed_covariance(in_first, options.old_sigma_px, options.range(unit))
        old = Stated(in_first, covariance)
    found = drift(
        old, new, options.criteria(unit),
        scale_free=scale_free, tested=tested, cov_difference=cov_difference, n_frames=n_frames,
        n_frames_old=n_frames_old, leaning=leaning,
    )  # fmt: skip
    said = list(notes)
    if assumed:
        said.append(
            f"the old calibration states no covariance: it is taken to be right to "
            f"{options.old_sigma_px:g} px (rms) in the picture (--old-sigma-px)"
        )
    if scale_free and len(old.estimate.cameras) > 1:
        size = "the baseline's length" if len(old.estimate.cameras) == 2 else "the rig's size"
        said.append(f"the two have no metric scale in common: {size} is not judged")
    record = _record(found, unit, options.old_sigma_px if assumed else None, tuple(said))
    of_old = (
        found.verdict == "inconclusive"
        and not cov_difference
        and _of_old(found, tested, n_frames, leaning)
    )
    lines = tuple(verdict_lines(record, of_old))
    return Judged(record.model_copy(update={"lines": lines}), found)


def _of_old(
    found: Drift,
    tested: Collection[tuple[str, Group]] | None,
    n_frames: int | None,
    leaning: Mapping[tuple[str, Group], float] | None,
) -> bool:
    """Whether this scan would do, were the old calibration exact."""
    exact = Stated(found.old.estimate, NOTHING)
    criteria = replace(found.criteria, depth_ranges=())
    return not drift(
        exact, found.new, criteria,
        scale_free=found.scale_free, tested=tested, n_frames=n_frames, leaning=leaning,
    ).unresolved  # fmt: skip


def _record(
    found: Drift, unit: Unit, old_sigma_px: float | None, notes: tuple[str, ...]
) -> DriftRecord:
    names = tuple(camera.name for camera in found.old.estimate.cameras)
    criteria = found.criteria
    two = len(names) == 2
    return DriftRecord(
        verdict=found.verdict,
        lines=(),
        cameras=names,
        unit=unit,
        tests=tuple(
            _test(found, test, unit)
            for test in sorted(found.tests, key=lambda test: (len(test.cameras), test.cameras))
        ),
        drifted=tuple(names[camera] for camera in found.drifted),
        moved=tuple(tuple(names[camera] for camera in one) for one in found.moved),
        told_by_lens=found.by_lens,
        detectable_px=found.detectable_px,
        scale_free=found.scale_free,
        systematic_px=criteria.systematic_px,
        matters_px=criteria.matters_px,
        alpha=criteria.alpha,
        power=criteria.power,
        range=criteria.range,
        old_sigma_px=old_sigma_px,
        pairs=tuple(
            pair_difference(
                (names[pair.cameras[0]], names[pair.cameras[1]]),
                pair.place,
                pair.depth,
                scaled=found.scale_free and two,
            )
            for pair in found.pairs
        ),
        notes=notes,
    )


def _test(found: Drift, test: GroupDrift, unit: Unit) -> DriftTest:
    return DriftTest(
        cameras=tuple(found.old.estimate.cameras[camera].name for camera in test.cameras),
        group=test.group,
        changes=tuple(_changes(test, unit)),
        chi2=test.chi2 if np.isfinite(test.chi2) else None,
        dof=test.dof,
        nu=test.nu if np.isfinite(test.nu) else None,
        p_value=test.p_value,
        p_corrected=test.p_corrected,
        effect_px=test.effect_px,
        expected_px=test.expected_px,
        detectable_px=test.detectable_px,
        found=any(test is one for one in found.found),
        decisive=any(test is one for one in found.decisive),
    )


def _changes(test: GroupDrift, unit: Unit) -> Iterator[DriftChange]:
    for name, change, sigma in zip(test.names, test.change, test.sigma, strict=True):
        if test.group == "rotation":
            yield DriftChange(
                name=f"rotation_{name}", unit="deg",
                change=float(np.degrees(change)), sigma=float(np.degrees(sigma)),
            )  # fmt: skip
        elif test.group == "translation":
            yield DriftChange(
                name=f"centre_{name}", unit=unit, change=float(change), sigma=float(sigma)
            )
        else:
            in_px: Literal["px", ""] = "px" if name in IN_PX else ""
            yield DriftChange(name=name, unit=in_px, change=float(change), sigma=float(sigma))

"""What an old calibration said, what the scan alone says, and what came out, side by side."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm_calib.recalibration_record import Contribution, Recalibration
from sfm_calib.report.digits import decimals_for, number

IN_PX = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class ContributionRow:
    """One parameter, ready to print."""

    name: str
    old: str
    sigma_old: str
    alone: str  # empty: the scan was solved once
    result: str
    sigma: str
    unit: str
    share: str  # of what is known, by the old calibration


@dataclass(frozen=True)
class ContributionSection:
    """How the old calibration was used, and what of the result is its."""

    summary: str
    rows: tuple[ContributionRow, ...]


def contribution_section(recalibration: Recalibration | None, metric: bool) -> ContributionSection:
    """Of every parameter that both know; empty of a result that started from no calibration."""
    if recalibration is None:
        return ContributionSection("", ())
    rows = tuple(_rows(recalibration, "m" if metric else "baselines"))
    return ContributionSection(_summary(recalibration), rows)


def _summary(recalibration: Recalibration) -> str:
    used = {
        "start": "It said where to start, and nothing else: it has no share in what came out.",
        "weak": "It is the centre of the wide beliefs that every calibration starts with, whose "
        "shares stand with the lenses below; of its own precision nothing was used.",
        "full": "It was believed as far as its covariance says, together with the scan.",
    }[recalibration.prior]
    if recalibration.freed != ("all",):
        used += (
            f" Estimated anew: {', '.join(recalibration.freed)}; all else was held at its values, "
            "and is as uncertain as it was."
        )
    return used


def _rows(recalibration: Recalibration, length: str) -> Iterator[ContributionRow]:
    for name, one in recalibration.contributions.items():
        kind = name.rpartition(".")[2]
        by, unit = (180 / np.pi, "deg") if kind.startswith("rotation") else (1.0, "")
        unit = length if kind.startswith("translation") else "px" if kind in IN_PX else unit
        yield _row(name, one, by, unit, twice=recalibration.prior == "full")


def _row(name: str, one: Contribution, by: float, unit: str, twice: bool) -> ContributionRow:
    before = one.sigma_old or 0.0
    alone = one.new_alone
    return ContributionRow(
        name=name,
        old=number(by * one.old, decimals_for(by * before)),
        sigma_old=number(by * before, decimals_for(by * before)) if before else "–",
        alone=number(by * alone, decimals_for(by * one.sigma))
        if twice and alone is not None
        else "",
        result=number(by * one.result, decimals_for(by * one.sigma)),
        sigma=number(by * one.sigma, decimals_for(by * one.sigma)) if one.sigma else "fixed",
        unit=unit,
        share=f"{one.prior_share:.0%}",
    )

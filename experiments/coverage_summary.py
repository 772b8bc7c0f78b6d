"""What the scans of one case of the coverage study say together, and what is promised of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.runner.protocol import Row
from experiments.standard_errors import WITHIN_95, mean_and_error
from graphs.frames import FloatArray

# What is promised, by the kind of noise.
MEAN_NEES = {"gaussian": (0.9, 1.15), "heavy": (0.8, 1.3)}
COVERAGE = (0.90, 0.98)
MOST_OF_BOUND = 1.1  # RMSE over the Cramer-Rao bound; Cauchy's loss alone takes 1.026
# By how much chance may exceed it: standard errors of a chi-squared, and of a share of intervals;
# of all parameters together, and of one kind's RMSE, what was seen in 20 scans.
WIDENED = 3.0
COVERAGE_OF_20, BOUND_OF_20 = 0.02, 0.05
FEWEST_SCANS = 10  # of a case: of fewer chance alone decides

ALL = "all"  # kinds of parameters


@dataclass(frozen=True)
class Summary:
    """What the scans of one case say together."""

    case: str
    noise: str
    scans: int
    refused: int
    parameters: int
    nees_stated: tuple[float, float]  # mean a degree of freedom, and its standard error
    nees_model: tuple[float, float]
    nees_efficient: tuple[float, float] | None  # of least squares, by the bound
    coverage: dict[str, float]  # of 95 % intervals, by kind of parameter
    coverage_model: dict[str, float]
    of_bound: dict[str, float]  # RMSE over the Cramer-Rao bound, by kind of parameter
    of_bound_paired: dict[str, float]  # the same, less what chance did to the bound's own errors
    sigma_px: float  # mean estimate
    seconds: float  # a scan, median

    @property
    def chance(self) -> float:
        """Standard error of a mean NEES of so many parameters and scans, were it 1.

        Of a chi-squared: the scatter of the scans themselves would excuse what makes it large.
        """
        return float((2 / (self.parameters * self.scans)) ** 0.5)

    @property
    def worst_coverage(self) -> tuple[str, float]:
        """The kind of parameter whose coverage is farthest from 95 %."""
        return max(self.coverage.items(), key=lambda item: abs(item[1] - 0.95))

    @property
    def worst_of_bound(self) -> tuple[str, float]:
        """The kind of parameter whose errors are the largest by the bound."""
        return max(self.of_bound_paired.items(), key=lambda item: item[1])


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised estimation error squared a degree of freedom: 1 on average where they agree."""
    sigma = np.sqrt(np.diag(covariance))
    z = error / sigma
    return float(z @ np.linalg.solve(covariance / np.outer(sigma, sigma), z)) / len(error)


def summarise(case: str, noise: str, rows: Sequence[Row], refused: int = 0) -> Summary:
    """Means over the rows of all scans of a case that were not refused; there must be one."""
    names: Any = rows[0]["names"]
    kinds = [name.split(".")[1] for name in names]
    error = _column(rows, "error")
    best = [row for row in rows if row.get("nees_efficient") is not None]
    of_bound, paired = efficiency(kinds, best) if best else ({}, {})

    def covered(sigma: str) -> dict[str, float]:
        return by_kind(kinds, (np.abs(error / _column(rows, sigma)) < WITHIN_95).mean(0))

    return Summary(
        case=case,
        noise=noise,
        scans=len(rows),
        refused=refused,
        parameters=len(kinds),
        nees_stated=mean_and_error(_column(rows, "nees_stated")),
        nees_model=mean_and_error(_column(rows, "nees_model")),
        nees_efficient=mean_and_error(_column(best, "nees_efficient")) if best else None,
        coverage=covered("sigma_stated"),
        coverage_model=covered("sigma_model"),
        of_bound=of_bound,
        of_bound_paired=paired,
        sigma_px=float(_column(rows, "sigma_px").mean()),
        seconds=float(np.median(_column(rows, "seconds_calibrating"))),
    )


def _column(rows: Sequence[Row], name: str) -> FloatArray:
    """One column of rows (n_rows,), or (n_rows, n) of one that holds lists."""
    return np.array([row[name] for row in rows], dtype=np.float64)


def efficiency(
    kinds: Sequence[str], rows: Sequence[Row]
) -> tuple[dict[str, float], dict[str, float]]:
    """RMSE of the rows' errors over the Cramer-Rao bound, by kind of parameter, in two ways.

    Plain, and with the errors of least squares in the same scans as control variates: these are
    known to have the bound's variance, so what chance made of them is taken off.
    """
    variance = (_column(rows, "sigma_bound") ** 2).mean(0)
    square = (_column(rows, "error") ** 2).mean(0)
    excess = square - (_column(rows, "error_efficient") ** 2).mean(0)
    plain, paired = (
        {kind: max(ratio, 0.0) ** 0.5 for kind, ratio in by_kind(kinds, part / variance).items()}
        for part in (square, variance + excess)
    )
    return plain, paired


def by_kind(kinds: Sequence[str], values: FloatArray) -> dict[str, float]:
    """Means of values (n,) over all cameras' parameters of one kind, and over all."""
    of = np.array(kinds)
    means = {kind: float(values[of == kind].mean()) for kind in dict.fromkeys(kinds)}
    return means | {ALL: float(values.mean())}


def broken(summary: Summary) -> list[str]:
    """What of the promises a case does not keep, by more than chance; nothing is as it should."""
    found = []
    if summary.refused:
        found.append(f"{summary.refused} of {summary.scans + summary.refused} scans refused")
    low, high = MEAN_NEES[summary.noise]
    slack = WIDENED * summary.chance
    if not low - slack < summary.nees_stated[0] < high + slack:
        found.append(f"NEES {summary.nees_stated[0]:.2f}, not {low:g} to {high:g}")
    more = (20 / summary.scans) ** 0.5
    cameras = summary.parameters / (len(summary.coverage) - 1)
    share = (0.95 * 0.05 / (summary.scans * cameras)) ** 0.5
    for kind, covered in summary.coverage.items():
        slack = COVERAGE_OF_20 * more if kind == ALL else WIDENED * share
        if not COVERAGE[0] - slack < covered < COVERAGE[1] + slack:
            found.append(f"95 % intervals of {kind} hold {100 * covered:.1f} % of the truths")
    for kind, ratio in summary.of_bound_paired.items():
        slack = 0.0 if kind == ALL else BOUND_OF_20 * more
        if not ratio < MOST_OF_BOUND + slack:
            found.append(f"errors of {kind} {ratio:.2f} times the Cramer-Rao bound")
    return found


def in_words(summaries: Sequence[Summary]) -> str:
    """The numbers that decide, over all cases, in one line."""
    means = []
    for noise in dict.fromkeys(one.noise for one in summaries):
        some = [one for one in summaries if one.noise == noise]
        chance = max(one.chance for one in some)
        values = _range([one.nees_stated[0] for one in some], ".2f")
        means.append(f"{values} (± {chance:.2f}) under {noise} noise")
    parts = [f"{sum(one.scans for one in summaries)} scans", f"NEES {', '.join(means)}"]
    covered = [100 * one.coverage[ALL] for one in summaries]
    parts.append(f"95 % intervals hold {_range(covered, '.1f')} % of the truths")
    bounded = [one for one in summaries if one.of_bound_paired]
    if bounded:
        ratios = [one.of_bound_paired[ALL] for one in bounded]
        worst, of = max(one.worst_of_bound[::-1] for one in bounded)
        parts.append(
            f"errors {_range(ratios, '.2f')} times the Cramer-Rao bound ({of} {worst:.2f})"
        )
    return ", ".join(parts)


def _range(values: Sequence[float], form: str) -> str:
    low, high = format(min(values), form), format(max(values), form)
    return low if low == high else f"{low} to {high}"

"""What the trials of `weak_geometry` say together."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished

EPS = float(np.finfo(np.float64).eps)
# Where no digit is left (Bjorck 1996, 2.4); what is found may be so many decades off: errors of a
# tenth count, and rounding is not always at its worst.
LOST = {"cholesky": EPS**-0.5, "qr": EPS**-1.0}
DECADES = 1.5
GROWS = {"cholesky": 2.0, "qr": 1.0}  # error as condition to this power
POWER_WITHIN = 0.35
FITTED = (1e-12, 1e-2)  # errors between rounding and ruin
WRONG = 0.1  # relative, of a sigma
JUDGED = 1e17  # condition up to which 64 bits of mantissa leave two digits
FAR_OFF, MANY_SIGMAS = 0.02, 4.0  # of a focal length that nothing was said of
FEWEST = 2  # points of a line
TITLES = {
    "cholesky": "Cholesky", "qr": "QR", "gtsam_cholesky": "GTSAM Cholesky", "gtsam_qr": "GTSAM QR",
    "unchecked": "ours, pivots unseen", "ours": "ours",
}  # fmt: skip
VERDICTS = ("refused", "unusable", "weak", "nothing")


@dataclass(frozen=True)
class Solved:
    """A trial that did not fail."""

    options: Any
    row: Any


Trials = Sequence[Solved]


@dataclass(frozen=True)
class Standing:
    """How one solver fared with no belief in the lens."""

    solver: str
    # Condition of the first trial not right, a motion and lens each; inf: all judged are right.
    fails_from: tuple[float, ...]
    power: float | None  # of the condition, that errors grow as
    trials: int
    refused: int
    needless: int  # refused though the judge finds the lens usable
    wrong: int
    silent: int  # of these, those whose covariance would be called usable

    @property
    def typical(self) -> float | None:
        """The condition from which it fails, the median of all motions; inf: most never do."""
        return statistics.median(self.fails_from) if self.fails_from else None

    @property
    def failing(self) -> list[float]:
        """Conditions of the motions in which it fails at all."""
        return [condition for condition in self.fails_from if np.isfinite(condition)]


def answer(trials: Sequence[Finished[Any]]) -> Answer:
    """Where each solver fails, what it says then, and what calibrations say."""
    done = [Solved(t.options, t.row) for t in trials if t.error is None]
    judged = [t for t in done if t.options.belief == "none" and t.row["condition"] <= JUDGED]
    calibrated = [t for t in done if t.options.belief == "weak"]
    if not judged and not calibrated:
        return Answer(f"none of {len(trials)} trials was finished", None)
    standings = [standing(solver, judged) for solver in TITLES]
    unsaid = [t for t in calibrated if goes_unsaid(t.row)]
    reached = max((t.row["condition"] for t in judged), default=0.0)
    holds = _holds(standings, reached, calibrated, unsaid)
    word = {True: "yes", False: "no", None: "too little to say"}[holds]
    failed = len(trials) - len(done)
    words = [*_in_words(standings), _of_calibrations(calibrated, unsaid)]
    said = "; ".join(one for one in words if one) + (f"; {failed} trials failed" if failed else "")
    tables = (_solvers(standings), _calibrations(calibrated))
    return Answer(f"{word}: {said}", holds, tables, tuple(_figures(judged)))


def right(row: Any, solver: str) -> bool:
    """Whether a solver's sigmas are right to WRONG."""
    error = row[f"{solver}_sigma_error"]
    return error is not None and error <= WRONG


def standing(solver: str, judged: Trials) -> Standing:
    """One solver over all motions and lenses."""
    fails = []
    for _, some in _cases(judged):
        lost = [t.row["condition"] for t in some if not right(t.row, solver)]
        fails.append(min(lost, default=float("inf")))
    rows = [t.row for t in judged]
    refused = [row for row in rows if row[f"{solver}_sigma_error"] is None]
    wrong = [row for row in rows if (row[f"{solver}_sigma_error"] or 0.0) > WRONG]
    return Standing(
        solver, tuple(fails), power(solver, judged), len(rows), len(refused),
        sum(bool(row["usable"]) for row in refused), len(wrong),
        sum(not row[f"{solver}_doubted"] for row in wrong),
    )  # fmt: skip


def power(solver: str, judged: Trials) -> float | None:
    """p of error ~ condition^p, by least squares within each motion and lens."""
    x, y = [], []
    for _, some in _cases(judged):
        pairs = [(t.row["condition"], t.row[f"{solver}_sigma_error"]) for t in some]
        kept = [(c, e) for c, e in pairs if e is not None and FITTED[0] < e < FITTED[1]]
        if len(kept) >= FEWEST:
            logs = np.log10(kept)
            x += (logs[:, 0] - logs[:, 0].mean()).tolist()
            y += (logs[:, 1] - logs[:, 1].mean()).tolist()
    spread = float(np.dot(x, x))
    return float(np.dot(x, y)) / spread if spread > 1.0 else None


def goes_unsaid(row: Any) -> bool:
    """Whether a calibration is far off, and nothing was said of it."""
    if row["verdict"] != "nothing":
        return False
    return bool(abs(row["off"]) > FAR_OFF or abs(row["z"]) > MANY_SIGMAS)


def _cases(trials: Trials) -> Iterator[tuple[tuple[str, str], list[Solved]]]:
    """Trials by motion and lens."""

    def key(t: Solved) -> tuple[str, str]:
        return t.options.motion, t.options.lens

    for case, some in itertools.groupby(sorted(trials, key=key), key):
        yield case, list(some)


def _holds(
    standings: Sequence[Standing], reached: float, calibrated: Trials, unsaid: Trials
) -> bool | None:
    """reached: the largest condition tried."""
    of = {one.solver: one for one in standings}
    kept: list[bool | None] = []
    for solver, lost in LOST.items():
        found, p = of[solver].typical, of[solver].power
        # What fails beyond the judge's own condition is not seen to.
        least, most = lost / 10**DECADES, min(lost * 10**DECADES, JUDGED)
        if found is not None and np.isfinite(found):
            kept.append(bool(least <= found <= most))
        else:
            kept.append(False if reached > most else None)
        kept.append(None if p is None else abs(p - GROWS[solver]) <= POWER_WITHIN)
    kept.append(of["ours"].silent == 0 if of["ours"].trials else None)
    kept.append(not unsaid if calibrated else None)
    if False in kept:
        return False
    return None if None in kept else True


def _in_words(standings: Sequence[Standing]) -> Iterator[str]:
    for one in standings:
        if one.solver == "unchecked" or not one.trials:
            continue
        if not one.failing or one.typical is None:
            yield f"{TITLES[one.solver]} was right in all {one.trials}"
            continue
        grows = "" if one.power is None else f"error as cond^{one.power:.1f}, "
        usable = f", {one.silent} called usable" if one.wrong and one.solver == "ours" else ""
        at = one.typical if np.isfinite(one.typical) else min(one.failing)
        n, some = len(one.failing), f"in {len(one.failing)} of {len(one.fails_from)} cases "
        yield (
            f"{TITLES[one.solver]} fails {'' if n == len(one.fails_from) else some}"
            f"from cond(J) {at:.0e} ({grows}"
            f"{one.refused} refused, {one.wrong} wrong{usable})"
        )


def _of_calibrations(calibrated: Trials, unsaid: Trials) -> str:
    if not calibrated:
        return ""
    counts = [(v, sum(t.row["verdict"] == v for t in calibrated)) for v in VERDICTS]
    listed = ", ".join(f"{count} {verdict}" for verdict, count in counts if count)
    return (
        f"of {len(calibrated)} calibrations {len(unsaid)} went wrong without a word "
        f"(verdicts: {listed})"
    )


# ---- tables and figures --------------------------------------------------------------------


def _solvers(standings: Sequence[Standing]) -> AnswerTable:
    rows = tuple(
        (
            TITLES[one.solver],
            one.typical if one.typical is not None and np.isfinite(one.typical) else None,
            min(one.failing, default=None), max(one.failing, default=None), one.power, one.trials,
            one.refused, one.needless, one.wrong, one.silent, len(one.failing), len(one.fails_from),
        )
        for one in standings
    )  # fmt: skip
    columns = (
        "solver", "fails from cond(J)", "least", "most", "error as cond^", "trials", "refused",
        "though usable", "wrong", "called usable", "motions and lenses in which it fails", "of",
    )  # fmt: skip
    return AnswerTable("solvers", "No belief in the lens", columns, rows)


def _calibrations(calibrated: Trials) -> AnswerTable:
    rows = []
    for (motion, lens), some in _cases(calibrated):
        for scale in sorted({t.options.scale for t in some}, reverse=True):
            own = [t.row for t in some if t.options.scale == scale]
            counts = (sum(row["verdict"] == verdict for row in own) for verdict in VERDICTS)
            off = [abs(row["off"]) for row in own if row["off"] is not None]
            z = [abs(row["z"]) for row in own if row["z"] is not None]
            middle = 100 * statistics.median(off) if off else None
            rows.append((motion, lens, scale, *counts, middle, max(z, default=None)))
    columns = ("motion", "lens", "scale", *VERDICTS, "focal off, median, %", "worst |z|")
    title = "What calibrations of the same scans say, with the usual weak beliefs"
    return AnswerTable("calibrations", title, columns, tuple(rows))


def _figures(judged: Trials) -> Iterator[AnswerFigure]:
    for (motion, lens), some in _cases(judged):
        series = []
        for solver, title in TITLES.items():
            points = list(_line(some, solver))
            if len(points) >= FEWEST:
                x, y = zip(*points, strict=True)
                series.append(Series(title, x, y))
        if series:
            figure = lines(
                series, "cond(J)", "relative error of the worst sigma", log_x=True, log_y=True,
                level=WRONG,
            )  # fmt: skip
            figure.update_xaxes(exponentformat="power")
            figure.update_yaxes(exponentformat="power")
            yield AnswerFigure(
                f"{motion}_{lens}",
                f"{motion}, {lens}",
                "Medians of those that were not refused: a line ends where all are. Above the "
                "dotted line sigmas are wrong.",
                figure,
            )


def _line(some: Trials, solver: str) -> Iterator[tuple[float, float]]:
    """Median condition and error at each scale."""
    for scale in sorted({t.options.scale for t in some}, reverse=True):
        rows = [t.row for t in some if t.options.scale == scale]
        errors = [e for row in rows if (e := row[f"{solver}_sigma_error"]) is not None]
        if errors:
            condition = statistics.median(row["condition"] for row in rows)
            yield condition, max(statistics.median(errors), EPS)

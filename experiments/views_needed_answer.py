"""How errors fall with the number, tilt and spread of views: from all trials of `views_needed`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from experiments.standard_errors import jackknifed, rms
from graphs.frames import FloatArray

SLOPE, SLOPE_TOLERANCE = -0.5, 0.1  # of log error over log n, for independent views
# With fewer, luck decides what the picture's corners see, or the scan has not gone round yet.
FROM = {"board": 10, "scan": 20}
MOST_OF_STATED = 1.4  # RMS error over RMS stated: beyond, sigmas hide how large it is
MOST_NEES = MOST_OF_STATED**2
STANDARD_ERRORS = 2.0
FEWEST = 5  # trials of a case
ADVICE = (20, 30)  # views
# Swept beside the number; coverage with boards so far away that they are small in the picture.
SWEPT: tuple[tuple[str, str, dict[str, object]], ...] = (
    ("tilt_deg", " deg of tilt", {}),
    ("coverage", " coverage", {"distance_m": 1.2}),
)
Trials = Sequence[Finished[Any]]


@dataclass(frozen=True)
class Case:
    """Trials that differ in their seeds alone."""

    options: Any
    trials: Trials
    failed: int

    def column(self, name: str) -> FloatArray:
        return np.array([each.row[name] for each in self.trials], dtype=float)

    @property
    def off_px(self) -> tuple[float, float]:
        """RMS error over the picture, and its standard error."""
        return jackknifed(rms, self.column("off_px"))

    @property
    def of_stated(self) -> tuple[float, float]:
        """RMS error over what was stated, and its standard error."""
        both = np.stack([self.column("off_px"), self.column("stated_px")], axis=1)
        return jackknifed(lambda values: rms(values[:, 0]) / rms(values[:, 1]), both)

    @property
    def nees(self) -> float:
        """Median: where the lens is all but free single ones are millions, and their mean no
        surer than itself."""
        return float(np.median(self.column("nees")))

    @property
    def share_above(self) -> float:
        """Of the trials, whose NEES is more than the median may be."""
        return float((self.column("nees") > MOST_NEES).mean())

    @property
    def told(self) -> bool:
        """Whether neither the error over the picture nor that of the parameters is larger."""
        ratio, error = self.of_stated
        by_chance = STANDARD_ERRORS * 0.5 / len(self.trials) ** 0.5
        return ratio <= MOST_OF_STATED + STANDARD_ERRORS * error and (
            self.share_above <= 0.5 + by_chance
        )


@dataclass(frozen=True)
class PowerLaw:
    """error = factor n^slope."""

    factor: float
    slope: float
    slope_error: float
    numbers: tuple[float, float]  # fitted from, to

    def at(self, n: float) -> float:
        return float(self.factor * n**self.slope)

    def reaches(self, error: float) -> float:
        """The number at which the error is so large."""
        return float((error / self.factor) ** (1 / self.slope))


def answered(trials: Trials, usual: Any) -> Answer:
    """The verdict, tables and figures. usual: the case of which one option is varied."""
    cases = cases_of(trials)
    tables = (cases_table(cases),) if cases else ()
    board, scan = (power_law(of_number(cases, usual, source)) for source in ("board", "scan"))
    if board is None:
        return Answer("too few numbers of views were tried to say", None, tables)
    steep = abs(board.slope - SLOPE) <= SLOPE_TOLERANCE + STANDARD_ERRORS * board.slope_error
    judged = [case for case in cases if len(case.trials) >= FEWEST]
    untold = [case for case in judged if not case.told]
    holds = steep and not untold
    said = [
        f"error ~ n^{board.slope:.2f}±{board.slope_error:.2f} from {board.numbers[0]:g} to "
        f"{board.numbers[1]:g} board views (stated: n^{stated_slope(cases, usual):.2f})",
        f"{board.at(ADVICE[0]):.2g} px at {ADVICE[0]}, {board.at(ADVICE[1]):.2g} px at "
        f"{ADVICE[1]} ({100 * (1 - board.at(ADVICE[1]) / board.at(ADVICE[0])):.0f} % less)",
        *worse(cases, usual),
    ]
    if scan is not None:
        equal = " and ".join(f"{scan.reaches(board.at(n)):.0f}" for n in ADVICE)
        said.append(
            f"{equal} frames of a scan equal {ADVICE[0]} and {ADVICE[1]} views "
            f"(n^{scan.slope:.2f}±{scan.slope_error:.2f})"
        )
    if judged:
        ratios, nees = ([part(c) for c in judged if c.told] for part in (_ratio, _nees))
        said.append(
            f"errors are {min(ratios):.2f} to {max(ratios):.2f} of what is stated, NEES "
            f"{min(nees):.2f} to {max(nees):.2f}"
            if ratios
            else "stated covariances are too small"
        )
    said += [
        f"too small a covariance at {_differs(case, usual)}: {_ratio(case):.2f} of what is "
        f"stated, NEES {_nees(case):.2g}"
        for case in untold
    ]
    verdict = ("yes: " if holds else "no: ") + "; ".join(said)
    return Answer(verdict, holds, tables, figures(cases, usual, board, scan))


def _ratio(case: Case) -> float:
    return case.of_stated[0]


def _nees(case: Case) -> float:
    return case.nees


def _differs(case: Case, usual: Any) -> str:
    """Options in which a case is not the usual one, in a few words."""
    words = [
        f"{name} {getattr(case.options, name)}"
        for name in type(usual).model_fields
        if getattr(case.options, name) != getattr(usual, name)
    ]
    return ", ".join(words) or "the usual views"


def cases_of(trials: Trials) -> list[Case]:
    """All with a finished trial, by their options, in the config's order."""
    found: dict[str, list[Finished[Any]]] = {}
    for each in trials:
        found.setdefault(each.options.model_dump_json(), []).append(each)
    cases = []
    for group in found.values():
        good = [each for each in group if each.error is None]
        if good:
            cases.append(Case(good[0].options, good, len(group) - len(good)))
    return cases


def varied(cases: Sequence[Case], usual: Any, option: str, **fixed: object) -> list[Case]:
    """Cases that differ from the usual one in one option alone, by that option."""
    base = usual.model_copy(update=fixed)
    others = [name for name in type(usual).model_fields if name != option]
    some = [
        case
        for case in cases
        if all(getattr(case.options, name) == getattr(base, name) for name in others)
    ]
    return sorted(some, key=lambda case: getattr(case.options, option))


def of_number(cases: Sequence[Case], usual: Any, source: str) -> list[Case]:
    """Cases of a source from FROM on."""
    return [
        case
        for case in varied(cases, usual, "views", source=source)
        if case.options.views >= FROM[source]
    ]


def power_law(cases: Sequence[Case]) -> PowerLaw | None:
    """Fitted to the log of the errors, by their standard errors; None: to fewer than two."""
    some = [case for case in cases if len(case.trials) > 1]
    if len(some) < 2:
        return None
    n = np.log([case.options.views for case in some])
    error = np.array([case.off_px for case in some])  # (n, 2)
    sigma = error[:, 1] / error[:, 0]
    design = np.stack([np.ones(len(n)), n], axis=1) / sigma[:, None]
    covariance = np.linalg.inv(design.T @ design)
    level, slope = covariance @ design.T @ (np.log(error[:, 0]) / sigma)
    numbers = (some[0].options.views, some[-1].options.views)
    return PowerLaw(float(np.exp(level)), float(slope), float(np.sqrt(covariance[1, 1])), numbers)


def stated_slope(cases: Sequence[Case], usual: Any) -> float:
    """Of what is stated of board views: chance plays less of a part in it."""
    some = of_number(cases, usual, "board")
    stated = [rms(case.column("stated_px")) for case in some]
    return float(np.polyfit(np.log([case.options.views for case in some]), np.log(stated), 1)[0])


def worse(cases: Sequence[Case], usual: Any) -> list[str]:
    """By how much flat and central boards err more than the usual ones."""
    found = []
    for option, unit, fixed in SWEPT:
        some = varied(cases, usual, option, **fixed)
        usually = getattr(usual, option)
        base = [case for case in some if getattr(case.options, option) == usually]
        if not base or len(some) < 2:
            continue
        parts = [
            f"{getattr(case.options, option):g}{unit} x{case.off_px[0] / base[0].off_px[0]:.2g}"
            for case in some
            if getattr(case.options, option) != usually
        ]
        found.append(", ".join(parts))
    return found


# ---- tables and figures --------------------------------------------------------------------


def cases_table(cases: Sequence[Case]) -> AnswerTable:
    """A row a case."""
    columns = (
        "source", "number", "tilt deg", "coverage", "distance m", "printed", "trials",
        "failed", "off px", "±",
        "stated px", "off / stated", "± of it", "NEES, median", "share above", "focal RMSE px",
        "centre RMSE px", "picture seen", "warned %",
    )  # fmt: skip
    rows = []
    for case in cases:
        o = case.options
        warned: list[Any] = [each.row["warned"] for each in case.trials]
        warned = [each for each in warned if each is not None]
        numbers = (
            *case.off_px, rms(case.column("stated_px")), *case.of_stated,
            case.nees, case.share_above,
            rms(case.column("focal_px")), rms(case.column("centre_px")),
            float(case.column("seen").mean()), 100 * np.mean(warned) if warned else np.nan,
        )  # fmt: skip
        rows.append((
            o.source, o.views, o.tilt_deg, o.coverage, o.distance_m, o.printed,
            len(case.trials), case.failed,
            *(number if np.isfinite(number) else None for number in numbers),
        ))  # fmt: skip
    return AnswerTable(
        "cases", "Errors over the picture, and what was stated", columns, tuple(rows)
    )


def figures(
    cases: Sequence[Case], usual: Any, board: PowerLaw, scan: PowerLaw | None
) -> tuple[AnswerFigure, ...]:
    """Errors over the number, the tilt and the coverage."""
    series = []
    for source, law in (("board", board), ("scan", scan)):
        some = varied(cases, usual, "views", source=source)
        if some:
            series += _measured_and_stated(some, "views", source)
        if law is not None:
            ends = [law.numbers[0], law.numbers[1]]
            name = f"{source}: n^{law.slope:.2f}"
            series.append(Series(name, ends, [law.at(n) for n in ends], dashed=True))
    found = [AnswerFigure(
        "number", "Error over the number of views or frames",
        "Straight lines are power laws: no number is a threshold. Dashed: fitted, and stated.",
        lines(series, "views or frames", "error over the picture, px", log_x=True, log_y=True),
    )]  # fmt: skip
    for option, unit, fixed in SWEPT:
        title = f"{unit.strip()}, at most" if option == "tilt_deg" else unit.strip()
        some = varied(cases, usual, option, **fixed)
        if len(some) > 1:
            found.append(AnswerFigure(
                option, f"Error over {title}",
                "Where the dashed line follows, the stated covariance tells of it.",
                lines(_measured_and_stated(some, option, "board"), title,
                      "error over the picture, px", log_y=True),
            ))  # fmt: skip
    return tuple(found)


def _measured_and_stated(cases: Sequence[Case], option: str, name: str) -> list[Series]:
    x = [getattr(case.options, option) for case in cases]
    bars = [case.off_px[1] if np.isfinite(case.off_px[1]) else 0.0 for case in cases]
    return [
        Series(name, x, [case.off_px[0] for case in cases], bars),
        Series(f"{name}: stated", x, [rms(case.column("stated_px")) for case in cases],
               dashed=True),
    ]  # fmt: skip

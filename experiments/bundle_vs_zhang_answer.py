"""What joint refinement gains over Zhang's closed form, from all trials of `bundle_vs_zhang`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished, TrialOptions
from experiments.standard_errors import jackknifed, rms
from graphs.frames import FloatArray

CLAIM = (0.5, 0.8)  # of every error, a textbook says, is gone after joint refinement
STANDARD_ERRORS = 2.0
FEWEST = 5  # trials of a case with an answer

# Unit and meaning of each; all but the first are errors against the truth.
MEASURES = {
    "rms": "reprojection, px",
    "focal": "focal length, px",
    "centre": "principal point, px",
    "distortion": "distortion, px over the picture",
    "picture": "lens over the picture, px",
    "held_out": "exact views held out, px",
    "turn": "board's rotation, deg",
    "place": "board's place, % of its distance",
}
SHOWN = ("rms", "focal", "picture", "held_out", "turn")  # in figures
CLOSED_FORM, JOINT = "zhang4", "joint"
METHODS = ("zhang5", "zhang4", "zhang4_linear", "zhang4_alternated", "zhang3",
           "joint", "opencv", "target")  # fmt: skip
Trials = Sequence[Finished[Any]]


@dataclass(frozen=True)
class Case:
    """Trials that differ in their seeds alone."""

    options: Any
    trials: Trials

    @property
    def corner_px(self) -> float:
        """How far the distortion moves the picture's corners."""
        return float(np.mean([each.row["corner_px"] for each in self.trials]))

    @property
    def named(self) -> str:
        o = self.options
        return f"{o.views} views, {o.sigma_px:g} px noise, {self.corner_px:.3g} px at the corners"

    def pairs(self, measure: str, a: str, b: str) -> FloatArray:
        """Errors (n, 2) of two methods, in trials where both have one."""
        rows = [(t.row.get(f"{measure}_{a}"), t.row.get(f"{measure}_{b}")) for t in self.trials]
        found = [row for row in rows if all(isinstance(v, float) and np.isfinite(v) for v in row)]
        return np.array(found, dtype=float).reshape(-1, 2)

    def fall(
        self, measure: str, before: str = CLOSED_FORM, after: str = JOINT
    ) -> tuple[float, float]:
        """Share of the RMS error that is gone, and its standard error; NaN of too few trials."""
        pairs = self.pairs(measure, before, after)
        if len(pairs) < FEWEST:
            return float("nan"), float("inf")
        return jackknifed(lambda values: 1 - rms(values[:, 1]) / rms(values[:, 0]), pairs)

    def error(self, measure: str, method: str) -> float:
        pairs = self.pairs(measure, method, method)
        return rms(pairs[:, 0]) if len(pairs) else float("nan")


def answered(trials: Trials, usual: TrialOptions) -> Answer:
    """The verdict, tables and figures. usual: the case that figures vary one option of."""
    cases = cases_of(trials)
    falls = {
        (index, measure): case.fall(measure)
        for index, case in enumerate(cases)
        for measure in MEASURES
    }
    known = [(value, error) for value, error in falls.values() if np.isfinite(value)]
    tables = (falls_table(cases), errors_table(cases)) if cases else ()
    if not known:
        return Answer("no case has enough finished trials to say", None, tables)
    low, high = CLAIM
    within = [
        low - STANDARD_ERRORS * error <= value <= high + STANDARD_ERRORS * error
        for value, error in known
    ]
    return Answer(verdict(cases, usual, within), all(within), tables, figures(cases, usual))


def cases_of(trials: Trials) -> list[Case]:
    """All that finished, by their options."""
    found: dict[str, list[Finished[Any]]] = {}
    for each in trials:
        if each.error is None:
            found.setdefault(each.options.model_dump_json(), []).append(each)
    cases = [Case(group[0].options, group) for group in found.values()]
    return sorted(cases, key=lambda c: (c.corner_px, c.options.sigma_px, c.options.views))


def verdict(cases: Sequence[Case], usual: Any, within: Sequence[bool]) -> str:
    """One line with the falls that decide: with least and most distortion, the rest as usual."""
    said = [
        f"{len(within) - sum(within)} of {len(within)} falls lie outside {100 * CLAIM[0]:.0f} to "
        f"{100 * CLAIM[1]:.0f} %"
    ]
    same = [c for c in cases if c.options.views == usual.views
            and c.options.sigma_px == usual.sigma_px] or list(cases)  # fmt: skip
    for case in same if len(same) < 2 else (same[0], same[-1]):
        falls = ", ".join(
            f"{name.replace('_', ' ')} {_percent(case.fall(name))}" for name in MEASURES
        )
        said.append(f"{case.named}: {falls}")
    bridge = [c.corner_px for c in same if CLAIM[0] <= c.fall("rms")[0] <= CLAIM[1]]
    if bridge:
        least, most = f"{min(bridge):.2g}", f"{max(bridge):.2g}"
        said.append(
            "the reprojection rms falls as claimed where distortion moves the corners by "
            + (f"{least} px" if least == most else f"{least} to {most} px")
        )
    all_apart = [t.row["joint_less_opencv_px"] for c in cases for t in c.trials]
    apart = max(each for each in all_apart if isinstance(each, float))
    said.append(f"ours and OpenCV's optimum at most {apart:.1g} px apart")
    return ("yes: " if all(within) else "no: ") + "; ".join(said)


def _percent(fall: tuple[float, float]) -> str:
    if not np.isfinite(fall[0]):
        return "unknown"
    return f"{100 * fall[0]:.0f}±{100 * fall[1]:.0f} %"


# ---- tables and figures --------------------------------------------------------------------


def falls_table(cases: Sequence[Case]) -> AnswerTable:
    """Falls in %, a row a case."""
    columns = ["views", "noise px", "corners moved px", "trials", "no camera"]
    columns += [part for measure in MEASURES for part in (f"{measure} %", "±")]
    rows = []
    for case in cases:
        n_answered = len(case.pairs("rms", CLOSED_FORM, JOINT))
        cells = [
            100 * part if np.isfinite(part) else None
            for measure in MEASURES
            for part in case.fall(measure)
        ]
        rows.append(
            (
                case.options.views,
                case.options.sigma_px,
                case.corner_px,
                len(case.trials),
                len(case.trials) - n_answered,
                *cells,
            )
        )
    title = "Fall of the RMS over trials, from Zhang's closed form (4 unknowns) to joint refinement"
    return AnswerTable("falls", title, tuple(columns), tuple(rows))


def errors_table(cases: Sequence[Case]) -> AnswerTable:
    """RMS of every measure by every method, a row each."""
    rows = []
    for case in cases:
        for method in METHODS:
            errors = [case.error(measure, method) for measure in MEASURES]
            rows.append((
                case.options.views, case.options.sigma_px, case.corner_px, method,
                len(case.pairs("rms", method, method)),
                *(error if np.isfinite(error) else None for error in errors),
            ))  # fmt: skip
    columns = ("views", "noise px", "corners moved px", "method", "answers", *MEASURES.values())
    return AnswerTable("errors", "RMS over trials", columns, tuple(rows))


def figures(cases: Sequence[Case], usual: Any) -> tuple[AnswerFigure, ...]:
    """Falls over one option, the others as usual; of views and noise also without distortion."""
    found = []
    plain = usual.model_copy(update={"distortion": 0.0})
    swept = (
        ("distortion", usual, "distortion, px at the corners", False),
        ("sigma_px", usual, "noise, px", True),
        ("sigma_px", plain, "noise, px", True),
        ("views", usual, "views", True),
        ("views", plain, "views", True),
    )
    for option, fixed, x_title, log_x in swept:
        others = {name for name in type(fixed).model_fields if name != option}
        some = [
            case
            for case in cases
            if all(getattr(case.options, name) == getattr(fixed, name) for name in others)
        ]
        if len(some) < 2:
            continue
        some.sort(key=lambda case: getattr(case.options, option))
        x = [case.corner_px if option == "distortion" else getattr(case.options, option)
             for case in some]  # fmt: skip
        without = " (no distortion)" if fixed is plain else ""
        series = []
        for measure in SHOWN:
            falls = [case.fall(measure) for case in some]
            bars = [100 * error if np.isfinite(error) else 0.0 for _, error in falls]
            series.append(Series(MEASURES[measure], x, [100 * each for each, _ in falls], bars))
        bounds = [Series(f"{100 * level:.0f} %", [x[0], x[-1]], [100 * level] * 2, dashed=True)
                  for level in CLAIM]  # fmt: skip
        found.append(AnswerFigure(
            f"falls_{option}{'_plain' if without else ''}",
            f"Fall of errors over {x_title}{without}",
            "Between the dashed lines the claim holds. Bars: one standard error.",
            lines([*series, *bounds], x_title, "fall, %", log_x=log_x),
        ))  # fmt: skip
    return tuple(found)

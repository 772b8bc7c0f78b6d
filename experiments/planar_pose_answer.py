"""How often a flat board's tilt is taken for its mirror image: from all trials of `planar_pose`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from experiments.scatter import ratio_of

# Measured and predicted shares agree within this and three standard errors: the prediction is of
# second order, and solutions of small tilts lie near each other.
CLOSE_ENOUGH, STANDARD_ERRORS = 0.03, 3.0
RESOLVED = 0.01  # of views at most wrong, where a second camera looks from RESOLVED_DEG away
RESOLVED_DEG = 15.0
SWEPT = {
    "distance": "distance, sides of the board",
    "tilt_deg": "tilt, deg",
    "noise_px": "noise, px",
    "focal_px": "focal length, px",
    "corners": "corners in a row",
}
NAMES = {
    "lone": "least rms",
    "sequence": "a sequence",
    "known_rig": "two cameras, known rig",
    "votes": "two cameras, votes",
    "half_turns": "two cameras, votes, symmetric board",
    "target": "target, one camera",
}
# Views that are judged together; of a sequence, its frames.
TOGETHER = {"lone": 1, "target": 1, "known_rig": 2}
LINKED = ("votes", "half_turns")  # a trial decides once where its second camera stands
Trials = Sequence[Finished[Any]]


@dataclass(frozen=True)
class Case:
    """Trials that differ in their seeds alone."""

    options: Any
    trials: Trials
    failed: int

    def total(self, name: str) -> int:
        counts: list[Any] = [each.row[name] for each in self.trials]
        return sum(counts)

    @property
    def wrong(self) -> tuple[float, float]:
        """Share of the views used, and its standard error; NaN where none was used."""
        used = self.total("n_used")
        if not used:
            return float("nan"), float("inf")
        share = self.total("n_wrong") / used
        if self.options.how in LINKED:
            return share, self._scatter(share)
        # Views that are judged together err together.
        return share, _guarded(share, used / TOGETHER.get(self.options.how, self.options.frames))

    def _scatter(self, share: float) -> float:
        """Standard error by the scatter of the trials, infinite of one."""
        counts: list[Any] = [[one.row["n_wrong"], one.row["n_used"]] for one in self.trials]
        own = np.array([pair for pair in counts if pair[1]], dtype=float)
        if len(own) < 2:
            return float("inf")
        return ratio_of(own)[1] or _guarded(share, len(own))

    def mean(self, name: str) -> float:
        values: list[Any] = [each.row[name] for each in self.trials]
        values = [each for each in values if each is not None]
        return float(np.mean(values)) if values else float("nan")

    @property
    def as_predicted(self) -> bool:
        share, error = self.wrong
        off = abs(share - self.mean("predicted_wrong"))
        return bool(off <= CLOSE_ENOUGH + STANDARD_ERRORS * error)

    @property
    def resolved(self) -> bool | None:
        """Whether as few are wrong as with a second camera should be; None: more, by chance."""
        share, error = self.wrong
        if share > RESOLVED + STANDARD_ERRORS * error:
            return False
        return True if share <= RESOLVED and np.isfinite(error) else None


def _guarded(share: float, n: float) -> float:
    """Binomial standard error of a share of n, not zero where none or all of them are wrong."""
    guarded = (share * n + 1) / (n + 2)
    return float(np.sqrt(guarded * (1 - guarded) / n))


def answered(trials: Trials, usual: Any) -> Answer:
    """The verdict, tables and figures. usual: the case of which one option is varied."""
    cases = cases_of(trials)
    if not cases:
        return Answer("no trial was finished", None)
    lone = [case for case in cases if case.options.how == "lone"]
    odd = [case for case in lone if not case.as_predicted]
    pairs = [
        case
        for case in cases
        if case.options.how in ("known_rig", "votes") and case.options.apart_deg >= RESOLVED_DEG
    ]
    resolved = [case.resolved for case in pairs]
    said = [f"{len(lone) - len(odd)} of {len(lone)} cases of lone views as predicted"]
    if lone:
        farthest = max(lone, key=lambda case: abs(case.wrong[0] - case.mean("predicted_wrong")))
        said.append(
            f"at worst {_percent(farthest)} wrong against "
            f"{100 * farthest.mean('predicted_wrong'):.1f} % ({_differs(farthest, usual)})"
        )
    for how, name in NAMES.items():
        some = [case for case in cases if case.options.how == how]
        if how == "lone":
            some = [case for case in some if case.options == usual]
        if some:
            said.append(f"{name}: " + ", ".join(_short(case, usual) for case in some))
    tables = (cases_table(cases),)
    if not lone or not pairs:
        return Answer("; ".join(said), None, tables, figures(cases, usual))
    holds = False if odd or False in resolved else None if None in resolved else True
    word = {True: "yes", False: "no", None: "too few trials to say"}[holds]
    return Answer(f"{word}: {'; '.join(said)}", holds, tables, figures(cases, usual))


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


def _percent(case: Case) -> str:
    share, error = case.wrong
    if not np.isfinite(share):
        return "none used"
    bar = f"±{100 * error:.1f}" if np.isfinite(error) else ""
    return f"{100 * share:.1f}{bar} %"


def _short(case: Case, usual: Any) -> str:
    left_out = 100 * case.total("n_left_out") / case.total("n_views")
    also = f" and {left_out:.0f} % left out" if left_out >= 1 else ""
    if case.total("n_wrong") and case.total("guessed"):
        also += f", said to be a guess in {100 * case.mean('guessed'):.0f} % of the rigs"
    return f"{_percent(case)}{also} ({_differs(case, usual)})"


def _differs(case: Case, usual: Any) -> str:
    """Options in which a case is not the usual one, in a few words."""
    names = [
        name
        for name in type(usual).model_fields
        if name != "how" and getattr(case.options, name) != getattr(usual, name)
    ]
    words = [f"{name.split('_')[0]} {getattr(case.options, name):g}" for name in names]
    return ", ".join(words) or "as usual"


# ---- tables and figures --------------------------------------------------------------------


def cases_table(cases: Sequence[Case]) -> AnswerTable:
    """A row a case."""
    columns = (
        "chosen by", "distance", "tilt deg", "noise px", "focal px", "corners", "apart deg",
        "frames", "roam deg", "trials", "failed", "views",
        "wrong %", "±", "predicted %", "said to be a guess %", "left out %",
        "misnumbered %", "error deg",
    )  # fmt: skip
    rows = []
    for case in cases:
        o, (share, error), n_views = case.options, case.wrong, case.total("n_views")
        used = case.total("n_used")
        numbers = (
            100 * share, 100 * error, 100 * case.mean("predicted_wrong"),
            100 * case.mean("guessed"), 100 * case.total("n_left_out") / n_views,
            100 * case.total("n_misnumbered") / max(used, 1), case.mean("error_deg"),
        )  # fmt: skip
        rows.append((
            o.how, o.distance, o.tilt_deg, o.noise_px, o.focal_px, o.corners, o.apart_deg,
            o.frames, o.roam_deg,
            len(case.trials), case.failed, n_views,
            *(number if np.isfinite(number) else None for number in numbers),
        ))  # fmt: skip
    title = "Views whose tilt is nearer to the mirror image than to the truth"
    return AnswerTable("cases", title, columns, tuple(rows))


def figures(cases: Sequence[Case], usual: Any) -> tuple[AnswerFigure, ...]:
    """Shares of wrong views over one option, the others as usual."""
    found = []
    for option, title in SWEPT.items():
        some = varied(cases, usual, option)
        if len(some) > 1:
            x = [getattr(case.options, option) for case in some]
            predicted = [100 * case.mean("predicted_wrong") for case in some]
            found.append(AnswerFigure(
                option, f"Wrong tilts over {title.split(',')[0]}",
                "Dashed: as predicted from the second-order effect of depth.",
                lines([_shares("least rms", some, x), Series("predicted", x, predicted,
                      dashed=True)], title, "wrong, %", log_x=option != "tilt_deg"),
            ))  # fmt: skip
    series = []
    for how in ("known_rig", "votes", "half_turns"):
        some = varied(cases, usual.model_copy(update={"how": how}), "apart_deg")
        if some:
            x = [case.options.apart_deg for case in some]
            series.append(_shares(NAMES[how], some, x))
    if series:
        found.append(AnswerFigure(
            "apart", "Wrong tilts with a second camera",
            "The farther apart the two look from, the fewer.",
            lines(series, "between the lines of sight, deg", "wrong, %"),
        ))  # fmt: skip
    return tuple(found)


def varied(cases: Sequence[Case], usual: Any, option: str) -> list[Case]:
    """Cases that differ from the usual one in one option alone, by that option."""
    others = [name for name in type(usual).model_fields if name != option]
    some = [
        case
        for case in cases
        if all(getattr(case.options, name) == getattr(usual, name) for name in others)
    ]
    return sorted(some, key=lambda case: getattr(case.options, option))


def _shares(name: str, cases: Sequence[Case], x: Sequence[float]) -> Series:
    shares = [case.wrong for case in cases]
    bars = [100 * error if np.isfinite(error) else 0.0 for _, error in shares]
    return Series(name, x, [100 * share for share, _ in shares], bars)

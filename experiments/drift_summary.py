"""What the scans of one case of the drift study say together, and what is expected of that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go
from scipy import stats

from experiments.runner.protocol import AnswerFigure, AnswerTable, Row
from sfm_calib.report.theme import AMBER, BLUE, RED, plain, styled

Change = Literal["none", "turned", "focal", "baseline", "weak", "weak turned", "panorama"]
UNTOUCHED: tuple[Change, ...] = ("none", "weak", "panorama")
TOO_WEAK: tuple[Change, ...] = ("weak", "weak turned", "panorama")

FINDABLE: tuple[Change, ...] = ("turned", "focal")  # of three or more cameras: meant to be found
LEAST_ALLOWED = 0.5  # of their trials: where sigmas allow fewer, nothing is said of what is found

LEVEL, POWER = 0.05, 0.95  # wrongly replaced at most; found at least, where sigmas allow it
LEAST_CHANCE = 0.00135  # of what is seen, were it as expected: three standard errors
FEWEST_TRIALS = 5  # of a case: of fewer even all of them say little


@dataclass(frozen=True)
class Summary:
    """What all scans of a case said, as counts."""

    case: str
    change: Change
    cameras: int
    trials: int
    refused: int
    replace: int
    keep: int
    inconclusive: int
    named: int  # the right camera and no other
    among: int  # the right camera, or one of several of which it is one, said to be so
    allowed: int  # trials whose sigmas let expect the change to be found
    replace_allowed: int  # of these
    nameable: int  # of these, trials whose sigmas let expect the camera to be named
    named_nameable: int  # of these
    detectable_px: float  # median
    worst: str  # where it most often is
    surest: str  # the test that most often is


def summarise(
    case: str, change: Change, cameras: int, power: float, rows: Sequence[Row], refused: int = 0
) -> Summary:
    """Counts over the rows of a case; power: from which on sigmas allow a change to be found."""
    some: list[Any] = list(rows)
    allowed = [row for row in some if row["power"] >= power]
    nameable = [row for row in allowed if row["nameable"]]
    said = [row["verdict"] for row in some]
    return Summary(
        case=case,
        change=change,
        cameras=cameras,
        trials=len(some),
        refused=refused,
        replace=said.count("replace"),
        keep=said.count("keep"),
        inconclusive=said.count("inconclusive"),
        named=sum(row["named"] for row in some),
        among=sum(row["among"] for row in some),
        allowed=len(allowed),
        replace_allowed=sum(row["verdict"] == "replace" for row in allowed),
        nameable=len(nameable),
        named_nameable=sum(row["named"] for row in nameable),
        detectable_px=float(np.median([row["detectable_px"] for row in some])),
        worst=_commonest([row["worst"] for row in some]),
        surest=_commonest([row["surest"] for row in some]),
    )


def _commonest(words: Sequence[str]) -> str:
    return max(sorted(set(words)), key=words.count)


def broken(one: Summary) -> list[str]:
    """What of a case is not as expected, by more than chance."""
    found = []
    if one.refused:
        found.append(f"{one.refused} of {one.trials + one.refused} scans refused")
    if one.change in UNTOUCHED and too_many(one.replace, one.trials):
        found.append(f"{one.replace} of {one.trials} untouched rigs replaced")
    if one.change in TOO_WEAK and too_many(one.trials - one.inconclusive, one.trials):
        found.append(f"{one.inconclusive} of {one.trials} scans too weak to tell inconclusive")
    if too_many(one.allowed - one.replace_allowed, one.allowed):
        found.append(f"{one.replace_allowed} of {one.allowed} changes found")
    if one.cameras > 2 and too_many(one.nameable - one.named_nameable, one.nameable):
        found.append(f"the camera named in {one.named_nameable} of {one.nameable}")
    return found


def broken_together(summaries: Sequence[Summary]) -> list[str]:
    """What of all rigs together is not as expected, though each alone may be by chance."""
    some = [one for one in summaries if one.change == "none"]
    replace, trials = (sum(getattr(one, name) for one in some) for name in ("replace", "trials"))
    if len(some) > 1 and too_many(replace, trials):
        return [f"{replace} of {trials} untouched rigs replaced"]
    return []


def too_little_allowed(summaries: Sequence[Summary]) -> bool:
    """Whether sigmas allow so little of what is meant to be found that finding it says nothing."""
    some = [one for one in summaries if one.change in FINDABLE and one.cameras > 2]
    return sum(one.allowed for one in some) < LEAST_ALLOWED * sum(one.trials for one in some)


def too_many(wrong: int, of: int) -> bool:
    """More than chance makes of LEVEL = 1 - POWER."""
    return bool(stats.binom.sf(wrong - 1, of, LEVEL) < LEAST_CHANCE) if of else False


def in_words(summaries: Sequence[Summary]) -> str:
    """The numbers that decide, over all cases, in one line."""

    def total(name: str, some: Sequence[Summary]) -> int:
        return sum(getattr(one, name) for one in some)

    untouched = [one for one in summaries if one.change == "none"]
    weak = [one for one in summaries if one.change in TOO_WEAK]
    changed = [one for one in summaries if one.change not in UNTOUCHED]
    named = [one for one in changed if one.cameras > 2]
    parts = []
    if untouched:
        parts.append(
            f"{total('replace', untouched)} of {total('trials', untouched)} untouched rigs replaced"
        )
    if total("allowed", changed):
        parts.append(
            f"{total('replace_allowed', changed)} of {total('allowed', changed)} changes found "
            "that the sigmas allow to be found"
        )
    if total("nameable", named):
        parts.append(
            f"the camera named in {total('named_nameable', named)} of {total('nameable', named)}"
        )
    if weak:
        parts.append(
            f"{total('inconclusive', weak)} of {total('trials', weak)} scans too weak to tell "
            "inconclusive"
        )
    return ", ".join(parts)


def overview(summaries: Sequence[Summary]) -> AnswerTable:
    """A row a case."""
    columns = (
        "case", "trials", "refused", "replace", "keep", "inconclusive", "right camera named",
        "or among those named", "allowed by sigmas", "replace of these", "nameable",
        "named of these", "detectable px", "where", "surest test",
    )  # fmt: skip
    rows = tuple(
        (
            one.case,
            one.trials,
            one.refused,
            one.replace,
            one.keep,
            one.inconclusive,
            one.named,
            one.among,
            one.allowed,
            one.replace_allowed,
            one.nameable,
            one.named_nameable,
            one.detectable_px,
            one.worst,
            one.surest,
        )
        for one in summaries
    )
    return AnswerTable("cases", "What was said of each case", columns, rows)


def figure(summaries: Sequence[Summary]) -> AnswerFigure:
    """Verdicts of each case as bars of shares."""
    bars = go.Figure()
    cases = [plain(one.case) for one in summaries]
    for verdict, colour in (("replace", RED), ("inconclusive", AMBER), ("keep", BLUE)):
        shares = [100 * getattr(one, verdict) / one.trials for one in summaries]
        bars.add_bar(x=cases, y=shares, name=verdict, marker={"color": colour})
    styled(bars, 440)
    bars.update_layout(barmode="stack", showlegend=True)
    bars.update_xaxes(tickangle=45, automargin=True)
    bars.update_yaxes(title="% of the scans")
    caption = (
        "Rigs with nothing done to them should not be replaced, scans too weak to tell be "
        "inconclusive; a change is found where sigmas allow it, which the table counts."
    )
    return AnswerFigure("verdicts", "What was said", caption, bars)

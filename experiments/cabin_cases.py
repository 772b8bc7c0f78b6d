"""Trials of `depth_camera_cabin` by case, and numbers of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from experiments.cabin_calibration import CabinOptions
from experiments.cabin_model import FAILED_MM
from experiments.runner.protocol import Finished
from experiments.standard_errors import mean_and_error

Trials = Sequence[Finished[CabinOptions]]
Cases = Mapping[str, Trials]  # finished ones, by what is said of the case

FEWEST = 4  # cabins from which anything is concluded
NOTHING, FACTORY, BOARDS = "nothing", "places by boards, factory lenses", "boards"
SCAN, LOOSE, ADDED, TRUTH = "scan, tape", "scan, no length", "scan + one board", "truth"


def case_of(options: CabinOptions) -> str:
    """The case in a few words."""
    known = options.intrinsics, options.extrinsics
    if options.way == "none":
        by_hand = f"places by hand ({options.hand_deg:g}°, {options.hand_mm:g} mm)"
        return {
            ("factory", "hand"): NOTHING,
            ("exact", "exact"): TRUTH,
            ("exact", "hand"): f"exact lenses, {by_hand}",
        }.get(known, "factory lenses, exact places")
    scan = SCAN if options.scale == "tape" else LOOSE
    way = {"boards": BOARDS, "scan": scan, "scan_board": ADDED}[options.way]
    lenses = f"{options.intrinsics} lenses"
    return {
        ("calibrated", "calibrated"): way,
        ("factory", "calibrated"): f"places by {way}, factory lenses",
        ("calibrated", "hand"): f"lenses by {way}, places by hand",
    }.get(known, f"{way}: {lenses}, {options.extrinsics} places")


def by_case(trials: Trials) -> Cases:
    """In the order in which cases come."""
    names = dict.fromkeys(case_of(one.options) for one in trials)
    return {name: [one for one in trials if case_of(one.options) == name] for name in names}


def is_swept(trials: Trials) -> bool:
    """Whether a case is one of those with exact lenses and places by hand."""
    options = trials[0].options
    return (options.way, options.intrinsics, options.extrinsics) == ("none", "exact", "hand")


def is_lost(trial: Finished[CabinOptions]) -> bool:
    """Whether ICP left a part of the model where it does not belong."""
    return number(trial, "registered_misplaced_mm") > FAILED_MM


def is_refused(trial: Finished[CabinOptions]) -> bool:
    """Whether ICP said of a part that it could not be registered, and let it be."""
    return number(trial, "refused") > 0


def number(trial: Finished[CabinOptions], column: str) -> float:
    """What a trial measured; NaN, where it did not."""
    value = trial.row.get(column)
    return float(value) if isinstance(value, int | float) else float("nan")


def mean(trials: Trials, column: str) -> tuple[float, float]:
    """Mean over trials that measured it and its standard error, infinite of one."""
    values = np.array([number(one, column) for one in trials])
    values = values[np.isfinite(values)]
    return mean_and_error(values) if len(values) else (float("nan"), float("inf"))


def paired(trials: Trials, others: Trials, column: str) -> tuple[float, float]:
    """Mean of the differences on the same cabins and its standard error, infinite of too few."""
    there = {one.seed: number(one, column) for one in others}
    less = np.array([number(one, column) - there[one.seed] for one in trials if one.seed in there])
    less = less[np.isfinite(less)]
    if not len(less):
        return float("nan"), float("inf")
    found, error = mean_and_error(less)
    return found, error if len(less) >= FEWEST else float("inf")


def common(trials: Trials, others: Trials, column: str) -> tuple[Trials, Trials]:
    """Those of both whose cabin both measured."""
    seeds = [{t.seed for t in some if np.isfinite(number(t, column))} for some in (trials, others)]
    both = seeds[0] & seeds[1]
    return [one for one in trials if one.seed in both], [one for one in others if one.seed in both]


def share(trials: Trials, is_so: Callable[[Finished[CabinOptions]], bool]) -> float:
    """Of the trials of which something is so."""
    return float(np.mean([is_so(one) for one in trials]))


def cell(value: float) -> float | None:
    """A number of a table; nothing, where it was not measured."""
    return value if np.isfinite(value) else None

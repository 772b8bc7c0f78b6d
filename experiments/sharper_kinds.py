"""Trials of the study `sharper_tracks` by scan and kind of tracks, and kinds beside raw SIFT."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.calibration_options import SIMULATE
from experiments.runner.protocol import TIMING, Finished, Row
from experiments.scatter import Value
from experiments.sharper_trial import SharperOptions
from experiments.standard_errors import jackknifed
from graphs.frames import FloatArray

Some = Sequence[Finished[SharperOptions]]
# Options that make the tracks; all others are of the scan, and kinds are compared within these.
OF_KIND = ("features", "matcher", "weights", "refine", "image_scale", "device")
CALLED = {"sift": "SIFT", "xfeat": "XFeat", "aliked": "ALIKED", "disk": "DISK"}
STAGES = ("features", "matches", "mapping", "patches", "solve")
OF_ONE_KIND = ("patches", "solve")
FOCAL, CENTRE = ("fx", "fy"), ("cx", "cy")


@dataclass(frozen=True)
class Kind:
    """What is tracked, and whether its patches are matched."""

    features: str = "sift"
    matcher: str = "auto"
    image_scale: float = 1.0
    refined: bool = False
    weights: str | None = None
    device: str = "cpu"

    @staticmethod
    def of(options: SharperOptions) -> Kind:
        """What is left out is as usual."""
        said = options.said
        weights = said.get("weights")
        return Kind(
            said.get("features", "sift"), said.get("matcher", "auto"),
            float(said.get("image_scale", 1.0)), bool(said.get("refine", False)),
            None if weights is None else Path(weights).name, said.get("device", "cpu"),
        )  # fmt: skip

    @property
    def name(self) -> str:
        words = [CALLED.get(self.features, self.features)]
        words += [f"by {self.matcher}"] if self.matcher != "auto" else []
        words += [f"in images of {self.image_scale:g}"] if self.reduced else []
        words += ["refined"] if self.refined else []
        words += [f"weights {self.weights}"] if self.weights else []
        words += [f"on {self.device}"] if self.device != "cpu" else []
        return ", ".join(words)

    @property
    def reduced(self) -> bool:
        return self.image_scale < 1


RAW = Kind()


@dataclass(frozen=True)
class Case:
    """One scan, or the scans that one simulation draws by seed, and all its trials."""

    name: str
    rendered: bool
    trials: Mapping[Kind, Mapping[int, Finished[SharperOptions]]]  # those that went well, by seed

    def rows(self, kind: Kind) -> list[Row]:
        """Of all seeds."""
        return [one.row for one in self.trials.get(kind, {}).values()]

    def seconds(self, kind: Kind, stage: str) -> dict[int, float]:
        """Of a stage, by seed, where a trial did it: raw and refined tracks share all before."""
        kinds = (kind,) if stage in OF_ONE_KIND else (kind, replace(kind, refined=not kind.refined))
        return {
            seed: taken
            for one in kinds
            for seed, trial in self.trials.get(one, {}).items()
            if (taken := number(trial.row, f"{TIMING}_{stage}")) is not None
        }

    def pairs(self, kind: Kind) -> Iterator[tuple[Row, Row]]:
        """Rows of raw SIFT and of a kind, of every seed that has both."""
        raw, other = (self.trials.get(one, {}) for one in (RAW, kind))
        yield from ((raw[seed].row, other[seed].row) for seed in raw if seed in other)


def cases_of(trials: Some) -> list[Case]:
    """Trials of one scan together, in their order; scans of which none went well left out."""
    found: dict[str, dict[Kind, dict[int, Finished[SharperOptions]]]] = {}
    options: dict[str, dict[str, object]] = {}
    first: dict[str, SharperOptions] = {}
    for one in trials:
        dumped = one.options.model_dump(mode="json")
        of_scan = {key: value for key, value in dumped.items() if key not in OF_KIND}
        key = json.dumps(of_scan, sort_keys=True)
        options[key], first[key] = of_scan, one.options
        if one.error is None:
            kinds = found.setdefault(key, {})
            kinds.setdefault(Kind.of(one.options), {})[one.seed] = one
    names = dict(zip(first, _names(list(first.values()), list(options.values())), strict=True))
    return [Case(names[key], bool(first[key].simulate), kinds) for key, kinds in found.items()]


def _names(first: Sequence[SharperOptions], options: Sequence[Mapping[str, object]]) -> list[str]:
    """What each scan is called, with the options that tell it from others of that name."""
    short = [_name(one) for one in first]
    said = []
    for name, own in zip(short, options, strict=True):
        others = [o for o, other in zip(options, short, strict=True) if other == name]
        varied = [key for key in own if any(other[key] != own[key] for other in others)]
        said.append(", ".join([name, *(f"{key} {own[key]}" for key in varied)]))
    return said


def _name(options: SharperOptions) -> str:
    if options.name:
        return options.name
    if options.scan is not None:
        return "/".join(options.scan.parts[-2:])
    return str(options.said.get(SIMULATE + "trajectory", "handheld"))


def kinds_of(cases: Sequence[Case]) -> list[Kind]:
    """Every kind there is, raw SIFT first."""
    every = dict.fromkeys(kind for case in cases for kind in case.trials)
    return sorted(every, key=lambda kind: kind != RAW)


# ---- what is measured ----------------------------------------------------------------------

Measure = Callable[[Row], float | None]  # a square, of one trial; None: not measured


def number(row: Row, column: str) -> float | None:
    """What was measured; None where it was not."""
    value: Any = row.get(column)
    return None if value is None or not math.isfinite(value) else float(value)


def square_of(column: str) -> Measure:
    """Of a number of the row."""

    def measure(row: Row) -> float | None:
        value = number(row, column)
        return None if value is None else value**2

    return measure


def mean_square_of(column: str, parameters: Sequence[str]) -> Measure:
    """Of a list of the row, over all cameras' parameters of these names."""

    def measure(row: Row) -> float | None:
        values = values_of(row, column, parameters)
        return float(np.mean(np.square(values))) if values.size else None

    return measure


def values_of(row: Row, column: str, parameters: Sequence[str]) -> FloatArray:
    """Of a list of the row, those of all cameras' parameters of these names (n,)."""
    values: Any = row.get(column) or ()
    both = zip(names_of(row), values, strict=True)
    some = [value for name, value in both if name.rpartition(".")[2] in parameters]
    return np.array(some, dtype=np.float64)


def names_of(row: Row) -> tuple[str, ...]:
    """The parameters that were compared with a truth or a reference."""
    names: Any = row.get("names") or ()
    return tuple(names)


def root_mean(rows: Sequence[Row], measure: Measure) -> float | None:
    """Over all rows that have it."""
    squares = [one for row in rows if (one := measure(row)) is not None]
    return float(np.mean(squares)) ** 0.5 if squares else None


def gain(cases: Sequence[Case], kind: Kind, measure: Measure) -> Value | None:
    """How many times smaller than raw SIFT's, rms over the seeds: the geometric mean over cases.

    With its standard error, by leaving out one pair of trials after the other. None where no scan
    was measured with both.
    """
    rows = [
        (place, raw, other)
        for place, case in enumerate(cases)
        for before, after in case.pairs(kind)
        if (raw := measure(before)) is not None and (other := measure(after)) is not None
    ]
    if not rows:
        return None
    value, error = jackknifed(_geometric, rows)
    return value, error if math.isfinite(error) else None


def _geometric(rows: FloatArray) -> float:
    """rows (n, 3): which case, and the two squares."""
    ratios = []
    for place in np.unique(rows[:, 0]):
        raw, other = rows[rows[:, 0] == place, 1:].sum(0)
        ratios.append(0.5 * np.log(max(raw, 1e-300) / max(other, 1e-300)))
    return float(np.exp(np.mean(ratios)))

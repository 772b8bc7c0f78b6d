"""What trials of calibrations say together: of a fleet rig by rig, of a sweep option by option."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from experiments.calibration_options import SEED, SIMULATE, CalibrationOptions
from experiments.calibration_rows import SIGMA
from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from sfm_calib.report.digits import short

VERDICTS = ("keep", "replace", "inconclusive", "usable", "not usable", "failed")
TO_NAME = ("replace", "not usable", "failed")  # in the one line, with the reason
MOST_NAMED = 3  # of each
MOST_LETTERS = 80  # of a reason
STANDARD_ERRORS = 3.0
# What is drawn against swept options: lens parameters of every camera, then places in the rig.
DRAWN: Mapping[str, tuple[str, ...]] = {
    "focal length": ("fx", "fy"),
    "principal point": ("cx", "cy"),
    "rotation": ("rotation_x", "rotation_y", "rotation_z"),
    "baseline": ("baseline",),
}
UNITS = {"focal length": "px", "principal point": "px", "rotation": "deg", "baseline": "m"}
COLUMNS = {
    "drifted": "drifted", "p": "p", "largest change": "change", "px": "change_px",
    "found from px": "detectable_px", "weak": "weak", "rms px": "rms_px", "noise px": "noise_px",
    "frames": "n_frames", "converged": "converged", "error px": "error_px", "z rms": "z_rms",
}  # fmt: skip
OF_RIG = ("name", "scan", "old", "board", "board_images", "truth", "report")  # and not how


@dataclass(frozen=True)
class Calibrated:
    """A trial with what tables call it."""

    trial: Finished[CalibrationOptions]
    rig: str
    settings: tuple[tuple[str, object], ...]  # options that vary within the rig

    @property
    def verdict(self) -> str:
        if self.trial.error is not None:
            return "failed"
        drift = self.trial.row.get("drift")
        return str(drift) if drift else "usable" if self.trial.row.get("usable") else "not usable"

    @property
    def reason(self) -> str:
        """Of the verdict, in a few words."""
        row = self.trial.row
        said = {"failed": self.trial.error, "not usable": row.get("weak")}
        text = str(said.get(self.verdict, row.get("change")) or "")
        return text if len(text) <= MOST_LETTERS else text[: MOST_LETTERS - 3] + "..."

    @property
    def name(self) -> str:
        """The rig, and what sets the trial apart from others of it."""
        settings = ", ".join(f"{key} {value}" for key, value in self.settings)
        return f"{self.rig} ({settings})" if settings else self.rig

    def number(self, column: str) -> float | None:
        """What was measured; None where it was not."""
        value = self.trial.row.get(column)
        if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
            return None
        return float(value)

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Columns that have a sigma beside them, one that is not zero."""
        row = self.trial.row
        return tuple(n for n in row if self.number(n) is not None and self.number(n + SIGMA))


def answer(trials: Sequence[Finished[CalibrationOptions]]) -> Answer:
    """The verdicts, rig by rig; what swept options do to parameters; how far off a truth is."""
    if not trials:
        return Answer("no trial was finished", None)
    every = labelled(trials)
    swept = list(dict.fromkeys(key for one in every for key, _ in one.settings))
    said, holds = against_truth(every)
    sentences = (verdicts(every), *moved_most(every, swept), *said)
    tables = [rig_table(every, swept)]
    if len({one.rig for one in every}) < len(every):
        tables += [parameter_table(every, swept)]
    figures = [*drift_figure(every), *sweep_figures(every, swept)]
    return Answer("; ".join(sentences), holds, tuple(tables), tuple(figures))


# ---- which is which ------------------------------------------------------------------------


def labelled(trials: Sequence[Finished[CalibrationOptions]]) -> list[Calibrated]:
    """Every trial with its rig's name, and the options that vary among those of one rig."""
    names = _names([trial.options for trial in trials])
    said = [_said(trial) for trial in trials]
    values: dict[tuple[str, str], set[str]] = {}
    for name, one in zip(names, said, strict=True):
        for key, value in one.items():
            values.setdefault((name, key), set()).add(json.dumps(value))
    return [
        Calibrated(
            trial,
            name,
            tuple((key, _plain(v)) for key, v in one.items() if len(values[name, key]) > 1),
        )
        for trial, name, one in zip(trials, names, said, strict=True)
    ]


def _said(trial: Finished[CalibrationOptions]) -> dict[str, object]:
    options = trial.options.model_dump(mode="json")
    return {key: value for key, value in options.items() if key not in OF_RIG} | {SEED: trial.seed}


def _plain(value: object) -> object:
    """A value as a table shows it: None is what rig.yaml says, or the default."""
    if value is None:
        return "default"
    return value if isinstance(value, int | float | str) else json.dumps(value)


def _names(options: Sequence[CalibrationOptions]) -> list[str]:
    """What each is called: by its name, or else by what tells its scan from others."""
    scans = {one.scan for one in options if one.scan}
    folders = [scan.parent if len(scans) > 1 else scan.parent.parent for scan in scans]
    common = os.path.commonpath(folders) if folders else ""
    return [
        one.name or (os.path.relpath(one.scan, common) if one.scan else f"simulated {one.simulate}")
        for one in options
    ]


# ---- words ---------------------------------------------------------------------------------


def verdicts(every: Sequence[Calibrated]) -> str:
    """How many of each, and which are to be looked at."""
    counts = Counter(one.verdict for one in every)
    said = []
    for verdict in VERDICTS:
        if counts[verdict]:
            some = [one for one in every if one.verdict == verdict]
            said.append(f"{counts[verdict]} {verdict}{_named(some) if verdict in TO_NAME else ''}")
    each_rig_once = len({one.rig for one in every}) == len(every)
    noun = "rig" if each_rig_once else "trial"
    return f"{len(every)} {noun}{'s' * (len(every) != 1)}: {', '.join(said)}"


def _named(some: Sequence[Calibrated]) -> str:
    first = [f"{one.name}: {one.reason}".rstrip(": ") for one in some[:MOST_NAMED]]
    more = [f"and {len(some) - MOST_NAMED} more"] if len(some) > MOST_NAMED else []
    return f" ({'; '.join(first + more)})"


def moved_most(every: Sequence[Calibrated], swept: Sequence[str]) -> Iterator[str]:
    """The parameter that a swept option moves farthest, in its own sigmas."""
    found: list[tuple[float, float, str, str]] = []
    for key in swept:
        if key == SEED:
            continue
        for (rig, name), groups in _by_value(every, key).items():
            means = [float(np.mean([v for v, _ in some])) for some in groups.values()]
            sigma = float(np.mean([s for some in groups.values() for _, s in some]))
            span = max(means) - min(means)
            found.append((span / sigma, span, key, f"{name} of {rig}"))
    if found:
        sigmas, span, key, name = max(found)
        yield f"{key} moves {name} most, by {short(span)} ({short(sigmas)} sigma)"


def _by_value(
    every: Sequence[Calibrated], key: str
) -> dict[tuple[str, str], dict[object, list[tuple[float, float]]]]:
    """Values and sigmas of every parameter of every rig, by what an option was; of usable results
    alone, for others may be anywhere."""
    found: dict[tuple[str, str], dict[object, list[tuple[float, float]]]] = {}
    for one in every:
        if not one.trial.row.get("usable"):
            continue
        for name in one.parameters:
            value, sigma = one.number(name), one.number(name + SIGMA)
            settings = dict(one.settings)
            if value is not None and sigma is not None and key in settings:
                groups = found.setdefault((one.rig, name), {})
                groups.setdefault(settings[key], []).append((value, sigma))
    return found


def against_truth(every: Sequence[Calibrated]) -> tuple[list[str], bool | None]:
    """How large errors are beside the sigmas, and whether chance allows it: no larger, that is.

    Trials of one scan share its errors and count together as one.
    """
    shares: dict[tuple[object, ...], list[tuple[float, float]]] = {}
    for one in every:
        z, directions = one.number("z_rms"), one.number("z_directions")
        if z is not None and directions:
            options = one.trial.options
            drawn = (one.trial.seed, options.said.get(SIMULATE + SEED)) if options.simulate else ()
            data = (one.rig, options.scan, *drawn)
            shares.setdefault(data, []).append((z**2 * directions, directions))
    if not shares:
        return [], None
    chi2, directions = np.sum([np.mean(some, axis=0) for some in shares.values()], axis=0).tolist()
    by_chance = math.sqrt(2 / directions)  # of the mean square, where the sigmas are true
    z = math.sqrt(chi2 / directions)
    bar = z * by_chance / 2
    of = f"{len(shares)} scan{'s' * (len(shares) != 1)}"
    said = f"errors are {z:.2f} ± {bar:.2f} times what the sigmas say ({of} with a truth)"
    return [said], z**2 <= 1 + STANDARD_ERRORS * by_chance


# ---- tables --------------------------------------------------------------------------------


def rig_table(every: Sequence[Calibrated], swept: Sequence[str]) -> AnswerTable:
    """A row a trial."""
    there = {title: column for title, column in COLUMNS.items() if _any(every, column)}
    columns = ("rig", *swept, "verdict", *there, "failure")
    rows = []
    for one in every:
        settings, row = dict(one.settings), one.trial.row
        rows.append((
            one.rig, *(_cell(settings.get(key)) for key in swept), one.verdict,
            *(_cell(row.get(column)) for column in there.values()), one.trial.error,
        ))  # fmt: skip
    return AnswerTable("rigs", "Rig by rig", columns, tuple(rows))


def _any(every: Sequence[Calibrated], column: str) -> bool:
    return any(one.trial.row.get(column) is not None for one in every)


def _cell(value: object) -> str | float | int | bool | None:
    return value if isinstance(value, str | float | int | bool) else None


def parameter_table(every: Sequence[Calibrated], swept: Sequence[str]) -> AnswerTable:
    """Mean and scatter of every parameter over the seeds, for each combination of options."""
    keys = [key for key in swept if key != SEED]
    groups: dict[tuple[object, ...], list[Calibrated]] = {}
    for one in every:
        settings = dict(one.settings)
        groups.setdefault((one.rig, *(settings.get(key) for key in keys)), []).append(one)
    rows = []
    for group, some in groups.items():
        for name in dict.fromkeys(name for one in some for name in one.parameters):
            got = [(one.number(name), one.number(name + SIGMA)) for one in some]
            values = np.array([v for v, s in got if v is not None and s is not None])
            sigmas = np.array([s for v, s in got if v is not None and s is not None])
            scatter = float(values.std(ddof=1)) if len(values) > 1 else None
            mean, sigma = float(values.mean()), float(sigmas.mean())
            rows.append((*map(_cell, group), name, len(values), mean, scatter, sigma))
    columns = ("rig", *keys, "parameter", "trials", "mean", "scatter", "sigma")
    return AnswerTable("parameters", "Parameters by option", columns, tuple(rows))


# ---- figures -------------------------------------------------------------------------------


def drift_figure(every: Sequence[Calibrated]) -> Iterator[AnswerFigure]:
    """The largest change of each rig, beside what would be found wherever it is."""
    some = [one for one in every if one.number("change_px") is not None]
    if not some:
        return
    x = [one.name for one in some]
    change, found = (
        [one.number(column) or math.nan for one in some]
        for column in ("change_px", "detectable_px")
    )
    series = [Series("largest change", x, change), Series("found wherever it is", x, found)]
    figure = lines(series, "", "px, rms over an image", log_y=True)
    figure.update_traces(mode="markers")
    figure.update_traces(selector=1, marker={"symbol": "line-ew-open", "size": 18})
    yield AnswerFigure(
        "drift", "Change of each rig",
        "Where nothing was found, the largest change is what noise makes of an untouched rig.",
        figure,
    )  # fmt: skip


def sweep_figures(every: Sequence[Calibrated], swept: Sequence[str]) -> Iterator[AnswerFigure]:
    """Parameters against every swept option, less their mean; bars: one stated sigma."""
    for key in swept:
        if key == SEED:
            continue
        found = _by_value(every, key)
        rigs = {rig for rig, _ in found}
        for title, parameters in DRAWN.items():
            series = [
                _series(name if len(rigs) == 1 else f"{name} of {rig}", groups)
                for (rig, name), groups in found.items()
                if name.rpartition(".")[2] in parameters and len(groups) > 1
            ]
            if series:
                unit = UNITS[title]
                file = f"{key}_{title}".replace(" ", "_").replace(".", "_")
                yield AnswerFigure(
                    file, f"{title.capitalize()} against {key}",
                    f"Usable results, each less its mean over {key}; bars: the stated sigma.",
                    lines(series, key, f"change, {unit}"),
                )  # fmt: skip


def _series(name: str, groups: Mapping[object, Sequence[tuple[float, float]]]) -> Series:
    numeric = all(isinstance(value, int | float) for value in groups)
    x = sorted(groups) if numeric else list(groups)  # type: ignore[type-var]
    means = np.array([np.mean([v for v, _ in groups[value]]) for value in x])
    bars = [float(np.mean([s for _, s in groups[value]])) for value in x]
    shown = [float(v) for v in x] if numeric else [str(v) for v in x]  # type: ignore[arg-type]
    return Series(name, shown, (means - means.mean()).tolist(), bars)

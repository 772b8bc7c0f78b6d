"""What the study `sharper_tracks` requires of refined tracks, and whether they reach it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.runner.protocol import Answer, AnswerTable
from experiments.scatter import Value, in_digits, mean_of, ratio_of
from experiments.sharper_figures import (
    figures,
    kind_table,
    mean,
    numbers,
    parameter_table,
    seconds_table,
)
from experiments.sharper_kinds import (
    CENTRE,
    FOCAL,
    RAW,
    Case,
    Kind,
    Measure,
    Some,
    cases_of,
    gain,
    kinds_of,
    mean_square_of,
    root_mean,
    square_of,
)

FEWEST_SEEDS = 4  # of rendered scans: errors of fewer say little of how large they are
NEES = (0.8, 1.3)  # as under heavy noise of the study `coverage`
TIME = "time of features and patches over that of features in full size"
WORDS = {True: "yes", False: "no", None: "too little to say"}
NO_SLOWER = 1.0  # reduced extraction and patches, of extraction in full size


@dataclass(frozen=True)
class Gain:
    """So many times smaller than with raw SIFT, something has to be."""

    what: str
    measure: Measure
    least: float
    reference: Measure | None = None  # what a reference errs by itself; a smaller rms is enough


OF_RENDERED = (
    Gain("true noise", square_of("noise_true_px"), 2.5),
    Gain("focal error", mean_square_of("error", FOCAL), 2.0),
    Gain("principal point error", mean_square_of("error", CENTRE), 2.0),
)
OF_REAL = (
    Gain("sigma_px", square_of("noise_px"), 1.5),
    Gain(
        "focal difference",
        mean_square_of("error", FOCAL),
        1.0,
        mean_square_of("sigma_reference", FOCAL),
    ),
    Gain(
        "principal point difference",
        mean_square_of("error", CENTRE),
        1.0,
        mean_square_of("sigma_reference", CENTRE),
    ),
    Gain("difference of halves", square_of("halves_px"), 1.5),
)


@dataclass(frozen=True)
class Finding:
    """A requirement, and what was found of a kind of tracks."""

    scans: str
    kind: Kind
    what: str
    wanted: str
    found: Value
    met: bool | None  # None: what is required lies within a standard error
    note: str = ""

    @property
    def verdict(self) -> str:
        return f"{WORDS[self.met]}{self.note}"

    @property
    def in_words(self) -> str:
        return f"{self.what} {in_digits(self.found)} ({self.wanted}: {self.verdict})"


def lies(found: Value, low: float, high: float) -> bool | None:
    """Whether a value is within these bounds; None where its error reaches over one of them."""
    value, error = found
    near = min(abs(value - low), abs(value - high))
    return None if error is not None and near < error else low <= value <= high


def answer(trials: Some) -> Answer:
    """The requirements of refined tracks, each with its number, on rendered scans and on others."""
    failed = tuple(
        (Kind.of(one.options).name, one.options.name or "", one.seed, one.error)
        for one in trials
        if one.error is not None
    )
    why = AnswerTable("failed", "Trials that failed", ("tracks", "name", "seed", "why"), failed)
    cases = cases_of(trials)
    if not cases:
        return Answer(f"none of {len(trials)} trials went well", None, (why,) if failed else ())
    findings = [one for some in by_source(cases) for one in findings_of(some)]
    judged = [one for one in findings if is_judged(one, findings)]
    few = [said for some in by_source(cases) for said in too_few(some)]
    met = {one.met for one in judged}
    holds = None if few or not judged else False if False in met else None if None in met else True
    begin = WORDS[holds]
    said = [*sentences(cases, judged), *few]
    if failed:
        said.append(f"{len(failed)} of {len(trials)} trials failed")
    tables = [requirement_table(findings), kind_table(cases), parameter_table(cases)]
    tables += [seconds_table(cases), *([why] if failed else [])]
    return Answer(f"{begin}: {'; '.join(said)}", holds, tuple(tables), figures(cases))


def by_source(cases: Sequence[Case]) -> Iterator[list[Case]]:
    """Rendered scans, and real ones."""
    for rendered in (True, False):
        some = [case for case in cases if case.rendered == rendered]
        if some:
            yield some


def named(cases: Sequence[Case]) -> str:
    """What the scans of one source are called together."""
    return f"{'rendered' if cases[0].rendered else 'real'} ({', '.join(c.name for c in cases)})"


def too_few(cases: Sequence[Case]) -> Iterator[str]:
    """What is missing to say anything of the scans of one source."""
    refined = [kind for kind in kinds_of(cases) if kind.refined]
    if not any(True for kind in refined for case in cases for _ in case.pairs(kind)):
        yield f"{named(cases)}: nothing refined beside raw SIFT went well"
    elif cases[0].rendered:
        fewest = min(len(case.rows(kind)) for case in cases for kind in (RAW, *refined))
        if fewest < FEWEST_SEEDS:
            yield f"{named(cases)}: {fewest} seed{'s' * (fewest != 1)} of {FEWEST_SEEDS} needed"


# ---- requirements --------------------------------------------------------------------------


def findings_of(cases: Sequence[Case]) -> Iterator[Finding]:
    """Of every kind of refined tracks, on the scans of one source."""
    scans, rendered = named(cases), cases[0].rendered
    for kind in kinds_of(cases):
        if not kind.refined:
            continue
        for one in OF_RENDERED if rendered else OF_REAL:
            found = gain(cases, kind, one.measure)
            if found is not None:
                if not rendered:  # other seeds map and halve the same images again
                    found = found[0], None
                met = lies(found, one.least, math.inf)
                near = met is not True and within_reference(cases, kind, one)
                wanted = f"{one.least:g} times smaller" if one.least > 1 else "no larger"
                note = ", within the reference's own sigma" if near else ""
                yield Finding(scans, kind, one.what, wanted, found, near or met, note)
        if rendered:
            yield from _consistency(cases, kind, scans)
        yield from _time(cases, kind, scans)


def within_reference(cases: Sequence[Case], kind: Kind, one: Gain) -> bool:
    """Whether a kind is off by no more than the reference itself may be, in every case."""
    if one.reference is None:
        return False
    for case in cases:
        own = root_mean(case.rows(kind), one.measure)
        allowed = root_mean(case.rows(kind), one.reference)
        if own is not None and (allowed is None or own > allowed):
            return False
    return True


def _consistency(cases: Sequence[Case], kind: Kind, scans: str) -> Iterator[Finding]:
    found = mean_of(np.concatenate([numbers(case.rows(kind), "nees_stated") for case in cases]))
    low, high = NEES
    yield Finding(scans, kind, "NEES", f"{low:g} to {high:g}", found, lies(found, low, high))


def _time(cases: Sequence[Case], kind: Kind, scans: str) -> Iterator[Finding]:
    """Of features in reduced images and their patches, over that of features in full ones."""
    if not kind.reduced:
        return
    pairs = []
    for case in cases:
        features, patches = case.seconds(kind, "features"), case.seconds(kind, "patches")
        for seed, full in case.seconds(RAW, "features").items():
            if seed in features and seed in patches:
                pairs.append((features[seed] + patches[seed], full))
    if pairs:
        found = ratio_of(np.array(pairs))
        yield Finding(
            scans, kind, TIME, f"{NO_SLOWER:g} at most", found, lies(found, 0.0, NO_SLOWER)
        )


def is_judged(one: Finding, findings: Sequence[Finding]) -> bool:
    """Whether a finding decides: of SIFT in full size where it is there, but for the time."""
    if one.kind.features != "sift":
        return not any(f.kind.features == "sift" for f in findings)
    if one.what == TIME:
        return True
    full = any(f.kind.features == "sift" and not f.kind.reduced for f in findings)
    return not one.kind.reduced or not full


# ---- words and tables ----------------------------------------------------------------------


def sentences(cases: Sequence[Case], judged: Sequence[Finding]) -> Iterator[str]:
    """What was found of each source of scans, and where the gain goes."""
    for some in by_source(cases):
        own = [one for one in judged if one.scans == named(some)]
        for kind in dict.fromkeys(one.kind for one in own):
            said = ", ".join(one.in_words for one in own if one.kind == kind)
            yield f"{named(some)}: {kind.name}: {said}"
            if any(one.kind == kind and one.what != TIME for one in own):
                yield from lost(some, kind)


def lost(cases: Sequence[Case], kind: Kind) -> Iterator[str]:
    """What of sharper tracks reaches the sigmas: noise alone, and with what errs together."""
    alone = gain(cases, kind, mean_square_of("sigma_noise", FOCAL))
    stated = gain(cases, kind, mean_square_of("sigma", FOCAL))
    if alone is None or stated is None:
        return
    raw, own = (mean([r for case in cases for r in case.rows(k)], "inflation") for k in (RAW, kind))
    yield (
        f"sigmas of the focal length are {in_digits(stated)} times smaller, of noise alone "
        f"{in_digits(alone)} times: sigmas are {own:.1f} times those of noise alone (raw SIFT "
        f"{raw:.1f} times), for what errs together"
    )


def requirement_table(findings: Sequence[Finding]) -> AnswerTable:
    """A row a requirement and kind of tracks."""
    rows = tuple(
        (
            one.scans, one.kind.name, one.what, one.wanted, one.found[0],
            one.found[1] if one.found[1] is not None and math.isfinite(one.found[1]) else None,
            one.verdict,
        )
        for one in findings
    )  # fmt: skip
    columns = ("scans", "tracks", "what", "wanted", "found", "±", "met")
    title = "Requirements: how many times smaller than with raw SIFT, and other ratios"
    return AnswerTable("requirements", title, columns, rows)

"""Drift in words: whether to keep the old calibration, what changed, what could not be seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sfm_calib.drift_record import DriftChange, DriftRecord, DriftTest
from sfm_calib.report.digits import short, sigma_text, with_digits

LEAST_P = 1e-12  # smaller ones are a matter of how normal errors are so far out
MOST_NAMED = 3  # groups in the main line
HELP = {
    "lens": "fill the images to their corners, and tilt and roll the cameras",
    "rotation": "look at things that cameras see together or one after another, and turn the rig",
    "translation": "go near things, and move the rig in all directions",
}


def verdict_lines(record: DriftRecord, of_old: bool) -> Iterator[str]:
    """The main line, and what follows from it; of_old: the old one's own sigmas hide drift."""
    found = [test for test in record.tests if test.found]
    if record.verdict == "replace":
        yield f"Replace: {_what_changed(found)}"
        yield from _which_moved(record)
    elif record.verdict == "keep":
        yield (
            f"Keep: no drift found, and {short(record.detectable_px)} px of it (rms over an "
            "image) would have been, wherever it is"
        )
    else:
        yield from _unseen(record, of_old)


def _what_changed(found: Sequence[DriftTest]) -> str:
    # All of a lens, and the rig as a whole, say again what a group says.
    parts = [t for t in found if t.group not in ("lens", "places")] or list(found)
    surest = sorted(parts, key=lambda test: test.p_value)
    named = "; ".join(change_text(test) for test in surest[:MOST_NAMED])
    more = len(surest) - MOST_NAMED
    return f"{named}; and {more} more" if more > 0 else named


def change_text(test: DriftTest) -> str:
    """What changed of one group, and how surely."""
    return f"{who(test)} {_verb(test)} ({short(test.effect_px)} px rms, {p_text(test.p_corrected)})"


def who(test: DriftTest) -> str:
    """The cameras of a test in words."""
    if test.group == "places":
        return "the rig"
    return " against ".join(reversed(test.cameras))


def _verb(test: DriftTest) -> str:
    size = size_text(test)
    return {
        "rotation": f"points {size} elsewhere",
        "translation": f"moved by {size}",
        "focal": f"has another focal length, by {size}",
        "principal point": f"has its principal point {size} off",
        "distortion": "has another distortion",
        "lens": "has another lens",
        "places": "has changed",
    }[test.group]


def size_text(test: DriftTest) -> str:
    """A group's change as one number: of a focal length the mean, else a length; or nothing."""
    changes = [one.change for one in test.changes]
    if test.group == "focal":
        mean = sum(changes) / len(changes)
        return f"{'-' if mean < 0 else '+'}{short(abs(mean))} px"
    if test.group not in ("principal point", "rotation", "translation"):
        return ""
    size, unit = sum(change**2 for change in changes) ** 0.5, test.changes[0].unit
    return f"{short(1000 * size)} mm" if unit == "m" else f"{short(size)} {unit}"


def p_text(p_value: float) -> str:
    """A p-value, as far as it means something."""
    return f"p < {LEAST_P:.0e}" if p_value < LEAST_P else f"p = {p_value:.2g}"


def _which_moved(record: DriftRecord) -> Iterator[str]:
    places = any(t.found and t.group in ("rotation", "translation", "places") for t in record.tests)
    if len(record.moved) == 1:
        (moved,) = record.moved
        why = (
            "its lens changed too: it was touched"
            if record.told_by_lens
            else "the others sit to each other as they sat"
        )
        yield f"It is {' and '.join(moved)} that moved: {why}"
    elif record.moved:
        either = ", or ".join(" and ".join(one) for one in record.moved)
        two = "of two cameras" if len(record.cameras) == 2 else "of these"
        yield f"{either}: {two} the picture cannot tell which moved"
    elif places:
        yield "No small part of the cameras explains how they sit now: the rig itself changed"


def _unseen(record: DriftRecord, of_old: bool) -> Iterator[str]:
    lost = sorted(
        (t for t in record.tests if t.decisive and t.detectable_px > record.matters_px),
        key=lambda test: -test.detectable_px,
    )
    worst = lost[0]
    group = "lens" if worst.group not in HELP else worst.group
    yield (
        f"Inconclusive: no drift found, but {group} of {who(worst)} may have drifted by "
        f"{short(worst.detectable_px)} px (rms over the image) unseen; {short(record.matters_px)} "
        "px matter"
    )
    if len(lost) > 1:
        rest = ", ".join(f"{t.group} of {who(t)} {short(t.detectable_px)} px" for t in lost[1:])
        yield f"also not known well enough: {rest}"
    if of_old:
        assumed = record.old_sigma_px
        whose = "sigmas of the old calibration" + (
            f" (assumed {assumed:g} px)" if assumed is not None else ""
        )
        yield f"It is the {whose} that hide it: another scan would not help"
        return
    for help_ in dict.fromkeys(
        HELP["lens" if test.group not in HELP else test.group] for test in lost
    ):
        yield f"to see more: {help_}"


def change_of(one: DriftChange) -> str:
    """A parameter's change with its sigma."""
    name = one.name.replace("rotation_", "").replace("centre_", "")
    factor, unit = (1000.0, "mm") if one.unit == "m" else (1.0, one.unit)
    change, sigma = factor * one.change, factor * one.sigma
    value = f"{name} {with_digits(change, sigma, '+')}"
    return f"{value} ± {sigma_text(sigma)} {unit}".rstrip() if sigma > 0 else f"{value} {unit}"

"""Weak directions in print: what they move and how far, and which parameters they mark."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sfm_calib.report.digits import short
from sfm_calib.result import OF_LENS, Calibration, WeakDirection

IN_PX = ("fx", "fy", "cx", "cy")
MUCH_MORE = 1.2  # what data alone leave open, over what they do with priors: worth saying


@dataclass(frozen=True)
class WeakCard:
    """One weak direction, ready to print."""

    what: str
    sizes: str
    remedy: str
    mover: str
    moves: tuple[str, ...]  # "left.cx ± 2.4 px", the most moved first
    without_priors: str


@dataclass(frozen=True)
class Mark:
    """A word beside a parameter that is weak, and why it is."""

    word: str
    why: str


def weak_cards(calibration: Calibration) -> tuple[WeakCard, ...]:
    """Every weak direction of the verdict."""
    unit = length_unit(calibration)
    return tuple(
        WeakCard(
            one.what,
            one.sizes,
            one.remedy,
            "that lens" if one.kind == OF_LENS else "one sigma of it",
            _moves(one, unit),
            _without_priors(one),
        )
        for one in (calibration.verdict.weak if calibration.verdict else ())
    )


def marks_of(calibration: Calibration) -> dict[str, tuple[Mark, ...]]:
    """The parameters that weak directions move, or that hang on the lens: a mark for either."""
    found: dict[str, dict[str, Mark]] = {}
    for one in calibration.verdict.weak if calibration.verdict else ():
        word = "lens" if one.kind == OF_LENS else "weak"
        for name in one.parameters:
            found.setdefault(name, {}).setdefault(word, Mark(word, one.what))
    return {name: tuple(marks.values()) for name, marks in found.items()}


def length_unit(calibration: Calibration) -> str:
    """What a length of the rig is counted in."""
    return "m" if calibration.rig.metric else "units"


def in_print(name: str, value: float, length: str) -> tuple[float, str]:
    """A value of the covariance's parameter `name`, angles in degrees, and its unit."""
    parameter = name.rpartition(".")[2]
    if parameter in IN_PX:
        return value, "px"
    if parameter.startswith("rotation_"):
        return float(np.degrees(value)), "°"
    return value, length if parameter.startswith("translation_") else ""


def _moves(one: WeakDirection, length: str) -> tuple[str, ...]:
    texts = []
    for name, move in zip(one.parameters, one.moves, strict=False):
        value, unit = in_print(name, move, length)
        # Directions of one kind are told as one: signs need not agree among them.
        sign = "by " + "-" * (value < 0) if one.kind == OF_LENS else "± "
        texts.append(f"{name} {sign}{short(abs(value))}{' ' * (unit not in ('', '°'))}{unit}")
    return tuple(texts)


def _without_priors(one: WeakDirection) -> str:
    if one.slide_px is None:
        return ""
    if one.data_slide_px is None:
        return "Without priors the scan says nothing of it."
    if one.data_slide_px <= MUCH_MORE * one.slide_px:
        return ""
    return f"Without priors it would be free by {short(one.data_slide_px)} px."

"""Figures of `depth_error`."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.depth_answer import Group
from experiments.depth_laws import LAWS
from experiments.runner.figures import Series, lines
from experiments.runner.protocol import AnswerFigure


def figures(groups: Sequence[Group]) -> tuple[AnswerFigure, ...]:
    """Those that the groups have something for."""
    alone = [g for g in groups if g.effect != "scan"]
    depth = [g for g in alone if g.effect != "scan" and LAWS[g.effect].over == "depth"]
    radius = [g for g in alone if g.effect != "scan" and LAWS[g.effect].over == "radius"]
    scans = [g for g in groups if g.effect == "scan"]
    found = []
    if depth:
        found.append(_errors("depth", "Errors over depth", "Z (m)", depth))
    if radius:
        found.append(_errors("radius", "Errors over radius", "r", radius))
    for group in scans:
        found += [_sigmas(group), _z_rms(group)]
    return tuple(found)


def _errors(name: str, title: str, x_title: str, groups: Sequence[Group]) -> AnswerFigure:
    series = [
        one
        for g in groups
        for one in (
            Series(_named(g), g.at.tolist(), g.rms_m.tolist()),
            Series(f"{_named(g)}, propagated", g.at.tolist(), g.propagated_m.tolist(), dashed=True),
        )
    ]
    caption = (
        "RMS over all rigs, by Monte Carlo and (dashed) by our propagation: the slope of a line is "
        "its exponent, and the dashes should lie on it."
    )
    figure = lines(series, x_title, "error (m)", log_x=True, log_y=True, height=480)
    return AnswerFigure(name, title, caption, figure)


def _named(group: Group) -> str:
    return group.effect if group.shape == "straight" else f"{group.effect} ({group.shape})"


def _sigmas(group: Group) -> AnswerFigure:
    at = group.at.tolist()
    series = [
        Series("actual error of the calibration", at, group.rms_m.tolist()),
        Series("stated sigma of the calibration", at, group.propagated_m.tolist(), dashed=True),
    ]
    if group.noise_m is not None:
        series.append(Series("stated sigma of one pixel pair", at, group.noise_m.tolist()))
    caption = (
        "What a calibrated scan gets wrong of depths without noise, and what it states: they "
        "should lie on each other. The noise of one measurement comes on top."
    )
    figure = lines(series, "Z (m)", "depth error (m)", log_x=True, log_y=True)
    return AnswerFigure("scan_depth", "Depth by calibrated scans", caption, figure)


def _z_rms(group: Group) -> AnswerFigure:
    values = [value for value, _ in group.ratio_at]
    bars = [error or 0.0 for _, error in group.ratio_at]
    figure = lines([Series("RMS of z", group.at.tolist(), values, bars)], "Z (m)", "RMS of z",
                   log_x=True, level=1.0)  # fmt: skip
    caption = "Depth errors of calibrated scans over their stated sigma; bars are standard errors."
    return AnswerFigure("scan_z", "Do the stated depth sigmas hold?", caption, figure)

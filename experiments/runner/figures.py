"""Figures that studies share: lines with error bars over what was swept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import plotly.graph_objects as go

from sfm_calib.report.theme import MUTED, camera_colour, plain, styled


@dataclass(frozen=True)
class Series:
    """One line: points (x, y), and the half length of the bar at each, if any."""

    name: str
    x: Sequence[float] | Sequence[str]
    y: Sequence[float]
    bar: Sequence[float] | None = None
    dashed: bool = False  # a prediction or a bound rather than a measurement


def lines(
    series: Sequence[Series],
    x_title: str,
    y_title: str,
    log_x: bool = False,
    log_y: bool = False,
    level: float | None = None,
    height: int = 380,
) -> go.Figure:
    """Lines in the reports' style; `level`: a value to compare with, drawn across."""
    figure = go.Figure()
    for index, one in enumerate(series):
        colour = camera_colour(index)
        figure.add_scatter(
            x=list(one.x),
            y=list(one.y),
            name=plain(one.name),
            mode="lines" if one.dashed else "lines+markers",
            line={"color": colour, "dash": "dash" if one.dashed else "solid"},
            error_y=None if one.bar is None else {"type": "data", "array": list(one.bar)},
        )
    if level is not None:
        figure.add_hline(y=level, line={"color": MUTED, "dash": "dot"})
    styled(figure, height)
    figure.update_xaxes(title=plain(x_title), type="log" if log_x else None)
    figure.update_yaxes(title=plain(y_title), type="log" if log_y else None)
    figure.update_layout(showlegend=True)
    return figure

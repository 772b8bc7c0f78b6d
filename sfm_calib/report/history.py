"""The page of a history: the calibrations, and each number of each camera over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import plotly.graph_objects as go
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from sfm_calib.files import write_atomically
from sfm_calib.history_record import Group, History, HistoryEntry, Quantity
from sfm_calib.history_terminal import left_out
from sfm_calib.report.digits import decimals_for, number
from sfm_calib.report.theme import (
    Panel,
    camera_colour,
    figure_html,
    page_template,
    plain,
    styled,
)

TITLE = "Calibrations over time"
NONE = "–"
ALARM_Z = 4.0
ISO = "%Y-%m-%d %H:%M:%S.%f"
DODGE = 0.006  # of the time shown, by which bars of one calibration stand apart
MARGIN = 0.05
LABELS = {"focal_x": "fx", "focal_y": "fy", "corner": "outwards"}
SHOWN: dict[Group, tuple[str, str]] = {
    "focal": ("Focal length", "Pixels per radian on the axis, whatever the lens model."),
    "principal_point": ("Principal point", "Trades against a turn of the camera: see pointing."),
    "distortion": (
        "Distortion in the corners",
        "How far distortion moves the image's corners: outwards in their mean, and all alike to "
        "the right (x) and down (y).",
    ),
    "pointing": ("Pointing", "Turn about the camera's axes, beside the reference camera."),
    "translation": ("Place", "Translation of cam_from_rig, beside the reference camera."),
    "baseline": ("Baselines", "Distances between cameras."),
}


@dataclass(frozen=True)
class CameraHistory:
    """One camera's figures."""

    name: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class QuantityCells:
    """One line of the table of numbers, ready to print."""

    name: str
    entry: int
    value: str
    sigma: str
    unit: str
    change: str
    z: str
    alarming: bool


def write_history(record: History, path: Path) -> None:
    """Write the page as one HTML file that loads nothing from anywhere.

    Raises CalibrationError when the file cannot be written; then nothing is left.
    """
    write_atomically(path, render_history(record).encode("utf-8", "replace"))


def render_history(record: History) -> str:
    """The page as text."""
    return page_template("history.html").render(
        title=TITLE,
        record=record,
        cameras=[CameraHistory(name, _panels(record, name)) for name in record.cameras],
        baselines=_panel(record, "baseline", None, "figure-baseline"),
        rows=[row for entry in record.entries for row in _cells(entry)],
        changes={entry.number: _largest(entry) for entry in record.entries},
        alarm_z=ALARM_Z,
        left_out=left_out(record),
        plotly_js=Markup(get_plotlyjs()),
    )


# ---- figures -------------------------------------------------------------------------------


def _panels(record: History, camera: str) -> tuple[Panel, ...]:
    place = record.cameras.index(camera)
    made = (
        _panel(record, group, camera, f"camera-{place}-{group}")
        for group in SHOWN
        if group != "baseline"
    )
    return tuple(panel for panel in made if panel is not None)


def _panel(record: History, group: Group, camera: str | None, key: str) -> Panel | None:
    """One figure; None where no calibration has such a number that can be compared."""
    figure = history_figure(record, group, camera)
    if figure is None:
        return None
    title, caption = SHOWN[group]
    return Panel(title, caption, figure_html(figure, key))


def history_figure(record: History, group: Group, camera: str | None) -> go.Figure | None:
    """Numbers of one group over time, each less what the first calibration has; None of none.

    camera: whose; None of baselines, which are of two.
    """
    traces: dict[str, list[tuple[HistoryEntry, Quantity]]] = {}
    for entry in record.entries:
        for one in entry.quantities:
            of_camera = camera is None or one.name.rpartition(".")[0] == camera
            if (
                one.group == group
                and one.compared
                and of_camera
                and not one.name.endswith(".focal")
            ):
                traces.setdefault(one.name, []).append((entry, one))
    traces = {
        n: points for n, points in traces.items() if any(q.value or q.sigma for _, q in points)
    }
    if not traces:
        return None
    figure = go.Figure()
    moments = [entry.when for entry in record.entries]
    span = max(moments[-1] - moments[0], timedelta(seconds=1))
    for index, (name, points) in enumerate(traces.items()):
        aside = DODGE * span * (index - (len(traces) - 1) / 2)
        _add_trace(figure, name, points, camera_colour(index), camera, aside)
    styled(figure, height=300)
    unit = next(iter(traces.values()))[0][1].unit
    figure.update_yaxes(
        title=f"since the first, {plain(unit)}", zeroline=True, exponentformat="none"
    )
    ends = [moments[0] - MARGIN * span, moments[-1] + MARGIN * span]
    figure.update_xaxes(type="date", range=[one.strftime(ISO) for one in ends])
    figure.update_layout(showlegend=True)
    return figure


def _add_trace(
    figure: go.Figure,
    name: str,
    points: Sequence[tuple[HistoryEntry, Quantity]],
    colour: str,
    camera: str | None,
    aside: timedelta,
) -> None:
    before, _, parameter = name.rpartition(".")
    label = plain(before if camera is None else _label(parameter))
    first = points[0][1]
    figure.add_scatter(
        x=[(entry.when + aside).strftime(ISO) for entry, _ in points],
        y=[one.since_first for _, one in points],
        mode="lines+markers",
        name=f"{label} ({number(first.value, decimals_for(first.sigma or 0.0))})",
        line={"color": colour, "width": 1},
        marker={"color": colour, "size": 8, "symbol": [_symbol(*point) for point in points]},
        error_y={
            "type": "data",
            "array": [one.sigma or 0.0 for _, one in points],
            "color": colour,
            "thickness": 1.5,
            "width": 3,
        },
        customdata=[
            f"{label} {_with_sigma(one)}<br>#{entry.number} {plain(entry.path)}, "
            f"{entry.when:%Y-%m-%d %H:%M}"
            for entry, one in points
        ],
        hovertemplate="%{customdata}<br>%{y:+.4g} since the first<extra></extra>",
    )


def _label(parameter: str) -> str:
    return LABELS.get(parameter, parameter.rpartition("_")[2])


def _symbol(entry: HistoryEntry, one: Quantity) -> str:
    """A square for what was copied, open for what has no sigma."""
    kept = one.name.rpartition(".")[0] in entry.kept
    return ("square" if kept else "circle") + ("" if one.sigma else "-open")


# ---- tables --------------------------------------------------------------------------------


def _with_sigma(one: Quantity) -> str:
    decimals = decimals_for(one.sigma or 0.0)
    value = number(one.value, decimals)
    return f"{value} ± {number(one.sigma, decimals)} {one.unit}" if one.sigma else value


def _largest(entry: HistoryEntry) -> tuple[str, float] | None:
    told = [(one.name, one.z) for one in entry.quantities if one.z is not None]
    return max(told, key=lambda pair: abs(pair[1]), default=None)


def _cells(entry: HistoryEntry) -> list[QuantityCells]:
    rows = []
    for one in entry.quantities:
        decimals = decimals_for(one.sigma or 0.0)
        change = NONE
        if one.change is not None:
            change = ("+" if one.change > 0 else "") + number(one.change, decimals)
        rows.append(
            QuantityCells(
                one.name,
                entry.number,
                number(one.value, decimals),
                number(one.sigma, decimals) if one.sigma else NONE,
                one.unit,
                change,
                NONE if one.z is None else f"{one.z:+.1f}",
                one.z is not None and abs(one.z) > ALARM_Z,
            )
        )
    return rows

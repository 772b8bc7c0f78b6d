"""Where the sigmas come from: of noise alone, of what errs together, and what is stated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from graphs.frames import FloatArray
from sfm_calib.report.digits import decimals_for, number
from sfm_calib.report.rows import HELD
from sfm_calib.report.theme import AMBER, BLUE, INK, MUTED, Panel, figure_html, plain, styled
from sfm_calib.report.weak import in_print, length_unit
from sfm_calib.result import Calibration, Sigmas

NONE = "–"
OPEN_UP_TO = 40  # rows of tables that are shown unasked
ROW_PX = 17
TICKS = (0.1, 0.2, 0.5, 1, 1.5, 2, 3, 4, 5, 7, 10, 15, 20, 30, 50, 100, 200, 500, 1000)


@dataclass(frozen=True)
class SigmaRow:
    """One parameter's sigmas, ready to print to the same digits."""

    name: str
    label: str
    model: str
    robust: str
    jackknife: str
    stated: str
    ratio: str  # stated over model
    unit: str


@dataclass(frozen=True)
class SigmaTable:
    """The rows of one camera."""

    name: str
    rows: tuple[SigmaRow, ...]


@dataclass(frozen=True)
class SigmaSection:
    """What the page shows of the origin of the sigmas."""

    tables: tuple[SigmaTable, ...]
    opened: bool
    has_jackknife: bool
    summary: str
    ratios: Panel | None  # None: nothing has a sigma


def sigma_section(calibration: Calibration) -> SigmaSection | None:
    """Tables and figure; None for results that do not say what their sigmas are made of."""
    sigmas = calibration.noise.sigmas if calibration.noise else {}
    if not sigmas:
        return None
    length, by_camera = length_unit(calibration), dict[str, list[SigmaRow]]()
    for name, one in sigmas.items():
        row = sigma_row(name, one, length)
        by_camera.setdefault(name.rpartition(".")[0], []).append(row)
    free = {name: one for name, one in sigmas.items() if one.model > 0 and one.stated > 0}
    ratios = [one.stated / one.model for one in free.values()]
    return SigmaSection(
        tuple(SigmaTable(name, tuple(rows)) for name, rows in by_camera.items()),
        len(sigmas) <= OPEN_UP_TO,
        any(one.jackknife is not None for one in sigmas.values()),
        _summary(np.array(ratios)),
        _ratio_panel(free) if free else None,
    )


def sigma_row(name: str, one: Sigmas, length: str) -> SigmaRow:
    """One row, with two digits of the smallest sigma in it."""
    given = (one.model, one.robust, one.jackknife, one.stated)
    unit = in_print(name, 0.0, length)[1]
    shown = [None if sigma is None else in_print(name, sigma, length)[0] for sigma in given]
    decimals = decimals_for(min((s for s in shown if s is not None and s > 0), default=0.0))
    model, robust, jackknife, stated = (
        NONE if sigma is None or not one.stated > 0 else number(sigma, decimals) for sigma in shown
    )
    return SigmaRow(
        name,
        name.rpartition(".")[2].replace("_", " "),
        model,
        robust,
        jackknife,
        stated if one.stated > 0 else HELD,
        f"× {one.stated / one.model:.1f}" if one.model > 0 else NONE,
        unit,
    )


def _summary(ratios: FloatArray) -> str:
    if not ratios.size:
        return "Nothing was estimated."
    if f"{ratios.min():.1f}" == f"{ratios.max():.1f}":
        return f"Here stated sigmas are {ratios.max():.1f} times those of noise alone."
    return (
        f"Here stated sigmas are {ratios.min():.1f} to {ratios.max():.1f} times those of noise "
        f"alone, in the median {np.median(ratios):.1f} times."
    )


def _ratio_panel(free: Mapping[str, Sigmas]) -> Panel:
    return Panel(
        "Over the sigma of noise alone",
        "The line at 1 is the model. A parameter far to the right of the others is one whose "
        "errors frames, tracks or parts of the image share most.",
        figure_html(ratio_figure(free), "sigma-ratios"),
    )


def ratio_figure(free: Mapping[str, Sigmas]) -> go.Figure:
    """Robust, jackknife and stated sigma over the model's, a parameter a row."""
    names = [plain(name) for name in free]
    kinds = (
        ("robust", [s.robust for s in free.values()], BLUE, "circle-open"),
        ("jackknife", [s.jackknife for s in free.values()], AMBER, "diamond-open"),
        ("stated", [s.stated for s in free.values()], INK, "circle"),
    )
    model = np.array([s.model for s in free.values()])
    figure, most, least = go.Figure(), 1.0, 1.0
    for kind, sigmas, colour, symbol in kinds:
        ratio = np.array([np.nan if sigma is None else sigma for sigma in sigmas]) / model
        if (ratio > 0).any():
            most, least = np.nanmax([most, *ratio]), np.nanmin([least, *ratio[ratio > 0]])
            figure.add_scatter(
                x=ratio.astype(np.float32),
                y=list(range(len(names))),
                mode="markers",
                name=kind,
                marker={"size": 8, "color": colour, "symbol": symbol},
                customdata=names,
                hovertemplate=f"%{{customdata}}<br>{kind} × %{{x:.2f}}<extra></extra>",
            )
    styled(figure, height=120 + ROW_PX * len(names))
    figure.add_vline(x=1, line={"color": MUTED, "width": 1, "dash": "dash"})
    figure.update_xaxes(
        title="sigma / sigma of noise alone",
        type="log",
        range=[np.log10(least / 1.1), np.log10(most * 1.1)],
        tickvals=TICKS,
        ticktext=[f"{tick:g}" for tick in TICKS],
    )
    figure.update_yaxes(
        tickvals=list(range(len(names))),
        ticktext=names,
        range=[len(names) - 0.5, -0.5],
        zeroline=False,
    )
    return figure

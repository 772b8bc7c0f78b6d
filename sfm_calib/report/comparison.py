"""The page of a comparison: verdict, parameters, maps of the difference, depths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from graphs.compare import Difference
from sfm_calib.compare_record import Comparison, Kind, PairDifference, ParameterDifference
from sfm_calib.compare_terminal import taken_out
from sfm_calib.compare_verdict import p_text, px_text
from sfm_calib.files import write_atomically
from sfm_calib.report.digits import at_range, decimals_for, number, short, signed_percent
from sfm_calib.report.image_plane import add_arrows, in_image
from sfm_calib.report.theme import (
    AMBER,
    BLUE,
    MAGNITUDE_SCALE,
    MUTED,
    Panel,
    camera_colour,
    figure_html,
    page_template,
    plain,
    round_number,
    styled,
)

TITLE = "Two calibrations compared"
EVERY = 3  # pixel of a map that has an arrow, each way
LEAST_PX = 1e-3  # colours reach at least so far: of equal calibrations all is pale
COLOURS_REACH = 0.98  # quantile of a map: the outermost corner would hide the rest
ROW_PX = 17
MOST_Z = 12.0  # beyond, bars are cut
BANNERS: dict[Kind, tuple[str, str]] = {
    "same": ("good", "The same"),
    "agree": ("good", "They agree"),
    "differ": ("bad", "They differ"),
    "cannot tell": ("doubtful", "Cannot be told"),
    "no sigmas": ("unknown", "No sigmas to judge by"),
}
NONE = "–"


@dataclass(frozen=True)
class ParameterRow:
    """One line of the table of parameters, ready to print."""

    name: str
    a: str
    b: str
    difference: str
    sigma: str
    z: str
    unit: str
    alarming: bool


@dataclass(frozen=True)
class CameraMaps:
    """One camera's maps, range by range."""

    name: str
    lens: str
    panels: tuple[Panel, ...]


def write_comparison(record: Comparison, found: Difference, path: Path) -> None:
    """Write the page as one HTML file that loads nothing from anywhere.

    Raises CalibrationError when the file cannot be written; then nothing is left.
    """
    write_atomically(path, render_comparison(record, found).encode("utf-8", "replace"))


def render_comparison(record: Comparison, found: Difference) -> str:
    """The page as text."""
    shown = z_figure(record)
    return page_template("comparison.html").render(
        title=TITLE,
        record=record,
        banner=BANNERS[record.verdict.kind],
        rows=[parameter_row(row) for row in record.parameters],
        z_figure=figure_html(shown, "z") if shown else "",
        taken_out=taken_out(record),
        cameras=camera_maps(record, found),
        depth_figure=(
            figure_html(depth_figure(record.pairs, record.unit), "depth")
            if has_depth(record.pairs)
            else ""
        ),
        at_range=at_range,
        p_text=p_text,
        px_text=px_text,
        short=lambda value: NONE if value is None else short(value),
        percent=lambda value: NONE if value is None else signed_percent(value),
        plotly_js=Markup(get_plotlyjs()),
    )


# ---- parameters ----------------------------------------------------------------------------


def parameter_row(row: ParameterDifference) -> ParameterRow:
    """Numbers to two digits of the combined sigma."""
    sigma = math.hypot(row.sigma_a, row.sigma_b)
    decimals = decimals_for(sigma)
    return ParameterRow(
        row.name,
        number(row.a, decimals),
        number(row.b, decimals),
        ("+" if row.difference > 0 else "") + number(row.difference, decimals),
        NONE if sigma == 0 else number(sigma, decimals),
        NONE if row.z is None else f"{row.z:+.1f}",
        row.unit,
        row.z is not None and abs(row.z) > 4,
    )


def z_figure(record: Comparison) -> go.Figure | None:
    """Differences in combined sigmas, a parameter a row; None where nothing has a sigma."""
    rows = [row for row in record.parameters if row.z is not None]
    if not rows:
        return None
    z = np.array([row.z for row in rows], dtype=np.float64)
    figure = go.Figure(
        go.Bar(
            x=np.clip(z, -MOST_Z, MOST_Z).astype(np.float32),
            y=list(range(len(rows))),
            orientation="h",
            marker={"color": [AMBER if abs(one) > 4 else BLUE for one in z]},
            customdata=[f"{plain(row.name)}<br>z {row.z:+.1f}" for row in rows],
            hovertemplate="%{customdata}<extra></extra>",
        )
    )
    styled(figure, height=110 + ROW_PX * len(rows))
    reach = max(4.5, min(float(np.abs(z).max()) * 1.1, MOST_Z))
    for line in (-2, 2):
        figure.add_vline(x=line, line={"color": MUTED, "width": 1, "dash": "dot"})
    figure.update_xaxes(title="difference in combined sigmas", range=[-reach, reach])
    figure.update_yaxes(
        tickvals=list(range(len(rows))),
        ticktext=[plain(row.name) for row in rows],
        range=[len(rows) - 0.5, -0.5],
        zeroline=False,
    )
    return figure


# ---- in the picture ------------------------------------------------------------------------


def camera_maps(record: Comparison, found: Difference) -> tuple[CameraMaps, ...]:
    """A map a camera and range; of one camera all share their colours."""
    out = []
    for index, match in enumerate(record.cameras):
        maps = [found.over_image(index, distance) for distance in found.frames.ranges]
        sizes = [np.linalg.norm(moved, axis=-1) for _, _, moved in maps]
        reach = max(*(float(np.nanquantile(size, COLOURS_REACH)) for size in sizes), LEAST_PX)
        panels = []
        for number_, one in enumerate(record.projection[match.name]):
            figure, factor = map_figure(found, index, number_, reach)
            title = "Lens" if record.unit is None else f"At {at_range(one.range, record.unit)}"
            caption = (
                f"{short(one.rms_px)} px rms, {short(one.max_px)} px at most; arrows from A's "
                f"pixel to B's, {factor:g} times as long as they are."
            )
            panels.append(Panel(title, caption, figure_html(figure, f"map-{index}-{number_}")))
        lens = match.lens if match.lens == match.lens_b else f"{match.lens} and {match.lens_b}"
        out.append(CameraMaps(match.name, lens, tuple(panels)))
    return tuple(out)


def map_figure(found: Difference, camera: int, which: int, reach: float) -> tuple[go.Figure, float]:
    """Size and direction of the difference over an image, and the arrows' magnification."""
    across, down, moved = found.over_image(camera, found.frames.ranges[which])
    size = np.linalg.norm(moved, axis=-1)
    figure = go.Figure(
        go.Heatmap(
            x=across.astype(np.float32),
            y=down.astype(np.float32),
            z=size.astype(np.float32),
            zmin=0,
            zmax=reach,
            colorscale=MAGNITUDE_SCALE,
            colorbar={"title": "px", "thickness": 10, "outlinewidth": 0},
            customdata=moved.astype(np.float32),
            hovertemplate="%{x:.0f}, %{y:.0f}<br>%{customdata[0]:.3f}, %{customdata[1]:.3f} px"
            "<extra></extra>",
        )
    )
    magnification = round_number(EVERY * float(across[1] - across[0]) / reach)
    starts = np.stack(np.meshgrid(across, down), axis=-1)[::EVERY, ::EVERY].reshape(-1, 2)
    vectors = magnification * moved[::EVERY, ::EVERY].reshape(-1, 2)
    drawn = np.isfinite(vectors).all(-1)
    if drawn.any():
        add_arrows(figure, starts[drawn], vectors[drawn])
    return in_image(figure, found.a.cameras[camera]), magnification


# ---- depths --------------------------------------------------------------------------------


def has_depth(pairs: Sequence[PairDifference]) -> bool:
    """Whether any pair has a depth."""
    return any(one.median_percent is not None for pair in pairs for one in pair.depth)


def depth_figure(
    pairs: Sequence[PairDifference], unit: str | None, sides: tuple[str, str] = ("A", "B")
) -> go.Figure:
    """Error of A's depths against range, a line a pair, from the middle to the worst."""
    figure = go.Figure()
    for index, pair in enumerate(pairs):
        _add_pair(figure, pair, camera_colour(index), unit)
    styled(figure, height=380)
    words = "baselines" if unit == "baseline" else unit
    figure.update_xaxes(title=f"range from the pair's first camera, {words}", type="log")
    figure.update_yaxes(
        title=f"depth by {sides[0]} where {sides[1]} is true, % of it", zeroline=True
    )
    return figure


def _add_pair(figure: go.Figure, pair: PairDifference, colour: str, unit: str | None) -> None:
    told = [one for one in pair.depth if one.median_percent is not None]
    name = plain(" and ".join(pair.cameras))
    ranges = [one.range for one in told]
    for kind, values, dash in (
        ("median", [one.median_percent for one in told], "solid"),
        ("worst", [one.worst_percent for one in told], "dot"),
    ):
        figure.add_scatter(
            x=ranges,
            y=values,
            mode="lines+markers",
            name=name,
            line={"color": colour, "width": 2, "dash": dash},
            showlegend=kind == "median",
            error_y={
                "type": "data",
                "array": [one.sigma_percent or 0.0 for one in told],
                "visible": kind == "median" and any(one.sigma_percent for one in told),
                "color": colour,
                "thickness": 1,
            },
            hovertemplate=f"{name}, {kind}<br>%{{y:+.2g}} % at %{{x:g}} {unit}<extra></extra>",
        )

"""The look shared by every figure, and the border where outside text becomes plotly text."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

import jinja2
import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from numpy.typing import NDArray

from graphs.frames import FloatArray

Float32Array = NDArray[np.float32]

OWN_PACKAGE = "sfm_calib.report"
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
INK, MUTED, RULE, PAPER = "#1f2937", "#6b7280", "#e5e7eb", "#ffffff"
BLUE, AMBER, RED = "#2563eb", "#d97706", "#dc2626"
# Okabe and Ito: told apart by colour-blind readers too. Without the yellow: unreadable on white.
CAMERA_COLOURS = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#E69F00",
    "#7A5195",
    "#525252",
)
MAGNITUDE_SCALE = ((0.0, "#f8fafc"), (0.35, "#bfdbfe"), (0.7, "#60a5fa"), (1.0, "#1d4ed8"))
CONFIG = {
    "displaylogo": False,
    "responsive": True,
    "modeBarButtonsToRemove": ["lasso2d", "select2d"],
    # plotly.js 4 offers a button that uploads the figure to plotly's cloud.
    "showSendToCloud": False,
}


@dataclass(frozen=True)
class Panel:
    """A figure with its title and what to look for in it."""

    title: str
    caption: str
    figure: Markup


def plain(text: str) -> str:
    """Text from outside for a plotly label, where tags and entities would be interpreted.

    File names that are not UTF-8 carry lone surrogates, which no HTML file can hold.
    """
    return html.escape(text.encode("utf-8", "replace").decode())


def camera_colour(index: int) -> str:
    """The colour of one camera in every figure."""
    return CAMERA_COLOURS[index % len(CAMERA_COLOURS)]


def styled(figure: go.Figure, height: int) -> go.Figure:
    """The figure in the page's style, with room above for plotly's buttons and a legend."""
    figure.update_layout(
        template="none",
        height=height,
        font={"family": FONT, "size": 12, "color": INK},
        paper_bgcolor=PAPER,
        plot_bgcolor=PAPER,
        margin={"l": 52, "r": 16, "t": 56, "b": 44},
        hoverlabel={"bgcolor": PAPER, "font": {"family": FONT, "color": INK}},
        legend={
            "orientation": "h",
            "x": 0,
            "y": 1.0,
            "yanchor": "bottom",
            "itemsizing": "constant",
        },
        legend_font_size=11,
    )
    axes = {"gridcolor": RULE, "linecolor": RULE, "zerolinecolor": "#9ca3af", "title_standoff": 8}
    figure.update_xaxes(**axes)
    figure.update_yaxes(**axes, automargin=True)
    return figure


def figure_html(figure: go.Figure, key: str) -> Markup:
    """The figure as a div and its script; plotly.js is already on the page."""
    # plotly escapes < and > in its JSON, so outside text cannot close the script element.
    return Markup(
        figure.to_html(full_html=False, include_plotlyjs=False, div_id=key, config=CONFIG)
    )


def page_template(name: str, package: str = OWN_PACKAGE) -> jinja2.Template:
    """A page of a package, its outside text escaped; parts of our own pages can be included."""
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader(one, ".") for one in dict.fromkeys((package, OWN_PACKAGE))]
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def evenly(n: int, at_most: int) -> NDArray[np.int64]:
    """Indices of at most `at_most` of n rows, spread evenly: the same page for the same input."""
    return np.linspace(0, n - 1, min(n, at_most)).round().astype(np.int64)


def polyline(strokes: Sequence[FloatArray] | FloatArray) -> Float32Array:
    """Strokes (n, k, d), or arrays (k, d), as one trace (m, d) with NaN rows between them."""
    if not len(strokes):
        return np.zeros((0, 3), dtype=np.float32)
    gap = np.full((1, np.shape(strokes[0])[1]), np.nan)
    return np.concatenate([row for stroke in strokes for row in (stroke, gap)]).astype(np.float32)


def round_number(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that does not exceed a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)

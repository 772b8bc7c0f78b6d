"""The page of a distance between surfaces: painted, and how often each distance comes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import plotly.graph_objects as go
from markupsafe import Markup
from plotly.colors import sample_colorscale
from plotly.offline import get_plotlyjs

from graphs.frames import FloatArray
from sfm_calib.depth.surface import Surface
from sfm_calib.files import write_atomically
from sfm_calib.report.theme import BLUE, Panel, evenly, figure_html, page_template, styled

if TYPE_CHECKING:
    from sfm_calib.depth.distance_command import DistanceRecord

SCALE = "Viridis"
SHADES = 256
MOST_POINTS = 30_000  # of a cloud, on the page
MOST_TRIANGLES = 100_000  # of a mesh, on the page; of more its vertices are shown
BINS = 80


def colours_of(distance_m: FloatArray, top_m: float) -> FloatArray:
    """Colours (n, 3), 0 to 1, of distances (n,): the last from `top_m` on."""
    shades = sample_colorscale(SCALE, np.linspace(0, 1, SHADES), colortype="tuple")
    index = np.round((SHADES - 1) * np.clip(distance_m / top_m if top_m > 0 else distance_m, 0, 1))
    colours: FloatArray = np.array(shades)[index.astype(int)]
    return colours


def write_distance_page(
    record: DistanceRecord, a: Surface, on_a_m: FloatArray, a_to_b_m: FloatArray, path: Path
) -> None:
    """Write the page as one HTML file that loads nothing from anywhere.

    on_a_m: at each vertex of A (n,); a_to_b_m: at its samples.

    Raises CalibrationError when the file cannot be written; then nothing is left.
    """
    ways = (("A to B", record.a_to_b), ("B to A", record.b_to_a))
    panels = (
        Panel(
            "Painted on A",
            "The last colour stands for its distance and more.",
            figure_html(painted_figure(a, on_a_m, record.painted_to_m), "painted"),
        ),
        Panel(
            "How often",
            "Distances from A to B; the mean is blue, the root mean square dashed.",
            figure_html(_histogram(record, a_to_b_m), "histogram"),
        ),
    )
    page = page_template("distance.html").render(
        title="Distance between surfaces",
        record=record,
        ways=ways,
        panels_shown=panels,
        plotly_js=Markup(get_plotlyjs()),
    )
    write_atomically(path, page.encode("utf-8", "replace"))


def painted_figure(a: Surface, distance_m: FloatArray, top_m: float) -> go.Figure:
    """A in the colours of its distances, in mm."""
    figure, bar = go.Figure(), {"title": "mm", "thickness": 14}
    span = {"cmin": 0.0, "cmax": 1e3 * top_m, "colorscale": SCALE, "colorbar": bar}
    if a.is_mesh and len(a.triangles) <= MOST_TRIANGLES:
        x, y, z = a.vertices.astype(np.float32).T
        i, j, k = a.triangles.T
        figure.add_mesh3d(
            x=x, y=y, z=z, i=i, j=j, k=k, intensity=1e3 * distance_m.astype(np.float32), **span
        )
    else:
        some = evenly(len(a.vertices), MOST_POINTS)
        x, y, z = a.vertices[some].astype(np.float32).T
        marker = {"size": 2, "color": 1e3 * distance_m[some].astype(np.float32), **span}
        figure.add_scatter3d(x=x, y=y, z=z, mode="markers", marker=marker)
    styled(figure, height=560)
    hidden = {"visible": False}
    figure.update_layout(
        scene={"aspectmode": "data", "xaxis": hidden, "yaxis": hidden, "zaxis": hidden},
        margin={"l": 0, "r": 0, "t": 8, "b": 0},
    )
    return figure


def _histogram(record: DistanceRecord, distance_m: FloatArray) -> go.Figure:
    counts, edges = np.histogram(1e3 * distance_m, BINS, range=(0, 1e3 * record.painted_to_m * 1.5))
    figure = go.Figure(go.Bar(x=(edges[:-1] + edges[1:]) / 2, y=counts, marker_color="#94a3b8"))
    figure.add_vline(x=1e3 * record.a_to_b.mean_m, line={"color": BLUE})
    figure.add_vline(x=1e3 * record.a_to_b.rms_m, line={"color": BLUE, "dash": "dash"})
    styled(figure, height=560)
    figure.update_layout(bargap=0, showlegend=False)
    figure.update_xaxes(title="mm")
    figure.update_yaxes(title="points")
    return figure

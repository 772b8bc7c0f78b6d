"""Figures of the covariance: the correlation matrix, its strongest pairs, errors in sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from graphs.frames import FloatArray
from sfm_calib.report.rows import Z_ALARM, TruthRow
from sfm_calib.report.theme import BLUE, MUTED, RED, plain, styled
from sfm_calib.result import Calibration, Covariance

# Blue for minus, white for zero, red for plus (ColorBrewer RdBu, reversed).
DIVERGING = (
    (0.0, "#2166ac"),
    (0.25, "#92c5de"),
    (0.5, "#ffffff"),
    (0.75, "#f4a582"),
    (1.0, "#b2182b"),
)
STRONG = 0.9  # the scan determines the pair's sum or difference over twice as well as either alone
STRONGEST_SHOWN = 8


@dataclass(frozen=True)
class Pair:
    """Two parameters that the scan could hardly tell apart."""

    first: str
    second: str
    correlation: float


def correlation_matrix(covariance: Covariance) -> FloatArray:
    """Correlations (n, n); NaN where a variance is zero or not finite."""
    cov = np.array(covariance.matrix, dtype=np.float64).reshape(2 * (len(covariance.names),))
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt(np.diag(cov))
        sigma = np.where(sigma > 0, sigma, np.nan)
        return np.clip(cov / np.outer(sigma, sigma), -1.0, 1.0)


def strongest_pairs(covariance: Covariance) -> tuple[Pair, ...]:
    """The pairs with |correlation| above STRONG, strongest first, at most STRONGEST_SHOWN."""
    matrix, names = correlation_matrix(covariance), covariance.names
    rows, columns = np.triu_indices(len(names), 1)
    size = np.nan_to_num(np.abs(matrix[rows, columns]))
    order = [k for k in np.argsort(-size) if size[k] > STRONG][:STRONGEST_SHOWN]
    return tuple(
        Pair(names[rows[k]], names[columns[k]], float(matrix[rows[k], columns[k]])) for k in order
    )


def correlation_figure(calibration: Calibration) -> go.Figure:
    """The heat map, with lines between the cameras."""
    covariance = calibration.covariance
    names = [plain(name) for name in covariance.names]
    n = len(names)
    figure = go.Figure(
        go.Heatmap(
            z=correlation_matrix(covariance).astype(np.float32),
            customdata=[[f"{row} and {column}" for column in names] for row in names],
            zmin=-1,
            zmax=1,
            colorscale=DIVERGING,
            xgap=1 if n <= 60 else 0,
            ygap=1 if n <= 60 else 0,
            hovertemplate="%{customdata}<br>correlation %{z:.3f}<extra></extra>",
            colorbar={
                "orientation": "h",
                "x": 0,
                "xanchor": "left",
                "y": 1.01,
                "yanchor": "bottom",
                "len": 240,
                "lenmode": "pixels",
                "thickness": 10,
                "tickvals": [-1, -0.5, 0, 0.5, 1],
                "outlinewidth": 0,
            },
        )
    )
    styled(figure, height=int(np.clip(180 + 20 * n, 360, 1080)))
    ticks = {
        "tickvals": list(range(n)),
        "ticktext": names,
        "tickfont_size": 11 if n <= 50 else 8,
        "showgrid": False,
        "zeroline": False,
        "automargin": True,
        "constrain": "domain",
    }
    figure.update_xaxes(**ticks, tickangle=-90, constraintoward="left")
    figure.update_yaxes(**ticks, autorange="reversed", scaleanchor="x", constraintoward="top")
    owners = [name.rpartition(".")[0] for name in covariance.names]
    for k in (k for k in range(1, n) if owners[k] != owners[k - 1]):
        figure.add_hline(y=k - 0.5, line={"color": MUTED, "width": 1})
        figure.add_vline(x=k - 0.5, line={"color": MUTED, "width": 1})
    return figure


def z_figure(truth_rows: Sequence[TruthRow]) -> go.Figure:
    """Error over sigma of every quantity, on bands of 1, 2 and 4 sigma."""
    rows = [row for row in truth_rows if np.isfinite(row.z)]
    z = np.array([row.z for row in rows])
    figure = go.Figure(
        go.Scatter(
            x=z.astype(np.float32),
            y=list(range(len(rows))),
            mode="markers",
            marker={"size": 8, "color": [RED if row.alarming else BLUE for row in rows]},
            customdata=[plain(row.name) for row in rows],
            hovertemplate="%{customdata}<br>z = %{x:.2f}<extra></extra>",
        )
    )
    styled(figure, height=110 + 17 * len(rows))
    for bound, opacity in ((Z_ALARM, 0.05), (2.0, 0.07), (1.0, 0.10)):
        figure.add_vrect(
            -bound, bound, fillcolor=BLUE, opacity=opacity, line_width=0, layer="below"
        )
    reach = max(float(np.abs(z).max(initial=0.0)) * 1.05, Z_ALARM + 0.5)
    figure.update_xaxes(title="z = error / sigma", range=[-reach, reach])
    figure.update_yaxes(
        tickvals=list(range(len(rows))),
        ticktext=[plain(row.name) for row in rows],
        autorange="reversed",
        automargin=True,
        zeroline=False,
    )
    return figure

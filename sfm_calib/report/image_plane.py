"""Figures in image coordinates: single residuals, what they share, and where points were seen."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from graphs.camera import Camera
from graphs.frames import FloatArray
from sfm_calib.report.residuals import CameraResiduals
from sfm_calib.report.theme import (
    AMBER,
    BLUE,
    INK,
    MAGNITUDE_SCALE,
    MUTED,
    RED,
    Float32Array,
    evenly,
    polyline,
    round_number,
    styled,
)

ARROWS = 2000  # more hide each other on a screen
GRID_CELLS = 16  # along the longer side of the image
CALM_NOISES = 3  # colours reach at least so many times the noise of a mean: chance stays pale
CELL_LEAST = 4  # observations: the mean of fewer is noise
SIGMA_ON_PAGE = 0.012  # a residual of one sigma is drawn this part of the image's diagonal long
ARROW_HEAD = 0.3  # of the arrow's length


def arrows(starts: FloatArray, vectors: FloatArray) -> Float32Array:
    """Polyline (m, 2) of arrows from `starts` (n, 2) along `vectors` (n, 2)."""
    tips = starts + vectors
    sideways = np.column_stack([-vectors[:, 1], vectors[:, 0]])
    left = tips - ARROW_HEAD * (vectors + 0.5 * sideways)
    right = tips - ARROW_HEAD * (vectors - 0.5 * sideways)
    return polyline(np.stack([starts, tips, left, tips, right], axis=1))


def in_image(figure: go.Figure, camera: Camera) -> go.Figure:
    """Image axes: y down, equal scales, the border of the image drawn."""
    width, height = camera.size
    styled(figure, height=int(np.clip(100 + 410 * height / width, 280, 640)))
    pad = 0.03 * max(width, height)
    figure.add_shape(
        type="rect",
        x0=-0.5,
        y0=-0.5,
        x1=width - 0.5,
        y1=height - 0.5,
        line={"color": MUTED, "width": 1},
    )
    figure.update_xaxes(
        range=[-pad, width + pad], constrain="domain", showgrid=False, zeroline=False
    )
    figure.update_yaxes(
        range=[height + pad, -pad],
        scaleanchor="x",
        constrain="domain",
        constraintoward="top",
        showgrid=False,
        zeroline=False,
    )
    return figure


def arrows_figure(part: CameraResiduals) -> tuple[go.Figure, float]:
    """A sample of residuals as arrows from the observed pixel, and their magnification."""
    camera = part.camera
    rows = evenly(len(part.pixels), ARROWS)
    pixels, residuals, norms = part.pixels[rows], part.residuals[rows], part.norms[rows]
    magnification = round_number(SIGMA_ON_PAGE * float(np.hypot(*camera.size)) / part.sigma_px)
    limits = part.limits_px[rows]
    outlier = norms > limits
    shortened = residuals * (limits / np.maximum(norms, limits))[:, None]
    figure = go.Figure()
    for chosen, colour, name in ((~outlier, BLUE, "residual"), (outlier, AMBER, "mismatch")):
        lines = arrows(pixels[chosen], magnification * shortened[chosen])
        figure.add_scatter(
            x=lines[:, 0],
            y=lines[:, 1],
            mode="lines",
            line={"color": colour, "width": 1},
            name=name,
            hoverinfo="skip",
        )
    cx, cy = camera.params[2:4]
    figure.add_scatter(
        x=[cx],
        y=[cy],
        mode="markers",
        marker={"symbol": "cross-thin", "size": 14, "line": {"width": 2, "color": RED}},
        name="principal point",
        hovertemplate=f"principal point<br>{cx:.2f}, {cy:.2f}<extra></extra>",
    )
    return in_image(figure, camera), magnification


def cell_edges(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Edges in px of nearly square cells, GRID_CELLS along the longer side."""
    width, height = camera.size
    cell = max(width, height) / GRID_CELLS
    columns, rows = max(round(width / cell), 1), max(round(height / cell), 1)
    return np.linspace(0, width, columns + 1) - 0.5, np.linspace(0, height, rows + 1) - 0.5


def cell_counts(pixels: FloatArray, camera: Camera) -> FloatArray:
    """Observations in each cell (rows, columns)."""
    x_edges, y_edges = cell_edges(camera)
    return np.histogram2d(pixels[:, 1], pixels[:, 0], (y_edges, x_edges))[0]


def cell_means(part: CameraResiduals) -> tuple[FloatArray, FloatArray]:
    """Mean residual (rows, columns, 2) without mismatches, NaN in sparse cells; and the counts."""
    kept, (x_edges, y_edges) = part.inliers, cell_edges(part.camera)
    counts = cell_counts(kept.pixels, part.camera)
    sums = [
        np.histogram2d(
            kept.pixels[:, 1], kept.pixels[:, 0], (y_edges, x_edges), weights=kept.residuals[:, k]
        )[0]
        for k in range(2)
    ]
    safe = np.where(counts >= CELL_LEAST, counts, np.nan)
    return np.stack(sums, axis=-1) / safe[..., None], counts


def noise_of_cell_mean(part: CameraResiduals) -> float | None:
    """Mean length in px that noise alone gives a cell's mean residual; None without such cells."""
    _, counts = cell_means(part)
    full = counts[counts >= CELL_LEAST]
    if not full.size:
        return None
    sigma_px = np.sqrt(np.mean(part.inliers.sigmas_px**2))
    return float(sigma_px * np.sqrt(np.pi / 2) * np.mean(1 / np.sqrt(full)))


def systematic_figure(part: CameraResiduals) -> tuple[go.Figure, float]:
    """The mean residual of each cell as colour and arrow, and the arrows' magnification."""
    camera, (x_edges, y_edges) = part.camera, cell_edges(part.camera)
    means, counts = cell_means(part)
    size = np.linalg.norm(means, axis=-1)
    full = np.isfinite(size)
    longest = float(np.quantile(size[full], 0.95)) if full.any() else 0.0
    magnification = round_number((x_edges[1] - x_edges[0]) / max(longest, 1e-9))
    x, y = (x_edges[:-1] + x_edges[1:]) / 2, (y_edges[:-1] + y_edges[1:]) / 2
    figure = go.Figure(
        go.Heatmap(
            x=x.astype(np.float32),
            y=y.astype(np.float32),
            z=size.astype(np.float32),
            zmin=0,
            zmax=max(longest, CALM_NOISES * (noise_of_cell_mean(part) or part.sigma_px)),
            colorscale=MAGNITUDE_SCALE,
            colorbar={"title": "px", "thickness": 10, "outlinewidth": 0},
            customdata=np.dstack([means, counts]).astype(np.float32),
            hovertemplate="mean residual %{customdata[0]:.3f}, %{customdata[1]:.3f} px"
            "<br>%{customdata[2]:.0f} observations<extra></extra>",
        )
    )
    centres = np.stack(np.meshgrid(x, y), axis=-1)[full]
    vectors = magnification * means[full]
    add_arrows(figure, centres - vectors / 2, vectors)
    return in_image(figure, camera), magnification


def add_arrows(figure: go.Figure, starts: FloatArray, vectors: FloatArray) -> None:
    """Arrows over a map, from starts (n, 2) along vectors (n, 2)."""
    lines = arrows(starts, vectors)
    figure.add_scatter(
        x=lines[:, 0],
        y=lines[:, 1],
        mode="lines",
        line={"color": INK, "width": 1.2},
        hoverinfo="skip",
        showlegend=False,
    )


def coverage_figure(part: CameraResiduals) -> go.Figure:
    """How many observations fell on each part of the image; empty cells stay white."""
    camera, (x_edges, y_edges) = part.camera, cell_edges(part.camera)
    counts = cell_counts(part.pixels, camera)
    figure = go.Figure(
        go.Heatmap(
            x=((x_edges[:-1] + x_edges[1:]) / 2).astype(np.float32),
            y=((y_edges[:-1] + y_edges[1:]) / 2).astype(np.float32),
            z=np.where(counts > 0, counts, np.nan).astype(np.float32),
            zmin=0,
            colorscale="Viridis",
            colorbar={"thickness": 10, "outlinewidth": 0},
            hovertemplate="%{z:.0f} observations<extra></extra>",
        )
    )
    return in_image(figure, camera)


def empty_share(part: CameraResiduals) -> float:
    """Part of the image's cells in which nothing was observed."""
    return float(np.mean(cell_counts(part.pixels, part.camera) == 0))

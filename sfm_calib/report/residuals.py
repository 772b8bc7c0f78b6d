"""Residuals of one camera, and what their size says: against chance and against the lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from graphs.camera import Camera
from graphs.frames import FloatArray
from graphs.problem import Estimate, IntArray, Problem, residuals_px
from sfm_calib.report.theme import AMBER, BLUE, INK, MUTED, plain, styled

# Normal noise leaves exp(-8), 0.03 %, of the residuals beyond 4 sigma; the rest are mismatches.
OUTLIER_SIGMAS = 4.0
SMALLEST_SIGMA_PX = 1e-9  # perfect data still needs a scale to be drawn at
RAYLEIGH_MEDIAN = 1.17741  # median norm of two normal coordinates of sigma 1: sqrt(2 ln 2)
HISTOGRAM_SIGMAS, HISTOGRAM_BINS = 6.0, 48
RADIUS_BINS, RADIUS_BIN_LEAST = 14, 20  # fewer observations than this say little about a mean


@dataclass(frozen=True)
class CameraResiduals:
    """Every residual of one camera that could be computed."""

    camera: Camera
    index: int
    pixels: FloatArray  # (n, 2) observed
    residuals: FloatArray  # (n, 2) projected minus observed
    frames: IntArray  # (n,) index into Problem.frame_names
    sigmas_px: FloatArray  # (n,) of one coordinate: large keypoints are located worse
    n_unprojectable: int

    @property
    def norms(self) -> FloatArray:
        """Lengths in px (n,)."""
        return np.linalg.norm(self.residuals, axis=1)

    @property
    def sigma_px(self) -> float:
        """The typical one."""
        return float(np.median(self.sigmas_px)) if len(self.sigmas_px) else SMALLEST_SIGMA_PX

    @property
    def limits_px(self) -> FloatArray:
        """Residuals beyond (n,) are mismatches: shown apart, and left out of every mean."""
        return OUTLIER_SIGMAS * self.sigmas_px

    @property
    def inliers(self) -> CameraResiduals:
        """The same without mismatches."""
        keep = self.norms <= self.limits_px
        return CameraResiduals(
            self.camera,
            self.index,
            self.pixels[keep],
            self.residuals[keep],
            self.frames[keep],
            self.sigmas_px[keep],
            self.n_unprojectable,
        )


def residuals_by_camera(
    problem: Problem, estimate: Estimate, sigma_px: float | None
) -> tuple[CameraResiduals, ...]:
    """The residuals of every camera.

    sigma_px: of one coordinate where the relative sigma is 1; None takes a robust one from them.
    """
    observations = problem.observations
    residuals = residuals_px(estimate, observations)
    relative = observations.relative_sigma
    relative = np.ones(len(observations)) if relative is None else relative
    finite = np.isfinite(residuals).all(axis=1) & np.isfinite(observations.pixels).all(axis=1)
    if sigma_px is None or not sigma_px > 0:
        norms = np.linalg.norm(residuals[finite], axis=1) / relative[finite]
        sigma_px = float(np.median(norms)) / RAYLEIGH_MEDIAN if len(norms) else 1.0
    sigma_px = max(sigma_px, SMALLEST_SIGMA_PX)
    parts = []
    for index, camera in enumerate(estimate.cameras):
        mine = observations.camera == index
        rows = mine & finite
        lost = int((mine & ~finite).sum())
        parts.append(
            CameraResiduals(
                camera,
                index,
                observations.pixels[rows],
                residuals[rows],
                observations.frame[rows],
                sigma_px * relative[rows],
                lost,
            )
        )
    return tuple(parts)


def summary(part: CameraResiduals) -> str:
    """One sentence on the size of the residuals of a camera."""
    n = len(part.norms)
    if n == 0:
        return "No observation of this camera could be projected."
    outliers = int((part.norms > part.limits_px).sum())
    text = (
        f"{n:,} observations, median residual {np.median(part.norms):.3f} px; "
        f"{outliers:,} ({100 * outliers / n:.1f} %) lie beyond {OUTLIER_SIGMAS:.0f} of "
        f"their sigmas (typically {part.sigma_px:.2f} px) and count as mismatches below."
    )
    if part.n_unprojectable:
        text += f" {part.n_unprojectable:,} more point(s) cannot be projected and are not shown."
    return text


def histogram_figure(part: CameraResiduals) -> go.Figure:
    """Residual norms over their sigmas beside the Rayleigh density that noise predicts."""
    norms = part.norms / part.sigmas_px
    edges = np.linspace(0, HISTOGRAM_SIGMAS, HISTOGRAM_BINS + 1)
    centres, width = (edges[:-1] + edges[1:]) / 2, edges[1]
    density = np.histogram(norms, edges)[0] / len(norms) / width
    rayleigh = centres * np.exp(-(centres**2) / 2)
    beyond = 100 * np.mean(norms > edges[-1])
    figure = go.Figure(
        [
            go.Bar(
                x=centres.astype(np.float32),
                y=density.astype(np.float32),
                width=width,
                name="measured",
                marker={"color": BLUE, "opacity": 0.55, "line_width": 0},
                hovertemplate="%{x:.2f} sigmas<br>density %{y:.3f}<extra></extra>",
            ),
            go.Scatter(
                x=centres.astype(np.float32),
                y=rayleigh.astype(np.float32),
                name="normal noise (Rayleigh)",
                line={"color": INK, "width": 2},
                hoverinfo="skip",
            ),
        ]
    )
    styled(figure, height=330)
    figure.update_xaxes(title=f"residual norm over its sigma ({beyond:.1f} % lie beyond this axis)")
    figure.update_yaxes(title="density", rangemode="tozero")
    return figure


def radial_profile(part: CameraResiduals) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean residual against the distance from the principal point, mismatches left out.

    Returns radii (m,) in px, means (m, 2) of the radial (outward) and the tangential component
    in px, and the standard errors of those means (m, 2).
    """
    kept = part.inliers
    offsets = kept.pixels - part.camera.params[2:4]
    radii = np.linalg.norm(offsets, axis=1)
    outward = offsets / np.maximum(radii, 1e-9)[:, None]
    sideways = np.column_stack([-outward[:, 1], outward[:, 0]])
    parts = np.column_stack([(kept.residuals * outward).sum(1), (kept.residuals * sideways).sum(1)])
    edges = np.linspace(0, radii.max(initial=1.0) * (1 + 1e-9), RADIUS_BINS + 1)
    bins = np.digitize(radii, edges) - 1
    full = [k for k in range(RADIUS_BINS) if (bins == k).sum() >= RADIUS_BIN_LEAST]
    groups = [bins == k for k in full]
    centres = np.array([radii[g].mean() for g in groups])
    means = np.array([parts[g].mean(0) for g in groups]).reshape(-1, 2)
    errors = np.array([parts[g].std(0) / np.sqrt(g.sum()) for g in groups]).reshape(-1, 2)
    return centres, means, errors


def radius_figure(part: CameraResiduals) -> go.Figure:
    """The radial profile with bars of two standard errors."""
    radii, means, errors = radial_profile(part)
    figure = go.Figure()
    for column, (name, colour) in enumerate((("radial", BLUE), ("tangential", AMBER))):
        figure.add_scatter(
            x=radii.astype(np.float32),
            y=means[:, column].astype(np.float32),
            error_y={
                "array": (2 * errors[:, column]).astype(np.float32),
                "thickness": 1,
                "width": 3,
            },
            name=name,
            mode="lines+markers",
            line={"color": colour, "width": 2},
            hovertemplate="%{x:.0f} px from the principal point<br>mean %{y:.4f} px<extra></extra>",
        )
    styled(figure, height=330)
    reach = max(float(np.abs(means).max(initial=0.0)) * 1.3, 0.1 * part.sigma_px)
    figure.update_xaxes(title="distance from the principal point, px", rangemode="tozero")
    figure.update_yaxes(title="mean residual, px", range=[-reach, reach])
    return figure


def frames_figure(part: CameraResiduals, frame_names: Sequence[str]) -> go.Figure:
    """Median residual norm of each image beside the median that sigma_px predicts."""
    frames = np.unique(part.frames)
    groups = [part.norms[part.frames == frame] for frame in frames]
    medians = np.array([np.median(group) for group in groups])
    figure = go.Figure(
        go.Scatter(
            x=frames,
            y=medians.astype(np.float32),
            mode="markers",
            marker={"size": 6, "color": BLUE},
            customdata=[
                (plain(frame_names[frame]), len(group))
                for frame, group in zip(frames, groups, strict=True)
            ],
            hovertemplate="%{customdata[0]}<br>median %{y:.3f} px of %{customdata[1]} observations"
            "<extra></extra>",
        )
    )
    styled(figure, height=330)
    expected = RAYLEIGH_MEDIAN * part.sigma_px
    figure.add_hline(y=expected, line={"color": MUTED, "width": 1, "dash": "dash"})
    figure.update_xaxes(title="frame")
    top = 1.15 * max(float(medians.max()), expected)
    figure.update_yaxes(title="median residual, px", range=[0, top])
    return figure

"""How well keypoints were located: by their size, for large ones are blurred and err more, or by
the sigma that the matching of their patches states."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from sfm_calib.report.digits import short
from sfm_calib.report.theme import Panel, camera_colour, figure_html, plain, styled
from sfm_calib.result import Calibration, NoiseBySize

TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200)
Classes = dict[str, tuple[NoiseBySize, ...]]


def noise_panel(calibration: Calibration) -> Panel | None:
    """Noise against size, every camera; None where no size is known."""
    by_size = calibration.noise.by_size if calibration.noise else {}
    known = {name: _known(classes) for name, classes in by_size.items()}
    if not any(known.values()):
        return None
    said = " ".join(_said(name, classes) for name, classes in known.items() if classes)
    figure = figure_html(noise_figure(known), "noise-by-size")
    if _matched(known):
        return Panel(
            "Noise by what matching states",
            "Every observation is weighed by the sigma and shape that the matching of its patch "
            f"states, corrected by what the residuals of its like show. {said} Dotted: as stated.",
            figure,
        )
    return Panel(
        "Noise by the size of keypoints",
        f"Every observation is weighed by the noise of its camera and size. {said}",
        figure,
    )


def _matched(known: Classes) -> bool:
    return any(one.matched for classes in known.values() for one in classes)


def _known(classes: tuple[NoiseBySize, ...]) -> tuple[NoiseBySize, ...]:
    return tuple(one for one in classes if one.smallest_px and one.largest_px)


def _said(name: str, classes: tuple[NoiseBySize, ...]) -> str:
    if len(classes) == 1:
        return f"{name}: {short(classes[0].sigma_px)} px for all."
    first, last = classes[0], classes[-1]
    return f"{name}: from {short(first.sigma_px)} px to {short(last.sigma_px)} px."


def noise_figure(known: Classes) -> go.Figure:
    """Sigma of one pixel coordinate against keypoint scale, or stated sigma, a line a camera."""
    figure = go.Figure()
    what = "stated sigma" if _matched(known) else "scale of the keypoint"
    for index, (name, classes) in enumerate(known.items()):
        ends = np.array([(one.smallest_px, one.largest_px) for one in classes]).reshape(-1, 2)
        figure.add_scatter(
            x=np.sqrt(ends.prod(axis=1)).astype(np.float32),
            y=np.array([one.sigma_px for one in classes], dtype=np.float32),
            mode="lines+markers",
            name=plain(name),
            line={"color": camera_colour(index), "width": 2},
            customdata=[
                (f"{one.smallest_px:.2g} to {one.largest_px:.2g}", f"{one.n_observations:,}")
                for one in classes
            ],
            hovertemplate=f"{what} %{{customdata[0]}} px<br>sigma %{{y:.3f}} px"
            "<br>%{customdata[1]} observations",
        )
    if _matched(known):
        stated = [one for classes in known.values() for one in classes]
        ends_px = (
            min(one.smallest_px or np.inf for one in stated),
            max(one.largest_px or 0.0 for one in stated),
        )
        figure.add_scatter(
            x=ends_px, y=ends_px, mode="lines", name="as stated", hoverinfo="skip",
            line={"color": "gray", "dash": "dot", "width": 1},
        )  # fmt: skip
    styled(figure, height=330)
    by_powers = {"type": "log", "tickvals": TICKS, "ticktext": [f"{tick:g}" for tick in TICKS]}
    figure.update_xaxes(title=f"{what}, px", **by_powers)
    # Both ways alike, where the line of what is stated has to be straight.
    scale = by_powers if _matched(known) else {"rangemode": "tozero"}
    figure.update_yaxes(title="sigma of one coordinate, px", **scale)
    figure.update_layout(showlegend=len(known) > 1)
    return figure

"""Figures of `depth_camera_cabin`: bars, places by hand, and the distance painted on the head."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.colors import sample_colorscale
from plotly.subplots import make_subplots

from experiments.cabin_calibration import CabinOptions
from experiments.cabin_cases import (
    ADDED,
    BOARDS,
    FACTORY,
    NOTHING,
    Cases,
    Trials,
    is_lost,
    is_swept,
    mean,
    number,
    share,
)
from experiments.cabin_model import FAILED_MM, PAINTED
from experiments.runner.figures import Series, lines
from experiments.runner.protocol import AnswerFigure, Finished
from graphs.frames import FloatArray
from sfm_calib.report.theme import MUTED, camera_colour, styled
from sfm_calib.simulate.head import make_head

PUBLISHED_FUSED = (2.36, 2.95, 15.9)  # mean, RMS, largest, mm: as the project's plan quotes it
PAINTED_CASES = (NOTHING, FACTORY, BOARDS, ADDED)
PAINTED_MM = 6.0  # where colours end
PAINT, UNSEEN = "Viridis", "rgb(200, 200, 200)"


def figures(cases: Cases) -> tuple[AnswerFigure, ...]:
    """Those that the cases allow."""
    found = [
        AnswerFigure(
            "rms",
            "The head's model",
            "RMS distance to the head, mean over cabins with its standard error; dotted: the "
            f"published fused model, {PUBLISHED_FUSED[1]} mm.",
            rms_figure(cases),
        )
    ]
    swept = by_hand(cases)
    if len(swept) > 1:
        found.append(
            AnswerFigure(
                "by_hand",
                "Places by hand",
                "Heads of which a part lies more than 10 mm off, by how far the places by hand "
                "are (exact lenses): as placed, and after ICP between the parts.",
                hand_figure(swept),
            )
        )
    painted = [
        name for name in PAINTED_CASES if name in cases and "painted_mm" in cases[name][0].row
    ]
    if painted:
        found.append(
            AnswerFigure(
                "painted",
                "The distance painted on the head",
                f"Cabin {cases[painted[0]][0].seed}: mean distance of the model's points at each "
                "place of the head. Grey: nobody sees it. Drag to turn.",
                painted_figure([(name, cases[name][0]) for name in painted]),
            )
        )
    return tuple(found)


def rms_figure(cases: Cases) -> go.Figure:
    """A pair of bars a case."""
    figure = go.Figure()
    cases = {name: trials for name, trials in cases.items() if not is_swept(trials)}
    for index, (what, column) in enumerate(
        (("as placed", "rms_mm"), ("after ICP between the parts", "registered_rms_mm"))
    ):
        values = [mean(trials, column) for trials in cases.values()]
        figure.add_bar(
            x=list(cases),
            y=[value for value, _ in values],
            name=what,
            marker_color=camera_colour(index),
            error_y={"type": "data", "array": [e if np.isfinite(e) else 0.0 for _, e in values]},
        )
    figure.add_hline(y=PUBLISHED_FUSED[1], line={"color": MUTED, "dash": "dot"})
    styled(figure, 460)
    figure.update_xaxes(automargin=True)
    figure.update_yaxes(title="RMS distance, mm")
    figure.update_layout(showlegend=True, barmode="group")
    return figure


def by_hand(cases: Cases) -> list[tuple[CabinOptions, Trials]]:
    """Cases of exact lenses and places by hand, by how far these are off."""
    found = [(trials[0].options, trials) for trials in cases.values() if is_swept(trials)]
    return sorted(found, key=lambda one: (one[0].hand_deg, one[0].hand_mm))


def hand_figure(swept: Sequence[tuple[CabinOptions, Trials]]) -> go.Figure:
    """How many heads fail, as placed and after ICP."""
    x = [f"{options.hand_deg:g}°, {options.hand_mm:g} mm" for options, _ in swept]
    as_placed = [
        100 * share(trials, lambda one: number(one, "misplaced_mm") > FAILED_MM)
        for _, trials in swept
    ]
    by_icp = [100 * share(trials, is_lost) for _, trials in swept]
    return lines(
        [Series("as placed", x, as_placed), Series("after ICP", x, by_icp)],
        "places by hand are off by",
        "heads that fail, %",
    )


def painted_figure(cases: Sequence[tuple[str, Finished[CabinOptions]]]) -> go.Figure:
    """Heads side by side, coloured by distance."""
    vertices, triangles = make_head(PAINTED)
    figure = make_subplots(
        1, len(cases), specs=[[{"type": "scene"}] * len(cases)],
        subplot_titles=[name for name, _ in cases], horizontal_spacing=0.01,
    )  # fmt: skip
    i, j, k = triangles.T
    x, y, z = 1e3 * vertices.T
    for column, (_, one) in enumerate(cases, start=1):
        values = np.array(one.row["painted_mm"], dtype=np.float64)
        figure.add_trace(
            go.Mesh3d(
                x=x, y=y, z=z, i=i, j=j, k=k,
                vertexcolor=colours(values),
                lighting={"ambient": 0.65, "diffuse": 0.45, "specular": 0.05},
                hoverinfo="skip",
            ),
            row=1, col=column,
        )  # fmt: skip
    styled(figure, 520)
    hidden = {axis: {"visible": False} for axis in ("xaxis", "yaxis", "zaxis")}
    view = {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0.9, "y": -0.3, "z": -1.3}}
    figure.update_scenes(**hidden, aspectmode="data", camera=view)
    figure.add_trace(scale_bar(), row=1, col=len(cases))
    return figure


def scale_bar() -> go.Scatter3d:
    """A trace that shows nothing but the colours' meaning."""
    return go.Scatter3d(
        x=[None], y=[None], z=[None], mode="markers", showlegend=False,
        marker={
            "color": [0.0], "cmin": 0.0, "cmax": PAINTED_MM, "colorscale": PAINT,
            "colorbar": {"title": {"text": "mm"}, "thickness": 10, "len": 0.8},
        },
    )  # fmt: skip


def colours(values_mm: FloatArray) -> list[str]:
    """Of distances (n,); negative: nobody sees it."""
    shades = sample_colorscale(PAINT, np.clip(values_mm / PAINTED_MM, 0, 1).tolist())
    return [UNSEEN if value < 0 else shade for value, shade in zip(values_mm, shades, strict=True)]

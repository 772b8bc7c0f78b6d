"""The board that took part: where it was seen, what it is like, and what it brought."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from graphs.boards import N_WHOLE, shape_of
from graphs.frames import FloatArray
from graphs.problem import Estimate, Problem
from sfm_calib.board_record import BoardResult
from sfm_calib.report.digits import short
from sfm_calib.report.theme import (
    BLUE,
    MUTED,
    Panel,
    camera_colour,
    figure_html,
    plain,
    polyline,
    round_number,
    styled,
)
from sfm_calib.result import Calibration

SEEN = {
    "": "in images of its own",
    "still": "standing in the scan",
    "waved": "moved about in the scan",
}
NOTICED = 2.0  # sigmas from which a bend or a size is worth a word
ARROW_OF_BOARD = 0.04  # a typical arrow, of the board's longer side


@dataclass(frozen=True)
class GainRow:
    """A parameter's sigma from the scan alone, and with the board."""

    name: str
    alone: str
    joint: str
    gain: str
    moved: str


@dataclass(frozen=True)
class BoardSection:
    """Ready to print."""

    lines: tuple[str, ...]
    gains: tuple[GainRow, ...]
    left_out: tuple[str, ...]
    repeated: tuple[str, ...]
    panels: tuple[Panel, ...]


def board_section(
    calibration: Calibration, problem: Problem, estimate: Estimate
) -> BoardSection | None:
    """The section; None where no board took part."""
    board = calibration.board
    if board is None or problem.board is None:
        return None
    panels = []
    if board.corners_off_mm > 0:
        places, factor = corners_figure(problem, estimate)
        panels.append(
            Panel(
                "Where corners lie",
                f"How far each corner lies off its place on the board; arrows {factor:g} times as "
                "long as they are. A pattern is a board that was printed longer one way, or askew.",
                figure_html(places, "board-corners"),
            )
        )
    panels += [
        Panel(
            f"Views of {camera.name}",
            "The board's outline in each image. Bring it to the edges and into the corners, and "
            "tilt it.",
            figure_html(views_figure(problem, index), f"board-views-{index}"),
        )
        for index, camera in enumerate(estimate.cameras)
        if board.n_images.get(camera.name)
    ]
    return BoardSection(
        tuple(board_lines(board)), gains(calibration), board.left_out, board.repeated,
        tuple(panels),
    )  # fmt: skip


def board_lines(board: BoardResult) -> list[str]:
    """Where the board was seen, and what it turned out to be like."""
    seen = ", ".join(
        f"{name} {board.n_images[name]} images with {board.n_corners[name]} corners"
        + (f" ({short(board.sigma_px[name])} px)" if name in board.sigma_px else "")
        for name in board.n_images
        if board.n_images[name]
    )
    lines = [f"board: {board.description}, {SEEN[board.in_scan]}: {seen}"]
    said = []
    if abs(board.size - 1) > NOTICED * board.sigma_size > 0:
        said.append(
            f"{100 * (board.size - 1):+.2f} +- {100 * board.sigma_size:.2f} % larger than stated"
        )
    for which, bend, sigma in zip(
        ("left and right", "top and foot"), board.bend_mm, board.sigma_bend_mm, strict=True
    ):
        if sigma > 0 and abs(bend) > NOTICED * sigma:
            said.append(f"bent by {bend:.2g} +- {sigma:.1g} mm between {which}")
    if said:
        lines.append(f"the board is {' and '.join(said)}")
    elif max(board.sigma_bend_mm) > 0:
        lines.append(f"the board is flat to {short(max(board.sigma_bend_mm))} mm")
    if board.corners_off_mm > 0:
        lines.append(
            f"its corners lie {short(board.corners_off_mm)} mm (rms) from where they belong"
        )
    return lines


def gains(calibration: Calibration) -> tuple[GainRow, ...]:
    """Each parameter's sigma from the scan alone, and with the board; none without both."""
    board, noise = calibration.board, calibration.noise
    if board is None or noise is None:
        return ()
    rows = []
    for name, alone in board.without.items():
        if name not in noise.sigmas:
            continue
        # radians are told in degrees, as everywhere
        unit, label = (math.degrees(1), f"{name} (deg)") if ".rotation_" in name else (1.0, name)
        sigma = noise.sigmas[name].stated
        rows.append(
            GainRow(
                label,
                "no metre" if alone.sigma is None else short(alone.sigma * unit),
                short(sigma * unit),
                f"{alone.sigma / sigma:.1f} x" if alone.sigma and sigma else "",
                "" if alone.moved is None else short(alone.moved * unit),
            )
        )
    return tuple(rows)


def corners_figure(problem: Problem, estimate: Estimate) -> tuple[go.Figure, float]:
    """How far each corner lies off its place as an arrow on the board, so many times as long."""
    board = problem.board
    assert board is not None
    off = 1e3 * shape_of(estimate, board.board)[N_WHOLE:].reshape(-1, 3)
    places = 1e3 * board.board.corners[:, :2]
    typical = float(np.sqrt((off[:, :2] ** 2).sum(1).mean()))
    side = float(np.ptp(places, axis=0).max())
    factor = round_number(ARROW_OF_BOARD * side / typical) if typical > 0 else 1.0
    ends = places + factor * off[:, :2]
    figure = go.Figure()
    line = polyline([np.stack(pair) for pair in zip(places, ends, strict=True)])
    figure.add_scatter(
        x=line[:, 0], y=line[:, 1], mode="lines", line={"color": BLUE, "width": 2},
        hoverinfo="skip",
    )  # fmt: skip
    figure.add_scatter(
        x=places[:, 0].astype(np.float32), y=places[:, 1].astype(np.float32), mode="markers",
        marker={"size": 4, "color": MUTED},
        customdata=[
            (index, f"{x:+.3f}", f"{y:+.3f}", f"{z:+.3f}") for index, (x, y, z) in enumerate(off)
        ],
        hovertemplate="corner %{customdata[0]}<br>right %{customdata[1]}, down %{customdata[2]}, "
        "away %{customdata[3]} mm<extra></extra>",
    )  # fmt: skip
    styled(figure, height=360)
    figure.update_layout(showlegend=False)
    figure.update_xaxes(title="on the board, mm", scaleanchor="y")
    figure.update_yaxes(autorange="reversed", title="mm")
    return figure, factor


def views_figure(problem: Problem, camera: int) -> go.Figure:
    """The outline of the board in every image of one camera."""
    seen, lens = problem.observations, problem.initial.cameras[camera]
    rows = problem.known[seen.point] & (seen.camera == camera)
    outlines = [outline(seen.pixels[rows & (seen.frame == f)]) for f in np.unique(seen.frame[rows])]
    figure = go.Figure()
    line = polyline(outlines)
    figure.add_scatter(
        x=line[:, 0], y=line[:, 1], mode="lines", name=plain(lens.name),
        line={"color": camera_colour(camera), "width": 1}, hoverinfo="skip",
    )  # fmt: skip
    width, height = lens.size
    styled(figure, height=360)
    figure.add_shape(
        type="rect", x0=-0.5, y0=-0.5, x1=width - 0.5, y1=height - 0.5, line={"color": MUTED}
    )
    figure.update_layout(showlegend=False)
    figure.update_xaxes(
        range=[-0.5, width - 0.5], title="x, px", scaleanchor="y", constrain="domain"
    )
    figure.update_yaxes(range=[height - 0.5, -0.5], title="y, px")
    return figure


def outline(pixels: FloatArray) -> FloatArray:
    """Convex hull (k, 2) of points (n, 2), closed (Andrew's monotone chain)."""
    ordered = pixels[np.lexsort((pixels[:, 1], pixels[:, 0]))]
    hull: list[FloatArray] = []
    for chain in (ordered, ordered[::-1]):
        first = len(hull)
        for point in chain:
            while len(hull) - first > 1 and _turn(hull[-2], hull[-1], point) <= 0:
                hull.pop()
            hull.append(point)
        hull.pop()
    return np.array([*hull, hull[0]]) if hull else pixels


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

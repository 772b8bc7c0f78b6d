"""The rig and the scan in three dimensions."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from graphs.camera import Camera, unproject
from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate, Problem, residuals_px
from sfm_calib.report.theme import (
    FONT,
    MUTED,
    RULE,
    Float32Array,
    camera_colour,
    evenly,
    plain,
    polyline,
    styled,
)

POINTS = 5000  # more slow the browser down and show no more
POINTS_WITHIN = 0.95  # of the points, nearest to their median: the far rest would shrink the view
FRUSTUM_FRAMES = 12
SCENE_DIAGONAL, EYE = 2.2, 2.0  # in plotly's units: fills the page, cuts nothing off
FRUSTUM_AHEAD = 0.3  # of a unit ray: corners no more than 72 deg off the axis
FRUSTUM_OF_SCENE = 0.035  # a frustum's length beside the scene's diagonal
FRUSTUM_OF_RIG = 0.45  # a frustum's length beside the distance to the nearest camera


def frustum(camera: Camera, ref_from_cam: Transform, length: float) -> list[FloatArray]:
    """Strokes (k, 3) of the camera's pyramid, its corner rays `length` long."""
    width, height = camera.size
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], float)
    # A fisheye may see nothing in its corners, or behind itself: shrink until it looks ahead.
    for shrink in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3):
        rays = unproject(camera, camera.centre + shrink * (corners - camera.centre))
        if (rays[:, 2] > FRUSTUM_AHEAD).all():  # false for NaN
            break
    else:
        rays = np.array([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]]) / np.sqrt(6.0)
    tips, apex = ref_from_cam @ (length * rays), ref_from_cam.translation
    roof = ref_from_cam @ (length * (0.5 * (rays[0] + rays[1]) + [0, -0.12, 0]))
    sides = [np.stack([apex, tip]) for tip in tips]
    return [np.stack([*tips, tips[0]]), np.stack([tips[0], roof, tips[1]]), *sides]


def in_space(
    figure: go.Figure, height: int, unit: str, up: FloatArray, eye: FloatArray
) -> go.Figure:
    """Equal scales, quiet axes, and a first view with `up` upwards on the page."""
    styled(figure, height=height)
    low, high = bounds(figure)
    span = high - low
    axis = {
        "backgroundcolor": "#fafafa",
        "gridcolor": RULE,
        "zerolinecolor": RULE,
        "showspikes": False,
        "nticks": 6,
        "tickfont": {"size": 10, "color": MUTED, "family": FONT},
    }
    axes = {
        f"{a}axis": {**axis, "title": {"text": f"{a}, {unit}"}, "range": [low[k], high[k]]}
        for k, a in enumerate("xyz")
    }
    # Plotly's own "data" aspect lets a long scene grow out of the page: fix its diagonal instead.
    aspect = SCENE_DIAGONAL * span / np.linalg.norm(span)
    figure.update_layout(
        margin={"l": 0, "r": 0, "t": 56, "b": 0},
        scene={
            **axes,
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", aspect.tolist(), strict=True)),
            "dragmode": "orbit",
            "camera": {
                "up": dict(zip("xyz", up.tolist(), strict=True)),
                "eye": dict(zip("xyz", (eye / np.linalg.norm(eye) * EYE).tolist(), strict=True)),
            },
        },
    )
    return figure


def bounds(figure: go.Figure) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates (3,) of everything drawn, a little apart on every axis."""
    drawn = np.concatenate([np.column_stack([t.x, t.y, t.z]) for t in figure.data])
    drawn = drawn[np.isfinite(drawn).all(axis=1)].astype(np.float64)
    if not len(drawn):
        return -np.ones(3), np.ones(3)
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    margin = 0.04 * max(float((high - low).max()), 1e-6)
    return low - margin, high + margin


def lines_3d(lines: Float32Array, colour: str, name: str, width: float = 2.0) -> go.Scatter3d:
    """A trace of strokes without hover."""
    x, y, z = lines.T
    style = {"color": colour, "width": width}
    return go.Scatter3d(x=x, y=y, z=z, mode="lines", line=style, name=name, hoverinfo="skip")


def rig_figure(estimate: Estimate, reference: int, unit: str) -> go.Figure:
    """Every camera's frustum in the rig's frame, and the baselines from the reference."""
    rig_from_cam = [t.inverse for t in estimate.cam_from_rig]
    centres = np.array([t.translation for t in rig_from_cam])
    gaps = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    apart = gaps[gaps > 1e-9]
    length = FRUSTUM_OF_RIG * float(apart.min() if apart.size else 1.0)
    figure = go.Figure()
    spokes = [np.stack([centres[reference], c]) for c in centres]
    figure.add_trace(lines_3d(polyline(spokes), MUTED, "baseline", width=2))
    for index, camera in enumerate(estimate.cameras):
        name, colour = plain(camera.name), camera_colour(index)
        strokes = polyline(frustum(camera, rig_from_cam[index], length))
        figure.add_trace(lines_3d(strokes, colour, name, width=4))
        distance = gaps[reference, index]
        x, y, z = centres[index]
        figure.add_scatter3d(
            x=[x],
            y=[y],
            z=[z],
            mode="markers",
            marker={"size": 4, "color": colour},
            showlegend=False,
            hovertemplate=f"{name}<br>centre {x:.4g}, {y:.4g}, {z:.4g} {unit}"
            f"<br>{distance:.4g} {unit} from the reference<extra></extra>",
        )
    in_space(figure, 480, unit, np.array([0.0, -1.0, 0.0]), np.array([0.7, -1.0, -1.5]))
    labels = [
        _label(plain(camera.name), centre, camera_colour(index))
        for index, (camera, centre) in enumerate(zip(estimate.cameras, centres, strict=True))
    ]
    figure.update_layout(scene_annotations=labels)
    return figure


def _label(text: str, position: FloatArray, colour: str) -> dict[str, object]:
    # Plotly's 3-D text shows entities as they are written; an annotation decodes them.
    where = dict(zip("xyz", position.tolist(), strict=True))
    font = {"color": colour, "size": 13}
    return {**where, "text": text, "font": font, "showarrow": False, "yanchor": "top", "yshift": -6}


def central(points: FloatArray) -> FloatArray:
    """The POINTS_WITHIN of the points (n, 3) nearest to their median, at most POINTS of them."""
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return points
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    kept = points[distance <= np.quantile(distance, POINTS_WITHIN)]
    return kept[evenly(len(kept), POINTS)]


def frame_medians_px(problem: Problem, estimate: Estimate) -> FloatArray:
    """Median residual norm of each frame (n_frames,); NaN where a frame has none."""
    norms = np.linalg.norm(residuals_px(estimate, problem.observations), axis=1)
    finite = np.isfinite(norms)
    norms, frames = norms[finite], problem.observations.frame[finite]
    medians = np.full(len(estimate.rig_from_world), np.nan)
    for frame in np.unique(frames):
        medians[frame] = np.median(norms[frames == frame])
    return medians


def view_of(world_from_rig: list[Transform]) -> tuple[FloatArray, FloatArray]:
    """Up and eye for a first view from behind and above the rig's mean direction."""
    down = np.mean([t.rotation[:, 1] for t in world_from_rig], axis=0)
    ahead = np.mean([t.rotation[:, 2] for t in world_from_rig], axis=0)
    # A rig that tumbles or turns all around has no mean direction: any view is then as good.
    up = -down / np.linalg.norm(down) if np.linalg.norm(down) > 0.1 else np.array([0.0, 0.0, 1.0])
    ahead = ahead - (ahead @ up) * up
    if np.linalg.norm(ahead) < 0.1:
        ahead = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    ahead = ahead / np.linalg.norm(ahead)
    return up, 1.1 * up - 1.2 * ahead + 0.8 * np.cross(ahead, up)


def scan_figure(problem: Problem, estimate: Estimate, unit: str) -> go.Figure:
    """The rig's trajectory coloured by residual, some frustums, and the scene's points."""
    world_from_rig = [t.inverse for t in estimate.rig_from_world]
    path = np.array([t.translation for t in world_from_rig])
    points = central(estimate.points[np.unique(problem.observations.point)])
    extent = np.ptp(np.concatenate([path, points]), axis=0)
    length = FRUSTUM_OF_SCENE * float(np.linalg.norm(extent))
    figure = go.Figure()
    x, y, z = points.astype(np.float32).T
    figure.add_scatter3d(
        x=x,
        y=y,
        z=z,
        mode="markers",
        marker={"size": 1.6, "color": "#94a3b8"},
        name="scene point",
        hoverinfo="skip",
    )
    for index, camera in enumerate(estimate.cameras):
        rig_from_cam = estimate.cam_from_rig[index].inverse
        strokes = [
            stroke
            for frame in evenly(len(path), FRUSTUM_FRAMES)
            for stroke in frustum(camera, world_from_rig[frame] @ rig_from_cam, length)
        ]
        figure.add_trace(lines_3d(polyline(strokes), camera_colour(index), plain(camera.name)))
    figure.add_trace(_trajectory(problem, estimate, path))
    up, eye = view_of(world_from_rig)
    return in_space(figure, 620, unit, up, eye)


def _trajectory(problem: Problem, estimate: Estimate, path: FloatArray) -> go.Scatter3d:
    medians = frame_medians_px(problem, estimate)
    x, y, z = path.astype(np.float32).T
    return go.Scatter3d(
        x=x,
        y=y,
        z=z,
        mode="lines+markers",
        name="rig",
        line={"color": MUTED, "width": 3},
        marker={
            "size": 3,
            "color": medians.astype(np.float32),
            "colorscale": "Plasma",
            "colorbar": {
                "title": {"text": "median<br>residual, px"},
                "thickness": 10,
                "len": 0.6,
                "outlinewidth": 0,
            },
        },
        customdata=[plain(name) for name in problem.frame_names],
        hovertemplate="%{customdata}<br>median residual %{marker.color:.3f} px<extra></extra>",
    )

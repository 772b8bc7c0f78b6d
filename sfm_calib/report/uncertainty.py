"""What the covariance means in use: pixels over each image, depth over range for each pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from graphs.covariance import Covariance
from graphs.problem import Estimate, Problem, points_in_cameras
from graphs.uncertainty import (
    DepthSigma,
    ProjectionMap,
    curve_ranges,
    depth_sigma,
    pairs,
    projection_maps,
)
from sfm_calib.report.digits import short
from sfm_calib.report.image_plane import in_image
from sfm_calib.report.theme import (
    AMBER,
    BLUE,
    INK,
    MUTED,
    PAPER,
    Panel,
    figure_html,
    plain,
    round_number,
    styled,
)
from sfm_calib.result import Calibration, PairDepth, Uncertainty
from sfm_calib.uncertainty import uncertainty_of, unit_of

# Paler than MAGNITUDE_SCALE: the contours' labels must be read on it.
SIGMA_SCALE = ((0.0, "#f8fafc"), (0.4, "#bfdbfe"), (1.0, "#60a5fa"))
LEVELS = 4  # contours of a map, at least
COLOURS_REACH = 0.98  # quantile of a map: the outermost corner of a wide lens would hide the rest
LEAST_PX = 1e-3  # colours reach at least so far: what is held has no sigma
OF_RANGE = (0.01, 0.1)  # lines of reference in a plot of depths
UNIT_WORDS = {"m": "m", "baseline": "baselines", None: "units"}


@dataclass(frozen=True)
class ProjectionRow:
    """One line of the table of projections, ready to print."""

    camera: str
    what: str
    centre: str
    rms: str
    corner: str


@dataclass(frozen=True)
class DepthRow:
    """One line of the table of depths, ready to print; `missing` says why there is no sigma."""

    pair: str
    range: str
    noise: str
    calibration: str
    total: str
    percent: str
    missing: str


@dataclass(frozen=True)
class UncertaintySection:
    """What the page shows of pixels and depths."""

    is_rig: bool
    unit: str
    noise: str  # of one pixel coordinate in depths, px
    rows: tuple[ProjectionRow, ...]
    maps: tuple[Panel, ...]
    depth_rows: tuple[DepthRow, ...]
    curves: tuple[Panel, ...]
    remarks: tuple[str, ...]  # on pairs without a curve


def uncertainty_section(
    calibration: Calibration, problem: Problem, estimate: Estimate
) -> UncertaintySection:
    """Maps, curves and tables of a result that states a covariance.

    Tables show what the file says; files from before it did so are filled in here.
    """
    stated = Covariance(calibration.covariance.names, np.array(calibration.covariance.matrix))
    sigma_px = calibration.noise.sigma_px if calibration.noise else None
    record = calibration.uncertainty or uncertainty_of(
        estimate, stated, sigma_px, unit_of(calibration)
    )
    is_rig = len(estimate.cameras) > 1
    unit = UNIT_WORDS[record.unit]
    typical = _two_digits(typical_range(problem, estimate)) if record.unit else np.inf
    curves = {}
    if record.sigma_px is not None:
        for pair in pairs(estimate):
            ranges = curve_ranges(estimate, pair)
            curves[pair] = depth_sigma(estimate, stated, pair, ranges, record.sigma_px)
    return UncertaintySection(
        is_rig,
        unit,
        "" if record.sigma_px is None else short(record.sigma_px),
        projection_rows(record, unit),
        map_panels(estimate, stated, typical, unit),
        tuple(row for pair in record.depth for row in depth_rows(pair)),
        tuple(
            _depth_panel(estimate, curve, unit)
            for curve in curves.values()
            if curve.determined.sum() > 1
        ),
        _remarks(estimate, list(curves.values()), calibration),
    )


def typical_range(problem: Problem, estimate: Estimate) -> float:
    """Median distance of the observed points from the cameras; infinity where there are none."""
    distance = np.linalg.norm(points_in_cameras(estimate, problem.observations), axis=1)
    distance = distance[np.isfinite(distance)]
    return float(np.median(distance)) if distance.size else np.inf


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}")


# ---- over the image ------------------------------------------------------------------------


def _where(relative_to: str, distance: float | None, unit: str) -> str:
    if relative_to == "camera":
        return "the lens alone"
    at = "at infinity" if distance is None else f"at {distance:g} {unit}"
    return f"in the rig, {at}"


def projection_rows(record: Uncertainty, unit: str) -> tuple[ProjectionRow, ...]:
    """The file's numbers, camera by camera."""
    return tuple(
        ProjectionRow(
            name,
            _where(one.relative_to, one.range, unit),
            short(one.centre_px),
            short(one.rms_px),
            short(one.corner_px),
        )
        for name, told in record.projection.items()
        for one in told
    )


def map_panels(
    estimate: Estimate, covariance: Covariance, typical: float, unit: str
) -> tuple[Panel, ...]:
    """A map for each camera, in a rig two; of one kind all share their colours."""
    alone = projection_maps(estimate, covariance)
    in_rig = projection_maps(estimate, covariance, typical, "rig") if len(alone) > 1 else ()
    panels = []
    for kind, maps in (("camera", alone), ("rig", in_rig)):
        reach = max((_reach(one) for one in maps), default=LEAST_PX)
        for one in maps:
            distance = one.range if np.isfinite(one.range) else None
            where = _where(kind, distance, unit)
            caption = (
                f"{short(one.centre_px)} px at the centre, {short(one.rms_px)} px rms, "
                f"{short(one.corner_px)} px in the worst corner."
            )
            figure = figure_html(
                map_figure(one, estimate, reach), f"camera-{one.camera}-sigma-{kind}"
            )
            title = f"{estimate.cameras[one.camera].name}: {where}"
            panels.append((one.camera, Panel(title, caption, figure)))
    # Side by side: a camera's two maps.
    return tuple(panel for _, panel in sorted(panels, key=lambda entry: entry[0]))


def _reach(one: ProjectionMap) -> float:
    return max(float(np.nanquantile(one.sigma_px, COLOURS_REACH)), LEAST_PX)


def map_figure(one: ProjectionMap, estimate: Estimate, reach: float) -> go.Figure:
    """Sigma over one image, colours up to `reach` px, with labelled contours."""
    step = round_number(reach / LEVELS)
    figure = go.Figure(
        go.Contour(
            x=one.across.astype(np.float32),
            y=one.down.astype(np.float32),
            z=one.sigma_px.astype(np.float32),
            zmin=0,
            zmax=reach,
            colorscale=SIGMA_SCALE,
            colorbar={"title": "px", "thickness": 10, "outlinewidth": 0},
            contours={
                "coloring": "heatmap",
                "showlabels": True,
                "labelfont": {"size": 11, "color": INK},
                "start": step,
                "end": reach,
                "size": step,
            },
            line={"color": INK, "width": 0.8},
            hovertemplate="%{x:.0f}, %{y:.0f}<br>sigma %{z:.3f} px<extra></extra>",
        )
    )
    return in_image(figure, estimate.cameras[one.camera])


# ---- over range ----------------------------------------------------------------------------


def depth_rows(pair: PairDepth) -> tuple[DepthRow, ...]:
    """The file's numbers of one pair."""
    rows = []
    for one in pair.depth:
        noise, calibration = one.sigma_noise, one.sigma_calibration
        shown = ("", "", "", "")
        if noise is not None and calibration is not None:
            total = float(np.hypot(noise, calibration))
            percent = short(100 * total / one.range)
            shown = (short(noise), short(calibration), short(total), percent)
        name = " and ".join(pair.cameras)
        rows.append(DepthRow(name, f"{one.range:g}", *shown, one.missing))
    return tuple(rows)


def _names(estimate: Estimate, curve: DepthSigma) -> str:
    return " and ".join(estimate.cameras[camera].name for camera in curve.cameras)


def _depth_panel(estimate: Estimate, curve: DepthSigma, unit: str) -> Panel:
    first, second = curve.cameras
    figure = figure_html(
        depth_figure(curve, estimate.cameras[first].name, unit), f"depth-{first}-{second}"
    )
    title = f"{_names(estimate, curve)}, {curve.baseline:.3g} {unit} apart"
    if np.isclose(curve.baseline, 1.0) and unit == UNIT_WORDS["baseline"]:
        title = _names(estimate, curve)  # the unit itself
    return Panel(title, " ".join(_said(curve, unit)), figure)


def _said(curve: DepthSigma, unit: str) -> list[str]:
    """What a curve tells, in words."""
    there = curve.determined
    ranges, larger = curve.ranges[there], (curve.sigma_calibration > curve.sigma_noise)[there]
    said = []
    if larger.all():
        said.append("The calibration is the larger part everywhere: averaging gains little.")
    elif not larger.any():
        said.append("The noise of one measurement is the larger part everywhere: average.")
    elif larger[0] and (np.diff(larger.astype(int)) <= 0).all():
        last = int(larger.sum())  # from here on it is not: half way there
        limit = _two_digits(float(np.sqrt(ranges[last - 1] * ranges[last])))
        said.append(f"Up to about {limit:g} {unit} the calibration is the larger part.")
    if curve.determined_to is not None:
        said.append(
            f"Beyond about {_two_digits(curve.determined_to):g} {unit} a depth is less than three "
            "of its sigmas: not determined."
        )
    return [*said, "Dotted: 1 and 10 % of the range."]


def _remarks(
    estimate: Estimate, curves: Sequence[DepthSigma], calibration: Calibration
) -> tuple[str, ...]:
    if len(estimate.cameras) < 2:
        return ()
    if not curves:
        why = "no noise" if calibration.noise is None else "no unit of length"
        return (f"This result states {why}: nothing can be said of depths.",)
    blind = [_names(estimate, curve) for curve in curves if not curve.in_view.any()]
    vague = [
        _names(estimate, curve)
        for curve in curves
        if curve.in_view.any() and curve.determined.sum() <= 1
    ]
    remarks = []
    if blind:
        remarks.append(f"No common view, hence no depth: {'; '.join(blind)}.")
    if vague:
        remarks.append(f"A common view, but no depth is determined: {'; '.join(vague)}.")
    return tuple(remarks)


def depth_figure(curve: DepthSigma, first: str, unit: str) -> go.Figure:
    """Sigma of depth against range, both logarithmic: its two parts and the whole."""
    there = curve.determined
    ranges = curve.ranges[there]
    lines = (
        ("pixel noise, averages out", curve.sigma_noise, BLUE, "solid"),
        ("calibration, stays", curve.sigma_calibration, AMBER, "solid"),
        ("both", curve.sigma, INK, "dash"),
    )
    figure = go.Figure()
    for share in OF_RANGE:
        figure.add_scatter(
            x=ranges.astype(np.float32),
            y=(share * ranges).astype(np.float32),
            mode="lines",
            line={"color": MUTED, "width": 1, "dash": "dot"},
            hoverinfo="skip",
            showlegend=False,
        )
    for name, sigma, colour, dash in lines:
        figure.add_scatter(
            x=ranges.astype(np.float32),
            y=sigma[there].astype(np.float32),
            mode="lines",
            name=name,
            line={"color": colour, "width": 2, "dash": dash},
            customdata=(100 * sigma[there] / ranges).astype(np.float32),
            hovertemplate=f"at %{{x:.3g}} {unit}: %{{y:.2g}} {unit}, %{{customdata:.2g}} %"
            f"<extra>{name}</extra>",
        )
    _log_axes(figure, curve, first, unit)
    return figure


def _log_axes(figure: go.Figure, curve: DepthSigma, first: str, unit: str) -> None:
    there = curve.determined
    ranges = curve.ranges[there]
    shown = np.concatenate([curve.sigma_noise[there], curve.sigma[there]])
    low, high = np.log10(shown[shown > 0].min()) - 0.4, np.log10(shown.max()) + 0.2
    styled(figure, height=360)
    ticks = {
        "type": "log",
        "dtick": 1,
        "exponentformat": "none",
        "minor": {"ticks": "inside", "showgrid": False},
    }
    figure.update_xaxes(title=f"range from {plain(first)}, {unit}", **ticks)
    title = {"text": f"sigma of depth, {unit}", "standoff": 20}
    figure.update_yaxes(title=title, range=[low, high], **ticks)
    # A little inside: what lies outside the axes by rounding is not drawn.
    left = float(np.log10(ranges[0]) + 0.03 * np.log10(ranges[-1] / ranges[0]))
    for share in OF_RANGE:
        if low < left + np.log10(share) < high:
            figure.add_annotation(
                x=left,
                y=left + float(np.log10(share)),
                text=f"{100 * share:g} %",
                showarrow=False,
                bgcolor=PAPER,
                font={"size": 11, "color": MUTED},
            )

"""The part of a page that says whether an old calibration still holds."""

from __future__ import annotations

import plotly.graph_objects as go
from markupsafe import Markup

from graphs.drift import Verdict
from sfm_calib.drift_record import DriftRecord, DriftTest
from sfm_calib.drift_verdict import change_of, p_text, who
from sfm_calib.report.comparison import depth_figure, has_depth
from sfm_calib.report.digits import at_range, short
from sfm_calib.report.theme import (
    AMBER,
    BLUE,
    INK,
    MUTED,
    figure_html,
    page_template,
    plain,
    styled,
)

BANNERS: dict[Verdict, tuple[str, str]] = {
    "keep": ("good", "Keep"),
    "replace": ("bad", "Replace"),
    "inconclusive": ("doubtful", "Inconclusive"),
}
ROW_PX = 19
LEAST_PX = 1e-3  # left end of the axis: less shows in no image


def drift_section(record: DriftRecord) -> Markup:
    """A section of HTML, its outside text escaped; the page brings plotly.js and the style."""
    depths = (
        figure_html(depth_figure(record.pairs, record.unit, ("old", "new")), "drift-depth")
        if has_depth(record.pairs)
        else ""
    )
    return Markup(
        page_template("drift.html").render(
            record=record,
            banner=BANNERS[record.verdict],
            figure=figure_html(drift_figure(record), "drift-groups"),
            depth_figure=depths,
            at_range=at_range,
            change_of=change_of,
            p_text=p_text,
            short=short,
            who=who,
        )
    )


def drift_figure(record: DriftRecord) -> go.Figure:
    """Drift, what chance lets expect, and what is found: a group of a camera a row."""
    rows = list(range(len(record.tests)))
    told = [plain(_told(test)) for test in record.tests]
    figure = go.Figure(
        go.Bar(
            x=[max(test.effect_px, LEAST_PX) for test in record.tests],
            y=rows,
            orientation="h",
            marker={"color": [AMBER if test.found else BLUE for test in record.tests]},
            customdata=told,
            hovertemplate="%{customdata}<extra></extra>",
            name="drift",
            showlegend=False,
        )
    )
    for name, values, symbol, colour in (
        ("by chance", [test.expected_px for test in record.tests], "line-ns-open", INK),
        ("found from", [test.detectable_px for test in record.tests], "diamond-open", INK),
    ):
        figure.add_scatter(
            x=[max(value, LEAST_PX) for value in values],
            y=rows,
            mode="markers",
            marker={"symbol": symbol, "size": 9, "color": colour, "line": {"width": 2}},
            name=name,
            customdata=told,
            hovertemplate="%{customdata}<extra></extra>",
        )
    styled(figure, height=130 + ROW_PX * len(rows))
    figure.add_vline(x=record.matters_px, line={"color": MUTED, "width": 1, "dash": "dot"})
    figure.update_xaxes(title="rms over the image, px; dotted: what matters", type="log")
    figure.update_yaxes(
        tickvals=rows,
        ticktext=[plain(f"{who(test)}: {test.group}") for test in record.tests],
        range=[len(rows) - 0.5, -0.5],
        zeroline=False,
    )
    return figure


def _told(test: DriftTest) -> str:
    return (
        f"{who(test)}: {test.group}, {short(test.effect_px)} px, by chance "
        f"{short(test.expected_px)}, found from {short(test.detectable_px)}, "
        f"{p_text(test.p_corrected)}"
    )

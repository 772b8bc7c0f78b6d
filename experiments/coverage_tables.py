"""Tables and figures of the coverage study."""

from __future__ import annotations

from collections.abc import Sequence

import plotly.graph_objects as go

from experiments.coverage_summary import ALL, COVERAGE, Summary
from experiments.runner.protocol import AnswerFigure, AnswerTable
from sfm_calib.report.theme import MUTED, RULE, camera_colour, plain, styled

Value = tuple[float, float] | None


def overview(summaries: Sequence[Summary]) -> AnswerTable:
    """A row a case."""
    columns = (
        "case", "scans", "refused", "parameters", "NEES stated", "±", "NEES model", "± model",
        "NEES bound", "± bound", "expected ±", "coverage %", "worst %", "worst of",
        "RMSE / bound", "unpaired", "largest", "largest of", "sigma px", "seconds",
    )  # fmt: skip
    rows = []
    for s in summaries:
        kind, covered = s.worst_coverage
        largest = s.worst_of_bound if s.of_bound_paired else ("", None)
        rows.append(
            (
                s.case,
                s.scans,
                s.refused,
                s.parameters,
                *s.nees_stated,
                *s.nees_model,
                *(s.nees_efficient or (None, None)),
                s.chance,
                100 * s.coverage[ALL],
                100 * covered,
                kind,
                s.of_bound_paired.get(ALL),
                s.of_bound.get(ALL),
                largest[1],
                largest[0],
                s.sigma_px,
                s.seconds,
            )
        )
    title = (
        "NEES a degree of freedom (1: errors are as stated) by the stated and the model's "
        "covariance, and of least squares by the Cramer-Rao bound; 95 % intervals that hold the "
        "truth; RMSE over the bound"
    )
    return AnswerTable("overview", title, columns, tuple(rows))


def by_parameter(summaries: Sequence[Summary]) -> AnswerTable:
    """A row a kind of parameter and case: coverage by both covariances, RMSE over the bound."""
    rows = tuple(
        (
            kind,
            s.case,
            100 * s.coverage[kind],
            100 * s.coverage_model[kind],
            s.of_bound_paired.get(kind),
            s.of_bound.get(kind),
        )
        for kind in _kinds(summaries)
        for s in summaries
        if kind in s.coverage
    )
    columns = ("parameter", "case", "stated %", "model %", "RMSE / bound", "unpaired")
    title = "95 % intervals that hold the truth, and RMSE over the bound, by kind of parameter"
    return AnswerTable("by_parameter", title, columns, rows)


def _kinds(summaries: Sequence[Summary]) -> tuple[str, ...]:
    kinds = dict.fromkeys(kind for s in summaries for kind in s.coverage if kind != ALL)
    return (*kinds, ALL)


def nees_figure(summaries: Sequence[Summary]) -> AnswerFigure:
    """NEES of each case with the chance of it, by the three covariances."""
    figure = go.Figure()
    cases = [plain(s.case) for s in summaries]
    of: list[tuple[str, list[Value]]] = [
        ("stated", [s.nees_stated for s in summaries]),
        ("model", [s.nees_model for s in summaries]),
        ("bound, of least squares", [s.nees_efficient for s in summaries]),
    ]
    for index, (name, values) in enumerate(of):
        figure.add_scatter(
            x=cases,
            y=[None if value is None else value[0] for value in values],
            name=name,
            mode="markers",
            marker={"color": camera_colour(index), "size": 9},
            error_y={"type": "data", "array": [s.chance for s in summaries]},
        )
    figure.add_hline(y=1, line={"color": MUTED, "dash": "dot"})
    styled(figure, 400)
    figure.update_xaxes(automargin=True)
    figure.update_yaxes(title="NEES a degree of freedom", rangemode="normal")
    figure.update_layout(showlegend=True, scattermode="group", scattergap=0.6)
    caption = (
        "Errors are as large as stated at 1, larger above. Bars: a standard error of so many scans "
        "and parameters. Sigmas that were twice too small would stand at 4."
    )
    return AnswerFigure("nees", "Squared errors over the covariance", caption, figure)


def coverage_figure(summaries: Sequence[Summary]) -> AnswerFigure:
    """How often 95 % intervals hold the truth, by kind of parameter and case."""
    figure = go.Figure()
    low, high = (100 * share for share in COVERAGE)
    figure.add_hrect(y0=low, y1=high, fillcolor=RULE, opacity=0.5, line_width=0, layer="below")
    figure.add_hline(y=95, line={"color": MUTED, "dash": "dot"})
    geometries = list(dict.fromkeys(s.case.split()[0] for s in summaries))
    for s in summaries:
        colour = camera_colour(geometries.index(s.case.split()[0]))
        kinds = [kind for kind in _kinds(summaries) if kind in s.coverage]
        figure.add_scatter(
            x=kinds,
            y=[100 * s.coverage[kind] for kind in kinds],
            name=plain(s.case),
            mode="markers",
            marker={"color": colour, "symbol": _symbol(s), "size": 8},
        )
    styled(figure, 420)
    figure.update_yaxes(title="95 % intervals that hold the truth, %")
    figure.update_xaxes(
        categoryarray=list(_kinds(summaries)), categoryorder="array", automargin=True
    )
    figure.update_layout(showlegend=True)
    caption = (
        "The band is what is promised; of one kind of parameter chance may exceed it by three "
        "standard errors. Rings: heavy noise."
    )
    return AnswerFigure("coverage", "Coverage of the intervals", caption, figure)


def _symbol(summary: Summary) -> str:
    return "circle-open" if summary.noise == "heavy" else "circle"

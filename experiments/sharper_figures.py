"""Tables and figures of the study `sharper_tracks`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import plotly.graph_objects as go

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import AnswerFigure, AnswerTable, Row
from experiments.scatter import mean_of
from experiments.sharper_kinds import (
    CENTRE,
    FOCAL,
    RAW,
    STAGES,
    Case,
    Kind,
    Measure,
    gain,
    kinds_of,
    mean_square_of,
    names_of,
    root_mean,
    square_of,
    values_of,
)
from experiments.standard_errors import rms
from sfm_calib.report.theme import camera_colour, plain, styled

ROTATION = ("rotation_x", "rotation_y", "rotation_z", "rotation_deg")
# Of a case and a kind: rms over the seeds.
MEASURED: dict[str, Measure] = {
    "sigma px": square_of("noise_px"),
    "residual px": square_of("residual_px"),
    "true noise px": square_of("noise_true_px"),
    "true 90 % px": square_of("noise_true_90_px"),
    "focal error px": mean_square_of("error", FOCAL),
    "focal sigma px": mean_square_of("sigma", FOCAL),
    "focal noise alone px": mean_square_of("sigma_noise", FOCAL),
    "centre error px": mean_square_of("error", CENTRE),
    "centre sigma px": mean_square_of("sigma", CENTRE),
    "centre noise alone px": mean_square_of("sigma_noise", CENTRE),
    "rotation error deg": mean_square_of("error", ROTATION),
    "rotation sigma deg": mean_square_of("sigma", ROTATION),
    "z rms": square_of("z_rms"),
    "picture error px": square_of("error_px"),
    "halves px": square_of("halves_px"),
}
COUNTED = {"images": "n_images", "tracks": "n_tracks", "observations": "n_observations"}
AVERAGED = {"inflation": "inflation", "NEES": "nees_stated", "NEES of noise alone": "nees_noise"}
GAINS: dict[str, Measure] = {
    "true noise": square_of("noise_true_px"),
    "stated noise": square_of("noise_px"),
    "focal error": mean_square_of("error", FOCAL),
    "principal point error": mean_square_of("error", CENTRE),
    "focal sigma": mean_square_of("sigma", FOCAL),
    "focal sigma of noise alone": mean_square_of("sigma_noise", FOCAL),
    "halves": square_of("halves_px"),
}


def numbers(rows: Sequence[Row], column: str) -> np.ndarray:
    """A column of the rows that have it (n,)."""
    return np.array([v for row in rows if (v := row.get(column)) is not None], dtype=np.float64)


def mean(rows: Sequence[Row], column: str) -> float | None:
    """Of the rows that have it."""
    values = numbers(rows, column)
    return float(values.mean()) if values.size else None


# ---- tables --------------------------------------------------------------------------------


def kind_table(cases: Sequence[Case]) -> AnswerTable:
    """A row a scan and kind of tracks."""
    rows = [
        (
            case.name, kind.name, len(some),
            *(mean(some, column) for column in COUNTED.values()),
            *(root_mean(some, measure) for measure in MEASURED.values()),
            *(mean(some, column) for column in AVERAGED.values()),
        )
        for case in cases
        for kind in kinds_of([case])
        if (some := case.rows(kind))
    ]  # fmt: skip
    columns = ("scan", "tracks", "trials", *COUNTED, *MEASURED, *AVERAGED)
    title = "Noise, errors and sigmas, rms over the seeds; halves: how far they project apart"
    return AnswerTable("tracks", title, columns, tuple(rows))


def parameter_table(cases: Sequence[Case]) -> AnswerTable:
    """A row a kind of parameter, of all cameras, for each scan and kind of tracks."""
    found: list[tuple[str | float, ...]] = []
    for case in cases:
        for kind in kinds_of([case]):
            rows = case.rows(kind)
            names = dict.fromkeys(name for row in rows for name in names_of(row))
            for name in dict.fromkeys(one.rpartition(".")[2] for one in names):
                error, sigma, alone, reference = (
                    np.concatenate([values_of(row, column, (name,)) for row in rows])
                    for column in ("error", "sigma", "sigma_noise", "sigma_reference")
                )
                z = error / np.maximum(np.hypot(sigma, reference), 1e-300)
                values = (rms(one) for one in (error, sigma, alone, z))
                found.append((case.name, kind.name, name, len(error), *values))
    columns = ("scan", "tracks", "parameter", "values", "error", "sigma", "noise alone", "z rms")
    title = (
        "Errors against truth or reference, and what is stated of them, rms over cameras and seeds"
    )
    return AnswerTable("parameters", title, columns, tuple(found))


def seconds_table(cases: Sequence[Case]) -> AnswerTable:
    """A row a scan and kind of tracks; nothing where all trials shared what another had made."""
    rows = tuple(
        (case.name, kind.name, *(mean_seconds([case], kind, stage) for stage in STAGES))
        for case in cases
        for kind in kinds_of([case])
    )
    title = "Seconds a scan; what raw and refined tracks share is shown with both"
    return AnswerTable("seconds", title, ("scan", "tracks", *STAGES), rows)


# ---- figures -------------------------------------------------------------------------------


def figures(cases: Sequence[Case]) -> tuple[AnswerFigure, ...]:
    """Noise, gains, consistency and time, of all kinds of tracks."""
    return tuple(
        figure
        for draw in (noise_figure, gain_figures, nees_figure, seconds_figure)
        for figure in draw(cases)
    )


def noise_figure(cases: Sequence[Case]) -> Iterator[AnswerFigure]:
    """True and stated noise of each kind."""
    series = []
    for case in cases:
        for title, dashed in (("true noise px", False), ("sigma px", True)):
            kinds, values = _known(case, MEASURED[title])
            if kinds:
                what = "true" if not dashed else "stated"
                series.append(Series(f"{case.name}, {what}", kinds, values, dashed=dashed))
    if series:
        yield AnswerFigure(
            "noise", "Noise of the tracks",
            "Robust sigma of a pixel coordinate; dashed: as the solve states it.",
            lines(series, "", "px", log_y=True),
        )  # fmt: skip


def _known(case: Case, measure: Measure) -> tuple[list[str], list[float]]:
    """Kinds of a case for which something was measured, and that."""
    found = [(k.name, root_mean(case.rows(k), measure)) for k in kinds_of([case])]
    known = [(name, value) for name, value in found if value is not None]
    return [name for name, _ in known], [value for _, value in known]


def gain_figures(cases: Sequence[Case]) -> Iterator[AnswerFigure]:
    """How many times smaller than raw SIFT's, of rendered scans and of others."""
    for rendered, name in ((True, "rendered"), (False, "real")):
        some = [case for case in cases if case.rendered == rendered]
        others = [kind for kind in kinds_of(some) if kind != RAW]
        series = [_gains(title, some, others, measure) for title, measure in GAINS.items()]
        told = [one for one in series if one.x]
        if told:
            figure = lines(told, "", "times smaller than raw SIFT's", log_y=True, level=1)
            figure.update_traces(mode="markers")
            figure.update_layout(scattermode="group", scattergap=0.6)
            yield AnswerFigure(
                f"gain_{name}", f"Sharper than raw SIFT, {name} scans",
                "Bars: standard errors, with one trial left out at a time. A sigma of noise alone "
                "above the stated one is gain that errors of whole images or tracks take away.",
                figure,
            )  # fmt: skip


def _gains(title: str, cases: Sequence[Case], kinds: Sequence[Kind], measure: Measure) -> Series:
    found = [(kind.name, gain(cases, kind, measure)) for kind in kinds]
    known = [(name, value) for name, value in found if value is not None]
    return Series(
        title, [name for name, _ in known], [value for _, (value, _) in known],
        [error or 0.0 for _, (_, error) in known],
    )  # fmt: skip


def nees_figure(cases: Sequence[Case]) -> Iterator[AnswerFigure]:
    """Squared errors over the stated covariance, a degree of freedom."""
    series = []
    for case in cases:
        kinds = [k for k in kinds_of([case]) if numbers(case.rows(k), "nees_stated").size]
        if kinds:
            found = [mean_of(numbers(case.rows(kind), "nees_stated")) for kind in kinds]
            values, bars = [v for v, _ in found], [error or 0.0 for _, error in found]
            series.append(Series(case.name, [kind.name for kind in kinds], values, bars))
    if series:
        yield AnswerFigure(
            "nees", "Do the sigmas hold?", "Errors are as large as stated at 1, larger above.",
            lines(series, "", "NEES a degree of freedom", level=1),
        )  # fmt: skip


def mean_seconds(cases: Sequence[Case], kind: Kind, stage: str) -> float | None:
    """Over all scans where a trial did it."""
    values = [one for case in cases for one in case.seconds(kind, stage).values()]
    return float(np.mean(values)) if values else None


def seconds_figure(cases: Sequence[Case]) -> Iterator[AnswerFigure]:
    """Where the time goes, by kind of tracks."""
    figure = go.Figure()
    kinds = kinds_of(cases)
    for index, stage in enumerate(STAGES):
        figure.add_bar(
            x=[plain(kind.name) for kind in kinds],
            y=[mean_seconds(cases, kind, stage) for kind in kinds],
            name=stage,
            marker={"color": camera_colour(index)},
        )
    styled(figure, 380)
    figure.update_yaxes(title="s a scan")
    figure.update_layout(barmode="stack", showlegend=True)
    caption = (
        "Means over all scans, where a trial did the stage. Features, matches and mapping are made "
        "once for raw and refined tracks, and shown with both."
    )
    yield AnswerFigure("seconds", "Seconds of each stage", caption, figure)

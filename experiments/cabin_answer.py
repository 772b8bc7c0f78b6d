"""What the trials of `depth_camera_cabin` say: cases beside one another, tables, figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.colors import sample_colorscale
from plotly.subplots import make_subplots

from experiments.cabin_calibration import CabinOptions
from experiments.cabin_model import FAILED_MM, PAINTED
from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from graphs.frames import FloatArray
from sfm_calib.report.theme import MUTED, camera_colour, styled
from sfm_calib.simulate.head import make_head

Trials = Sequence[Finished[CabinOptions]]
Cases = Mapping[str, Trials]  # finished ones, by what is said of the case

# The published study, as the project's plan quotes it, in mm.
PUBLISHED_FACTORY, PUBLISHED_CALIBRATED = (3.02, 3.84), (2.18, 2.95)  # mean, RMS
PUBLISHED_FUSED = (2.36, 2.95, 15.9)  # mean, RMS, largest
AS_GOOD = 1.1  # RMS with a scan and a board over that with boards, at most
OFTEN = 0.5  # share of cabins whose places by hand do not register
STANDARD_ERRORS = 3.0

NOTHING, FACTORY, BOARDS = "nothing", "places by boards, factory lenses", "boards"
SCAN, LOOSE, ADDED, TRUTH = "scan, tape", "scan, no length", "scan + one board", "truth"
LENSES = "lenses by boards, places by hand"
PAINTED_CASES = (NOTHING, FACTORY, BOARDS, ADDED)
PAINTED_MM = 6.0  # where colours end
PAINT, UNSEEN = "Viridis", "rgb(200, 200, 200)"


def case_of(options: CabinOptions) -> str:
    """The case in a few words."""
    known = options.intrinsics, options.extrinsics
    if options.way == "none":
        by_hand = f"places by hand ({options.hand_deg:g}°, {options.hand_mm:g} mm)"
        return {
            ("factory", "hand"): NOTHING,
            ("true", "true"): TRUTH,
            ("true", "hand"): f"true lenses, {by_hand}",
        }.get(known, "factory lenses, true places")
    scan = SCAN if options.scale == "tape" else LOOSE
    way = {"boards": BOARDS, "scan": scan, "scan_board": ADDED}[options.way]
    lenses = f"{options.intrinsics} lenses"
    return {
        ("calibrated", "calibrated"): way,
        ("factory", "calibrated"): f"places by {way}, factory lenses",
        ("calibrated", "hand"): f"lenses by {way}, places by hand",
    }.get(known, f"{way}: {lenses}, {options.extrinsics} places")


def answer(trials: Trials) -> Answer:
    """Every case beside the others, and the three questions."""
    cases = by_case([one for one in trials if one.error is None])
    if not cases:
        return Answer("no trial was finished", None)
    said, verdicts = [], []
    for question in (improved, fails_by_hand, scan_for_boards):
        words, holds = question(cases)
        said.append(words)
        verdicts.append(holds)
    known = [one for one in verdicts if one is not None]
    holds = None if len(known) < len(verdicts) else all(known)
    lead = "unsaid" if holds is None else "yes" if holds else "in part" if any(known) else "no"
    refused = sum(one.error is not None for one in trials)
    less = f"; {refused} of {len(trials)} trials failed" if refused else ""
    return Answer(f"{lead}: {'; '.join(said)}{less}", holds, tables(cases), figures(cases))


def by_case(trials: Trials) -> Cases:
    names = dict.fromkeys(case_of(one.options) for one in trials)
    return {name: [one for one in trials if case_of(one.options) == name] for name in names}


# ---- the questions -------------------------------------------------------------------------


def improved(cases: Cases) -> tuple[str, bool | None]:
    """Whether calibrated lenses, and lenses and places, make the model better."""
    if BOARDS not in cases or NOTHING not in cases or FACTORY not in cases:
        return "what calibration improves is unsaid", None
    whole, of_lenses = (paired(cases[name], cases[BOARDS], "rms_mm") for name in (NOTHING, FACTORY))
    before, lenses, after = (mean(cases[name], "rms_mm")[0] for name in (NOTHING, FACTORY, BOARDS))
    words = (
        f"the head's RMS falls from {before:.1f} mm uncalibrated to {after:.2f} mm by boards "
        f"(by lenses alone from {lenses:.1f})"
    )
    if TRUTH in cases:
        words += f", and is {mean(cases[TRUTH], 'rms_mm')[0]:.2f} mm by noise alone"
    return words, beyond_chance([whole, of_lenses])


def beyond_chance(differences: Sequence[tuple[float, float]]) -> bool | None:
    """Whether all (mean, standard error) are above zero by more than chance."""
    if not all(np.isfinite(error) for _, error in differences):
        return None
    return all(mean > STANDARD_ERRORS * error for mean, error in differences)


def fails_by_hand(cases: Cases) -> tuple[str, bool | None]:
    """Whether places by hand often fail to register."""
    if NOTHING not in cases:
        return "whether places by hand register is unsaid", None
    trials = cases[NOTHING]
    failed = sum(is_lost(one) for one in trials)
    refused = sum(number(one, "refused") > 0 for one in trials)
    words = (
        f"by ICP from places by hand {failed} of {len(trials)} heads fail ({refused} refused by "
        f"name)"
    )
    if len(trials) < 2:
        return words, None
    share = failed / len(trials)
    chance = (OFTEN * (1 - OFTEN) / len(trials)) ** 0.5
    return words, share > OFTEN - chance


def scan_for_boards(cases: Cases) -> tuple[str, bool | None]:
    """Whether a scan with one board does what boards do."""
    if BOARDS not in cases or ADDED not in cases:
        return "what a scan is worth is unsaid", None
    boards, added = (mean(cases[name], "rms_mm")[0] for name in (BOARDS, ADDED))
    words = f"a scan with one board reaches {added:.2f} mm"
    for name, what in ((SCAN, "with a tape"), (LOOSE, "without any length")):
        if name in cases:
            words += f", {what} {mean(cases[name], 'rms_mm')[0]:.2f}"
    more, error = paired(cases[ADDED], cases[BOARDS], "rms_mm")
    if not np.isfinite(error):
        return words, None
    return words, more - STANDARD_ERRORS * error <= (AS_GOOD - 1) * boards


def is_lost(trial: Finished[CabinOptions]) -> bool:
    """Whether ICP left a part of the model where it does not belong."""
    return number(trial, "registered_misplaced_mm") > FAILED_MM or number(trial, "refused") > 0


# ---- numbers -------------------------------------------------------------------------------


def number(trial: Finished[CabinOptions], column: str) -> float:
    value = trial.row.get(column)
    return float(value) if isinstance(value, int | float) else float("nan")


def mean(trials: Trials, column: str) -> tuple[float, float]:
    """Mean over trials that measured it and its standard error, infinite of one."""
    values = np.array([number(one, column) for one in trials])
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return float(values.mean()) if len(values) else float("nan"), float("inf")
    return float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)


def paired(trials: Trials, others: Trials, column: str) -> tuple[float, float]:
    """Mean of the differences on the same cabins and its standard error, infinite of one."""
    there = {one.seed: number(one, column) for one in others}
    less = np.array([number(one, column) - there[one.seed] for one in trials if one.seed in there])
    less = less[np.isfinite(less)]
    if len(less) < 2:
        return float(less.mean()) if len(less) else float("nan"), float("inf")
    return float(less.mean()), float(less.std(ddof=1) / len(less) ** 0.5)


def share(trials: Trials, is_so: Callable[[Finished[CabinOptions]], bool]) -> float:
    return float(np.mean([is_so(one) for one in trials]))


def digits(value: float, places: int = 2) -> float | None:
    return round(value, places) if np.isfinite(value) else None


# ---- tables --------------------------------------------------------------------------------


def tables(cases: Cases) -> tuple[AnswerTable, ...]:
    return (model_table(cases), registration_table(cases), device_table(cases), sigma_table(cases))


def model_table(cases: Cases) -> AnswerTable:
    """The fused model by each case, as its places have it."""
    rows = [
        (
            name,
            len(trials),
            digits(mean(trials, "mean_mm")[0]),
            digits(mean(trials, "rms_mm")[0]),
            digits(mean(trials, "rms_mm")[1]),
            digits(mean(trials, "p95_mm")[0]),
            digits(mean(trials, "max_mm")[0], 1),
            digits(mean(trials, "hausdorff_mm")[0], 1),
            digits(mean(trials, "misplaced_mm")[0], 1),
        )
        for name, trials in cases.items()
    ]
    published = ("published", None, *PUBLISHED_FUSED[:2], None, None, PUBLISHED_FUSED[2], None, None)
    return AnswerTable(
        "model",
        "Distance of the fused model to the head, mm: means over cabins",
        ("case", "cabins", "mean", "RMS", "±", "95 %", "largest", "Hausdorff", "part misplaced"),
        (*rows, published),
    )


def registration_table(cases: Cases) -> AnswerTable:
    """What ICP of the parts with each other makes of the same models."""
    rows = [
        (
            name,
            digits(mean(trials, "rms_mm")[0]),
            digits(mean(trials, "registered_rms_mm")[0]),
            digits(mean(trials, "registered_rms_mm")[1]),
            digits(mean(trials, "misplaced_mm")[0], 1),
            digits(mean(trials, "registered_misplaced_mm")[0], 1),
            digits(100 * share(trials, is_lost), 0),
            digits(100 * share(trials, lambda one: number(one, "refused") > 0), 0),
        )
        for name, trials in cases.items()
    ]
    columns = (
        "case", "RMS as placed, mm", "RMS by ICP", "±", "misplaced as placed", "misplaced by ICP",
        "failed, %", "of them refused, %",
    )  # fmt: skip
    title = f"The same after ICP between the parts; failed: a part over {FAILED_MM:g} mm misplaced"
    return AnswerTable("registration", f"{title}, or refused", columns, tuple(rows))


def device_table(cases: Cases) -> AnswerTable:
    """Single devices: what lenses alone do."""
    columns = ("infrared_mean_mm", "infrared_rms_mm", "colour_mean_mm", "colour_rms_mm")
    rows = [
        (name, *(digits(mean(trials, column)[0]) for column in columns))
        for name, trials in cases.items()
    ]
    return AnswerTable(
        "devices",
        "Clouds of single devices, each laid on the head by itself, mm",
        ("case", "infrared mean", "infrared RMS", "depth in colour: mean", "RMS"),
        (
            *rows,
            ("published, factory", *PUBLISHED_FACTORY, None, None),
            ("published, calibrated", *PUBLISHED_CALIBRATED, None, None),
        ),
    )


def sigma_table(cases: Cases) -> AnswerTable:
    """Errors of the calibration itself, and whether its sigmas say so."""
    rows = []
    for name, trials in cases.items():
        if not any(np.isfinite(number(one, "nees")) for one in trials):
            continue
        nees, error = mean(trials, "nees")
        rows.append((
            name,
            digits(mean(trials, "infrared_focal_px")[0]),
            digits(mean(trials, "infrared_centre_px")[0]),
            digits(mean(trials, "colour_focal_px")[0]),
            digits(mean(trials, "colour_centre_px")[0]),
            digits(mean(trials, "turn_deg")[0], 3),
            digits(mean(trials, "shift_mm")[0]),
            digits(nees),
            digits(error),
            digits(100 * mean(trials, "covered")[0], 0),
            digits(mean(trials, "seconds_calibration")[0], 1),
        ))  # fmt: skip
    columns = (
        "case", "infrared fx, px", "centre", "colour fx, px", "centre", "side devices turned, deg",
        "shifted, mm", "NEES", "±", "95 % intervals that hold, %", "seconds",
    )  # fmt: skip
    title = "Errors of the calibration (rms), and whether its sigmas hold (NEES 1)"
    return AnswerTable("calibration", title, columns, tuple(rows))


# ---- figures -------------------------------------------------------------------------------


def figures(cases: Cases) -> tuple[AnswerFigure, ...]:
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
                "are (true lenses): as placed, and after ICP between the parts.",
                hand_figure(swept),
            )
        )
    painted = [name for name in PAINTED_CASES if name in cases and "painted_mm" in cases[name][0].row]
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
    figure.update_yaxes(title="RMS distance, mm")
    figure.update_layout(showlegend=True, barmode="group")
    return figure


def by_hand(cases: Cases) -> list[tuple[CabinOptions, Trials]]:
    """Cases of true lenses and places by hand, by how far these are off."""
    found = [
        (trials[0].options, trials)
        for trials in cases.values()
        if (trials[0].options.way, trials[0].options.intrinsics) == ("none", "true")
        and trials[0].options.extrinsics == "hand"
    ]
    return sorted(found, key=lambda one: (one[0].hand_deg, one[0].hand_mm))


def hand_figure(swept: Sequence[tuple[CabinOptions, Trials]]) -> go.Figure:
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
    styled(figure, 420)
    hidden = dict.fromkeys(("xaxis", "yaxis", "zaxis"), {"visible": False})
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

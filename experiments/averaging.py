"""What many calibrations say of averaging: errors of means, what was predicted, where it ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import AnswerFigure, AnswerTable, Row
from experiments.scatter import (
    FEWEST,
    STANDARD_ERRORS,
    Value,
    in_digits,
    mean_of,
    ratio_of,
    root_of,
    stacked,
    within,
)
from experiments.standard_errors import jackknifed
from graphs.frames import FloatArray

Measure = Literal["depth", "point", "length"]
MEASURES: tuple[Measure, ...] = get_args(Measure)

FLOOR_NEES = (0.9, 1.15)  # as `coverage` promises of the calibration
RMSE_RATIO = (0.9**0.5, 1.15**0.5)
NSTAR_ROOM = 1.15**2  # a factor either way: calibration by 15 %, noise by 15 %
SIGMA_ROOM = 0.02  # of the noise: what is left of it in a sum of squares of some thousand residuals


@dataclass(frozen=True)
class Curve:
    """Errors of means of one measure, by one kind of rig and scan."""

    of: str  # the rig and its scan
    measure: Measure
    trials: int
    ranges_m: FloatArray  # (r,)
    counts: FloatArray  # (n,)
    rmse_m: FloatArray  # (r, n)
    predicted_m: FloatArray  # (r, n)
    ratio: tuple[Value, ...]  # (n,) RMSE over predicted, over all ranges
    noise_m: FloatArray  # (r,) of one measurement, stated
    calibration_m: FloatArray  # (r,) stated
    floor_m: FloatArray  # (r,) RMSE without noise
    nees: Value  # of the floor, over all ranges
    nstar: tuple[Value, ...]  # (r,) measured
    nstar_predicted: FloatArray  # (r,)


@dataclass(frozen=True)
class Kind:
    """One kind of rig and scan: its curves, and what they share."""

    of: str
    true_px: float  # noise of a coordinate
    sigma_px: Value  # as its scans estimate it
    nstar: Value  # measured over predicted, geometric mean over measures and ranges
    curves: tuple[Curve, ...]


def kind_of(of: str, true_px: float, rows: Sequence[Row]) -> Kind:
    """The rows of one kind of rig together."""
    curves = tuple(curve_of(of, measure, rows) for measure in MEASURES)
    sigma_px = mean_of(stacked(rows, "sigma_px"))
    return Kind(of, true_px, sigma_px, nstar_ratio(rows), curves)


def nstar_ratio(rows: Sequence[Row]) -> Value:
    """N* measured over predicted, as a geometric mean. Measures and ranges of a trial share its
    calibration: its standard error is by leaving out whole trials."""
    parts = []
    for measure in MEASURES:
        noise, calibration, floor = (
            stacked(rows, f"{measure}_{key}") for key in ("noise", "calibration", "floor")
        )  # (trials, r)
        one = stacked(rows, f"{measure}_square").reshape(*floor.shape, -1)[..., 0]
        parts.append(np.stack([one - floor, floor, noise, calibration], axis=1))
    pooled = np.concatenate(parts, axis=2)  # (trials, 4, measures * r)

    def geometric_mean(some: FloatArray) -> float:
        drawn, floor, noise, calibration = some.mean(0).reshape(4, -1)
        return float(np.exp(np.log(drawn / floor * calibration / noise).mean()))

    with np.errstate(all="ignore"):  # noise that does not show beside the floor: no number
        ratio, error = jackknifed(geometric_mean, pooled.reshape(len(rows), -1))
    return ratio, error if len(rows) > 1 else None


def curve_of(of: str, measure: Measure, rows: Sequence[Row]) -> Curve:
    """The rows of one kind of rig together."""
    ranges, counts = stacked(rows[:1], "range_m")[0], stacked(rows[:1], "n")[0]
    square = stacked(rows, f"{measure}_square").reshape(len(rows), len(ranges), len(counts))
    noise, calibration, floor, nees = (
        stacked(rows, f"{measure}_{key}") for key in ("noise", "calibration", "floor", "nees")
    )  # (trials, r)
    predicted = noise[..., None] / counts + calibration[..., None]
    normalised = (square / predicted).mean(1)  # (trials, n)
    nstar = [
        ratio_of(np.column_stack([square[:, r, 0] - floor[:, r], floor[:, r]]))
        for r in range(len(ranges))
    ]
    return Curve(
        of,
        measure,
        len(rows),
        ranges,
        counts,
        np.sqrt(square.mean(0)),
        np.sqrt(predicted.mean(0)),
        tuple(root_of(column) for column in normalised.T),
        np.sqrt(noise.mean(0)),
        np.sqrt(calibration.mean(0)),
        np.sqrt(floor.mean(0)),
        mean_of(nees.mean(1)),
        tuple(nstar),
        noise.mean(0) / calibration.mean(0),
    )


# ---- the verdict ---------------------------------------------------------------------------


def judged(kinds: Sequence[Kind]) -> bool | None:
    """Whether the split predicts what means do; None: of some there are too few trials to say."""
    if any(c.trials < FEWEST for kind in kinds for c in kind.curves):
        return None
    return not any(wrong_of(kind) for kind in kinds)


def wrong_of(kind: Kind) -> list[str]:
    """What of a kind is not as expected: its noise, its N* pooled, and each of its curves."""
    said = []
    if not noise_is_right(kind):
        off = 100 * (kind.sigma_px[0] / kind.true_px - 1)
        said.append(f"{noise_in_words(kind)}: {abs(off):.0f} % {'low' if off < 0 else 'high'}")
    if not near(kind.nstar, 1.0, 1 / NSTAR_ROOM, NSTAR_ROOM):
        said.append(f"N* {in_digits(kind.nstar)} times the predicted ({kind.of})")
    wrong = [(c.measure, b) for c in kind.curves if (b := broken(c))]
    return [*said, *(f"{measure} ({kind.of}): {', '.join(b)}" for measure, b in wrong)]


def noise_is_right(kind: Kind) -> bool:
    """Whether scans estimate the noise that there is."""
    room = SIGMA_ROOM * kind.true_px
    return near(kind.sigma_px, kind.true_px, kind.true_px - room, kind.true_px + room)


def noise_in_words(kind: Kind) -> str:
    """Estimated beside true, and the kind."""
    return f"sigma_px {in_digits(kind.sigma_px, 3)} of {kind.true_px:.3f} at {kind.of}"


def near(value: Value, expected: float, low: float, high: float) -> bool:
    """Whether a value lies in the room about what is expected, or misses that by chance alone."""
    by_chance = abs(value[0] - expected) <= STANDARD_ERRORS * (value[1] or 0.0)
    return low <= value[0] <= high or by_chance


def broken(curve: Curve) -> list[str]:
    """What is not as expected, by more than chance."""
    said = []
    for n, ratio in ((0, curve.ratio[0]), (-1, curve.ratio[-1])):
        if not within(ratio, *RMSE_RATIO):
            said.append(f"RMSE of {curve.counts[n]:.0f}")
    if not within(curve.nees, *FLOOR_NEES):
        said.append("NEES of the floor")
    for at, found, expected in zip(curve.ranges_m, curve.nstar, curve.nstar_predicted, strict=True):
        if not near(found, expected, expected / NSTAR_ROOM, expected * NSTAR_ROOM):
            said.append(f"N* at {at:g} m")
    return said


def in_words(kinds: Sequence[Kind]) -> str:
    """The numbers that decide, in one line: depths at the middle range, and the worst of all."""
    curves = [c for kind in kinds for c in kind.curves]
    most = f"{curves[0].counts[-1]:.0f}"
    said = []
    for c in curves:
        if c.measure != "depth":
            continue
        r = len(c.ranges_m) // 2
        before, after = 1e3 * c.rmse_m[r, 0], 1e3 * c.rmse_m[r, -1]
        alone = 1e3 * c.noise_m[r] / c.counts[-1] ** 0.5
        said.append(
            f"{c.of}: {most} measurements of a depth of {c.ranges_m[r]:g} m leave {after:.2g} of "
            f"{before:.2g} mm (noise alone would leave {alone:.2g}), averaging pays to N* "
            f"{in_digits(c.nstar[r], 0)} (predicted {c.nstar_predicted[r]:.0f})"
        )
    for n, count in ((0, "one"), (-1, most)):
        said.append(f"RMSE over predicted {_range([c.ratio[n] for c in curves])} for {count}")
    said.append(f"NEES of the floor {_range([c.nees for c in curves])}")
    each = ", ".join(f"{in_digits(kind.nstar)} ({kind.of})" for kind in kinds)
    said.append(f"N* over predicted {each}")
    said += [noise_in_words(kind) for kind in kinds if noise_is_right(kind)]
    wrong = [one for kind in kinds for one in wrong_of(kind)]
    if wrong:
        said.append(f"not as predicted: {'; '.join(wrong)}")
    return "; ".join(said)


def _range(values: Sequence[Value]) -> str:
    low, high = (of(values, key=lambda value: value[0]) for of in (min, max))
    return in_digits(low) if low == high else f"{in_digits(low)} to {in_digits(high)}"


# ---- tables and figures --------------------------------------------------------------------


def tables(kinds: Sequence[Kind]) -> tuple[AnswerTable, ...]:
    """Where averaging ends, errors of means, and what the curves of a kind share."""
    curves = [c for kind in kinds for c in kind.curves]
    shared = tuple((k.of, k.true_px, *k.sigma_px, *k.nstar) for k in kinds)
    ends = [
        (
            c.of, c.measure, float(at), c.trials, 1e3 * float(c.noise_m[r]),
            1e3 * float(c.calibration_m[r]), 1e3 * float(c.floor_m[r]), *c.nees, *c.nstar[r],
            float(c.nstar_predicted[r]), float(c.rmse_m[r, 0] / c.rmse_m[r, -1]),
            float(c.predicted_m[r, 0] / c.predicted_m[r, -1]),
        )
        for c in curves
        for r, at in enumerate(c.ranges_m)
    ]  # fmt: skip
    means = [
        (
            c.of, c.measure, float(at), int(count), 1e3 * float(c.rmse_m[r, n]),
            1e3 * float(c.predicted_m[r, n]), *c.ratio[n],
        )
        for c in curves
        for r, at in enumerate(c.ranges_m)
        for n, count in enumerate(c.counts)
    ]  # fmt: skip
    columns = ("rig and scan", "measure", "range (m)")
    return (
        AnswerTable(
            "ends", "Where averaging ends",
            (
                *columns, "trials", "stated noise of one (mm)", "stated calibration (mm)",
                "RMSE without noise (mm)", "NEES of the floor, all ranges", "±", "N*", "±",
                "N* predicted", "less by the most", "predicted",
            ), tuple(ends),
        ),
        AnswerTable(
            "means", "Errors of means",
            (*columns, "N", "RMSE (mm)", "predicted (mm)", "RMSE / predicted, all ranges", "±"),
            tuple(means),
        ),
        AnswerTable(
            "noise", "The noise that scans estimate, and N* over all measures and ranges",
            ("rig and scan", "noise (px)", "estimated (px)", "±", "N* / predicted", "±"), shared,
        ),
    )  # fmt: skip


def figures(curves: Sequence[Curve]) -> tuple[AnswerFigure, ...]:
    """RMSE against N, measure by measure at the middle range, and the ratio to what was said."""
    found = []
    for measure in MEASURES:
        series = []
        for c in curves:
            if c.measure != measure:
                continue
            r = len(c.ranges_m) // 2
            series += [
                Series(c.of, c.counts.tolist(), (1e3 * c.rmse_m[r]).tolist()),
                Series(
                    f"{c.of}, predicted", c.counts.tolist(), (1e3 * c.predicted_m[r]).tolist(),
                    dashed=True,
                ),
            ]  # fmt: skip
        if series:
            figure = lines(series, "N", "RMSE (mm)", log_x=True, log_y=True)
            caption = (
                "Noise falls with the root of N down to the calibration's floor; the prediction "
                "(dashed) should lie on it."
            )
            title = f"Mean of N measurements of a {measure} at the middle range"
            found.append(AnswerFigure(measure, title, caption, figure))
    ratios = [
        Series(
            f"{c.measure}, {c.of}", c.counts.tolist(), [v for v, _ in c.ratio],
            [e or 0.0 for _, e in c.ratio],
        )
        for c in curves
    ]  # fmt: skip
    caption = "1 where the split predicts what means do; bars are standard errors."
    figure = lines(ratios, "N", "RMSE / predicted", log_x=True, level=1.0)
    return (*found, AnswerFigure("ratio", "RMSE over predicted", caption, figure))

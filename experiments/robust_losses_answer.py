"""What the trials of `robust_losses` say together."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import Answer, AnswerFigure, AnswerTable, Finished
from experiments.standard_errors import mean_and_error
from graphs.frames import FloatArray

DEFAULT = "cauchy"  # of rig.yaml
BROKEN = 3.0  # times the bound
EXPECTED_COST = 0.95**-0.5 - 1  # of a loss that keeps 95 % of the efficiency
COST_WITHIN = 0.02  # what the optimum's curvature and few scans leave open, besides chance
NEES = (0.8, 1.3)  # as the study of coverage promises under heavy noise
MOST_OUTLIERS = 0.2  # up to which the default must not break
MOST_REGRET = 1.1  # its errors over those of the best loss, in any condition
STANDARD_ERRORS = 3.0
FEWEST = 3  # scans, to say anything of a condition
# The sides of a condition, as the options name them, and as the usual one has them.
SIDES: dict[str, Any] = {
    "way": "library", "noise": "gaussian", "noise_px": 0.5, "assumed": None,
    "outlier_kind": "uniform", "outlier_share": 0.0,
}  # fmt: skip
SWEPT = ("way", "outlier_share")

Condition = tuple[Any, ...]
Trials = Sequence[Finished[Any]]


@dataclass(frozen=True)
class Group:
    """One loss in one condition. Means are of scans that were not broken; errors standard ones."""

    loss: str
    condition: Condition
    scans: int
    refused: int
    broken: int  # far off, or refused
    square: dict[int, float]  # (rms error over the bound)^2 by seed
    nees: tuple[float, float] | None
    covered: float | None  # of 95 % intervals, by the truth
    sigma_ratio: float | None  # estimated over true noise
    iterations: float | None
    unconverged: int

    def of(self, side: str) -> Any:
        return self.condition[list(SIDES).index(side)]

    @property
    def usual(self) -> bool:
        """Whether nothing but way and share of outliers differs from the usual."""
        return all(self.of(side) == value for side, value in SIDES.items() if side not in SWEPT)

    @property
    def off(self) -> tuple[float, float] | None:
        """Rms error over the bound, and its standard error."""
        if not self.square:
            return None
        mean, error = mean_and_error(list(self.square.values()))
        return mean**0.5, error / (2 * mean**0.5)


def answer(trials: Trials) -> Answer:
    """Which loss, what it costs, where each breaks, and whether sigmas hold."""
    if all(t.error is not None for t in trials):
        return Answer(f"none of {len(trials)} scans was solved", None)
    groups = grouped(trials)
    kept = [_costs_kept(groups), *_default_kept(groups), _least_squares_broke(groups)]
    holds = False if False in kept else None if None in kept else True
    word = {True: "yes", False: "no", None: "too few scans to say"}[holds]
    words = (_of_costs(groups), _of_default(groups), _of_regret(groups), _of_breaking(groups))
    said = "; ".join(one for one in words if one)
    tables = (_choice(groups), _table(groups))
    return Answer(f"{word}: {said}", holds, tables, tuple(_figures(groups)))


# ---- summaries -----------------------------------------------------------------------------


def grouped(trials: Trials) -> list[Group]:
    """A group for each loss in each condition, in the order of the trials."""
    found: dict[tuple[str, Condition], list[Finished[Any]]] = {}
    for t in trials:
        condition = tuple(getattr(t.options, side) for side in SIDES)
        found.setdefault((t.options.loss, condition), []).append(t)
    return [_group(loss, condition, some) for (loss, condition), some in found.items()]


def _group(loss: str, condition: Condition, some: Trials) -> Group:
    pairs: list[tuple[Finished[Any], Any]] = [(t, t.row) for t in some if t.error is None]
    solved = [row for _, row in pairs]
    sound = [row for row in solved if row["off"] <= BROKEN]
    return Group(
        loss, condition, len(some), len(some) - len(solved), len(some) - len(sound),
        {t.seed: row["off"] ** 2 for t, row in pairs if row["off"] <= BROKEN},
        mean_and_error([row["nees"] for row in sound]) if sound else None,
        statistics.mean(row["covered"] for row in sound) if sound else None,
        statistics.mean(row["sigma_ratio"] for row in sound) if sound else None,
        statistics.median(row["iterations"] for row in solved) if solved else None,
        sum(not row["converged"] for row in solved),
    )  # fmt: skip


def ratio(one: Group, other: Group) -> tuple[float, float] | None:
    """Rms error of one loss over another's in the same scans, and its standard error.

    Of a ratio of means (Cochran, Sampling Techniques, 1977, 6.3). None: too few scans.
    """
    shared = sorted(set(one.square) & set(other.square))
    if len(shared) < FEWEST:
        return None
    a: FloatArray = np.array([one.square[seed] for seed in shared])
    b: FloatArray = np.array([other.square[seed] for seed in shared])
    of_means = float(a.mean() / b.mean())
    spread = float(np.std(a - of_means * b, ddof=1) / b.mean() / len(shared) ** 0.5)
    return of_means**0.5, spread / (2 * of_means**0.5)


def costs(groups: Sequence[Group]) -> dict[str, tuple[float, float]]:
    """By loss: how much larger errors are than those of least squares where nothing is wrong."""
    clean = [
        g for g in groups if g.usual and g.of("way") == "library" and not g.of("outlier_share")
    ]
    squares = [g for g in clean if g.loss == "none"]
    found = {}
    for group in clean:
        over = ratio(group, squares[0]) if squares and group.loss != "none" else None
        if over is not None:
            found[group.loss] = over[0] - 1, over[1]
    return found


Regret = tuple[float, float, str, Group]


def rivals(groups: Sequence[Group], loss: str) -> list[list[Regret]]:
    """Errors over those of each other loss, their standard error, that loss; condition by
    condition.

    In the library's way; of losses that broke no more often, in the scans that both got right.
    """
    found = []
    for own in groups:
        if own.loss != loss or own.of("way") != "library":
            continue
        others = [g for g in groups if g.condition == own.condition and g.broken <= own.broken]
        over = [(*r, g.loss, own) for g in others if g is not own and (r := ratio(own, g))]
        if over:
            found.append(over)
    return found


def regrets(groups: Sequence[Group], loss: str) -> list[Regret]:
    """Of each condition the rival that is better most surely; the surest condition first."""

    def surely(one: Regret) -> float:
        return one[0] - STANDARD_ERRORS * one[1]

    surest = [max(over, key=surely) for over in rivals(groups, loss)]
    return sorted(surest, key=surely, reverse=True)


def breaks_from(groups: Sequence[Group], loss: str, way: str) -> tuple[float | None, float] | None:
    """The least share of outliers that breaks most scans, None if none does, and the largest."""
    own = [g for g in groups if g.loss == loss and g.usual and g.of("way") == way]
    shares = [g.of("outlier_share") for g in own]
    if not any(shares):
        return None
    return min((g.of("outlier_share") for g in own if 2 * g.broken > g.scans), default=None), max(
        shares
    )


# ---- what was expected ---------------------------------------------------------------------


def _costs_kept(groups: Sequence[Group]) -> bool | None:
    found = costs(groups)
    if DEFAULT not in found:
        return None
    return all(
        abs(cost - (0.0 if loss == "adaptive" else EXPECTED_COST))
        <= COST_WITHIN + STANDARD_ERRORS * error
        for loss, (cost, error) in found.items()
    )


def _promised(groups: Sequence[Group], loss: str = DEFAULT) -> list[Group]:
    """A loss in the library's way, with few enough outliers, and enough scans."""
    own = [g for g in groups if g.loss == loss and g.of("way") == "library"]
    return [g for g in own if g.of("outlier_share") <= MOST_OUTLIERS and g.scans >= FEWEST]


def _default_kept(groups: Sequence[Group]) -> list[bool | None]:
    """Whether the default breaks nowhere, its sigmas hold, and none is much better."""
    some, over = _promised(groups), regrets(groups, DEFAULT)
    if not some or not over:
        return [None]
    low, high = NEES
    means = [g.nees for g in some if g.nees is not None]
    return [
        all(g.broken == 0 for g in some),
        all(low - STANDARD_ERRORS * e <= mean <= high + STANDARD_ERRORS * e for mean, e in means),
        all(times - STANDARD_ERRORS * error <= MOST_REGRET for times, error, _, _ in over),
    ]


def _least_squares_broke(groups: Sequence[Group]) -> bool | None:
    found = breaks_from(groups, "none", "alone")
    shares = [g.of("outlier_share") for g in groups if g.of("way") == "alone" and g.usual]
    return None if found is None else found[0] == min(share for share in shares if share)


# ---- in words ------------------------------------------------------------------------------


def _of_costs(groups: Sequence[Group]) -> str:
    found = costs(groups).items()
    each = (f"{loss} {100 * cost:+.1f} ± {100 * error:.1f} %" for loss, (cost, error) in found)
    return f"without outliers errors beside least squares' are {', '.join(each)}" if found else ""


def _of_default(groups: Sequence[Group]) -> str:
    some = _promised(groups)
    means = [g.nees[0] for g in some if g.nees is not None]
    if not means:
        return ""
    worst = {loss: _worst(groups, loss) for loss in dict.fromkeys(g.loss for g in groups)}
    each = ", ".join(f"{loss} {times:.2f}" for loss, times in worst.items() if times is not None)
    beside = f", errors at worst so many times the best loss's: {each}" if each else ""
    return (
        f"in the library's way, to {MOST_OUTLIERS:.0%} outliers, {DEFAULT} has NEES "
        f"{min(means):.2f} to {max(means):.2f}, {sum(g.broken for g in some)} of "
        f"{sum(g.scans for g in some)} scans broken{beside}"
    )


def _worst(groups: Sequence[Group], loss: str) -> float | None:
    """Errors over those of the best loss where outliers are few enough, at worst."""
    every = [r for over in rivals(groups, loss) for r in over]
    few = [r[0] for r in every if r[3].of("outlier_share") <= MOST_OUTLIERS]
    return max(few, default=None)


def _of_regret(groups: Sequence[Group]) -> str:
    over = regrets(groups, DEFAULT)
    if not over:
        return ""
    times, error, best, worst = over[0]
    return (
        f"surest, {DEFAULT}'s are {times:.2f} ± {error:.2f} times those of {best} "
        f"({in_words(worst)})"
    )


def _of_breaking(groups: Sequence[Group]) -> str:
    parts = []
    for way in ("library", "alone"):
        found: dict[str, list[str]] = {}
        for loss in dict.fromkeys(g.loss for g in groups):
            broke = breaks_from(groups, loss, way)
            if broke is not None:
                share = f"nowhere to {broke[1]:.0%}" if broke[0] is None else f"{broke[0]:.0%}"
                found.setdefault(share, []).append(loss)
        if found:
            each = ", ".join(f"{'/'.join(losses)} {share}" for share, losses in found.items())
            parts.append(f"{way}: {each}")
    return f"most scans break from ({'; '.join(parts)})" if parts else ""


def in_words(group: Group) -> str:
    """A condition by what is not usual about it, the way aside."""
    sides = {side: value for side, value in SIDES.items() if side != "way"}
    odd = [f"{side} {group.of(side)}" for side, value in sides.items() if group.of(side) != value]
    return ", ".join(odd).replace("_", " ") or "no outliers"


# ---- table and figures ---------------------------------------------------------------------


def _choice(groups: Sequence[Group]) -> AnswerTable:
    """A row a loss, to choose by."""
    columns = (
        "loss", "cost without outliers, %", "±", "worst times the best", "NEES, least",
        "NEES, most", "sigma / true, least", "sigma / true, most", "broken", "of",
        "breaks from, library", "breaks from, alone",
    )  # fmt: skip
    rows = []
    for loss in dict.fromkeys(g.loss for g in groups):
        own, cost = _promised(groups, loss), costs(groups).get(loss, (None, None))
        nees = [g.nees[0] for g in own if g.nees is not None]
        sigma = [g.sigma_ratio for g in own if g.sigma_ratio is not None]
        broke = [breaks_from(groups, loss, way) for way in ("library", "alone")]
        rows.append(
            (
                loss, *(None if part is None else 100 * part for part in cost),
                _worst(groups, loss), min(nees, default=None), max(nees, default=None),
                min(sigma, default=None), max(sigma, default=None), sum(g.broken for g in own),
                sum(g.scans for g in own), *(one and one[0] for one in broke),
            )
        )  # fmt: skip
    title = f"Which loss: the library's way up to {MOST_OUTLIERS:.0%} outliers, every noise"
    return AnswerTable("choice", title, columns, tuple(rows))


def _table(groups: Sequence[Group]) -> AnswerTable:
    columns = (
        "way", "condition", "loss", "scans", "broken", "refused", "error / bound", "±", "NEES",
        "± ", "95 % intervals, %", "sigma / true", "iterations", "not converged",
    )  # fmt: skip
    ordered = sorted(groups, key=lambda g: [str(part) for part in g.condition])
    rows = tuple(
        (
            g.of("way"), in_words(g), g.loss, g.scans, g.broken, g.refused, *_told(g.off),
            *_told(g.nees), None if g.covered is None else 100 * g.covered, g.sigma_ratio,
            g.iterations, g.unconverged,
        )
        for g in ordered
    )  # fmt: skip
    title = "Every condition and loss; errors and NEES are of scans that did not break"
    return AnswerTable("losses", title, columns, rows)


def _told(value: tuple[float, float] | None) -> tuple[float | None, float | None]:
    """A mean and its standard error, where there is one."""
    if value is None:
        return None, None
    return value[0], value[1] if np.isfinite(value[1]) else None


def _figures(groups: Sequence[Group]) -> Iterator[AnswerFigure]:
    for way in ("library", "alone"):
        some = sorted(
            (g for g in groups if g.usual and g.of("way") == way),
            key=lambda g: g.of("outlier_share"),
        )
        losses = list(dict.fromkeys(g.loss for g in some))
        off, nees, broken = ([] for _ in range(3))
        for loss in losses:
            own = [g for g in some if g.loss == loss]
            told = [(g.of("outlier_share"), g.off, g.nees) for g in own if g.off and g.nees]
            if told:
                x = [share for share, _, _ in told]
                off.append(
                    Series(loss, x, [o[0] for _, o, _ in told], _bars(o for _, o, _ in told))
                )
                nees.append(
                    Series(loss, x, [n[0] for _, _, n in told], _bars(n for _, _, n in told))
                )
            shares = [g.of("outlier_share") for g in own]
            broken.append(Series(loss, shares, [100 * g.broken / g.scans for g in own]))
        for name, series, title, level in (
            ("error", off, "error over the bound", 1.0),
            ("nees", nees, "NEES a degree of freedom", 1.0),
            ("broken", broken, "broken scans, %", None),
        ):
            if series:
                figure = lines(series, "share of outliers", title, level=level)
                yield AnswerFigure(
                    f"{way}_{name}", f"{title}, {way}",
                    "Means of scans that did not break; bars: one standard error.", figure,
                )  # fmt: skip


def _bars(values: Any) -> list[float]:
    return [error if np.isfinite(error) else 0.0 for _, error in values]

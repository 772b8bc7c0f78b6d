"""Every source of scale beside what all others say of it.

By linear algebra on the factorised system, without solving again. With J (m, n) the whitened rows
of the sources and H the normal equations, G = J H^-1 J^T holds on its diagonal the leverage h of
each: the share of its own say in what the estimate has for it. Left out, a source's residual r
becomes r / (1 - h), and the rest predicts its length (Cook and Weisberg, Residuals and Influence in
Regression, 1982). A source with h = 1 is the only one: nothing tests it.

What the data say of the ratio of two lengths, as of a path and a baseline, is uncertain too: B, the
covariance of the estimate's lengths from all but the sources themselves. The residuals' covariance
is B + (I - G)^2, and is I - G where the graph's weights are the truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from graphs.build import CalibrationGraph, root_information
from graphs.clusters import homogeneous
from graphs.frames import FloatArray
from graphs.influence import responses
from graphs.noise import loss_moments
from graphs.problem import Estimate, ScaleSource, residuals_px
from graphs.scale import length_of, scale_factor, total_sigma_m
from graphs.system import assemble, jacobian_of
from graphs.threads import threads

# Of sources that agree, one in 370 is as far off; with as many as ten, one scan in 37.
CONTRADICTION = 3.0
# 1 - h of a source that nothing tests is rounding: 1e-9 on a real rig with 50 frames, 1e-12 on
# small ones. At this, what others say is 3000 times less certain than the source is.
UNTESTED = 1e-7


@dataclass(frozen=True)
class SourceRow:
    """One scalar source of scale, linearised: a length, or the logarithm of one."""

    name: str
    measured: float
    sigma: float  # of the measure
    estimated: float  # as the estimate has it
    spread: float  # sigma of the estimated length from what is in no column: the ends' own pixels
    row: FloatArray  # (n_columns,) its derivative, over `whole`
    residual: float  # estimated less measured, over `whole`

    @property
    def whole(self) -> float:
        """What whitens it."""
        return math.hypot(self.sigma, self.spread)


@dataclass(frozen=True)
class LedgerEntry:
    """A source of scale, what the estimate made of it, and what the others say of it."""

    name: str
    measured_m: float
    sigma_m: float
    estimated_m: float
    predicted_m: float | None = None  # by all others and the data; None: nothing else tells
    sigma_predicted_m: float | None = None

    @property
    def z(self) -> float | None:
        """Measured less predicted, in sigmas of that difference."""
        if self.predicted_m is None or self.sigma_predicted_m is None:
            return None
        sigma_m = math.hypot(self.sigma_m, self.sigma_predicted_m)
        return (self.measured_m - self.predicted_m) / sigma_m

    @property
    def p_value(self) -> float | None:
        """Of a larger |z|, if the sigmas are true."""
        return None if self.z is None else math.erfc(abs(self.z) / math.sqrt(2))

    @property
    def contradicts(self) -> bool:
        return self.z is not None and abs(self.z) > CONTRADICTION


@dataclass(frozen=True)
class ScaleLedger:
    """All sources, and which of them may be wrong where they contradict each other."""

    entries: tuple[LedgerEntry, ...]
    suspects: tuple[int, ...] = ()  # each of them alone could be; none: it takes two to explain it

    @property
    def contradicted(self) -> bool:
        return any(entry.contradicts for entry in self.entries)


NO_SOURCES = ScaleLedger(())


def scale_ledger(
    graph: CalibrationGraph,
    estimate: Estimate,
    values: gtsam.Values,
    names: Sequence[str],
    inflation: float = 1.0,
    further: Sequence[SourceRow] = (),
) -> ScaleLedger:
    """The ledger of the problem's measured distances, and of `further` sources in the graph.

    names: of the problem's, in their order. inflation: what sigmas from the data's noise are
    multiplied by, as stated sigmas exceed the model's.
    Raises ValueError when the problem determines less than it asks for.
    """
    own = zip(graph.problem.scales, names, strict=True)
    rows = [*(source_row(graph, estimate, values, *one) for one in own), *further]
    if not rows:
        return NO_SOURCES
    return judged(rows, _lengths(graph, estimate, values, rows, inflation))


def source_row(
    graph: CalibrationGraph,
    estimate: Estimate,
    values: gtsam.Values,
    source: ScaleSource,
    name: str,
) -> SourceRow:
    """A measured distance of the problem as a row of its system."""
    problem, options = graph.problem, graph.options
    noise = root_information(problem, options)
    weighed = noise, graph.layout.lens_of, options.loss, options.loss_scale
    alone = gtsam.NonlinearFactorGraph()
    alone.add(scale_factor(problem, source, *weighed))
    row, rhs = jacobian_of(alone.linearize(values), graph.layout)
    whole = total_sigma_m(problem, source, *weighed, values)
    return SourceRow(
        name,
        source.length_m,
        source.sigma_m,
        length_of(source, estimate),
        math.sqrt(max(whole**2 - source.sigma_m**2, 0.0)),
        row.toarray()[0],
        -float(rhs[0]),
    )


@dataclass(frozen=True)
class Lengths:
    """What the sources' lengths are at the optimum, each over what whitens it."""

    residual: FloatArray  # (m,) estimated less measured
    leverage: FloatArray  # (m, m) G: how the estimated follow the measured
    from_data: FloatArray  # (m, m) B: covariance of the estimated from all but the sources

    def without(self, source: int) -> Lengths:
        """The same of the other sources, had this one not been made."""
        rest = np.arange(len(self.residual)) != source
        own = 1 - self.leverage[source, source]
        follow = self.leverage[rest, source] / own
        # What each of the others moves by, is a sum over all: `by` (m - 1, m).
        by = np.eye(len(rest))[rest]
        by[:, source] = follow
        return Lengths(
            by @ self.residual,
            self.leverage[np.ix_(rest, rest)] + np.outer(follow, self.leverage[source, rest]),
            by @ self.from_data @ by.T,
        )

    @property
    def predictions(self) -> tuple[FloatArray, FloatArray]:
        """Predicted less measured (m,) and the prediction's variance (m,); NaN: none."""
        own = 1 - np.diag(self.leverage)
        own = np.where(own > UNTESTED, own, np.nan)
        of_others = (self.leverage**2).sum(1) - np.diag(self.leverage) ** 2
        return self.residual / own, (np.diag(self.from_data) + of_others) / own**2

    @property
    def z(self) -> FloatArray:
        """Measured less predicted (m,) in sigmas of that; NaN where nothing predicts."""
        apart, variance = self.predictions
        result: FloatArray = -apart / np.sqrt(1 + variance)
        return result


def _lengths(
    graph: CalibrationGraph,
    estimate: Estimate,
    values: gtsam.Values,
    rows: Sequence[SourceRow],
    inflation: float,
) -> Lengths:
    seen = graph.problem.observations
    moments = loss_moments(graph.problem, graph.options, residuals_px(estimate, seen))
    others = graph.others.linearize(values)
    points = homogeneous(graph.tracks, estimate.points)
    with threads() as pool:
        system = assemble(
            graph.tracks, others, graph.layout, graph.variables(values), points, pool,
            moments.curvature,
        )  # fmt: skip
    J = np.array([one.row for one in rows])
    columns = np.flatnonzero(J.any(axis=0))
    response = responses(graph, system, columns) @ J[:, columns].T
    A, b = jacobian_of(others, graph.layout)
    of_others = A @ response
    leverage = J @ response
    by_others = of_others.T @ of_others
    by_noise = moments.score_variance * (leverage - by_others) / moments.curvature
    # The solve stops a little before its optimum, which matters to what hardly weighs in the cost.
    pull = A.T @ b
    gradient = (system.gradient + pull) / moments.curvature - pull
    return Lengths(
        np.array([one.residual for one in rows]) - response.T @ gradient,
        leverage,
        inflation**2 * by_noise + by_others - leverage @ leverage.T,
    )


def judged(rows: Sequence[SourceRow], lengths: Lengths) -> ScaleLedger:
    """Each source beside what the others predict of it."""
    entries = []
    for one, apart, variance in zip(rows, *lengths.predictions, strict=True):
        entry = LedgerEntry(one.name, one.measured, one.sigma, one.estimated)
        if math.isfinite(apart):
            sigma_m = math.sqrt(max(variance, 0.0) * one.whole**2 + one.spread**2)
            entry = LedgerEntry(
                one.name, one.measured, one.sigma, one.estimated,
                one.measured + float(apart) * one.whole, sigma_m,
            )  # fmt: skip
        entries.append(entry)
    ledger = ScaleLedger(tuple(entries))
    return ScaleLedger(ledger.entries, _suspects(lengths)) if ledger.contradicted else ledger


def _suspects(lengths: Lengths) -> tuple[int, ...]:
    """Sources without which the rest agree with each other; of two it may be either."""
    testable = np.flatnonzero(np.isfinite(lengths.z))
    found = []
    for source in testable.tolist():
        z = lengths.without(source).z
        if not (np.abs(z[np.isfinite(z)]) > CONTRADICTION).any():
            found.append(source)
    return tuple(found)

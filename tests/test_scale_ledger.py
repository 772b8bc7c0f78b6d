"""Each source of scale beside the others: the algebra against solving again, and what is said."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.clusters import homogeneous
from graphs.influence import responses
from graphs.losses import SCALE_95, LossName
from graphs.noise import loss_moments, with_click_sigma
from graphs.priors import RigPrior
from graphs.problem import (
    Estimate,
    KnownBaseline,
    KnownPath,
    KnownSpan,
    Problem,
    ScaleSource,
    residuals_px,
)
from graphs.scale import length_of
from graphs.scale_ledger import (
    CONTRADICTION,
    ScaleLedger,
    SourceRow,
    scale_ledger,
    source_row,
)
from graphs.solve import solve
from graphs.system import assemble
from graphs.threads import threads
from sfm_calib.scale_ledger import contradiction
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.3
SCAN = TrackOptions(
    rig="stereo", frames=8, points=300, max_points_per_image=80, lens="radial", sigma_px=SIGMA_PX,
    baseline_sigma_m=0, outlier_share=0, focal_error=0.01, rotation_error_deg=0.2,
    translation_error_m=0.005, point_error_m=0.01,
)  # fmt: skip
ENDS = (-1, -2)  # in place of a pair of points: of the longest tracks
KINDS: tuple[ScaleSource, ...] = (
    KnownBaseline((0, 1), 0.0, 0.001),
    KnownPath((0, 7), 0.0, 0.01),
    KnownSpan(ENDS, 0.0, 0.01, click_sigma_px=1.0),
    KnownPath((1, 5), 0.0, 0.008),
)


def measured(sources: tuple[ScaleSource, ...], seed: int = 0) -> tuple[Problem, Estimate]:
    """A scan with tapes that err by their sigmas, and clicks by theirs; and its truth."""
    rng = np.random.default_rng(seed)
    problem, true = simulate_tracks(SCAN, rng)
    seen = problem.observations
    longest = np.argsort(np.bincount(seen.point), kind="stable")
    taped: list[ScaleSource] = []
    for one in sources:
        if isinstance(one, KnownSpan):
            ends = (int(longest[ENDS[0]]), int(longest[ENDS[1]]))
            one = replace(one, points=ends)
            rows = np.isin(seen.point, ends)
            more_px = (1.0**2 - SIGMA_PX**2) ** 0.5 * rng.standard_normal((len(seen), 2))
            pixels = np.where(rows[:, None], seen.pixels + more_px, seen.pixels)
            problem = replace(problem, observations=replace(seen, pixels=pixels))
        length_m = length_of(one, true) + one.sigma_m * rng.standard_normal()
        taped.append(replace(one, length_m=length_m))
    return with_click_sigma(replace(problem, scales=tuple(taped)), SIGMA_PX), true


Solved = tuple[CalibrationGraph, Estimate, gtsam.Values]


def solved(problem: Problem, options: GraphOptions | None = None) -> Solved:
    graph = build(problem, options or GraphOptions(SIGMA_PX, "none"))
    estimate, values, _ = solve(graph, relative_tolerance=1e-12)
    return graph, estimate, values


def ledger_of(
    problem: Problem, inflation: float = 1.0, options: GraphOptions | None = None
) -> ScaleLedger:
    names = [str(index) for index in range(len(problem.scales))]
    return scale_ledger(*solved(problem, options), names, inflation)


def without(problem: Problem, index: int) -> Problem:
    rest = tuple(one for i, one in enumerate(problem.scales) if i != index)
    return replace(problem, scales=rest)


def longer(problem: Problem, index: int, factor: float) -> Problem:
    scales = list(problem.scales)
    scales[index] = replace(scales[index], length_m=factor * scales[index].length_m)
    return replace(problem, scales=tuple(scales))


# ---- the algebra ----------------------------------------------------------------------------


def predicted_by(
    graph: CalibrationGraph, at: Estimate, values: gtsam.Values, source: ScaleSource
) -> tuple[float, float]:
    """A length by a graph that does not have it, one Newton step from here, and its sigma."""
    points, others = homogeneous(graph.tracks, at.points), graph.others.linearize(values)
    variables = graph.variables(values)
    with threads() as pool:
        system = assemble(graph.tracks, others, graph.layout, variables, points, pool)
    row = source_row(graph, at, values, source, "")
    inverse = responses(graph, system, np.arange(len(row.row)))
    apart = row.residual - row.row @ inverse @ system.gradient
    variance = row.row @ inverse @ row.row * row.whole**2 + row.spread**2
    return source.length_m + apart * row.whole, variance**0.5


@pytest.mark.parametrize("index", range(len(KINDS)))
def test_the_algebra_is_exact(index: int) -> None:
    """Where noise is as weighed: beside a graph that was built without the source."""
    problem, _ = measured(KINDS)
    graph, estimate, values = solved(problem)
    left_px = residuals_px(estimate, problem.observations)
    as_weighed = loss_moments(problem, graph.options, left_px).score_variance ** -0.5
    ledger = scale_ledger(graph, estimate, values, [""] * len(KINDS), as_weighed)
    entry = ledger.entries[index]
    rest = build(without(problem, index), graph.options)
    length_m, sigma_m = predicted_by(rest, estimate, values, problem.scales[index])
    assert entry.sigma_predicted_m == pytest.approx(sigma_m, rel=1e-5)
    assert entry.predicted_m == pytest.approx(length_m, abs=1e-5 * sigma_m)


@pytest.mark.parametrize("loss", ["none", "cauchy"])
@pytest.mark.parametrize("index", range(len(KINDS)))
def test_what_others_predict_is_what_solving_without_it_finds(index: int, loss: LossName) -> None:
    problem, _ = measured(KINDS)
    options = GraphOptions(SIGMA_PX, loss, SCALE_95[loss])
    source, entry = problem.scales[index], ledger_of(problem, options=options).entries[index]
    _, estimate, _ = solved(without(problem, index), options)
    found, sigma_m = length_of(source, estimate), entry.sigma_predicted_m
    assert sigma_m is not None
    assert entry.predicted_m == pytest.approx(found, abs=0.02 * sigma_m, rel=1e-4)
    if not isinstance(source, KnownSpan):  # whose own pixels pull, and not the tape
        assert abs(found - entry.estimated_m) > 0.02 * sigma_m


@pytest.mark.slow
def test_removing_a_source_by_algebra_leaves_the_ledger_of_the_others() -> None:
    """Through the suspects: of four, two that agree on a wrong length are found by no removal."""
    problem, _ = measured(KINDS)
    for index in range(len(KINDS)):
        wrong = longer(problem, index, 1.2)
        ledger, rest = ledger_of(wrong), ledger_of(without(wrong, index))
        assert ledger.contradicted and ledger.suspects == (index,)
        assert not rest.contradicted and rest.suspects == ()
    two = longer(longer(problem, 0, 1.2), 1, 0.8)
    assert ledger_of(two).contradicted and ledger_of(two).suspects == ()


@pytest.mark.slow
def test_z_is_standard_normal() -> None:
    """Forty scans with four tapes each, all of which err by their sigmas."""
    z = np.array(
        [[e.z for e in ledger_of(measured(KINDS, seed)[0]).entries] for seed in range(1, 41)]
    )
    rms = np.sqrt((z**2).mean(axis=0))
    assert ((rms > 0.67) & (rms < 1.33)).all(), rms  # 1 +- 3 standard errors
    assert abs(z.mean(axis=0)).max() < 3 / 40**0.5
    assert np.mean(np.abs(z) > 2) < 0.09


def test_the_data_say_how_certain_the_ratio_of_two_lengths_is() -> None:
    """With exact tapes the images' noise decides, and is as many times larger as told."""
    exact = tuple(replace(one, sigma_m=1e-5) for one in KINDS[:2])
    problem, _ = measured(exact)
    once, thrice = (ledger_of(problem, inflation).entries for inflation in (1.0, 3.0))
    for one, three in zip(once, thrice, strict=True):
        assert one.sigma_predicted_m is not None and three.sigma_predicted_m is not None
        assert one.sigma_predicted_m > 10 * one.sigma_m
        assert three.sigma_predicted_m == pytest.approx(3 * one.sigma_predicted_m, rel=0.03)
        assert one.predicted_m == three.predicted_m


# ---- what tests what ------------------------------------------------------------------------


@pytest.mark.parametrize("source", KINDS[:3])
def test_a_source_alone_is_not_tested(source: ScaleSource) -> None:
    problem, _ = measured((source,))
    ledger = ledger_of(problem)
    (entry,) = ledger.entries
    assert (entry.predicted_m, entry.sigma_predicted_m, entry.z, entry.p_value) == (None,) * 4
    assert not ledger.contradicted and contradiction(ledger) == []
    assert entry.measured_m == problem.scales[0].length_m
    if not isinstance(source, KnownSpan):
        assert entry.estimated_m == pytest.approx(entry.measured_m, rel=1e-6)


def test_without_sources_there_is_no_ledger() -> None:
    problem, _ = measured(KINDS[:1])
    assert ledger_of(replace(problem, scales=())) == ScaleLedger(())


def test_a_nominal_rig_in_metres_tests_a_source() -> None:
    problem, true = measured(KINDS[:1])
    wrong = replace(
        true.cam_from_rig[1], translation=0.9 * np.array(true.cam_from_rig[1].translation)
    )
    for nominal, contradicted in ((true.cam_from_rig[1], False), (wrong, True)):
        prior = {1: RigPrior(nominal, np.inf, 0.003)}
        ledger = ledger_of(problem, options=GraphOptions(SIGMA_PX, "none", rig_priors=prior))
        assert ledger.contradicted is contradicted
        assert ledger.entries[0].sigma_predicted_m == pytest.approx(0.003, rel=0.02)
    (message,) = contradiction(ledger)
    assert message.startswith("the 0 of 0.2012 m contradicts cam_from_rig as rig.yaml states it: ")


def test_a_source_of_any_kind_joins() -> None:
    """A row of the caller's own, as a board's would be: here a baseline given by hand."""
    problem, _ = measured(KINDS[:3])
    graph, estimate, values = solved(problem)
    rows = [
        source_row(graph, estimate, values, one, str(i)) for i, one in enumerate(problem.scales)
    ]
    own = scale_ledger(graph, estimate, values, ["0", "1", "2"])
    fewer = replace(graph, problem=replace(problem, scales=problem.scales[:2]))
    assert isinstance(rows[2], SourceRow)
    joined = scale_ledger(fewer, estimate, values, ["0", "1"], further=rows[2:])
    for ours, theirs in zip(joined.entries, own.entries, strict=True):
        assert ours == theirs


def test_two_that_contradict_are_both_suspects() -> None:
    problem, _ = measured(KINDS[:2])
    ledger = ledger_of(longer(problem, 0, 1.1))
    assert ledger.suspects == (0, 1)
    first, second = (entry.z or 0.0 for entry in ledger.entries)
    assert first > CONTRADICTION and second < -CONTRADICTION
    assert first == pytest.approx(-second, rel=0.1)  # one and the same difference

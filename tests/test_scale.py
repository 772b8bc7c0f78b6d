"""What a measured distance does: against GTSAM's own factors, and by arithmetic."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from synthetic.problems import small_problem

from graphs.build import CalibrationGraph, GraphOptions, build, root_information
from graphs.clusters import homogeneous
from graphs.frames import FloatArray, log_rotation
from graphs.influence import responses
from graphs.keys import frame_key, lens_key, rig_key
from graphs.lenses import LensName
from graphs.losses import LOSS_NAMES, SCALE_95, LossName
from graphs.noise import loss_moments, robust_sigma_px, with_click_sigma
from graphs.problem import (
    Estimate,
    KnownBaseline,
    KnownPath,
    KnownSpan,
    Problem,
    ScaleSource,
    residuals_px,
)
from graphs.reference import (
    ReferenceGraph,
    build_reference,
    native_slots,
    solve_reference,
)
from graphs.scale import length_of, total_sigma_m
from graphs.selection import compact
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from graphs.system import assemble
from graphs.threads import threads

SIGMA_PX = 0.5
LENGTH_M, SIGMA_M = 2.0, 0.02
SOURCES: dict[str, ScaleSource] = {
    "baseline": KnownBaseline((0, 1), LENGTH_M, SIGMA_M),
    "path": KnownPath((0, 3), LENGTH_M, SIGMA_M),
    "span": KnownSpan((2, 25), LENGTH_M, SIGMA_M),
    "span of noisy clicks": KnownSpan((2, 25), LENGTH_M, SIGMA_M, click_sigma_px=3 * SIGMA_PX),
}
each_source = pytest.mark.parametrize("source", SOURCES.values(), ids=SOURCES)


def measured(
    source: ScaleSource, lens: LensName = "radtan", sigma_px: float = SIGMA_PX, seed: int = 0
) -> tuple[Problem, Estimate]:
    """A small problem whose start is in the unit of the measured distance, and its truth."""
    problem, true = small_problem(lens, sigma_px=sigma_px, start_error=0.3, seed=seed)
    scaled = problem.initial.scaled(source.length_m / length_of(source, problem.initial))
    problem = replace(problem, initial=scaled, scales=(source,))
    true = true.scaled(source.length_m / length_of(source, true))
    return with_click_sigma(problem, SIGMA_PX), true


def options_of(loss: LossName = "none") -> GraphOptions:
    return GraphOptions(SIGMA_PX, loss, SCALE_95[loss])


# ---- against GTSAM's own factors ------------------------------------------------------------


def keys_of(problem: Problem) -> list[int]:
    lenses = [lens_key(i) for i in range(len(problem.initial.cameras))]
    frames = [frame_key(i) for i in range(len(problem.frame_names))]
    return [*lenses, rig_key(1), *frames]


def our_covariance(graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values) -> FloatArray:
    points = homogeneous(graph.tracks, estimate.points)
    others = graph.others.linearize(values)
    with threads() as pool:
        system = assemble(graph.tracks, others, graph.layout, graph.variables(values), points, pool)
    columns = np.concatenate([graph.layout.columns(key) for key in keys_of(graph.problem)])
    return responses(graph, system, columns)[columns]


def native_covariance(graph: ReferenceGraph, values: gtsam.Values) -> FloatArray:
    keys = keys_of(graph.problem)
    slots = [np.array(native_slots(camera)) for camera in graph.problem.initial.cameras]
    slots += [np.arange(6)] * (len(keys) - len(slots))
    joint = gtsam.Marginals(graph.factors, values).jointMarginalCovariance(keys)
    return np.block(
        [
            [joint.at(a, b)[np.ix_(of_a, of_b)] for b, of_b in zip(keys, slots, strict=True)]
            for a, of_a in zip(keys, slots, strict=True)
        ]
    )


def difference(a: Estimate, b: Estimate) -> FloatArray:
    """In the order of `keys_of`: lenses, the second camera in the rig, frames."""
    lenses = [x.params - y.params for x, y in zip(a.cameras, b.cameras, strict=True)]
    poses = zip(
        (a.cam_from_rig[1], *a.rig_from_world), (b.cam_from_rig[1], *b.rig_from_world), strict=True
    )
    moved = [
        np.append(
            log_rotation(x.rotation @ y.rotation.T), x.inverse.translation - y.inverse.translation
        )
        for x, y in poses
    ]
    return np.concatenate([*lenses, *moved])


@pytest.mark.parametrize("loss", ["none", "cauchy"])
@pytest.mark.parametrize("lens", ["radtan", "kannala_brandt"])
@each_source
def test_optimum_and_marginals_are_gtsams(
    source: ScaleSource, lens: LensName, loss: LossName
) -> None:
    problem, _ = measured(source, lens)
    graph = build(problem, options_of(loss))
    estimate, values, summary = solve(graph, relative_tolerance=1e-14)
    reference = build_reference(problem, options_of(loss))
    theirs, native, _ = solve_reference(reference)
    assert summary.converged
    assert summary.cost == pytest.approx(reference.factors.error(native), rel=1e-8)
    expected = native_covariance(reference, native)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs(difference(estimate, theirs) / sigma).max() < 1e-3
    ours = our_covariance(graph, estimate, values)
    assert np.abs((ours - expected) / np.outer(sigma, sigma)).max() < 1e-4


@each_source
def test_the_factors_slope_is_that_of_the_distance(source: ScaleSource) -> None:
    """By differences along every variable, its points following; on perfect data, where
    Gauss-Newton's way to follow is exact."""
    problem, true = measured(source, sigma_px=0.0)
    graph = build(replace(problem, initial=true), options_of())
    alone = gtsam.NonlinearFactorGraph()
    alone.add(graph.others.at(graph.others.size() - 1))
    analytic, _ = alone.linearize(graph.initial).jacobian()
    slopes = []
    for key in sorted(alone.at(0).keys()):
        for direction in np.eye(graph.initial.zeroVectors().at(key).size):
            step = 1e-5 * direction * (100.0 if key in (lens_key(0), lens_key(1)) else 1.0)
            ends = []
            for size in (1, -1):
                delta = gtsam.VectorValues()
                delta.insert(key, size * step)
                moved = alone.at(0).unwhitenedError(graph.initial.retract(delta))[0]
                ends.append(moved if isinstance(source, KnownSpan) else moved / source.sigma_m)
            slopes.append((ends[0] - ends[1]) / (2 * step.sum()))
    np.testing.assert_allclose(analytic[0], slopes, atol=1e-5 * np.abs(slopes).max())


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_the_distance_does_not_depend_on_where_its_points_start(loss: LossName) -> None:
    """Losses that forget far residuals have minima elsewhere, which a solve would jump between."""
    problem, true = measured(SOURCES["span"])
    errors = []
    for moved in (0.0, 0.3):
        start = replace(true, points=true.points + moved * np.array([1, -1, 1]))
        graph = build(replace(problem, initial=start), options_of(loss))
        factor = graph.others.at(graph.others.size() - 1)
        errors.append(factor.unwhitenedError(graph.initial)[0])
    assert errors[1] == pytest.approx(errors[0], abs=1e-4)


# ---- the sigma of a metric result -----------------------------------------------------------


def baseline_of(source: ScaleSource, sigma_m: float, seed: int = 0) -> tuple[float, float, float]:
    """Of the second camera from the first: found, its sigma, and the truth."""
    problem, true = measured(replace(source, sigma_m=sigma_m), seed=seed)
    if seed:  # the tape errs
        error = sigma_m * np.random.default_rng(seed).standard_normal()
        (tape,) = problem.scales
        problem = replace(problem, scales=(replace(tape, length_m=LENGTH_M + error),))
    graph = build(problem, options_of())
    estimate, values, _ = solve(graph, relative_tolerance=1e-12)
    covariance = calibration_covariance(graph, estimate, values).model
    places = [covariance.names.index(f"cam1.translation_{axis}") for axis in "xyz"]
    t = estimate.cam_from_rig[1].translation
    found = float(np.linalg.norm(t))
    variance = float(t @ covariance.matrix[np.ix_(places, places)] @ t) / found**2
    return found, variance**0.5, float(np.linalg.norm(true.cam_from_rig[1].translation))


@each_source
def test_a_sigma_is_the_tapes_and_the_pixels(source: ScaleSource) -> None:
    """Lengths beside the measured one: its relative sigma, and what the images add."""
    found, wide, _ = baseline_of(source, 0.05)
    _, narrow, _ = baseline_of(source, 0.001)
    of_tape = [found / LENGTH_M * sigma_m for sigma_m in (0.05, 0.001)]
    assert wide**2 - narrow**2 == pytest.approx(of_tape[0] ** 2 - of_tape[1] ** 2, rel=1e-2)
    if isinstance(source, KnownBaseline):
        assert narrow == pytest.approx(0.001, rel=1e-2)
    else:
        assert narrow > 1.5 * of_tape[1]


@each_source
@pytest.mark.slow
def test_sigmas_hold(source: ScaleSource) -> None:
    """Forty tapes and forty scans: the baseline is as far off as its sigma says."""
    z = []
    for seed in range(1, 41):
        found, sigma, true = baseline_of(source, 0.05, seed)
        z.append((found - true) / sigma)
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize("click_sigma_px", [0.5, 5.0])
def test_the_scales_sigma_is_the_tapes_and_the_clicks(click_sigma_px: float) -> None:
    """With everything but the two ends held, by numerical differences of their residuals."""
    source = KnownSpan((2, 25), LENGTH_M, SIGMA_M, click_sigma_px)
    problem, _ = measured(source)
    graph = build(problem, options_of())
    estimate, values, _ = solve(graph, relative_tolerance=1e-12)
    noise = root_information(problem, graph.options)
    total = total_sigma_m(problem, source, noise, graph.layout.lens_of, "none", np.inf, values)
    a, b = estimate.points[list(source.points)]
    along = (b - a) / np.linalg.norm(b - a)
    variance = SIGMA_M**2
    for end in source.points:
        seen = problem.observations.subset(problem.observations.point == end)
        rows = []
        for step in 1e-6 * np.eye(3):
            ends = []
            for size in (1, -1):
                points = estimate.points.copy()
                points[end] += size * step
                ends.append(residuals_px(replace(estimate, points=points), seen).ravel())
            rows.append((ends[0] - ends[1]) / 2e-6)
        J = np.array(rows).T / click_sigma_px
        variance += along @ np.linalg.inv(J.T @ J) @ along
    assert total == pytest.approx(variance**0.5, rel=1e-5)
    assert total > 1.05 * SIGMA_M
    path = SOURCES["path"]
    of_path = total_sigma_m(problem, path, noise, graph.layout.lens_of, "none", np.inf, values)
    assert of_path == SIGMA_M


# ---- ends that are lost, and renumbered -----------------------------------------------------


def ends_of(problem: Problem) -> FloatArray:
    """Places (2, 3) of the measured distance's ends."""
    (scale,), start = problem.scales, problem.initial
    if isinstance(scale, KnownSpan):
        return start.points[list(scale.points)]
    assert isinstance(scale, KnownPath)
    return np.array([start.rig_from_world[f].inverse.translation for f in scale.frames])


def test_ends_keep_their_place_when_others_go() -> None:
    problem, _ = measured(KnownPath((1, 3), LENGTH_M, SIGMA_M))
    first = problem.observations.frame == 0
    small = compact(problem, problem.observations.subset(~first))
    (path,) = small.scales
    assert isinstance(path, KnownPath) and path.frames == (0, 2)
    np.testing.assert_array_equal(ends_of(small), ends_of(problem))
    problem, _ = measured(KnownSpan((25, 7), LENGTH_M, SIGMA_M))
    others = np.isin(problem.observations.point, (0, 3, 11, 28))
    small = compact(problem, problem.observations.subset(~others))
    (span,) = small.scales
    assert isinstance(span, KnownSpan) and span.points == (22, 5)
    np.testing.assert_array_equal(ends_of(small), ends_of(problem))
    baseline, _ = measured(SOURCES["baseline"])
    first = baseline.observations.frame == 0
    assert compact(baseline, baseline.observations.subset(~first)).scales == baseline.scales


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (SOURCES["path"], "2 m between the frames 000000 and 000003 cannot be used"),
        (SOURCES["span"], "2 m between two points cannot be used: one is seen fewer than 3 times"),
    ],
)
def test_an_end_that_is_lost_is_refused(source: ScaleSource, message: str) -> None:
    problem, _ = measured(source)
    seen = problem.observations
    lost = seen.frame == 3 if isinstance(source, KnownPath) else seen.point == 25
    with pytest.raises(ValueError, match=message):
        compact(problem, seen.subset(~lost))


# ---- clicks ---------------------------------------------------------------------------------


def test_clicks_keep_their_sigma_whatever_that_of_features() -> None:
    problem, _ = measured(SOURCES["span of noisy clicks"])
    clicks = np.isin(problem.observations.point, (2, 25))
    for sigma_px in (0.1, 0.5, 4.0):
        weighed = with_click_sigma(problem, sigma_px).observations.relative_sigma
        assert weighed is not None
        np.testing.assert_array_equal(weighed[~clicks], 1.0)
        # never below the features': a lens that does not fit spares no pixel
        np.testing.assert_allclose(sigma_px * weighed[clicks], max(3 * SIGMA_PX, sigma_px))
    for name in ("baseline", "path", "span"):
        problem, _ = measured(SOURCES[name])
        assert problem.observations.relative_sigma is None


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy", "tukey"])
def test_noise_is_that_of_an_observation_whose_relative_sigma_is_one(loss: LossName) -> None:
    problem, true = small_problem("radtan", sigma_px=SIGMA_PX)
    residuals = residuals_px(true, problem.observations)
    relative = np.random.default_rng(0).uniform(0.5, 5, len(residuals))
    weighed = replace(problem, observations=replace(problem.observations, relative_sigma=relative))
    wide = relative[:, None] * residuals
    assert robust_sigma_px(weighed, wide) == pytest.approx(robust_sigma_px(problem, residuals))
    ours, plain = (
        loss_moments(weighed, options_of(loss), wide),
        loss_moments(problem, options_of(loss), residuals),
    )
    for name in ("curvature", "score_variance", "refit"):
        assert getattr(ours, name) == pytest.approx(getattr(plain, name))

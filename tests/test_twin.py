"""The twin of a scan: its noise is the scan's, its truth the optimum, and its judgement fair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphs.build import GraphOptions
from graphs.priors import PINNED_SIGMA, LensPrior
from graphs.problem import KnownBaseline, KnownPath, residuals_px
from graphs.refine import Refinement, refine
from graphs.scale import length_of
from graphs.twin import Certificate, certify, twin_problem, worst
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

TRACKS = TrackOptions(
    rig="stereo", frames=10, points=900, max_points_per_image=100, sigma_px=0.4, focal_error=0.01,
    rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02, outlier_share=0.03,
    outlier_kind="heavy",
)  # fmt: skip


@pytest.fixture(scope="module")
def refinement() -> Refinement:
    problem, _ = simulate_tracks(TRACKS, np.random.default_rng(0))
    return refine(problem, GraphOptions(), 1.0)


def test_a_twin_has_the_noise_of_the_scan_and_the_optimum_for_its_truth(
    refinement: Refinement,
) -> None:
    twin = twin_problem(refinement, np.random.default_rng(1))
    assert twin.initial is refinement.estimate
    seen = refinement.problem.observations
    np.testing.assert_array_equal(twin.observations.point, seen.point)
    ours = np.linalg.norm(residuals_px(refinement.estimate, twin.observations), axis=1)
    theirs = np.linalg.norm(residuals_px(refinement.estimate, seen), axis=1)
    for share in (0.5, 0.9):  # those of the scan shrank in its fit
        assert 1.0 < np.quantile(ours, share) / np.quantile(theirs, share) < 1.25
    across = residuals_px(refinement.estimate, twin.observations)
    assert np.abs(across.mean(0)).max() < 0.03


def test_noise_is_scaled_by_the_sigma_of_each_observation(refinement: Refinement) -> None:
    seen = refinement.problem.observations
    relative = np.where(seen.frame % 2 == 0, 1.0, 5.0)
    problem = replace(refinement.problem, observations=replace(seen, relative_sigma=relative))
    graph = replace(refinement.graph, problem=problem)
    left = residuals_px(refinement.estimate, seen) * relative[:, None]
    wild = replace(seen, pixels=seen.pixels + residuals_px(refinement.estimate, seen) - left)
    problem = replace(problem, observations=replace(wild, relative_sigma=relative))
    twin = twin_problem(
        replace(refinement, graph=replace(graph, problem=problem)), np.random.default_rng(1)
    )
    lengths = np.linalg.norm(residuals_px(refinement.estimate, twin.observations), axis=1)
    ratio = np.median(lengths[relative == 5]) / np.median(lengths[relative == 1])
    assert ratio == pytest.approx(5, rel=0.1)


def test_a_measured_distance_errs_anew(refinement: Refinement) -> None:
    rng = np.random.default_rng(2)
    scales = [twin_problem(refinement, rng).scales[0] for _ in range(40)]
    lengths = [scale.length_m for scale in scales if isinstance(scale, KnownBaseline)]
    true = np.linalg.norm(refinement.estimate.cam_from_rig[1].translation)
    assert np.std(lengths) == pytest.approx(TRACKS.baseline_sigma_m, rel=0.4)
    assert np.mean(lengths) == pytest.approx(true, abs=3e-4)


def test_every_measured_distance_errs_for_itself(refinement: Refinement) -> None:
    problem = refinement.problem
    scales = (*problem.scales, KnownPath((0, 5), 99.0, 0.01))
    known = replace(
        refinement, graph=replace(refinement.graph, problem=replace(problem, scales=scales))
    )
    drawn = [twin_problem(known, np.random.default_rng(seed)).scales for seed in range(60)]
    off = np.array(
        [
            [(s.length_m - length_of(s, refinement.estimate)) / s.sigma_m for s in own]
            for own in drawn
        ]
    )
    assert np.abs(off.std(axis=0) - 1).max() < 0.3
    assert abs(np.corrcoef(off.T)[0, 1]) < 0.4


@pytest.mark.slow
def test_a_good_scan_is_certified_and_the_same_every_time(refinement: Refinement) -> None:
    told: list[tuple[int, int]] = []
    first = certify(refinement, 4, 0, 1.0, on_trial=lambda *done: told.append(done))
    assert told[-1] == (4, 4)
    mean, error = first.mean_nees
    assert 0.5 < mean < 1.8 and 0 < error < 0.5
    assert first.failed == 0 and first.coverage.mean() > 0.8
    second = certify(refinement, 4, 0, 1.0)
    np.testing.assert_array_equal(first.z, second.z)


def test_coverage_is_the_share_within_the_interval() -> None:
    z = np.array([[0.0, 3.0], [1.9, -2.1], [-1.9, 0.5], [2.0, 1.0]])
    found = Certificate(("a", "b"), z, np.array([0.5, 1.5, 1.0, 1.0]), np.ones(4), 0)
    np.testing.assert_allclose(found.coverage, [0.75, 0.5])
    assert list(worst(found)) == [("b", 0.5), ("a", 0.75)]
    assert found.mean_nees == pytest.approx((1.0, np.sqrt(1 / 6) / 2))


def test_a_twin_that_cannot_be_solved_is_said_so(
    refinement: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*arguments: object, **options: object) -> None:
        raise ValueError("too little")

    monkeypatch.setattr("graphs.twin.refine", refused)
    with pytest.raises(ValueError, match="only 0 of 3 simulated twins"):
        certify(refinement, 3, 0, 1.0)


@pytest.mark.slow
def test_a_rig_without_scale_is_judged_in_its_own_unit() -> None:
    tracks = TRACKS.model_copy(update={"baseline_sigma_m": 0.0})
    problem, _ = simulate_tracks(tracks, np.random.default_rng(3))
    scaled = replace(problem, initial=problem.initial.scaled(7.0))
    found = certify(refine(scaled, GraphOptions(), 1.0), 4, 0, 1.0)
    assert 0.4 < found.mean_nees[0] < 2


def test_nothing_can_be_certified_where_everything_is_held() -> None:
    problem, true = simulate_tracks(
        TRACKS.model_copy(update={"rig": "mono"}), np.random.default_rng(0)
    )
    held = tuple(LensPrior(c.params, np.full(c.params.size, PINNED_SIGMA)) for c in true.cameras)
    with pytest.raises(ValueError, match="every parameter is held"):
        certify(refine(problem, GraphOptions(lens_priors=held), 1.0), 3, 0, 1.0)


def test_an_adaptive_loss_adapts_to_the_twin_too(
    refinement: Refinement, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []

    def noted(*arguments: object, adaptive: bool) -> None:
        asked.append(adaptive)
        raise ValueError

    monkeypatch.setattr("graphs.twin.refine", noted)
    for adaptive in (True, False):
        with pytest.raises(ValueError, match="twins"):
            certify(refinement, 2, 0, 1.0, adaptive=adaptive)
    assert asked == [True, True, False, False]

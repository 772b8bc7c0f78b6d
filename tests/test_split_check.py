"""Two halves of a scan: they agree as far as the sigmas say, and a scan that changes does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphs.build import GraphOptions, build
from graphs.covariance import Covariance
from graphs.jackknife import blocks_of
from graphs.model_covariance import model_covariance
from graphs.priors import PINNED_SIGMA, LensPrior
from graphs.problem import KnownBaseline, Problem
from graphs.solve import solve
from graphs.split_check import TOO_LITTLE_PX, SplitCheck, _widening, difference_px, split_check
from graphs.stated_covariance import CalibrationCovariance, calibration_covariance
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
TRACKS = TrackOptions(
    rig="stereo", frames=20, points=1500, max_points_per_image=100, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
)  # fmt: skip


def problem_of(seed: int = 0, **changes: object) -> Problem:
    return simulate_tracks(TRACKS.model_copy(update=changes), np.random.default_rng(seed))[0]


def checked(problem: Problem, stretch: float = 1.0) -> SplitCheck | None:
    """The check with stated sigmas `stretch` times those of the model."""
    graph = build(problem, GraphOptions(SIGMA_PX))
    estimate, values, _ = solve(graph)
    model = model_covariance(graph, estimate, values)
    stated = Covariance(model.names, stretch**2 * model.matrix)
    covariance = CalibrationCovariance(stated, stated, None, model)
    return split_check(graph, estimate, covariance, 1.0)


@pytest.mark.slow
def test_halves_of_independent_noise_agree_as_often_as_they_should() -> None:
    """p-values of 20 scans are spread over 0 to 1, and the mean square is what was expected."""
    checks = [checked(problem_of(seed, baseline_sigma_m=0.0)) for seed in range(20)]
    found = [check for check in checks if check is not None]
    assert len(found) == len(checks)
    ratio = [(c.difference_px / c.expected_px) ** 2 for c in found]
    assert 0.6 < np.mean(ratio) < 1.5
    p = np.sort([c.p_value for c in found])
    assert p[0] < 0.35 and p[-1] > 0.65 and 0.3 < p.mean() < 0.7
    assert sum(c.agrees for c in found) >= 19
    assert all(c.model_px == pytest.approx(c.expected_px, rel=0.05) for c in found)


def test_any_halves_can_be_held_against_each_other() -> None:
    """Every second block gives the check's own difference, other halves others."""
    problem = problem_of()
    graph = build(problem, GraphOptions(SIGMA_PX))
    estimate, values, _ = solve(graph)
    model, block = model_covariance(graph, estimate, values), blocks_of(problem)
    of_check = checked(problem)
    assert of_check is not None
    found = difference_px(graph, estimate, model, block % 2 == 1, 1.0)
    assert found == pytest.approx(of_check.difference_px, rel=1e-9)
    other = difference_px(graph, estimate, model, block < 5, 1.0)
    assert other is not None and other > 0 and other != pytest.approx(found, rel=0.01)
    assert difference_px(graph, estimate, model, block < 0, 1.0) is None


def test_a_focal_length_that_changes_is_told() -> None:
    """Every second block of frames is 2 % closer: as after somebody touched the zoom."""
    problem = problem_of()
    seen = problem.observations
    centres = np.array([camera.centre for camera in problem.initial.cameras])[seen.camera]
    zoomed = np.where(blocks_of(problem)[seen.frame] % 2 == 1, 1.02, 1.0)
    moved = centres + zoomed[:, None] * (seen.pixels - centres)
    changed = replace(problem, observations=replace(seen, pixels=moved))
    check = checked(changed)
    assert check is not None and not check.agrees
    wide = checked(changed, stretch=12.0)
    assert wide is not None and wide.agrees  # sigmas that allow for it
    assert wide.expected_px == pytest.approx(12 * check.expected_px, rel=1e-6)
    assert wide.difference_px == check.difference_px


def test_halves_that_may_lie_anywhere_are_not_compared() -> None:
    problem = problem_of(baseline_sigma_m=0.0)
    near = checked(problem)
    assert near is not None
    assert checked(problem, stretch=1.1 * TOO_LITTLE_PX / near.expected_px) is None


def test_halves_that_determine_nothing_are_not_compared() -> None:
    problem = problem_of(frames=4, points=3000)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("graphs.split_check.solve_part", lambda *a: None)
        assert checked(problem) is None


def test_the_widening_turns_the_model_into_what_is_stated() -> None:
    rng = np.random.default_rng(0)
    root, more = rng.standard_normal((2, 5, 5))
    scale = np.diag([1e-4, 1.0, 10.0, 1e-3, 1.0])
    M = scale @ root @ root.T @ scale
    S = M + scale @ more @ more.T @ scale
    T = _widening(M, S)
    np.testing.assert_allclose(T @ M @ T.T, S, rtol=1e-6, atol=1e-12)


def test_what_both_halves_believe_moves_them_together() -> None:
    """A loose tape measure makes neither half surer nor their difference larger."""
    expected = []
    for sigma_m in (0.0005, 0.05):
        start = problem_of(baseline_sigma_m=0.0)
        check = checked(replace(start, scales=(KnownBaseline((0, 1), 0.2, sigma_m),)))
        assert check is not None
        expected.append(check.expected_px)
    assert expected[1] == pytest.approx(expected[0], rel=0.1)


def test_where_everything_is_held_there_is_nothing_to_compare() -> None:
    problem, true = simulate_tracks(
        TRACKS.model_copy(update={"rig": "mono"}), np.random.default_rng(0)
    )
    held = tuple(LensPrior(c.params, np.full(c.params.size, PINNED_SIGMA)) for c in true.cameras)
    graph = build(problem, GraphOptions(SIGMA_PX, lens_priors=held))
    estimate, values, _ = solve(graph)
    covariance = calibration_covariance(graph, estimate, values, 1.0)
    assert split_check(graph, estimate, covariance, 1.0) is None

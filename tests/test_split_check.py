"""Two halves of a scan: they agree as far as the sigmas say, and a scan that changes does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphs.build import GraphOptions, build
from graphs.covariance import Covariance
from graphs.jackknife import blocks_of
from graphs.model_covariance import model_covariance
from graphs.problem import Problem
from graphs.solve import solve
from graphs.split_check import SplitCheck, _widening, split_check
from graphs.stated_covariance import CalibrationCovariance
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
    wide = checked(changed, stretch=30.0)
    assert wide is not None and wide.agrees  # sigmas that allow for it
    assert wide.expected_px == pytest.approx(30 * check.expected_px, rel=1e-6)
    assert wide.difference_px == check.difference_px


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

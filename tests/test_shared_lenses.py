"""Cameras that share one lens variable, from rig.yaml to the covariance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm_calib.calibrate import covariance_of, solve_problem
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan
from sfm_calib.nominal import check_config, shared_lenses, start_from_config
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

TRACKS = TrackOptions(rig="triple", frames=10, points=900, max_points_per_image=60)


def config_of(**said: object) -> RigConfig:
    return RigConfig.model_validate({"lens": "radial", **said})


def test_cameras_that_share_a_lens_end_with_one() -> None:
    """Other lenses are hardly moved; the shared one is surer than either alone."""
    problem, _ = simulate_tracks(TRACKS, np.random.default_rng(0))
    results = {}
    for groups in ([], [["cam0", "cam2"]]):
        config = config_of(shared_lenses=groups)
        start = start_from_config(problem, config)
        refinement = solve_problem(start, config, lambda *progress: None)
        results[bool(groups)] = (
            refinement.estimate.cameras,
            covariance_of(refinement, config, lambda *progress: None)[0].model,
        )
    (apart, sigma_apart), (shared, sigma_shared) = results[False], results[True]
    np.testing.assert_array_equal(shared[0].params, shared[2].params)
    assert np.abs(apart[0].params[:2] - apart[2].params[:2]).max() > 1
    assert sigma_shared.names == sigma_apart.names
    for name in ("fx", "cx", "k1"):
        ours = sigma_shared.sigma[f"cam0.{name}"]
        assert ours == pytest.approx(sigma_shared.sigma[f"cam2.{name}"], rel=1e-12)
        assert ours < 0.97 * min(sigma_apart.sigma[f"cam{i}.{name}"] for i in (0, 2))
        assert sigma_shared.of_difference(f"cam0.{name}", f"cam2.{name}") < 1e-6 * ours


def test_a_budget_chooses_among_cameras_that_share_a_lens() -> None:
    problem, _ = simulate_tracks(TRACKS, np.random.default_rng(0))
    config = config_of(shared_lenses=[["cam0", "cam2"]], max_observations=1000)
    refinement = solve_problem(start_from_config(problem, config), config, lambda *p: None)
    assert refinement.budget is not None and refinement.budget.kept <= 1000
    assert 1 < refinement.budget.sigma_factor < refinement.budget.worst_sigma_factor


def scan_of(*sizes: tuple[int, int]) -> Scan:
    names = tuple(f"cam{i}" for i in range(len(sizes)))
    return Scan(Path(), names, sizes, ("0",), ())


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        ({"shared_lenses": [["cam0", "cam9"]]}, "no camera 'cam9'"),
        ({"shared_lenses": [["cam0", "cam1"], ["cam1", "cam2"]]}, "names cam1 twice"),
        ({"shared_lenses": [["cam0", "cam0"]]}, "names cam0 twice"),
        ({"shared_lenses": [["cam0"]]}, "a group of 1 .*shares nothing"),
        ({"shared_lenses": [["cam0", "cam2"]]}, "320 x 240 px.* cannot share"),
        (
            {"shared_lenses": [["cam0", "cam1"]], "cameras": {"cam1": {"lens": "pinhole"}}},
            "cam1 \\(pinhole, .* cannot share",
        ),
        (
            {"shared_lenses": [["cam0", "cam1"]], "cameras": {"cam1": {"params": {"k1": 0.1}}}},
            "lens of cam1 belongs to cam0",
        ),
    ],
)
def test_what_cannot_be_shared_is_said(said: dict[str, object], complaint: str) -> None:
    with pytest.raises(CalibrationError, match=complaint):
        check_config(config_of(**said), scan_of((640, 480), (640, 480), (320, 240)))


def test_groups_are_told_by_index_of_what_is_left() -> None:
    problem, _ = simulate_tracks(TRACKS, np.random.default_rng(0))
    groups = [["cam2", "cam0"], ["cam1", "lost"]]
    assert shared_lenses(problem, config_of(shared_lenses=groups)) == ((2, 0),)

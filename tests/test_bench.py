import json
from dataclasses import replace

import numpy as np
import pytest

from experiments.bench import SIZES, Size, main, simulated, thinned
from experiments.ceres import ceres_bundle_adjust, estimate_of, reconstruction_of
from graphs.build import GraphOptions
from graphs.problem import Estimate, KnownBaseline, Problem, residuals_px
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SMALL = Size(observations=600, frames=6, max_points_per_image=50, points=300)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return simulated(SMALL)


def assert_same(a: Estimate, b: Estimate) -> None:
    for one, other in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_allclose(one.params, other.params, rtol=0, atol=1e-9)
    pairs = [*zip(a.cam_from_rig, b.cam_from_rig, strict=True)]
    pairs += zip(a.rig_from_world, b.rig_from_world, strict=True)
    for one, other in pairs:
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(one.translation, other.translation, atol=1e-12)
    np.testing.assert_allclose(a.points, b.points, atol=1e-12)


@pytest.mark.parametrize("reference", [0, 1])
def test_a_problem_survives_the_way_through_colmap(problem: Problem, reference: int) -> None:
    turned = problem
    if reference:
        ref_from_rig = problem.initial.cam_from_rig[reference]
        start = replace(
            problem.initial,
            cam_from_rig=tuple(t @ ref_from_rig.inverse for t in problem.initial.cam_from_rig),
            rig_from_world=tuple(ref_from_rig @ t for t in problem.initial.rig_from_world),
        )
        turned = replace(problem, initial=start, reference=reference)
    assert_same(estimate_of(reconstruction_of(turned), turned), turned.initial)


def test_colmap_sees_our_residuals(problem: Problem) -> None:
    model = reconstruction_of(problem)
    assert model.compute_num_observations() == len(problem.observations)
    model.update_point_3d_errors()
    ours = np.linalg.norm(residuals_px(problem.initial, problem.observations), axis=1)
    counts = np.bincount(problem.observations.point)
    by_point = np.bincount(problem.observations.point, weights=ours) / counts
    theirs = [model.points3D[i].error for i in sorted(model.points3D)]
    np.testing.assert_allclose(theirs, by_point, rtol=1e-9)


def test_bench_compares_equal_costs_and_writes_them(tmp_path) -> None:
    out = tmp_path / "deep" / "ba.json"
    (row,) = main([SMALL], out)
    assert abs(row.cost_difference) < 1e-6
    (stored,) = json.loads(out.read_text())
    assert stored["observations"] == SMALL.observations and stored["frames"] == SMALL.frames
    assert {
        "points", "cost", "cost_ceres", "seconds", "seconds_marginals", "seconds_ceres",
        "iterations",
    } <= stored.keys()  # fmt: skip
    assert 0 < stored["seconds"] < stored["seconds_marginals"]


@pytest.mark.parametrize("size", SIZES)
def test_sizes_of_the_bench_are_exact(size: Size) -> None:
    problem = simulated(size)
    assert len(problem.observations) == size.observations
    assert len(problem.frame_names) == size.frames
    assert np.bincount(problem.observations.point).min() >= 3


def test_too_much_thinning_is_refused(problem: Problem) -> None:
    with pytest.raises(ValueError, match="cannot thin 600 observations to 50"):
        thinned(problem, 50, np.random.default_rng(0))


def test_what_colmap_cannot_state_is_refused(problem: Problem) -> None:
    measured = replace(problem, scale=KnownBaseline((0, 1), 0.2, 0.001))
    with pytest.raises(ValueError, match="baselines"):
        ceres_bundle_adjust(measured, GraphOptions(), 1e-9)
    options = TrackOptions(lens="radial", frames=4, points=200, baseline_sigma_m=0)
    radial, _ = simulate_tracks(options, np.random.default_rng(0))
    with pytest.raises(ValueError, match="radial"):
        ceres_bundle_adjust(radial, GraphOptions(), 1e-9)

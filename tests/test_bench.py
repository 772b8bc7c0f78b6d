import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import bench
from experiments.bench import (
    GROWTH_SIZES,
    LONG,
    QUICK_SIZES,
    SHORT,
    SIZES,
    BenchOptions,
    Row,
    check_costs,
    main,
    measure,
    native_remarks,
)
from experiments.ceres import (
    ceres_bundle_adjust,
    estimate_of,
    reconstruction_of,
    trace_of,
)
from experiments.scans import Size, simulated, thinned
from experiments.solvers import memory_meter, run, seconds_near
from graphs.build import GraphOptions
from graphs.problem import Estimate, KnownBaseline, Problem, residuals_px
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SMALL = Size(observations=1_400, frames=12, points=450)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return simulated(SMALL)


@pytest.fixture(scope="module")
def row(problem: Problem) -> Row:
    return measure(problem)


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


@pytest.mark.slow
def test_all_solvers_end_at_the_same_cost(row: Row) -> None:
    assert abs(row.cost_difference) < 1e-6
    assert row.cost_gtsam == pytest.approx(row.cost, rel=1e-6)
    check_costs([row])


@pytest.mark.slow
def test_a_row_is_complete_and_in_order(row: Row) -> None:
    assert (row.observations, row.frames) == (SMALL.observations, SMALL.frames)
    assert row.points == 219
    assert min(row.iterations, row.iterations_ceres) > 2
    assert 0 < row.seconds_near <= row.seconds < row.seconds_marginals
    assert 0 < row.seconds_near_ceres <= row.seconds_ceres
    assert row.seconds_gtsam is not None and row.seconds_gtsam > 0
    assert 0 < row.peak_mb <= row.peak_mb_marginals
    assert row.peak_mb_ceres > 0


def test_the_bench_writes_its_rows_and_prints_them(row: Row, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(bench, "measure", lambda *_: row)
    monkeypatch.setattr(bench, "QUICK_SIZES", [SMALL])
    assert main(BenchOptions(quick=True, out=tmp_path / "deep")) == [row]
    (stored,) = json.loads((tmp_path / "deep" / "ba.json").read_text())
    assert stored["observations"] == SMALL.observations and stored["frames"] == SMALL.frames
    assert {
        "points", "cost", "cost_ceres", "seconds", "seconds_marginals", "seconds_ceres",
        "seconds_gtsam", "iterations", "peak_mb", "peak_mb_ceres",
    } <= stored.keys()  # fmt: skip
    assert "1,400" in capsys.readouterr().out
    assert not (tmp_path / "deep" / "growth.json").exists()


def test_growth_is_written_beside_and_held_against_its_promise(
    row: Row, tmp_path, monkeypatch, capsys
) -> None:
    def fake(size: Size, native: bool, repeats: int) -> Row:
        seconds = size.frames * size.observations / 1e6
        same = {"observations": size.observations, "frames": size.frames}
        return replace(row, seconds=seconds, seconds_gtsam=1.0 if native else None, **same)

    monkeypatch.setattr(bench, "simulated", lambda size: size)
    monkeypatch.setattr(bench, "measure", fake)
    monkeypatch.setattr(bench, "cold_compile_seconds", lambda: 12.3)
    rows = main(BenchOptions(out=tmp_path))
    assert [row.observations for row in rows] == [25_000, 100_000, 400_000, 400_000, 1_600_000]
    assert [row.seconds_gtsam for row in rows] == [1.0, 1.0, 1.0, 1.0, None]
    growth = json.loads((tmp_path / "growth.json").read_text())
    assert growth["compile_seconds"] == 12.3
    assert growth["growth_observations"] == 16 and growth["growth_frames"] == 25
    assert [row["observations"] for row in growth["rows"]] == [80_000]
    printed = capsys.readouterr().out
    assert "BROKEN" in next(line for line in printed.splitlines() if "1,000 frames, 400" in line)
    assert "kept" in next(line for line in printed.splitlines() if "1,600,000 obs" in line)


def test_different_costs_fail_after_writing(row: Row, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(bench, "QUICK_SIZES", [SMALL])
    monkeypatch.setattr(bench, "measure", lambda *_: replace(row, cost_ceres=row.cost * 0.99999))
    with pytest.raises(AssertionError, match=r"1,400 observations, 12 frames: our cost \d.*Ceres"):
        main(BenchOptions(quick=True, out=tmp_path))
    assert len(json.loads((tmp_path / "ba.json").read_text())) == 1


def test_gtsam_ending_elsewhere_is_reported(row: Row) -> None:
    assert native_remarks([row, replace(row, cost_gtsam=None)]) == []
    (remark,) = native_remarks([row, replace(row, cost_gtsam=row.cost * 1.001)])
    assert "1,400 observations" in remark and "+1.0e-03" in remark


@pytest.mark.slow
def test_a_solver_that_fails_says_why(tmp_path: Path) -> None:
    stored = tmp_path / "broken.pickle"
    stored.write_bytes(pickle.dumps("no problem"))
    with pytest.raises(
        RuntimeError, match=r"ceres failed on broken.pickle, exit status 1(.|\n)*AttributeError"
    ):
        run("ceres", stored)


def test_memory_is_counted_above_what_was_there() -> None:
    kept = np.ones(10_000_000)  # 80 MB
    peak_mb = memory_meter()
    passing = np.ones(5_000_000)  # 40 MB
    del passing
    assert 35 < peak_mb() < 60
    assert len(kept) == 10_000_000


def test_the_time_to_get_near_is_read_from_the_trace() -> None:
    trace = [(1.0, 5.0), (2.0, 2.0 + 1e-5), (3.0, 2.0 + 1e-6), (4.0, 2.0)]
    assert seconds_near(trace, 4.5) == pytest.approx(3.5)
    assert seconds_near([], 4.5) is None


def test_ceres_table_becomes_a_trace() -> None:
    table = """
iter cost cost_change |gradient| |step| tr_ratio tr_radius ls_iter iter_time total_time
   0  4.1e+05  0.00e+00 1.32e+05 0.0e+00  0.00e+00 1.0e+04 0 1.88e-01 1.0e+00
   1  8.0e+04  3.00e+00 1.44e+06 0.0e+00  4.72e+00 3.0e+04 1 4.49e-01 2.0e+00
   2  2.0e+04 -7.00e+02 5.40e+05 7.0e+00 -1.78e+00 9.0e+04 1 4.23e-01 3.0e+00
   3  1.8e+04  1.00e-06 1.57e+05 3.7e+00  1.19e+00 2.7e+05 1 4.34e-01 4.0e+00
"""
    times, costs = np.array(trace_of(table, 10.0)).T
    np.testing.assert_array_equal(times, [1, 2, 3, 4])
    np.testing.assert_allclose(costs - 10, [3 + 1e-6, 1e-6, 1e-6, 0], rtol=1e-6)


def test_ceres_trace_is_its_own(problem: Problem, capfd) -> None:
    result = ceres_bundle_adjust(problem, GraphOptions(sigma_px=0.5), 1e-9)
    times = [at for at, _ in result.trace]
    assert len(times) == result.iterations and times == sorted(times)
    assert times[-1] <= result.seconds
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("size", [*QUICK_SIZES, SHORT])
def test_sizes_of_the_bench_are_exact(size: Size) -> None:
    problem = simulated(size)
    assert len(problem.observations) == size.observations
    assert len(problem.frame_names) == size.frames
    assert np.bincount(problem.observations.point).min() >= 3


def test_the_sizes_are_those_promised() -> None:
    assert {size.observations for size in SIZES} == {25_000, 100_000, 400_000, 1_600_000}
    assert {size.frames for size in SIZES} == {50, 200, 1_000}
    assert GROWTH_SIZES == (SHORT,)
    assert SHORT.observations / SHORT.frames == LONG.observations / LONG.frames


def test_too_much_thinning_is_refused(problem: Problem) -> None:
    with pytest.raises(ValueError, match="cannot thin 1400 observations to 50"):
        thinned(problem, 50, np.random.default_rng(0))


def test_what_colmap_cannot_state_is_refused(problem: Problem) -> None:
    measured = replace(problem, scales=(KnownBaseline((0, 1), 0.2, 0.001),))
    with pytest.raises(ValueError, match="baselines"):
        ceres_bundle_adjust(measured, GraphOptions(), 1e-9)
    options = TrackOptions(lens="radial", frames=4, points=200, baseline_sigma_m=0)
    radial, _ = simulate_tracks(options, np.random.default_rng(0))
    with pytest.raises(ValueError, match="radial"):
        ceres_bundle_adjust(radial, GraphOptions(), 1e-9)
    with pytest.raises(ValueError, match="no loss tukey"):
        ceres_bundle_adjust(problem, GraphOptions(loss="tukey"), 1e-9)
    seen = problem.observations
    weighed = replace(problem, observations=replace(seen, relative_sigma=np.ones(len(seen))))
    with pytest.raises(ValueError, match="alike"):
        ceres_bundle_adjust(weighed, GraphOptions(), 1e-9)

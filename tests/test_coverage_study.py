"""The study's statistics on draws from known covariances, and the requirement itself (slow)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.coverage import (
    GEOMETRIES,
    NOISES,
    CoverageOptions,
    answer,
    inverse_information,
    measured_prior,
    trial,
)
from experiments.coverage_summary import ALL, FEWEST_SCANS, Summary, broken, nees, summarise
from experiments.runner.protocol import Finished, Row
from experiments.runner.sweep import load_study, trials_of
from graphs.build import GraphOptions, build
from graphs.frames import FloatArray, Transform
from graphs.jackknife import change
from graphs.model_covariance import model_covariance
from graphs.priors import weak_lens_prior
from graphs.solve import solve
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

WALL = CoverageOptions(geometry="wall")
CASES = tuple(
    CoverageOptions(geometry=geometry, noise=noise) for noise in NOISES for geometry in GEOMETRIES
)
NAMES = ["cam0.fx", "cam0.fy", "cam1.fx", "cam1.fy"]
CONFIG = Path(__file__).parents[1] / "configs/studies/coverage.yaml"
SCANS = 20  # of the requirement


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def some_covariance(sigma: FloatArray) -> FloatArray:
    root = np.tril(rng(1).standard_normal((len(sigma), len(sigma)))) + 2 * np.eye(len(sigma))
    covariance = root @ root.T
    scale = sigma / np.sqrt(np.diag(covariance))
    return covariance * np.outer(scale, scale)


def drawn(count: int, stated: float = 1.0, inefficient: float = 1.0) -> list[Row]:
    """Rows whose errors follow a covariance; `stated` times its sigma is stated, and it is
    `inefficient` times the bound's."""
    bound = some_covariance(np.array([1e-3, 1.0, 5.0, 100.0]))
    sigma = np.sqrt(np.diag(bound))
    efficient = rng().multivariate_normal(np.zeros(4), bound, count)
    return [
        {
            "names": NAMES,
            "error": (inefficient * best).tolist(),
            "sigma_stated": (stated * sigma).tolist(),
            "sigma_model": (inefficient * sigma).tolist(),
            "nees_stated": nees(inefficient * best, bound * stated**2),
            "nees_model": nees(inefficient * best, bound * inefficient**2),
            "error_efficient": best.tolist(),
            "sigma_bound": sigma.tolist(),
            "nees_efficient": nees(best, bound),
            "sigma_px": 0.5,
            "seconds_calibrating": 1.0,
        }
        for best in efficient
    ]


def summary_of(rows: list[Row], refused: int = 0) -> Summary:
    return summarise("wall gaussian", "gaussian", rows, refused)


def finished(rows: list[Row], options: CoverageOptions = WALL) -> list[Finished[CoverageOptions]]:
    return [Finished(options, seed, row, 1.0) for seed, row in enumerate(rows)]


# ---- statistics ----------------------------------------------------------------------------


def test_nees_by_hand() -> None:
    assert nees(np.array([2.0, 3.0]), np.diag([4.0, 1.0])) == pytest.approx((1 + 9) / 2)
    correlated = np.array([[1.0, 0.9], [0.9, 1.0]])
    with_it, against = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    assert nees(with_it, correlated) == pytest.approx(1 / 1.9)
    assert nees(against, correlated) == pytest.approx(1 / 0.1)


@pytest.mark.parametrize(("stated", "expected"), [(1.0, 1.0), (2.0, 0.25), (0.5, 4.0)])
def test_nees_of_draws_is_what_is_stated_of_them(stated: float, expected: float) -> None:
    summary = summary_of(drawn(3000, stated))
    mean, error = summary.nees_stated
    assert mean == pytest.approx(expected, rel=0.05)
    assert error == pytest.approx(expected * (2 / 4 / 3000) ** 0.5, rel=0.15)
    assert summary.nees_model[0] == pytest.approx(1.0, rel=0.05)


def test_coverage_of_draws_is_that_of_their_intervals() -> None:
    assert summary_of(drawn(3000)).coverage[ALL] == pytest.approx(0.95, abs=0.01)
    narrow = summary_of(drawn(3000, 0.5))
    assert narrow.coverage["fx"] == pytest.approx(0.673, abs=0.02)  # within 0.98 sigma
    assert narrow.worst_coverage[1] < 0.70
    assert summary_of(drawn(3000, 2.0)).coverage["fy"] > 0.995


def test_efficiency_is_measured_better_in_pairs() -> None:
    few = [summary_of(drawn(2000, inefficient=1.08)), summary_of(drawn(30))]
    assert few[0].of_bound[ALL] == pytest.approx(1.08, rel=0.05)
    assert few[0].of_bound_paired[ALL] == pytest.approx(1.08, rel=0.01)
    assert few[1].of_bound_paired["fx"] == pytest.approx(1.0)
    assert abs(few[1].of_bound[ALL] - 1) > 0.005


# ---- what is promised ----------------------------------------------------------------------


def test_draws_as_stated_keep_the_promises() -> None:
    found = answer(finished(drawn(200)))
    assert found.holds is True and found.verdict.startswith("yes: 200 scans, NEES")
    overview = dict(zip(found.tables[0].columns, found.tables[0].rows[0], strict=True))
    assert overview["scans"] == 200 and overview["parameters"] == 4
    assert overview["NEES stated"] == pytest.approx(1, abs=0.2)
    assert overview["RMSE / bound"] == pytest.approx(1.0)
    assert {row[0] for row in found.tables[1].rows} == {"fx", "fy", ALL}


@pytest.mark.parametrize(
    ("rows", "fault"),
    [
        (drawn(200, stated=0.8), "NEES 1."),
        (drawn(200, stated=1.4), "NEES 0."),
        (drawn(200, stated=0.6), "95 % intervals of all hold"),
        (drawn(200, stated=1.2, inefficient=1.2), "errors of all 1.20 times the Cramer-Rao bound"),
    ],
)
def test_draws_not_as_stated_break_them(rows: list[Row], fault: str) -> None:
    found = answer(finished(rows))
    assert found.holds is False and found.verdict.startswith("no: ")
    assert any(one.startswith(fault) for one in broken(summary_of(rows))) and fault in found.verdict


def test_one_kind_of_parameter_breaks_them() -> None:
    """One camera's, in a third of all scans."""
    rows = [dict(row) for row in drawn(200)]
    for row in rows[::3]:
        row["sigma_stated"] = [*row["sigma_stated"][:3], 1e-3]  # type: ignore[index, misc]
    kinds = {
        fault.split(" hold ")[0].removeprefix("95 % intervals of ")
        for fault in broken(summary_of(rows))
    }
    assert "fy" in kinds and kinds <= {"fy", ALL}


def test_heavy_noise_may_err_more() -> None:
    rows = [row | {"nees_efficient": None} for row in drawn(2000, stated=0.9)]
    assert broken(summary_of(rows))
    assert not broken(summarise("wall heavy", "heavy", rows))
    assert not summarise("wall heavy", "heavy", rows).of_bound


def test_refusals_are_counted_apart() -> None:
    summary = summary_of(drawn(30), refused=1)
    assert summary.scans == 30 and broken(summary) == ["1 of 31 scans refused"]
    failed = Finished(WALL, 30, {}, 1.0, "no parallax")
    found = answer([*finished(drawn(30)), failed])
    assert found.holds is False and "1 of 31 scans refused" in found.verdict
    assert found.tables[-1].rows == (("wall gaussian", 30, "no parallax"),)


def test_of_few_scans_nothing_is_said() -> None:
    failed = Finished(WALL, 0, {}, 1.0, "no parallax")
    for trials in ([], [failed], finished(drawn(1)), finished(drawn(FEWEST_SCANS - 1))):
        assert answer(trials).holds is None
    heavy = CoverageOptions(geometry="wall", noise="heavy")
    only = drawn(1)[0] | {"nees_efficient": None}
    assert answer([*finished(drawn(30)), *finished([only], heavy), failed]).holds is None


def test_the_config_asks_for_every_case() -> None:
    trials = trials_of(load_study(CONFIG))
    assert {trial.options for trial in trials} == set(CASES)
    assert len(trials) >= FEWEST_SCANS * len(CASES)


def test_a_case_says_what_is_unusual() -> None:
    assert CoverageOptions(noise="heavy").case == "orbit heavy"
    assert CoverageOptions(sigma_px=1, outlier_share=0.1).case == (
        "orbit gaussian sigma_px 1 outlier_share 0.1"
    )


# ---- one scan ------------------------------------------------------------------------------


def test_errors_are_those_that_the_covariance_reports() -> None:
    """Turns about the camera's own axes, the translation as it stands."""
    options = TrackOptions(rig="stereo", frames=6, points=600)
    _, true = simulate_tracks(options, rng())
    turn, move = np.array([1e-3, -2e-3, 3e-3]), np.array([0.01, 0.02, -0.03])
    moved = true.cam_from_rig[1]
    moved = Transform(Transform.exp(turn, move).rotation @ moved.rotation, moved.translation + move)
    longer = replace(true.cameras[0], params=true.cameras[0].params + np.array([1, 0, 0, -2, 0, 0]))
    wrong = replace(
        true, cameras=(longer, true.cameras[1]), cam_from_rig=(true.cam_from_rig[0], moved)
    )
    axes = [f"cam1.{kind}_{axis}" for kind in ("rotation", "translation") for axis in "xyz"]
    names = ["cam0.fx", "cam0.cy", "cam1.fx", *axes]
    np.testing.assert_allclose(change(true, wrong, names), [1, -2, 0, *turn, *move], atol=1e-9)
    np.testing.assert_allclose(change(true, true, names), 0, atol=1e-9)


def test_priors_are_drawn_by_their_own_sigmas() -> None:
    _, true = simulate_tracks(TrackOptions(rig="mono", frames=6, points=600), rng())
    camera, prior = true.cameras[0], weak_lens_prior(true.cameras[0])
    off = [measured_prior(camera, rng(seed)).mean - camera.params for seed in range(2000)]
    np.testing.assert_allclose(np.std(off, axis=0)[2:], prior.sigma[2:], rtol=0.06)
    ratio = np.diff(off, axis=1)[:, 0] / prior.mean[0]
    assert ratio.std() == pytest.approx(prior.aspect_sigma, rel=0.06)


def test_the_bound_is_the_covariance_of_least_squares() -> None:
    """The model's covariance has it times the noise that the residuals show."""
    options = TrackOptions(rig="stereo", frames=12, points=900, max_points_per_image=100)
    problem, true = simulate_tracks(options, rng())
    graph = build(replace(problem, initial=true), GraphOptions(options.sigma_px, "none"))
    bound = np.sqrt(np.diag(inverse_information(graph)))
    estimate, values, _ = solve(graph)
    model = model_covariance(graph, estimate, values).matrix
    np.testing.assert_allclose(np.sqrt(np.diag(model)), bound, rtol=0.05)


def test_a_scan_that_cannot_be_used_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.coverage.MIN_PARALLAX_DEG", 179.0)
    with pytest.raises(ValueError, match="179 deg of parallax"):
        trial(WALL, 0)


def test_a_scan_measures_what_the_answer_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    short = TrackOptions(frames=14, points=700, max_points_per_image=60)
    monkeypatch.setattr("experiments.coverage.SCAN", short)
    gaussian, heavy = (trial(one, 3) for one in CASES if one.geometry == "wall")
    assert trial(WALL, 3)["error"] == gaussian["error"] != trial(WALL, 4)["error"]
    summary = summary_of([gaussian])
    assert summary.parameters == 6 and set(summary.coverage) >= {"fx", "k2", ALL}
    assert 0.5 < summary.of_bound_paired[ALL] < 2 and "nees_efficient" not in heavy
    assert summary.sigma_px == pytest.approx(WALL.sigma_px, rel=0.1)
    z = np.array(gaussian["error"]) / np.array(gaussian["sigma_stated"])
    assert np.abs(z).max() < 5
    louder = trial(WALL.model_copy(update={"sigma_px": 1.0}), 3)
    assert louder["sigma_px"] == pytest.approx(2 * gaussian["sigma_px"], rel=0.1)  # type: ignore[operator]


# ---- the requirement -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def trials() -> list[Finished[CoverageOptions]]:
    return [Finished(case, seed, trial(case, seed), 1.0) for case in CASES for seed in range(SCANS)]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda one: one.case.replace(" ", "-"))
def test_sigmas_hold(case: CoverageOptions, trials: list[Finished[CoverageOptions]]) -> None:
    rows = [one.row for one in trials if one.options == case]
    assert len(rows) == SCANS
    assert broken(summarise(case.case, case.noise, rows)) == []


@pytest.mark.slow
def test_the_verdict_is_yes(trials: list[Finished[CoverageOptions]]) -> None:
    found = answer(trials)
    assert found.holds, found.verdict
    assert len(found.tables[0].rows) == len(CASES)

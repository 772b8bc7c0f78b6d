"""The study's statistics on draws from known covariances, and the requirement itself (slow)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.coverage import (
    ALL,
    CASES,
    COVERAGE,
    MEAN_NEES,
    MOST_OF_BOUND,
    SIGMA_PX,
    Case,
    Efficient,
    Options,
    Refusal,
    Summary,
    Trial,
    inverse_information,
    main,
    measured_prior,
    nees,
    study,
    summarise,
    trial,
)
from graphs.build import GraphOptions, build
from graphs.frames import FloatArray, Transform
from graphs.jackknife import change
from graphs.model_covariance import model_covariance
from graphs.priors import weak_lens_prior
from graphs.solve import solve
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

CASE = Case("wall", "gaussian")
NAMES = ("cam0.fx", "cam0.fy", "cam1.fx", "cam1.fy")
WIDENED = 3.0  # standard errors


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def some_covariance(sigma: FloatArray) -> FloatArray:
    root = np.tril(rng(1).standard_normal((len(sigma), len(sigma)))) + 2 * np.eye(len(sigma))
    covariance = root @ root.T
    scale = sigma / np.sqrt(np.diag(covariance))
    return covariance * np.outer(scale, scale)


def drawn(count: int, stated: float = 1.0, inefficient: float = 1.0) -> list[Trial]:
    """Trials whose errors follow a covariance; `stated` times its sigma is stated, and it is
    `inefficient` times the bound's."""
    bound = some_covariance(np.array([1e-3, 1.0, 5.0, 100.0]))
    efficient = rng().multivariate_normal(np.zeros(4), bound, count)
    error = inefficient * efficient
    return [
        Trial(NAMES, e, bound * stated**2, bound * inefficient**2, Efficient(best, bound), 0.5, 1.0)
        for e, best in zip(error, efficient, strict=True)
    ]


# ---- statistics ----------------------------------------------------------------------------


def test_nees_by_hand() -> None:
    assert nees(np.array([2.0, 3.0]), np.diag([4.0, 1.0])) == pytest.approx((1 + 9) / 2)
    correlated = np.array([[1.0, 0.9], [0.9, 1.0]])
    with_it, against = np.array([1.0, 1.0]), np.array([1.0, -1.0])
    assert nees(with_it, correlated) == pytest.approx(1 / 1.9)
    assert nees(against, correlated) == pytest.approx(1 / 0.1)


@pytest.mark.parametrize(("stated", "expected"), [(1.0, 1.0), (2.0, 0.25), (0.5, 4.0)])
def test_nees_of_draws_is_what_is_stated_of_them(stated: float, expected: float) -> None:
    summary = summarise(CASE, drawn(4000, stated))
    mean, error = summary.nees_stated
    assert mean == pytest.approx(expected, rel=0.05)
    assert error == pytest.approx(expected * (2 / 4 / 4000) ** 0.5, rel=0.15)
    assert summary.nees_model[0] == pytest.approx(1.0, rel=0.05)


def test_coverage_of_draws_is_that_of_their_intervals() -> None:
    assert summarise(CASE, drawn(4000)).coverage[ALL] == pytest.approx(0.95, abs=0.01)
    narrow = summarise(CASE, drawn(4000, 0.5))
    assert narrow.coverage["fx"] == pytest.approx(0.673, abs=0.02)  # within 0.98 sigma
    assert narrow.worst_coverage[1] < 0.70
    assert summarise(CASE, drawn(4000, 2.0)).coverage["fy"] > 0.995


def test_efficiency_is_measured_better_in_pairs() -> None:
    few = [summarise(CASE, drawn(2000, inefficient=1.08)), summarise(CASE, drawn(30))]
    assert few[0].of_bound[ALL] == pytest.approx(1.08, rel=0.05)
    assert few[0].of_bound_paired[ALL] == pytest.approx(1.08, rel=0.01)
    assert few[1].of_bound_paired["fx"] == pytest.approx(1.0)
    assert abs(few[1].of_bound[ALL] - 1) > 0.005


def test_refusals_are_counted_apart() -> None:
    summary = summarise(CASE, [*drawn(3), Refusal("no")])
    assert summary.scans == 3 and summary.refused == ("no",)
    with pytest.raises(ValueError, match=r"wall gaussian: none of 1 scans .* no"):
        summarise(CASE, [Refusal("no")])


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
    graph = build(replace(problem, initial=true), GraphOptions(SIGMA_PX, "none"))
    bound = np.sqrt(np.diag(inverse_information(graph)))
    estimate, values, _ = solve(graph)
    model = model_covariance(graph, estimate, values).matrix
    np.testing.assert_allclose(np.sqrt(np.diag(model)), bound, rtol=0.05)


def test_a_scan_that_cannot_be_used_is_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiments.coverage.MIN_PARALLAX_DEG", 179.0)
    result = trial(CASE, 0)
    assert isinstance(result, Refusal) and "179 deg of parallax" in result.message


# ---- all of it -----------------------------------------------------------------------------


@pytest.mark.slow
def test_the_study_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "coverage.json"
    summaries = main(Options(scans=2, only=("wall",), out=out))
    assert [(s.geometry, s.noise) for s in summaries] == [("wall", "gaussian"), ("wall", "heavy")]
    gaussian, heavy = summaries
    assert gaussian.scans == heavy.scans == 2
    assert gaussian.parameters == 6 and set(gaussian.coverage) >= {"fx", "k2", ALL}
    assert 0.9 < gaussian.of_bound_paired[ALL] < 1.3 and not heavy.of_bound
    assert heavy.nees_efficient is None
    assert gaussian.sigma_px == pytest.approx(SIGMA_PX, rel=0.1)
    assert json.loads(out.read_text())[1]["noise"] == "heavy"
    assert "RMSE" in capsys.readouterr().out


@pytest.mark.slow
def test_scans_are_the_same_in_any_number_of_processes() -> None:
    cases = [Case("wall", "heavy")]
    alone, together = study(cases, 2)[0], study(cases, 2, jobs=2)[0]
    assert together.nees_model == pytest.approx(alone.nees_model, rel=1e-6)


@pytest.fixture(scope="module")
def summaries() -> dict[Case, Summary]:
    return dict(zip(CASES, study(CASES, scans=20), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.geometry}-{case.noise}")
def test_sigmas_hold(case: Case, summaries: dict[Case, Summary]) -> None:
    summary = summaries[case]
    assert not summary.refused
    low, high = MEAN_NEES[case.noise]
    # of a chi-squared: the scatter of the scans themselves would excuse what makes it large
    chance = (2 / (summary.parameters * summary.scans)) ** 0.5
    assert low - WIDENED * chance < summary.nees_stated[0] < high + WIDENED * chance
    cameras = summary.parameters / (len(summary.coverage) - 1)
    share = (0.95 * 0.05 / (summary.scans * cameras)) ** 0.5
    for kind, covered in summary.coverage.items():
        slack = 0.02 if kind == ALL else WIDENED * share
        assert COVERAGE[0] - slack < covered < COVERAGE[1] + slack, kind


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.geometry}-{case.noise}")
def test_estimates_are_efficient(case: Case, summaries: dict[Case, Summary]) -> None:
    for kind, ratio in summaries[case].of_bound_paired.items():
        slack = 0.0 if kind == ALL else 0.05  # chance in 20 scans
        assert ratio < MOST_OF_BOUND + slack, kind

"""The study of degenerate motion: its scans, its judge, its solvers, and what it makes of rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic.dense import linearise_dense
from synthetic.problems import small_problem

from experiments.degenerate_motion import MotionName, degenerate_scan
from experiments.dense_squares import (
    DenseSquares,
    condition,
    dense_squares,
    householder,
    of_lens,
)
from experiments.linear_solvers import REFUSALS, SOLVERS
from experiments.runner.protocol import Answer, Finished
from experiments.runner.sweep import load_study, trials_of
from experiments.weak_geometry import STUDY, WeakGeometryOptions, trial
from experiments.weak_geometry_answer import EPS, TITLES, answer
from graphs.build import GraphOptions, build
from graphs.frames import log_rotation
from graphs.keys import lens_key
from graphs.problem import Problem, residuals_px
from sfm_calib.simulate.rigs import make_rig

CONFIG = Path(__file__).resolve().parent.parent / "configs/studies/weak_geometry.yaml"
CAMERA = make_rig("mono", "radial").cameras[0]
MOTIONS: tuple[MotionName, ...] = ("panorama", "forward", "facing")


def scan(motion: MotionName, scale: float, sigma_px: float = 0.0) -> Problem:
    return degenerate_scan(motion, scale, CAMERA, 5, 14, sigma_px, np.random.default_rng(3))


# ---- scans ---------------------------------------------------------------------------------


def test_motion_loses_what_it_is_said_to_lose() -> None:
    few = 1e-6
    for motion in MOTIONS:
        problem = scan(motion, few)
        places = problem.initial.rig_from_world
        centre = np.array([t.inverse.translation for t in places])
        spread = np.ptp(centre, axis=0)
        turn = np.ptp([log_rotation(t.rotation) for t in places], axis=0).max()
        relief = np.ptp(problem.initial.points[:, 2])
        assert (spread.max() < 1e-5) == (motion == "panorama")
        assert (turn < 1e-2) == (motion != "panorama")
        assert (relief < 1e-2) == (motion == "facing")
        assert (spread[2] > 0.1) == (motion == "forward")
        assert (spread[:2].max() > 0.1) == (motion == "facing")


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_scan_starts_at_its_truth(motion: MotionName) -> None:
    problem = scan(motion, 0.1)
    assert np.abs(residuals_px(problem.initial, problem.observations)).max() < 1e-9
    noisy = scan(motion, 0.1, 0.5)
    assert np.std(residuals_px(noisy.initial, noisy.observations)) == pytest.approx(0.5, rel=0.3)


# ---- the judge -----------------------------------------------------------------------------


def test_the_judge_has_eleven_bits_more() -> None:
    """A Hilbert matrix, whose inverse is whole numbers: condition 5e11."""
    n = 9
    i = np.arange(n)
    inverse = np.array([[_inverse_hilbert(n, a, b) for b in i] for a in i], dtype=float)
    exact = np.sqrt((inverse**2).sum(1))
    errors = []
    for real in (np.float64, np.longdouble):
        A = 1 / (i[:, None] + i + 1).astype(real)
        squares = DenseSquares(A, A @ np.ones(n, real), np.ones(n, real), n)
        R, y = householder(squares)
        found = of_lens(R, y, squares)
        errors.append(np.abs(found.sigma / exact - 1).max())
        assert np.abs(found.step - 1).max() < (1e-3 if real is np.float64 else 1e-6)
        assert condition(R, np.random.default_rng(0)) == pytest.approx(4.93e11, rel=0.02)
    assert errors[1] < 1e-7 and errors[1] < errors[0] / 100


def _inverse_hilbert(n: int, a: int, b: int) -> float:
    parts = comb(n + a, n - b - 1) * comb(n + b, n - a - 1) * comb(a + b, a) ** 2
    return float((-1) ** (a + b) * (a + b + 1) * parts)


def test_derivatives_are_those_of_the_residuals() -> None:
    problem = scan("forward", 0.5, 0.5)
    graph = build(problem, GraphOptions(0.5, "none"))
    n_points, points = len(problem.initial.points), problem.initial.points
    exact = dense_squares(graph, graph.initial, points, np.longdouble)
    A = (exact.A * exact.scale).astype(float)[: 2 * len(problem.observations)]
    about = linearise_dense(graph, graph.initial, points)
    seen, width = problem.observations, graph.layout.elimination.n_columns
    differences = np.zeros((len(seen), 2, 3 * n_points + width))
    for row, point in enumerate(seen.point):
        differences[row, :, 3 * point : 3 * point + 3] = about.by_point[row]
    differences[:, :, 3 * n_points :] = about.by_variables
    lens = 3 * n_points + graph.layout.columns(lens_key(0))
    order = np.append(np.setdiff1d(np.arange(differences.shape[2]), lens), lens)
    np.testing.assert_allclose(A, differences.reshape(len(A), -1)[:, order], rtol=1e-5, atol=2e-3)
    np.testing.assert_allclose(exact.b[: len(A)].astype(float), -about.residuals.ravel())


def test_dense_equations_are_for_one_camera() -> None:
    problem, _ = small_problem("radial", cameras=2)
    graph = build(problem, GraphOptions())
    with pytest.raises(ValueError, match="one camera"):
        dense_squares(graph, graph.initial, problem.initial.points, np.float64)


# ---- trials --------------------------------------------------------------------------------

SMALL = WeakGeometryOptions(frames=6, points=20, lens="radial", noise_px=0.1)


def test_on_a_good_scan_all_solvers_agree() -> None:
    row: Any = trial(SMALL, 0)
    for solver in SOLVERS:
        assert row[f"{solver}_sigma_error"] < 1e-6 and row[f"{solver}_step_error"] < 1e-6
    assert row["condition"] < 1e5 and 1e-5 < row["focal_sigma"] < 0.1
    assert trial(SMALL, 0) == row != trial(SMALL, 1)


def test_on_a_degenerate_one_they_fall_one_after_the_other() -> None:
    row: Any = trial(SMALL.model_copy(update={"motion": "facing", "scale": 1e-10}), 0)
    assert 1e9 < row["condition"] < 1e13
    assert row["qr_sigma_error"] < 1e-3
    assert (row["cholesky_sigma_error"] or 1.0) > 0.1
    assert row["gtsam_cholesky_refused"].startswith("Indeterminate")
    assert row["ours_refused"].startswith("the scan leaves 1 direction of cam0.fx, cam0.fy")
    assert row["ours_sigma_error"] is row["ours_doubted"] is None and not row["usable"]


def test_a_calibration_says_what_it_lacks() -> None:
    row: Any = trial(
        SMALL.model_copy(update={"motion": "forward", "scale": 1e-3, "belief": "weak"}), 0
    )
    assert row["verdict"] == "unusable" and "cam0" in row["said"]
    row = trial(SMALL.model_copy(update={"motion": "panorama", "scale": 1e-3, "belief": "weak"}), 0)
    assert row["verdict"] == "refused" and "parallax" in row["said"]
    assert row["off"] is row["z"] is None


def test_a_refusal_is_none_of_its_own() -> None:
    assert not any(issubclass(KeyError, kind) or issubclass(TypeError, kind) for kind in REFUSALS)


# ---- the answer ----------------------------------------------------------------------------

Change = Callable[[dict[str, Any]], dict[str, Any]]


def rows(change: Change = lambda row: row) -> list[Finished[WeakGeometryOptions]]:
    """What theory says of two motions, scale by scale; `change` makes them something else."""
    found = []
    for motion in MOTIONS[:2]:
        for power in range(15):
            cond = 10.0 ** (3 + power)
            row: dict[str, Any] = {"condition": cond, "usable": power < 3, "focal_sigma": 0.0}
            for solver in TITLES:
                error = EPS * cond if "qr" in solver else EPS * cond**2
                lost = error > 0.1 and "qr" not in solver
                row |= {
                    f"{solver}_sigma_error": None if lost else error,
                    f"{solver}_step_error": None if lost else error,
                    f"{solver}_doubted": None if lost else power >= 3,
                    f"{solver}_refused": "it is" if lost else None,
                }
            options = WeakGeometryOptions(motion=motion, scale=10.0**-power)
            found.append(Finished(options, 0, change(row), 0.1))
            weak = options.model_copy(update={"belief": "weak"})
            verdict = "nothing" if power < 3 else "unusable"
            told = change(row | {"verdict": verdict, "said": "", "off": 1e-3, "z": 1.0})
            found.append(Finished(weak, 0, told, 0.1))
    return found


def changed(name: str, value: Any, least: float = 0.0) -> Change:
    return lambda row: (
        row | {name: value} if name in row and row["condition"] >= least else dict(row)
    )


def test_theory_holds() -> None:
    found = answer(rows())
    assert found.holds and found.verdict.startswith("yes: Cholesky fails from cond(J) 1e+08")
    assert "QR fails from cond(J) 1e+15 (error as cond^1.0, 0 refused" in found.verdict
    assert "ours fails from cond(J) 1e+08 (error as cond^2.0, 20 refused, 0 wrong)" in found.verdict
    assert "of 30 calibrations 0 went wrong without a word" in found.verdict
    solvers = {row[0]: row for row in found.tables[0].rows}
    assert solvers["Cholesky"][1] == 1e8 and solvers["Cholesky"][6] == 20
    assert len(found.figures) == 2 and len(found.tables[1].rows) == 30


def squared(row: dict[str, Any]) -> dict[str, Any]:
    return row | {"qr_sigma_error": row["condition"] ** 2 * EPS}


def silent(row: dict[str, Any]) -> dict[str, Any]:
    lost = row["ours_sigma_error"] is None
    return row | {"ours_sigma_error": 0.5, "ours_doubted": False} if lost else row


@pytest.mark.parametrize(
    "change",
    [
        squared,  # QR fails as early as Cholesky
        silent,  # ours states what is wrong, and calls it usable
        changed("cholesky_sigma_error", 1e-5),  # never fails
        changed("cholesky_sigma_error", None, 1e5),  # fails too early
        changed("off", 0.03),
        changed("z", -5.0),
    ],
)
def test_what_is_otherwise_is_said(change: Change) -> None:
    found = answer(rows(change))
    assert found.holds is False and found.verdict.startswith("no: ")


def test_few_trials_answer_too() -> None:
    every = rows()
    for some in (every[:1], every[1:2], every[:3], [every[0], replace(every[1], error="why")]):
        found = answer(some)
        assert found.holds is None and found.verdict.startswith("too little to say")
    beyond = answer([Finished(t.options, t.seed, {**t.row, "condition": 1e18}, 0.1) for t in every])
    assert beyond.holds is None and "Cholesky" not in beyond.verdict
    nothing: Answer = answer([replace(t, row={}, error="no") for t in every])
    assert nothing.holds is None and nothing.verdict == "none of 60 trials was finished"


def test_a_motion_in_which_nothing_fails_counts_in_the_median() -> None:
    """QR fails in one of two at 1e15: the typical motion is one of which nothing is known."""
    every = rows()
    good = [
        replace(t, row={**t.row, "qr_sigma_error": 1e-3})
        if t.options.motion == MOTIONS[0] and t.row["qr_sigma_error"] > 0.1
        else t
        for t in every
    ]
    found = answer(good)
    assert found.holds is None and found.verdict.startswith("too little to say")
    assert "QR fails in 1 of 2 cases from cond(J) 1e+15" in found.verdict
    row = {row[0]: row for row in found.tables[0].rows}["QR"]
    assert row[1] is None and row[2:4] == (1e15, 1e15) and row[-2:] == (1, 2)
    # of Cholesky the judge sees far beyond where it should
    fine = [
        replace(t, row={**t.row, "cholesky_sigma_error": 1e-5})
        if t.options.motion == MOTIONS[0]
        else t
        for t in every
    ]
    assert answer(fine).holds is False


def test_failures_are_counted() -> None:
    every = rows()
    found = answer([*every, replace(every[0], row={}, error="why")])
    assert found.holds and found.verdict.endswith("; 1 trials failed")


def test_the_config_is_one() -> None:
    trials = trials_of(load_study(CONFIG))
    assert len(trials) > 300 and STUDY.options is WeakGeometryOptions
    assert answer([]).holds is None

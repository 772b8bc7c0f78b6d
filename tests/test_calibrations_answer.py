"""What trials of calibrations say together, on rows made by hand."""

from __future__ import annotations

import re

import numpy as np
import pytest

from experiments.calibration_answer import answer
from experiments.calibration_options import CalibrationOptions, CalibrationTrial
from experiments.runner.protocol import Cell, Finished


def options(**given: object) -> CalibrationOptions:
    return CalibrationTrial.model_validate(given)


def judged(name: str, verdict: str, **row: Cell) -> Finished[CalibrationOptions]:
    """A rig's recalibration with that verdict."""
    said: dict[str, Cell] = {
        "usable": True, "weak": "", "drift": verdict, "drifted": "", "p": 0.5, "change_px": 0.3,
        "change": "left has its principal point 1 px off", "detectable_px": 0.8,
    }  # fmt: skip
    of = options(name=name, command="recalibrate", scan=f"s/{name}", old=f"o/{name}")
    return Finished(of, 0, said | row, 60.0)


def refused(name: str, why: str) -> Finished[CalibrationOptions]:
    of = options(name=name, command="recalibrate", scan=f"s/{name}", old=f"o/{name}")
    return Finished(of, 0, {}, 1.0, why)


def swept(loss: str, seed: int, fx: float, **row: Cell) -> Finished[CalibrationOptions]:
    said: dict[str, Cell] = {
        "usable": True, "weak": "", "rms_px": 0.5, "cam0.fx": fx, "cam0.fx.sigma": 0.5,
        "cam0.k1": 0.0, "cam0.k1.sigma": 0.0,
    }  # fmt: skip
    return Finished(options(scan="s/one", loss=loss), seed, said | row, 2.0)


def test_a_fleet_is_told_rig_by_rig() -> None:
    fleet = [judged(f"rig{i:02}", "keep") for i in range(9)]
    fleet += [judged("rig09", "replace", drifted="right", change="right points 0.3 deg elsewhere")]
    fleet += [judged("rig10", "inconclusive"), refused("rig11", "no such scan: s/rig11")]
    found = answer(fleet)
    assert found.verdict == (
        "12 rigs: 9 keep, 1 replace (rig09: right points 0.3 deg elsewhere), 1 inconclusive, "
        "1 failed (rig11: no such scan: s/rig11)"
    )
    assert found.holds is None  # nothing was expected
    (table,) = found.tables
    assert [row[0] for row in table.rows] == [f"rig{i:02}" for i in range(12)]
    verdict, failure = (table.columns.index(name) for name in ("verdict", "failure"))
    assert (
        table.rows[9][verdict] == "replace"
        and table.rows[9][table.columns.index("drifted")] == "right"
    )
    assert table.rows[11][verdict] == "failed" and "no such scan" in str(table.rows[11][failure])
    (figure,) = found.figures
    assert list(figure.figure.data[0].x) == [f"rig{i:02}" for i in range(11)]  # not the failed one


def test_many_rigs_to_replace_are_not_all_named() -> None:
    found = answer([judged(f"rig{i}", "replace") for i in range(7)])
    assert "rig2" in found.verdict and "rig3" not in found.verdict
    assert "and 4 more" in found.verdict and "\n" not in found.verdict


def test_a_sweep_is_told_option_by_option() -> None:
    trials = [swept("huber", seed, 500.0 + seed) for seed in (0, 1)]
    trials += [swept("cauchy", seed, 502.0 + seed) for seed in (0, 1)]
    found = answer(trials)
    assert found.verdict == (
        "4 trials: 4 usable; loss moves cam0.fx of s/one most, by 2.0 (4.0 sigma)"
    )
    rigs, parameters = found.tables
    assert rigs.columns[:4] == ("rig", "loss", "seed", "verdict")
    assert parameters.columns == ("rig", "loss", "parameter", "trials", "mean", "scatter", "sigma")
    # k1 is held: it has no sigma, and nothing to tell
    assert parameters.rows == (
        ("s/one", "huber", "cam0.fx", 2, 500.5, pytest.approx(0.5**0.5), 0.5),
        ("s/one", "cauchy", "cam0.fx", 2, 502.5, pytest.approx(0.5**0.5), 0.5),
    )
    (figure,) = found.figures
    (line,) = figure.figure.data
    assert list(line.x) == ["huber", "cauchy"]
    assert list(line.y) == [-1.0, 1.0] and list(line.error_y["array"]) == [0.5, 0.5]


def test_results_that_are_not_usable_are_counted_and_not_drawn() -> None:
    trials = [swept("huber", 0, 500.0), swept("cauchy", 0, 501.0)]
    found = answer([*trials, swept("none", 0, 22.0, usable=False, weak="doming")])
    assert found.verdict == (
        "3 trials: 2 usable, 1 not usable (s/one (loss none): doming); "
        "loss moves cam0.fx of s/one most, by 1.0 (2.0 sigma)"
    )
    assert list(found.figures[0].figure.data[0].x) == ["huber", "cauchy"]


def test_scans_without_a_name_are_called_by_what_tells_them_apart() -> None:
    row: dict[str, Cell] = {"usable": True, "weak": ""}
    trials = [
        Finished(options(scan=f"fleet/{name}/scan"), 0, row, 1.0) for name in ("rig1", "rig2")
    ]
    (table,) = answer(trials).tables
    assert [one[0] for one in table.rows] == ["rig1/scan", "rig2/scan"]


def compared(z: float, count: int = 20, directions: int = 18) -> list[Finished[CalibrationOptions]]:
    rng = np.random.default_rng(0)
    chi2 = z**2 * rng.chisquare(directions, count)
    row: dict[str, Cell] = {"usable": True, "weak": "", "z_directions": directions}
    made = options(simulate="tracks")
    return [
        Finished(made, seed, row | {"z_rms": float((one / directions) ** 0.5)}, 1.0)
        for seed, one in enumerate(chi2)
    ]


def test_with_a_truth_the_sigmas_are_put_to_the_test() -> None:
    right, small, wide = (answer(compared(z)) for z in (1.0, 1.5, 0.6))
    assert (right.holds, small.holds, wide.holds) == (True, False, True)
    for found, z in ((right, 1.0), (small, 1.5), (wide, 0.6)):
        said = re.search(
            r"errors are ([0-9.]+) ± ([0-9.]+) times what .* \(20 scans with a truth\)",
            found.verdict,
        )
        assert said and abs(float(said[1]) - z) < 3 * float(said[2]) < 0.3


def test_one_scan_calibrated_in_many_ways_is_one_scan() -> None:
    """Its trials share their errors: more of them say no more."""
    (unlucky,) = compared(1.5, count=1, directions=4)
    ways = [
        Finished(options(simulate="tracks", max_observations=1000 + way), 0, unlucky.row, 1.0)
        for way in range(50)
    ]
    found = answer(ways)
    assert "(1 scan with a truth)" in found.verdict and found.holds is True


@pytest.mark.parametrize(
    "trials",
    [
        [refused("rig0", "no such scan")],
        [judged("rig0", "keep")],
        [swept("huber", 0, 1.0)],
        [swept("huber", 0, 1.0), Finished(options(scan="s/one", loss="none"), 0, {}, 1.0, "bad")],
        [swept("huber", 0, float("nan")), swept("none", 0, 1.0)],
        compared(1.0, count=1),
        [judged("rig0", "keep", change=None, change_px=None, p=None)],
    ],
)
def test_few_trials_have_an_answer_too(trials: list[Finished[CalibrationOptions]]) -> None:
    found = answer(trials)
    assert f"{len(trials)} " in found.verdict
    assert all(len(row) == len(table.columns) for table in found.tables for row in table.rows)
    assert answer([]).holds is None

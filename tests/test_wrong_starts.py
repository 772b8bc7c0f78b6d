from __future__ import annotations

from pathlib import Path

import pytest

from experiments.runner.protocol import Finished
from experiments.runner.sweep import load_study, trials_of
from experiments.wrong_starts import SAME_COST, WrongStartOptions, answer, trial

CONFIG = Path(__file__).parents[1] / "configs/studies/wrong_starts.yaml"
MONO = WrongStartOptions(rig="mono", lens="radial", frames=30)


def finished(above: float, seed: int = 0, iterations: int = 9) -> Finished[WrongStartOptions]:
    row = {
        "cost_above": above, "iterations": iterations, "iterations_from_truth": 3, "reason": "x"
    }  # fmt: skip
    return Finished(MONO, seed, row, 1.0)


def test_all_at_the_optimum_or_below_is_yes() -> None:
    found = answer([finished(0.0), finished(-1e-3, 1), finished(SAME_COST / 2, 2, 40)])
    assert found.holds is True
    assert found.verdict == "yes: 3 of 3 wrong starts end at the optimum, in at most 40 iterations"
    assert found.tables[0].rows[0][1:] == (3, 3, pytest.approx(58 / 3), 40, 3.0)


@pytest.mark.parametrize(
    "missed", [finished(2 * SAME_COST, 1), Finished(MONO, 1, {}, 1.0, "singular")]
)
def test_one_elsewhere_is_no(missed: Finished[WrongStartOptions]) -> None:
    found = answer([finished(0.0), missed])
    assert found.holds is False and found.verdict.startswith("no: 1 of 2")
    assert found.tables[1].rows[0][:2] == (MONO.kind, 1)


def test_of_nothing_or_failures_alone() -> None:
    assert answer([]).holds is None
    assert answer([Finished(MONO, 0, {}, 1.0, "singular")]).holds is False


def test_a_wrong_start_is_solved() -> None:
    small = WrongStartOptions(rig="stereo", frames=10)
    row = trial(small, 0)
    assert row == trial(small, 0)
    assert abs(float(row["cost_above"])) <= SAME_COST  # type: ignore[arg-type]
    assert int(row["iterations"]) > int(row["iterations_from_truth"])  # type: ignore[arg-type]


@pytest.mark.slow
def test_every_wrong_start_ends_at_the_optimum() -> None:
    trials = trials_of(load_study(CONFIG))
    done = [Finished(t.options, t.seed, trial(t.options, t.seed), 1.0) for t in trials]  # type: ignore[arg-type]
    assert len(done) == 100
    found = answer(done)  # type: ignore[arg-type]
    assert found.holds, found.verdict

"""How errors fall with views: the answer on rows whose answer is known, and small real trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from experiments.runner.protocol import Finished
from experiments.views_needed import ViewsOptions, answer, share_seen, trial

NUMBERS = (3, 10, 20, 30, 60)


def finished(
    options: ViewsOptions, seed: int, off_px: float, stated_px: float, nees: float = 1.0
) -> Finished[ViewsOptions]:
    scale = 1 + 0.02 * (seed % 3 - 1)
    row = {
        "off_px": off_px * scale, "stated_px": stated_px, "nees": nees, "focal_px": 1.0,
        "centre_px": 1.0, "sigma_focal_px": 1.0, "seen": 0.9, "n_corners": 1000, "warned": False,
    }  # fmt: skip
    return Finished(options, seed, row, 1.0)


def by_number(
    slope: float, understated: float = 1.0, numbers: Sequence[int] = NUMBERS
) -> list[Finished[ViewsOptions]]:
    return [
        finished(ViewsOptions(views=n), seed, n**slope, n**slope / understated)
        for n in numbers
        for seed in range(6)
    ]


def test_a_square_root_law_with_true_sigmas_holds() -> None:
    found = answer(by_number(-0.5))
    assert found.holds is True
    assert "n^-0.50" in found.verdict
    assert "18 % less" in found.verdict


def test_other_laws_and_too_small_sigmas_do_not() -> None:
    assert answer(by_number(-0.1)).holds is False
    assert answer(by_number(-1.2)).holds is False
    hidden = answer(by_number(-0.5, understated=3))
    assert hidden.holds is False
    assert "stated covariances are too small" in hidden.verdict
    assert hidden.verdict.count("3.0") >= len(NUMBERS)
    flat = [finished(ViewsOptions(tilt_deg=0), seed, 1.0, 1.0, nees=30.0) for seed in range(6)]
    narrow = answer([*by_number(-0.5), *flat])
    assert narrow.holds is False
    assert "at tilt_deg 0.0: 1.00 of what is stated, NEES 30" in narrow.verdict
    wild = [replace(one, row={**one.row, "nees": 4.0 * 10.0 ** (3 * one.seed)}) for one in flat]
    assert answer([*by_number(-0.5), *wild]).holds is False, "a mean is no surer than itself"


def test_a_scan_twice_as_bad_takes_four_times_the_frames() -> None:
    scan = [
        finished(ViewsOptions(source="scan", views=n), seed, 2 * n**-0.5, 2 * n**-0.5)
        for n in (20, 40, 80)
        for seed in range(6)
    ]
    assert "80 and 120 frames of a scan" in answer([*by_number(-0.5), *scan]).verdict


def test_flat_boards_are_compared_with_the_usual_ones() -> None:
    flat = [finished(ViewsOptions(tilt_deg=5), seed, 10 * 20**-0.5, 3.0) for seed in range(6)]
    found = answer([*by_number(-0.5), *flat])
    assert "5 deg of tilt x10" in found.verdict
    assert {figure.name for figure in found.figures} == {"number", "tilt_deg"}


def test_few_failed_and_missing_trials_are_no_answer() -> None:
    assert answer([]).holds is None
    broken = Finished(ViewsOptions(), 0, {}, 0.1, "no")
    assert answer([broken]).holds is None
    assert answer([*by_number(-0.5, numbers=(20,)), broken]).holds is None
    assert answer([trials for trials in by_number(-0.5) if trials.seed == 0]).holds is None
    assert answer([*by_number(-0.5), broken]).holds is True


def test_the_share_of_the_picture_with_a_corner() -> None:
    size = (640, 480)
    assert share_seen(np.array([[0.0, 0.0], [1.0, 1.0]]), size) == pytest.approx(1 / 108)
    x, y = np.meshgrid(np.arange(640.0), np.arange(240.0))
    assert share_seen(np.stack([x, y], -1).reshape(-1, 2), size) == pytest.approx(5 / 9)


@pytest.mark.parametrize("options", [ViewsOptions(views=4), ViewsOptions(source="scan", views=12)])
def test_a_trial_is_near_the_truth_and_the_same_again(options: ViewsOptions) -> None:
    row = trial(options, 1)
    assert row == trial(options, 1)
    off, stated = row["off_px"], row["stated_px"]
    assert isinstance(off, float)
    assert isinstance(stated, float)
    assert 0 < off < 4 * stated < 40

"""The study's counts on rows whose answer is known, and small scans of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.drift import CHANGES, RIGS, DriftOptions, after, answer, trial
from experiments.drift_summary import FEWEST_TRIALS, broken, summarise, too_many
from experiments.runner.protocol import Finished, Row
from experiments.runner.sweep import load_study, trials_of
from graphs.frames import angle_between
from sfm_calib.simulate.rigs import make_rig
from sfm_calib.simulate.tracks import TrackOptions

CONFIG = Path(__file__).parents[1] / "configs/studies/drift.yaml"


def row(verdict: str, power: float = 0.0, named: bool = False, nameable: bool = False) -> Row:
    return {
        "verdict": verdict,
        "named": named,
        "among": named,
        "power": power,
        "nameable": nameable,
        "detectable_px": 0.5,
        "worst": "focal (0,)",
        "surest": "rotation (1,)",
    }


def finished(rows: list[Row], **given: Any) -> list[Finished[DriftOptions]]:
    return [Finished(DriftOptions(**given), seed, one, 1.0) for seed, one in enumerate(rows)]


FOUND = row("replace", 1.0, named=True, nameable=True)


def test_chance_is_allowed_for() -> None:
    """Of 20, 1 is expected; 5 or more have a chance of 0.0026, 6 or more of 0.0003."""
    assert not too_many(5, 20) and too_many(6, 20)
    assert not too_many(0, 0) and not too_many(0, 100) and too_many(20, 100)


def test_counts_by_hand() -> None:
    rows = [
        FOUND,
        row("inconclusive", 1.0),
        row("inconclusive", 0.5),
        row("keep", 0.96, True, True),
    ]
    one = summarise("triple turned", "turned", 3, 0.95, rows, 1)
    assert (one.trials, one.replace, one.inconclusive, one.keep, one.refused) == (4, 1, 2, 1, 1)
    assert (one.allowed, one.replace_allowed, one.nameable, one.named_nameable) == (3, 1, 2, 2)
    assert one.worst == "focal (0,)" and one.surest == "rotation (1,)"


def test_what_is_expected_is_yes() -> None:
    trials = [
        *finished([row("keep")] * 19 + [row("replace")]),
        *finished([FOUND] * 20, rig="triple", change="turned"),
        *finished([row("inconclusive", 0.2)] * 20, change="focal"),
        *finished([row("inconclusive")] * 20, change="panorama"),
    ]
    found = answer(trials)
    assert found.holds is True and found.verdict == (
        "yes: 1 of 20 untouched rigs replaced, 20 of 20 changes found that the sigmas allow to be "
        "found, the camera named in 20 of 20, 20 of 20 scans too weak to tell inconclusive"
    )


@pytest.mark.parametrize(
    ("rows", "given", "fault"),
    [
        ([row("replace")] * 6 + [row("keep")] * 14, {}, "6 of 20 untouched rigs replaced"),
        (
            [FOUND] * 14 + [row("keep", 1.0)] * 6,
            {"change": "turned"},
            "14 of 20 changes found",
        ),
        (
            [FOUND] * 14 + [row("replace", 1.0, nameable=True)] * 6,
            {"rig": "quad", "change": "focal"},
            "the camera named in 14 of 20",
        ),
        (
            [row("inconclusive")] * 14 + [row("keep")] * 6,
            {"change": "weak turned"},
            "14 of 20 scans too weak to tell inconclusive",
        ),
    ],
)
def test_what_is_not_is_no(rows: list[Row], given: dict[str, Any], fault: str) -> None:
    found = answer(finished(rows, **given))
    assert found.holds is False and fault in found.verdict.split("expected otherwise")[1]


def test_sigmas_that_allow_nothing_are_no_yes() -> None:
    quiet = finished([row("keep")] * 20)
    blind = [
        one
        for change in ("turned", "focal")
        for one in finished([row("inconclusive", 0.4)] * 20, rig="quad", change=change)
    ]
    found = answer([*quiet, *blind])
    assert found.holds is None and found.verdict.startswith("sigmas allow too little to be found")
    half = finished([FOUND] * 20, rig="triple", change="turned")
    assert answer([*quiet, *blind[:20], *half]).holds is True
    assert answer([*quiet, *blind, *half]).holds is None
    # of two cameras, and of what is not meant to be found, none is asked
    assert answer(finished([row("keep", 0.2)] * 20, rig="quad", change="baseline")).holds is True
    assert answer(finished([row("keep", 0.2)] * 20, change="turned")).holds is True


def test_untouched_rigs_are_counted_together_too() -> None:
    """Of 20 each 4 are chance (0.016); 12 of 60 are not (0.00004)."""
    each = [row("replace")] * 4 + [row("keep")] * 16
    alone = [finished(each, rig=rig) for rig in RIGS]
    assert answer(alone[0]).holds is True
    found = answer([one for some in alone for one in some])
    assert found.holds is False
    assert found.verdict.endswith("expected otherwise: all rigs: 12 of 60 untouched rigs replaced")


def test_of_two_cameras_no_name_is_asked() -> None:
    rows = [row("replace", 1.0, nameable=True)] * 20
    assert not broken(summarise("", "turned", 2, 0.95, rows))
    assert broken(summarise("", "turned", 3, 0.95, rows))


def test_refusals_and_little() -> None:
    refused = Finished(DriftOptions(), 20, {}, 1.0, "no parallax")
    found = answer([*finished([row("keep")] * 20), refused])
    assert found.holds is False and "1 of 21 scans refused" in found.verdict
    assert answer([]).holds is None and answer([refused]).holds is None
    assert answer(finished([row("keep")] * (FEWEST_TRIALS - 1))).holds is None


def test_the_config_asks_for_every_case() -> None:
    trials = trials_of(load_study(CONFIG))
    cases = {(t.options.rig, t.options.change) for t in trials}  # type: ignore[attr-defined]
    assert cases == {(rig, change) for rig in RIGS for change in CHANGES}


def test_what_is_changed_is_changed() -> None:
    rig = make_rig("triple", "radial")
    rng = np.random.default_rng(0)
    turned = after(rig, DriftOptions(change="turned", turn_deg=0.2), 1, rng)
    apart = [
        np.degrees(angle_between(a.rotation, b.rotation))
        for a, b in zip(rig.cam_from_rig, turned.cam_from_rig, strict=True)
    ]
    np.testing.assert_allclose(apart, [0, 0.2, 0], atol=1e-6)
    longer = after(rig, DriftOptions(change="focal", focal=0.01), 2, rng).cameras[2].params
    np.testing.assert_allclose(longer[:2], 1.01 * rig.cameras[2].params[:2])
    same = after(rig, DriftOptions(), 0, rng)
    assert [c.params.tolist() for c in same.cameras] == [c.params.tolist() for c in rig.cameras]


def test_a_turned_camera_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    short = TrackOptions(
        points=600, max_points_per_image=60, frames=12, lens="radial", baseline_sigma_m=0.0001
    )
    monkeypatch.setattr("experiments.drift.SCAN", short)
    options = DriftOptions(change="turned", turn_deg=3.0)
    found = trial(options, 0)
    assert found == trial(options, 0)
    assert found["verdict"] == "replace" and found["power"] == pytest.approx(1)
    assert trial(DriftOptions(), 0)["verdict"] != "replace"

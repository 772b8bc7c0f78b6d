"""The study's answer on rows whose answer is known, and small calibrations of each kind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.runner.protocol import Finished
from experiments.runner.sweep import load_study, trials_of
from experiments.targetless_trial import (
    BOARD,
    TargetlessOptions,
    errors,
    trial,
)
from experiments.targetless_vs_target import FEWEST_SEEDS, SET_VIEWS, Kind, answer, kinds_of
from graphs.compare import Stated
from graphs.covariance import NOTHING
from graphs.drift_picture import assumed_covariance
from graphs.frames import Transform
from graphs.problem import Estimate
from sfm_calib.simulate.rigs import make_rig

CONFIG = Path(__file__).parents[1] / "configs/studies/targetless_vs_target.yaml"
IMAGES = (20, 50, 100, 200, 400)
LEVEL = 0.1  # px of the board set
Trials = list[Finished[TargetlessOptions]]


def options(**given: Any) -> TargetlessOptions:
    return TargetlessOptions.model_validate(given)


def finished(one: TargetlessOptions, seed: int, stated: float, ratio: float = 1.0) -> Any:
    """A calibration that states an error, and errs by a ratio of that."""
    px, metric = ratio * stated, one.board_views > 0 or one.source == "boards"
    row = {
        "px": px,
        "px_stated": stated,
        "focal_percent": [px, -px],
        "sigma_focal_percent": [stated, stated],
        "rotation_deg": px,
        "sigma_rotation_deg": stated,
        "baseline_percent": px if metric else None,
        "sigma_baseline_percent": stated if metric else None,
    }
    return Finished(one, seed, row, 1.0)


def made(equal_at: float, seeds: int = 8, ratio: float = 1.0, **given: Any) -> Trials:
    """That board set, and scans that equal it at a length, by what they state."""
    rng = np.random.default_rng(0)
    found = [
        finished(options(source="boards", images=SET_VIEWS), seed, LEVEL) for seed in range(seeds)
    ]
    for images in IMAGES:
        for seed in range(seeds):
            px = LEVEL * (equal_at / images) ** 0.5 * (1 + 0.05 * rng.standard_normal())
            found.append(finished(options(images=images, **given), seed, px, ratio))
    return found


# ---- the answer ----------------------------------------------------------------------------


def test_counting_by_hand() -> None:
    """25 views of 54 corners are 1350, each worth 25 features; 200 of these an image."""
    assert len(BOARD.corners_m) == 54
    assert Kind(options(), (), 0).counted == pytest.approx(168.75)
    assert Kind(options(features=50), (), 0).counted == pytest.approx(675)
    assert Kind(options(sigma_px=0.1), (), 0).counted == pytest.approx(6.75)


@pytest.mark.parametrize(
    ("equal_at", "holds"), [(169, True), (110, True), (40, False), (1e4, False), (1.0, False)]
)
def test_the_count_holds_within_a_factor_of_two(equal_at: float, holds: bool) -> None:
    found = answer(made(equal_at))
    assert found.holds is holds
    assert found.verdict.startswith("yes: " if holds else "no: ")
    assert "handheld, 200 features" in found.verdict and "(0.10 px)" in found.verdict
    row = dict(zip(found.tables[0].columns, found.tables[0].rows[0], strict=True))
    if 20 < equal_at < 400:
        assert float(row["images"]) == pytest.approx(equal_at, rel=0.06)  # type: ignore[arg-type]
    else:
        assert row["images"] == ("20 or fewer" if equal_at == 1 else "more than 400")


def test_one_kind_of_scan_can_break_it() -> None:
    good, bad = made(169), made(1e4, motion="corridor")
    assert answer([*good, *bad[8:]]).holds is False


def test_board_views_beside_a_scan_are_told_apart() -> None:
    trials = [*made(169), *made(60, board_views=2)[8:], *made(30, board_views=5)[8:]]
    found = answer(trials)
    assert found.holds is True  # what is expected is said of scans alone
    assert "handheld, 200 features + 2, 5: 56, 29 (of 50 images" in found.verdict
    assert [one.name for one in found.figures] == ["alone", "with_boards_handheld_200"]
    table = found.tables[1]
    at = table.columns.index("baseline %")
    scans = [row for row in table.rows if row[0] != "board views alone"]
    assert {row[at] is None for row in scans if "+" not in str(row[0])} == {True}
    assert all(row[at] is not None for row in scans if "+" in str(row[0]))


def test_errors_that_are_not_as_stated_say_nothing() -> None:
    good = answer(made(169))
    same = "errors are 1.00 ± 0.00 (of boards) and 1.00 ± 0.00 (of scans) times as stated"
    assert same in good.verdict
    wrong = answer(made(169, ratio=2.0))
    assert wrong.holds is None and wrong.verdict.startswith("errors are not as stated: ")
    assert "1.00 ± 0.00 (of boards) and 2.00 ± 0.00 (of scans) times" in wrong.verdict
    row = wrong.tables[0].rows[0]
    assert float(row[4]) == pytest.approx(169, rel=0.06)  # type: ignore[arg-type]
    assert row[7] == "more than 400"  # by errors, 676


def test_a_few_boards_that_err_more_than_stated_are_not_lost_among_scans() -> None:
    """Both together would be 1.09 times as stated."""
    trials = made(169)
    boards = [replace(one, row={**one.row, "px": 1.45 * LEVEL}) for one in trials[:8]]
    found = answer([*boards, *trials[8:]])
    assert found.holds is None and found.verdict.startswith("errors are not as stated: ")
    assert "1.45 ± 0.00 (of boards) and 1.00 ± 0.00 (of scans)" in found.verdict


def test_scans_that_are_too_short_are_no_contradiction() -> None:
    """By counting 169 images: 200 that do not reach it leave 338 open; 50 say nothing."""

    def up_to(longest: int, equal_at: float = 1e4, **given: Any) -> Trials:
        every = made(equal_at, **given)
        return [t for t in every if t.options.source == "boards" or t.options.images <= longest]

    assert answer(up_to(200)).holds is True
    assert answer(up_to(400)).holds is False
    short = answer(up_to(50))
    assert short.holds is None and short.verdict.startswith("scans are too short to say: ")
    assert answer(up_to(50, 30)).holds is False  # far too early is one, however short they are
    other = [t for t in made(1e4, features=50) if t.options.source == "scan"]  # 675 by counting
    assert answer([*made(169), *[t for t in other if t.options.images <= 200]]).holds is True
    assert answer([*made(40), *[t for t in other if t.options.images <= 200]]).holds is False


def test_of_little_nothing_is_said() -> None:
    failed: Any = Finished(options(), 0, {}, 1.0, "no parallax")
    boards = made(169)[:8]
    assert answer([]).holds is None
    for trials in ([failed], boards, made(169)[8:], [*boards, failed]):
        found = answer(trials)
        assert found.holds is None and found.verdict.startswith("too little to say")
    assert answer(made(169, seeds=1)).holds is None
    assert answer(made(169, seeds=FEWEST_SEEDS - 1)).holds is None
    found = answer([*made(169), failed])
    assert found.holds is True and found.tables[-1].rows == (
        ("handheld, 200 features, 50 images", 0, "no parallax"),
    )
    one_length = [one for one in made(169) if one.options.images in (SET_VIEWS, 50)]
    assert "more than 50" in answer(one_length).verdict


def test_the_config_has_a_board_set_and_scans_of_every_kind() -> None:
    trials = trials_of(load_study(CONFIG))
    kinds = kinds_of([Finished(t.options, t.seed, {}, 1.0) for t in trials])  # type: ignore[arg-type]
    assert any(k.options.source == "boards" and SET_VIEWS in k.images for k in kinds)
    assert {k.options.board_views for k in kinds} == {0, 1, 2, 5}
    assert all(k.fewest >= FEWEST_SEEDS for k in kinds)


# ---- one calibration -----------------------------------------------------------------------


def test_errors_are_those_of_the_calibration() -> None:
    """One focal length 1 % long, and the second camera turned and moved."""
    rig = make_rig("stereo", "radtan")
    longer = rig.cameras[0].params * np.where(np.arange(8) < 2, 1.01, 1.0)
    turn = Transform.exp(np.array([0.0, 0.003, 0.0]), np.zeros(3))
    second = turn @ rig.cam_from_rig[1]
    moved = Transform(second.rotation, 0.98 * second.translation)
    cameras = (type(rig.cameras[0])("cam0", "radtan", (640, 480), longer), rig.cameras[1])
    estimate = Estimate(cameras, (rig.cam_from_rig[0], moved), (), np.zeros((0, 3)))
    found = errors(rig, Stated(estimate, assumed_covariance(estimate, 0.2, 2.0)), True)
    np.testing.assert_allclose(found["focal_percent"], [1.0, 0.0], atol=1e-9)
    assert found["rotation_deg"] == pytest.approx(np.degrees(0.003))
    assert found["baseline_percent"] == pytest.approx(-2.0)
    # 1 % of some 220 px from the centre, in one camera of two
    assert 1.2 < found["px"] < 1.9
    # no turn in it: of the five parts three are of lenses, which weak priors hold a little
    assert found["px_stated"] == pytest.approx(0.2 * (3 / 5) ** 0.5, rel=0.1)
    unknown = errors(rig, Stated(estimate, NOTHING), False)
    assert unknown["baseline_percent"] is None and unknown["px_stated"] == 0


def test_a_scan_is_calibrated() -> None:
    short = options(images=10, features=60)
    row = trial(short, 1)
    assert trial(short, 1)["px"] == row["px"] != trial(short, 2)["px"]
    assert 40 < row["features"] <= 60  # type: ignore[operator]
    assert row["baseline_percent"] is None
    assert row["px"] < 5 * row["px_stated"] < 50  # type: ignore[operator]


def test_board_views_help_a_corridor() -> None:
    alone, joined = (
        trial(options(images=12, features=80, motion="corridor", board_views=n), 0) for n in (0, 2)
    )
    assert joined["px_stated"] < 0.6 * alone["px_stated"]  # type: ignore[operator]
    assert abs(joined["baseline_percent"]) < 1  # type: ignore[arg-type]
    assert joined["sigma_baseline_percent"] < 0.5  # type: ignore[operator]


@pytest.mark.slow
def test_boards_alone_are_calibrated() -> None:
    row = trial(options(source="boards", images=6), 0)
    assert row["px"] < 4 * row["px_stated"] < 4  # type: ignore[operator]
    assert "features" not in row and abs(row["baseline_percent"]) < 1  # type: ignore[arg-type]

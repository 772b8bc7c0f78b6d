from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

import sfm_calib.simulate.depth_image as depth_images
from experiments.cabin_answer import fails_by_hand, scan_for_boards
from experiments.cabin_calibration import CabinOptions, calibrate_cabin, show_board
from experiments.cabin_cases import ADDED, BOARDS, NOTHING, by_case, case_of, mean, paired
from experiments.cabin_model import misplaced_mm, model_row, taken
from experiments.depth_camera_cabin import STUDY, answer, trial
from experiments.runner.protocol import Finished
from experiments.runner.sweep import load_study, trials_of
from graphs.frames import Transform
from sfm_calib.depth.cloud import Cloud
from sfm_calib.errors import CalibrationError
from sfm_calib.simulate.cabin import Cabin, draw_cabin
from sfm_calib.simulate.rigs import SimulatedRig

CONFIG = Path(__file__).resolve().parent.parent / "configs/studies/depth_camera_cabin.yaml"
SMALL_SCAN = {"way": "scan", "scan_frames": 25, "features": 40}
UNCALIBRATED = {"way": "none", "intrinsics": "factory", "extrinsics": "hand"}
EXACT = {"way": "none", "intrinsics": "exact", "extrinsics": "exact"}


def some_cabin(seed: int = 0) -> Cabin:
    return draw_cabin(np.random.default_rng(seed), 2.0, 0.02)


def untimed(row):  # type: ignore[no-untyped-def]
    return {key: value for key, value in row.items() if not key.startswith("seconds")}


# ---- the answer, of rows whose answer is known ----------------------------------------------

CASES = [
    (UNCALIBRATED, 6.0, 25.0),
    ({"way": "boards", "intrinsics": "factory"}, 3.5, 3.0),
    ({"way": "boards"}, 1.04, 0.6),
    ({"way": "scan"}, 1.6, 2.0),
    ({"way": "scan", "scale": "none"}, 4.0, 6.0),
    ({"way": "scan_board"}, 1.05, 0.8),
    (EXACT, 1.0, 0.0),
]


def made_up(seeds: int = 6, **changed: tuple[float, float]) -> list[Finished[CabinOptions]]:
    """Trials with an RMS and a misplaced part by each case; changed: of a case by its name."""
    rng = np.random.default_rng(0)
    found = []
    for seed in range(seeds):
        for given, rms, off in CASES:
            options = CabinOptions.model_validate(given)
            rms, off = changed.get(case_of(options), (rms, off))
            row = {
                f"{prefix}{what}_mm": rms + 0.02 * rng.standard_normal()
                for prefix in ("", "registered_", "infrared_", "colour_")
                for what in ("mean", "rms", "p95", "max", "hausdorff")
            }
            row |= {"misplaced_mm": off, "registered_misplaced_mm": off, "refused": 0}
            found.append(Finished(options, seed, row, 1.0))
    return found


def test_what_holds_is_said_with_its_numbers() -> None:
    result = answer(made_up())
    assert result.holds is True
    assert result.verdict.startswith("yes: the head's RMS falls from 6.0 mm uncalibrated to 1.0")
    assert "6 of 6 heads fail to register" in result.verdict
    assert "a scan with one board reaches 1.0" in result.verdict and "\n" not in result.verdict
    assert {table.name for table in result.tables} == {
        "model", "registration", "devices", "calibration"
    }  # fmt: skip
    for table in result.tables:
        assert all(len(row) == len(table.columns) for row in table.rows)


@pytest.mark.parametrize(
    ("case", "numbers"),
    [
        (BOARDS, (6.5, 0.6)),  # boards make it worse
        (NOTHING, (6.0, 3.0)),  # places by hand register
        ("scan + one board", (1.5, 0.8)),  # a scan is no match
        ("places by boards, factory lenses", (1.0, 3.0)),  # lenses do nothing
    ],
)
def test_what_does_not_hold_turns_the_verdict(case: str, numbers: tuple[float, float]) -> None:
    result = answer(made_up(**{case: numbers}))
    assert result.holds is False
    assert not result.verdict.startswith("yes")


def scattered(case: str, scatter: float) -> list[Finished[CabinOptions]]:
    """RMS of one case up and down by so much, cabin by cabin; 0 on average."""
    return [
        replace(one, row={**one.row, "rms_mm": one.row["rms_mm"] + scatter * (-1) ** one.seed})
        if case_of(one.options) == case
        else one
        for one in made_up()
    ]


def test_what_scatters_too_much_is_neither_as_good_nor_worse() -> None:
    assert scan_for_boards(by_case(scattered(ADDED, 0.03)))[1] is True
    words, holds = scan_for_boards(by_case(scattered(ADDED, 0.4)))
    assert holds is None and "too few cabins to say whether as good" in words
    assert answer(scattered(ADDED, 0.4)).holds is None
    assert scan_for_boards(by_case(made_up(**{ADDED: (1.5, 0.8)})))[1] is False


def test_a_scan_and_boards_are_compared_in_the_cabins_that_both_have() -> None:
    """Of boards there is one cabin more, in which they fare ill."""
    trials = made_up()
    ill = next(one for one in trials if case_of(one.options) == BOARDS)
    more = replace(ill, seed=100, row={**ill.row, "rms_mm": 40.0})
    worse = made_up(**{ADDED: (1.5, 0.8)})
    assert scan_for_boards(by_case([*worse, more]))[1] is False
    assert scan_for_boards(by_case([*worse, more])) == scan_for_boards(by_case(worse))


@pytest.mark.parametrize(
    ("failed", "of", "often"), [(8, 8, True), (6, 8, None), (3, 8, None), (0, 8, False)]
)
def test_often_is_more_than_half_beyond_chance(failed: int, of: int, often: bool | None) -> None:
    options = CabinOptions.model_validate(UNCALIBRATED)
    trials = [
        Finished(options, seed, {"registered_misplaced_mm": 25.0 if seed < failed else 1.0}, 1.0)
        for seed in range(of)
    ]
    assert fails_by_hand(by_case(trials))[1] is often


@pytest.mark.parametrize("seeds", [0, 1, 3])
def test_too_few_trials_say_nothing(seeds: int) -> None:
    assert answer(made_up(seeds)).holds is None


def test_failed_and_missing_trials_are_told_and_do_no_harm() -> None:
    trials = made_up()
    for left_out in {case_of(one.options) for one in trials}:
        some = [one for one in trials if case_of(one.options) != left_out]
        assert answer(some).holds in (None, True)
        assert answer([one for one in trials if case_of(one.options) == left_out]).holds is None
    broken = [replace(one, row={}, error="no") if one.seed == 2 else one for one in trials]
    assert "7 of 42 trials failed" in answer(broken).verdict
    assert answer([replace(one, row={}, error="no") for one in trials]).holds is None


def test_differences_are_of_the_same_cabins() -> None:
    cases = by_case(made_up(4))
    shifted = [
        replace(one, row=dict(one.row) | {"rms_mm": 100.0 * one.seed}) for one in cases[BOARDS]
    ]
    more = [replace(one, row={"rms_mm": 100.0 * one.seed + 1.0}) for one in cases[NOTHING][::-1]]
    assert paired(more, shifted, "rms_mm") == (1.0, 0.0)
    assert mean(more, "rms_mm")[0] == 151.0 and mean(more, "rms_mm")[1] > 10


# ---- the config ----------------------------------------------------------------------------


def test_every_trial_of_the_config_is_a_case_of_its_own() -> None:
    config = load_study(CONFIG)
    trials = [one for one in trials_of(config) if one.seed == 0]
    names = [case_of(one.options) for one in trials]  # type: ignore[arg-type]
    assert len(set(names)) == len(names)
    assert {BOARDS, NOTHING} < set(names)
    assert STUDY.options is CabinOptions


def test_nothing_comes_of_nothing() -> None:
    with pytest.raises(ValidationError, match="way none calibrates nothing"):
        CabinOptions(way="none")
    with pytest.raises(ValidationError):
        CabinOptions(depth_noise=-1.0)


# ---- trials --------------------------------------------------------------------------------


def test_without_noise_the_true_rig_makes_the_head() -> None:
    row = trial(CabinOptions(**EXACT, depth_noise=0.0), 3)  # type: ignore[arg-type]
    assert row["max_mm"] < 0.05 and row["registered_misplaced_mm"] < 5  # type: ignore[operator]
    assert row["misplaced_mm"] < 1e-9  # type: ignore[operator]
    painted = np.array(row["painted_mm"])
    assert 0.4 < np.mean(painted >= 0) < 0.9 and painted.max() < 0.05


@pytest.mark.slow
def test_a_trial_depends_on_its_seed_alone_and_an_uncalibrated_cabin_is_worse() -> None:
    exact = CabinOptions(**EXACT)  # type: ignore[arg-type]
    row = trial(exact, 1)
    assert untimed(row) == untimed(trial(exact, 1))
    worse = trial(CabinOptions(**UNCALIBRATED), 1)  # type: ignore[arg-type]
    assert worse["rms_mm"] > 2 * row["rms_mm"]  # type: ignore[operator]
    assert worse["colour_rms_mm"] > row["colour_rms_mm"]  # type: ignore[operator]


def test_a_scan_calibrates_the_cabin_as_well_as_it_says() -> None:
    cabin, options = some_cabin(), CabinOptions.model_validate(SMALL_SCAN)
    found = calibrate_cabin(cabin, options, np.random.default_rng(0))
    again = calibrate_cabin(cabin, options, np.random.default_rng(0))
    assert np.array_equal(found.error, again.error)
    assert len(found.names) == 6 * 9 + 5 * 6
    assert 0.5 < found.nees < 1.6
    focal = [abs(found.error[i]) for i, n in enumerate(found.names) if n.endswith("red.fx")]
    assert len(focal) == 3 and max(focal) < 5.0  # px; the factory's are no better


def test_without_a_length_the_places_by_hand_give_it() -> None:
    cabin, options = some_cabin(), CabinOptions.model_validate(SMALL_SCAN | {"scale": "none"})
    found = calibrate_cabin(cabin, options, np.random.default_rng(0))
    a, b = (found.rig.cam_from_rig[i].inverse.translation for i in (0, 4))
    c, d = (cabin.nominal.cam_from_rig[i].inverse.translation for i in (0, 4))
    assert np.linalg.norm(a - b) == pytest.approx(np.linalg.norm(c - d))
    assert 0.5 < found.nees < 1.6  # in units of a baseline, of which nothing is exact but one


def test_one_board_gives_a_scan_its_lengths() -> None:
    cabin, options = some_cabin(), CabinOptions.model_validate(SMALL_SCAN | {"way": "scan_board"})
    found = calibrate_cabin(cabin, options, np.random.default_rng(0))
    for side in cabin.infrared[1:]:
        here, there = (
            rig.cam_from_rig[side].inverse.translation for rig in (found.rig, cabin.true)
        )
        ratio = np.linalg.norm(here) / np.linalg.norm(there)
        assert ratio == pytest.approx(1.0, abs=0.01)


def test_held_lenses_stay_the_factorys() -> None:
    cabin = some_cabin()
    options = CabinOptions.model_validate(SMALL_SCAN | {"intrinsics": "factory"})
    found = calibrate_cabin(cabin, options, np.random.default_rng(0))
    for camera, factory in zip(found.rig.cameras, cabin.nominal.cameras, strict=True):
        assert np.allclose(camera.params, factory.params, rtol=0, atol=1e-12)
    assert len(found.names) == 5 * 6


def test_the_board_is_shown_to_devices_and_to_pairs() -> None:
    views = show_board(some_cabin(), 2, 1, np.random.default_rng(0))
    assert len(views.frames) == 2 * 3 + 2
    seeing = [{view.camera for view in views.views if view.frame == f} for f in range(8)]
    assert all({2 * (f // 2), 2 * (f // 2) + 1} <= seeing[f] for f in range(6))
    assert {0, 1, 2, 3} <= seeing[6] and {0, 1, 4, 5} <= seeing[7]


@pytest.mark.slow
def test_boards_calibrate_the_cabin_as_well_as_they_say() -> None:
    nees = []
    for seed in range(4):
        options = CabinOptions(alone=12, together=6)
        found = calibrate_cabin(some_cabin(seed), options, np.random.default_rng(seed))
        nees.append(found.nees)
    assert 0.6 < np.mean(nees) < 1.4


# ---- what is measured ----------------------------------------------------------------------


def test_a_part_that_is_misplaced_is_measured_beside_the_front_one() -> None:
    rng = np.random.default_rng(0)
    points, camera = rng.uniform(-0.1, 0.1, (60, 3)), np.repeat([0, 1, 2], 20)
    exact = Cloud(points, camera)
    turned = Transform.exp(np.array([0.2, -0.1, 0.3]), np.array([0.5, 0.0, 0.1]))
    assert misplaced_mm(Cloud(turned @ points, camera), exact) < 1e-9
    off = points + np.where(camera[:, None] == 2, [0.003, 0.0, 0.004], 0.0)
    assert misplaced_mm(Cloud(turned @ off, camera), exact) == pytest.approx(5.0)


def test_a_device_that_is_shifted_shows_in_the_model() -> None:
    cabin = some_cabin()
    scene = taken(cabin, np.random.default_rng(0), 0.0)
    places = list(cabin.true.cam_from_rig)
    places[2] = Transform(np.eye(3), np.array([0.0, 0.0, 0.01])) @ places[2]
    row = model_row(scene, SimulatedRig(cabin.true.cameras, tuple(places)))
    assert row["misplaced_mm"] == pytest.approx(10.0, abs=1e-3)
    assert 1.0 < row["mean_mm"] < 10.0  # type: ignore[operator]
    assert row["infrared_rms_mm"] < 0.05  # type: ignore[operator]


def test_without_open3d_a_trial_says_so_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise CalibrationError("depth images needs open3d: pip install 'sfm_calib[depth]'")

    monkeypatch.setattr(depth_images, "import_open3d", missing)
    with pytest.raises(CalibrationError, match="open3d") as refused:
        trial(CabinOptions(**EXACT), 0)  # type: ignore[arg-type]
    assert "\n" not in str(refused.value)

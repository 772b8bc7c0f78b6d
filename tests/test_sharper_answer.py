"""The answer of the study of sharper tracks, on rows made up so that it is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from experiments.runner.protocol import Answer, Finished
from experiments.sharper_answer import answer
from experiments.sharper_kinds import FOCAL, RAW, Kind, cases_of, gain, mean_square_of, square_of
from experiments.sharper_trial import SharperOptions, SharperTrial

NAMES = ["cam0.fx", "cam0.fy", "cam0.cx", "cam0.cy", "cam1.rotation_x"]
RENDERED: dict[str, Any] = {"simulate": "images", "simulate.trajectory": "orbit"}
REAL: dict[str, Any] = {"scan": "scans/hall", "name": "hall"}
REFINED: dict[str, Any] = {"refine": True}
HALF: dict[str, Any] = {"refine": True, "image_scale": 0.5}
Trials = list[Finished[SharperOptions]]


def made(how: dict[str, Any], size: float, seeds: int = 6, **changes: Any) -> Trials:
    """Trials of one kind, everything of which is `size` times that of raw SIFT, nearly."""
    options = SharperTrial.model_validate(how)
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)  # the same scan for all kinds
        errors = rng.standard_normal(len(NAMES))
        row: dict[str, Any] = {
            "noise_true_px": 0.3 * size, "noise_true_90_px": size, "noise_px": 0.3 * size,
            "residual_px": 0.3 * size, "halves_px": size,
            "n_images": 20, "n_tracks": 500, "n_observations": 4000, "inflation": 1.5,
            "names": NAMES, "error": (size * errors).tolist(), "sigma": [size] * 5,
            "sigma_noise": [size / 1.5] * 5, "sigma_reference": [0.0] * 5,
            "seconds_features": 4.0, "seconds_matches": 2.0, "seconds_mapping": 3.0,
            "seconds_solve": 1.0, "nees_stated": 1.0 + 0.1 * rng.standard_normal(),
            "nees_noise": 2.2, "z_rms": 1.0,
        }  # fmt: skip
        if options.said.get("refine"):
            row |= {"seconds_features": None, "seconds_patches": 5.0}
        found.append(Finished(options, seed, row | changes, 10.0))
    return found


def rendered(size: float = 0.3, **changes: Any) -> Trials:
    """Raw SIFT, and refined tracks so many times sharper."""
    return [*made(RENDERED, 1.0), *made(RENDERED | REFINED, size, **changes)]


def requirement(found: Answer, what: str, tracks: str = "SIFT, refined") -> Sequence[Any]:
    """Found, its standard error, and whether that is enough."""
    (row,) = (row for row in found.tables[0].rows if row[1:3] == (tracks, what))
    return row[4:]


# ---- kinds and gains -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("how", "name"),
    [
        ({}, "SIFT"),
        ({"refine": False, "image_scale": 1.0}, "SIFT"),
        (REFINED, "SIFT, refined"),
        (HALF, "SIFT, in images of 0.5, refined"),
        ({"refine": True, "device": "cuda"}, "SIFT, refined, on cuda"),
    ],
)
def test_kinds_are_told_by_what_makes_the_tracks(how: dict[str, Any], name: str) -> None:
    kind = Kind.of(SharperTrial.model_validate(RENDERED | {"max_features": 500} | how))
    assert kind.name == name and (kind == RAW) == (name == "SIFT")


def test_learned_kinds_have_names_too() -> None:
    assert Kind("xfeat", "lightglue", 1.0, True).name == "XFeat, by lightglue, refined"
    assert Kind("aliked", weights="aliked.pth").name == "ALIKED, weights aliked.pth"


def test_other_options_part_scans() -> None:
    """Kinds are compared among trials that differ in nothing else."""
    some = {**RENDERED, "max_features": 500}
    trials = [*rendered(), *made(some, 1.0), *made(some | REFINED, 0.2)]
    cases = cases_of(trials)
    assert [case.name for case in cases] == ["orbit, max_features None", "orbit, max_features 500"]
    assert [len(list(case.pairs(Kind(refined=True)))) for case in cases] == [6, 6]


def test_a_gain_is_of_the_same_seeds_and_a_mean_over_scans() -> None:
    refined = Kind(refined=True)
    noise = square_of("noise_true_px")
    one = cases_of([*made(RENDERED, 1.0), *made(RENDERED | REFINED, 0.25, seeds=3)])
    value = gain(one, refined, noise)
    assert value is not None and value == pytest.approx((4.0, 0.0), abs=1e-9)
    focal = gain(one, refined, mean_square_of("error", FOCAL))
    assert focal is not None and focal[0] == pytest.approx(4.0)  # of the same errors
    other = {**RENDERED, "simulate.trajectory": "corridor"}
    trials = [*rendered(0.25), *made(other, 9.0), *made(other | REFINED, 9.0)]
    both = gain(cases_of(trials), refined, noise)
    assert both is not None and both[0] == pytest.approx(2.0)  # of 4 and 1
    assert gain(cases_of(made(RENDERED | REFINED, 0.25)), refined, noise) is None


def test_a_gain_that_scatters_has_a_standard_error() -> None:
    """Ratios of squared errors of six scans, each with its own errors."""
    trials = made(RENDERED, 1.0)
    for one in made(RENDERED | REFINED, 0.5):
        errors = 0.5 * np.random.default_rng(100 + one.seed).standard_normal(len(NAMES))
        trials.append(Finished(one.options, one.seed, {**one.row, "error": errors.tolist()}, 1.0))
    value = gain(cases_of(trials), Kind(refined=True), mean_square_of("error", FOCAL))
    assert value is not None and value[1] is not None
    assert 0.2 < value[1] < 2 and abs(value[0] - 2) < 3 * value[1]


# ---- rendered scans ------------------------------------------------------------------------


def test_tracks_that_reach_everything() -> None:
    found = answer(rendered())
    assert found.holds is True and found.verdict.startswith("yes: rendered (orbit): SIFT, refined:")
    assert "true noise 3.33 ± 0.00 (2.5 times smaller: yes)" in found.verdict
    assert "noise alone (raw SIFT 1.5 times)" in found.verdict
    assert [one.name for one in found.figures] == ["noise", "gain_rendered", "nees", "seconds"]
    assert [one.name for one in found.tables] == ["requirements", "tracks", "parameters", "seconds"]


@pytest.mark.parametrize(
    ("size", "changes", "misses"),
    [
        (0.45, {}, {"true noise"}),
        (0.8, {"noise_true_px": 0.1}, {"focal error", "principal point error"}),
        (0.3, {"nees_stated": 1.6}, {"NEES"}),
        (0.3, {"nees_stated": 0.5}, {"NEES"}),
    ],
)
def test_what_is_not_reached_is_said(size: float, changes: Any, misses: set[str]) -> None:
    found = answer(rendered(size, **changes))
    assert found.holds is False and found.verdict.startswith("no: ")
    of = ("true noise", "focal error", "principal point error", "NEES")
    assert {what for what in of if requirement(found, what)[-1] == "no"} == misses


def test_of_two_sizes_the_full_one_decides_but_for_the_time() -> None:
    """Features of half size: 1 s, patches 2 s; features of full size: 4 s."""
    quick = made(RENDERED | {"image_scale": 0.5}, 1.2, seconds_features=1.0)
    rough = made(RENDERED | HALF, 0.9, seconds_patches=2.0)
    found = answer([*rendered(), *quick, *rough])
    half = "SIFT, in images of 0.5, refined"
    what = "time of features and patches over that of features in full size"
    assert found.holds is True
    assert requirement(found, "true noise", half)[-1] == "no"
    assert requirement(found, what, half)[0] == pytest.approx(0.75)
    slow = answer([*rendered(), *quick, *made(RENDERED | HALF, 0.3, seconds_patches=4.0)])
    assert slow.holds is False and f"{what} 1.25 ± 0.00 (1 at most: no)" in slow.verdict
    unknown = [*rendered(), *made(RENDERED | HALF, 0.3, seconds_patches=None)]
    assert answer(unknown).holds is True and what not in answer(unknown).verdict


def test_seconds_are_those_of_the_trial_that_did_it() -> None:
    """Refined tracks share features and mapping with raw ones, and do patches themselves."""
    table = {one.name: one for one in answer(rendered()).tables}["seconds"]
    rows = {row[1]: row[2:] for row in table.rows}
    assert rows["SIFT"] == (4.0, 2.0, 3.0, None, 1.0)
    assert rows["SIFT, refined"] == (4.0, 2.0, 3.0, 5.0, 1.0)


def test_too_few_say_nothing() -> None:
    few = [*made(RENDERED, 1.0, seeds=3), *made(RENDERED | REFINED, 0.3, seeds=3)]
    found = answer(few)
    assert found.holds is None and "3 seeds of 4 needed" in found.verdict
    alone = answer(made(RENDERED, 1.0))
    assert alone.holds is None and "nothing refined beside raw SIFT" in alone.verdict
    assert answer([]).holds is None


def test_trials_that_fail_are_told_and_the_others_judged() -> None:
    """Such as all with features whose weights are missing."""
    options = SharperTrial.model_validate(RENDERED | {"refine": True, "image_scale": 0.25})
    failed = [Finished(options, seed, {}, 1.0, "no weights") for seed in range(6)]
    found = answer([*rendered(), *failed])
    assert found.holds is True and "6 of 18 trials failed" in found.verdict
    assert found.tables[-1].name == "failed" and len(found.tables[-1].rows) == 6
    assert found.tables[-1].rows[0][-1] == "no weights"
    nothing = answer(failed)
    assert nothing.holds is None and nothing.verdict == "none of 6 trials went well"


# ---- real scans ----------------------------------------------------------------------------


def real(size: float, **changes: Any) -> Trials:
    """One seed, as the same scan needs no more."""
    return [*made(REAL, 1.0, 1), *made(REAL | REFINED, size, 1, **changes)]


def test_real_scans_have_requirements_of_their_own() -> None:
    found = answer(real(0.5))
    assert found.holds is True and found.verdict.startswith("yes: real (hall): SIFT, refined:")
    assert "sigma_px 2.00 (1.5 times smaller: yes)" in found.verdict
    assert [one.name for one in found.figures] == ["noise", "gain_real", "nees", "seconds"]
    assert answer(real(0.5, halves_px=0.9)).holds is False
    assert answer(real(0.8)).holds is False  # sigma_px and halves 1.25 times smaller


def test_no_difference_counts_within_the_references_own_sigma() -> None:
    """As near as the reference is right: beyond that it is not known which of them is."""
    worse = [1.5 * one for one in made(REAL, 1.0, 1)[0].row["error"]]  # type: ignore[union-attr]
    assert answer(real(0.5, error=worse)).holds is False
    found = answer(real(0.5, error=worse, sigma_reference=[5.0] * 5))
    assert found.holds is True
    assert requirement(found, "focal difference")[-1] == "yes, within the reference's own sigma"


def test_rendered_and_real_scans_are_judged_apart() -> None:
    found = answer([*rendered(), *real(0.8)])
    assert found.holds is False
    assert requirement(found, "true noise")[-1] == "yes"
    assert requirement(found, "sigma_px")[-1] == "no"

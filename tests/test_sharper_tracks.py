"""Trials of the study of sharper tracks: true noise where it is known, seconds, options."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from synthetic.problems import projected, small_problem

from experiments.runner.sweep import load_study, trials_of
from experiments.sharper_kinds import RAW, Kind
from experiments.sharper_tracks import STUDY, inputs
from experiments.sharper_trial import (
    SharperOptions,
    SharperTrial,
    TimedCache,
    from_numbers,
    measured_anew,
    second_halves,
    seconds,
    trial,
)
from experiments.true_noise import true_estimate, true_frames, true_noise
from graphs.problem import Estimate, Problem
from sfm_calib.config import BaselineConfig, Options, RigConfig, ScaleConfig, first_problem
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.ours import rig_of
from sfm_calib.result import Calibration, Noise, Solve, truth
from sfm_calib.simulate.rigs import make_rig

ROOT = Path(__file__).parents[1]
RENDERED: dict[str, Any] = {"simulate": "images", "simulate.trajectory": "orbit", "lens": "radial"}
REAL: dict[str, Any] = {"scan": "scans/hall", "name": "hall"}


def options(**given: Any) -> SharperOptions:
    return SharperTrial.model_validate(given)


# ---- true noise ----------------------------------------------------------------------------


def noisy(sigma_px: float, seed: int = 0) -> tuple[Problem, Estimate]:
    """A problem whose start is off by pixels, and the truth of its cameras and frames."""
    problem, true = small_problem(points=500, frames=10, sigma_px=sigma_px, seed=seed)
    return problem, replace(true, points=np.zeros((0, 3)))


@pytest.mark.parametrize("sigma_px", [0.02, 0.5])
def test_the_true_noise_is_what_the_observations_were_drawn_with(sigma_px: float) -> None:
    """Of six to twelve observations a point takes three numbers: they are given back."""
    found = true_noise(*noisy(sigma_px))
    assert found.sigma_px == pytest.approx(sigma_px, rel=0.03)
    assert found.weighed_px == pytest.approx(sigma_px, rel=0.03)
    assert found.quantile_px == pytest.approx(sigma_px * (2 * np.log(10)) ** 0.5, rel=0.04)


def test_mismatches_are_in_the_quantile_and_hardly_in_the_sigma() -> None:
    problem, true = noisy(0.2)
    rng = np.random.default_rng(1)
    wrong = rng.random(len(problem.observations)) < 0.15
    pixels = problem.observations.pixels + 10 * wrong[:, None] * rng.standard_normal(
        (len(wrong), 2)
    )
    found = true_noise(
        replace(problem, observations=replace(problem.observations, pixels=pixels)), true
    )
    assert found.sigma_px == pytest.approx(0.2, rel=0.25)
    assert found.quantile_px > 5 * found.sigma_px


def test_weighed_noise_is_that_of_relative_sigma_one() -> None:
    problem, whole = small_problem(points=500, frames=10)
    seen, rng = problem.observations, np.random.default_rng(2)
    relative = np.where(rng.random(len(seen)) < 0.3, 5.0, 1.0)
    errors = 0.1 * relative[:, None] * rng.standard_normal((len(seen), 2))
    pixels = projected(whole, seen) + errors
    true = replace(whole, points=np.zeros((0, 3)))
    weighed = replace(problem, observations=replace(seen, pixels=pixels, relative_sigma=relative))
    found = true_noise(weighed, true)
    assert found.weighed_px == pytest.approx(0.1, rel=0.05)
    assert found.sigma_px > 0.12


def test_another_truth_shows() -> None:
    """Cameras that are not the true ones leave errors that points cannot take."""
    problem, true = noisy(0.1)
    bent = replace(true.cameras[0], params=true.cameras[0].params * [1.01, 1, 1, 1, 1, 1])
    assert true_noise(problem, replace(true, cameras=(bent, *true.cameras[1:]))).sigma_px > 0.15


def test_the_truth_is_brought_into_the_problems_order(tmp_path: Path) -> None:
    problem, true = noisy(0.1)
    backwards = truth(list(true.cameras)[::-1], list(true.cam_from_rig)[::-1], "0")
    record = {
        name: {"rotation_wxyz": placed.rotation_wxyz.tolist(), "translation": [*placed.translation]}
        for name, placed in zip(problem.frame_names, true.rig_from_world, strict=True)
    }
    path = tmp_path / "truth_frames.json"
    path.write_text(json.dumps(record))
    found = true_estimate(problem, rig_of(backwards, path), true_frames(path))
    assert true_noise(problem, found).sigma_px == pytest.approx(0.1, rel=0.03)
    some = {name: one for name, one in true_frames(path).items() if name != "000003"}
    with pytest.raises(CalibrationError, match="no frame '000003'"):
        true_estimate(problem, rig_of(backwards, path), some)
    path.write_text("[]")
    with pytest.raises(CalibrationError, match=r"cannot read the true frames from .*json"):
        true_frames(path)


# ---- parts of a trial ----------------------------------------------------------------------


def test_halves_take_one_of_every_two_blocks() -> None:
    block = np.repeat(np.arange(5), 2)
    every = second_halves(block, 100, np.random.default_rng(0))
    assert len({tuple(half) for half in every}) == len(every) == 4  # of three pairs, and no twin
    for half in every:
        of_block = half.reshape(5, 2)
        assert (of_block[:, 0] == of_block[:, 1]).all()  # a block stays whole
        assert of_block[0, 0] != of_block[1, 0] and of_block[2, 0] != of_block[3, 0]
        assert not any((~half == other).all() for other in every)
    drawn = {tuple(second_halves(block, 1, np.random.default_rng(seed))[0]) for seed in range(30)}
    assert len(drawn) == 4
    assert second_halves(np.zeros(3, np.int64), 4, np.random.default_rng(0)) == []


def test_a_stage_has_seconds_where_it_was_made_alone(tmp_path: Path) -> None:
    def make(place: Path) -> None:
        (place / "file").write_text("made")

    first, second = (TimedCache(tmp_path, shared=True) for _ in range(2))
    for cache, name in ((first, "features"), (second, "features"), (second, "models")):
        assert (cache.stage(name, [1], make) / "file").read_text() == "made"
    assert first.seconds["features"] is not None and second.seconds["features"] is None
    stages = {"matching patches": 3.0, "solving": 1.0, "covariance": 0.5, "tracks and mapping": 9.0}
    row = seconds(solved(stages), second.seconds | {"patches": 2.0})
    assert row["seconds_features"] is None and row["seconds_matches"] is None
    assert row["seconds_mapping"] == second.seconds["models"]
    assert (row["seconds_patches"], row["seconds_solve"]) == (3.0, 1.5)
    again = seconds(solved(stages), {"patches": None})
    assert again["seconds_patches"] is None
    assert "seconds_patches" not in seconds(solved({"solving": 1.0}), {})


def solved(stages: Mapping[str, float]) -> Calibration:
    rig = make_rig("stereo")
    found = truth(list(rig.cameras), list(rig.cam_from_rig), "0")
    told = Solve(
        converged=True, reason="", iterations=1, rms_px=1.0, n_frames=1, n_images=1, n_points=1,
        n_observations=1, seconds=dict(stages),
    )  # fmt: skip
    return found.model_copy(update={"solve": told})


def test_a_baseline_is_measured_with_its_error() -> None:
    """And with the same error for all tracks of one scan."""
    one = BaselineConfig(cameras=("cam0", "cam1"), length_m=0.2, sigma_m=0.001)
    config = RigConfig(scale=ScaleConfig(baseline=(one,)))
    drawn = [measured_anew(config, seed).scale.baseline[0].length_m for seed in range(100)]
    assert np.mean(drawn) == pytest.approx(0.2, abs=0.0003)
    assert np.std(drawn) == pytest.approx(0.001, rel=0.2)
    assert drawn[7] == measured_anew(config, 7).scale.baseline[0].length_m
    assert measured_anew(RigConfig(), 0) == RigConfig()


def test_numbers_of_a_reference_are_compared_as_they_are() -> None:
    rig = make_rig("stereo")
    found = truth(list(rig.cameras), list(rig.cam_from_rig), "0")
    found = found.model_copy(update={"noise": Noise(sigma_px=1.0)})
    fx = rig.cameras[1].params[0]
    angle = np.degrees(np.arccos((np.trace(rig.cam_from_rig[1].rotation) - 1) / 2))
    reference = {"cam1": {"fx": (fx - 2, 0.5), "rotation_deg": angle + 0.1}}
    errors = {one.name: one for one in from_numbers(found, reference)}
    assert errors["cam1.fx"].error == pytest.approx(2)
    assert errors["cam1.fx"].sigma_reference == 0.5
    assert errors["cam1.rotation_deg"].error == pytest.approx(-0.1)
    with pytest.raises(CalibrationError, match="no camera 'cam3'"):
        from_numbers(found, {"cam3": {"fx": 1.0}})
    with pytest.raises(CalibrationError, match="cam0 is radial, which has no p1"):
        from_numbers(found, {"cam0": {"p1": 0.0}})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::numba.core.errors.NumbaWarning")  # of an old TBB
def test_refined_tracks_of_a_rendered_scan_are_sharper(tmp_path: Path) -> None:
    """One scan both ways: in truth, and as stated; and the second shares what the first made."""
    for extra, library in (("depth", "open3d"), ("learned", "torch"), ("learned", "kornia")):
        pytest.importorskip(library, reason=f"it needs {library} (the extra `{extra}`)")
    small = {"simulate.rig": "stereo", "simulate.frames": 8, "simulate.size": (320, 240)}
    given = {**RENDERED, **small, "simulate.supersampling": 2, "max_features": 500, "halves": 2}
    rows = [
        trial(options(**given, refine=refine), 0, tmp_path / f"{refine}")
        for refine in (False, True)
    ]
    raw, refined = ({k: v for k, v in row.items() if isinstance(v, float)} for row in rows)
    assert raw["noise_true_px"] > 2 * refined["noise_true_px"] > 0.01
    for one in (raw, refined):
        assert one["noise_true_px"] == pytest.approx(one["residual_px"], rel=0.2)
        assert 0 < one["nees_stated"] < 4 and one["halves_px"] > 0
    assert raw["seconds_features"] > 0 and rows[1]["seconds_features"] is None
    assert refined["seconds_patches"] > 0 and "seconds_patches" not in raw
    names = list(rows[0]["names"])  # type: ignore[call-overload]
    assert {"cam0.fx", "cam1.cy", "cam1.rotation_x", "cam1.translation_z"} <= set(names)
    assert all(len(rows[0][k]) == len(names) for k in ("error", "sigma", "sigma_noise"))  # type: ignore[arg-type]


# ---- options -------------------------------------------------------------------------------


def test_every_option_of_calibrate_may_be_swept() -> None:
    assert set(Options.model_fields) - {"seed"} <= set(SharperTrial.model_fields)
    one = options(**RENDERED, refine=True, image_scale=0.5, max_features=300)
    assert one.given(Options) == {
        "refine": True, "image_scale": 0.5, "max_features": 300, "lens": "radial"
    }  # fmt: skip
    assert one.halves == 4 and not one.report
    assert SharperTrial.model_validate_json(one.model_dump_json()) == one


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"simulate": "tracks"}, "simulated tracks have no patches"),
        ({"scan": "a", "command": "target", "board": "b"}, "compares calibrate's"),
        ({"scan": "a", "refined": True}, "did you mean 'refine'"),
        ({"scan": "a", "reference_params": {"left": {"fxx": 3.0}}}, "did you mean 'fx'"),
        ({**RENDERED, "reference_params": {"left": {"fx": 3.0}}}, "for a scan without a truth"),
        ({"scan": "a", "reference_params": {"left": {"fx": [3.0, -1.0]}}}, "reference_params"),
    ],
)
def test_bad_options_are_refused_with_a_remedy(given: dict[str, Any], says: str) -> None:
    with pytest.raises(ValidationError) as refused:
        options(**given)
    assert re.search(says, first_problem(refused.value, model=SharperTrial))


def test_a_scan_that_is_not_there_is_said(tmp_path: Path) -> None:
    one = options(scan=tmp_path / "nowhere", lens="radial")
    with pytest.raises(CalibrationError, match=r"no such scan: .*nowhere"):
        trial(one, 0, tmp_path / "trial")
    assert inputs(one) == (tmp_path / "nowhere",)


@pytest.mark.parametrize(
    "path", ["configs/studies/sharper_tracks.yaml", "configs/sharper_tracks_real.yaml"]
)
def test_configs_have_raw_sift_beside_the_others(path: str) -> None:
    trials = trials_of(load_study(ROOT / path))
    scans: dict[str, set[Kind]] = {}
    for one in trials:
        assert isinstance(one.options, SharperOptions)
        name = one.options.name or str(one.options.said["simulate.trajectory"])
        scans.setdefault(name, set()).add(Kind.of(one.options))
    assert len(scans) == 2
    for kinds in scans.values():
        assert {RAW, replace(RAW, refined=True)} < kinds
        assert replace(RAW, refined=True, image_scale=0.5) in kinds
    assert STUDY.options is SharperTrial

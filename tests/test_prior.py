"""From a calibration file, words and a scan's cameras to what the graph is given."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic.earlier import NAMES, old, scan
from synthetic.scans import silent

from graphs.covariance import NOTHING, Covariance
from graphs.frames import Transform
from graphs.pose_covariance import rereferenced
from graphs.problem import Estimate, PriorMode
from graphs.propagation import lens_names, marginal, pose_names
from sfm_calib.calibrate import Stopwatch, determine, options_of
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.reading import NO_SIZE, CameraRig, LengthUnit
from sfm_calib.images import Scan
from sfm_calib.mapping import Mapped
from sfm_calib.nominal import lens_priors, start_from_config
from sfm_calib.prior import checked, freed, prior_of, started, with_lenses
from sfm_calib.result import Calibration
from sfm_calib.run import Given

CAMERAS = old().estimate.cameras
SIZES = {camera.name: camera.size for camera in CAMERAS}


def read(covariance: Covariance | None = None) -> CameraRig:
    return CameraRig(
        Path("old.json"),
        "sfm_calib/1",
        CAMERAS,
        old().estimate.cam_from_rig,
        "m",
        old().covariance if covariance is None else covariance,
    )


# ---- words ----------------------------------------------------------------------------------


def test_words_free_what_they_name() -> None:
    everything = {n for c in CAMERAS for n in lens_names(c)}
    everything |= {n for c in CAMERAS[1:] for n in pose_names(c.name)}
    cases = {
        "all": everything,
        "intrinsics": {n for c in CAMERAS for n in lens_names(c)},
        "extrinsics": {n for c in CAMERAS[1:] for n in pose_names(c.name)},
        "rotation": {n for c in CAMERAS[1:] for n in pose_names(c.name)[:3]},
        "cam2.translation": set(pose_names("cam2")[3:]),
        "cam1": {*lens_names(CAMERAS[1]), *pose_names("cam1")},
        "focal": {f"{n}.{p}" for n in NAMES for p in ("fx", "fy")},
        "cam0.principal_point": {"cam0.cx", "cam0.cy"},
        "cam1.distortion": {"cam1.k1", "cam1.k2"},
        "k1": {"cam0.k1", "cam1.k1", "cam2.k1"},
        "cam2.cx": {"cam2.cx"},
    }
    for word, expected in cases.items():
        assert freed([word], CAMERAS, "cam0") == expected, word
    both = freed(["cam1.rotation", "cam2.focal"], CAMERAS, "cam0")
    assert both == {*pose_names("cam1")[:3], "cam2.fx", "cam2.fy"}
    assert freed([], CAMERAS, "cam0") == frozenset()


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("rotations", "did you mean 'rotation'"),
        ("cam9", "did you mean 'cam"),
        ("cam1.rotaton", "of cam1: did you mean 'rotation'"),
        ("cam1.p1", "of cam1"),
        ("cam0", "--reference"),
        ("cam0.rotation", "--reference"),
        ("", "nothing is called so"),
    ],
)
def test_other_words_are_refused_in_one_line(word: str, said: str) -> None:
    with pytest.raises(CalibrationError) as error:
        freed([word], CAMERAS, "cam0")
    assert said in str(error.value) and "\n" not in str(error.value)


def test_a_lone_camera_is_its_lens() -> None:
    assert freed(["cam0"], CAMERAS[:1], "cam0") == set(lens_names(CAMERAS[0]))


# ---- files ------------------------------------------------------------------------------------


def test_sizes_come_from_the_scan_where_the_file_has_none() -> None:
    sizeless = replace(read(), cameras=tuple(replace(c, size=NO_SIZE) for c in CAMERAS))
    assert [c.size for c in checked(sizeless, SIZES).cameras] == list(SIZES.values())
    assert checked(read(), {"cam1": SIZES["cam1"]}).names == NAMES  # missing cameras stay


def test_what_does_not_fit_the_scan_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"320 x 240 px.*640 x 480 px"):
        checked(read(), {"cam0": (320, 240)})
    with pytest.raises(CalibrationError, match="none is in both"):
        checked(read(), {"left": (640, 480)})
    with pytest.raises(CalibrationError, match="does not say how its 3 cameras sit"):
        checked(replace(read(), cam_from_rig=None), SIZES)
    with pytest.raises(CalibrationError, match="states no sigmas"):
        prior_of(read(NOTHING), "full", ["all"], NAMES, "cam0")
    with pytest.raises(CalibrationError, match="reference camera left"):
        prior_of(read(), "full", ["all"], ("left", "cam1"), "left")


def test_lenses_are_those_of_the_file() -> None:
    config = RigConfig.model_validate({"cameras": {"cam1": {"fixed": ["k2"]}}})
    told = with_lenses(config, read(), ("cam0", "cam1", "new"))
    assert told.cameras["cam0"].lens == told.cameras["cam1"].lens == "radial"
    assert told.cameras["cam1"].fixed == ("k2",)
    assert set(told.cameras) == {"cam0", "cam1"}
    other = RigConfig.model_validate({"cameras": {"cam0": {"lens": "brown"}}})
    with pytest.raises(CalibrationError, match="cam0 the lens brown"):
        with_lenses(other, read(), NAMES)


def test_another_reference_and_missing_cameras() -> None:
    """cam0 is not in the scan, which has a camera that is new; its frame is cam2's."""
    prior = prior_of(read(), "full", ["all"], ("cam1", "cam2", "new"), "cam2")
    assert [camera.name for camera in prior.cameras] == ["cam1", "cam2"]
    seen, whole = rereferenced(old().estimate, old().covariance, 2)
    expected = marginal(
        whole, [*lens_names(CAMERAS[1]), *lens_names(CAMERAS[2]), *pose_names("cam1")]
    )
    ours = marginal(prior.covariance, expected.names)
    assert set(prior.covariance.names) == set(expected.names)
    np.testing.assert_array_equal(ours.matrix, expected.matrix)
    np.testing.assert_array_equal(
        prior.cam_from_rig[0].translation, seen.cam_from_rig[1].translation
    )
    assert prior.reference == "cam2" and not prior.held


def test_places_stated_in_part_are_not_taken_for_exact() -> None:
    names = [n for n in old().covariance.names if not n.startswith("cam1.translation")]
    part = read(marginal(old().covariance, names))
    told = prior_of(part, "full", ["all"], NAMES, "cam2").covariance.names
    assert not set(pose_names("cam1")) & set(told)
    assert set(pose_names("cam0")) <= set(told)


# ---- into the problem ---------------------------------------------------------------------------


def test_a_problem_starts_from_it_in_metres() -> None:
    problem, _ = scan()
    problem = replace(problem, initial=problem.initial.scaled(5.0))
    prior = prior_of(read(), "full", ["cam1"], NAMES, "cam0")
    start = started(problem, prior)
    assert start.metric and start.prior is prior
    for camera, known in zip(start.initial.cameras, CAMERAS, strict=True):
        assert camera is known
    held = start.initial.cam_from_rig[2]
    np.testing.assert_array_equal(held.translation, prior.cam_from_rig[2].translation)
    free = start.initial.cam_from_rig[1]
    ratio = np.linalg.norm(free.translation) / np.linalg.norm(prior.cam_from_rig[1].translation)
    assert ratio == pytest.approx(1, abs=0.1)


def test_without_metres_a_problem_keeps_its_unit() -> None:
    problem, _ = scan()
    baseline = replace(read(), unit="baseline")
    start = started(problem, prior_of(baseline, "full", ["rotation"], NAMES, "cam0"))
    assert not start.metric
    np.testing.assert_array_equal(start.initial.points, problem.initial.points)
    now, was = (np.linalg.norm(one.initial.cam_from_rig[1].translation) for one in (start, problem))
    assert now == pytest.approx(was, rel=0.1)


def test_options_ask_the_problem_for_what_is_believed() -> None:
    problem, _ = scan()
    config = RigConfig()
    without = options_of(problem, config).lens_priors
    for ours, generic in zip(without, lens_priors(problem.initial, config), strict=True):
        np.testing.assert_array_equal(ours.mean, generic.mean)
        np.testing.assert_array_equal(ours.information(), generic.information())
    prior = prior_of(read(), "weak", ["extrinsics", "cam1.focal"], NAMES, "cam0")
    told = options_of(started(problem, prior), config).lens_priors
    assert [int(one.free.sum()) for one in told] == [0, 2, 0]
    np.testing.assert_array_equal(told[1].mean, CAMERAS[1].params)


def test_rig_yaml_has_the_last_word_on_a_lens() -> None:
    problem, _ = scan()
    said = {"cam1": {"params": {"k1": -0.1}, "sigma": {"k1": 0.02}}}
    config = RigConfig.model_validate({"cameras": said})
    prior = prior_of(read(), "full", ["all"], NAMES, "cam0")
    belief = options_of(started(problem, prior), config).lens_priors[1]
    assert belief.mean[4] == -0.1 and belief.sigma[4] == 0.02 and belief.sigma[5] > 1e5


def test_one_camera_has_no_place() -> None:
    alone = CameraRig(Path("old.yaml"), "ROS", CAMERAS[:1], None, "unknown")
    prior = prior_of(alone, "weak", ["all"], ("cam0",), "cam0")
    assert prior.cam_from_rig[0].translation.tolist() == [0, 0, 0] and not prior.gives_scale
    start = Estimate(CAMERAS[:1], (Transform.identity(),), (), np.zeros((0, 3)))
    assert lens_priors(start, RigConfig(), False, prior)[0].mean[0] == CAMERAS[0].params[0]


# ---- to a result ----------------------------------------------------------------------------


def result_of(mode: PriorMode, free: list[str], unit: LengthUnit = "m") -> Calibration:
    """A scan's result with the earlier calibration, from a mapping in a unit of its own."""
    problem, _ = scan()
    problem = replace(problem, initial=problem.initial.scaled(2.5))
    config = with_lenses(RigConfig(), read(), NAMES)
    prior = prior_of(replace(read(), unit=unit), mode, free, NAMES, "cam0")
    images = Scan(Path(), NAMES, tuple(SIZES.values()), problem.frame_names, ())
    start = started(start_from_config(problem, config), prior)
    given = Given(images, config, Mapped(problem, (), {}), "")
    return determine(given, start, Stopwatch(), silent).calibration


def test_a_result_tells_where_its_metres_are_from_and_what_was_believed() -> None:
    found = result_of("full", ["all"])
    assert found.rig.metric and "earlier calibration" in found.rig.scale.source
    assert found.rig.scale.sigma_relative is not None
    assert 1e-3 < found.rig.scale.sigma_relative < 0.05
    for name, camera in found.cameras.items():
        assert set(camera.prior_share) == set(camera.params), name
        assert all(0.05 < share < 0.95 for share in camera.prior_share.values())
    assert not [one for one in found.verdict.messages if "contradict" in one]


@pytest.mark.parametrize(
    ("mode", "free", "unit"),
    [
        ("weak", ["all"], "m"),
        ("start", ["rotation"], "m"),
        ("full", ["cam1"], "baseline"),
        ("full", ["intrinsics"], "unknown"),
    ],
)
def test_every_mode_leads_to_a_result(mode: PriorMode, free: list[str], unit: LengthUnit) -> None:
    found = result_of(mode, free, unit)
    assert found.solve.converged
    assert found.rig.metric == (mode == "start")
    if "intrinsics" in free or "all" in free:
        return
    # held: where it was, as sure as it was
    held = found.cameras["cam2"]
    assert held.params["fx"] == CAMERAS[2].params[0]
    assert held.prior_share["fx"] == pytest.approx(1)
    assert held.sigma["fx"] == pytest.approx(old().covariance.sigma["cam2.fx"], rel=1e-6)
    assert found.noise.sigmas["cam2.fx"].model == pytest.approx(held.sigma["fx"], rel=1e-6)
    assert "cam2.fx" in found.covariance.names

"""Mapping with an old calibration for a guide, right or wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic.scans import silent, simulation

from graphs.frames import Transform, angle_between
from graphs.problem import images_seen
from sfm_calib import guided
from sfm_calib.cache import Cache
from sfm_calib.calibrate import solve_problem, start_from_config
from sfm_calib.config import RigConfig
from sfm_calib.formats.reading import CameraRig
from sfm_calib.guided import map_with_prior
from sfm_calib.images import read_scan
from sfm_calib.result import load_calibration

pytestmark = pytest.mark.slow
CONFIG = RigConfig(max_features=400)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    return read_scan(simulation() / "scan", Cache(tmp_path_factory.mktemp("x")), "stem", 9, silent)


def old_rig(names=("cam0", "cam1"), focal=1.0, turn_deg=0.0):
    """The truth, or what it was before a camera was turned and a lens exchanged."""
    truth = load_calibration(simulation() / "truth.json")
    cameras = tuple(truth.camera(name) for name in names)
    scale = [np.r_[focal, focal, np.ones(len(camera.params) - 2)] for camera in cameras]
    cameras = tuple(replace(c, params=c.params * s) for c, s in zip(cameras, scale, strict=True))
    turn = Transform.exp(np.array([0.0, np.radians(turn_deg), 0.0]), np.zeros(3))
    placed = tuple(truth.cam_from_rig(name) for name in names)
    placed = (*placed[:1], *(turn @ t for t in placed[1:]))
    return CameraRig(Path("old.json"), "ours", cameras, placed, "m")


def solved(scan, old, place):
    mapped = map_with_prior(scan, old, CONFIG, Cache(place), silent)
    config = CONFIG.model_copy(update={"lens": old.cameras[0].lens})
    refinement = solve_problem(start_from_config(mapped.problem, config), config, silent)
    return mapped, refinement.estimate


def test_a_wrong_old_calibration_leaves_no_trace(scan, tmp_path):
    truth = load_calibration(simulation() / "truth.json")
    (right, found), (wrong, other) = (
        solved(scan, old, tmp_path / str(number))
        for number, old in enumerate((old_rig(), old_rig(focal=1.03, turn_deg=2.0)))
    )
    assert len(images_seen(right.problem.observations)) == len(scan.images)
    assert len(images_seen(wrong.problem.observations)) == len(scan.images)
    sizes = [len(mapped.problem.observations) for mapped in (right, wrong)]
    assert 0.9 < sizes[0] / sizes[1] < 1.1
    for estimate in (found, other):
        for camera in estimate.cameras:
            assert camera.params[0] == pytest.approx(truth.camera(camera.name).params[0], rel=0.01)
        off = angle_between(estimate.cam_from_rig[1].rotation, truth.cam_from_rig("cam1").rotation)
        assert np.degrees(off) < 0.5
    # Old gives the unit too.
    length = np.linalg.norm(truth.cam_from_rig("cam1").translation)
    start = np.linalg.norm(right.problem.initial.cam_from_rig[1].translation)
    assert start == pytest.approx(length, rel=1e-6)


def test_cameras_share_tracks_and_keep_their_lens(scan, tmp_path):
    mapped = map_with_prior(scan, old_rig(), CONFIG, Cache(tmp_path), silent)
    seen = mapped.problem.observations
    by = np.zeros((len(mapped.problem.initial.points), 2), dtype=bool)
    by[seen.point, seen.camera] = True
    assert by.all(1).mean() > 0.2
    assert [c.lens for c in mapped.problem.initial.cameras] == [c.lens for c in old_rig().cameras]
    again = map_with_prior(scan, old_rig(), CONFIG, Cache(tmp_path / "again"), silent)
    np.testing.assert_array_equal(again.problem.initial.points, mapped.problem.initial.points)


def test_a_camera_that_is_new_to_the_rig_is_found(scan, tmp_path):
    mapped = map_with_prior(scan, old_rig(("cam0",)), CONFIG, Cache(tmp_path), silent)
    assert set(mapped.problem.observations.camera) == {0, 1}


def test_too_few_placed_images_are_mapped_without_old(scan, tmp_path, monkeypatch):
    monkeypatch.setattr(guided, "ENOUGH_REGISTERED", 1.1)
    mapped = map_with_prior(scan, old_rig(), CONFIG, Cache(tmp_path), silent)
    assert any("without the old calibration's help" in message for message in mapped.messages)
    assert [c.lens for c in mapped.problem.initial.cameras] == [c.lens for c in old_rig().cameras]

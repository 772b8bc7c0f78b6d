"""Old calibrations whose lens is too simple to solve a scan with."""

from pathlib import Path

import numpy as np
import pytest
from synthetic.earlier import NAMES
from synthetic.recalibrations import deployed

from graphs.camera import Camera, project
from graphs.covariance import Covariance
from graphs.frames import Transform
from graphs.propagation import marginal, pose_names
from sfm_calib.formats import CameraRig
from sfm_calib.lifted import lifted
from sfm_calib.old_calibration import OldCalibration

RAYS = np.array([[0.1, -0.2, 1.0], [0.4, 0.3, 1.0], [-0.5, 0.1, 1.0]])
PINHOLE = Camera("left", "pinhole", (640, 480), np.array([500.0, 501.0, 320.0, 240.0]))
BROWN = Camera(
    "right",
    "brown",
    (640, 480),
    np.array([500.0, 501.0, 320.0, 240.0, -0.2, 0.05, 1e-3, 2e-3, 0.01]),
)
SIGMAS = {
    "left.fx": 0.5,
    "left.fy": 0.5,
    "left.cx": 0.4,
    "left.cy": 0.4,
    "right.translation_x": 1e-3,
}


def rig(*, stated: bool) -> CameraRig:
    names, sigmas = (tuple(SIGMAS), tuple(SIGMAS.values())) if stated else ((), ())
    covariance = Covariance(names, np.diag(np.square(np.array(sigmas, dtype=np.float64))))
    beside = Transform(np.eye(3), np.array([-0.2, 0.0, 0.0]))
    return CameraRig(
        Path("old"), "made", (PINHOLE, BROWN), (Transform.identity(), beside), "m", covariance
    )


def test_a_simpler_lens_becomes_a_richer_one_that_sees_the_same() -> None:
    found, notes = lifted(rig(stated=False), "radtan", ("left", "right"), 0.2, 2.0)
    left, right = found.cameras
    assert (left.lens, right.lens) == ("radtan", "brown")
    np.testing.assert_allclose(project(left, RAYS), project(PINHOLE, RAYS), rtol=0, atol=1e-12)
    assert right == BROWN and found.covariance.names == ()
    assert len(notes) == 1 and "left is pinhole in old: solved as radtan" in notes[0]
    assert "k1 k2 p1 p2" in notes[0]


def test_coefficients_that_are_new_are_in_doubt_where_the_rest_is() -> None:
    sigma = lifted(rig(stated=True), "radtan", ("left",), 0.2, 2.0)[0].covariance.sigma
    assert {name: sigma[name] for name in SIGMAS} == SIGMAS
    added = {f"left.{name}" for name in ("k1", "k2", "p1", "p2")}
    assert set(sigma) == added | set(SIGMAS)
    assert all(0 < sigma[name] < 1 for name in added)
    vaguer = lifted(rig(stated=True), "radtan", ("left",), 0.4, 2.0)[0].covariance.sigma
    assert all(vaguer[name] > sigma[name] for name in added)


def test_cameras_that_the_scan_lacks_stay_as_they_are() -> None:
    old = rig(stated=True)
    assert lifted(old, "radtan", ("right",), 0.2, 2.0) == (old, ())


def test_what_is_added_to_a_lens_that_states_sigmas_is_as_sure_as_is_said() -> None:
    camera = Camera("one", "pinhole", (640, 480), np.array([500.0, 501.0, 320.0, 240.0]))
    names = tuple(f"one.{name}" for name in camera.names)
    stated = Covariance(names, np.diag([0.5, 0.6, 0.7, 0.8]) ** 2)
    read = CameraRig(Path("old.json"), "made", (camera,), None, covariance=stated)
    some, more = (lifted(read, "radtan", ("one",), px, 2.0)[0].covariance for px in (0.1, 0.2))
    assert len(set(some.names)) == len(some.names) == 8
    for name, sigma in stated.sigma.items():
        assert some.sigma[name] == more.sigma[name] == pytest.approx(sigma)
    for k in ("k1", "k2"):  # a weak belief holds p1, p2 beside
        assert more.sigma[f"one.{k}"] == pytest.approx(2 * some.sigma[f"one.{k}"], rel=0.05)


def test_a_distance_that_gives_metres_is_as_sure_as_the_old_calibration_has_it() -> None:
    old = OldCalibration(deployed(), "m", False, ())
    known = old.baseline(NAMES[:2])
    assert known is not None
    first, second = (old.rig.names.index(name) for name in known.cameras)
    stated = old.stated
    places = [stated.estimate.cam_from_rig[i].translation for i in (first, second)]
    assert not places[0].any()  # the reference: the distance is the other's own
    along = places[1] / np.linalg.norm(places[1])
    cov = marginal(stated.covariance, pose_names(known.cameras[1])[3:]).matrix
    assert known.length_m == pytest.approx(np.linalg.norm(places[1]))
    assert known.sigma_m == pytest.approx((along @ cov @ along) ** 0.5, rel=1e-6)
    assert known.sigma_m > 1e-5 * known.length_m

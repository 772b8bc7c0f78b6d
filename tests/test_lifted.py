"""Old calibrations whose lens is too simple to solve a scan with."""

from pathlib import Path

import numpy as np

from graphs.camera import Camera, project
from graphs.covariance import Covariance
from graphs.frames import Transform
from sfm_calib.formats import CameraRig
from sfm_calib.lifted import lifted

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

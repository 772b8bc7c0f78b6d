"""Depth images of balls, whose distances are known, by real lenses."""

import cv2
import numpy as np
import pytest

from graphs.camera import Camera
from graphs.covariance import POSE_NAMES
from graphs.frames import Transform, exp_rotation
from sfm_calib.depth.cloud import image_rays
from sfm_calib.errors import CalibrationError
from sfm_calib.open3d_import import import_open3d
from sfm_calib.result import Covariance, save_calibration, truth

try:
    import_open3d("this test")
    OPEN3D_MISSING = ""
except CalibrationError as missing:
    OPEN3D_MISSING = str(missing)

needs_open3d = pytest.mark.skipif(bool(OPEN3D_MISSING), reason=OPEN3D_MISSING)

SIZE = (192, 160)
LENSES = {  # a depth camera's infrared lens, and a fisheye
    "brown": np.array([140.0, 142, 96, 78, 0.11, -0.33, 1e-3, -5e-4, 0.15]),
    "kannala_brandt": np.array([100.0, 102, 94, 80, -0.03, -0.009, 0.009, -0.004]),
}
STILL = Transform.identity()
BALL, RADIUS = np.array([0.02, -0.01, 0.7]), 0.15
BESIDE = Transform(
    exp_rotation(np.array([0.0, 0.45, 0.02])), np.array([-0.3, 0.01, 0.08])
)  # cam_from_rig


def camera(lens="brown", name="a"):
    return Camera(name, lens, SIZE, LENSES[lens])


def ranges(taker, cam_from_rig=STILL, shape="ball"):
    """Distance (h, w) along each ray to a ball, or a ball with three more before it; 0 beside."""
    rays = image_rays(taker)
    balls = [(BALL, RADIUS)]
    if shape == "lumps":
        for off in ((0.08, 0.05, -0.11), (-0.09, 0.06, -0.1), (0.01, -0.1, -0.1)):
            balls.append((BALL + np.array(off), 0.05))
    nearest = np.full(rays.shape[:2], np.inf)
    for centre, radius in balls:
        middle = cam_from_rig @ centre
        along = rays @ middle
        under = along**2 - middle @ middle + radius**2
        hit = along - np.sqrt(np.where(under > 0, under, np.nan))
        nearest = np.fmin(nearest, hit)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def z_of(taker, range_m):
    return np.nan_to_num(range_m * image_rays(taker)[..., 2])


def calibration(path, cameras, rig=None, sigmas=None):
    made = truth(list(cameras), rig or [Transform.identity()] * len(cameras), "test")
    if sigmas:
        cov = np.diag(np.square(list(sigmas.values())))
        given = Covariance(names=tuple(sigmas), matrix=tuple(map(tuple, cov.tolist())))
        made = made.model_copy(update={"covariance": given})
    save_calibration(made, path)
    return path


def two(tmp_path, shape="lumps", rig=(STILL, BESIDE), frames=("000",), sigmas=None):
    """A calibration of two cameras, and depth images of what both see, in 0.1 mm."""
    cameras = (camera(), camera("kannala_brandt", "b"))
    for taker, place in zip(cameras, (Transform.identity(), BESIDE), strict=True):
        folder = tmp_path / "depths" / taker.name
        folder.mkdir(parents=True)
        depth = np.round(1e4 * z_of(taker, ranges(taker, place, shape))).astype(np.uint16)
        for frame in frames:
            assert cv2.imwrite(str(folder / f"{frame}.png"), depth)
    return calibration(tmp_path / "c.json", cameras, list(rig), sigmas), tmp_path / "depths"


SIGMAS = {
    "a.fx": 0.3, "a.cx": 0.2, "a.k1": 0.005, "b.fy": 0.3,
    **{f"b.{name}": 0.002 if "rot" in name else 0.001 for name in POSE_NAMES},
}  # fmt: skip

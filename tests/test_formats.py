"""Every format from small hand-written files, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic.cameras import camera_of
from synthetic.hand_written import CALISCOPE, KITTI, QUALISYS
from synthetic.refusals import refused, written

from graphs.camera import project
from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import NO_SIZE, read_calibration
from sfm_calib.result import Covariance, load_calibration, save_calibration, truth

TURN = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
POINTS = np.random.default_rng(0).uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 3.0], (20, 3))


# ---- OpenCV --------------------------------------------------------------------------------

K = np.array([[500.0, 0, 321.0], [0, 505.0, 241.0], [0, 0, 1]])
DISTORTIONS = {
    0: [],
    4: [-0.2, 0.05, 1e-3, -2e-3],
    5: [-0.2, 0.05, 1e-3, -2e-3, 0.01],
    8: [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.03, -0.01],
    12: [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.03, -0.01, 1e-3, 2e-3, 3e-3, -1e-3],
    14: [-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.03, -0.01, 1e-3, 2e-3, 3e-3, -1e-3, 0, 0],
}


def storage(path: Path, **entries: object) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in entries.items():
        file.write(name, value)
    file.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize("count", DISTORTIONS)
def test_opencv_projects_as_opencv_does(suffix: str, count: int, tmp_path: Path) -> None:
    k = np.array(DISTORTIONS[count])
    path = storage(
        tmp_path / f"left.{suffix}", image_width=640, image_height=480, camera_matrix=K,
        **({"distortion_coefficients": k} if count else {}),
    )  # fmt: skip
    read = read_calibration(path)
    camera = read.cameras[0]
    assert (camera.name, camera.size) == ("left", (640, 480))
    expected = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, k if count else None)[0]
    assert project(camera, POINTS) == pytest.approx(expected[:, 0], abs=1e-9)


def test_opencv_fisheye_is_kannala_brandt(tmp_path: Path) -> None:
    k = np.array([-0.03, 0.01, -0.004, 0.001])
    path = storage(
        tmp_path / "a.yml", image_width=640, image_height=480, fisheye_model=1,
        camera_matrix=K, distortion_coefficients=k,
    )  # fmt: skip
    camera = read_calibration(path).cameras[0]
    expected = cv2.fisheye.projectPoints(POINTS[:, None], np.zeros(3), np.zeros(3), K, k)[0]
    assert camera.lens == "kannala_brandt"
    assert project(camera, POINTS) == pytest.approx(expected[:, 0], abs=1e-9)


@pytest.mark.parametrize("which", ["intrinsics.yml", "extrinsics.yml", "."])
def test_opencv_stereo_in_two_files(which: str, tmp_path: Path) -> None:
    k = np.array(DISTORTIONS[5])
    storage(tmp_path / "intrinsics.yml", M1=K, D1=k, M2=K + np.diag([3.0, 4, 0]), D2=k)
    storage(tmp_path / "extrinsics.yml", R=TURN, T=np.array([[-3.0], [0.1], [0.2]]))
    read = read_calibration(tmp_path / which)
    assert read.names == ("cam1", "cam2") and read.unit == "unknown"
    assert read.cameras[1].params[0] == 503.0
    assert read.cameras[0].size == NO_SIZE
    assert read.cam_from_rig is not None
    assert read.cam_from_rig[1].translation == pytest.approx([-3, 0.1, 0.2])
    assert read.cam_from_rig[1].rotation == pytest.approx(TURN)
    assert "unit" in read.notes[0]


def test_opencv_stereo_without_a_rig_is_its_lenses(tmp_path: Path) -> None:
    path = storage(tmp_path / "intrinsics.yml", M1=K, D1=np.zeros(5), M2=K, D2=np.zeros(5))
    read = read_calibration(path)
    assert read.cam_from_rig is None and "extrinsics" in read.notes[0]
    with pytest.raises(CalibrationError, match="how its 2 cameras sit"):
        read.calibration()


def test_impossible_opencv_cameras_are_refused(tmp_path: Path) -> None:
    skewed = K + np.array([[0, 2.5, 0], [0, 0, 0], [0, 0, 0]])
    assert "skew of 2.5 px" in refused(storage(tmp_path / "a.yml", camera_matrix=skewed))
    tilted = np.array([*DISTORTIONS[12], 0.01, 0])
    path = storage(tmp_path / "b.yml", camera_matrix=K, distortion_coefficients=tilted)
    assert "tilted" in refused(path)
    path = storage(tmp_path / "c.yml", camera_matrix=K, distortion_coefficients=np.zeros(6))
    assert "6 distortion coefficients" in refused(path)
    assert "focal lengths -500" in refused(storage(tmp_path / "d.yml", camera_matrix=-K))
    assert "holds no camera" in refused(storage(tmp_path / "e.yml", nothing=1))
    path = storage(tmp_path / "f.yml", M1=K, D1=np.zeros(4), M2=K, D2=np.zeros(4), R=2 * TURN,
                   T=np.ones(3))  # fmt: skip
    assert "rotation matrix is none" in refused(path)


# ---- ROS -----------------------------------------------------------------------------------

ROS = """image_width: 640
image_height: 480
camera_name: {name}
camera_matrix:
  rows: 3
  cols: 3
  data: [500, 0, 321, 0, 505, 241, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: 5
  data: [{k}]
rectification_matrix:
  rows: 3
  cols: 3
  data: {R}
projection_matrix:
  rows: 3
  cols: 4
  data: [480, 0, 320, {shift}, 0, 480, 240, 0, 0, 0, 1, 0]
"""


def ros(path: Path, model: str = "plumb_bob", k: str = "-0.2, 0.05, 0.001, -0.002, 0.01",
        turn: object = None, shift: float = 0.0) -> Path:  # fmt: skip
    R = (np.eye(3) if turn is None else np.asarray(turn)).ravel().tolist()
    return written(path, ROS.format(name=path.stem, model=model, k=k, R=R, shift=shift))


def test_ros_camera_info(tmp_path: Path) -> None:
    read = read_calibration(ros(tmp_path / "front.yaml"))
    assert read.names == ("front",) and read.cam_from_rig is None
    assert read.cameras[0].named()["k3"] == 0.01
    fisheye = read_calibration(ros(tmp_path / "b.yaml", "equidistant", "0.1, 0.2, 0.3, 0.4"))
    assert fisheye.cameras[0].lens == "kannala_brandt"
    assert "not known" in refused(ros(tmp_path / "c.yaml", "magic"))


def test_ros_pair_sits_as_its_rectification_says(tmp_path: Path) -> None:
    """A point goes to both rectified cameras along one row, shifted by f b / z."""
    ros(tmp_path / "left.yaml", turn=TURN)
    ros(tmp_path / "right.yaml", turn=TURN.T, shift=-48.0)  # 0.1 m
    read = read_calibration(tmp_path)
    assert read.names == ("left", "right") and read.unit == "m"
    assert read.cam_from_rig is not None
    left, right = read.cam_from_rig
    assert np.linalg.norm((right @ left.inverse).translation) == pytest.approx(0.1)
    rectified = [TURN @ (left @ POINTS).T, TURN.T @ (right @ POINTS).T]
    assert rectified[1] == pytest.approx(rectified[0] - np.array([[0.1], [0], [0]]), abs=1e-12)


# ---- Kalibr --------------------------------------------------------------------------------

KALIBR = """cam0:
  camera_model: {model}
  intrinsics: {intrinsics}
  distortion_model: {distortion}
  distortion_coeffs: {k}
  resolution: [640, 480]
  rostopic: /cam0
"""
SECOND = """cam{number}:
  camera_model: pinhole
  intrinsics: [400, 401, 320, 240]
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.1, 0.001, 0.002]
  resolution: [640, 480]
  T_cn_cnm1: {matrix}
"""


def kalibr(
    path: Path, model: str, distortion: str, intrinsics: list[float], k: list[float]
) -> Path:
    text = KALIBR.format(model=model, distortion=distortion, intrinsics=intrinsics, k=k)
    return written(path, text)


def test_kalibr_chains_its_cameras(tmp_path: Path) -> None:
    step = Transform(TURN, np.array([0.1, 0.0, 0.02]))
    matrix = np.vstack([np.column_stack([step.rotation, step.translation]), [0, 0, 0, 1]])
    path = kalibr(tmp_path / "c.yaml", "pinhole", "equidistant", [350, 351, 320, 240], [0.1] * 4)
    for number in (1, 2):
        written(path, path.read_text() + SECOND.format(number=number, matrix=matrix.tolist()))
    read = read_calibration(path)
    assert [c.lens for c in read.cameras] == ["kannala_brandt", "radtan", "radtan"]
    assert read.unit == "m" and read.cam_from_rig is not None
    assert read.cam_from_rig[2].translation == pytest.approx((step @ step).translation)
    assert not read.notes
    written(path, path.read_text() + f"  T_cam_imu: {matrix.tolist()}\n")
    assert "IMU" in read_calibration(path).notes[0]


def test_kalibr_lenses(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    ds = read_calibration(kalibr(path, "ds", "none", [-0.2, 0.6, 300, 301, 320, 240], []))
    assert ds.cameras[0].lens == "double_sphere"
    assert ds.cameras[0].params.tolist() == [300, 301, 320, 240, -0.2, 0.6]
    eucm = read_calibration(kalibr(path, "eucm", "none", [0.6, 1.1, 300, 301, 320, 240], []))
    assert eucm.cameras[0].named()["beta"] == 1.1
    message = refused(kalibr(path, "pinhole", "fov", [300, 301, 320, 240], [0.9]))
    assert "pinhole-fov, which no lens here is" in message
    message = refused(kalibr(path, "omni", "radtan", [1.1, 300, 301, 320, 240], [0.1, 0, 0, 0]))
    assert "omni-radtan" in message


def test_kalibr_omni_is_the_unified_model(tmp_path: Path) -> None:
    """Mei and Rives: onto the unit sphere, then from a point xi behind its centre."""
    xi, focal = 1.2, [500.0, 505.0]
    path = kalibr(tmp_path / "c.yaml", "omni", "none", [xi, *focal, 320, 240], [])
    sphere = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    expected = np.array(focal) * sphere[:, :2] / (sphere[:, 2:] + xi) + [320, 240]
    assert project(read_calibration(path).cameras[0], POINTS) == pytest.approx(expected, abs=1e-9)


# ---- Caliscope, Qualisys, KITTI ------------------------------------------------------------


def test_caliscope_with_matrix_and_vector(tmp_path: Path) -> None:
    read = read_calibration(written(tmp_path / "camera_array.toml", CALISCOPE))
    assert read.names == ("cam_0", "cam_1") and read.unit == "m"
    assert [c.lens for c in read.cameras] == ["brown", "kannala_brandt"]
    assert read.cam_from_rig is not None
    assert read.cam_from_rig[1].rotation == pytest.approx(TURN)
    broken = CALISCOPE.replace("translation = [0.1, 0.2, 0.3]\n", "")
    assert read_calibration(written(tmp_path / "b.toml", broken)).cam_from_rig is None
    broken = CALISCOPE.replace("size = [1280, 720]", "size = 3", 1)
    assert "cam_0 is not whole" in refused(written(tmp_path / "c.toml", broken))


def test_qualisys_sees_what_lies_before_it(tmp_path: Path) -> None:
    """A camera at x = 1 m, z = 2 m whose backward axis is the world's x: it looks along -x."""
    read = read_calibration(written(tmp_path / "a.qca.txt", QUALISYS))
    camera = read.cameras[0]
    assert camera.size == (1088, 1920)
    assert camera.params == pytest.approx([1000, 1010, 500, 950, -0.05, 0.1, 0.001, 0.002, 0])
    assert read.cam_from_rig is not None
    seen = read.cam_from_rig[0] @ np.array([[0.0, 0.0, 2.0], [0.0, 0.1, 2.0], [0.0, 0.0, 2.1]])
    # Straight ahead at 1 m; the world's y is the camera's right, its z up.
    assert seen == pytest.approx(np.array([[0, 0, 1], [0.1, 0, 1], [0, -0.1, 1]]), abs=1e-12)
    assert "0.5 px" in read.notes[0]
    assert "not whole" in refused(written(tmp_path / "b", QUALISYS.replace("skew", "askew")))


@pytest.mark.parametrize("labels", [True, False])
def test_kitti_projection_matrices(labels: bool, tmp_path: Path) -> None:
    text = KITTI if labels else KITTI.replace("P0: ", "").replace("P1: ", "")
    read = read_calibration(written(tmp_path / "calib.txt", text))
    assert read.names == (("P0", "P1") if labels else ("cam0", "cam1"))
    assert read.cameras[0].size == NO_SIZE and read.unit == "m"
    assert read.cam_from_rig is not None
    assert read.cam_from_rig[1].translation == pytest.approx([-0.54, 0, 0])
    turned = KITTI.replace("P1: 700 0", "P1: 700 5").replace("0 700 180", "9 700 180")
    assert "rectified" in refused(written(tmp_path / "b.txt", turned))


def test_a_plain_camera_matrix(tmp_path: Path) -> None:
    read = read_calibration(written(tmp_path / "K.txt", "700 0 600\n0 701 180\n0 0 1\n"))
    assert read.cameras[0].params.tolist() == [700, 701, 600, 180]


# ---- our own, and none ---------------------------------------------------------------------


def test_our_own_with_its_covariance(tmp_path: Path) -> None:
    cameras = [camera_of("radtan")]
    made = truth(cameras, [Transform.identity()], "0").model_copy(
        update={"covariance": Covariance(names=("cam.fx", "cam.cx"), matrix=((4, 1), (1, 9)))}
    )
    save_calibration(made, tmp_path / "calibration.json")
    for path in (tmp_path, tmp_path / "calibration.json"):
        read = read_calibration(path)
        assert read.states_sigmas and read.covariance.sigma["cam.cx"] == 3.0
        assert read.cameras[0].params == pytest.approx(cameras[0].params)


def test_what_was_read_is_a_result(tmp_path: Path) -> None:
    read = read_calibration(written(tmp_path / "camera_array.toml", CALISCOPE))
    save_calibration(read.calibration(), tmp_path / "out.json")
    again = load_calibration(tmp_path / "out.json")
    assert again.rig.reference == "cam_0" and again.rig.metric
    assert again.cam_from_rig("cam_1").translation == pytest.approx([0.1, 0.2, 0.3])


def test_units_can_be_stated(tmp_path: Path) -> None:
    storage(tmp_path / "s.yml", M1=K, D1=np.zeros(4), M2=K, D2=np.zeros(4), R=TURN,
            T=np.array([-150.0, 0, 0]))  # fmt: skip
    read = read_calibration(tmp_path / "s.yml").metric(0.001)
    assert read.unit == "m" and read.cam_from_rig is not None
    assert read.cam_from_rig[1].translation == pytest.approx([-0.15, 0, 0])


@pytest.mark.parametrize(
    "text",
    ["hello", "", "a: 1\n", "[table]\nx = 1\n", "<root/>", "1 2 3 4\n", json.dumps([1])],
)
def test_what_is_no_calibration_is_told_the_formats(text: str, tmp_path: Path) -> None:
    message = refused(written(tmp_path / "x.txt", text))
    assert "known are" in message and "Kalibr" in message


def test_damaged_and_missing_files(tmp_path: Path) -> None:
    assert "No such file" in refused(tmp_path / "nowhere.yml")
    assert "no whole XML" in refused(written(tmp_path / "a.xml", "<opencv_storage><a>"))
    assert "no whole JSON" in refused(written(tmp_path / "a.json", "{"))
    assert "is no sfm_calib/1 file" in refused(written(tmp_path / "b.json", '{"cameras": {}}'))
    (tmp_path / "c.bin").write_bytes(b"\xff\xfe\x00\x80")
    assert "known are" in refused(tmp_path / "c.bin")
    (tmp_path / "empty").mkdir()
    assert "holds no calibration" in refused(tmp_path / "empty")
    assert refused(written(tmp_path / "d.yml", "%YAML:1.0\n---\n: : [\n"))

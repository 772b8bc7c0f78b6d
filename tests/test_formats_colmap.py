"""COLMAP models as COLMAP writes them, read without it."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from synthetic.cameras import camera_of
from synthetic.refusals import refused, written

from graphs.camera import Camera
from sfm_calib.colmap import colmap_camera
from sfm_calib.formats import read_calibration

TURN = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]


def colmap_model(folder: Path, binary: bool, cameras: list[Camera], placed: bool = True) -> Path:
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig()
    rig.rig_id = 1
    names = {"radtan": "OPENCV", "kannala_brandt": "OPENCV_FISHEYE", "rational": "FULL_OPENCV"}
    for number, camera in enumerate(cameras, start=1):
        model.add_camera(colmap_camera(camera, names[camera.lens], number))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        if number == 1:
            rig.add_ref_sensor(sensor)
        elif placed:
            shift = np.array([0.1 * number, 0.2, 0.3])
            rig.add_sensor(sensor, pycolmap.Rigid3d(pycolmap.Rotation3d(TURN), shift))
        else:
            rig.add_sensor(sensor, None)
    model.add_rig(rig)
    folder.mkdir(exist_ok=True)
    (model.write_binary if binary else model.write_text)(folder)
    return folder


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_as_colmap_writes_it(binary: bool, tmp_path: Path) -> None:
    wanted = [camera_of("radtan"), camera_of("kannala_brandt"), camera_of("rational")]
    read = read_calibration(colmap_model(tmp_path / "model", binary, wanted))
    assert read.names == ("camera1", "camera2", "camera3")
    for camera, original in zip(read.cameras, wanted, strict=True):
        assert (camera.lens, camera.size) == (original.lens, original.size)
        assert camera.params == pytest.approx(original.params, rel=1e-12)  # half a pixel and back
    assert read.cam_from_rig is not None
    assert read.cam_from_rig[0].translation == pytest.approx(np.zeros(3))
    assert read.cam_from_rig[2].translation == pytest.approx([0.3, 0.2, 0.3])
    assert read.cam_from_rig[2].rotation == pytest.approx(TURN)


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_whose_rig_is_not_known(binary: bool, tmp_path: Path) -> None:
    cameras = [camera_of("radtan"), camera_of("radtan")]
    read = read_calibration(colmap_model(tmp_path / "model", binary, cameras, placed=False))
    assert read.cam_from_rig is None and "no rig" in read.notes[0]


def test_colmap_files_that_cannot_be(tmp_path: Path) -> None:
    path = written(tmp_path / "cameras.txt", "1 FOV 640 480 500 500 320 240 0.9\n")
    assert "FOV, which no lens here is" in refused(path)
    written(path, "# nothing\n")
    assert "without cameras" in refused(tmp_path)
    written(path, "1 OPENCV 640 480 500\n")
    assert "has 1 numbers, not 8" in refused(tmp_path)
    written(path, "1 OPENCV 640\n")
    assert "no whole COLMAP model" in refused(tmp_path)
    written(path, "9" * 50 + " PINHOLE 640 480 500 500 320 240\n")
    assert "no number of a camera" in refused(tmp_path)
    for bad in ("nan 500 320 240", "-500 500 320 240"):
        written(path, f"1 PINHOLE 640 480 {bad}\n")
        assert "not finite" in refused(tmp_path) or "not positive" in refused(tmp_path)
    path.unlink()
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<QIi", 3, 1, 4))
    assert "no whole COLMAP model" in refused(tmp_path)


def test_colmap_with_cameras_alone(tmp_path: Path) -> None:
    written(tmp_path / "cameras.txt", "7 SIMPLE_RADIAL_FISHEYE 640 480 300 320 240 0.01\n")
    camera = read_calibration(tmp_path).cameras[0]
    assert camera.lens == "kannala_brandt" and camera.name == "camera7"
    assert camera.params == pytest.approx([300, 300, 319.5, 239.5, 0.01, 0, 0, 0])

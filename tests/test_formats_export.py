"""COLMAP, NeRF and URDF as their owners read them, and every format there and back."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic.cameras import camera_of
from synthetic.refusals import refused, written
from synthetic.rigs_to_write import (
    ODD_NAMES,
    POINTS,
    exported,
    read_again,
    relative,
    rig_of,
    rigs,
    transforms,
)

from graphs.camera import Camera, project
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.lenses import LENS_NAMES, LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import CameraRig, read_calibration
from sfm_calib.formats.colmap_export import COLMAP
from sfm_calib.formats.contents import camera_name, file_name, file_path
from sfm_calib.formats.mrcal import MRCAL
from sfm_calib.formats.nerf import NERF
from sfm_calib.formats.urdf import RIG, URDF, URDF_FILE, roll_pitch_yaw
from sfm_calib.formats.writing import Format

TURN = exp_rotation(np.array([0.1, -0.2, 0.3]))
PLACES = (
    Transform.identity(),
    Transform(TURN, np.array([-0.11, 0.02, 0.003])),
    Transform(TURN.T, np.array([0.2, 0.01, -0.03])),
)
DATA = Path(__file__).parents[2] / "shared" / "data"


def three(*lenses: LensName, names: tuple[str, ...] = ("left", "right", "rear")) -> CameraRig:
    cameras = tuple(replace(camera_of(lens), name=n) for lens, n in zip(lenses, names, strict=True))
    return rig_of(cameras, PLACES)


# ---- there and back ------------------------------------------------------------------------


def same(rig: CameraRig, again: CameraRig) -> None:
    """Names, sizes, projections and relative places; lenses may have more coefficients, of zero."""
    assert sorted(again.names) == sorted(rig.names)
    by_name = {camera.name: camera for camera in again.cameras}
    for camera in rig.cameras:
        assert by_name[camera.name].size == camera.size
        pixels = project(camera, POINTS)
        assert np.isfinite(pixels).mean() > 0.5
        assert project(by_name[camera.name], POINTS) == pytest.approx(pixels, abs=1e-9, nan_ok=True)
    for name in rig.names[1:]:
        between = relative(again, name, rig.names[0])
        assert between == pytest.approx(relative(rig, name, rig.names[0]), abs=1e-12)


@pytest.mark.parametrize("format", [COLMAP, MRCAL], ids=lambda f: f.title)
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_there_and_back(format: Format, data: st.DataObject) -> None:
    rig = data.draw(rigs(format.lenses))
    with tempfile.TemporaryDirectory() as folder:
        same(rig, read_again(format.write(rig), format, Path(folder)))


@pytest.mark.parametrize("lenses", [NERF.lenses[:-1], NERF.lenses[-1:]], ids=["plain", "fisheye"])
@settings(deadline=None, max_examples=30)
@given(data=st.data())
def test_there_and_back_by_nerf(lenses: tuple[LensName, ...], data: st.DataObject) -> None:
    rig = data.draw(rigs(lenses))
    with tempfile.TemporaryDirectory() as folder:
        again = read_again(NERF.write(rig), NERF, Path(folder))
    same(rig, again)
    assert again.names == rig.names  # in their order
    assert [c.lens for c in again.cameras] == [c.lens for c in rig.cameras]


@pytest.mark.parametrize("lens", ["pinhole", "simple_radial", "radial"])
def test_lenses_of_one_focal_length_stay_what_they_are(lens: LensName, tmp_path: Path) -> None:
    params = camera_of(lens).params.copy()
    params[1] = params[0]
    camera = Camera("cam", lens, (640, 480), params)
    again = read_again(COLMAP.write(rig_of((camera,), PLACES[:1])), COLMAP, tmp_path).cameras[0]
    assert (again.name, again.lens) == ("cam", lens)
    assert again.params == pytest.approx(params, abs=1e-12)


REAL = ("fisheye_rig5/kalibr/calib_3_cam0-1-camchain-imucam.yaml", "charuco_rig4/camera_array.toml",
        "mocap_static4/Calib.qca.txt")  # fmt: skip


@pytest.mark.parametrize("name", REAL)
def test_real_calibrations_there_and_back(name: str, tmp_path: Path) -> None:
    if not (DATA / name).is_file():
        pytest.skip(f"there is no {DATA / name}")
    rig = read_calibration(DATA / name)
    formats = [f for f in (COLMAP, MRCAL, NERF) if {c.lens for c in rig.cameras} <= set(f.lenses)]
    assert len(formats) >= 2
    for number, format in enumerate(formats):
        (tmp_path / str(number)).mkdir()
        same(rig, read_again(format.write(rig), format, tmp_path / str(number)))


# ---- names ---------------------------------------------------------------------------------


@given(st.one_of(st.sampled_from(ODD_NAMES), st.text(min_size=1, max_size=20)))
def test_a_name_is_a_files_name_and_back(name: str) -> None:
    coded = file_name(name)
    assert "/" not in coded and "\\" not in coded and not coded.startswith(".") and coded.isascii()
    assert camera_name(coded) == name
    path = Path(file_path(name))
    assert not path.is_absolute() and ".." not in path.parts
    assert camera_name(file_path(name)) == name


def test_names_that_can_be_no_files_are_refused() -> None:
    for name in ("", "x" * 201, "日" * 30):
        with pytest.raises(CalibrationError, match="rename it"):
            file_name(name)


@pytest.mark.parametrize("name", ODD_NAMES)
def test_odd_names_stay_text(name: str, tmp_path: Path) -> None:
    rig = three("radtan", "radtan", "radtan", names=(name, "right", "rear"))
    root = ElementTree.parse(exported(URDF.write(rig), URDF, tmp_path) / URDF_FILE).getroot()
    links = [link.get("name", "") for link in root.iterfind("link")]
    assert len(set(links)) == 4 and all(link.isidentifier() and link.isascii() for link in links)
    for format in (COLMAP, NERF, MRCAL):
        (tmp_path / format.title).mkdir()
        again = read_again(format.write(rig), format, tmp_path / format.title)
        assert set(again.names) == {name, "right", "rear"}


# ---- COLMAP --------------------------------------------------------------------------------


def test_colmap_sees_what_we_see(tmp_path: Path) -> None:
    lenses = COLMAP.lenses
    cameras = tuple(replace(camera_of(lens), name=lens) for lens in lenses)
    places = (PLACES * len(lenses))[: len(lenses)]
    exported(COLMAP.write(rig_of(cameras, places)), COLMAP, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path))
    config = pycolmap.read_rig_config(str(tmp_path / "rig_config.json"))[0].cameras
    assert len(model.cameras) == len(config) == len(lenses)
    rig = model.rigs[1]
    for number, (camera, place) in enumerate(zip(cameras, places, strict=True), start=1):
        theirs, stated = model.cameras[number], config[number - 1]
        wanted = project(camera, POINTS) + 0.5
        assert np.isfinite(wanted).all()
        assert theirs.img_from_cam(POINTS) == pytest.approx(wanted, abs=1e-9)
        assert (theirs.width, theirs.height) == camera.size
        assert stated.image_prefix == f"{camera.name}/"
        assert stated.camera.model == theirs.model
        assert np.array_equal(stated.camera.params, theirs.params)
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        assert stated.ref_sensor == rig.is_ref_sensor(sensor) == (number == 1)
        if number > 1:
            for known in (rig.sensor_from_rig(sensor), stated.cam_from_rig):
                matrix = np.column_stack([place.rotation, place.translation])
                assert known.matrix() == pytest.approx(matrix, abs=1e-12)


def test_colmap_takes_the_rig_into_the_frame_of_a_camera(tmp_path: Path) -> None:
    rig = three("radtan", "brown", "pinhole")
    assert rig.cam_from_rig is not None
    second = replace(rig, cam_from_rig=tuple(p @ PLACES[1].inverse for p in rig.cam_from_rig))
    world = replace(rig, cam_from_rig=tuple(p @ PLACES[2] for p in rig.cam_from_rig))
    moved = []
    for number, each in enumerate((rig, world, second)):
        export = COLMAP.write(each)
        moved.append(any("frame is that of left" in note for note in export.notes))
        (tmp_path / str(number)).mkdir()
        same(rig, read_again(export, COLMAP, tmp_path / str(number)))
    assert moved == [False, True, True]  # of the second, R R' is the identity but for rounding


def test_a_lone_rig_config(tmp_path: Path) -> None:
    rig = three("radtan", "kannala_brandt", "eucm")
    path = written(
        tmp_path / "rig_config.json", COLMAP.write(rig).files["rig_config.json"].decode()
    )
    for again in (read_calibration(path), read_calibration(tmp_path)):
        assert again.names == rig.names and [c.size for c in again.cameras] == [(0, 0)] * 3
        assert relative(again, "rear", "left") == pytest.approx(relative(rig, "rear", "left"))
        for a, b in zip(again.cameras, rig.cameras, strict=True):
            assert a.params == pytest.approx(b.params, rel=1e-12)


def test_rig_configs_that_say_less(tmp_path: Path) -> None:
    rig = json.loads(COLMAP.write(three("radtan", "radtan", "radtan")).files["rig_config.json"])
    path = tmp_path / "any.json"
    written(path, json.dumps([*rig, *rig]))
    assert "holds 2 rigs" in refused(path)
    del rig[0]["cameras"][1]["cam_from_rig_rotation"]
    again = read_calibration(written(path, json.dumps(rig)))
    assert again.cam_from_rig is None and "no rig" in again.notes[0]
    del rig[0]["cameras"][1]["camera_params"]
    written(path, json.dumps(rig))
    assert "camera_params of right: give the model's folder" in refused(path)
    rig[0]["cameras"][1]["image_prefix"] = "left/"
    written(path, json.dumps(rig))
    assert "one image_prefix" in refused(path)
    rig[0]["cameras"][1]["image_prefix"] = "x" * 1000
    written(path, json.dumps(rig))
    assert "longer than 200" in refused(path)


def test_a_rig_config_of_another_calibration_names_nothing(tmp_path: Path) -> None:
    exported(COLMAP.write(three("radtan", "radtan", "radtan")), COLMAP, tmp_path)
    other = COLMAP.write(three("radtan", "brown", "radtan")).files["rig_config.json"].decode()
    longer = json.loads(COLMAP.write(three("radtan", "radtan", "radtan")).files["rig_config.json"])
    longer[0]["cameras"][0]["camera_params"][0] += 1e-9
    for text in (other, json.dumps(longer), "[", "[1]", "{}"):
        written(tmp_path / "rig_config.json", text)
        again = read_calibration(tmp_path)
        assert again.names == ("camera1", "camera2", "camera3")
        assert "other lenses" in again.notes[-1]


# ---- NeRF ----------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", NERF.lenses)
def test_nerfstudio_sees_what_we_see(lens: LensName) -> None:
    """By nerfstudio's own steps: OpenGL's axes, cx - 0.5 before OpenCV, k1 k2 p1 p2 k3."""
    rig = three(lens, lens, lens)
    content = json.loads(NERF.write(rig).files[""])
    assert not {"fl_x", "cx", "k1", "w"} & set(content)  # at the top they would be all frames'
    for camera, place, frame in zip(rig.cameras, PLACES, content["frames"], strict=True):
        in_rig = place.inverse @ POINTS
        matrix = np.array(frame["transform_matrix"])
        opengl = (in_rig - matrix[:3, 3]) @ matrix[:3, :3]
        ahead = opengl * [1, -1, -1]
        assert ahead == pytest.approx(POINTS, abs=1e-12)
        K = np.array([[frame["fl_x"], 0, frame["cx"] - 0.5], [0, frame["fl_y"], frame["cy"] - 0.5],
                      [0, 0, 1]])  # fmt: skip
        k = [frame.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
        if lens == "kannala_brandt":
            assert content["camera_model"] == "OPENCV_FISHEYE"
            k4 = np.array([frame[f"k{i}"] for i in (1, 2, 3, 4)])
            seen = cv2.fisheye.projectPoints(ahead[:, None], np.zeros(3), np.zeros(3), K, k4)[0]
        else:
            seen = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), K, np.array(k))[0]
        assert seen[:, 0] == pytest.approx(project(camera, POINTS), abs=1e-9)


def frames(count: int, **more: object) -> list[dict[str, object]]:
    matrix = np.eye(4).tolist()
    return [
        {"file_path": f"./images/{n:04d}.png", "transform_matrix": matrix, **more}
        for n in range(count)
    ]


def nerf_file(path: Path, **content: object) -> Path:
    lens = {"fl_x": 500.0, "w": 640.0, "h": 480.0}
    return written(path / "transforms.json", json.dumps(lens | content))


def test_nerf_frames_that_share_a_lens_are_one_camera(tmp_path: Path) -> None:
    path = nerf_file(
        tmp_path, fl_y=505, cx=321, cy=241, k1=0.1, k2=0.0, k3=0, k4=0, p1=0, p2=0,
        camera_model="OPENCV", frames=frames(7),
    )  # fmt: skip
    read = read_calibration(path)
    assert "7 frames share one lens" in read.notes[0] and read.cam_from_rig is None
    assert read.cameras[0].size == (640, 480) and read.cameras[0].lens == "simple_radial"
    assert read.cameras[0].params == pytest.approx([500, 505, 320.5, 240.5, 0.1])
    # without a centre it is the image's: pixels from 0 to 640
    centred = read_calibration(nerf_file(tmp_path, frames=frames(1))).cameras[0]
    assert centred.params == pytest.approx([500, 500, 319.5, 239.5])


def test_nerf_files_that_cannot_be(tmp_path: Path) -> None:
    def said(**content: object) -> str:
        return refused(nerf_file(tmp_path, **content))

    assert "k1 k4 as OPENCV" in said(k1=0.1, k4=0.1, frames=frames(1))
    assert "none that a lens here is" in said(camera_model="EQUIRECTANGULAR", frames=frames(1))
    assert "one file_path" in said(frames=frames(1, cx=1) * 2)
    assert "last 0 0 0 1" in said(frames=[{"cx": 1, "transform_matrix": np.ones((4, 4)).tolist()}])
    assert "whole number" in said(w=640.5, frames=frames(1))
    assert "fl_x, w and h" in refused(
        written(tmp_path / "t.json", json.dumps({"camera_angle_x": 0.7, "frames": frames(2)}))
    )
    with pytest.raises(CalibrationError, match="one camera_model"):
        NERF.write(three("radtan", "kannala_brandt", "radtan"))


# ---- URDF ----------------------------------------------------------------------------------


def rotation_of(roll: float, pitch: float, yaw: float) -> FloatArray:
    """About fixed axes: first x, then y, then z."""
    x, y, z = (exp_rotation(a * e) for a, e in zip((roll, pitch, yaw), np.eye(3), strict=True))
    return z @ y @ x


@given(transforms(), st.one_of(st.sampled_from([-np.pi / 2, np.pi / 2]), st.floats(-1.571, 1.571)))
def test_roll_pitch_yaw_at_the_poles_too(placed: Transform, pitch: float) -> None:
    pole = rotation_of(0.3, pitch, -2.0)
    for R in (placed.rotation, pole, TURN @ (TURN.T @ pole)):  # the last with rounding everywhere
        assert rotation_of(*roll_pitch_yaw(R)) == pytest.approx(R, abs=1e-14)


@settings(deadline=None, max_examples=30)
@given(rigs(LENS_NAMES))
def test_urdf_and_static_transforms_place_the_cameras(rig: CameraRig) -> None:
    export = URDF.write(rig)
    assert rig.cam_from_rig is not None
    robot, launch = (ElementTree.fromstring(content) for content in export.files.values())
    joints, nodes = robot.findall("joint"), launch.findall("node")
    links = {link.get("name") for link in robot.iterfind("link")}
    assert len(joints) == len(nodes) == len(rig.cameras) and len(links) == len(joints) + 1
    for joint, node, place in zip(joints, nodes, rig.cam_from_rig, strict=True):
        parts = {part.tag: part.attrib for part in joint}
        child = parts["child"]["link"]
        assert parts["parent"]["link"] == RIG and child in links
        xyz, rpy = ([float(n) for n in parts["origin"][key].split()] for key in ("xyz", "rpy"))
        rig_from_camera = Transform(rotation_of(*rpy), np.array(xyz))
        words = str(node.get("args")).split()
        told = dict(zip(words[::2], words[1::2], strict=True))
        assert (told["--frame-id"], told["--child-frame-id"]) == (RIG, child)
        published = Transform.from_wxyz(
            [float(told[f"--q{axis}"]) for axis in "wxyz"],
            [float(told[f"--{axis}"]) for axis in "xyz"],
        )
        for known in (rig_from_camera, published):
            both = known @ place  # rig_from_camera camera_from_rig
            assert both.rotation == pytest.approx(np.eye(3), abs=1e-12)
            assert both.translation == pytest.approx(np.zeros(3), abs=1e-12)


# ---- what is not held ----------------------------------------------------------------------


@pytest.mark.parametrize("format", [COLMAP, MRCAL, NERF, URDF], ids=lambda f: f.title)
def test_what_is_left_out_is_told(format: Format) -> None:
    rig = replace(
        three("radtan", "brown", "pinhole"),
        unit="baseline", covariance=Covariance(("left.fx",), np.eye(1)),
    )  # fmt: skip
    notes = " ".join(format.write(rig).notes)
    assert "covariance are not held" in notes and "longest baseline, not metres" in notes
    alone = rig_of((camera_of("radtan"),), PLACES[:1])
    assert "length" not in " ".join(format.write(replace(alone, cam_from_rig=None)).notes)
    with pytest.raises(CalibrationError, match="does not say how its 3 cameras sit"):
        format.write(replace(rig, cam_from_rig=None))

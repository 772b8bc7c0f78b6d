"""What each writer writes: read back exactly, and read by the tool whose format it is."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st
from synthetic.calibrations import NAMES, apart_px, rig_of, rigs, there

from graphs.camera import project
from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_folder_atomically
from sfm_calib.formats import CameraRig, read_calibration
from sfm_calib.formats.convert import FORMATS, FormatName, exported
from sfm_calib.formats.writing import file_names

POINTS = np.random.default_rng(0).uniform([-0.4, -0.3, 1.5], [0.4, 0.3, 3.0], (20, 3))
MINE: tuple[FormatName, ...] = (
    "sfm_calib", "kalibr", "opencv", "opencv_xml", "opencv_json", "ros",
)  # fmt: skip
MOST = {"one": 1, "two": 2, "any": 4}


@pytest.mark.parametrize("to", MINE)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_what_is_written_is_read_again(to: FormatName, data: st.DataObject) -> None:
    """Names, sizes and lenses bit by bit; places to rounding; whatever cameras are called."""
    form = FORMATS[to]
    rig = data.draw(rigs(form.lenses, MOST[form.cameras]))
    with TemporaryDirectory() as folder:
        back = there(rig, to, Path(folder) / "x")
    assert sorted(back.names) == sorted(rig.names)
    back = back.only(rig.names)
    for one, other in zip(rig.cameras, back.cameras, strict=True):
        assert one.size == other.size
        shorter = min(one.params.size, other.params.size)  # zeros fill what several share
        assert one.params[:shorter].tolist() == other.params[:shorter].tolist()
        assert not one.params[shorter:].any() and not other.params[shorter:].any()
    if len(rig.names) > 1:
        assert back.unit == "m"
        for one, other in zip(seen_from_first(rig), seen_from_first(back), strict=True):
            assert one.rotation == pytest.approx(other.rotation, abs=1e-12)
            assert one.translation == pytest.approx(other.translation, abs=1e-12 * 30)


def seen_from_first(rig: CameraRig) -> list[Transform]:
    assert rig.cam_from_rig is not None
    return [place @ rig.cam_from_rig[0].inverse for place in rig.cam_from_rig]


# ---- OpenCV reads its own ------------------------------------------------------------------


@pytest.mark.parametrize("to", ["opencv", "opencv_xml", "opencv_json"])
@given(name=NAMES)
@example(name='"')
@example(name="'")
@example(name="'both ends'")
@example(name='"both \\ <ends>"')
@settings(max_examples=25, deadline=None)
def test_opencv_reads_what_we_write(to: FormatName, name: str) -> None:
    rig = rig_of("brown", names=(name,))
    storage = in_opencv(rig, to)
    K = storage.getNode("camera_matrix").mat()
    k = storage.getNode("distortion_coefficients").mat()
    assert storage.getNode("camera_name").string() == name
    assert storage.getNode("image_width").real() == 640
    expected = cv2.projectPoints(POINTS, np.zeros(3), np.zeros(3), K, k)[0][:, 0]
    assert project(rig.cameras[0], POINTS) == pytest.approx(expected, abs=1e-9)


def in_opencv(rig: CameraRig, to: FormatName = "opencv") -> cv2.FileStorage:
    text = exported(rig, to).files[""].decode()
    return cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)


@pytest.mark.parametrize("lens", ["rational", "kannala_brandt"])
def test_opencv_sees_a_stereo_pair_as_we_do(lens: str) -> None:
    rig = rig_of(lens, lens)  # type: ignore[arg-type]
    storage = in_opencv(rig)
    M2, D2, R, T = (storage.getNode(name).mat() for name in ("M2", "D2", "R", "T"))
    turn = cv2.Rodrigues(R)[0]
    if lens == "kannala_brandt":
        seen = cv2.fisheye.projectPoints(POINTS[:, None], turn, T, M2, D2)[0][:, 0]
        assert storage.getNode("fisheye_model").real() == 1
    else:
        seen = cv2.projectPoints(POINTS, turn, T, M2, D2)[0][:, 0]
    assert rig.cam_from_rig is not None
    assert project(rig.cameras[1], rig.cam_from_rig[1] @ POINTS) == pytest.approx(seen, abs=1e-8)


def test_opencv_reads_several_as_its_sample_does(tmp_path: Path) -> None:
    """A fisheye among others: is_fisheye says which, and its coefficients are the first four."""
    rig = rig_of("brown", "kannala_brandt", "rational", names=("a,b", "c", "d"))
    storage = in_opencv(rig)
    names = ("Ks", "distortions", "rvecs", "Ts", "is_fisheye", "image_sizes")
    Ks, k, rvecs, Ts, fisheye, sizes = (storage.getNode(name).mat() for name in names)
    assert Ks.shape == (3, 3, 3) and fisheye.ravel().tolist() == [0, 1, 0]
    assert sizes.tolist() == [[640, 480]] * 3
    assert storage.getNode("cam_ids").string() == "a_b,c,d"
    assert rig.cam_from_rig is not None
    for i, camera in enumerate(rig.cameras):
        if camera.lens == "kannala_brandt":
            seen = cv2.fisheye.projectPoints(POINTS[:, None], rvecs[i], Ts[i], Ks[i], k[i, :4])
        else:
            seen = cv2.projectPoints(POINTS, rvecs[i], Ts[i], Ks[i], k[i])
        ours = project(camera, rig.cam_from_rig[i] @ POINTS)
        assert ours == pytest.approx(seen[0][:, 0], abs=1e-8)
    back = there(rig, "opencv", tmp_path / "x")
    assert [c.lens for c in back.cameras] == ["brown", "kannala_brandt", "rational"]
    assert apart_px(rig, back) < 1e-9


def test_a_pair_of_two_kinds_or_sizes_is_written_as_several(tmp_path: Path) -> None:
    mixed = rig_of("brown", "kannala_brandt")
    sized = rig_of("brown", "brown")
    sized = replace(sized, cameras=(sized.cameras[0], replace(sized.cameras[1], size=(800, 480))))
    for rig in (mixed, sized):
        assert b"Ks" in exported(rig, "opencv").files[""]
        assert apart_px(rig, there(rig, "opencv", tmp_path / "x")) < 1e-9


# ---- ROS: by what its rectification does ---------------------------------------------------


@pytest.mark.parametrize("lens", ["brown", "rational", "kannala_brandt"])
@pytest.mark.parametrize("move", [(-0.12, 0.003, 0.002), (0.002, -0.2, 0.01), (0.1, 0.0, 0.0)])
def test_ros_rectifies_a_pair_onto_one_row_or_column(
    lens: str, move: tuple[float, float, float], tmp_path: Path
) -> None:
    """A point goes through R and P of each camera; side by side, or one above the other."""
    rig = rig_of(lens, lens, names=("left", "right"))  # type: ignore[arg-type]
    second = Transform.exp(np.array([0.01, -0.02, 0.015]), np.array(move))
    rig = replace(rig, cam_from_rig=(Transform.identity(), second))
    export = exported(rig, "ros")
    entries = [yaml.safe_load(text) for text in export.files.values()]
    seen = []
    for entry, place in zip(entries, (Transform.identity(), second), strict=True):
        R, P = (
            np.array(entry[f"{name}_matrix"]["data"]) for name in ("rectification", "projection")
        )
        rectified = (place @ POINTS) @ R.reshape(3, 3).T
        # P's last column tells where the other camera stands: of the left one's frame.
        own = rectified @ P.reshape(3, 4)[:, :3].T
        seen.append(own[:, :2] / own[:, 2:])
    P2 = np.array(entries[1]["projection_matrix"]["data"]).reshape(3, 4)
    # OpenCV's fisheye module turns all pairs onto rows.
    across = 0 if abs(move[0]) > abs(move[1]) or lens == "kannala_brandt" else 1
    assert seen[0][:, 1 - across] == pytest.approx(seen[1][:, 1 - across], abs=1e-9)
    assert abs(P2[across, 3]) == pytest.approx(P2[across, across] * np.linalg.norm(move))
    disparity = (seen[1] - seen[0])[:, across]
    depth = (POINTS @ np.array(entries[0]["rectification_matrix"]["data"]).reshape(3, 3).T)[:, 2]
    assert disparity == pytest.approx(P2[across, 3] / depth, rel=1e-9)
    assert apart_px(rig, there(rig, "ros", tmp_path / "x").only(rig.names)) < 1e-9


def test_ros_pairs_that_rectify_nothing(tmp_path: Path) -> None:
    rig = rig_of("brown", "brown")
    apart = Transform.exp(np.array([0.0, 2.5, 0.0]), np.array([0.3, 0.0, 0.4]))
    back_to_back = replace(rig, cam_from_rig=(Transform.identity(), apart))
    assert any("look apart" in note for note in exported(back_to_back, "ros").notes)
    assert apart_px(back_to_back, there(back_to_back, "ros", tmp_path / "a")) < 1e-9
    turned = replace(
        rig, cam_from_rig=(Transform.identity(), Transform.exp(np.ones(3), np.zeros(3)))
    )
    assert any("one place" in note for note in exported(turned, "ros").notes)
    assert there(turned, "ros", tmp_path / "b").cam_from_rig is None


def test_the_left_camera_of_a_ros_pair_is_the_first_whatever_it_is_called(tmp_path: Path) -> None:
    rig = rig_of("brown", "brown", names=("z", "a"))
    assert there(rig, "ros", tmp_path / "x").names == ("z", "a")


def test_ros_cameras_that_are_all_called_camera_go_by_their_files(tmp_path: Path) -> None:
    export = exported(rig_of("brown", "brown"), "ros")
    for name, content in export.files.items():
        changed = re.sub(rb"camera_name: .*", b"camera_name: camera", content)
        (tmp_path / name).write_bytes(changed)
    assert read_calibration(tmp_path).names == ("cam0", "cam1")


# ---- Kalibr --------------------------------------------------------------------------------


def test_kalibr_chains_and_tells_who_overlaps() -> None:
    rig = rig_of("radtan", "kannala_brandt", "eucm", "double_sphere", names=("a", "b", "c", "d"))
    assert rig.cam_from_rig is not None
    away = Transform.exp(np.array([0.0, np.pi, 0.0]), np.array([0.0, 0.0, -0.2]))
    rig = replace(rig, cam_from_rig=(*rig.cam_from_rig[:3], away))
    export = exported(rig, "kalibr")
    chain = yaml.safe_load(export.files[""])
    assert list(chain) == ["cam0", "cam1", "cam2", "cam3"]
    step = np.array(chain["cam2"]["T_cn_cnm1"])
    assert rig.cam_from_rig[2].translation == pytest.approx(
        (step @ [*rig.cam_from_rig[1].translation, 1])[:3]
    )
    assert [chain[f"cam{i}"]["cam_overlaps"] for i in (0, 3)] == [[1, 2], []]
    assert chain["cam2"]["intrinsics"][:2] == rig.cameras[2].params[4:].tolist()  # alpha beta
    assert chain["cam3"]["intrinsics"][:2] == rig.cameras[3].params[4:].tolist()  # xi alpha
    assert [chain[f"cam{i}"]["camera_model"] for i in range(4)] == [
        "pinhole",
        "pinhole",
        "eucm",
        "ds",
    ]
    assert any("cam1 is b" in note for note in export.notes)


# ---- files ---------------------------------------------------------------------------------


@given(names=st.lists(NAMES, min_size=1, unique=True))
def test_file_names_are_plain_and_different(names: list[str]) -> None:
    found = file_names(tuple(names), ".yaml")
    assert len({name.lower() for name in found}) == len(names)
    assert all(re.fullmatch(r"[\w+][\w.+-]*\.yaml", name) for name in found)


def test_names_of_cameras_make_no_paths() -> None:
    assert file_names(("../../etc/passwd", "a/b", "a b", ".x"), "") == (
        "_.._etc_passwd", "a_b", "a_b_2", "x",
    )  # fmt: skip


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    write_folder_atomically(folder, {"a": b"1", "b/c": b"2"})
    write_folder_atomically(folder, {"a": b"3", "b/c": b"4"})
    assert (folder / "a").read_bytes() == b"3" and (folder / "b" / "c").read_bytes() == b"4"
    (folder / "photo.jpg").write_bytes(b"")
    with pytest.raises(CalibrationError, match=r"other files too, such as photo\.jpg"):
        write_folder_atomically(folder, {"a": b"5", "b/c": b"6"})
    assert (folder / "a").read_bytes() == b"3"
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CalibrationError, match="cannot write"):
        write_folder_atomically(tmp_path / "file" / "x", {"a": b""})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "out"]

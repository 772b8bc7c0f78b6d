"""Videos as scans: which frames are picked, and videos that give none."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic.scans import DATA, panning_frames, silent, video

from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.images import camera_names, read_scan
from sfm_calib.video import MOTION_STEP, find_videos, pick_frames, unpack


def read(scan, folder, n_frames=80):
    return read_scan(scan, Cache(folder / "cache"), "stem", n_frames, silent)


def refusal(scan, folder):
    with pytest.raises(CalibrationError) as caught:
        read(scan, folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def blurred(frame):
    return cv2.GaussianBlur(frame, (0, 0), 6)


@settings(deadline=None)
@given(st.lists(st.floats(0, 0.2), min_size=3, max_size=200), st.integers(3, 50), st.integers(0, 9))
def test_picked_frames_are_few_and_in_order(motion, most, seed):
    sharpness = np.random.default_rng(seed).random(len(motion))
    picked = pick_frames(np.array([0.0, *motion[1:]]), sharpness, most)
    assert picked == sorted(set(picked)) and 1 <= len(picked) <= most
    assert all(0 <= frame < len(motion) for frame in picked)


def test_the_sharpest_frame_of_each_stretch_is_picked():
    motion, sharpness = np.full(60, MOTION_STEP / 6), np.zeros(60)
    sharpness[::4] = 1.0
    picked = pick_frames(motion, sharpness, 80)
    assert 10 <= len(picked) <= 11 and sharpness[picked].all()


def test_a_standing_camera_gives_no_more_frames_than_its_moves_do():
    moving = np.concatenate([np.zeros(500), np.full(50, MOTION_STEP / 5), np.zeros(500)])
    picked = np.array(pick_frames(moving, np.ones(1050), 80))
    assert 10 <= len(picked) <= 11 and ((picked >= 500) & (picked <= 550)).sum() >= 9


def test_blurred_frames_are_avoided(tmp_path):
    frames = panning_frames(60, step=4)
    shaken = [blurred(f) if i % 3 else f for i, f in enumerate(frames)]
    unpack({"walk": video(tmp_path / "walk.avi", shaken)}, tmp_path / "out", 80, silent)
    picked = [int(path.stem) for path in (tmp_path / "out").iterdir()]
    assert len(picked) >= 8 and all(number % 3 == 0 for number in picked)


def test_a_video_is_a_scan_of_one_camera(tmp_path):
    path = video(tmp_path / "walk.avi", panning_frames(30))
    scan = read(path, tmp_path)
    assert scan.cameras == camera_names(path) == ("camera",) and scan.sizes == ((320, 240),)
    # 8 px of 320 a frame over 30 frames are nine steps of MOTION_STEP
    assert 7 <= len(scan.images) <= 11
    assert len(read(path, tmp_path, 4).images) == 4


def test_videos_of_a_folder_give_the_same_frames(tmp_path):
    frames = panning_frames(30)
    for name, view in (("left", frames), ("right", [f[::-1].copy() for f in frames])):
        video(tmp_path / "scan" / f"{name}.avi", view)
    scan = read(tmp_path / "scan", tmp_path)
    assert scan.cameras == camera_names(tmp_path / "scan") == ("left", "right")
    frames_of = [[i.frame for i in scan.images if i.camera == camera] for camera in (0, 1)]
    assert frames_of[0] == frames_of[1] and len(frames_of[0]) >= 7


def test_a_folder_of_folders_with_a_video_each(tmp_path):
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "take1.avi").write_bytes(b"")
        (tmp_path / name / ".take2.avi").write_bytes(b"")
    assert sorted(find_videos(tmp_path)) == ["left", "right"]
    (tmp_path / "left" / "take2.avi").write_bytes(b"")
    with pytest.raises(CalibrationError, match=r"take1.avi and take2.avi would both be .* left"):
        find_videos(tmp_path)


def test_two_videos_of_one_name(tmp_path):
    for suffix in ("avi", "mp4"):
        (tmp_path / f"left.{suffix}").write_bytes(b"")
    assert "left.avi and left.mp4 would both be" in refusal(tmp_path, tmp_path)


@pytest.mark.parametrize("content", [b"", b"no video", bytes(100_000)])
def test_a_video_that_cannot_be_decoded(tmp_path, content):
    (tmp_path / "walk.mp4").write_bytes(content)
    assert "walk.mp4 gave 0 frames" in refusal(tmp_path / "walk.mp4", tmp_path)


def test_a_camera_that_stands_still(tmp_path):
    path = video(tmp_path / "still.avi", panning_frames(1) * 20)
    message = refusal(path, tmp_path)
    assert "still.avi: the view moves by 0.0%" in message and "move the camera" in message


def test_real_videos_of_static_cameras_are_refused(tmp_path):
    scan = DATA / "charuco_rig4"
    if not scan.is_dir():
        pytest.skip("../shared/data/charuco_rig4 is not on this machine")
    assert "move the camera while it films" in refusal(scan, tmp_path)

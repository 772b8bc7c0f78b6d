"""Images of a board: folders and videos, how they are matched, and what is refused in one line."""

import cv2
import numpy as np
import pytest
from synthetic.scans import DATA, picture, silent, video

from sfm_calib import target_images
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.target_images import read_target

KALIBR = 1403636579763555584  # ns, as in EuRoC


def read(folder, matching="stem", video_frames=80, tolerance_s=None):
    cache = Cache(folder.parent / "cache")
    return read_target(folder, cache, matching, video_frames, tolerance_s, silent)


def refusal(folder, *args):
    with pytest.raises(CalibrationError) as caught:
        read(folder, *args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def stems(folder, **cameras):
    for camera, names in cameras.items():
        for name in names:
            picture(folder / camera / f"{name}.png")
    return folder


def frames_of(scan, camera=0):
    return [scan.frames[i.frame] for i in scan.images if i.camera == camera]


# ---- images ------------------------------------------------------------------------------------


def test_cameras_need_not_share_frames_and_one_image_is_enough(tmp_path):
    scan = read(stems(tmp_path / "s", left=["a", "b"], right=["b"], top=["close"]))
    assert scan.cameras == ("left", "right", "top") and scan.frames == ("a", "b", "close")
    assert [(i.camera, i.frame) for i in scan.images] == [(0, 0), (0, 1), (1, 1), (2, 2)]
    (warning,) = scan.warnings
    assert "by top" in warning and "left" not in warning


def test_a_flat_folder_is_one_camera(tmp_path):
    for number in (2, 10, 1):
        picture(tmp_path / "s" / f"{number}.png")
    scan = read(tmp_path / "s")
    assert scan.cameras == ("camera",) and scan.frames == ("1", "2", "10") and not scan.warnings


def test_matching_by_order(tmp_path):
    scan = read(stems(tmp_path / "s", left="abc", right=["x", "y"]), "order")
    assert [i.frame for i in scan.images] == [0, 1, 2, 0, 1]
    assert "left 3, right 2" in scan.warnings[0]


def test_matching_by_time(tmp_path):
    left = [KALIBR + i * 50_000_000 for i in range(4)]
    right = [t + 4_000_000 for t in left[1:]] + [left[-1] + 500_000_000]
    scan = read(stems(tmp_path / "s", left=left, right=right), "time")
    assert scan.frames == tuple(map(str, [*left, right[-1]]))
    assert [i.frame for i in scan.images] == [0, 1, 2, 3, 1, 2, 3, 4]
    assert scan.images[4].path == f"right/{right[0]}.png"
    (warning,) = scan.warnings
    assert "read as ns" in warning and "6 of 8 found a partner within 16.7 ms" in warning
    assert "2 found none" in warning and "gap is 4 ms" in warning


def test_a_tolerance_below_the_gaps_leaves_every_image_alone(tmp_path):
    folder = stems(tmp_path / "s", left=["0.0", "1.0"], right=["0.1", "1.1"])
    assert len(read(folder, "time", 80, 0.1).frames) == 2
    scan = read(folder, "time", 80, 0.09)
    assert scan.frames == ("0.0", "0.1", "1.0", "1.1") and "by left, right" in scan.warnings[1]


def test_frames_by_time_are_in_order_of_time(tmp_path):
    for name in ("9.5", "10.25", "10.125"):
        picture(tmp_path / "s" / f"{name}.png")
    scan = read(tmp_path / "s", "time")
    assert scan.frames == ("9.5", "10.125", "10.25") and not scan.warnings


def test_stems_that_are_no_times(tmp_path):
    message = refusal(stems(tmp_path / "s", left=["1.0", "2.0"], right=["img3"]), "time")
    assert "camera right: the stem of img3.png is no number" in message


def test_two_images_within_the_tolerance(tmp_path):
    folder = stems(tmp_path / "s", left=["1.0", "2.0"], right=["1.9", "2.2"])
    message = refusal(folder, "time", 80, 0.25)
    assert "camera right: 1.9.png and 2.2.png both lie within 250 ms of left's 2.0.png" in message
    assert "tolerance_s" in message


def test_unreadable_images_become_warnings(tmp_path):
    folder = stems(tmp_path / "s", left="abc", right="abc")
    (folder / "left" / "b.png").write_bytes(b"no image")
    scan = read(folder)
    assert len(scan.images) == 5 and "b.png is unreadable" in scan.warnings[0]
    for path in (folder / "right").iterdir():
        path.write_bytes(b"")
    assert "camera right: none of its images" in refusal(folder)


def test_sizes_that_differ_within_a_camera_are_counted(tmp_path):
    folder = stems(tmp_path / "s", left="abc")
    picture(folder / "left" / "0.png", size=(24, 32))
    message = refusal(folder)
    assert "camera left has images of 2 sizes (3 of 32x24, 1 of 24x32)" in message
    assert "remove the odd images" in message


def test_too_few_images(tmp_path):
    folder = stems(tmp_path / "s", left="ab")
    (folder / "left" / "b.png").write_bytes(b"")
    message = refusal(folder)
    assert "holds 1 usable image;" in message and "b.png is unreadable" in message


def test_no_folder_and_no_images(tmp_path):
    assert "no such folder" in refusal(tmp_path / "nowhere")
    (tmp_path / "s").mkdir()
    assert "holds no images" in refusal(tmp_path / "s")
    assert "is no video" in refusal(picture(tmp_path / "s" / "a.png"))


# ---- videos ------------------------------------------------------------------------------------

SIZE = (160, 120)


def board_frames(places, blurred=(), seed=0):
    """A static view in which a small board is at `places` (px from the left); some are blurred."""
    rng = np.random.default_rng(seed)
    still = cv2.GaussianBlur(rng.integers(60, 200, (SIZE[1], SIZE[0], 3), np.uint8), (0, 0), 3)
    board = np.kron(np.indices((4, 4)).sum(axis=0) % 2, np.ones((5, 5)))[..., None] * 255
    frames = []
    for number, place in enumerate(places):
        frame = still.copy()
        frame[50:70, place : place + 20] = board
        frames.append(cv2.GaussianBlur(frame, (0, 0), 2) if number in blurred else frame)
    return frames


def marked(n, first=0):
    """Frames that say their number: a level of grey, 4 levels a frame."""
    return [np.full((SIZE[1], SIZE[0], 3), 40 + 4 * (first + i), np.uint8) for i in range(n)]


def numbers(scan, camera=0):
    """What the frames picked from `marked` videos say."""
    paths = [scan.root / i.path for i in scan.images if i.camera == camera]
    return [round((cv2.imread(str(p), cv2.IMREAD_GRAYSCALE).mean() - 40) / 4) for p in paths]


def rig(folder, **n_frames):
    for camera, n in n_frames.items():
        video(folder / f"{camera}.avi", marked(n))
    return folder


def times_csv(path, rows, heading="sync_index,cam_id,frame_time"):
    path.write_text("\n".join([heading, *(",".join(map(str, row)) for row in rows)]))


def test_a_board_that_moves_before_a_static_camera(tmp_path):
    places = [0] * 10 + list(range(0, 80, 4)) + [80] * 30
    path = video(tmp_path / "s.avi", board_frames(places))
    scan = read(path)
    assert scan.cameras == ("camera",) and scan.sizes == (SIZE,)
    picked = [int(name) for name in scan.frames]
    # every step is a view, and the 40 frames without one are not
    assert picked == sorted(picked) and 18 <= len(picked) <= 21
    assert sum(10 <= frame < 31 for frame in picked) >= len(picked) - 2
    assert scan.warnings == (f"{len(picked)} of 60 moments of the video picked",)


def test_frames_are_few_and_spread_over_the_motion(tmp_path):
    path = video(tmp_path / "s.avi", board_frames(range(0, 120, 2)))
    picked = np.array([int(name) for name in read(path, "stem", 3).frames])
    assert len(picked) == 9 and np.diff(picked).max() <= 13


def test_slow_motion_is_summed_up(tmp_path):
    path = video(tmp_path / "s.avi", board_frames([i // 6 for i in range(120)]))
    assert 12 <= len(read(path).frames) <= 20


def test_blurred_frames_are_avoided(tmp_path):
    places = list(range(0, 120, 2))
    blurred = {i for i in range(len(places)) if i % 3}
    scan = read(video(tmp_path / "s.avi", board_frames(places, blurred)), "stem", 3)
    assert all(int(name) not in blurred for name in scan.frames)


def test_a_board_that_is_held_is_taken_while_it_is(tmp_path):
    places = [
        p
        for stop in range(5)
        for p in [*range(20 * stop, 20 * stop + 20, 4), *[20 * stop + 20] * 6]
    ]
    held = {i for i in range(1, len(places)) if places[i] == places[i - 1]}
    picked = {
        int(n) for n in read(video(tmp_path / "s.avi", board_frames(places)), "stem", 2).frames
    }
    assert len(picked) == 6 and len(picked & held) >= 5


def test_a_view_in_which_nothing_moves_gives_one_frame(tmp_path):
    for camera in ("a", "b", "c"):
        video(tmp_path / "s" / f"{camera}.avi", board_frames([5] * 9, seed=ord(camera)))
    scan = read(tmp_path / "s")
    assert len(scan.images) == 3 and len(scan.frames) == 1
    lone = video(tmp_path / "lone.avi", board_frames([5] * 9))
    assert "holds 1 usable image" in refusal(lone)


def test_videos_are_matched_by_frame_number(tmp_path):
    scan = read(rig(tmp_path / "s", left=12, right=9))
    assert scan.cameras == ("left", "right")
    for camera, n in ((0, 12), (1, 9)):
        assert numbers(scan, camera) == [int(name) for name in frames_of(scan, camera)]
        assert max(numbers(scan, camera)) >= n - 3
    assert "matched by frame number" in scan.warnings[0]
    assert "left 12, right 9" in scan.warnings[1] and "together?" in scan.warnings[1]


def test_videos_of_different_rates_are_doubted(tmp_path):
    folder = rig(tmp_path / "s", left=9)
    writer = cv2.VideoWriter(str(folder / "right.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 15, SIZE)
    for frame in marked(9):
        writer.write(frame)
    writer.release()
    assert "left 30, right 15" in read(folder).warnings[1]


def test_frames_are_unpacked_once(tmp_path, monkeypatch):
    folder = rig(tmp_path / "s", left=6, right=6)
    first = read(folder)
    monkeypatch.setattr(target_images, "unpack_moments", None)
    assert read(folder) == first
    monkeypatch.undo()
    times_csv(folder / "timestamps.csv", [(i, c, i) for i in range(6) for c in ("left", "right")])
    assert read(folder) != first  # what they are matched by is part of the key


def test_sub_folders_with_a_video_each(tmp_path):
    for camera in ("left", "right"):
        video(tmp_path / "s" / camera / "take.avi", marked(6))
        (tmp_path / "s" / camera / "take.txt").write_text("\n".join(map(str, range(6))))
    scan = read(tmp_path / "s")
    assert scan.cameras == ("left", "right") and "matched by time" in scan.warnings[0]


def test_timestamps_csv_gives_the_sync_index(tmp_path):
    folder = rig(tmp_path / "s", cam_0=6, cam_1=5)
    # cam_1 starts one moment later, and its rows are out of order in the file
    rows = [(100 + i, 0, 10 + i) for i in range(6)] + [(101 + i, 1, 11.02 + i) for i in range(5)]
    times_csv(folder / "timestamps.csv", [*rows[::-1], (100, 7, 10.0)])
    scan = read(folder)
    assert {"000100", "000101"} & set(scan.frames)
    for camera, start in ((0, 100), (1, 101)):
        assert numbers(scan, camera) == [int(n) - start for n in frames_of(scan, camera)]
    assert set(frames_of(scan, 0)) & set(frames_of(scan, 1))
    assert "6 moments, their times up to 20 ms apart; 1 of its cam_id" in scan.warnings[0]
    assert "matched by frame number" in read(folder, "order").warnings[0]


@pytest.mark.parametrize(
    ("rows", "heading", "message"),
    [
        ([(i, c, i) for i in range(6) for c in (0, 1)], "sync_index,port,time", "no column cam_id"),
        ([(i, 0, i) for i in range(6)], None, "no times of cam_1 (its cam_id are 0)"),
        ([(i, c, i) for i in range(5) for c in (0, 1)], None, "has 5 times of cam_0"),
        (
            [(3, c, i) for i in range(6) for c in (0, 1)],
            None,
            "two times of cam_0 with sync_index 3",
        ),
        ([(0, 0, 0), ("x", 0, 1)], None, "line 3: sync_index 'x'"),
        ([(0, 0, 0), (1, 0, "nan")], None, "line 3: sync_index '1' and frame_time 'nan'"),
        ([(0, 0)], None, "line 2"),
    ],
)
def test_a_timestamps_csv_that_does_not_fit(tmp_path, rows, heading, message):
    folder = rig(tmp_path / "s", cam_0=6, cam_1=6)
    times_csv(folder / "timestamps.csv", rows, heading or "sync_index,cam_id,frame_time")
    assert message in refusal(folder)


def test_times_beside_each_video(tmp_path):
    folder = rig(tmp_path / "s", left=8, right=6)
    left = [KALIBR + i * 100_000_000 for i in range(8)]
    right = [t + 7_000_000 for t in left[2:]]
    (folder / "left.csv").write_text("time\n" + "\n".join(map(str, left)))
    (folder / "right.txt").write_text("# ns\n" + "\n".join(map(str, right)) + "\n\n")
    scan = read(folder, "time")
    pairs = {
        name: (a, b)
        for a, name in zip(numbers(scan, 0), frames_of(scan, 0), strict=True)
        for b, other in zip(numbers(scan, 1), frames_of(scan, 1), strict=True)
        if name == other
    }
    assert len(pairs) >= 3 and all(a == b + 2 for a, b in pairs.values())
    assert "12 of 14 found a partner within 33.3 ms" in scan.warnings[0]
    assert "gap is 7 ms" in scan.warnings[0]


def test_times_that_do_not_fit_the_videos(tmp_path):
    folder = rig(tmp_path / "s", left=6, right=6)
    assert "no times beside the 2 videos" in refusal(folder, "time")
    (folder / "left.csv").write_text("\n".join(map(str, range(6))))
    assert "left.csv holds times and right.avi has none" in refusal(folder)
    (folder / "right.txt").write_text("\n".join(map(str, range(5))))
    assert "right.txt has 5 times of right and its video has 6 frames" in refusal(folder)
    (folder / "right.txt").write_text("0\n1\nnoon")
    assert "right.txt line 3: 'noon' is no time" in refusal(folder)
    (folder / "right.txt").write_text("0\n2\n1")
    assert "1 follows 2" in refusal(folder)
    (folder / "right.txt").write_text("heading\n")
    assert "holds no times" in refusal(folder)
    (folder / "right.txt").write_bytes(b"0\n\xff")
    assert "byte 2 is not UTF-8" in refusal(folder)
    (folder / "right.csv").write_text("0")
    assert "right.csv and right.txt may both" in refusal(folder)


def test_a_video_that_cannot_be_decoded(tmp_path):
    folder = rig(tmp_path / "s", left=6)
    (folder / "right.avi").write_bytes(b"no video")
    assert "right.avi gave 0 frames" in refusal(folder)


def test_real_videos_agree_with_their_timestamps(tmp_path):
    if not (DATA / "charuco_rig4").is_dir():
        pytest.skip("../shared/data/charuco_rig4 is not on this machine")
    cache = Cache(tmp_path / "cache")
    scan = read_target(DATA / "charuco_rig4", cache, "stem", 4, None, silent)
    assert len(scan.cameras) == 4 and len(scan.frames) == 12 and len(scan.images) == 48
    assert "sync_index of timestamps.csv: 48 moments" in scan.warnings[0]

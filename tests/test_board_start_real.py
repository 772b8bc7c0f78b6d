"""Where board calibration starts on real boards: within a few per cent of their references."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic.scans import DATA
from test_board_start import View, grid

from graphs.board_start import BoardScene, BoardStart, start_from_board
from graphs.frames import FloatArray, Transform, angle_between

pytestmark = pytest.mark.slow


def folder(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f"../shared/data/{name} is not on this machine")
    return DATA / name


def view(camera: int, frame: int, corner: FloatArray, pixels: FloatArray) -> View:
    flat = pixels.reshape(-1, 2).astype(np.float64)
    return View(camera, frame, np.ravel(corner).astype(np.int64), flat, np.full(len(flat), 0.1))


def checkerboards(
    folders: list[Path], pattern: tuple[int, int]
) -> tuple[list[View], list[tuple[int, int]]]:
    views, sizes = [], []
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for camera, images in enumerate(folders):
        paths = sorted(images.glob("*.jpg")) + sorted(images.glob("*.png"))
        for path in paths:
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            found, corners = cv2.findChessboardCornersSB(image, pattern, flags=flags)
            if found:
                frame = int("".join(c for c in path.stem if c.isdigit()))
                views.append(view(camera, frame, np.arange(len(corners)), corners))
        sizes.append(image.shape[::-1])
    return views, sizes


def rotation_deg(transform: Transform) -> float:
    return float(np.degrees(angle_between(np.eye(3), transform.rotation)))


def test_the_corridor_whose_board_can_be_numbered_from_two_ends() -> None:
    place = folder("corridor_stereo") / "boards"
    views, sizes = checkerboards([place / "left", place / "right"], (8, 6))
    board = grid(8, 6, 0.025)
    turn = np.arange(48)[::-1]
    found = start_from_board(BoardScene(views, board, ["left", "right"], sizes, (turn,)))
    assert found.dropped == () and found.notes == ()
    for camera, focal_px in zip(found.cameras, (690, 687), strict=True):
        assert camera.lens == "radial" and abs(camera.params[0] / focal_px - 1) < 0.05
    assert abs(np.linalg.norm(found.cam_from_rig[1].translation) - 0.1529) < 0.003
    assert abs(rotation_deg(found.cam_from_rig[1]) - 0.73) < 0.5
    assert max(found.rms_px.values()) < 0.6


def test_the_opencv_pair() -> None:
    place = folder("opencv_stereo")
    views, sizes = checkerboards([place / "left", place / "right"], (9, 6))
    found = start_from_board(BoardScene(views, grid(9, 6, 1.0), ["left", "right"], sizes))
    assert found.dropped == () and found.notes == ()
    for camera in found.cameras:
        assert abs(camera.params[0] / 534 - 1) < 0.02
    assert abs(np.linalg.norm(found.cam_from_rig[1].translation) - 3.3) < 0.1


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_cameras_of_a_motion_capture_studio(number: int) -> None:
    place = folder("mocap_static4") / "intrinsics" / f"int_cam0{number}_img"
    views, sizes = checkerboards([place], (4, 7))
    found = start_from_board(BoardScene(views, grid(4, 7, 0.06), ["cam"], sizes))
    assert abs(found.cameras[0].params[0] / 1680 - 1) < 0.01
    assert found.dropped == ()


def charuco_views(place: Path) -> tuple[list[View], FloatArray]:
    """The pattern is printed on both sides, mirrored on the back."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    board = cv2.aruco.CharucoBoard((4, 5), 0.054, 0.0405, dictionary)
    detector = cv2.aruco.CharucoDetector(board)
    with (place / "timestamps.csv").open() as file:
        times = sorted(csv.DictReader(file), key=lambda row: float(row["frame_time"]))
    views = []
    for camera in range(4):
        video = cv2.VideoCapture(str(place / f"cam_{camera}.mp4"))
        for row in (row for row in times if int(row["cam_id"]) == camera):
            image = 255 - cv2.cvtColor(video.read()[1], cv2.COLOR_BGR2GRAY)
            for mirrored in (False, True):
                shown = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
                corners, ids, _, _ = detector.detectBoard(shown)
                if ids is not None and len(ids) >= 4:
                    pixels = corners.reshape(-1, 2).astype(np.float64)
                    if mirrored:
                        pixels[:, 0] = image.shape[1] - 1 - pixels[:, 0]
                    views.append(view(camera, int(row["sync_index"]), ids, pixels))
                    break
    return views, np.asarray(board.getChessboardCorners(), dtype=np.float64)


def reference_rig(place: Path) -> list[Transform]:
    import tomllib

    cameras = tomllib.loads((place / "camera_array.toml").read_text())["cameras"]
    each = [cameras[str(i)] for i in range(4)]
    return [Transform(np.array(c["rotation"]), np.array(c["translation"])) for c in each]


@pytest.fixture(scope="module")
def charuco() -> tuple[BoardStart, list[Transform]]:
    place = folder("charuco_rig4")
    views, corners_m = charuco_views(place)
    names, sizes = [f"cam{i}" for i in range(4)], [(1280, 720)] * 4
    return start_from_board(BoardScene(views, corners_m, names, sizes)), reference_rig(place)


def test_four_cameras_around_a_board_that_has_two_faces(
    charuco: tuple[BoardStart, list[Transform]],
) -> None:
    found, reference = charuco
    for camera, focal_px in zip(found.cameras, (895, 705, 635, 642), strict=True):
        assert abs(camera.params[0] / focal_px - 1) < 0.05
    for ours, there in zip(found.cam_from_rig, reference, strict=True):
        true = there @ reference[0].inverse
        assert np.degrees(angle_between(ours.rotation, true.rotation)) < 3
        assert np.linalg.norm(ours.inverse.translation - true.inverse.translation) < 0.06
    assert found.notes == () and np.median(list(found.rms_px.values())) < 0.6

"""Simulated scans: reproducible, geometrically exact, whole or absent."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
import yaml
from synthetic.scans import simulation

from graphs.camera import Camera, project, unproject
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.open3d_import import import_open3d
from sfm_calib.result import load_calibration, save_calibration
from sfm_calib.simulate import render as rendering
from sfm_calib.simulate.render import RenderOptions, ray_table, render
from sfm_calib.simulate.rigs import CAMERA_COUNT, TrajectoryName, make_rig, make_trajectory
from sfm_calib.simulate.room import Room, build_room
from sfm_calib.simulate.scan import SimulateOptions, rig_like, simulate_scan
from sfm_calib.simulate.textures import pink_noise

try:
    import_open3d()
    OPEN3D_MISSING = ""
except CalibrationError as missing:
    OPEN3D_MISSING = str(missing)

needs_open3d = pytest.mark.skipif(bool(OPEN3D_MISSING), reason=OPEN3D_MISSING)

SMALL = SimulateOptions(rig="stereo", frames=2, size=(96, 72), supersampling=2)


def silent(stage: str, done: int, total: int) -> None:
    pass


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def files_below(folder: Path) -> dict[str, bytes]:
    found = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


@pytest.fixture(scope="module")
def charuco_room() -> Room:
    return build_room(rng(), "charuco", texels_per_m=100)


@pytest.fixture(scope="module")
def small_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scan") / "out"
    simulate_scan(SMALL, out, silent)
    return out


@needs_open3d
def test_same_seed_gives_same_bytes_and_another_seed_does_not(
    small_scan: Path, tmp_path: Path
) -> None:
    simulate_scan(SMALL, tmp_path / "again", silent)
    simulate_scan(SMALL.model_copy(update={"seed": 1}), tmp_path / "other", silent)
    first, other = files_below(small_scan), files_below(tmp_path / "other")
    assert files_below(tmp_path / "again") == first
    assert first["scan/cam0/000000.png"] != other["scan/cam0/000000.png"]


@needs_open3d
def test_scan_holds_images_rig_file_and_truth(small_scan: Path) -> None:
    stems = {f"scan/cam{c}/{f:06d}.png" for c in range(2) for f in range(2)}
    assert set(files_below(small_scan)) == stems | {
        "scan/rig.yaml",
        "truth.json",
        "truth_frames.json",
    }
    image = cv2.imread(str(small_scan / "scan/cam1/000001.png"), cv2.IMREAD_UNCHANGED)
    assert image.shape == (72, 96)
    assert image.dtype == np.uint8
    assert image.std() > 15

    calibration = load_calibration(small_scan / "truth.json")
    rig = make_rig("stereo", "radial", (96, 72))
    np.testing.assert_array_equal(calibration.camera("cam1").params, rig.cameras[1].params)
    baseline = yaml.safe_load((small_scan / "scan/rig.yaml").read_text())["scale"]["baseline"]
    length_m = np.linalg.norm(calibration.cam_from_rig("cam1").inverse.translation)
    assert baseline["cameras"] == ["cam0", "cam1"]
    assert baseline["sigma_m"] == 0.0005
    assert abs(baseline["length_m"] - length_m) <= 0.00005 + 1e-12

    frames = json.loads((small_scan / "truth_frames.json").read_text())
    assert sorted(frames) == ["000000", "000001"]
    Transform.from_wxyz(**frames["000001"])


@needs_open3d
def test_mono_images_lie_in_scan_itself_and_a_board_is_described(tmp_path: Path) -> None:
    options = SMALL.model_copy(update={"rig": "mono", "frames": 1, "board": "charuco"})
    simulate_scan(options, tmp_path / "out", silent)
    assert set(files_below(tmp_path / "out")) == {
        "scan/000000.png",
        "truth.json",
        "truth_frames.json",
        "board.yaml",
        "truth_board.json",
    }
    assert yaml.safe_load((tmp_path / "out/board.yaml").read_text())["type"] == "charuco"


def views_of_board(lens: LensName) -> Iterator[tuple[Camera, Transform]]:
    """A camera, and where it stands before the board: straight, aslant and rolled."""
    camera = make_rig("mono", lens).cameras[0]
    nearer = 0.3 if lens == "kannala_brandt" else 0.0
    for x, y, z, turn in ((0.0, 1.3, 1.5, (0, 0, 0)), (0.45, 1.2, 1.6, (3, -25, 20))):
        facing = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # along the world's y
        turned = Transform.exp(np.deg2rad(turn), np.zeros(3)).rotation
        world_from_cam = Transform(facing.T @ turned, np.array([x, y + nearer, z]))
        yield camera, world_from_cam.inverse


@pytest.mark.slow
@needs_open3d
@pytest.mark.parametrize("lens", ["radial", "kannala_brandt"])
def test_charuco_corners_are_where_the_lens_projects_them(
    charuco_room: Room, lens: LensName
) -> None:
    board = charuco_room.board
    assert board
    pattern = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_m,
        board.marker_m,
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)),
    )
    errors, options = [], RenderOptions(supersampling=2)
    table = ray_table(make_rig("mono", lens).cameras[0], 2)
    for camera, cam_from_world in views_of_board(lens):
        image = render(camera, cam_from_world, charuco_room, rng(), options, table)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(image)
        truth = project(camera, cam_from_world @ (board.world_from_board @ board.corners_m))
        errors.append(corners.reshape(-1, 2) - truth[ids.ravel()])
    assert_no_bias(np.concatenate(errors), at_least=60)


@pytest.mark.slow
@needs_open3d
def test_checkerboard_corners_are_where_the_lens_projects_them() -> None:
    room = build_room(rng(), "checkerboard", texels_per_m=50)
    board = room.board
    assert board
    camera, cam_from_world = next(views_of_board("radial"))
    image = render(camera, cam_from_world, room, rng(), RenderOptions(supersampling=2))
    found, corners = cv2.findChessboardCornersSB(
        image, (board.columns - 1, board.rows - 1), flags=cv2.CALIB_CB_ACCURACY
    )
    assert found
    truth = project(camera, cam_from_world @ (board.world_from_board @ board.corners_m))
    corners = corners.reshape(-1, 2)
    nearest = np.linalg.norm(truth[:, None] - corners, axis=2).argmin(1)
    assert_no_bias(corners[nearest] - truth, at_least=48)


def assert_no_bias(errors_px: FloatArray, at_least: int) -> None:
    """Half a pixel of offset, or a distortion left out, would show here."""
    assert len(errors_px) >= at_least
    assert np.median(np.linalg.norm(errors_px, axis=1)) < 0.1
    assert (np.abs(errors_px.mean(0)) < 0.03).all()


@pytest.mark.slow
@needs_open3d
def test_continued_rays_see_what_cast_rays_see(
    charuco_room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = make_rig("mono", size=(320, 240)).cameras[0]
    table, options = ray_table(camera), RenderOptions(noise=0)
    for cam_from_world in make_trajectory("handheld", 40, rng())[::13]:
        quick = render(camera, cam_from_world, charuco_room, rng(), options, table)
        with monkeypatch.context() as patch:
            patch.setattr(rendering, "_edges", lambda triangle, *_: np.ones_like(triangle, bool))
            full = render(camera, cam_from_world, charuco_room, rng(), options, table)
        difference = np.abs(quick.astype(int) - full)
        assert difference.mean() < 0.02
        assert np.percentile(difference, 99.9) <= 2


@pytest.mark.slow
@needs_open3d
def test_supersampling_removes_aliases(charuco_room: Room) -> None:
    camera = make_rig("mono", size=(160, 120)).cameras[0]
    cam_from_world = make_trajectory("handheld", 1, rng(4))[0]

    def image(supersampling: int) -> FloatArray:
        options = RenderOptions(supersampling=supersampling, noise=0)
        return render(camera, cam_from_world, charuco_room, rng(), options).astype(float)

    best = image(6)
    assert np.sqrt(np.square(image(3) - best).mean()) < 0.6  # the sensor's noise is 2
    assert np.sqrt(np.square(image(1) - best).mean()) > 0.6


@needs_open3d
def test_noise_has_the_level_asked_for(charuco_room: Room) -> None:
    camera = make_rig("mono", size=(160, 120)).cameras[0]
    cam_from_world, table = make_trajectory("static", 1, rng())[0], ray_table(camera)
    a, b = (
        render(camera, cam_from_world, charuco_room, rng(s), RenderOptions(noise=4.0), table)
        for s in (1, 2)
    )
    grey = (np.abs((a.astype(float) + b) / 2 - 128) < 15).ravel()
    spread = (a.astype(float) - b).ravel()[grey].std() / np.sqrt(2)
    assert grey.sum() > 500
    assert spread == pytest.approx(4.0, rel=0.08)


@needs_open3d
def test_pixels_the_lens_cannot_see_are_black(charuco_room: Room) -> None:
    params = np.array([80.0, 80.0, 79.5, 59.5, -0.4, 0.0])
    camera = Camera("folding", "radial", (160, 120), params)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    blind = np.isnan(unproject(camera, np.stack([u, v], -1))[..., 0])
    cam_from_world = make_trajectory("static", 1, rng())[0]
    image = render(camera, cam_from_world, charuco_room, rng(), RenderOptions(noise=0))
    inner = cv2.erode(blind.astype(np.uint8), np.ones((5, 5))) > 0
    assert inner.any()
    assert image[inner].max() == 0
    assert image[60, 80] > 0


@needs_open3d
@pytest.mark.parametrize("name", get_args(TrajectoryName))
def test_cameras_stay_half_a_metre_clear(charuco_room: Room, name: TrajectoryName) -> None:
    for seed in range(5):
        for rig_name in CAMERA_COUNT:
            rig = make_rig(rig_name)
            placed = make_trajectory(name, 150, rng(seed))
            centres = [(c @ f).inverse.translation for f in placed for c in rig.cam_from_rig]
            assert charuco_room.distance_m(np.array(centres)).min() > 0.5


@pytest.mark.parametrize("seed", range(5))
def test_handheld_scan_tilts_and_keeps_its_overlap(seed: int) -> None:
    placed = make_trajectory("handheld", 40, rng(seed))
    forward = np.array([t.rotation[2] for t in placed])  # the rig's z in the world
    turns_deg = np.rad2deg(np.arccos((forward[1:] * forward[:-1]).sum(1)))
    assert turns_deg.max() < 22  # of a field of view of 61 x 48 degrees
    up = np.array([t.rotation[:, 2] for t in placed])  # the world's z in the rig
    roll_deg = np.rad2deg(np.arctan2(up[:, 0], -up[:, 1]))
    assert 30 < np.abs(roll_deg).max() < 47
    assert np.ptp(roll_deg) > 50


def test_noise_texture_is_the_same_nowhere() -> None:
    field = pink_noise((256, 256), 100.0, rng())
    assert field.std() == pytest.approx(1.0, abs=1e-3)
    fine = field - cv2.GaussianBlur(field, (0, 0), 4)
    spectrum = np.fft.fft2(fine)
    likeness = np.fft.ifft2(np.abs(spectrum) ** 2).real
    likeness /= likeness[0, 0]
    likeness[:16, :16] = likeness[-16:, :16] = likeness[:16, -16:] = likeness[-16:, -16:] = 0
    assert likeness.max() < 0.2


@pytest.mark.parametrize(
    ("change", "number"),
    [
        ({"frames": 0}, "0"),
        ({"size": (640, 32)}, "640 x 32"),
        ({"size": (9000, 480)}, "9000"),
        ({"noise": -1.0}, "-1"),
        ({"noise": float("nan")}, "nan"),
        ({"supersampling": 0}, "0"),
        ({"supersampling": 8, "size": (4000, 3000)}, "768 million"),
        ({"seed": -3}, "-3"),
    ],
)
def test_impossible_scans_are_refused(
    change: dict[str, object], number: str, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match="give") as caught:
        simulate_scan(SMALL.model_copy(update=change), tmp_path / "out", silent)
    assert number in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@needs_open3d
def test_a_failed_run_leaves_nothing(tmp_path: Path) -> None:
    def cancel(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("images", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_scan(SMALL, tmp_path / "out", cancel)
    assert list(tmp_path.iterdir()) == []


@needs_open3d
def test_an_occupied_folder_is_replaced_only_on_request(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "scan").mkdir(parents=True)
    (out / "scan" / "stale.png").write_text("old")
    (out / "notes.txt").write_text("mine")
    options = SMALL.model_copy(update={"rig": "mono", "frames": 1})
    with pytest.raises(CalibrationError, match=r"holds 2 things, notes\.txt"):
        simulate_scan(options, out, silent)
    simulate_scan(options, out, silent, overwrite=True)
    assert (out / "notes.txt").read_text() == "mine"
    assert [path.name for path in (out / "scan").iterdir()] == ["000000.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(CalibrationError, match="is a file"):
        simulate_scan(SMALL, tmp_path / "out", silent, overwrite=True)


def test_missing_open3d_is_one_line_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(CalibrationError, match="pip install") as caught:
        simulate_scan(SMALL, tmp_path / "out", silent)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_rig_like_a_calibration(tmp_path):
    pytest.importorskip("open3d", exc_type=ImportError)
    path = simulation() / "truth.json"
    options = SimulateOptions(like=path, frames=1, supersampling=1, noise=0)
    calibration = simulate_scan(options, tmp_path / "out", lambda *done: None)
    original = load_calibration(path)
    assert calibration.cameras == original.cameras
    ours, theirs = calibration.cam_from_rig("cam1"), original.cam_from_rig("cam1")
    np.testing.assert_allclose(ours.rotation, theirs.rotation, atol=1e-12)
    np.testing.assert_allclose(ours.translation, theirs.translation, atol=1e-12)
    image = cv2.imread(str(tmp_path / "out" / "scan" / "cam1" / "000000.png"))
    assert image.shape[1::-1] == original.cameras["cam1"].size and image.std() > 10
    turned = original.model_copy(update={"rig": original.rig.model_copy(update={"metric": False})})
    save_calibration(turned, tmp_path / "unit.json")
    with pytest.raises(CalibrationError, match="not metric"):
        rig_like(tmp_path / "unit.json")

"""`undistort` and `rectify`: images of a known scene through a lens, and what is refused."""

import cv2
import numpy as np
import pytest
from synthetic.scans import panning_frames, picture, video

from graphs.camera import Camera, image_pixels, unproject
from graphs.frames import Transform, exp_rotation
from sfm_calib.cli import main
from sfm_calib.formats import read_calibration
from sfm_calib.result import load_calibration, save_calibration, truth

SIZE = (160, 120)
LENSES = {
    "radtan": np.array([140.0, 141, 84, 57, -0.3, 0.12, 1e-3, -5e-4]),
    "kannala_brandt": np.array([90.0, 91, 82, 58, -0.037, -0.009, 0.009, -0.004]),
}


def camera(lens="radtan", name="cam", size=SIZE):
    return Camera(name, lens, size, LENSES[lens])


def calibration(path, *cameras, rig=None):
    cameras = cameras or (camera(),)
    rig = rig or [Transform.identity()] * len(cameras)
    save_calibration(truth(list(cameras), rig, "test"), path)
    return path


def waves(rays):
    """Grey levels 0 to 1 of a far scene: smooth on the plane z = 1, so that it can be resampled."""
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    return 0.5 + 0.2 * np.sin(14 * x + 3 * y) + 0.2 * np.cos(11 * y - 2 * x)


def taken_by(taker, levels=255.0, dtype=np.uint8):
    rays = unproject(taker, image_pixels(taker.size, taker.size)[2])
    return np.round(waves(rays) * levels).reshape(taker.size[1], taker.size[0]).astype(dtype)


def write(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def run(*arguments):
    return main([str(a) for a in arguments])


def refused(capsys, *arguments):
    assert run(*arguments) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("sfm-calib: ")
    return said


# ---- undistort -----------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", sorted(LENSES))
@pytest.mark.parametrize(
    "flags", [(), ("--view", "whole"), ("--view", "keep", "--scale", "0.5"), ("--fov", "50")]
)
def test_an_image_is_as_the_written_camera_takes_it(tmp_path, lens, flags):
    file = calibration(tmp_path / "calibration.json", camera(lens))
    image = write(tmp_path / "in" / "a.png", taken_by(camera(lens)))
    out = tmp_path / "out"
    assert run("undistort", file, image, "-o", out, *flags) == 0
    found = cv2.imread(str(out / "a.png"), cv2.IMREAD_UNCHANGED)
    virtual = load_calibration(out / "calibration.json").camera("cam")
    assert virtual.lens == "pinhole" and found.shape == virtual.size[::-1]
    wanted = taken_by(virtual)
    black = cv2.dilate((found == 0).astype(np.uint8), np.ones((5, 5))) > 0
    assert black.any() == ("whole" in flags)
    assert np.abs(found.astype(int) - wanted)[~black].max() <= 3
    if "--fov" in flags:
        assert 2 * np.degrees(np.arctan(80 / virtual.params[0])) == pytest.approx(50)
    if "keep" in flags:
        assert virtual.params[:2] == pytest.approx(LENSES[lens][:2] / 2)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_remain(tmp_path, suffix):
    file = calibration(tmp_path / "calibration.json")
    image = write(tmp_path / f"a{suffix}", taken_by(camera(), 65535.0, np.uint16))
    assert run("undistort", file, image, "-o", tmp_path / "out") == 0
    found = cv2.imread(str(tmp_path / "out" / f"a{suffix}"), cv2.IMREAD_UNCHANGED)
    wanted = taken_by(
        load_calibration(tmp_path / "out/calibration.json").camera("cam"), 65535.0, int
    )
    assert found.dtype == np.uint16 and np.abs(found - wanted).max() < 400


def test_channels_folders_and_names_remain(tmp_path):
    left, right = camera(name="left"), camera("kannala_brandt", "right")
    place = Transform(exp_rotation(np.array([0.0, 0.1, 0.0])), np.array([-0.2, 0.01, 0.0]))
    file = calibration(tmp_path / "c.json", left, right, rig=[Transform.identity(), place])
    grey = taken_by(left)
    write(tmp_path / "scan/left/1.PNG", np.dstack([grey, grey, grey, np.full_like(grey, 255)]))
    write(tmp_path / "scan/left/2.jpg", np.dstack([grey] * 3))
    write(tmp_path / "scan/right/1.pgm", taken_by(right))
    out = tmp_path / "out"
    assert run("undistort", file, tmp_path / "scan", "-o", out, "--view", "whole", "--maps") == 0
    written = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    assert written == [
        "calibration.json", "left/1.PNG", "left/2.jpg", "maps_left.npz", "maps_right.npz",
        "right/1.pgm",
    ]  # fmt: skip
    found = cv2.imread(str(out / "left/1.PNG"), cv2.IMREAD_UNCHANGED)
    assert found.shape[2] == 4 and (found[..., 3][found[..., 0] == 0] == 0).all()
    rig = read_calibration(out)
    assert rig.names == ("left", "right") and rig.unit == "m"
    assert np.allclose(rig.cam_from_rig[1].rotation, place.rotation)
    assert np.allclose(rig.cam_from_rig[1].translation, place.translation)
    result = load_calibration(out / "calibration.json")
    assert "not carried over" in result.verdict.messages[0] and not result.covariance.names
    with np.load(out / "maps_left.npz") as maps:
        x, y = maps["map_x"], maps["map_y"]
    again = cv2.remap(grey, x, y, cv2.INTER_CUBIC)
    inner = (
        (x > 2) & (x < SIZE[0] - 3) & (y > 2) & (y < SIZE[1] - 3)
    )  # what lies beyond is no matter
    assert (again == found[..., 0])[inner].all()


@pytest.mark.parametrize(
    ("name", "written"), [("a.avi", "a.avi"), ("a.mp4", "a.mp4"), ("a.mpeg", "a.mp4")]
)
def test_videos_keep_frames_and_rate(tmp_path, name, written):
    frames = panning_frames(12, size=SIZE)
    made = video(tmp_path / "made.avi", frames).rename(tmp_path / name)  # OpenCV looks inside
    file = calibration(tmp_path / "c.json")
    assert run("undistort", file, made, "-o", tmp_path / "out", "--size", 96, 80) == 0
    capture = cv2.VideoCapture(str(tmp_path / "out" / written))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(30)
    seen = [capture.read()[1] for _ in range(12)]
    assert not capture.read()[0] and all(frame.shape == (80, 96, 3) for frame in seen)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [written, "calibration.json"]


def test_a_damaged_image_is_named_and_the_rest_made(tmp_path, capsys):
    picture(tmp_path / "in/1.png", SIZE)
    whole = picture(tmp_path / "in/2.png", SIZE).read_bytes()
    (tmp_path / "in/2.png").write_bytes(whole[: len(whole) // 2])
    file = calibration(tmp_path / "c.json")
    assert run("undistort", file, tmp_path / "in", "-o", tmp_path / "out") == 0
    assert "2.png is unreadable or truncated: skipped" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["1.png", "calibration.json"]


def test_what_is_refused(tmp_path, capsys):
    file = calibration(tmp_path / "c.json", camera(name="left"), camera(name="right"))
    other = picture(tmp_path / "in/a.png", (80, 60))
    out = tmp_path / "out"
    choose = ("--camera", "left")
    said = refused(capsys, "undistort", file, other, "-o", out, *choose)
    assert "80 x 60 px" in said and "160 x 120 px" in said
    assert "--camera" in refused(capsys, "undistort", file, other, "-o", out)
    assert "it has left, right" in refused(
        capsys, "undistort", file, other, "-o", out, "--camera", "top"
    )
    good = picture(tmp_path / "good/a.png", SIZE)
    for flags, word in (
        (("--view", "keep", "--fov", 90), "leave out --view"),
        (("--fov", 180), "1 to 170"),
        (("--size", 90, 90, "--scale", 2), "leave out --scale"),
        (("--scale", 0.001), "8 to 32000 px"),
        (("--scale", -1), "positive"),
    ):
        assert word in refused(capsys, "undistort", file, good, "-o", out, *choose, *flags)
    assert "own folder" in refused(capsys, "undistort", file, good, "-o", good.parent, *choose)
    assert "OUT is a folder" in refused(capsys, "undistort", file, good, "-o", "x.png", *choose)
    assert "no image and no video" in refused(capsys, "undistort", file, file, "-o", out)
    assert "no such input" in refused(capsys, "undistort", file, tmp_path / "no", "-o", out)
    assert not out.exists()


def test_nothing_is_written_over(tmp_path, capsys):
    image = picture(tmp_path / "in/a.png", SIZE)
    out = tmp_path / "out"
    out.mkdir()
    file = calibration(out / "calibration.json")
    before = file.read_bytes()
    said = refused(capsys, "undistort", file, image, "-o", out, "--overwrite")
    assert "written over" in said and file.read_bytes() == before
    file = file.rename(tmp_path / "c.json")
    assert run("undistort", file, image, "-o", out) == 0
    first = (out / "a.png").read_bytes()
    assert "--overwrite" in refused(capsys, "undistort", file, image, "-o", out, "--fov", 40)
    assert (out / "a.png").read_bytes() == first
    assert run("undistort", file, image, "-o", out, "--fov", 40, "--overwrite") == 0
    assert (out / "a.png").read_bytes() != first


def test_a_view_too_wide_is_refused_with_its_angle(tmp_path, capsys):
    wide = Camera("cam", "kannala_brandt", SIZE, np.array([60.0, 60, 80, 60, 0, 0, 0, 0]))
    file = calibration(tmp_path / "c.json", wide)
    image = write(tmp_path / "in/a.png", np.zeros(SIZE[::-1], np.uint8))
    said = refused(
        capsys, "undistort", file, image, "-o", tmp_path / "out", "--view", "whole"
    )  # fmt: skip
    assert "191 degrees" in said and "--fov" in said


# ---- rectify -------------------------------------------------------------------------------------

DEPTH, BASELINE = 3.0, 0.2


def pair(tmp_path, centre=(BASELINE, 0.0, 0.0)):
    """A textured wall 3 m ahead, seen by two unlike cameras, turned against each other."""
    left = Camera("left", "radtan", (320, 240), np.array([260.0, 260, 165, 115, -0.2, 0.05, 0, 0]))
    right = Camera("right", "kannala_brandt", (320, 240), np.array(
        [250.0, 251, 155, 122, -0.03, 0, 0, 0]))  # fmt: skip
    turn = exp_rotation(np.array([0.02, -0.04, 0.03]))
    rig = [Transform.identity(), Transform(turn, -turn @ np.array(centre))]
    texture = np.random.default_rng(1).integers(0, 255, (700, 900)).astype(np.uint8)
    texture = cv2.normalize(cv2.GaussianBlur(texture, (0, 0), 2), None, 0, 255, cv2.NORM_MINMAX)
    for taker, place in zip((left, right), rig, strict=True):
        rays = unproject(taker, image_pixels(taker.size, taker.size)[2]) @ place.rotation
        at = place.inverse.translation
        wall = at + rays * ((DEPTH - at[2]) / rays[:, 2])[:, None]
        x, y = (wall[:, :2] * 150 + [450, 350]).astype(np.float32).T.reshape(2, 240, 320)
        image = cv2.remap(texture, x, y, cv2.INTER_LINEAR)
        for stem in ("1", "2"):
            write(tmp_path / f"scan/{taker.name}/{stem}.png", image)
    return calibration(tmp_path / "c.json", left, right, rig=rig)


def test_a_pair_shares_rows_and_depths(tmp_path, capsys):
    file = pair(tmp_path)
    out = tmp_path / "out"
    assert run("rectify", file, tmp_path / "scan", "-o", out) == 0
    text = capsys.readouterr().out
    assert "left camera left: 2 images" in text and "baseline 0.2 m" in text
    assert "in 2 pairs differ by" in text and "note" not in text
    result = load_calibration(out / "calibration.json")
    assert np.allclose(result.cam_from_rig("right").translation, [-BASELINE, 0, 0])
    assert np.allclose(result.cam_from_rig("right").rotation, np.eye(3)) and result.rig.metric
    images = [cv2.imread(str(out / side / "1.png"), 0) for side in ("left", "right")]
    storage = cv2.FileStorage(str(out / "rectification.yml"), cv2.FILE_STORAGE_READ)
    R1, P1, P2, Q = (storage.getNode(name).mat() for name in ("R1", "P1", "P2", "Q"))
    assert P2[0, 3] == pytest.approx(-P1[0, 0] * BASELINE)
    sift = cv2.SIFT.create()
    (a, da), (b, db) = (sift.detectAndCompute(image, None) for image in images)
    matched = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(da, db)
    seen = np.array([[a[m.queryIdx].pt, b[m.trainIdx].pt] for m in matched])
    moved = seen[:, 0] - seen[:, 1]
    assert abs(np.median(moved[:, 1])) < 0.05
    points = np.column_stack([seen[:, 0], moved[:, 0], np.ones(len(seen))]) @ Q.T
    in_left = points[:, :3] / points[:, 3:] @ R1
    assert np.median(in_left[:, 2]) == pytest.approx(DEPTH, rel=0.005)


def test_exchanged_images_are_noticed(tmp_path, capsys):
    file = pair(tmp_path)
    given = ("--cameras", "left=right", "right=left")
    assert run("rectify", file, tmp_path / "scan", "-o", tmp_path / "out", *given) == 0
    assert "are exchanged" in capsys.readouterr().out


def test_cameras_called_otherwise_are_matched_by_order_and_told(tmp_path, capsys):
    file = pair(tmp_path)
    (tmp_path / "scan/left").rename(tmp_path / "scan/a")
    (tmp_path / "scan/right").rename(tmp_path / "scan/b")
    out = tmp_path / "out"
    assert run("rectify", file, tmp_path / "scan", "-o", out, "--no-check") == 0
    assert "matched by order, left = a, right = b" in capsys.readouterr().out
    assert read_calibration(out).names == ("a", "b")


def test_the_upper_camera_comes_first_whatever_the_order(tmp_path, capsys):
    file = pair(tmp_path, centre=(0.0, -BASELINE, 0.0))
    out = tmp_path / "out"
    given = ("--cameras", "left", "right")
    assert run("rectify", file, tmp_path / "scan", "-o", out, *given) == 0
    text = capsys.readouterr().out
    assert "upper camera right" in text and "columns: " in text
    result = load_calibration(out / "calibration.json")
    assert result.rig.reference == "right"
    assert np.allclose(result.cam_from_rig("left").translation, [0, -BASELINE, 0])


@pytest.mark.parametrize(
    ("centre", "turn_y", "word"),
    [
        ((0.02, 0.0, 1.0), 0.0, "one behind the other"),
        ((0.2, 0.0, 0.0), 1.4, "80 degrees apart"),
        ((0.0, 0.0, 0.0), 0.0, "in one place"),
    ],
)
def test_what_is_no_pair(tmp_path, capsys, centre, turn_y, word):
    turn = exp_rotation(np.array([0.0, turn_y, 0.0]))
    rig = [Transform.identity(), Transform(turn, -turn @ np.array(centre))]
    file = calibration(tmp_path / "c.json", camera(name="a"), camera(name="b"), rig=rig)
    for name in ("a", "b"):
        picture(tmp_path / f"scan/{name}/1.png", SIZE)
    out = tmp_path / "out"
    assert word in refused(capsys, "rectify", file, tmp_path / "scan", "-o", out)
    assert not out.exists()


def test_one_camera_and_cameras_without_places_are_no_pair(tmp_path, capsys):
    picture(tmp_path / "scan/a/1.png", SIZE)
    picture(tmp_path / "scan/b/1.png", SIZE)
    one = calibration(tmp_path / "one.json")
    out = tmp_path / "out"
    assert "has two cameras" in refused(capsys, "rectify", one, tmp_path / "scan", "-o", out)
    storage = cv2.FileStorage(str(tmp_path / "intrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    for name in ("M1", "M2"):
        storage.write(name, np.array([[140.0, 0, 80], [0, 140, 60], [0, 0, 1]]))
    storage.release()
    assert "how its cameras sit" in refused(
        capsys, "rectify", tmp_path / "intrinsics.yml", tmp_path / "scan", "-o", out
    )
    assert not out.exists()


def test_cameras_without_places_get_a_calibration_each(tmp_path):
    K = np.array([[140.0, 0, 80], [0, 140, 60], [0, 0, 1]])
    storage = cv2.FileStorage(str(tmp_path / "intrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    for name in ("M1", "M2"):
        storage.write(name, K)
    storage.release()
    for name in ("cam1", "cam2"):
        picture(tmp_path / f"scan/{name}/1.png", SIZE)
    out = tmp_path / "out"
    assert run("undistort", tmp_path / "intrinsics.yml", tmp_path / "scan", "-o", out) == 0
    for name in ("cam1", "cam2"):  # the size, which the file does not state, is the images'
        found = load_calibration(out / f"calibration_{name}.json").camera(name)
        assert found.size == SIZE and np.allclose(found.params, [140, 140, 80, 60])

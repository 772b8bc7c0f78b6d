"""`fuse`: depth of known surfaces through real lenses, and what is refused."""

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from graphs.camera import Camera, project, unproject
from graphs.covariance import NOTHING, POSE_NAMES
from graphs.frames import Transform, exp_rotation
from sfm_calib.cli import main
from sfm_calib.depth.cloud import DepthLimits, depth_points, image_rays
from sfm_calib.depth.fuse import fuse_clouds, register, thinned
from sfm_calib.depth.overlap import overlap
from sfm_calib.depth.predicted import calibration_names, point_jacobian, sigma_apart
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import read_calibration
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


def run(*arguments):
    return main([str(a) for a in arguments])


def refused(capsys, *arguments):
    assert run(*arguments) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("sfm-calib: ")
    return said


def ply(path):
    cloud = import_open3d("this test").io.read_point_cloud(str(path))
    return np.asarray(cloud.points), np.asarray(cloud.normals), np.asarray(cloud.colors)


# ---- points --------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", sorted(LENSES))
@pytest.mark.parametrize("kind", ["z", "range"])
def test_a_ball_comes_back_through_a_distorted_lens(lens, kind):
    taker = camera(lens)
    range_m = ranges(taker)
    depth = range_m if kind == "range" else z_of(taker, range_m)
    points, pixels = depth_points(depth, taker, kind)
    assert len(points) == (range_m > 0).sum() > 500
    assert np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS).max() < 1e-9
    assert np.abs(project(taker, points) - pixels[:, ::-1]).max() < 1e-6
    other = depth_points(depth, taker, "z" if kind == "range" else "range")[0]
    assert np.abs(np.linalg.norm(other - BALL, axis=1) - RADIUS).max() > 1e-3


def test_limits_and_what_is_no_measurement():
    taker = camera()
    depth = np.full(SIZE[::-1], 1.0)
    depth[0, :4] = np.nan, np.inf, -1.0, 0.0
    assert len(depth_points(depth, taker)[0]) == depth.size - 4
    depth[10], depth[20] = 0.5, 2.0
    points, _ = depth_points(depth, taker, limits=DepthLimits(near_m=0.6, far_m=1.5))
    assert len(points) == depth.size - 4 - 2 * SIZE[0] and points[:, 2] == pytest.approx(1.0)
    with pytest.raises(CalibrationError, match=r"40 x 30 px.*192 x 160 px"):
        depth_points(np.ones((30, 40)), taker)


def test_flying_pixels_go_and_edges_stay():
    depth = np.full(SIZE[::-1], 1.0)
    depth[:, 80:] = 0.6
    depth[:, 80] = np.linspace(0.62, 0.98, SIZE[1])  # between the two
    kept = {tuple(p) for p in depth_points(depth, camera(), limits=DepthLimits(edge=0.02))[1]}
    corners = {(0, 0), (0, 191), (159, 0), (159, 191)}
    lost = {tuple(p) for p in np.ndindex(depth.shape)} - kept - corners
    flying = {(row, 80) for row in range(SIZE[1]) if 0.62 < depth[row, 80] < 0.96}
    assert flying <= lost and {p for p in lost if p[0] not in (0, 159)} <= {
        (row, 80) for row in range(SIZE[1])
    }


def test_thinning_keeps_a_point_of_each_camera_in_each_cube():
    parts = [np.random.default_rng(i).random((400, 3)) for i in (0, 1)]
    cloud = fuse_clouds(parts, [Transform.identity()] * 2)
    kept = cloud.only(thinned(cloud, 0.5))
    assert len(kept.points) == 16 and (np.bincount(kept.camera) == 8).all()
    assert {tuple(p) for p in kept.points} <= {tuple(p) for p in cloud.points}


# ---- registration --------------------------------------------------------------------------


def seen_by_two(noise_m=0.0, shape="lumps"):
    rng = np.random.default_rng(1)
    parts = []
    for taker, place in ((camera(), Transform.identity()), (camera(name="b"), BESIDE)):
        taker = replace(taker, size=(288, 240), params=taker.params * np.r_[[1.5] * 4, [1.0] * 5])
        found = ranges(taker, place, shape)
        noisy = np.where(found > 0, found + noise_m * rng.standard_normal(found.shape), 0.0)
        parts.append(depth_points(noisy, taker, "range")[0])
    return parts


@needs_open3d
@pytest.mark.parametrize(("noise_m", "most_m"), [(0.0, 2e-4), (0.001, 1e-3)])
def test_icp_finds_a_known_motion(noise_m, most_m):
    parts = seen_by_two(noise_m)
    motion = Transform(
        exp_rotation(np.array([0.02, -0.01, 0.015])), np.array([0.006, 0.004, -0.01])
    )
    found = register(fuse_clouds(parts, [Transform.identity(), motion @ BESIDE], True))
    assert found.failed == (False, False)
    right = found.corrected([Transform.identity(), motion @ BESIDE])[1]
    before, after = (
        np.linalg.norm(rig.inverse @ parts[1] - BESIDE.inverse @ parts[1], axis=1).max()
        for rig in (motion @ BESIDE, right)
    )
    assert before > 0.008 and after < most_m
    again = register(fuse_clouds(parts, [Transform.identity(), motion @ BESIDE], True))
    assert np.array_equal(again.transforms[1].translation, found.transforms[1].translation)


@needs_open3d
@pytest.mark.parametrize(
    ("shape", "shift_m", "word"), [("ball", 0.002, "slides"), ("lumps", 0.6, "points overlap")]
)
def test_icp_says_where_it_fails_and_leaves_the_part(shape, shift_m, word):
    parts = seen_by_two(shape=shape)
    rig = [Transform.identity(), Transform(BESIDE.rotation, BESIDE.translation + shift_m)]
    found = register(fuse_clouds(parts, rig, True))
    assert found.failed == (False, True) and word in found.reasons[1]
    assert np.array_equal(found.transforms[1].rotation, np.eye(3))


@needs_open3d
def test_an_overlap_is_measured_across_the_surface():
    """Two planes 3 mm apart, one half beside the other's border."""
    x, y = np.meshgrid(np.arange(80) / 1000, np.arange(40) / 1000)
    plane = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)])
    rig = [Transform.identity(), Transform(np.eye(3), np.array([0.0402, 0.0003, -0.003]))]
    cloud = fuse_clouds([plane, rig[1] @ (plane + np.array([0.0402, 0.0003, 0.003]))], rig, True)
    assert cloud.normals[:, 2] == pytest.approx(-1.0)  # to the cameras
    found = overlap(cloud.of(0), cloud.of(1), 0.05)
    assert found.apart_m == pytest.approx(0.003) and found.rms_m == pytest.approx(0.003)
    assert found.share == pytest.approx(0.5, abs=0.05)
    assert not len(overlap(cloud.of(0), cloud.of(1), 0.002).points)


# ---- sigmas --------------------------------------------------------------------------------


def drawn(taker, place, by):
    """A camera and its place with reported changes added."""
    turned = exp_rotation(by[-6:-3]) @ place.rotation
    return replace(taker, params=taker.params + by[:-6]), Transform(
        turned, place.translation + by[-3:]
    )


def lifted(taker, place, pixels, depth, kind="z"):
    """Points in the rig's frame of pixels (n, 2) with depths (n,)."""
    rays = unproject(taker, pixels)
    return place.inverse @ (rays * (depth / (rays[:, 2] if kind == "z" else 1.0))[:, None])


@pytest.mark.parametrize("lens", sorted(LENSES))
@pytest.mark.parametrize("kind", ["z", "range"])
def test_derivatives_of_points_are_those_of_finite_differences(lens, kind):
    taker, rng = camera(lens), np.random.default_rng(2)
    pixels, depth = rng.uniform([30, 25], [160, 135], (20, 2)), rng.uniform(0.4, 1.2, 20)
    found = point_jacobian(taker, BESIDE, lifted(taker, BESIDE, pixels, depth, kind), kind)
    assert len(calibration_names(taker)) == found.shape[2]
    for index, step in enumerate(1e-6 * np.eye(found.shape[2])):
        up, down = (
            lifted(*drawn(taker, BESIDE, sign * step), pixels, depth, kind) for sign in (1, -1)
        )
        assert (up - down) / 2e-6 == pytest.approx(found[..., index], abs=1e-6)


@needs_open3d
def test_sigmas_of_an_overlap_are_what_drawn_calibrations_do(tmp_path):
    rig = read_calibration(two(tmp_path, sigmas=SIGMAS)[0])
    sides = list(zip(rig.cameras, rig.cam_from_rig, strict=True))
    parts = [depth_points(z_of(c, ranges(c, t, "lumps")), c)[0] for c, t in sides]
    true = fuse_clouds(parts, rig.cam_from_rig, True)
    found = overlap(true.of(0), true.of(1), 0.01)
    seen = [t @ p for (_, t), p in zip(sides, (found.points, found.others), strict=True)]
    given = [(project(c, p), p[:, 2]) for (c, _), p in zip(sides, seen, strict=True)]
    sigma = [np.array([SIGMAS.get(n, 0.0) for n in calibration_names(c)]) for c, _ in sides]
    rng, squares = np.random.default_rng(0), []
    for _ in range(200):
        a, b = (
            lifted(*drawn(*side, rng.standard_normal(len(s)) * s), *where)
            for side, s, where in zip(sides, sigma, given, strict=True)
        )
        moved = (a - b - found.points + found.others) * found.normals
        squares.append((moved.sum(axis=1) ** 2).mean())
    # Chance of 200 draws, few of whose directions count: 10 %.
    assert sigma_apart(rig, (0, 1), found) == pytest.approx(np.sqrt(np.mean(squares)), rel=0.15)
    assert sigma_apart(replace(rig, covariance=NOTHING), (0, 1), found) is None


SIGMAS = {
    "a.fx": 0.3, "a.cx": 0.2, "a.k1": 0.005, "b.fy": 0.3,
    **{f"b.{name}": 0.002 if "rot" in name else 0.001 for name in POSE_NAMES},
}  # fmt: skip


# ---- the command ---------------------------------------------------------------------------


@needs_open3d
def test_two_cameras_make_one_cloud(tmp_path, capsys):
    file, depths = two(tmp_path, "ball", sigmas=SIGMAS)
    out = tmp_path / "out"
    given = ("fuse", file, depths, "-o", out, "--depth-unit", "0.0001")
    assert run(*given, "--parts") == 0
    text = capsys.readouterr().out
    assert "in the frame of a" in text and "a and b" in text
    points, normals, _ = ply(out / "fused.ply")
    from_middle = points - BALL
    assert np.abs(np.linalg.norm(from_middle, axis=1) - RADIUS).max() < 4e-4  # 0.1 mm, aslant
    outwards = (from_middle * normals).sum(1) / RADIUS
    assert np.quantile(outwards, 0.05) > 0.9
    record = json.loads((out / "fuse.json").read_text())
    (frame,) = record["frames"]
    assert frame["n_points"] == len(points) == sum(p["n_points"] for p in frame["parts"])
    assert len(ply(out / "parts/b.ply")[0]) == frame["parts"][1]["n_points"]
    (pair,) = frame["overlaps"]
    assert pair["rms_m"] < 5e-4 and pair["n_points"] > 100 and pair["sigma_m"] > 2e-4
    before = (out / "fused.ply").read_bytes()
    assert "--overwrite" in refused(capsys, *given)
    assert run(*given, "--overwrite", "--json") == 0
    assert json.loads(capsys.readouterr().out)["frames"][0]["n_points"] == len(points)
    assert (out / "fused.ply").read_bytes() == before


@needs_open3d
def test_frames_colours_registration_and_what_is_left_out(tmp_path, capsys):
    wrong = Transform(BESIDE.rotation, BESIDE.translation + np.array([0.005, 0.0, 0.008]))
    file, depths = two(tmp_path, rig=(Transform.identity(), wrong), frames=("2", "10"))
    cv2.imwrite(str(depths / "b/11.png"), np.zeros(SIZE[::-1], np.uint16))
    for name, colour in (("a", (0, 0, 255)), ("b", (255, 0, 0))):
        (tmp_path / "rgb" / name).mkdir(parents=True)
        for stem in ("2", "10"):
            picture = np.full((*SIZE[::-1], 3), colour, np.uint8)
            cv2.imwrite(str(tmp_path / f"rgb/{name}/{stem}.png"), picture)
    out = tmp_path / "out"
    given = ("--depth-unit", "0.0001", "--colours", tmp_path / "rgb", "--registration", "icp")
    assert run("fuse", file, depths, "-o", out, *given) == 0
    assert "nothing measured in b/11: left out" in capsys.readouterr().out
    assert sorted(p.name for p in (out / "fused").iterdir()) == ["10.ply", "2.ply"]
    frame = json.loads((out / "fuse.json").read_text())["frames"][0]
    assert frame["name"] == "2" and not frame["registration"][1]["failed"]
    assert frame["overlaps_registered"][0]["rms_m"] < 0.5 * frame["overlaps"][0]["rms_m"]
    _, _, colours = ply(out / "fused/2.ply")
    assert (colours[0] == (1, 0, 0)).all() and (colours[-1] == (0, 0, 1)).all()


@needs_open3d
def test_floating_point_and_single_images_are_read(tmp_path):
    taker = camera()
    depth = z_of(taker, ranges(taker)).astype(np.float32)
    depth[depth == 0] = np.nan
    file = calibration(tmp_path / "c.json", [taker])
    np.save(tmp_path / "x.npy", depth)
    cv2.imwrite(str(tmp_path / "y.tiff"), depth)
    for name in ("x.npy", "y.tiff"):
        assert run("fuse", file, tmp_path / name, "-o", tmp_path / name[0]) == 0
        off = np.linalg.norm(ply(tmp_path / name[0] / "fused.ply")[0] - BALL, axis=1) - RADIUS
        assert np.abs(off).max() < 1e-6
    flat = tmp_path / "flat"
    flat.mkdir()
    two_file, depths = two(tmp_path)
    for name in ("a", "b"):
        (depths / name / "000.png").rename(flat / f"{name}.png")
    assert run("fuse", two_file, flat, "-o", tmp_path / "f", "--depth-unit", "0.0001") == 0
    frame = json.loads((tmp_path / "f/fuse.json").read_text())["frames"][0]
    assert [part["camera"] for part in frame["parts"]] == ["a", "b"]


def write(path, array):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, array)
    else:
        assert cv2.imwrite(str(path), array)


FULL = np.full(SIZE[::-1], 700, np.uint16)
BAD = {
    "eight bits": ({"a/1.png": FULL.astype(np.uint8)}, (), "holds uint8"),
    "a picture": ({"a/1.png": np.dstack([FULL] * 3)}, (), "160 x 192 x 3"),
    "complex": ({"a/1.npy": FULL * 1j}, (), "holds complex128"),
    "objects": ({"a/1.npy": np.array([{}])}, (), "no array that numpy can read"),
    "another size": ({"a/1.png": FULL[:40]}, (), "192 x 40 px"),
    "all zero": ({"a/1.png": FULL * 0}, (), "farthest is 0 m"),
    "all beyond": ({"a/1.png": FULL}, ("--far-m", 0.5), "farthest is 0.7 m"),
    "all NaN": ({"a/1.npy": np.full(SIZE[::-1], np.nan)}, (), "no depth image has a depth"),
    "no camera": ({"front/1.png": FULL}, (), "'front' is no camera"),
    "two of a stem": ({"a/1.png": FULL, "a/1.npy": FULL}, (), "would be one frame"),
    "flat and folders": ({"a/1.png": FULL, "b.png": FULL}, (), "beside 1 folders"),
    "nothing": ({"a/1.jpg": np.zeros((9, 9), np.uint8)}, (), "holds no images"),
    "unit": ({"a/1.png": FULL}, ("--depth-unit", 0), "--depth-unit 0"),
    "limits": ({"a/1.png": FULL}, ("--near-m", 2, "--far-m", 1), "--near-m 2"),
    "edge": ({"a/1.png": FULL}, ("--edge", -1), "--edge -1"),
    "voxel": ({"a/1.png": FULL}, ("--voxel-m", "nan"), "--voxel-m nan"),
    "within": ({"a/1.png": FULL}, ("--max-correspondence-m", 0), "above 0"),
}


@needs_open3d
@pytest.mark.parametrize("case", sorted(BAD))
def test_bad_input_is_one_line_and_writes_nothing(tmp_path, capsys, case):
    files, flags, word = BAD[case]
    for name, array in files.items():
        write(tmp_path / "depths" / name, array)
    rig = calibration(
        tmp_path / "c.json", (camera(), camera(name="b")), [Transform.identity(), BESIDE]
    )
    out = tmp_path / "out"
    assert word in refused(capsys, "fuse", rig, tmp_path / "depths", "-o", out, *flags)
    assert not out.exists()


@needs_open3d
def test_a_rig_without_metres_is_refused_with_the_remedy(tmp_path, capsys):
    file, depths = two(tmp_path, "ball")
    told = json.loads(file.read_text())
    told["rig"]["metric"] = False
    for place in told["rig"]["cam_from_rig"].values():
        place["translation"] = [1000 * x for x in place["translation"]]
    file.write_text(json.dumps(told))
    out = tmp_path / "out"
    given = ("fuse", file, depths, "-o", out, "--depth-unit", "0.0001")
    assert "--metres" in refused(capsys, *given) and not out.exists()
    assert run(*given, "--metres", 0.001) == 0
    off = np.linalg.norm(ply(out / "fused.ply")[0] - BALL, axis=1) - RADIUS
    assert np.abs(off).max() < 4e-4


@needs_open3d
def test_damaged_files_missing_colours_and_places_that_cannot_be_written(tmp_path, capsys):
    file, depths = two(tmp_path)
    given = ("fuse", file, depths, "-o", tmp_path / "out", "--depth-unit", "0.0001")
    assert "no such input" in refused(capsys, "fuse", file, tmp_path / "no", "-o", tmp_path / "out")
    write(tmp_path / "rgb/a/000.png", np.zeros((9, 9, 3), np.uint8))
    assert "registered" in refused(capsys, *given, "--colours", tmp_path / "rgb")
    write(tmp_path / "rgb/a/000.png", np.zeros((*SIZE[::-1], 3), np.uint8))
    assert "no picture of b/000" in refused(capsys, *given, "--colours", tmp_path / "rgb")
    (tmp_path / "taken").write_text("")
    assert "it is a file" in refused(capsys, *given[:4], tmp_path / "taken")
    whole = (depths / "b/000.png").read_bytes()
    (depths / "b/000.png").write_bytes(whole[: len(whole) // 2])
    assert "000.png is unreadable" in refused(capsys, *given)
    assert not (tmp_path / "out").exists()


def test_without_open3d_one_line_names_the_extra(tmp_path, capsys, monkeypatch):
    file, depths = two(tmp_path)
    monkeypatch.setitem(sys.modules, "open3d", None)
    said = refused(capsys, "fuse", file, depths, "-o", tmp_path / "out")
    assert "sfm_calib[depth]" in said and not (tmp_path / "out").exists()

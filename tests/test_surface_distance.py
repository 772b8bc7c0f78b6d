"""Distances between surfaces that are known by hand, and what is wrong with files."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphs.frames import FloatArray, Transform, angle_between
from sfm_calib.cli import main
from sfm_calib.depth.surface import Surface, load_surface, painted
from sfm_calib.depth.surface_distance import align_icp, summary, surface_distance
from sfm_calib.errors import CalibrationError
from sfm_calib.open3d_import import import_open3d
from sfm_calib.report.distance import colours_of

try:
    open3d = import_open3d("surfaces")
except CalibrationError as missing:
    pytest.skip(str(missing), allow_module_level=True)

NO_TRIANGLES = np.zeros((0, 3), dtype=np.int64)


def box(size: float = 0.2) -> Surface:
    """A cube, closed, from 0 to `size`."""
    mesh = open3d.geometry.TriangleMesh.create_box(size, size, size)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64))


def sheet(size: float = 1.0) -> Surface:
    """A square in z = 0 about the origin."""
    corners = size / 2 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def bumpy(count: int, rng: np.random.Generator) -> Surface:
    """An ellipsoid with bumps: it lies in one way only."""
    mesh = open3d.geometry.TriangleMesh.create_sphere(1.0, count)
    v = np.asarray(mesh.vertices)
    radius = 0.1 * (1 + 0.15 * np.sin(3 * v[:, 0] + 1) + 0.1 * np.cos(5 * v[:, 1] * v[:, 2]))
    return Surface(v * radius[:, None] * [1, 0.8, 1.2], np.asarray(mesh.triangles).astype(np.int64))


def write(surface: Surface, path: Path) -> Path:
    path.write_bytes(painted(surface, np.full((len(surface.vertices), 3), 0.5)))
    return path


# ---- distances -----------------------------------------------------------------------------


@given(st.tuples(*[st.floats(-0.4, 0.4)] * 3))
@settings(max_examples=60, deadline=None)
def test_points_beside_a_sheet(point: tuple[float, float, float]) -> None:
    found = surface_distance(np.array([point]), sheet())
    assert found.signed is None  # it has no inside
    assert found.unsigned[0] == pytest.approx(abs(point[2]), abs=1e-6)


def test_a_cube_has_an_inside() -> None:
    points = np.array([[0.1, 0.1, 0.05], [0.1, 0.1, -0.05], [0.3, 0.3, 0.3]])
    found = surface_distance(points, box())
    assert found.signed == pytest.approx([-0.05, 0.05, 0.1 * 3**0.5], abs=1e-7)
    assert found.unsigned == pytest.approx(np.abs(found.signed), abs=0)


def test_far_from_the_origin_nothing_is_lost() -> None:
    """Single precision would leave half a metre of 5,000 km."""
    away = Transform(np.eye(3), np.array([4.2e6, 1.7e5, 4.8e6]))
    found = surface_distance(away @ np.array([[0.1, 0.1, -0.05]]), box().moved(away))
    assert found.unsigned[0] == pytest.approx(0.05, abs=2e-7)


def test_to_a_cloud_the_nearest_point_counts() -> None:
    cloud = Surface(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), NO_TRIANGLES)
    found = surface_distance(np.array([[0.4, 0.0, 0.3]]), cloud)
    assert found.unsigned[0] == pytest.approx(0.5)
    assert found.signed is None


def test_what_is_said_of_distances() -> None:
    said = summary(surface_distance(np.array([[0, 0, 0.3], [0, 0, 0.4], [0.0, 0, 0]]), sheet()))
    assert said.points == 3
    assert (said.mean_m, said.median_m, said.max_m) == pytest.approx((0.7 / 3, 0.3, 0.4), abs=1e-6)
    assert said.rms_m == pytest.approx((0.25 / 3) ** 0.5, abs=1e-6)


def test_samples_lie_evenly_on_a_mesh() -> None:
    points = box(1.0).sampled(60_000, 0)
    assert len(points) == 60_000
    assert surface_distance(points, box(1.0)).unsigned.max() < 1e-6
    faces = [np.isclose(points[:, axis], side).sum() for axis in range(3) for side in (0, 1)]
    assert faces == pytest.approx([10_000] * 6, abs=500)
    np.testing.assert_array_equal(points, box(1.0).sampled(60_000, 0))


# ---- laying on -----------------------------------------------------------------------------


def small(rng: np.random.Generator, angle_deg: float, shift_m: float) -> Transform:
    axis, way = rng.standard_normal((2, 3))
    turn = np.radians(angle_deg) * axis / np.linalg.norm(axis)
    return Transform.exp(turn, shift_m * way / np.linalg.norm(way))


@pytest.mark.parametrize("seed", range(3))
def test_a_known_move_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    surface = bumpy(40, rng)
    points, away = surface.sampled(4000, seed), small(rng, 8.0, 0.01)
    found = align_icp(away @ points, surface, Transform.identity(), 0.02)
    assert found.converged and found.matched == 1.0
    left = found.transform @ away
    assert np.linalg.norm(left @ points - points, axis=1).max() < 2e-6
    assert found.rms_m < 1e-6


def test_what_has_no_counterpart_does_not_pull() -> None:
    rng = np.random.default_rng(5)
    surface = bumpy(40, rng)
    points = surface.sampled(4000, 1)
    stray = points.mean(axis=0) + 0.4 + 0.01 * rng.standard_normal((400, 3))
    away = small(rng, 3.0, 0.005)
    found = align_icp(away @ np.concatenate([points, stray]), surface, Transform.identity(), 0.02)
    assert angle_between((found.transform @ away).rotation, np.eye(3)) < 1e-4
    assert found.matched == pytest.approx(len(points) / (len(points) + 400), abs=1e-3)


def test_the_same_every_time() -> None:
    surface = bumpy(30, np.random.default_rng(0))
    points = small(np.random.default_rng(1), 5.0, 0.005) @ surface.sampled(3000, 0)
    one, two = (align_icp(points, surface, Transform.identity(), 0.02) for _ in range(2))
    np.testing.assert_array_equal(one.transform.rotation, two.transform.rotation)
    np.testing.assert_array_equal(one.transform.translation, two.transform.translation)


def test_surfaces_that_are_apart_cannot_be_laid_on_each_other() -> None:
    with pytest.raises(CalibrationError, match=r"only 0 of .* within 80 mm"):
        align_icp(box().sampled(100, 0) + 5, box(), Transform.identity(), 0.02)


# ---- files ---------------------------------------------------------------------------------


def test_what_is_painted_is_read_again(tmp_path: Path) -> None:
    surface = box()
    colours = colours_of(np.linspace(0, 1, 8), 1.0)
    path = tmp_path / "painted.ply"
    path.write_bytes(painted(surface, colours))
    mesh = open3d.io.read_triangle_mesh(str(path))
    np.testing.assert_allclose(np.asarray(mesh.vertices), surface.vertices)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), surface.triangles)
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors), colours, atol=0.5 / 255 + 1e-9)
    assert len(load_surface(path).triangles) == 12
    cloud = Surface(surface.vertices, NO_TRIANGLES)
    path.write_bytes(painted(cloud, colours))
    assert not load_surface(path).is_mesh


def bad_file(folder: Path, kind: str) -> Path:
    path = folder / "bad.ply"
    if kind == "text":
        path.write_text("no surface\n")
    elif kind == "nan":
        write(Surface(np.array([[0.0, 0, 0], [np.nan, 0, 0]]), NO_TRIANGLES), path)
    elif kind == "empty":
        write(Surface(np.zeros((0, 3)), NO_TRIANGLES), path)
    elif kind == "flat":
        write(Surface(np.zeros((3, 3)), np.array([[0, 1, 2]])), path)
    return path


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("missing", "is not there"),
        ("text", "holds no mesh and no points"),
        ("nan", "1 of 2 points are no numbers, the first number 1"),
        ("empty", "holds no mesh and no points"),
        ("flat", "have no area"),
    ],
)
def test_files_that_are_no_surfaces(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str, said: str
) -> None:
    good, out = write(box(), tmp_path / "good.ply"), tmp_path / "out"
    for a, b in ((bad_file(tmp_path, kind), good), (good, bad_file(tmp_path, kind))):
        assert main(["surface-distance", str(a), str(b), "-o", str(out)]) == 2
        err = capfd.readouterr().err
        assert said in err and err.count("sfm-calib:") == 1 and "Traceback" not in err
        assert not out.exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--crop", "-1"], "--crop -1: give a length above 0"),
        (["--metres-per-unit", "0"], "--metres-per-unit 0"),
        (["--max-correspondence", "nan"], "--max-correspondence nan"),
        (["--crop", "0.01"], "farther than --crop 0.01 m"),
        (["--align", "icp"], "begin nearer"),
    ],
)
def test_impossible_requests(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    a = write(box().moved(Transform(np.eye(3), np.array([3.0, 0, 0]))), tmp_path / "a.ply")
    b, out = write(box(), tmp_path / "b.ply"), tmp_path / "out"
    assert main(["surface-distance", str(a), str(b), "-o", str(out), *more]) == 2
    assert said in capsys.readouterr().err
    assert not out.exists()


# ---- the command ---------------------------------------------------------------------------


def record(out: Path) -> dict[str, object]:
    content: dict[str, object] = json.loads((out / "distance.json").read_text())
    return content


def test_inputs_are_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = write(box(), tmp_path / "painted.ply"), write(box(), tmp_path / "b.ply")
    before = a.read_bytes()
    for files in ((a, b), (b, a)):
        assert main(["surface-distance", *map(str, files), "-o", str(tmp_path)]) == 2
        assert "painted.ply would be overwritten" in capsys.readouterr().err
    assert a.read_bytes() == before


def test_a_shifted_cube(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    up = Transform(np.eye(3), np.array([0.0, 0, 0.01]))
    a, b = write(box().moved(up), tmp_path / "a.ply"), write(box(), tmp_path / "b.ply")
    out = tmp_path / "out"
    assert main(["surface-distance", str(a), str(b), "-o", str(out)]) == 0
    assert "Hausdorff distance 10.000 mm" in capsys.readouterr().out
    found = record(out)
    assert found["hausdorff_m"] == pytest.approx(0.01, abs=1e-6)
    assert found["aligned"] is None and len(found["provenance"]["input_hashes"]) == 2  # type: ignore[index]
    page = (out / "distance.html").read_text()
    assert "10.000 mm" in page and "<script src" not in page
    assert main(["surface-distance", str(a), str(b), "-o", str(out), "--align", "centroid"]) == 0
    again = record(out)
    assert again["hausdorff_m"] < 1e-5  # type: ignore[operator]
    laid: FloatArray = np.array(again["aligned"]["translation_m"])  # type: ignore[index]
    assert laid == pytest.approx([0, 0, -0.01], abs=1e-5)
    painted_there = np.asarray(open3d.io.read_triangle_mesh(str(out / "painted.ply")).vertices)
    assert painted_there == pytest.approx(box().vertices, abs=1e-5)


def test_millimetres_and_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savetxt(tmp_path / "a.xyz", 1e3 * (box().sampled(500, 0) + np.array([0, 0, 0.002])))
    in_mm = Surface(1e3 * box().vertices, box().triangles)
    b, out = write(in_mm, tmp_path / "b.ply"), tmp_path / "out"
    assert main(["surface-distance", str(tmp_path / "a.xyz"), str(b), "-o", str(out)]) == 0
    assert "b.ply is 200 m large: if its unit is mm" in " ".join(capsys.readouterr().out.split())
    command = ["surface-distance", str(tmp_path / "a.xyz"), str(b), "-o", str(out)]
    assert main([*command, "--metres-per-unit", "0.001"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "a.xyz is a cloud" in said and "200 m large" not in said
    assert record(out)["a_to_b"]["max_m"] == pytest.approx(0.002, abs=1e-6)  # type: ignore[index]


def test_where_a_mesh_is_finer_does_not_weigh_more(tmp_path: Path) -> None:
    """A corner cut into a thousand triangles is still one corner, but its peak is the farthest."""
    flat = sheet()
    fan = np.linspace(0, np.pi / 2, 1001)
    rim = flat.vertices[0] + 0.01 * np.stack([np.cos(fan), np.sin(fan), 0 * fan], axis=-1)
    peak = flat.vertices[0] + np.array([0.0, 0.0, 0.5])
    index = 4 + np.arange(1000)
    more = np.stack([np.full(1000, 4 + 1001), index, index + 1], axis=-1)
    a = Surface(
        np.concatenate([flat.vertices, rim, peak[None]]), np.concatenate([flat.triangles, more])
    )
    places, out = (write(a, tmp_path / "a.ply"), write(flat, tmp_path / "b.ply")), tmp_path / "out"
    assert main(["surface-distance", *map(str, places), "-o", str(out)]) == 0
    found = record(out)["a_to_b"]
    assert found["max_m"] == pytest.approx(0.5, abs=1e-6)  # type: ignore[index]
    assert found["median_m"] < 1e-6 and found["mean_m"] < 0.002  # type: ignore[index]


def test_what_only_one_side_has_can_be_left_out(tmp_path: Path) -> None:
    half = sheet().vertices * [0.5, 1, 1]
    a = write(Surface(half + np.array([0, 0, 0.01]), sheet().triangles), tmp_path / "a.ply")
    b, out = write(sheet(), tmp_path / "b.ply"), tmp_path / "out"
    assert main(["surface-distance", str(a), str(b), "-o", str(out), "--crop", "0.0101"]) == 0
    found = record(out)
    assert found["hausdorff_m"] == pytest.approx(0.0101, abs=1e-4)
    assert found["left_out"]["a_to_b"] == 0 and found["left_out"]["b_to_a"] > 10_000  # type: ignore[index]


def test_a_closed_stl_has_an_inside(tmp_path: Path) -> None:
    """Each of its triangles has vertices of its own, which no edge shares."""
    mesh = open3d.geometry.TriangleMesh.create_sphere(0.1, 12)
    mesh.compute_triangle_normals()
    path = tmp_path / "ball.stl"
    assert open3d.io.write_triangle_mesh(str(path), mesh)
    ball = load_surface(path)
    assert ball.is_closed
    signed = surface_distance(np.array([[0.0, 0, 0.09], [0, 0, 0.11]]), ball).signed
    assert signed is not None and signed == pytest.approx([-0.01, 0.01], abs=1e-3)
    assert not Surface(ball.vertices, ball.triangles[1:]).is_closed


def test_whether_a_large_mesh_is_closed_takes_no_minutes() -> None:
    """Of Open3D's own test, which compares every two triangles, hours."""
    mesh = open3d.geometry.TriangleMesh.create_sphere(0.1, 300)
    ball = Surface(np.asarray(mesh.vertices), np.asarray(mesh.triangles).astype(np.int64))
    start = time.monotonic()
    assert ball.is_closed and time.monotonic() - start < 20


@pytest.mark.parametrize("ascii_", [False, True])
@pytest.mark.parametrize("cloud", [False, True])
def test_a_truncated_ply_is_refused(tmp_path: Path, ascii_: bool, cloud: bool) -> None:
    """Open3D would take the points that are missing to lie at the origin."""
    path, mesh = tmp_path / "x.ply", open3d.geometry.TriangleMesh.create_sphere(0.1, 12)
    if cloud:
        points = open3d.geometry.PointCloud(mesh.vertices)
        open3d.io.write_point_cloud(str(path), points, write_ascii=ascii_)
    else:
        open3d.io.write_triangle_mesh(str(path), mesh, write_ascii=ascii_)
    assert len(load_surface(path).vertices) == len(mesh.vertices)
    whole = path.read_bytes()
    for share in (0.02, 0.3, 0.7, 0.98):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(CalibrationError, match="truncated"):
            load_surface(path)

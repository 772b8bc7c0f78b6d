"""`sfm-calib fuse`: what it writes of known surfaces, and what is refused."""

import json
import sys

import cv2
import numpy as np
import pytest
from synthetic.depths import (
    BALL,
    BESIDE,
    RADIUS,
    SIGMAS,
    SIZE,
    calibration,
    camera,
    needs_open3d,
    ranges,
    two,
    z_of,
)

from graphs.frames import Transform
from sfm_calib.cli import main
from sfm_calib.open3d_import import import_open3d


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

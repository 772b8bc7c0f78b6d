"""mrcal's .cameramodel: ours as mrcal reads it, mrcal's as we read it."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic.cameras import camera_of
from synthetic.refusals import refused, written
from synthetic.rigs_to_write import POINTS, exported, rig_of

from experiments.peers.mrcal import PYTHON, why_not
from graphs.camera import project
from graphs.frames import Transform
from sfm_calib.formats import read_calibration
from sfm_calib.formats.mrcal import LONGEST, MRCAL

PLACE = Transform.exp(np.array([0.1, -3.0, 0.3]), np.array([-0.11, 0.02, 0.003]))
needs_mrcal = pytest.mark.skipif(why_not() is not None, reason=str(why_not()))
# Reads the models of a folder, says where it sees points of the camera's and the reference frame,
# and writes models of its own.
SCRIPT = """
import json, sys
from pathlib import Path
import mrcal, numpy as np
folder, points = Path(sys.argv[1]), np.array(json.loads(sys.argv[2]))
answer = {}
for path in sorted(folder.glob("*.cameramodel")):
    model = mrcal.cameramodel(str(path))
    moved = mrcal.transform_point_Rt(model.extrinsics_Rt_fromref(), points)
    answer[path.stem] = {
        "pixels": mrcal.project(points, *model.intrinsics()).tolist(),
        "moved": moved.tolist(),
        "size": [int(n) for n in model.imagersize()],
    }
    model.write(str(folder / "theirs" / path.name), note="a note\\nof two lines")
extra = dict(imagersize=(640, 480), extrinsics_rt_fromref=np.arange(6) * .1)
for name, n in (("LENSMODEL_CAHVOR", 9), ("LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=20_fov_x_deg=120", 1204)):
    params = np.r_[500, 500, 320, 240, np.zeros(n - 4)]
    mrcal.cameramodel(intrinsics=(name, params), **extra).write(str(folder / "theirs" / (name[10:17] + ".cameramodel")))
print(json.dumps(answer))
"""  # noqa: E501


@needs_mrcal
def test_mrcal_sees_what_we_see(tmp_path: Path) -> None:
    cameras = tuple(replace(camera_of(lens), name=lens) for lens in MRCAL.lenses)
    rig = rig_of(cameras, (PLACE,) * len(cameras))
    exported(MRCAL.write(rig), MRCAL, tmp_path)
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    asked = [PYTHON, "-c", SCRIPT, str(tmp_path), json.dumps(POINTS.tolist())]
    done = subprocess.run(asked, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert len(answer) == len(cameras)
    for camera in cameras:
        seen = answer[camera.name]
        assert np.array(seen["pixels"]) == pytest.approx(project(camera, POINTS), abs=1e-9)
        assert np.array(seen["moved"]) == pytest.approx(PLACE @ POINTS, abs=1e-12)
        assert tuple(seen["size"]) == camera.size
        read = read_calibration(theirs / f"{camera.name}.cameramodel")
        assert read.cam_from_rig is not None
        # mrcal writes ten digits
        assert project(read.cameras[0], POINTS) == pytest.approx(project(camera, POINTS), abs=1e-6)
        assert read.cam_from_rig[0] @ POINTS == pytest.approx(PLACE @ POINTS, abs=1e-7)
    for name in ("CAHVOR", "SPLINED"):
        assert "mrcal-convert-lensmodel LENSMODEL_OPENCV8" in refused(
            theirs / f"{name}.cameramodel"
        )


MODEL = """# generated on 2024-05-01 with mrcal-calibrate-cameras
{
    'lensmodel':  'LENSMODEL_OPENCV4',
    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....
    'intrinsics': [ 500, 501.5, 320., 240, -0.1, 0.01, 1e-3, -2e-3,],
    'valid_intrinsics_region': [ [ 1, 2 ], [ 3, 4 ], [1, 2]],
    'extrinsics': [ 0, 0, 0, 1, 2, 3,],
    'imagersize': [ 640, 480,],
    'icam_intrinsics': 0,
    'optimization_inputs': b'P)h>@6aWAK2mk;8AOHXW%s{}~`|(a',
}
"""


def test_a_model_with_its_solve(tmp_path: Path) -> None:
    read = read_calibration(written(tmp_path / "camera-0.cameramodel", MODEL))
    camera = read.cameras[0]
    assert (camera.name, camera.lens, camera.size) == ("camera-0", "radtan", (640, 480))
    assert camera.params.tolist() == [500, 501.5, 320, 240, -0.1, 0.01, 1e-3, -2e-3]
    assert read.cam_from_rig is not None and read.cam_from_rig[0].translation.tolist() == [1, 2, 3]
    assert "optimization_inputs" in read.notes[0] and "valid_intrinsics_region" in read.notes[1]
    # A solve of megabytes is no obstacle.
    long = MODEL.replace("b'P)", "b'" + "P)h>@6aWAK2mk;8" * 200_000)
    assert read_calibration(written(tmp_path / "long.cameramodel", long)).notes[0] == (
        read.notes[0].replace("camera-0", "long")
    )


def test_models_by_their_old_names(tmp_path: Path) -> None:
    old = MODEL.replace("'lensmodel'", "'distortion_model'").replace("LENSMODEL", "DISTORTION")
    assert read_calibration(written(tmp_path / "a", old)).cameras[0].lens == "radtan"


def test_a_folder_is_a_rig(tmp_path: Path) -> None:
    for name in ("right", "left"):
        written(tmp_path / f"{name}.cameramodel", MODEL)
    read = read_calibration(tmp_path)
    assert read.names == ("left", "right") and read.unit == "unknown"
    assert read.cam_from_rig is not None and len(read.cam_from_rig) == 2


def test_files_are_data_never_code(tmp_path: Path) -> None:
    path, touched = tmp_path / "a.cameramodel", tmp_path / "touched"
    code = f"__import__('pathlib').Path({str(touched)!r}).touch()"
    for text in (
        MODEL.replace("'icam_intrinsics': 0", f"'icam_intrinsics': {code}"),
        MODEL.replace("[ 640, 480,]", f"[{code}, 480]"),
    ):
        assert "not the literal of a Python dict" in refused(written(path, text))
    assert not touched.exists()


@pytest.mark.parametrize("nest", ["[", "{1:", "-", "(", "1+", "not ", "a.", "1 if 1 else "])
def test_texts_that_try_pythons_parser(nest: str, tmp_path: Path) -> None:
    nested = nest * (LONGEST // len(nest) - len(MODEL)) + "1"
    path = written(tmp_path / "a.cameramodel", MODEL.replace("[ 640, 480,]", nested))
    assert "not the literal" in refused(path)
    written(path, MODEL.replace("[ 640, 480,]", nest * LONGEST))
    assert "too long for a camera model" in refused(path)


def test_models_that_are_not_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.cameramodel"
    for old, new, said in (
        ("'extrinsics'", "'else'", "extrinsics"),
        ("501.5", "-1", "both must be positive"),
        ("501.5", "1e999", "not finite"),
        ("640, 480", "640.5, 480", "whole number"),
        ("-2e-3,", "", "has 7 numbers, not 8"),
        ("500,", "1j,", "something else than numbers"),
        ("500,", "9" * 400 + ",", "something else than numbers"),
        ("LENSMODEL_OPENCV4", "LENSMODEL_X\\n\\n", "LENSMODEL_X, which no lens here is"),
    ):
        assert said in refused(written(path, MODEL.replace(old, new)))

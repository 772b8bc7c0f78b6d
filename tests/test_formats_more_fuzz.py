"""Files that are broken in every way: the one clear error, or a calibration that can be used."""

from __future__ import annotations

import json
import struct
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from synthetic.cameras import camera_of
from synthetic.rigs_to_write import rig_of

from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import NO_SIZE, CameraRig, read_calibration
from sfm_calib.formats.colmap_export import COLMAP
from sfm_calib.formats.mrcal import MRCAL, looks_like_mrcal
from sfm_calib.formats.nerf import NERF, looks_like_nerf
from sfm_calib.formats.rig_config import looks_like_rig_config

PLACES = (
    Transform.identity(),
    Transform.exp(np.array([0.1, -0.2, 0.3]), np.array([-0.1, 0.02, 0.003])),
)
RIG = rig_of(
    (replace(camera_of("radtan"), name="a"), replace(camera_of("brown"), name="b")), PLACES
)
MODEL = COLMAP.write(RIG).files
VALID: dict[str, bytes] = {
    "a.cameramodel": MRCAL.write(RIG).files["a.cameramodel"],
    "transforms.json": NERF.write(RIG).files[""],
    "rig_config.json": MODEL["rig_config.json"],
    "cameras.txt": MODEL["cameras.txt"],
    "rigs.txt": MODEL["rigs.txt"],
}
LONGEST_LINE = 1000  # of an error's message
fuzzed = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])


def valid(rig: CameraRig) -> None:
    assert rig.cameras and len(set(rig.names)) == len(rig.names)
    for camera in rig.cameras:
        assert isinstance(camera.name, str)
        assert np.isfinite(camera.params).all() and (camera.params[:2] > 0).all()
        assert camera.size == NO_SIZE or all(n > 0 and isinstance(n, int) for n in camera.size)
    for place in rig.cam_from_rig or ():
        R = place.rotation
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-9 and np.linalg.det(R) > 0
        assert np.isfinite(place.translation).all()
    assert rig.cam_from_rig is None or len(rig.cam_from_rig) == len(rig.cameras)


def read(path: Path) -> None:
    """A calibration that can be used, or one clear line."""
    said = ""
    try:
        valid(read_calibration(path))
    except CalibrationError as error:
        said = str(error)
    assert "\n" not in said and len(said) < LONGEST_LINE


def is_ours(name: str, content: bytes) -> bool:
    """Whether it goes to the readers that are tried here, and not to others."""
    text = content.decode("utf-8", "replace").lstrip()
    if not name.endswith("json"):
        return name.endswith("txt") or looks_like_mrcal(text)
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError):
        return text.startswith("{")
    return looks_like_rig_config(tree) or looks_like_nerf(tree)


def tried(name: str, content: bytes) -> None:
    """A file and its folder, beside the rest of a COLMAP model where it is of one."""
    if not is_ours(name, content):
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        if name == "rigs.txt":
            (path.parent / "cameras.txt").write_bytes(VALID["cameras.txt"])
        path.write_bytes(content)
        for place in [path.parent] if name == "rigs.txt" else [path, path.parent]:
            read(place)


def test_what_is_mutated_is_valid_before() -> None:
    for name, content in VALID.items():
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "cameras.txt").write_bytes(VALID["cameras.txt"])
            (Path(folder) / name).write_bytes(content)
            valid(read_calibration(Path(folder) / name.replace("rigs", "cameras")))


@pytest.mark.parametrize("name", VALID)
@fuzzed
@given(content=st.binary(max_size=200))
@example(b"")
@example(b"\x00")
@example(b"[")
@example(b"[{}]")
@example(b"{'lensmodel': 'LENSMODEL_PINHOLE'}")
@example(b'{"frames": [{"transform_matrix": 1}]}')
@example(b'{"frames": [{"transform_matrix": 1}, 2]}')
@example(b'[{"cameras": {"image_prefix": 1}}]')
@example(b"1 1\n")
def test_bytes_of_any_kind(name: str, content: bytes) -> None:
    tried(name, content)


PIECES = [
    b"nan", b"NaN", b"inf", b"-Infinity", b"1e308", b"-1", b"0", b"1e-320", b"9" * 400, b"true",
    b"null", b"None", b"'", b'"', b"[", b"]", b"{", b"}", b",", b":", b"\n", b" ", b"#", b"\\",
    b"\\x", b"\xff", b"\x00", b"\xf0\x9f\x98\x80", b"\\ud800", b"1j", b"b'x'", b"...", b"[[[[",
    b"../", b"CAMERA", b"LENSMODEL_CAHVOR", b"FULL_OPENCV", b"<x>", b"%s%n", b"__import__('os')",
]  # fmt: skip


@st.composite
def mutated(draw: st.DrawFn, name: str) -> bytes:
    content = VALID[name]
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(content)))
        end = min(len(content), at + draw(st.integers(0, 12)))
        twice = st.just(content[at:end] * 2)
        put = draw(st.one_of(st.sampled_from(PIECES), st.binary(max_size=3), twice))
        content = content[:at] + put + content[end:]
    return content


@pytest.mark.parametrize("name", VALID)
@fuzzed
@given(data=st.data())
def test_valid_files_with_bytes_changed(name: str, data: st.DataObject) -> None:
    tried(name, data.draw(mutated(name)))


Tree = Any
ANYTHING = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
        st.sampled_from([10**400, -(10**400), 1e308, "OPENCV_FISHEYE", "EUCM", "x" * 300, "a/b"]),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=6,
)  # fmt: skip


def changed(draw: Callable[[st.SearchStrategy[Any]], Any], tree: Tree) -> Tree:
    """The tree with something else at one place of it, or something missing."""
    if not isinstance(tree, dict | list) or not tree or draw(st.integers(0, 4)) == 0:
        return draw(ANYTHING)
    keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
    key = draw(st.sampled_from(keys))
    copy = tree.copy()
    if draw(st.integers(0, 5)) == 0:
        del copy[key]
    else:
        copy[key] = changed(draw, tree[key])
    return copy


@pytest.mark.parametrize("name", ["transforms.json", "rig_config.json", "a.cameramodel"])
@fuzzed
@given(data=st.data())
def test_valid_files_with_entries_of_another_kind(name: str, data: st.DataObject) -> None:
    literal = name.endswith(".cameramodel")
    tree = eval(VALID[name]) if literal else json.loads(VALID[name])
    for _ in range(data.draw(st.integers(1, 3))):
        tree = changed(data.draw, tree)
    tried(name, (repr(tree) if literal else json.dumps(tree)).encode("utf-8", "surrogatepass"))


@pytest.mark.parametrize("name", VALID)
@pytest.mark.parametrize(("start", "end"), [("[", "]"), ('{"a":', "}"), ("(", ")"), ("-", "")])
@pytest.mark.parametrize("count", [500, 100_000])
def test_deep_nesting(name: str, start: str, end: str, count: int) -> None:
    deep = (start * count + "1" + end * count).encode()
    tried(name, deep)
    for old in (b"640", b"0.0", b"520.0", b"1"):
        tried(name, VALID[name].replace(old, deep, 1))


@fuzzed
@given(
    cameras=st.binary(max_size=200), rigs=st.binary(max_size=120), whole=st.booleans(),
    model=st.integers(-1, 20), values=st.lists(st.floats(), min_size=12, max_size=12),
    size=st.lists(st.integers(0, 2**64 - 1), min_size=2, max_size=2),
)  # fmt: skip
def test_binary_models(
    cameras: bytes, rigs: bytes, whole: bool, model: int, values: list[float], size: list[int]
) -> None:
    if whole:
        cameras = struct.pack("<QIiQQ12d", 1, 1, model, *size, *values)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "cameras.bin").write_bytes(cameras)
        (Path(folder) / "rigs.bin").write_bytes(rigs)
        read(Path(folder))

"""Files that are damaged, mad or meant to harm: one clear error, or a calibration; nothing else."""

from __future__ import annotations

import re
import struct
import time
import tracemalloc
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic.calibrations import READ_BACK, rig_of
from synthetic.hand_written import CALISCOPE, COLMAP_CAMERAS, COLMAP_RIGS, KITTI, QUALISYS
from synthetic.refusals import refused, written

from sfm_calib.errors import CalibrationError
from sfm_calib.formats import NO_SIZE, read_calibration
from sfm_calib.formats.convert import FORMATS, exported

Files = dict[str, bytes]  # by name; of one alone, that is what is read, else their folder


def seeds() -> dict[str, Files]:
    """A whole calibration of every format."""
    colmap = struct.pack("<QIiQQ8d", 1, 1, 4, 640, 480, 520, 529, 330, 231, -0.31, 0.1, 0, 0)
    found: dict[str, Files] = {
        "caliscope": {"camera_array.toml": CALISCOPE.encode()},
        "qualisys": {"a.qca.txt": QUALISYS.encode()},
        "kitti": {"calib.txt": KITTI.encode()},
        "colmap text": {"cameras.txt": COLMAP_CAMERAS.encode(), "rigs.txt": COLMAP_RIGS.encode()},
        "colmap binary": {
            "cameras.bin": colmap,
            "rigs.bin": struct.pack("<QIIiI", 1, 1, 1, 0, 1),
        },
    }
    for name in READ_BACK:
        form = FORMATS[name]
        count = {"one": 1, "two": 2, "any": 3}[form.cameras]
        for size in {1, 2, count} if form.cameras != "one" else {1}:
            files = exported(rig_of(*[form.lenses[0]] * size), name).files
            found[f"{name} {size}"] = {key or "file": content for key, content in files.items()}
    return found


SEEDS = seeds()
NUMBER = re.compile(rb"-?\d+\.?\d*(?:e[+-]?\d+)?")
WORD = re.compile(rb"[A-Za-z_]\w*")
HOSTILE = [
    b"nan", b".nan", b"NaN", b"inf", b"-inf", b".inf", b"Infinity", b"1e400", b"-1e308", b"1e155",
    b"0", b"-1", b"1e-320", b"9" * 30, b"9" * 5000, b"x", b'"x"', b"''", b"null", b"~", b"true",
    b"[]", b"{}", b"[[1, 2], [3]]", b"[" * 20000, b"{" * 5000, b"- " * 3000, b"<a>" * 3000, b"*a",
    b"&a [*a, *a]", b"&a 1", b"!!python/object/apply:os.system ['false']", b"!!binary x",
    b"1:30:30", b"2001-99-99", b"1, " * 20000,
    b"0x1F", b"1_000", b"$base64$AAAA", b"\x00", b"\xff\xfe", b"\t",
    b"a.b." * 20000, b"]]>", b"&amp;", b"&#0;", b"<!--", b"%", b"\\u0000", b"\\ud800", b"= 1\n[",
]  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, max(len(content) - 1, 0)))
        to = min(len(content), at + draw(st.integers(0, 40)))
        kind = draw(st.sampled_from(["number", "word", "flip", "cut", "end", "twice", "insert"]))
        if kind in ("number", "word"):
            found = list((NUMBER if kind == "number" else WORD).finditer(content))
            if found:
                one = draw(st.sampled_from(found))
                new = draw(st.sampled_from(HOSTILE))
                content = content[: one.start()] + new + content[one.end() :]
        elif kind == "flip" and content:
            content = content[:at] + bytes([draw(st.integers(0, 255))]) + content[at + 1 :]
        elif kind == "cut":
            content = content[:at] + content[to:]
        elif kind == "end":
            content = content[:at]
        elif kind == "twice":
            content = content[:to] + content[at:]
        else:
            content = content[:at] + draw(st.binary(max_size=20)) + content[at:]
    return content


def is_one_error_or_a_calibration(folder: Path, files: Files) -> None:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    path = folder / next(iter(files)) if len(files) == 1 else folder
    try:
        rig = read_calibration(path)
    except CalibrationError:
        assert refused(path)  # in one line
        return
    assert rig.cameras and len(set(rig.names)) == len(rig.names)
    for camera in rig.cameras:
        assert np.isfinite(camera.params).all() and (camera.params[:2] > 0).all()
        assert camera.size == NO_SIZE or min(camera.size) > 0
    for place in rig.cam_from_rig or ():
        assert place.rotation @ place.rotation.T == pytest.approx(np.eye(3), abs=1e-6)
    if rig.cam_from_rig and all(camera.size != NO_SIZE for camera in rig.cameras):
        assert exported(rig, "sfm_calib").files[""]


@pytest.mark.parametrize("which", SEEDS)
def test_every_seed_is_a_calibration(which: str, tmp_path: Path) -> None:
    """Else the tests below would ask nothing."""
    for name, content in SEEDS[which].items():
        (tmp_path / name).write_bytes(content)
    one = next(iter(SEEDS[which]))
    assert read_calibration(tmp_path / one if len(SEEDS[which]) == 1 else tmp_path).cameras


@pytest.mark.parametrize("which", SEEDS)
@settings(max_examples=20, deadline=None)
@given(data=st.data())
def test_damaged_files_of_every_format(which: str, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(SEEDS[which])))
    files = SEEDS[which] | {name: data.draw(damaged(SEEDS[which][name]))}
    with TemporaryDirectory() as folder:
        is_one_error_or_a_calibration(Path(folder), files)


STARTS = [b"", b"{", b"<", b"%YAML:1.0\n---\n", b"a:\n", b"[a]\n", b"<opencv_storage>"]
TEXTS = st.text(max_size=200).map(lambda text: text.encode("utf-8", "replace"))


@pytest.mark.parametrize("name", ["x.yaml", "x.json", "x.xml", "x.toml", "cameras.bin", "x"])
@settings(max_examples=20, deadline=None)
@given(start=st.sampled_from(STARTS), content=st.binary(max_size=300) | TEXTS)
def test_any_bytes(name: str, start: bytes, content: bytes) -> None:
    with TemporaryDirectory() as folder:
        is_one_error_or_a_calibration(Path(folder), {name: start + content})


# ---- bombs ---------------------------------------------------------------------------------

LAUGHS = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
BOMBS = {
    "aliases": (
        "x.yaml",
        f"{LAUGHS}cam0:\n  camera_model: pinhole\n  intrinsics: *i\n  resolution: [1, 1]\n",
    ),
    "an alias of itself": ("x.yaml", "cam0: &a\n  camera_model: *a\n  intrinsics: [*a]\n"),
    "lists in lists": ("x.yaml", "a: " + "[" * 1_000_000),
    "rows in rows": ("x.yaml", "\n".join(" " * i + "a:" for i in range(2000))),
    "dashes": ("x.yaml", "- " * 500_000),
    "json in json": ("x.json", '{"cameras": ' + "[" * 1_000_000),
    "many empty lists": ("x.json", '{"cameras": [' + "[]," * 10_000_000),
    "tags in tags": ("x.xml", "<opencv_storage>" + "<a>" * 500_000),
    "tags in tags to the end": ("x.xml", "<a>" * 100_000 + "</a>" * 100_000),
    "entities": (
        "x.xml",
        '<!DOCTYPE l [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]><opencv_storage>&b;</opencv_storage>',
    ),
    "a matrix larger than memory": (
        "x.yml",
        "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 2000000000\n   cols: 2000000000\n   dt: d\n"
        "   data: [ 1. ]\n",
    ),
    "a key of many parts": ("x.toml", "a." * 1_000_000 + "a = 1\n"),
    "many numbers": ("calib.txt", "P0: " + "1 " * 20_000_000),
    "a long number": ("x.json", '{"cameras": ' + "9" * 1_000_000 + "}"),
    "a wide image": (
        "x.yaml",
        "image_width: 1e12\nimage_height: 5\ncamera_matrix: [5,0,5,0,5,5,0,0,1]\n",
    ),
}


@pytest.mark.parametrize("which", BOMBS)
def test_bombs_do_not_go_off(which: str, tmp_path: Path) -> None:
    name, text = BOMBS[which]
    path = written(tmp_path / name, text)
    tracemalloc.start()
    start = time.process_time()
    assert refused(path)
    seconds, (_, peak) = time.process_time() - start, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seconds < 3  # 0.2, and tracing them
    assert peak < 30e6 + 4 * len(text)


def test_pipes_and_folders_of_rubbish_are_refused(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "pipe.yaml")
    assert "is no file" in refused(tmp_path / "pipe.yaml")
    assert "is no file" in refused(tmp_path)


def test_names_that_no_camera_has_are_refused(tmp_path: Path) -> None:
    text = exported(rig_of("radtan", "radtan"), "kalibr").files[""].decode()
    for name in ("cam0", "x" * 201, '"\\e[31m"', '"a\\nb"', '" "'):
        path = written(
            tmp_path / "x.yaml", text.replace("camera_name: cam1", f"camera_name: {name}")
        )
        assert "name" in refused(path)

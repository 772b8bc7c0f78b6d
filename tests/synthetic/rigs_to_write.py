"""Rigs of any lens, place and name, to write to files and read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from sfm_calib.formats import CameraRig, read_calibration
from sfm_calib.formats.reading import LengthUnit
from sfm_calib.formats.writing import Export, Format
from synthetic.cameras import COEFFICIENTS, points_ahead, wide

POINTS = points_ahead(50, spread=0.4)
ODD_NAMES = [
    "cam 0", "Größe", "日本", "left/cam", "/etc/passwd", "..", "../../up", "a/../b", "./c", "C:\\x",
    "it's", 'say "hi"', "<script>alert(1)</script>", "&amp;", "100%", "a%2Fb", "~", "$(rm)",
    "cam.1", ".hidden", "{}", "x" * 60,
]  # fmt: skip


def _numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def cameras(draw: st.DrawFn, name: str, lenses: tuple[LensName, ...]) -> Camera:
    lens = draw(st.sampled_from(lenses))
    size = draw(st.integers(64, 9000)), draw(st.integers(48, 9000))
    fx = draw(_numbers(200, 3000))
    fy = draw(st.sampled_from([fx, fx * 1.01]))  # some formats tell the two apart
    centre = draw(_numbers(0, size[0])), draw(_numbers(0, size[1]))
    share = draw(_numbers(0.1, 1.0)) if not wide(lens) else 1.0
    params = [fx, fy, *centre, *(share * k for k in COEFFICIENTS[lens])]
    return Camera(name, lens, size, np.array(params))


def transforms() -> st.SearchStrategy[Transform]:
    """Half turns too."""
    axes = st.tuples(*[_numbers(-1, 1)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1)
    angles = st.one_of(_numbers(0, np.pi), st.sampled_from([np.pi / 2, np.pi]))
    shifts = st.tuples(*[_numbers(-50, 50)] * 3)
    return st.builds(
        lambda axis, angle, shift: Transform.exp(
            angle * np.array(axis) / np.linalg.norm(axis), np.array(shift)
        ),
        axes, angles, shifts,
    )  # fmt: skip


@st.composite
def rigs(draw: st.DrawFn, lenses: tuple[LensName, ...]) -> CameraRig:
    """Of one to four cameras; a camera or none at the rig's origin."""
    known = st.sampled_from(["b", "a", *ODD_NAMES])
    names = draw(st.lists(known, min_size=1, max_size=4, unique=True))
    places = [draw(transforms()) for _ in names]
    if draw(st.booleans()):
        places[draw(st.integers(0, len(names) - 1))] = Transform.identity()
    found = tuple(draw(cameras(name, lenses)) for name in names)
    return rig_of(found, tuple(places))


def rig_of(
    cameras: tuple[Camera, ...], places: tuple[Transform, ...], unit: LengthUnit = "m"
) -> CameraRig:
    return CameraRig(Path("rig.json"), "a test's", cameras, places, unit)


def exported(export: Export, format: Format, folder: Path) -> Path:
    """Where the files of an export lie, none of them outside the folder."""
    for name, content in export.files.items():
        path = folder / (name or format.name)
        assert path.resolve().parent == folder.resolve()
        path.write_bytes(content)
    return folder


def read_again(export: Export, format: Format, folder: Path) -> CameraRig:
    return read_calibration(exported(export, format, folder))


def relative(rig: CameraRig, name: str, other: str) -> FloatArray:
    """name_from_other (3, 4)."""
    assert rig.cam_from_rig is not None
    of = dict(zip(rig.names, rig.cam_from_rig, strict=True))
    between = of[name] @ of[other].inverse
    return np.column_stack([between.rotation, between.translation])

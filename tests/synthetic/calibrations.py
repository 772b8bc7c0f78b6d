"""Calibrations as they are read from files, with known and with random numbers, and their files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from graphs.camera import image_pixels, project, unproject
from graphs.frames import Transform
from graphs.lenses import LensName
from sfm_calib.formats import CameraRig, read_calibration
from sfm_calib.formats.convert import FORMATS, FormatName, exported
from sfm_calib.formats.reading import LengthUnit
from sfm_calib.formats.writing import Export
from synthetic.cameras import COEFFICIENTS, camera_of

READ_BACK = [name for name in FORMATS if name != "urdf"]  # which is written alone
# What a folder, or another program, may call a camera.
NAMES = st.text(
    st.characters(blacklist_categories=["C", "Z"]) | st.sampled_from(" ,'\"\\:#&<>{}[]%-~"),
    min_size=1, max_size=12,
).filter(lambda name: name.strip() == name)  # fmt: skip


def rig_of(*lenses: LensName, unit: LengthUnit = "m", names: tuple[str, ...] = ()) -> CameraRig:
    """Cameras side by side, 0.1 apart and turned a little, the first at the rig's origin."""
    names = names or tuple(f"cam{i}" for i in range(len(lenses)))
    cameras = tuple(
        replace(camera_of(lens), name=name) for lens, name in zip(lenses, names, strict=True)
    )
    turns = [np.array([0.02, -0.03, 0.01]) * i for i in range(len(lenses))]
    moves = [np.array([-0.1, 0.004, -0.007]) * i for i in range(len(lenses))]
    places = tuple(Transform.exp(r, t) for r, t in zip(turns, moves, strict=True))
    return CameraRig(Path("memory"), "made up", cameras, places, unit)


@st.composite
def rigs(draw: st.DrawFn, lenses: tuple[LensName, ...], most: int) -> CameraRig:
    """Up to `most` cameras of these lenses, placed and turned anyhow, in metres."""
    number = st.floats(0.7, 1.3)
    names = draw(st.lists(NAMES, min_size=1, max_size=most, unique=True))
    cameras, places = [], []
    width, height = draw(st.integers(64, 5000)), draw(st.integers(64, 5000))
    for name in names:
        lens = draw(st.sampled_from(lenses))
        k = [c * draw(number) for c in COEFFICIENTS[lens]]
        camera = camera_of(lens, tuple(k))
        params = camera.params.copy()
        params[:4] *= [draw(number) for _ in range(4)]
        cameras.append(replace(camera, name=name, size=(width, height), params=params))
        turn = [draw(st.floats(-np.pi, np.pi)) for _ in range(3)]
        move = [draw(st.floats(-10, 10).map(lambda x: round(x, 12))) for _ in range(3)]
        places.append(Transform.exp(np.array(turn) / 2, np.array(move)))
    return CameraRig(Path("memory"), "made up", tuple(cameras), tuple(places), "m")


def put(export: Export, out: Path) -> Path:
    """The files of an export, at OUT or in it."""
    for name, content in export.files.items():
        path = out / name if name else out
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return out


def there(rig: CameraRig, to: FormatName, out: Path, max_error_px: float = 1e-6) -> CameraRig:
    """A calibration in metres written in a format, and read again."""
    back = read_calibration(put(exported(rig, to, max_error_px), out))
    # mrcal, COLMAP and NeRF do not say what they count in, as one says with --metres 1.
    return back.metric(1.0) if rig.unit == "m" and back.unit == "unknown" else back


def apart_px(a: CameraRig, b: CameraRig) -> float:
    """How far two calibrations project points of the first camera's view apart, in any camera.

    Each camera's own rays, 1 and 7 units away, go through the rig of `a` to the first camera and
    through that of `b` to the pixel.
    """
    assert a.names == b.names
    worst = 0.0
    for i, (one, other) in enumerate(zip(a.cameras, b.cameras, strict=True)):
        assert one.size == other.size
        pixels = image_pixels(one.size, (17, 13))[2]
        rays = unproject(one, pixels)
        seen = np.isfinite(rays[:, 0])
        for distance in (1.0, 7.0):
            points = distance * rays[seen]
            if a.cam_from_rig is not None and b.cam_from_rig is not None:
                in_first = (a.cam_from_rig[0] @ a.cam_from_rig[i].inverse) @ points
                points = (b.cam_from_rig[i] @ b.cam_from_rig[0].inverse) @ in_first
            off = np.abs(project(other, points) - pixels[seen])
            worst = max(worst, float(np.nan_to_num(off, nan=np.inf).max(initial=0.0)))
    return worst

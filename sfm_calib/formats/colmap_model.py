"""A COLMAP model's cameras and rigs, as text or binary, without COLMAP.

COLMAP puts (0.5, 0.5) at the centre of the top-left pixel: half a pixel is subtracted. Its cameras
have no names and its lengths no unit.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from graphs.camera import Camera
from graphs.frames import Transform
from graphs.lenses import LensName
from sfm_calib.colmap_lenses import LENS_OF_MODEL, out_of_model
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.numbers import numbers
from sfm_calib.formats.reading import CameraRig, image_size

FORMAT = "COLMAP model"
PIXEL_OFFSET = 0.5
# By COLMAP's number: name and parameters by our names (src/colmap/sensor/models.h).
MODELS: dict[int, tuple[str, str]] = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    12: ("SIMPLE_DIVISION", "f cx cy k1"),
    13: ("DIVISION", "fx fy cx cy k1"),
    14: ("SIMPLE_FISHEYE", "f cx cy"),
    15: ("FISHEYE", "fx fy cx cy"),
    16: ("EUCM", "fx fy cx cy alpha beta"),
}
# Models that our own mapping never writes; equidistant, as kannala_brandt with few coefficients.
FISHEYES = ("SIMPLE_RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE")
LONGEST_REASON = 100  # characters: it may quote the file
LARGEST_ID = 2**32 - 1
CAMERA_SENSOR = 0  # in binary; in text CAMERA


@dataclass(frozen=True)
class Sensor:
    """A camera of a rig; no transform where the model does not know it."""

    camera_id: int
    cam_from_rig: Transform | None


def read_colmap(folder: Path) -> CameraRig:
    """The cameras of a model's folder in the order of their numbers, and its rig.

    Raises CalibrationError for models of other lenses and for files that are not whole.
    """
    text = (folder / "cameras.txt").is_file()
    try:
        cameras = dict(_text_cameras(folder) if text else _binary_cameras(folder))
        rigs = _text_rigs(folder) if text else _binary_rigs(folder)
    except (ValueError, IndexError, struct.error) as error:
        said = str(error)[:LONGEST_REASON]
        raise CalibrationError(f"{folder} is no whole COLMAP model: {said}") from error
    if not cameras:
        raise CalibrationError(f"{folder} is a COLMAP model without cameras")
    rig, notes = _rig_of_all(folder, rigs, sorted(cameras))
    return CameraRig(
        folder, FORMAT, tuple(cameras[i] for i in sorted(cameras)), rig, "unknown", notes=notes
    )


def _rig_of_all(
    folder: Path, rigs: list[list[Sensor]], ids: list[int]
) -> tuple[tuple[Transform, ...] | None, tuple[str, ...]]:
    if len(ids) == 1:
        return None, ()
    for sensors in rigs:
        placed = {s.camera_id: s.cam_from_rig for s in sensors}
        known = [placed.get(i) for i in ids]
        whole = tuple(t for t in known if t is not None)
        if len(whole) == len(ids):
            return whole, ()
    return None, (f"{folder} holds no rig of all its {len(ids)} cameras: each is compared alone",)


def model_camera(
    path: Path, name: str, model: str, size: tuple[int, int], values: Sequence[float]
) -> Camera:
    """The camera of one of COLMAP's models and its parameters.

    Raises CalibrationError for a model that no lens here is, and for parameters that cannot be.
    """
    names = next((names.split() for known, names in MODELS.values() if known == model), None)
    if names is None:
        raise CalibrationError(
            f"{path}: {name} is {model[:40]}, which no lens here is: of COLMAP's there are "
            f"{', '.join(known for known, _ in MODELS.values())}"
        )
    values = numbers(f"{path}: {model} of {name}", values, len(names)).tolist()
    found = dict(zip(names, values, strict=True))
    if "f" in found:
        found |= {"fx": found["f"], "fy": found["f"]}
    if not (found["fx"] > 0 and found["fy"] > 0):
        raise CalibrationError(f"{path}: {name} has a focal length that is not positive")
    found |= {"cx": found["cx"] - PIXEL_OFFSET, "cy": found["cy"] - PIXEL_OFFSET}
    source = "RADIAL_FISHEYE" if model in FISHEYES else model
    lens: LensName = LENS_OF_MODEL[source]
    return out_of_model(name, size, source, found, lens)


def _placed(q_and_t: Sequence[float]) -> Transform:
    """From a quaternion wxyz and a translation, seven numbers."""
    values = numbers("the place of a camera in the rig", q_and_t, 7).tolist()
    return Transform.from_wxyz(values[:4], values[4:])


# ---- text ----------------------------------------------------------------------------------


def _rows(path: Path) -> Iterator[list[str]]:
    for line in path.read_text("utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            yield line.split()


def _text_cameras(folder: Path) -> Iterator[tuple[int, Camera]]:
    for number, model, width, height, *values in _rows(folder / "cameras.txt"):
        if not 0 <= int(number) <= LARGEST_ID:
            raise ValueError(f"{number[:20]} is no number of a camera")
        name = f"camera{int(number)}"
        size = image_size(f"{folder}: {name}", width, height)
        params = [float(value) for value in values]
        yield int(number), model_camera(folder, name, model, size, params)


def _text_rigs(folder: Path) -> list[list[Sensor]]:
    path = folder / "rigs.txt"
    return [_text_rig(row) for row in _rows(path)] if path.is_file() else []


def _text_rig(row: list[str]) -> list[Sensor]:
    sensors, rest = [], row[2:]
    if int(row[1]) and rest[0] == "CAMERA":
        sensors.append(Sensor(int(rest[1]), Transform.identity()))
    rest = rest[2:]
    while rest:
        kind, number, has_pose = rest[0], int(rest[1]), rest[2] == "1"
        if kind == "CAMERA":
            placed = _placed([float(v) for v in rest[3:10]]) if has_pose else None
            sensors.append(Sensor(number, placed))
        rest = rest[10 if has_pose else 3 :]
    return sensors


# ---- binary: little endian, as COLMAP writes it --------------------------------------------


class _Bytes:
    """Reads numbers one after the other."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, kinds: str) -> tuple[float, ...]:
        found: tuple[float, ...] = struct.unpack_from(f"<{kinds}", self.data, self.at)
        self.at += struct.calcsize(f"<{kinds}")
        return found


def _binary_cameras(folder: Path) -> Iterator[tuple[int, Camera]]:
    file = _Bytes(folder / "cameras.bin")
    for _ in range(int(file.take("Q")[0])):
        camera_id, model_id, width, height = (int(n) for n in file.take("IiQQ"))
        if model_id not in MODELS:
            raise CalibrationError(
                f"{folder}: camera {camera_id} has COLMAP's model number {model_id}, which no "
                "lens here is"
            )
        model, names = MODELS[model_id]
        values = file.take(f"{len(names.split())}d")
        name = f"camera{camera_id}"
        size = image_size(f"{folder}: {name}", width, height)
        yield camera_id, model_camera(folder, name, model, size, values)


def _binary_rigs(folder: Path) -> list[list[Sensor]]:
    if not (folder / "rigs.bin").is_file():
        return []
    file, rigs = _Bytes(folder / "rigs.bin"), []
    for _ in range(int(file.take("Q")[0])):
        sensors: list[Sensor] = []
        _, count = file.take("II")
        for number in range(int(count)):
            kind, sensor_id = (int(n) for n in file.take("iI"))
            placed: Transform | None = Transform.identity()
            if number:
                has_pose = bool(file.take("B")[0])
                placed = _placed(file.take("7d")) if has_pose else None
            if kind == CAMERA_SENSOR:
                sensors.append(Sensor(sensor_id, placed))
        rigs.append(sensors)
    return rigs

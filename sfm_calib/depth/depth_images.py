"""Files of depth images, found camera by camera and read in metres."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.images import IMAGE_SUFFIXES, counting_order, read_image

DEPTH_SUFFIXES = {".png", ".npy", ".tif", ".tiff", ".exr", ".pgm"}
MOST_UNIT = 1.0  # m per count: depth in whole metres is none
CV_UNCHANGED = -1  # cv2.IMREAD_UNCHANGED
Uint8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Frame:
    """Images taken together: a file a camera."""

    name: str
    paths: dict[str, Path]  # by the calibration's camera


def find_frames(
    given: Path, cameras: Sequence[str], suffixes: Collection[str] = DEPTH_SUFFIXES
) -> tuple[Frame, ...]:
    """A folder with a sub-folder of images per camera, where files of one stem are one frame; or
    images directly in it, one a camera and called as it, or all of the only camera; or one image.

    Raises CalibrationError where there is none, or where the camera of one cannot be told.
    """
    if not given.exists():
        raise CalibrationError(f"no such input: {given}; give a folder of images, or an image")
    found = _by_camera(given, cameras, suffixes)
    stems = sorted({stem for files in found.values() for stem in files}, key=counting_order)
    return tuple(
        Frame(stem, {name: found[name][stem] for name in cameras if stem in found.get(name, {})})
        for stem in stems
    )


def _by_camera(
    given: Path, cameras: Sequence[str], suffixes: Collection[str]
) -> dict[str, dict[str, Path]]:
    """Files by camera and frame."""
    if given.is_file():
        if len(cameras) == 1:
            return {cameras[0]: {given.stem: given}}
        names = [name for name in (given.stem, given.resolve().parent.name) if name in cameras]
        if not names:
            raise _whose(given, given.stem, cameras)
        return {names[0]: {given.stem: given}}
    flat = _files(given, suffixes)
    folders = {
        p.name: files
        for p in sorted(given.iterdir())
        if p.is_dir() and not p.name.startswith(".") and (files := _files(p, suffixes))
    }
    if flat and folders:
        raise CalibrationError(
            f"{given} holds {len(flat)} images beside {len(folders)} folders of images: put every "
            "image into its camera's folder"
        )
    if not flat and not folders:
        raise CalibrationError(
            f"{given} holds no images ({' '.join(sorted(suffixes))}): expected a sub-folder of "
            "images per camera, or an image per camera that is called as the camera"
        )
    if len(cameras) == 1 and len(folders) <= 1:
        return {cameras[0]: flat or next(iter(folders.values()))}
    for name in folders or flat:
        if name not in cameras:
            raise _whose((given / name) if folders else flat[name], name, cameras)
    return folders or {name: {given.resolve().name: path} for name, path in flat.items()}


def _whose(path: Path, name: str, cameras: Sequence[str]) -> CalibrationError:
    return CalibrationError(
        f"{path}: {name!r} is no camera of the calibration: {nearest(name, cameras)}; rename it "
        "as its camera is called"
    )


def _files(folder: Path, suffixes: Collection[str]) -> dict[str, Path]:
    """Images of a folder by their stems."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir(), key=lambda p: counting_order(p.name)):
        if path.suffix.lower() not in suffixes or path.name.startswith(".") or path.is_dir():
            continue
        if path.stem in found:
            raise CalibrationError(
                f"{found[path.stem]} and {path.name} would be one frame: take one of them away"
            )
        found[path.stem] = path
    return found


# ---- reading -------------------------------------------------------------------------------


def read_depth(path: Path, unit_m: float) -> FloatArray:
    """Depth (h, w) in m: whole numbers times `unit_m`, floating point as it is.

    Raises CalibrationError for what is no depth image.
    """
    if not 0 < unit_m <= MOST_UNIT:
        raise CalibrationError(
            f"--depth-unit {unit_m:g} is no length: say how many metres a count is, above 0 and up "
            f"to {MOST_UNIT:g}"
        )
    pixels = _npy(path) if path.suffix.lower() == ".npy" else _image(path)
    if pixels.ndim != 2 or not pixels.size:
        raise CalibrationError(
            f"{path} has the shape {' x '.join(map(str, pixels.shape))}: a depth image has rows, "
            "columns and one channel; is it a picture, or a coloured rendering of depth?"
        )
    if pixels.dtype == np.uint8 or pixels.dtype.kind not in "uif":
        raise CalibrationError(
            f"{path} holds {pixels.dtype}: depth is whole numbers of 16 bits or more, or floating "
            "point in metres; export the raw depth"
        )
    metres = pixels.astype(np.float64)
    return metres if pixels.dtype.kind == "f" else metres * unit_m


def _npy(path: Path) -> NDArray[Any]:
    try:
        array = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        said = " ".join(str(error).split())[:120]
        raise CalibrationError(f"{path} is no array that numpy can read: {said}") from error
    if not isinstance(array, np.ndarray):
        raise CalibrationError(f"{path} is no array but an archive: save one array with np.save")
    return array


def _image(path: Path) -> NDArray[Any]:
    if path.suffix.lower() == ".exr":  # OpenCV reads it only where it is told that it may
        os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    pixels = read_image(path, CV_UNCHANGED)
    if pixels is None:
        raise CalibrationError(
            f"{path} is unreadable, truncated, or of a kind that OpenCV cannot decode: save it as "
            "16-bit PNG, or with np.save"
        )
    return pixels


def read_colours(path: Path, size: tuple[int, int]) -> Uint8:
    """Red, green, blue (h, w, 3) of a picture that is registered to a depth image of a size.

    Raises CalibrationError for another size, and for what cannot be decoded.
    """
    pixels = read_image(path, 1)  # cv2.IMREAD_COLOR: 8 bits
    if pixels is None:
        raise CalibrationError(f"{path} is unreadable or truncated")
    if pixels.shape[1::-1] != size:
        raise CalibrationError(
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} px and its depth image {size[0]} x "
            f"{size[1]} px: colours must be registered to the depth, pixel by pixel; leave out "
            "--colours otherwise"
        )
    return np.ascontiguousarray(pixels[..., ::-1])


COLOUR_SUFFIXES = IMAGE_SUFFIXES

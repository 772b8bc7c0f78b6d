"""The scan's layout: folders are cameras, files of the same stem are one frame.

One flat folder is one camera, a video file is one camera too. Every image is decoded once here,
so that a broken file is named before an hour of mapping rather than after.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_calib import video
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256

# What OpenCV and COLMAP both read; COLMAP has no WebP.
IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}
LONE_CAMERA = "camera"  # its name, where nothing gives one
START_OF_SCAN = 0xDA  # of a JPEG: its compressed pixels follow
MIN_IMAGES = 3  # fewer views do not determine a focal length
Progress = Callable[[str, int, int], None]  # stage, done, total


@dataclass(frozen=True)
class ScanImage:
    """One image: its place in the scan and its file, relative to the scan's root."""

    camera: int
    frame: int
    path: str


@dataclass(frozen=True)
class Scan:
    """All readable images of a scan."""

    root: Path
    cameras: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]  # width, height of each camera
    frames: tuple[str, ...]
    images: tuple[ScanImage, ...]
    warnings: tuple[str, ...] = ()

    def name(self, image: ScanImage) -> str:
        """How messages call an image."""
        return f"{self.cameras[image.camera]}/{self.frames[image.frame]}"

    @property
    def numbers(self) -> dict[tuple[int, int], int]:
        """The number of every image, by its camera and frame."""
        return {(image.camera, image.frame): i for i, image in enumerate(self.images)}

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of every image, by its path."""
        return {image.path: sha256(self.root / image.path) for image in self.images}


def read_scan(
    scan: Path,
    cache: Cache,
    matching: Literal["stem", "order"],
    video_frames: int,
    progress: Progress,
) -> Scan:
    """Find and check the images of a scan; videos are unpacked into the cache.

    Raises CalibrationError when there is nothing to calibrate from, or sizes differ.
    """
    check_exists(scan)
    files = find_images(scan)
    root = scan
    if not files:
        videos = video.find_videos(scan)
        if not videos:
            raise CalibrationError(nothing_in(scan))
        inputs = [{name: sha256(path) for name, path in videos.items()}, video_frames]
        root = cache.stage(
            "frames", inputs, lambda place: video.unpack(videos, place, video_frames, progress)
        )
        files = find_images(root)
    readable, warnings, sizes = _check_files(root, files, progress)
    n_images = sum(len(paths) for paths in readable.values())
    if n_images < MIN_IMAGES:
        unreadable = f" ({'; '.join(warnings)})" if warnings else ""
        raise CalibrationError(
            f"{scan} holds {n_images} readable image{'s' * (n_images != 1)}{unreadable}, and a "
            f"calibration needs at least {MIN_IMAGES}: take more views from different places"
        )
    return _number_images(root, files, readable, sizes, matching, warnings)


def check_exists(scan: Path) -> None:
    """Raises CalibrationError when there is no such scan."""
    if not scan.exists():
        raise CalibrationError(f"no such scan: {scan}; give a folder of images or a video file")


def camera_names(scan: Path) -> tuple[str, ...]:
    """The cameras of a scan, without looking into its images."""
    check_exists(scan)
    videos = video.find_videos(scan)
    return tuple(find_images(scan) or (videos if len(videos) > 1 else (LONE_CAMERA,)))


def nothing_in(scan: Path) -> str:
    """What to tell of a scan without images and videos."""
    if scan.is_file():
        return (
            f"{scan} is no video: give a folder of images or a video file "
            f"({' '.join(sorted(video.SUFFIXES))})"
        )
    known = IMAGE_SUFFIXES | video.SUFFIXES
    others = sorted({p.suffix.lower() for p in scan.rglob("*") if p.is_file()} - known - {""})
    found = f" (it has {' '.join(others[:5])} files)" if others else ""
    return (
        f"{scan} holds no images{found}: expected one sub-folder of images per camera, images "
        f"directly in it, or videos ({' '.join(sorted(known))})"
    )


def find_images(scan: Path) -> dict[str, list[Path]]:
    """Image files of each camera, sorted; hidden files and folders without images are passed by.

    Raises CalibrationError when images lie both in the folder and in sub-folders.
    """
    if scan.is_file():
        return {}

    def images_in(folder: Path) -> list[Path]:
        found = (
            p
            for p in folder.iterdir()
            if p.suffix.lower() in IMAGE_SUFFIXES
            and (p.is_file() or p.is_symlink())  # a broken link is an unreadable image
            and not p.name.startswith(".")
        )
        return sorted(found, key=lambda p: counting_order(p.name))

    folders = sorted(p for p in scan.iterdir() if p.is_dir() and not p.name.startswith("."))
    cameras = {folder.name: images for folder in folders if (images := images_in(folder))}
    flat = images_in(scan)
    if flat and cameras:
        raise CalibrationError(
            f"{scan} holds {len(flat)} images beside {len(cameras)} folders of images "
            f"({', '.join(list(cameras)[:3])}): put every image into its camera's folder"
        )
    for path in [*flat, *(path for paths in cameras.values() for path in paths)]:
        try:
            os.fspath(path.relative_to(scan)).encode()
        except UnicodeEncodeError:
            raise CalibrationError(
                f"{os.fspath(path)!a} has a name that is not UTF-8: rename it or its folder"
            ) from None
    return {LONE_CAMERA: flat} if flat else cameras


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image, or None when it cannot be decoded whole."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # as COLMAP reads it
    image = read_image(path, flags)
    return None if image is None else (image.shape[1], image.shape[0])


def read_image(path: Path, flags: int) -> NDArray[Any] | None:
    """An image as cv2.imdecode gives it, or None when it cannot be decoded whole."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    if not data or not (_whole_png(data) and _whole_jpeg(data)):
        return None  # decoders fill a truncated image with grey
    return cv2.imdecode(np.frombuffer(data, np.uint8), flags)


def _whole_png(data: bytes) -> bool:
    """Whether a PNG's chunks are all there and undamaged; True of any other format."""
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return True
    place = 8
    while place + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[place : place + 8])
        end = place + 8 + length
        if data[end : end + 4] != zlib.crc32(data[place + 4 : end]).to_bytes(4, "big"):
            return False
        if kind == b"IEND":
            return True
        place = end + 4
    return False


def _whole_jpeg(data: bytes) -> bool:
    """Whether a JPEG has its end; True of any other format.

    The end of a thumbnail in the header does not count, and what phones append is passed by.
    """
    if not data.startswith(b"\xff\xd8"):
        return True
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == START_OF_SCAN:
            return data.find(b"\xff\xd9", place) >= 0
        place += 1 if marker == 0xFF else 2 + length  # a lone FF is padding
    return False


def _check_files(
    root: Path, files: dict[str, list[Path]], progress: Progress
) -> tuple[dict[str, list[Path]], tuple[str, ...], dict[str, tuple[int, int]]]:
    warnings = []
    readable: dict[str, list[Path]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for camera, path, size in measured_sizes(files, progress):
        if size is None:
            warnings.append(skipped(root, path))
            continue
        first = sizes.setdefault(camera, size)
        if size != first:
            raise CalibrationError(
                f"camera {camera}: {path.name} is {size[0]}x{size[1]} and "
                f"{readable[camera][0].name} is {first[0]}x{first[1]}; one camera has one "
                "image size: remove the odd images or give them a folder of their own"
            )
        readable.setdefault(camera, []).append(path)
    check_cameras_remain(root, files, readable)
    return readable, tuple(warnings), sizes


def measured_sizes(
    files: dict[str, list[Path]], progress: Progress
) -> Iterator[tuple[str, Path, tuple[int, int] | None]]:
    """Every image's camera, path and (width, height); None where it cannot be decoded whole."""
    total, done = sum(map(len, files.values())), 0
    with ThreadPoolExecutor(max_workers=2) as pool:
        for camera, paths in files.items():
            for path, size in zip(paths, pool.map(image_size, paths), strict=True):
                progress("reading images", done := done + 1, total)
                yield camera, path, size


def skipped(root: Path, path: Path) -> str:
    """The warning of an image that cannot be decoded."""
    return f"{path.relative_to(root)} is unreadable or truncated: skipped"


def check_cameras_remain(
    root: Path, files: dict[str, list[Path]], readable: Mapping[str, object]
) -> None:
    """Raises CalibrationError for a camera that has files, and none of them readable."""
    if not readable:
        total = sum(map(len, files.values()))
        raise CalibrationError(f"none of the {total} images in {root} can be decoded")
    lost = sorted(set(files) - set(readable))
    if lost:
        raise CalibrationError(f"camera {lost[0]}: none of its images can be decoded")


def _number_images(
    root: Path,
    found: dict[str, list[Path]],
    files: dict[str, list[Path]],
    sizes: dict[str, tuple[int, int]],
    matching: Literal["stem", "order"],
    warnings: tuple[str, ...],
) -> Scan:
    named, doubts = name_frames(found, files, matching)
    _check_shared_frames({camera: {stem for stem, _ in named[camera]} for camera in named})
    every = {stem for entries in named.values() for stem, _ in entries}
    frames = tuple(sorted(every, key=counting_order))
    return number_images(root, named, frames, sizes, warnings + doubts)


def name_frames(
    found: dict[str, list[Path]],
    files: dict[str, list[Path]],
    matching: Literal["stem", "order"],
) -> tuple[dict[str, list[tuple[str, Path]]], tuple[str, ...]]:
    """The frame and path of each camera's readable `files`, among all `found`; and warnings.

    Raises CalibrationError when a camera has two images of one frame.
    """
    named = {
        camera: list(zip(_frame_names(found[camera], matching), found[camera], strict=True))
        for camera in files
    }
    readable = {path for paths in files.values() for path in paths}
    named = {
        camera: [(stem, path) for stem, path in entries if path in readable]
        for camera, entries in named.items()
    }
    for camera, entries in named.items():
        stem, count = Counter(stem for stem, _ in entries).most_common(1)[0]
        if count > 1:
            raise CalibrationError(
                f"camera {camera} has {count} images called {stem} (with different endings), "
                "which would be one frame: remove or rename all but one"
            )
    counts = {camera: len(paths) for camera, paths in found.items()}
    if matching == "order" and len(set(counts.values())) > 1:
        listed = ", ".join(f"{camera} {count}" for camera, count in counts.items())
        return named, (
            f"cameras have different numbers of images ({listed}): is their order right?",
        )
    return named, ()


def number_images(
    root: Path,
    named: Mapping[str, list[tuple[str, Path]]],
    frames: tuple[str, ...],
    sizes: Mapping[str, tuple[int, int]],
    warnings: tuple[str, ...],
) -> Scan:
    """A scan of each camera's images, given with the frame each belongs to, one of `frames`."""
    index = {stem: number for number, stem in enumerate(frames)}
    images = tuple(
        ScanImage(number, index[stem], path.relative_to(root).as_posix())
        for number, entries in enumerate(named.values())
        for stem, path in entries
    )
    return Scan(
        root, tuple(named), tuple(sizes[camera] for camera in named), frames, images, warnings
    )


def _frame_names(paths: list[Path], matching: Literal["stem", "order"]) -> list[str]:
    """Names that images of one frame share; an unreadable image keeps its place in the order."""
    if matching == "stem":
        return [path.stem for path in paths]
    return [f"{place:06d}" for place in range(len(paths))]


def counting_order(name: str) -> tuple[list[int | str], str]:
    """A sort key that puts 2 before 10."""
    parts = re.split("([0-9]+)", name)
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], name


def _check_shared_frames(frames: dict[str, set[str]]) -> None:
    """Raises CalibrationError for a camera that never takes an image together with another."""
    for camera, own in frames.items():
        others = set().union(*(f for name, f in frames.items() if name != camera))
        if others and not own & others:
            raise CalibrationError(
                f"camera {camera}: none of its {len(own)} images has the file stem of another "
                f"camera's (it has {min(own)!r}, others {min(others)!r}), so none are one frame: "
                "name images taken together alike, or add --frames order"
            )

"""The scan's layout: folders are cameras, files of the same stem are one frame.

One flat folder is one camera, a video file is one camera too. Every image is decoded once here,
so that a broken file is named before an hour of mapping rather than after.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from sfm_calib import video
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm"}
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
    if not scan.exists():
        raise CalibrationError(f"no such scan: {scan}; give a folder of images or a video file")
    files = find_images(scan)
    root = scan
    if not files:
        videos = video.find_videos(scan)
        if not videos:
            raise CalibrationError(
                f"{scan} holds no images: expected one sub-folder of images per camera, images "
                f"directly in it, or videos ({' '.join(sorted(IMAGE_SUFFIXES | video.SUFFIXES))})"
            )
        inputs = [{name: sha256(path) for name, path in videos.items()}, video_frames]
        root = cache.stage(
            "frames", inputs, lambda place: video.unpack(videos, place, video_frames, progress)
        )
        files = find_images(root)
    readable, warnings, sizes = _check_files(root, files, progress)
    n_images = sum(len(paths) for paths in readable.values())
    if n_images < MIN_IMAGES:
        raise CalibrationError(
            f"{scan} holds {n_images} readable image{'s' * (n_images != 1)}, and a calibration "
            f"needs at least {MIN_IMAGES}: take more views from different places"
        )
    return _number_images(root, readable, sizes, matching, warnings)


def find_images(scan: Path) -> dict[str, list[Path]]:
    """Image files of each camera, sorted; hidden files and folders without images are passed by.

    Raises CalibrationError when images lie both in the folder and in sub-folders.
    """
    if scan.is_file():
        return {}

    def images_in(folder: Path) -> list[Path]:
        return sorted(
            p
            for p in folder.iterdir()
            if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file() and not p.name.startswith(".")
        )

    folders = sorted(p for p in scan.iterdir() if p.is_dir() and not p.name.startswith("."))
    cameras = {folder.name: images for folder in folders if (images := images_in(folder))}
    flat = images_in(scan)
    if flat and cameras:
        raise CalibrationError(
            f"{scan} holds {len(flat)} images beside {len(cameras)} folders of images "
            f"({', '.join(list(cameras)[:3])}): put every image into its camera's folder"
        )
    return {"camera": flat} if flat else cameras


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image, or None when it cannot be decoded whole."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    suffix = path.suffix.lower()
    if suffix == ".png" and b"IEND" not in data[-64:]:
        return None
    if suffix in (".jpg", ".jpeg") and b"\xff\xd9" not in data[-65536:]:
        return None  # decoders fill a truncated JPEG with grey
    if not data:
        return None
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # as COLMAP reads it
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    return None if image is None else (image.shape[1], image.shape[0])


def _check_files(
    root: Path, files: dict[str, list[Path]], progress: Progress
) -> tuple[dict[str, list[Path]], tuple[str, ...], dict[str, tuple[int, int]]]:
    total = sum(map(len, files.values()))
    done, warnings = 0, []
    readable: dict[str, list[Path]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    with ThreadPoolExecutor(max_workers=2) as pool:
        for camera, paths in files.items():
            for path, size in zip(paths, pool.map(image_size, paths), strict=True):
                progress("reading images", done := done + 1, total)
                if size is None:
                    warnings.append(f"{path.relative_to(root)} is unreadable or truncated: skipped")
                    continue
                first = sizes.setdefault(camera, size)
                if size != first:
                    raise CalibrationError(
                        f"camera {camera}: {path.name} is {size[0]}x{size[1]} and "
                        f"{readable[camera][0].name} is {first[0]}x{first[1]}; one camera has one "
                        "image size: remove the odd images or give them a folder of their own"
                    )
                readable.setdefault(camera, []).append(path)
    if not readable:
        raise CalibrationError(f"none of the {total} images in {root} can be decoded")
    lost = sorted(set(files) - set(readable))
    if lost:
        raise CalibrationError(f"camera {lost[0]}: none of its images can be decoded")
    return readable, tuple(warnings), sizes


def _number_images(
    root: Path,
    files: dict[str, list[Path]],
    sizes: dict[str, tuple[int, int]],
    matching: Literal["stem", "order"],
    warnings: tuple[str, ...],
) -> Scan:
    width = len(str(max(map(len, files.values()))))

    def frame_name(place: int, path: Path) -> str:
        return path.stem if matching == "stem" else f"{place:0{width}d}"

    named = {
        camera: [(frame_name(place, path), path) for place, path in enumerate(paths)]
        for camera, paths in files.items()
    }
    for camera, entries in named.items():
        stems = [stem for stem, _ in entries]
        twice = next((stem for stem in stems if stems.count(stem) > 1), None)
        if twice is not None:
            raise CalibrationError(f"camera {camera} has two images called {twice}: rename one")
    frames = tuple(sorted({stem for entries in named.values() for stem, _ in entries}))
    index = {stem: number for number, stem in enumerate(frames)}
    images = tuple(
        ScanImage(number, index[stem], path.relative_to(root).as_posix())
        for number, entries in enumerate(named.values())
        for stem, path in entries
    )
    return Scan(
        root, tuple(named), tuple(sizes[camera] for camera in named), frames, images, warnings
    )

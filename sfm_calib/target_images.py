"""Images of a board for a calibration with targets: folders or videos, a camera each.

Unlike in a scan, cameras may share no frame, one image of a camera can do, and nothing but the
board need move.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Literal

from sfm_calib import images, video
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256
from sfm_calib.images import LONE_CAMERA, MIN_IMAGES, Progress, Scan
from sfm_calib.target_videos import NOTES, unpack_moments
from sfm_calib.timestamps import group_by_time, number_of, read_times, told_of
from sfm_calib.video_sync import read_sync

Matching = Literal["stem", "order", "time"]
# The board is not seen in every frame of a video, so more are taken than will be used.
FRAMES_A_VIEW = 3
Files = dict[str, list[Path]]
Sizes = dict[str, tuple[int, int]]


def read_target(
    folder: Path,
    cache: Cache,
    matching: Matching,
    video_frames: int,
    tolerance_s: float | None,
    progress: Progress,
    least: int = MIN_IMAGES,
) -> Scan:
    """Find and check the images of a board; videos are unpacked into the cache.

    One sub-folder of images per camera, images directly, or videos. Images are one frame by stem,
    by order, or by time (their stems are times, matched to the nearest within `tolerance_s`;
    default: a third of their spacing). Videos are matched by the times beside them, if any, unless
    by order, and else by frame number; at most three times `video_frames` moments are taken.
    What was done is told in the scan's warnings. least: images in all.
    Raises CalibrationError when there are no images, or they cannot be one calibration's.
    """
    if not folder.exists():
        raise CalibrationError(
            f"no such folder: {folder}; give a folder of images of the board, or a video file"
        )
    files = images.find_images(folder)
    if files:
        if tolerance_s is not None and matching != "time":
            raise CalibrationError("--tolerance-s needs --frames time, for stems that are times")
        scan = _from_images(folder, files, matching, tolerance_s, progress)
    else:
        scan = _from_videos(folder, cache, matching, video_frames, tolerance_s, progress)
    if len(scan.images) < least:
        raise CalibrationError(
            f"{folder} holds {len(scan.images)} usable image{'s' * (len(scan.images) != 1)}"
            f"{''.join(f'; {warning}' for warning in scan.warnings)}; a calibration needs at least "
            f"{least}: take more, with the board at other angles"
        )
    return replace(scan, warnings=scan.warnings + _cameras_alone(scan))


def _from_images(
    root: Path, files: Files, matching: Matching, tolerance_s: float | None, progress: Progress
) -> Scan:
    readable, sizes, warnings = _check_files(root, files, progress)
    if matching == "time":
        named, frames, told = _name_by_time(readable, tolerance_s)
    else:
        named, told = images.name_frames(files, readable, matching)
        every = {stem for entries in named.values() for stem, _ in entries}
        frames = tuple(sorted(every, key=images.counting_order))
    return images.number_images(root, named, frames, sizes, warnings + told)


def _check_files(
    root: Path, files: Files, progress: Progress
) -> tuple[Files, Sizes, tuple[str, ...]]:
    """The readable images and the size of each camera, and a warning of every other image."""
    readable: Files = defaultdict(list)
    counts: dict[str, Counter[tuple[int, int]]] = defaultdict(Counter)
    warnings = []
    for camera, path, size in images.measured_sizes(files, progress):
        if size is None:
            warnings.append(images.skipped(root, path))
            continue
        readable[camera].append(path)
        counts[camera][size] += 1
    images.check_cameras_remain(root, files, readable)
    for camera, sizes in counts.items():
        if len(sizes) > 1:
            listed = ", ".join(f"{n} of {w}x{h}" for (w, h), n in sizes.most_common())
            raise CalibrationError(
                f"camera {camera} has images of {len(sizes)} sizes ({listed}); one camera has one "
                "image size: remove the odd images or give them a folder of their own"
            )
    return (
        dict(readable),
        {camera: next(iter(sizes)) for camera, sizes in counts.items()},
        tuple(warnings),
    )


def _name_by_time(
    files: Files, tolerance_s: float | None
) -> tuple[dict[str, list[tuple[str, Path]]], tuple[str, ...], tuple[str, ...]]:
    """Each camera's frames and paths, all frames in order of time, and what to tell."""
    for camera, paths in files.items():
        for path in paths:
            if number_of(path.stem) is None:
                raise CalibrationError(
                    f"camera {camera}: the stem of {path.name} is no number, and images matched by "
                    "time are called by theirs, like 1403636579763555584.png: rename them, or "
                    "match them by stem or order"
                )
    times = read_times({camera: [path.stem for path in paths] for camera, paths in files.items()})
    if len(files) == 1:
        tolerance_s = 0.0  # there is nothing to match
    moments = group_by_time(times.of, tolerance_s, lambda camera, i: files[camera][i].name)
    cameras = list(files)
    frames: list[str] = []
    named: dict[str, list[tuple[str, Path]]] = {camera: [] for camera in cameras}
    for places in moments.images:
        own = [(c, int(place)) for c, place in zip(cameras, places, strict=True) if place >= 0]
        first, place = min(own, key=lambda image: times.of[image[0]][image[1]])
        frames.append(files[first][place].stem)
        for camera, place in own:
            named[camera].append((frames[-1], files[camera][place]))
    told = (told_of(moments, times.unit, "images"),) if len(files) > 1 else ()
    return named, tuple(frames), told


def _from_videos(
    folder: Path,
    cache: Cache,
    matching: Matching,
    video_frames: int,
    tolerance_s: float | None,
    progress: Progress,
) -> Scan:
    videos = video.find_videos(folder)
    if not videos:
        raise CalibrationError(images.nothing_in(folder))
    sync = read_sync(folder, videos, matching, tolerance_s)
    most = FRAMES_A_VIEW * video_frames
    moments = None if sync.moments is None else sync.moments.tolist()
    hashes = {name: sha256(path) for name, path in videos.items()}
    root = cache.stage(
        "target_frames",
        [hashes, most, sync.told, moments, sync.names],
        lambda place: unpack_moments(videos, sync, place, most, progress),
    )
    files = images.find_images(root)
    names = list(videos) if len(videos) > 1 else [LONE_CAMERA]
    told = json.loads((root / NOTES).read_text("utf-8"))
    told += [f"camera {name}: none of its frames was picked" for name in names if name not in files]
    named = {camera: [(path.stem, path) for path in files[camera]] for camera in files}
    every = {stem for entries in named.values() for stem, _ in entries}
    sizes = {}
    for camera, paths in files.items():
        size = images.image_size(paths[0])
        if size is None:
            raise CalibrationError(f"cannot read {paths[0]}: remove {root} and run again")
        sizes[camera] = size
    return images.number_images(
        root, named, tuple(sorted(every, key=images.counting_order)), sizes, tuple(told)
    )


def _cameras_alone(scan: Scan) -> tuple[str, ...]:
    """A warning of the cameras that never take an image together with another."""
    cameras = defaultdict(set)
    for image in scan.images:
        cameras[image.frame].add(image.camera)
    together = {camera for own in cameras.values() if len(own) > 1 for camera in own}
    alone = [name for camera, name in enumerate(scan.cameras) if camera not in together]
    if not alone or len(scan.cameras) == 1:
        return ()
    return (
        f"no frame shared with another camera by {', '.join(alone)}: the lens can be calibrated, "
        "the place in the rig cannot; are images that were taken together matched rightly?",
    )

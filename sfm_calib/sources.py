"""What cameras recorded: images or videos, found in a file or a folder, to be made into others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from sfm_calib import images, video
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.images import Progress

# What OpenCV's wheel writes into a container of each suffix: all keep sizes and frames per second.
# MPEG-1 and 2 know but a few rates (24.5 becomes 24): such videos are written as .mp4.
CODECS = {
    ".mp4": "mp4v", ".m4v": "mp4v", ".mov": "mp4v", ".mkv": "mp4v", ".avi": "MJPG", ".webm": "VP80",
}  # fmt: skip
OTHERWISE = ".mp4"


@dataclass(frozen=True)
class Source:
    """One camera's images, or videos."""

    names: tuple[str, ...]  # what its camera may be called, the likeliest first
    root: Path  # of the whole input; results keep the paths below it
    paths: tuple[Path, ...]
    is_video: bool
    size: tuple[int, int] = (0, 0)  # width, height in px; none until `measured`

    @property
    def name(self) -> str:
        return self.names[0]


def find_sources(given: Path) -> tuple[Source, ...]:
    """The cameras of an image, a video, or a folder of images or videos, as `images.find_images`.

    Raises CalibrationError where there is nothing.
    """
    if not given.exists():
        raise CalibrationError(f"no such input: {given}; give an image, a video or a folder")
    folder = given.resolve().parent.name
    if given.is_file():
        if given.suffix.lower() in images.IMAGE_SUFFIXES:
            return (Source((folder,), given.parent, (given,), False),)
        if given.suffix.lower() in video.SUFFIXES:
            return (Source((given.stem, folder), given.parent, (given,), True),)
        known = " ".join(sorted(images.IMAGE_SUFFIXES | video.SUFFIXES))
        raise CalibrationError(f"{given} is no image and no video: known are {known}")
    found = images.find_images(given)
    if list(found) == [images.LONE_CAMERA]:
        names = (given.resolve().name, images.LONE_CAMERA)
        return (Source(names, given, tuple(found[images.LONE_CAMERA]), False),)
    if found:
        return tuple(Source((name,), given, tuple(paths), False) for name, paths in found.items())
    videos = video.find_videos(given)
    if not videos:
        raise CalibrationError(images.nothing_in(given))
    return tuple(Source((name,), given, (path,), True) for name, path in videos.items())


def measured(
    sources: Sequence[Source], progress: Progress
) -> tuple[tuple[Source, ...], tuple[str, ...]]:
    """The sources with their sizes, without images that cannot be decoded, and what to tell.

    Raises CalibrationError where nothing of a source can be decoded, or where its sizes differ.
    """
    told: list[str] = []
    files = {str(i): list(s.paths) for i, s in enumerate(sources) if not s.is_video}
    sizes: list[dict[Path, tuple[int, int]]] = [{} for _ in sources]
    for key, path, size in images.measured_sizes(files, progress):
        if size is None:
            told.append(images.skipped(sources[int(key)].root, path))
        else:
            sizes[int(key)][path] = size
    for own, source in zip(sizes, sources, strict=True):
        if source.is_video:
            own.update((path, video_size(path)) for path in source.paths)
    return tuple(_of_one_size(s, own) for s, own in zip(sources, sizes, strict=True)), tuple(told)


def _of_one_size(source: Source, sizes: dict[Path, tuple[int, int]]) -> Source:
    if not sizes:
        raise CalibrationError(f"{source.name}: none of its images can be decoded")
    first, size = next(iter(sizes.items()))
    for path, other in sizes.items():
        if other != size:
            raise CalibrationError(
                f"{source.name}: {path.name} is {other[0]} x {other[1]} px and {first.name} "
                f"{size[0]} x {size[1]}: a calibration holds for one size; take the others away"
            )
    return replace(source, paths=tuple(sizes), size=size)


def video_size(path: Path) -> tuple[int, int]:
    """Width and height of a video's frames. Raises CalibrationError when it cannot be decoded."""
    capture = cv2.VideoCapture(str(path))
    ok, frame = capture.read()
    capture.release()
    if not ok:
        raise CalibrationError(f"{path} is damaged, or in a format OpenCV cannot decode")
    return frame.shape[1], frame.shape[0]


def match(
    sources: Sequence[Source], cameras: Sequence[str], chosen: str | None
) -> tuple[tuple[str, Source], ...]:
    """The calibration's camera of each source: the one that is chosen, the only one, or by name.

    Raises CalibrationError where that does not tell.
    """
    if chosen is not None:
        if chosen not in cameras:
            raise CalibrationError(
                f"--camera {chosen}: no such camera in the calibration: {nearest(chosen, cameras)}"
            )
        return tuple((chosen, source) for source in sources)
    if len(sources) == 1 == len(cameras):
        return ((cameras[0], sources[0]),)
    pairs = []
    for source in sources:
        known = [name for name in source.names if name in cameras]
        if not known:
            raise CalibrationError(
                f"{source.name} is no camera of the calibration ({', '.join(cameras)}): say which "
                "one with --camera, or rename"
                + (" the folder; one at a time" if len(sources) > 1 else " it")
            )
        pairs.append((known[0], source))
    return tuple(pairs)


def targets(
    sources: Sequence[Source], out: Path, others: Sequence[Path], taken: Sequence[Path],
    overwrite: bool,
) -> dict[Path, Path]:  # fmt: skip
    """Where in OUT the result of each file goes; `others` are written too.

    Raises CalibrationError where OUT is the input or inside of it, where a file of the input or
    one of `taken` would be lost, and where a file is there already.
    """
    into = out.resolve()
    if out.suffix.lower() in images.IMAGE_SUFFIXES | video.SUFFIXES:
        raise CalibrationError(f"-o {out}: OUT is a folder; results keep the names of their files")
    found: dict[Path, Path] = {}
    for source in sources:
        if into == source.root.resolve() or (
            len(sources) > 1 and into.is_relative_to(source.root.resolve())
        ):
            raise CalibrationError(
                f"{out} is the input's own folder, or in it: choose another with -o"
            )
        for path in source.paths:
            target = out / path.relative_to(source.root)
            if source.is_video and path.suffix.lower() not in CODECS:
                target = target.with_suffix(OTHERWISE)
            found[path] = target
    written = [*found.values(), *others]
    read = {path.resolve() for path in [*found, *taken]}
    for target in written:
        if target.resolve() in read or written.count(target) > 1:
            raise CalibrationError(f"{target} would be written over: choose another OUT with -o")
        if target.exists() and not overwrite:
            raise CalibrationError(
                f"{target} is there already: choose another OUT with -o, or --overwrite"
            )
    return found

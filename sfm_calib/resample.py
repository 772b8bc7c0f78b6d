"""Images and videos as another camera in the same place would have taken them."""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera, focal_on_axis
from graphs.virtual import Turned, pixel_maps, resized, within
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically
from sfm_calib.images import Progress, read_image
from sfm_calib.sources import CODECS, Source

Interpolation = Literal["linear", "cubic", "lanczos"]
# Corners of a rendered board, of 0.5 to 1 px blur, move by 0.012 to 0.015 px with linear, 0.011 to
# 0.019 px with cubic and 0.003 to 0.011 px with lanczos; linear blurs, lanczos takes 4 x as long.
FLAGS: dict[Interpolation, int] = {
    "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4,
}  # fmt: skip
JPEG_QUALITY = 95
MOST_FINER = 8  # of a thumbnail: beyond, what is averaged is grey anyway
USUAL_RATE = 30.0  # frames a second, of a video that states none
Pixels = NDArray[Any]


@dataclass(frozen=True)
class Resampling:
    """How the images of one camera become those of a virtual one."""

    maps: NDArray[np.float32]  # (2, rows, columns): x and y in the input, as `pixel_maps`
    unseen: NDArray[np.bool_]  # (rows, columns): outside the input
    size: tuple[int, int]  # of the output
    interpolation: Interpolation

    @property
    def black(self) -> float:
        """The share of the output that shows nothing."""
        return float(self.unseen.mean())

    def __call__(self, image: Pixels) -> Pixels:
        """An image (h, w) or (h, w, channels) of 8 or 16 bit or float; black outside."""
        found = cv2.remap(
            image, self.maps[0], self.maps[1], FLAGS[self.interpolation],
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        found[self.unseen] = 0
        if found.shape[1::-1] != self.size:
            found = cv2.resize(found, self.size, interpolation=cv2.INTER_AREA)
        return np.asarray(found)


def resampling(virtual: Camera, view: Turned, interpolation: Interpolation) -> Resampling:
    """Where the output is coarser than the input it is made finer first, then averaged."""
    coarser = float((focal_on_axis(view.camera) / virtual.params[:2]).min())
    finer = int(np.clip(round(coarser), 1, MOST_FINER))
    size = virtual.size[0] * finer, virtual.size[1] * finer
    maps = pixel_maps(resized(virtual, virtual.params[:2], size), view)
    unseen = ~within(np.moveaxis(maps, 0, -1), view.camera.size)
    return Resampling(maps, unseen, virtual.size, interpolation)


def resample(
    source: Source, by: Resampling, targets: dict[Path, Path], stage: str, progress: Progress
) -> None:
    """Write every image or video of a source to its target, whole or not at all.

    Raises CalibrationError where one cannot be read or written.
    """
    if source.is_video:
        for path in source.paths:
            resample_video(path, by, targets[path], stage, progress)
        return

    def one(path: Path) -> None:
        image = read_image(path, cv2.IMREAD_UNCHANGED)  # depth, alpha; no EXIF orientation
        if image is None:
            raise CalibrationError(f"{path} cannot be read any more")
        write_atomically(targets[path], encoded(by(image), targets[path]))

    with ThreadPoolExecutor(max_workers=2) as pool:
        for done, _ in enumerate(pool.map(one, source.paths), 1):
            progress(stage, done, len(source.paths))


def encoded(image: Pixels, path: Path) -> bytes:
    """An image as a file of the path's suffix. Raises CalibrationError where that cannot be."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    try:
        ok, data = cv2.imencode(path.suffix, image, quality if "jp" in path.suffix.lower() else [])
    except cv2.error as error:
        ok, data = False, np.zeros(0, np.uint8)
        said = f": {error.err}"
    else:
        said = ""
    if not ok:
        raise CalibrationError(f"cannot write {path} ({image.dtype}, {image.shape}){said}")
    return data.tobytes()


def maps_file(virtual: Camera, view: Turned) -> bytes:
    """A .npz with map_x and map_y (height, width) float32, as cv2.remap takes them."""
    maps = pixel_maps(virtual, view)
    file = io.BytesIO()
    np.savez_compressed(file, map_x=maps[0], map_y=maps[1])
    return file.getvalue()


def frames_of(path: Path) -> Iterator[Pixels]:
    """Every frame of a video."""
    capture = cv2.VideoCapture(str(path))
    try:
        while True:
            ok, frame = capture.read()
            if not ok:
                return
            yield frame
    finally:
        capture.release()


def resample_video(
    path: Path, by: Callable[[Pixels], Pixels], target: Path, stage: str, progress: Progress
) -> None:
    """Write a video of as many frames a second, under another name until it is whole."""
    capture = cv2.VideoCapture(str(path))
    rate, total = capture.get(cv2.CAP_PROP_FPS), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    rate = rate if 0 < rate < np.inf else USUAL_RATE
    target.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=".", suffix=target.suffix)
    os.close(descriptor)
    writer, done = None, 0
    try:
        for done, frame in enumerate(frames_of(path), 1):
            image = by(frame)
            writer = writer or _writer(Path(name), target, rate, image)
            writer.write(image)
            progress(stage, done, max(total, done))
        if writer is not None:
            writer.release()
        written = cv2.VideoCapture(name)
        kept = int(written.get(cv2.CAP_PROP_FRAME_COUNT))
        written.release()
        if not 0 < kept == done:  # OpenCV does not say that the disk is full
            raise CalibrationError(
                f"cannot write {target}: {kept} of {done} frames arrived; is the disk full?"
            )
        os.chmod(name, 0o644)
        os.replace(name, target)
    finally:
        Path(name).unlink(missing_ok=True)


def _writer(temporary: Path, target: Path, rate: float, image: Pixels) -> cv2.VideoWriter:
    codec = CODECS[target.suffix.lower()]
    fourcc = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(temporary), fourcc, rate, image.shape[1::-1])
    if not writer.isOpened():
        raise CalibrationError(
            f"cannot write {target}: OpenCV has no {codec} encoder for {image.shape[1]} x "
            f"{image.shape[0]} px; give another --size, or unpack the video into images"
        )
    return writer

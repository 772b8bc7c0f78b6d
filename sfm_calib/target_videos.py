"""Frames of a board from videos: moments spread over the time in which anything moves.

Here a board may move before cameras that stand still, so any change counts, however small the part
of the image; it is summed up over frames, so that slow motion counts too.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from sfm_calib.timestamps import IntArray
from sfm_calib.video import (
    ANALYSIS_WIDTH,
    GrayImage,
    check_decoded,
    sharpest_of_stretches,
    write_image,
)
from sfm_calib.video_sync import Sync

NOTES = "notes.json"  # beside the frames: what there was to tell when they were picked
# Video compression and grain, averaged over the pixels of a reduced image, stay below so many grey
# levels; a white square that leaves a black one moves by ten times as much.
CHANGED_LEVELS = 10
CHANGED_SHARE = 0.001  # of the image: a far board of 1 % of it that moves by a tenth of its size
STILL_LEVELS = 0.2  # the mean change of a view that stands still: grain and compression
RATES_DIFFER = 1.02  # frame numbers drift apart by a frame in 50
AT_ONCE = 32  # frames between two looks at progress
Progress = Callable[[str, int, int], None]
FloatArray = NDArray[np.float64]


@dataclass
class Track:
    """What was seen of each frame of one video, as it is decoded."""

    changed: list[bool] = field(default_factory=list)  # since the last frame that was
    step: list[float] = field(default_factory=list)  # mean change since the frame before, levels
    detail: list[float] = field(default_factory=list)  # log of the Laplacian's variance
    per_second: float = 0.0
    expected: int = 0


def unpack_moments(
    videos: Mapping[str, Path], sync: Sync, out: Path, most: int, progress: Progress
) -> None:
    """Write at most `most` moments as OUT/<camera>/<moment>.png, or OUT/... of a lone video, in
    grey levels: boards need no colour. OUT/notes.json is a list of lines to tell.

    Raises CalibrationError when a video cannot be decoded, or its times do not fit.
    """
    tracks = {camera: Track() for camera in videos}
    _side_by_side(
        [_watch(path, tracks[camera]) for camera, path in videos.items()],
        lambda done: progress(
            "scanning videos", done, max(done, sum(track.expected for track in tracks.values()))
        ),
    )
    counts = {camera: len(track.changed) for camera, track in tracks.items()}
    for camera, path in videos.items():
        check_decoded(path, counts[camera])
    frames = sync.frames(counts)
    picked = pick_moments(frames, list(tracks.values()), most)
    writers = []
    for column, (camera, path) in enumerate(videos.items()):
        folder = out / camera if len(videos) > 1 else out
        folder.mkdir(parents=True, exist_ok=True)
        own = {int(frames[m, column]): folder / f"{sync.name(m)}.png" for m in picked}
        own.pop(-1, None)
        writers.append(_write(path, own))
    total = sum(int(frames[picked, column].max()) + 1 for column in range(len(videos)))
    _side_by_side(writers, lambda done: progress("unpacking videos", done, total))
    (out / NOTES).write_text(json.dumps(_notes(sync, tracks, len(picked), len(frames))), "utf-8")


def pick_moments(frames: IntArray, tracks: list[Track], most: int) -> list[int]:
    """Moments, given the frames (n_moments, n_cameras) or -1 of each: those in which anything has
    changed are cut into equal stretches, and of each the sharpest and stillest is taken.

    What stands still between two changes belongs to the first, so a board that is held is taken
    while it is. Moments that more cameras have come first.
    """
    seen = frames >= 0

    def at_moments(values: list[FloatArray]) -> FloatArray:
        return np.array(
            [own[column] for own, column in zip(values, frames.T, strict=True)]
        ).T * np.where(seen, 1.0, 0.0)

    changed = at_moments([np.array(track.changed, float) for track in tracks]).any(axis=1)
    # Held on both sides: a frame like the one before may be the last before a jerk.
    steps = [np.array([*track.step, 0.0]) for track in tracks]
    speed = at_moments([np.maximum(own[:-1], own[1:]) for own in steps]).sum(axis=1)
    # Beside the camera's usual detail: scenes differ more than the blur of a board.
    detail = at_moments([np.array(t.detail) - np.median(t.detail) for t in tracks]).sum(axis=1)
    # Blur is as long as the way during the exposure, so half the speed is worth half the blur.
    ranks = rankdata(detail - np.log(speed + STILL_LEVELS)) / (len(frames) + 1)
    n_changes = int(changed.sum())
    travelled = (np.cumsum(changed) + 0.5) / (n_changes + 1)
    return sharpest_of_stretches(travelled, seen.sum(axis=1) + ranks, min(most, n_changes + 1))


def _watch(path: Path, track: Track) -> Iterator[None]:
    """Fill the track, one frame a step."""
    capture = cv2.VideoCapture(str(path))
    track.expected = int(max(capture.get(cv2.CAP_PROP_FRAME_COUNT), 0))
    track.per_second = float(capture.get(cv2.CAP_PROP_FPS))
    before: GrayImage | None = None  # the frame before
    last: GrayImage | None = None  # the last frame that had changed
    size: tuple[int, int] | None = None
    while True:
        ok, frame = capture.read()
        if not ok:
            break
        size = size or (ANALYSIS_WIDTH, round(frame.shape[0] * ANALYSIS_WIDTH / frame.shape[1]))
        small = cv2.resize(_gray(frame), size, interpolation=cv2.INTER_AREA)
        track.detail.append(float(np.log(max(cv2.Laplacian(small, cv2.CV_64F).var(), 1e-6))))
        halved = (size[0] // 2, max(size[1] // 2, 1))
        now = np.asarray(cv2.resize(small, halved, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        before, last = (now if before is None else before), (now if last is None else last)
        track.step.append(float(cv2.absdiff(now, before).mean()))
        share = np.count_nonzero(cv2.absdiff(now, last) > CHANGED_LEVELS) / now.size
        track.changed.append(bool(share >= CHANGED_SHARE))
        before, last = now, (now if track.changed[-1] else last)
        yield
    capture.release()


def _gray(frame: NDArray[np.uint8]) -> GrayImage:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _write(path: Path, files: Mapping[int, Path]) -> Iterator[None]:
    """Write the frames of these numbers to these files, one frame of the video a step.

    Frames are not sought but passed by without being converted: seeking is not exact to the frame
    in every format, and one frame off is another moment.
    """
    capture = cv2.VideoCapture(str(path))
    for number in range(max(files, default=-1) + 1):
        if not capture.grab():
            break
        if number in files:
            _, frame = capture.retrieve()
            write_image(files[number], _gray(frame))
        yield
    capture.release()


def _side_by_side(walks: Iterable[Iterator[None]], progress: Callable[[int], None]) -> None:
    """Walk several videos to their ends on both cores; `progress` is called between, from here."""
    going, done = list(walks), 0
    with ThreadPoolExecutor(max_workers=2) as pool:
        while going:
            steps = list(pool.map(lambda walk: sum(1 for _ in islice(walk, AT_ONCE)), going))
            done += sum(steps)
            progress(done)
            going = [walk for walk, n in zip(going, steps, strict=True) if n == AT_ONCE]


def _notes(sync: Sync, tracks: Mapping[str, Track], n_picked: int, n_moments: int) -> list[str]:
    """What to tell the user of how the videos were taken together."""
    told = []
    counts = {camera: len(track.changed) for camera, track in tracks.items()}
    rates = {c: track.per_second for c, track in tracks.items() if track.per_second > 0}
    if sync.told and sync.moments is None:
        if rates and max(rates.values()) > RATES_DIFFER * min(rates.values()):
            listed = ", ".join(f"{camera} {rate:.4g}" for camera, rate in rates.items())
            told.append(
                f"the videos have different frames per second ({listed}), so frame numbers do not "
                "tell what was taken together: give the times of their frames"
            )
        elif len(set(counts.values())) > 1:
            listed = ", ".join(f"{camera} {count}" for camera, count in counts.items())
            told.append(
                f"the videos have different numbers of frames ({listed}): did they start together?"
            )
    if sync.told:
        told.insert(0, sync.told)
    told.append(f"{n_picked} of {n_moments} moments of the video{'s' * (len(tracks) > 1)} picked")
    return told

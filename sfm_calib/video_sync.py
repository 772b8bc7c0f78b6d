"""Which frames of several videos were taken together: by frame number, or by times in files."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from sfm_calib.errors import CalibrationError
from sfm_calib.files import read_text
from sfm_calib.timestamps import IntArray, group_by_time, number_of, read_times, told_of

SYNC_FILE = "timestamps.csv"  # as caliscope writes it
COLUMNS = ("sync_index", "cam_id", "frame_time")
TIME_SUFFIXES = (".csv", ".txt")  # of a file beside a video, with the time of each of its frames
Row = tuple[float, int]  # frame_time in s, sync_index


@dataclass(frozen=True)
class Sync:
    """What files say of the videos' frames, before any is decoded."""

    told: str  # to the user; empty for a lone video
    moments: IntArray | None = None  # (n_moments, n_cameras): frame or -1; None: frame by frame
    names: tuple[str, ...] = ()  # of the moments, in order of time
    times: Mapping[str, tuple[str, int]] | None = None  # each camera's file, and times in it

    def frames(self, counts: Mapping[str, int]) -> IntArray:
        """Frame numbers (n_moments, n_cameras) or -1, given how many frames each video has.

        Raises CalibrationError when the files have another number of times.
        """
        for camera, (file, n_times) in (self.times or {}).items():
            if counts[camera] != n_times:
                raise CalibrationError(
                    f"{file} has {n_times} times of {camera} and its video has {counts[camera]} "
                    "frames: put the file of this very recording there, or remove it and match "
                    "by frame number"
                )
        if self.moments is not None:
            return self.moments
        number = np.arange(max(counts.values()))[:, None]
        return np.where(number < np.array(list(counts.values())), number, -1)

    def name(self, moment: int) -> str:
        """What the images of a moment are called; names sort as the moments do."""
        return self.names[moment] if self.names else f"{moment:06d}"


def read_sync(
    folder: Path,
    videos: Mapping[str, Path],
    matching: Literal["stem", "order", "time"],
    tolerance_s: float | None,
) -> Sync:
    """What the files beside the videos say: `timestamps.csv` in the folder, or `<video>.csv` or
    `.txt` beside each, one time a line. Without any, or by order, frame numbers count.

    Raises CalibrationError when they cannot be read or do not fit the videos.
    """
    if len(videos) == 1:
        return Sync("")
    if matching != "order":
        if (folder / SYNC_FILE).is_file():
            return _from_sync_file(folder / SYNC_FILE, videos)
        files = _time_files(videos)
        if files:
            return _from_times(files, tolerance_s)
    if matching == "time":
        raise CalibrationError(
            f"no times beside the {len(videos)} videos in {folder}: put {SYNC_FILE} there, or a "
            "<video>.csv with one time a line beside each"
        )
    return Sync("videos matched by frame number, as started together")


# ---- timestamps.csv ----------------------------------------------------------------------------


def _from_sync_file(path: Path, videos: Mapping[str, Path]) -> Sync:
    rows = _rows(path)
    of_camera: dict[str, list[Row]] = {}
    for cam_id, own in rows.items():
        for camera, video in videos.items():
            if {camera, video.stem} & {cam_id, f"cam_{cam_id}"}:
                of_camera[camera] = sorted(own, key=lambda row: row[0])
    missing = [camera for camera in videos if camera not in of_camera]
    if missing:
        raise CalibrationError(
            f"{path} has no times of {missing[0]} (its cam_id are {', '.join(sorted(rows))}): "
            "call the videos cam_<cam_id>, or remove the video"
        )
    every = sorted({index for own in of_camera.values() for _, index in own})
    row_of = {index: number for number, index in enumerate(every)}
    moments = np.full((len(every), len(videos)), -1, np.int64)
    seconds = np.full(moments.shape, np.nan)
    for column, camera in enumerate(videos):
        for frame, (time, index) in enumerate(of_camera[camera]):
            if moments[row_of[index], column] >= 0:
                raise CalibrationError(
                    f"{path} has two times of {camera} with sync_index {index}: export it again, "
                    "or remove it and match by frame number"
                )
            moments[row_of[index], column], seconds[row_of[index], column] = frame, time
    widest = float((np.nanmax(seconds, axis=1) - np.nanmin(seconds, axis=1)).max())
    ignored = len(rows) - len(of_camera)
    return Sync(
        f"videos matched by the sync_index of {path.name}: {len(every)} moments, their times up "
        f"to {widest * 1e3:.3g} ms apart"
        + (f"; {ignored} of its cam_id have no video" * (ignored > 0)),
        moments,
        tuple(f"{index:06d}" for index in every),
        {camera: (path.name, len(of_camera[camera])) for camera in videos},
    )


def _rows(path: Path) -> dict[str, list[Row]]:
    """The times and sync indices of each cam_id, in the order of the file."""
    reader = csv.DictReader(_lines(path))
    absent = [column for column in COLUMNS if column not in (reader.fieldnames or ())]
    if absent:
        raise CalibrationError(
            f"{path} has no column {absent[0]}: it needs {', '.join(COLUMNS)}, as caliscope writes "
            "it; otherwise call it something else"
        )
    rows: dict[str, list[Row]] = defaultdict(list)
    for row in reader:
        index, cam_id, time = ((row[column] or "").strip() for column in COLUMNS)
        if not (index.isascii() and index.isdigit()) or number_of(time) is None:
            raise CalibrationError(
                f"{path} line {reader.line_num}: sync_index {index!r} and frame_time {time!r} must "
                "be numbers; export it again"
            )
        rows[cam_id].append((float(time), int(index)))
    return dict(rows)


# ---- a time a frame ----------------------------------------------------------------------------


def _time_files(videos: Mapping[str, Path]) -> dict[str, Path]:
    """The file of times beside each video; none where no video has one."""
    found: dict[str, Path] = {}
    for camera, video in videos.items():
        own = [f for s in TIME_SUFFIXES if (f := video.with_suffix(s)).is_file()]
        if len(own) > 1:
            raise CalibrationError(
                f"{own[0].name} and {own[1].name} may both hold the times of {video.name}: remove "
                "or rename one"
            )
        if own:
            found[camera] = own[0]
    missing = [video for camera, video in videos.items() if camera not in found]
    if found and missing:
        raise CalibrationError(
            f"{next(iter(found.values())).name} holds times and {missing[0].name} has none beside "
            "it: add them, or remove the others and match by frame number"
        )
    return found


def _from_times(files: Mapping[str, Path], tolerance_s: float | None) -> Sync:
    texts = {camera: _times_in(path) for camera, path in files.items()}
    times = read_times(texts)
    for camera, own in times.of.items():
        back = np.flatnonzero(np.diff(own) <= 0)
        if back.size:
            before, after = texts[camera][back[0]], texts[camera][back[0] + 1]
            raise CalibrationError(
                f"{files[camera]}: {after} follows {before}, and the times of frames rise: put "
                "them in order"
            )
    moments = group_by_time(times.of, tolerance_s, lambda _, frame: f"frame {frame}")
    digits = max(6, len(str(len(moments.images))))
    return Sync(
        told_of(moments, times.unit, "video frames"),
        moments.images,
        tuple(f"{number:0{digits}d}" for number in range(len(moments.images))),
        {camera: (files[camera].name, len(texts[camera])) for camera in files},
    )


def _times_in(path: Path) -> list[str]:
    """Its lines that hold a time; empty ones, comments and a heading are passed by."""
    lines = [line.strip() for line in _lines(path)]
    if lines and number_of(lines[0]) is None and not any(c.isdigit() for c in lines[0]):
        lines[0] = ""
    times = []
    for number, line in enumerate(lines, 1):
        if not line or line.startswith("#"):
            continue
        if number_of(line) is None:
            raise CalibrationError(
                f"{path} line {number}: {line[:40]!r} is no time; write one number a line"
            )
        times.append(line)
    if not times:
        raise CalibrationError(f"{path} holds no times: write one a frame, each on its line")
    return times


def _lines(path: Path) -> list[str]:
    return read_text(path, "write one time a line", "utf-8-sig").splitlines()

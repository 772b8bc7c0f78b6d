"""Videos as scans: frames picked where the camera has moved, and the sharpest of each stretch."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_calib.errors import CalibrationError

SUFFIXES = {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"}
ANALYSIS_WIDTH = 320  # px; motion and sharpness need no more
# A tenth of the width between picked frames keeps nine tenths in common for matching.
MOTION_STEP = 0.08  # of the image width
LEAST_MOTION = 3 * MOTION_STEP  # three views are the fewest that determine a focal length
FEWEST_FRAMES = 3  # fewer are no video
GrayImage = NDArray[np.uint8]


def find_videos(scan: Path) -> dict[str, Path]:
    """Video files by camera name: the file itself, or every video in the folder by its stem, or
    the one video in each sub-folder by the folder's name.

    Raises CalibrationError when two would have the same name.
    """
    if scan.is_file():
        return {scan.stem: scan} if scan.suffix.lower() in SUFFIXES else {}
    named = [(path.stem, path) for path in _videos_in(scan)]
    if not named:
        folders = sorted(p for p in scan.iterdir() if p.is_dir() and not p.name.startswith("."))
        named = [(folder.name, path) for folder in folders for path in _videos_in(folder)]
    videos: dict[str, Path] = {}
    for name, path in named:
        if name in videos:
            raise CalibrationError(
                f"{videos[name].name} and {path.name} would both be the camera {name}: rename or "
                "remove one"
            )
        videos[name] = path
    return videos


def _videos_in(folder: Path) -> list[Path]:
    return sorted(
        p
        for p in folder.iterdir()
        if p.suffix.lower() in SUFFIXES and p.is_file() and not p.name.startswith(".")
    )


def unpack(
    videos: dict[str, Path],
    out: Path,
    max_frames: int,
    progress: Callable[[str, int, int], None],
) -> None:
    """Write the picked frames as OUT/<camera>/<frame number>.png, or OUT/... of a lone video.

    Videos of one folder are taken as started together: the same frame numbers of each are used.
    Raises CalibrationError when a video cannot be decoded, or nothing moves in it.
    """
    tracks = {name: _analyse(path, progress) for name, path in videos.items()}
    length = min(len(motion) for motion, _ in tracks.values())
    motion = np.max([motion[:length] for motion, _ in tracks.values()], axis=0)
    if motion.sum() < LEAST_MOTION:
        raise CalibrationError(
            f"{', '.join(path.name for path in videos.values())}: the view moves by "
            f"{motion.sum():.1%} of the image width in {length} frames (needs {LEAST_MOTION:.0%}); "
            "a calibration needs views from different places: move the camera while it films"
        )
    sharpness = np.min([_ranks(sharp[:length]) for _, sharp in tracks.values()], axis=0)
    picked = pick_frames(motion, sharpness, max_frames)
    for name, path in videos.items():
        folder = out / name if len(videos) > 1 else out
        folder.mkdir(parents=True, exist_ok=True)
        _write_frames(path, set(picked), folder, progress)


def pick_frames(
    motion: NDArray[np.float64], sharpness: NDArray[np.float64], max_frames: int
) -> list[int]:
    """Indices of frames: the path of motion (n,) in image widths is cut into equal stretches,
    and the sharpest frame (n,) of each is taken."""
    travelled = np.cumsum(motion)
    n_stretches = int(np.clip(np.ceil(travelled[-1] / MOTION_STEP), 3, max_frames))
    return sharpest_of_stretches(travelled / max(travelled[-1], 1e-9), sharpness, n_stretches)


def sharpest_of_stretches(
    travelled: NDArray[np.float64], sharpness: NDArray[np.float64], n_stretches: int
) -> list[int]:
    """The sharpest (n,) of each of equal stretches of a path (n,), given as shares of its whole."""
    stretch = np.minimum((travelled * n_stretches).astype(int), n_stretches - 1)
    return [
        int(members[sharpness[members].argmax()])
        for number in range(n_stretches)
        if (members := np.flatnonzero(stretch == number)).size
    ]


def _analyse(
    path: Path, progress: Callable[[str, int, int], None]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Motion since the frame before, in image widths, and sharpness, of every frame."""
    capture = cv2.VideoCapture(str(path))
    total = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    motion, sharpness = [], []
    previous: GrayImage | None = None
    while True:
        ok, frame = capture.read()
        if not ok:
            break
        small = _small_gray(frame)
        motion.append(0.0 if previous is None else _median_motion(previous, small))
        sharpness.append(float(cv2.Laplacian(small, cv2.CV_64F).var()))
        previous = small
        progress(f"scanning {path.name}", len(motion), max(total, len(motion)))
    capture.release()
    check_decoded(path, len(motion))
    return np.array(motion), np.array(sharpness)


def check_decoded(path: Path, n_frames: int) -> None:
    """Raises CalibrationError when a video gave next to nothing."""
    if n_frames < FEWEST_FRAMES:
        raise CalibrationError(
            f"{path} gave {n_frames} frames: it is damaged, or in a format OpenCV cannot decode"
        )


def _small_gray(frame: NDArray[np.uint8]) -> GrayImage:
    height = round(frame.shape[0] * ANALYSIS_WIDTH / frame.shape[1])
    small = cv2.resize(frame, (ANALYSIS_WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _median_motion(previous: GrayImage, current: GrayImage) -> float:
    corners = cv2.goodFeaturesToTrack(previous, 200, 0.01, 8)
    if corners is None or len(corners) < 8:
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(previous, current, corners, None)
    steps = np.linalg.norm((moved - corners).reshape(-1, 2), axis=1)[found.ravel() == 1]
    return float(np.median(steps)) / previous.shape[1] if steps.size else 0.0


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.argsort(np.argsort(values)) / max(len(values) - 1, 1)


def _write_frames(
    path: Path, picked: set[int], folder: Path, progress: Callable[[str, int, int], None]
) -> None:
    capture = cv2.VideoCapture(str(path))
    last = max(picked)
    for number in range(last + 1):
        ok, frame = capture.read()
        if not ok:
            break
        progress(f"unpacking {path.name}", number + 1, last + 1)
        if number not in picked:
            continue
        write_image(folder / f"{number:06d}.png", frame)
    capture.release()


def write_image(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write an image; raises OSError when it cannot be written."""
    if not cv2.imwrite(str(path), pixels):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # OpenCV does not say why

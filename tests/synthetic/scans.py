"""Small scans on disk: pictures, videos, and one simulated rig that maps in seconds."""

import atexit
import functools
import shutil
import tempfile
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
QUICK = ["--max-features", "250"]  # enough for 320 x 240 px


def silent(stage, done, total):
    """Progress that nobody watches."""


def picture(path, size=(32, 24), seed=0):
    """A picture of noise, which no other picture matches."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = () if path.suffix == ".pgm" else (3,)
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], *channels), np.uint8)
    assert cv2.imwrite(str(path), pixels)
    return path


def blank(path, size=(320, 240)):
    """A picture without a single feature."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((size[1], size[0]), 128, np.uint8))


def panning_frames(n, step=8, size=(320, 240), seed=0):
    """Views of a wide texture, each `step` px to the right of the one before."""
    rng = np.random.default_rng(seed)
    wide = rng.integers(0, 255, (size[1], size[0] + n * step), np.uint8)
    wide = cv2.GaussianBlur(wide, (0, 0), 2)
    wide = cv2.normalize(wide, None, 0, 255, cv2.NORM_MINMAX)
    views = [wide[:, i * step : i * step + size[0]] for i in range(n)]
    return [cv2.cvtColor(view, cv2.COLOR_GRAY2BGR) for view in views]


def video(path, frames):
    """Write frames as motion JPEG, which every OpenCV can decode."""
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


@functools.cache
def simulation():
    """OUT of a simulated two-camera scan of 8 frames: scan/ and truth.json. Read only."""
    pytest.importorskip("open3d", reason="the simulator needs open3d (the extra `depth`)")
    from sfm_calib.simulate.scan import SimulateOptions, simulate_scan

    out = Path(tempfile.mkdtemp(prefix="sfm_calib_test."))
    atexit.register(shutil.rmtree, out, ignore_errors=True)
    options = SimulateOptions(rig="stereo", frames=8, size=(320, 240), supersampling=1, noise=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numba's, of an old TBB on this machine
        simulate_scan(options, out, silent, overwrite=True)
    return out

"""All patches of a problem matched, batch by batch, out of its images."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from graphs.frames import FloatArray
from graphs.problem import Estimate, IntArray, Observations
from graphs.threads import thread_count
from sfm_calib.images import Progress
from sfm_calib.patches.alignment import Aligned, align
from sfm_calib.patches.crops import Images, cut_out, has_place
from sfm_calib.patches.warps import warps_of
from sfm_calib.torch_import import Device, import_torch

# Observations at once. Each takes 40 kB: on a CPU 40 MB a thread, on a GPU a gigabyte.
A_BATCH = {"cpu": 1000, "cuda": 25_000}
GPU_THREADS = 2  # one cuts out what the other does not yet match


@dataclass(frozen=True)
class Sights:
    """What is matched, and in which images."""

    estimate: Estimate
    seen: Observations
    middle: FloatArray  # (n_obs, 2) px, where each patch starts
    normal: FloatArray  # (n_points, 3) of the surfaces; NaN: not known
    image: IntArray  # (n_obs,) number of each observation's image
    images: Images  # by number


@dataclass(frozen=True)
class Matches:
    """What matching found of each observation."""

    pixels: FloatArray  # (n_obs, 2)
    cov_px: FloatArray  # (n_obs, 2, 2)
    likeness: FloatArray  # (n_obs,) to the other views of its track; 0 where nothing could be seen
    bend: FloatArray  # (n_obs, 2, 3) of the warps by which they were matched
    fitted: FloatArray  # (n_obs, 2, 2) px a sample, as they were matched


def match_patches(sights: Sights, device: Device, progress: Progress) -> Matches:
    """Match all patches.

    Raises CalibrationError where an image or the device cannot be had.
    """
    torch = import_torch("--refine", device)
    seen, n = sights.seen, len(sights.seen)
    warps = warps_of(sights.estimate, seen, sights.middle, sights.normal)
    unknown = np.full((n, 2, 2), np.inf)
    found = Matches(
        sights.middle.copy(), unknown, np.zeros(n), warps.bend, np.full_like(warps.linear, np.nan)
    )
    sizes = np.array([camera.size for camera in sights.estimate.cameras])[seen.camera]
    shown = has_place(warps, sizes)
    shown &= shown[warps.reference]  # without its square nothing is known of a track
    done = 0

    def matched(rows: IntArray) -> tuple[IntArray, Aligned]:
        part = warps.subset(rows)
        crops = cut_out(sights.images, sights.image[rows], part)
        return rows, align(torch, crops, seen.point[rows], device)

    batches = _batches(seen.point, sights.image, np.flatnonzero(shown), A_BATCH[device])
    # One thread a batch: torch's own wait for each other after every sum, and spin.
    torch.set_num_threads(1)
    with ThreadPoolExecutor(thread_count() if device == "cpu" else GPU_THREADS) as pool:
        for rows, aligned in pool.map(matched, batches):
            found.pixels[rows] += aligned.pixels
            found.cov_px[rows] = aligned.cov_px
            found.likeness[rows] = aligned.likeness
            found.fitted[rows] = warps.linear[rows] @ aligned.linear
            progress("matching patches", done := done + len(rows), int(shown.sum()))
    return found


def _batches(point: IntArray, image: IntArray, rows: IntArray, size: int) -> Iterator[IntArray]:
    """Rows in turn, ascending in each batch: whole tracks, those near each other in the scan."""
    first = np.full(int(point.max(initial=0)) + 1, np.iinfo(np.int64).max)
    np.minimum.at(first, point[rows], image[rows])
    rows = rows[np.lexsort((point[rows], first[point[rows]]))]
    begins = np.flatnonzero(np.diff(point[rows], prepend=-1))
    batch = begins // size
    starts = begins[np.flatnonzero(np.diff(batch, prepend=-1))]
    for part in np.split(rows, starts[1:]):
        if len(part):
            yield np.sort(part)

"""`--refine`: every track measured anew, by least-squares matching of its patches.

Keypoints scatter by 0.2 to 1 px, each by itself. Once the cameras are roughly known, what each
image shows of a point can be laid over what the others show, which is good to some hundredths.
"""

from __future__ import annotations

import hashlib
import pickle
from dataclasses import dataclass, replace

import numpy as np

from graphs.build import GraphOptions
from graphs.problem import IntArray, Problem
from graphs.refine import refine
from graphs.selection import compact
from graphs.threads import thread_count
from graphs.track_building import joined_at_spots
from sfm_calib.cache import Cache
from sfm_calib.config import Options
from sfm_calib.images import Progress, Scan
from sfm_calib.patches.rounds import VERSION, Job, load_state, match_in_rounds
from sfm_calib.torch_import import check_torch, torch_versions
from sfm_calib.worker import run_apart

STAGE = "patches"
WHO = "matching patches"  # in messages, where it is ended from outside


@dataclass(frozen=True)
class Refined:
    """A problem of matched observations, and what became of those that it came from."""

    problem: Problem
    n_before: int
    moved_px: float  # median

    @property
    def message(self) -> str:
        """One line on what was done."""
        return (
            f"patches were matched: {len(self.problem.observations):,} of {self.n_before:,} "
            f"observations agree with the other views of their track, and moved by "
            f"{self.moved_px:.2f} px (median)"
        )


def refine_tracks(
    problem: Problem,
    scan: Scan,
    graph_options: GraphOptions,
    options: Options,
    cache: Cache,
    progress: Progress,
) -> Refined:
    """The problem with its observations measured anew in the scan's images.

    It is solved roughly before, for the warps, and between rounds of matching.
    Raises CalibrationError where too few observations can be matched, or torch is missing, and
    ValueError as `graphs.refine.refine`.
    """
    check_torch("--refine")
    rough = refine(
        joined_at_spots(problem), graph_options, options.min_parallax_deg, options.max_observations,
        on_iteration=lambda iteration, cost: progress("solving roughly", iteration, 0),
    ).problem  # fmt: skip
    paths = [scan.root / one.path for one in scan.images]
    image = images_of(rough, scan)
    job = Job(rough, image, paths, graph_options, options.min_parallax_deg, options.device)
    made_of = hashlib.sha256(pickle.dumps(replace(job, paths=()))).hexdigest()
    place = cache.stage(
        STAGE,
        [VERSION, made_of, scan.hashes, torch_versions()],
        lambda to: run_apart(match_in_rounds, (job, thread_count(), to), progress, WHO),
    )
    state = load_state(rough, place)
    moved = np.linalg.norm(state.pixels - rough.observations.pixels, axis=1)[state.good]
    final = compact(rough, state.measured().subset(state.good))
    return Refined(final, len(state.good), float(np.median(moved)))


def images_of(problem: Problem, scan: Scan) -> IntArray:
    """The number in the scan of each observation's image (n_obs,)."""
    number = scan.numbers
    frames = [scan.frames.index(name) for name in problem.frame_names]
    seen = problem.observations
    pairs = zip(seen.camera, seen.frame, strict=True)
    return np.array([number[camera, frames[frame]] for camera, frame in pairs])

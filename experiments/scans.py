"""Simulated scans with exactly so many observations, for comparing solvers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.problem import Problem
from graphs.selection import MIN_TRACK_LENGTH, compact
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5


@dataclass(frozen=True)
class Size:
    """A three-camera scan with exactly so many observations."""

    observations: int
    frames: int
    points: int  # in the room; those seen too rarely are left out


def simulated(size: Size, seed: int = 0) -> Problem:
    """A three-camera problem of exactly `size`, its start off by per cents and degrees.

    A point stays in sight for 30 frames at most, in up to three cameras; tracks are 14 or 15
    observations long on average. Raises ValueError when `size` has too few points.
    """
    rng = np.random.default_rng(seed)
    options = TrackOptions(
        rig="triple",
        lens="radtan",
        frames=size.frames,
        points=size.points,
        max_points_per_image=size.points,  # none is left out
        sigma_px=SIGMA_PX,
        baseline_sigma_m=0,  # Ceres could not use it
    )
    problem, _ = simulate_tracks(options, rng)
    return thinned(problem, size.observations, rng)


def thinned(problem: Problem, n_observations: int, rng: np.random.Generator) -> Problem:
    """The problem with exactly so many observations; no track gets shorter than it must be.

    Raises ValueError when the problem has too few, or its tracks are too short to be thinned.
    """
    seen = problem.observations
    by_point = np.argsort(seen.point, kind="stable")
    counts = np.bincount(seen.point)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    spare = by_point[np.arange(len(seen)) - starts >= MIN_TRACK_LENGTH]
    excess = len(seen) - n_observations
    if not 0 <= excess <= len(spare):
        raise ValueError(f"cannot thin {len(seen)} observations to {n_observations}")
    keep = np.ones(len(seen), dtype=bool)
    keep[rng.choice(spare, excess, replace=False)] = False
    return compact(problem, seen.subset(keep))

"""Does the solver find the optimum from a badly wrong lens?

Question: with the focal length off by 30 %, no distortion and the principal point off by 5 % of
the width, does one solve end where a start at the truth ends? Method: simulated scans, 20 seeds a
kind of rig, focal lengths too short and too long in turn, frames off by 1 degree and 3 cm, points
by 5 cm; the share of solves whose cost is that from the truth to 1e-6. Expectation: all of them on
well-conditioned scenes. Run: python -m experiments.wrong_starts
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from graphs.build import GraphOptions, build
from graphs.camera import Camera
from graphs.lenses import LensName
from graphs.losses import SCALE_95, LossName
from graphs.priors import weak_lens_prior
from graphs.problem import Problem
from graphs.solve import SolveSummary, solve
from sfm_calib.simulate.rigs import RigName
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
FOCAL_ERROR = 0.3
PRINCIPAL_POINT_ERROR = 0.05  # of the width
SAME_COST = 1e-6  # relative
SEEDS = 20


@dataclass(frozen=True)
class Kind:
    """A kind of scan to start wrongly in."""

    rig: RigName
    lens: LensName
    frames: int
    loss: LossName


KINDS = (
    Kind("triple", "radtan", 20, "cauchy"),
    Kind("triple", "radtan", 20, "huber"),
    Kind("stereo", "brown", 20, "cauchy"),
    Kind("stereo", "kannala_brandt", 20, "cauchy"),
    Kind("mono", "radial", 30, "cauchy"),
)


def trials(kind: Kind, seeds: int = SEEDS) -> Iterator[tuple[bool, SolveSummary]]:
    """For each seed, whether the wrong start ended at the optimum, and how it went."""
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        options = TrackOptions(
            rig=kind.rig,
            lens=kind.lens,
            frames=kind.frames,
            points=3000,
            max_points_per_image=150,
            sigma_px=SIGMA_PX,
            baseline_sigma_m=0,
            focal_error=FOCAL_ERROR if seed % 2 else -FOCAL_ERROR,
            principal_point_error_px=PRINCIPAL_POINT_ERROR * 640,
        )
        problem, truth = simulate_tracks(options, rng)
        priors = tuple(weak_lens_prior(camera) for camera in truth.cameras)
        graph_options = GraphOptions(
            SIGMA_PX, loss=kind.loss, loss_scale=SCALE_95[kind.loss], lens_priors=priors
        )
        best = _solved(replace(problem, initial=truth), graph_options)
        start = replace(problem.initial, cameras=_undistorted(problem.initial.cameras))
        summary = _solved(replace(problem, initial=start), graph_options)
        yield summary.cost <= best.cost * (1 + SAME_COST), summary


def _undistorted(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras with all coefficients zero."""
    return tuple(
        replace(camera, params=np.append(camera.params[:4], np.zeros(camera.params.size - 4)))
        for camera in cameras
    )


def _solved(problem: Problem, options: GraphOptions) -> SolveSummary:
    return solve(build(problem, options))[2]


def main(kinds: Sequence[Kind] = KINDS, seeds: int = SEEDS) -> list[float]:
    """Print a row a kind; returns the shares that ended at the optimum."""
    table = Table(title="wrong starts: 30 % focal length, no distortion, 5 % principal point")
    for column in ("rig", "lens", "loss", "at the optimum", "iterations, mean", "most"):
        table.add_column(column, justify="right")
    shares = []
    for kind in kinds:
        results = list(trials(kind, seeds))
        found = sum(good for good, _ in results)
        steps = [summary.iterations for _, summary in results]
        table.add_row(
            kind.rig, kind.lens, kind.loss, f"{found} of {seeds}",
            f"{np.mean(steps):.1f}", f"{max(steps)}",
        )  # fmt: skip
        shares.append(found / seeds)
        print(f"{kind.rig} {kind.lens} {kind.loss}: {found} of {seeds}", file=sys.stderr)
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    return shares


@dataclass(frozen=True)
class Options:
    """Does the solver find the optimum from a badly wrong lens?"""

    seeds: int = SEEDS
    """Scans of each kind."""


if __name__ == "__main__":
    main(seeds=tyro.cli(Options).seeds)

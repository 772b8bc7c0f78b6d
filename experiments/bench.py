"""How fast is our bundle adjustment, side by side with Ceres: `make bench`.

Both solvers get the same simulated problem, the same loss and the same rule for stopping, and
must end at the same cost. Prints a table and writes out/bench/ba.json.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from experiments.ceres import ceres_bundle_adjust
from graphs.build import GraphOptions, build
from graphs.covariance import calibration_covariance
from graphs.frames import FloatArray
from graphs.priors import LensPrior
from graphs.problem import Estimate, Problem, residuals_px
from graphs.selection import MIN_TRACK_LENGTH, compact
from graphs.solve import RELATIVE_COST_TOLERANCE, solve
from sfm_calib.files import write_atomically
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

OUT = Path("out/bench/ba.json")
SIGMA_PX = 0.5
SAME_COST = 1e-4  # relative; beyond it the two did not solve the same problem
FLAT_SIGMA = 1e6  # px, or of a coefficient: adds less than 1e-9 of the cost


@dataclass(frozen=True)
class Size:
    """A three-camera scan with exactly so many observations."""

    observations: int
    frames: int
    max_points_per_image: int
    points: int  # in the room; those seen too rarely are left out


SIZES = (Size(5_000, 20, 100, 800), Size(25_000, 50, 230, 3_000))


@dataclass(frozen=True)
class Row:
    """One problem, solved twice. Costs are 1/2 sum rho(r / sigma), seconds are wall-clock."""

    observations: int
    frames: int
    points: int
    cost: float
    cost_ceres: float
    seconds: float  # graph built and solved
    seconds_marginals: float  # graph built and solved, covariance of lenses and rig recovered
    seconds_ceres: float  # problem set up and solved
    iterations: int
    iterations_ceres: int

    @property
    def cost_difference(self) -> float:
        """Ours less Ceres's, relative."""
        return (self.cost - self.cost_ceres) / self.cost_ceres


def main(sizes: Sequence[Size] = SIZES, out: Path = OUT) -> list[Row]:
    """Run every size, print the table and write the rows.

    Raises AssertionError when the two solvers end at different costs.
    """
    rows = []
    for size in sizes:
        print(f"bench: {size.observations} observations, {size.frames} frames", flush=True)
        rows.append(measure(simulated(size)))
    write_atomically(out, json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(table_of(rows))
    console.print(f"{out} written")
    for row in rows:
        assert abs(row.cost_difference) < SAME_COST, (
            f"{row.observations} observations: cost {row.cost:.6g}, Ceres {row.cost_ceres:.6g}"
        )
    return rows


def simulated(size: Size, seed: int = 0) -> Problem:
    """A three-camera problem of exactly `size`, its start off by per cents and degrees."""
    rng = np.random.default_rng(seed)
    options = TrackOptions(
        rig="triple",
        lens="radtan",
        frames=size.frames,
        points=size.points,
        max_points_per_image=size.max_points_per_image,
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


def measure(problem: Problem) -> Row:
    """Solve the problem with our reference graph and with Ceres."""
    options = GraphOptions(sigma_px=SIGMA_PX, loss="cauchy", lens_priors=flat_priors(problem))
    start = time.perf_counter()
    graph = build(problem, options)
    estimate, values, summary = solve(graph)
    seconds = time.perf_counter() - start
    calibration_covariance(graph, estimate, values)
    seconds_marginals = time.perf_counter() - start
    ceres = ceres_bundle_adjust(problem, options, RELATIVE_COST_TOLERANCE)
    return Row(
        observations=len(problem.observations),
        frames=len(problem.frame_names),
        points=len(problem.initial.points),
        cost=robust_cost(estimate, problem, options),
        cost_ceres=robust_cost(ceres.estimate, problem, options),
        seconds=round(seconds, 3),
        seconds_marginals=round(seconds_marginals, 3),
        seconds_ceres=round(ceres.seconds, 3),
        iterations=summary.iterations,
        iterations_ceres=ceres.iterations,
    )


def flat_priors(problem: Problem) -> tuple[LensPrior, ...]:
    """Beliefs in the lenses so weak that Ceres, which has none, solves the same problem."""
    return tuple(
        LensPrior(camera.params, np.full(camera.params.size, FLAT_SIGMA))
        for camera in problem.initial.cameras
    )


def robust_cost(estimate: Estimate, problem: Problem, options: GraphOptions) -> float:
    """Cauchy cost of an estimate, the same ruler for both solvers."""
    r: FloatArray = np.linalg.norm(residuals_px(estimate, problem.observations), axis=1)
    k = options.loss_scale
    return float(np.sum(k**2 / 2 * np.log1p((r / options.sigma_px / k) ** 2)))


def table_of(rows: Sequence[Row]) -> Table:
    """The rows for a person; ratios and the cost's difference are ours against Ceres's."""
    cores = len(os.sched_getaffinity(0))
    title = f"bundle adjustment, {cores} cores: our reference graph and Ceres"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for column in (
        "observations", "frames", "points", "ours s", "+ marginals s", "Ceres s",
        "ratio", "+ marginals", "iterations", "cost",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(
            f"{row.observations:,}",
            f"{row.frames}",
            f"{row.points:,}",
            f"{row.seconds:.2f}",
            f"{row.seconds_marginals:.2f}",
            f"{row.seconds_ceres:.2f}",
            f"{row.seconds / row.seconds_ceres:.2f}",
            f"{row.seconds_marginals / row.seconds_ceres:.2f}",
            f"{row.iterations} / {row.iterations_ceres}",
            f"{row.cost_difference:+.0e}",
        )
    return table


if __name__ == "__main__":
    main()

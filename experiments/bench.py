"""How fast is our bundle adjustment, side by side with Ceres and native GTSAM: `make bench`.

All solvers get the same simulated problems, the same loss and the same rule for stopping, each in
a process of its own, and must end at the same cost. Prints tables and writes
out/bench/ba.json, and out/bench/growth.json with what else the growth figures take.
"""

from __future__ import annotations

import json
import os
import pickle
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from experiments.scans import Size, simulated
from experiments.solvers import NEAR, TINY, Outcome, SolverName, run
from graphs.problem import Problem
from sfm_calib.files import write_atomically

SMALL, MEDIUM = Size(25_000, 50, 2_700), Size(100_000, 200, 8_100)
LARGE, LONG = Size(400_000, 200, 32_300), Size(400_000, 1_000, 29_000)
HUGE = Size(1_600_000, 200, 129_000)
SHORT = Size(80_000, 200, 6_500)  # as many observations a frame as LONG
QUICK_SIZES, SIZES = (SMALL, MEDIUM), (SMALL, MEDIUM, LARGE, LONG, HUGE)
GROWTH_SIZES = (SHORT,)  # measured for the sake of growth alone

# Each solver's fastest of so many runs counts: what else a machine does only ever slows it down.
REPEATS, FEW_REPEATS = 3, 2
OFTEN_UP_TO = 100_000  # observations
NATIVE_UP_TO = 400_000  # GTSAM's own factors take minutes beyond, and gigabytes

# What is promised; see README.md for what was measured.
PROMISED_SIZES = (100_000, 400_000)
MOST_OF_CERES, MOST_WITH_MARGINALS, MOST_MEMORY = 0.33, 0.5, 1.0
MOST_GROWTH_OBSERVATIONS, MOST_GROWTH_FRAMES = 18.0, 7.0
MOST_COMPILE_SECONDS = 20.0

TABLE_WIDTH = 160  # narrower terminals break its lines, but lose nothing


@dataclass(frozen=True)
class BenchOptions:
    """Bundle adjustment: ours beside Ceres and native GTSAM."""

    quick: bool = False
    """Only the two small sizes; no growth, no compile time."""
    native_all: bool = False
    """Run GTSAM's native factors at the largest size too: some minutes more."""
    repeats: int | None = None
    """Runs of each solver, the fastest of which counts; by default 3, of the large sizes 2."""
    out: Path = Path("out/bench")
    """Folder for ba.json and growth.json."""


@dataclass(frozen=True)
class Row:
    """One problem, solved by all. Costs are 1/2 sum rho(r / sigma), seconds are wall-clock.

    `seconds` are for setting up and solving, `_near` until within 1e-6 of the final cost,
    `_marginals` with the covariance of all lenses and cam_from_rig after it. Memory is what the
    process peaked above what it held before, the problem's arrays loaded. GTSAM: None if not run.
    """

    observations: int
    frames: int
    points: int
    cost: float
    cost_ceres: float
    cost_gtsam: float | None
    seconds: float
    seconds_marginals: float
    seconds_ceres: float
    seconds_gtsam: float | None
    seconds_near: float
    seconds_near_ceres: float
    iterations: int
    iterations_ceres: int
    iterations_gtsam: int | None
    peak_mb: float
    peak_mb_marginals: float
    peak_mb_ceres: float
    peak_mb_gtsam: float | None

    @property
    def cost_difference(self) -> float:
        """Ours less Ceres's, relative."""
        return (self.cost - self.cost_ceres) / self.cost_ceres


def main(options: BenchOptions) -> list[Row]:
    """Run every size, write the rows, print the tables.

    Raises AssertionError when ours and Ceres end at different costs.
    """
    native_up_to = HUGE.observations if options.native_all else NATIVE_UP_TO
    rows = measured(QUICK_SIZES if options.quick else SIZES, native_up_to, options.repeats)
    write_atomically(options.out / "ba.json", as_json([asdict(row) for row in rows]))
    more: list[Row] = []
    growth: dict[str, float] = {}
    if not options.quick:
        more = measured(GROWTH_SIZES, 0, options.repeats)
        growth = growth_of([*rows, *more]) | {"compile_seconds": cold_compile_seconds()}
        stored = {"rows": [asdict(row) for row in more], **growth}
        write_atomically(options.out / "growth.json", as_json(stored))
    console = Console(width=TABLE_WIDTH)
    console.print(table_of([*rows, *more]))
    for remark in native_remarks([*rows, *more]):
        console.print(remark)
    console.print(promises_of(rows, growth))
    console.print(f"written to {options.out}")
    check_costs([*rows, *more])
    return rows


def measured(sizes: Sequence[Size], native_up_to: int, repeats: int | None) -> list[Row]:
    """A row for each size; GTSAM is asked where there are at most so many observations."""
    rows = []
    for size in sizes:
        problem = simulated(size)
        native = size.observations <= native_up_to
        often = REPEATS if size.observations <= OFTEN_UP_TO else FEW_REPEATS
        rows.append(measure(problem, native, repeats or often))
    return rows


def measure(problem: Problem, native: bool = True, repeats: int = 1) -> Row:
    """The problem, solved by each solver in turn, `repeats` times over; the fastest runs count."""
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / f"{len(problem.observations)}.pickle"
        stored.write_bytes(pickle.dumps(problem))
        ours, ceres = [], []
        for _ in range(repeats):
            ours.append(announced("ours", problem, stored))
            ceres.append(announced("ceres", problem, stored))
        gtsam = announced("gtsam", problem, stored) if native else None
    return row_of(problem, fastest(ours), fastest(ceres), gtsam)


def announced(solver: SolverName, problem: Problem, stored: Path) -> Outcome:
    """Run a solver, with a line that says on what and how long it took."""
    outcome = run(solver, stored)
    seen = f"{len(problem.observations):>9,} observations, {len(problem.frame_names):>5,} frames"
    took = f"{outcome.seconds:7.2f} s, {outcome.iterations:3d} iterations"
    print(f"bench {time.strftime('%H:%M:%S')}: {seen}: {solver:5} {took}", flush=True)
    return outcome


def fastest(outcomes: Sequence[Outcome]) -> Outcome:
    """The outcome of the run that took the least time."""
    return min(outcomes, key=lambda outcome: outcome.seconds)


def row_of(problem: Problem, ours: Outcome, ceres: Outcome, gtsam: Outcome | None) -> Row:
    """All outcomes of one problem side by side, seconds to the millisecond."""
    return Row(
        observations=len(problem.observations),
        frames=len(problem.frame_names),
        points=len(problem.initial.points),
        cost=ours.cost,
        cost_ceres=ceres.cost,
        cost_gtsam=None if gtsam is None else gtsam.cost,
        seconds=round(ours.seconds, 3),
        seconds_marginals=round(ours.seconds_marginals or 0.0, 3),
        seconds_ceres=round(ceres.seconds, 3),
        seconds_gtsam=None if gtsam is None else round(gtsam.seconds, 3),
        seconds_near=round(ours.seconds_near or 0.0, 3),
        seconds_near_ceres=round(ceres.seconds_near or 0.0, 3),
        iterations=ours.iterations,
        iterations_ceres=ceres.iterations,
        iterations_gtsam=None if gtsam is None else gtsam.iterations,
        peak_mb=round(ours.peak_mb, 1),
        peak_mb_marginals=round(ours.peak_mb_marginals or 0.0, 1),
        peak_mb_ceres=round(ceres.peak_mb, 1),
        peak_mb_gtsam=None if gtsam is None else round(gtsam.peak_mb, 1),
    )


def check_costs(rows: Sequence[Row]) -> None:
    """Raise AssertionError, naming the row and both costs, if ours and Ceres's differ."""
    for row in rows:
        assert abs(row.cost_difference) <= NEAR, (
            f"{row.observations:,} observations, {row.frames} frames: our cost {row.cost:.9g}, "
            f"Ceres's {row.cost_ceres:.9g}: they did not solve the same problem"
        )


def native_remarks(rows: Sequence[Row]) -> list[str]:
    """Where GTSAM ended at another cost than ours, and by how much."""
    return [
        f"{row.observations:,} observations, {row.frames:,} frames: GTSAM's cost is ours "
        f"{row.cost_gtsam / row.cost - 1:+.1e}"
        for row in rows
        if row.cost_gtsam is not None and abs(row.cost_gtsam / row.cost - 1) > NEAR
    ]


def cold_compile_seconds() -> float:
    """What a first run ever takes longer than a later one: numba compiles, its cache empty."""
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / "tiny.pickle"
        stored.write_bytes(pickle.dumps(simulated(TINY)))
        cold = run("ours", stored, {"NUMBA_CACHE_DIR": str(Path(folder) / "cache")})
    return round(cold.seconds_tiny - (cold.seconds_marginals or 0.0), 1)


def growth_of(rows: Sequence[Row]) -> dict[str, float]:
    """How our time grows with observations, and with frames at as many observations a frame."""
    seconds = {(row.observations, row.frames): row.seconds for row in rows}

    def growth(fewer: Size, more: Size) -> float:
        few, many = ((size.observations, size.frames) for size in (fewer, more))
        return round(seconds[many] / seconds[few], 2)

    return {
        "growth_observations": growth(MEDIUM, HUGE),
        "growth_frames": growth(SHORT, LONG),
    }


def as_json(value: object) -> str:
    """For people to read, too."""
    return json.dumps(value, indent=1) + "\n"


def table_of(rows: Sequence[Row]) -> Table:
    """The rows for a person; where two numbers stand together, ours is the first."""
    cores = len(os.sched_getaffinity(0))
    title = f"bundle adjustment on {cores} cores, seconds in all: ours, Ceres, GTSAM's own factors"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for column in (
        "obser-\nvations", "frames", "points", "ours", "+ mar-\nginals", "Ceres", "GTSAM",
        "ours\n/ Ceres", "+ marg.\n/ Ceres", "to 1e-6\nof the end", "itera-\ntions",
        "ms an\niteration", "peak MB", "MB\n/ Ceres", "cost\ndiffers",
    ):  # fmt: skip
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        each = 1e3 * row.seconds / row.iterations, 1e3 * row.seconds_ceres / row.iterations_ceres
        table.add_row(
            f"{row.observations:,}",
            f"{row.frames:,}",
            f"{row.points:,}",
            f"{row.seconds:.2f}",
            f"{row.seconds_marginals:.2f}",
            f"{row.seconds_ceres:.2f}",
            "-" if row.seconds_gtsam is None else f"{row.seconds_gtsam:.1f}",
            f"{row.seconds / row.seconds_ceres:.2f}",
            f"{row.seconds_marginals / row.seconds_ceres:.2f}",
            f"{row.seconds_near:.2f} / {row.seconds_near_ceres:.2f}",
            f"{row.iterations} / {row.iterations_ceres}",
            f"{each[0]:.0f} / {each[1]:.0f}",
            f"{row.peak_mb:.0f} / {row.peak_mb_ceres:.0f}",
            f"{row.peak_mb / row.peak_mb_ceres:.2f}",
            f"{row.cost_difference:+.0e}",
        )
    return table


def promises_of(rows: Sequence[Row], growth: Mapping[str, Any]) -> Table:
    """What is promised, what was measured, and whether it was kept."""
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("promise", "at most", "measured", ""):
        table.add_column(column, justify="left" if column == "promise" else "right")

    def add(promise: str, limit: float, measured: float) -> None:
        verdict = "kept" if measured <= limit else "BROKEN"
        table.add_row(promise, f"{limit:g}", f"{measured:.2f}", verdict)

    for row in rows:
        if row.observations not in PROMISED_SIZES:
            continue
        at = f"{row.observations:,} observations, {row.frames:,} frames"
        add(f"time / Ceres, {at}", MOST_OF_CERES, row.seconds / row.seconds_ceres)
        with_marginals = row.seconds_marginals / row.seconds_ceres
        add(f"with marginals / Ceres, {at}", MOST_WITH_MARGINALS, with_marginals)
        add(f"peak memory / Ceres, {at}", MOST_MEMORY, row.peak_mb / row.peak_mb_ceres)
    if growth:
        few, many = (f"{size.observations:,}" for size in (MEDIUM, HUGE))
        observations = f"growth from {few} to {many} observations, {MEDIUM.frames} frames each"
        add(observations, MOST_GROWTH_OBSERVATIONS, growth["growth_observations"])
        frames = f"growth from {SHORT.frames} to {LONG.frames:,} frames, "
        frames += f"{LONG.observations // LONG.frames} observations a frame"
        add(frames, MOST_GROWTH_FRAMES, growth["growth_frames"])
        add("seconds of compilation, once", MOST_COMPILE_SECONDS, growth["compile_seconds"])
    return table


if __name__ == "__main__":
    main(tyro.cli(BenchOptions))

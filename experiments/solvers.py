"""Our solver, Ceres and GTSAM's native factors, each alone in a process of its own.

So that time and peak memory are the solver's own: the problem is loaded and a tiny one has been
solved before the clock starts and before memory is counted.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np

from experiments.scans import SIGMA_PX, Size, simulated
from graphs.build import GraphOptions, build
from graphs.frames import FloatArray
from graphs.priors import LensPrior
from graphs.problem import Estimate, Problem, residuals_px
from graphs.solve import RELATIVE_COST_TOLERANCE, solve
from graphs.stated_covariance import calibration_covariance

SolverName = Literal["ours", "ceres", "gtsam"]
MB = 1e6
NEAR = 1e-6  # relative: as near to its final cost as two solvers must end to each other
TINY = Size(observations=1_500, frames=12, points=460)  # solved first: compiles, loads libraries
FLAT_SIGMA = 1e6  # px, or of a coefficient: adds less than 1e-9 of the cost


@dataclass(frozen=True)
class Outcome:
    """What a solver made of a problem. Seconds are wall-clock, megabytes are 10^6 bytes.

    Memory is counted above what the process held before the solver started, its libraries and the
    problem's arrays loaded.
    """

    cost: float  # 1/2 sum rho(r / sigma), by `robust_cost`
    seconds: float  # set up and solved
    seconds_near: float | None  # until the cost was within NEAR of the final one
    iterations: int
    peak_mb: float
    seconds_marginals: float | None = None  # set up, solved, covariance of lenses and rig
    peak_mb_marginals: float | None = None
    seconds_tiny: float = 0.0  # for the tiny problem before, with marginals and compilation


def run(solver: SolverName, problem: Path, environment: Mapping[str, str] | None = None) -> Outcome:
    """Solve a pickled Problem in a process of its own, with further environment variables.

    Raises RuntimeError with the process's last words when it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "outcome.json"
        command = [sys.executable, "-m", "experiments.solvers", solver, str(problem), str(written)]
        done = subprocess.run(
            command, env={**os.environ, **(environment or {})}, capture_output=True, text=True
        )
        if done.returncode:
            raise RuntimeError(
                f"{solver} failed on {problem.name}, exit status {done.returncode}: "
                f"{done.stderr[-2000:].strip() or 'nothing said'}"
            )
        return Outcome(**json.loads(written.read_text()))


def main(solver: SolverName, problem_file: Path, written: Path) -> None:
    """The process's own story: a tiny problem first, then the one that counts."""
    problem: Problem = pickle.loads(problem_file.read_bytes())
    start = time.perf_counter()
    SOLVERS[solver](simulated(TINY))
    seconds_tiny = time.perf_counter() - start
    outcome = SOLVERS[solver](problem)
    written.write_text(json.dumps(asdict(outcome) | {"seconds_tiny": seconds_tiny}))


def solve_ours(problem: Problem) -> Outcome:
    """By the graph that calibration uses, then the covariance of all lenses and cam_from_rig."""
    options = options_for(problem)
    trace = []
    peak_mb = memory_meter()
    start = time.perf_counter()
    graph = build(problem, options)
    estimate, values, summary = solve(
        graph, on_iteration=lambda _, cost: trace.append((time.perf_counter() - start, cost))
    )
    seconds, peak = time.perf_counter() - start, peak_mb()
    calibration_covariance(graph, estimate, values)
    return Outcome(
        cost=robust_cost(estimate, problem, options),
        seconds=seconds,
        seconds_near=seconds_near(trace, seconds),
        iterations=summary.iterations,
        peak_mb=peak,
        seconds_marginals=time.perf_counter() - start,
        peak_mb_marginals=peak_mb(),
    )


def solve_ceres(problem: Problem) -> Outcome:
    """By pycolmap's bundle adjustment; the model counts as its memory, but not its loading time."""
    from experiments.ceres import ceres_bundle_adjust

    options = options_for(problem)
    peak_mb = memory_meter()
    result = ceres_bundle_adjust(problem, options, RELATIVE_COST_TOLERANCE)
    peak = peak_mb()
    return Outcome(
        cost=robust_cost(result.estimate, problem, options),
        seconds=result.seconds,
        seconds_near=seconds_near(result.trace, result.seconds),
        iterations=result.iterations,
        peak_mb=peak,
    )


def solve_gtsam(problem: Problem) -> Outcome:
    """By GTSAM's own factors, one an observation, and its own Levenberg-Marquardt."""
    from graphs.reference import build_reference, solve_reference

    options = options_for(problem)
    peak_mb = memory_meter()
    start = time.perf_counter()
    graph = build_reference(problem, options)
    estimate, _, iterations = solve_reference(graph, relative_tolerance=RELATIVE_COST_TOLERANCE)
    seconds, peak = time.perf_counter() - start, peak_mb()
    return Outcome(
        cost=robust_cost(estimate, problem, options),
        seconds=seconds,
        seconds_near=None,
        iterations=iterations,
        peak_mb=peak,
    )


SOLVERS: dict[SolverName, Callable[[Problem], Outcome]] = {
    "ours": solve_ours,
    "ceres": solve_ceres,
    "gtsam": solve_gtsam,
}


def options_for(problem: Problem) -> GraphOptions:
    """The same loss for every solver; beliefs in the lenses so weak that Ceres needs none."""
    flat = tuple(
        LensPrior(camera.params, np.full(camera.params.size, FLAT_SIGMA))
        for camera in problem.initial.cameras
    )
    return GraphOptions(sigma_px=SIGMA_PX, loss="cauchy", lens_priors=flat)


def robust_cost(estimate: Estimate, problem: Problem, options: GraphOptions) -> float:
    """Cauchy cost of an estimate, the same ruler for every solver."""
    r: FloatArray = np.linalg.norm(residuals_px(estimate, problem.observations), axis=1)
    k = options.loss_scale
    return float(np.sum(k**2 / 2 * np.log1p((r / options.sigma_px / k) ** 2)))


def seconds_near(trace: list[tuple[float, float]], seconds: float) -> float | None:
    """When a solve that took `seconds` came within NEAR of its final cost, by its (time, cost)s.

    What follows the trace's last time, or went before its first, counts as it fell.
    """
    if not trace:
        return None
    final = trace[-1][1]
    reached = next(at for at, cost in trace if cost <= final * (1 + NEAR))
    return seconds - (trace[-1][0] - reached)


def memory_meter() -> Callable[[], float]:
    """A function that says how many MB the process has peaked above what it holds now.

    From Linux's VmHWM: getrusage's ru_maxrss would include what the parent held at the fork.
    """
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what the tiny problem left would be used again, uncounted
    with suppress(OSError):  # where it is forbidden, what is counted is a lower bound
        Path("/proc/self/clear_refs").write_text("5")  # start the high-water mark anew
    before = _high_water_mb()
    return lambda: _high_water_mb() - before


def _high_water_mb() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    kilobytes = next(line for line in lines if line.startswith("VmHWM:")).split()[1]
    return int(kilobytes) * 1024 / MB


if __name__ == "__main__":
    main(cast(SolverName, sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))

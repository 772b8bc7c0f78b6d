"""Do the stated sigmas hold, and are they as small as the data allow?

Question: over five geometries, with Gaussian noise and with outliers on noise that grows with a
keypoint's scale, are errors as large as their covariance says, and no larger than the Cramer-Rao
bound? Method: simulated scans, solved from a wrong start as `sfm-calib calibrate` solves them; the
normalised squared error (NEES) of all lens parameters and cam_from_rig a degree of freedom, how
often 95 % intervals hold the truth, and the RMSE over the bound. A prior is a measurement here: its
mean is drawn about the truth. Expectation: see MEAN_NEES and below.
Run: python -m experiments.coverage [--scans N] [--only orbit wall ...] [--out FILE]
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import Camera
from graphs.clusters import homogeneous
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.losses import SCALE_95
from graphs.model_covariance import calibration_columns
from graphs.priors import LensPrior, weak_lens_prior
from graphs.problem import Estimate, Problem
from graphs.refine import Refinement, refine
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from graphs.system import assemble
from graphs.threads import threads
from sfm_calib.files import write_atomically
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

GeometryName = Literal["orbit", "handheld", "corridor", "wall", "quad"]
NoiseName = Literal["gaussian", "heavy"]

SIGMA_PX = 0.5
SCANS = 40  # of each case
MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it
SCAN = TrackOptions(points=1500, max_points_per_image=150, sigma_px=SIGMA_PX)
GEOMETRIES: dict[GeometryName, dict[str, object]] = {
    "orbit": {"rig": "stereo", "trajectory": "orbit"},
    "handheld": {"rig": "triple", "lens": "radtan", "trajectory": "handheld"},
    "corridor": {"rig": "stereo", "trajectory": "corridor"},
    "wall": {"rig": "mono", "trajectory": "sideways", "scene": "wall"},
    "quad": {"rig": "quad", "trajectory": "handheld"},
}
NOISES: dict[NoiseName, dict[str, object]] = {
    "gaussian": {},
    "heavy": {"outlier_share": 0.05, "outlier_kind": "heavy", "noise_by_scale": True},
}

# What is promised.
MEAN_NEES: dict[NoiseName, tuple[float, float]] = {"gaussian": (0.9, 1.15), "heavy": (0.8, 1.3)}
COVERAGE = (0.90, 0.98)
MOST_OF_BOUND = 1.1  # RMSE over the Cramer-Rao bound; Cauchy's loss alone takes 1.026
WITHIN_95 = 1.959964  # sigmas
ALL = "all"  # kinds of parameters


@dataclass(frozen=True)
class Case:
    """A geometry under a noise."""

    geometry: GeometryName
    noise: NoiseName

    @property
    def options(self) -> TrackOptions:
        return SCAN.model_copy(update=GEOMETRIES[self.geometry] | NOISES[self.noise])

    def rng(self, seed: int) -> np.random.Generator:
        place = list(GEOMETRIES).index(self.geometry), list(NOISES).index(self.noise)
        return np.random.default_rng([seed, *place])


CASES = tuple(Case(geometry, noise) for noise in NOISES for geometry in GEOMETRIES)


@dataclass(frozen=True)
class Efficient:
    """What least squares makes of a scan with Gaussian noise of known size, from the truth."""

    error: FloatArray  # (n,)
    bound: FloatArray  # (n, n) Cramer-Rao


@dataclass(frozen=True)
class Trial:
    """One scan: how far off its parameters are, and how far off they are said to be."""

    names: tuple[str, ...]
    error: FloatArray  # (n,)
    stated: FloatArray  # (n, n)
    model: FloatArray  # (n, n)
    efficient: Efficient | None  # None: the noise is not Gaussian
    sigma_px: float  # estimated
    seconds: float  # without what only the bound takes


@dataclass(frozen=True)
class Refusal:
    """One scan that was not calibrated, and why."""

    message: str


# ---- one scan ------------------------------------------------------------------------------


def trial(case: Case, seed: int) -> Trial | Refusal:
    """Simulate, calibrate and compare one scan."""
    rng = case.rng(seed)
    problem, truth = simulate_tracks(case.options, rng)
    priors = tuple(measured_prior(camera, rng) for camera in truth.cameras)
    options = GraphOptions(loss="cauchy", loss_scale=SCALE_95["cauchy"], lens_priors=priors)
    began = time.perf_counter()
    try:
        refinement = refine(problem, options, MIN_PARALLAX_DEG)
        names, of_stated, of_model = stated(refinement)
    except ValueError as refused:
        return Refusal(str(refused))
    seconds = time.perf_counter() - began
    error = change(truth, refinement.estimate, names)
    efficient = least_squares(problem, truth, priors) if case.noise == "gaussian" else None
    return Trial(names, error, of_stated, of_model, efficient, refinement.sigma_px, seconds)


def stated(refinement: Refinement) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Names of the parameters, their stated covariance (n, n), and the model's (n, n)."""
    covariance = calibration_covariance(
        refinement.graph, refinement.estimate, refinement.values, MIN_PARALLAX_DEG
    )
    return covariance.stated.names, covariance.stated.matrix, covariance.model.matrix


def measured_prior(camera: Camera, rng: np.random.Generator) -> LensPrior:
    """The weak prior of a true camera, off by what its sigmas say, as a measurement would be.

    A belief that is always the same leaves the same error in every scan, less than it says.
    Focal lengths, of which it knows nothing, stay; their ratio moves.
    """
    prior, mean = weak_lens_prior(camera), camera.params.copy()
    mean[1] += prior.aspect_sigma * prior.mean[0] * rng.standard_normal()
    mean[2:] += prior.sigma[2:] * rng.standard_normal(mean.size - 2)
    return replace(prior, mean=mean)


def least_squares(problem: Problem, truth: Estimate, priors: tuple[LensPrior, ...]) -> Efficient:
    """The efficient estimate of a problem with Gaussian noise of SIGMA_PX, and its bound."""
    options = GraphOptions(SIGMA_PX, "none", lens_priors=priors)
    graph = build(replace(problem, initial=truth), options)
    names = calibration_columns(graph, truth)[1]
    return Efficient(change(truth, solve(graph)[0], names), inverse_information(graph))


def inverse_information(graph: CalibrationGraph) -> FloatArray:
    """Covariance (n, n) of the parameters at the graph's start, its noise taken for granted."""
    start = graph.problem.initial
    columns, _, to_reported = calibration_columns(graph, start)
    others, variables = graph.others.linearize(graph.initial), graph.variables(graph.initial)
    with threads() as pool:
        points = homogeneous(graph.tracks, start.points)
        system = assemble(graph.tracks, others, graph.layout, variables, points, pool)
        unit = np.zeros((system.elimination.n_columns, len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        inverse = system.factorise().solve(unit)[columns]
    return to_reported @ inverse @ to_reported.T


# ---- many scans ----------------------------------------------------------------------------


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """Normalised estimation error squared a degree of freedom: 1 on average where they agree."""
    sigma = np.sqrt(np.diag(covariance))
    z = error / sigma
    return float(z @ np.linalg.solve(covariance / np.outer(sigma, sigma), z)) / len(error)


@dataclass(frozen=True)
class Summary:
    """What the scans of one case say together."""

    geometry: GeometryName
    noise: NoiseName
    scans: int
    refused: tuple[str, ...]
    parameters: int
    nees_stated: tuple[float, float]  # mean a degree of freedom, and its standard error
    nees_model: tuple[float, float]
    nees_efficient: tuple[float, float] | None  # of least squares, by the bound
    coverage: dict[str, float]  # of 95 % intervals, by kind of parameter
    coverage_model: dict[str, float]
    of_bound: dict[str, float]  # RMSE over the Cramer-Rao bound, by kind of parameter
    of_bound_paired: dict[str, float]  # the same, less what chance did to the bound's own errors
    sigma_px: float  # mean estimate
    seconds: float  # a scan, median

    @property
    def worst_coverage(self) -> tuple[str, float]:
        """The kind of parameter whose coverage is farthest from 95 %."""
        return max(self.coverage.items(), key=lambda item: abs(item[1] - 0.95))


def summarise(case: Case, results: Sequence[Trial | Refusal]) -> Summary:
    """Means over all scans of a case that were not refused. Raises ValueError when all were."""
    trials = [result for result in results if isinstance(result, Trial)]
    refused = tuple(result.message for result in results if isinstance(result, Refusal))
    if not trials:
        raise ValueError(
            f"{case.geometry} {case.noise}: none of {len(refused)} scans was calibrated: "
            f"{refused[0] if refused else 'none was asked for'}"
        )
    kinds = [name.split(".")[1] for name in trials[0].names]
    error = np.array([t.error for t in trials])
    z_stated, z_model = (
        error / np.sqrt([np.diag(getattr(t, name)) for t in trials]) for name in ("stated", "model")
    )
    best = [t.efficient for t in trials if t.efficient is not None]
    of_bound, paired = efficiency(kinds, error, best) if best else ({}, {})
    return Summary(
        geometry=case.geometry,
        noise=case.noise,
        scans=len(trials),
        refused=refused,
        parameters=len(kinds),
        nees_stated=mean_and_error([nees(t.error, t.stated) for t in trials]),
        nees_model=mean_and_error([nees(t.error, t.model) for t in trials]),
        nees_efficient=mean_and_error([nees(e.error, e.bound) for e in best]) if best else None,
        coverage=by_kind(kinds, (np.abs(z_stated) < WITHIN_95).mean(0)),
        coverage_model=by_kind(kinds, (np.abs(z_model) < WITHIN_95).mean(0)),
        of_bound=of_bound,
        of_bound_paired=paired,
        sigma_px=float(np.mean([t.sigma_px for t in trials])),
        seconds=float(np.median([t.seconds for t in trials])),
    )


def efficiency(
    kinds: Sequence[str], error: FloatArray, best: Sequence[Efficient]
) -> tuple[dict[str, float], dict[str, float]]:
    """RMSE of errors (n_scans, n) over the Cramer-Rao bound, by kind of parameter, in two ways.

    Plain, and with the errors of least squares in the same scans as control variates: these are
    known to have the bound's variance, so what chance made of them is taken off.
    """
    variance = np.mean([np.diag(e.bound) for e in best], axis=0)
    square = (error**2).mean(0)
    excess = square - np.mean([e.error**2 for e in best], axis=0)
    plain, paired = (
        {kind: max(ratio, 0.0) ** 0.5 for kind, ratio in by_kind(kinds, part / variance).items()}
        for part in (square, variance + excess)
    )
    return plain, paired


def by_kind(kinds: Sequence[str], values: FloatArray) -> dict[str, float]:
    """Means of values (n,) over all cameras' parameters of one kind, and over all."""
    of = np.array(kinds)
    means = {kind: float(values[of == kind].mean()) for kind in dict.fromkeys(kinds)}
    return means | {ALL: float(values.mean())}


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean and its standard error, infinite of a single value."""
    if len(values) < 2:
        return float(np.mean(values)), float("inf")
    return float(np.mean(values)), float(np.std(values, ddof=1) / len(values) ** 0.5)


def study(cases: Sequence[Case], scans: int, jobs: int = 1) -> list[Summary]:
    """Summaries of the cases, each over as many scans; `jobs` processes share them."""
    summaries = []
    for case in cases:
        if jobs == 1:
            results = [trial(case, seed) for seed in range(scans)]
        else:
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(jobs, context) as pool:
                results = list(pool.map(partial(trial, case), range(scans)))
        summaries.append(summarise(case, results))
        mean = summaries[-1].nees_stated[0]
        print(f"{case.geometry} {case.noise}: NEES {mean:.2f}", file=sys.stderr)
    return summaries


# ---- tables --------------------------------------------------------------------------------


def overview(summaries: Sequence[Summary]) -> Table:
    """A row a case."""
    table = Table(
        title="NEES a degree of freedom (1: errors are as stated), of stated and model covariance, "
        "and of least squares by the Cramer-Rao bound;\n95 % intervals that hold the truth; RMSE "
        "over the bound"
    )
    for column in (
        "geometry", "noise", "scans\nrefused", "parameters", "NEES\nstated", "NEES\nmodel",
        "NEES\nbound", "coverage", "worst", "RMSE /\nbound", "worst",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for s in summaries:
        kind, covered = s.worst_coverage
        ratio = worst = "–"
        if s.of_bound_paired:
            name = max(s.of_bound_paired, key=lambda k: s.of_bound_paired[k])
            ratio = f"{s.of_bound_paired[ALL]:.3f}"
            worst = f"{s.of_bound_paired[name]:.3f}\n{name}"
        table.add_row(
            s.geometry, s.noise, f"{s.scans}\n{len(s.refused)}", f"{s.parameters}",
            _with_error(s.nees_stated), _with_error(s.nees_model), _with_error(s.nees_efficient),
            f"{100 * s.coverage[ALL]:.1f} %", f"{100 * covered:.1f} %\n{kind}", ratio, worst,
        )  # fmt: skip
    return table


def _with_error(value: tuple[float, float] | None) -> str:
    return "–" if value is None else f"{value[0]:.2f} ± {value[1]:.2f}"


def by_parameter(summaries: Sequence[Summary]) -> Table:
    """A row a kind of parameter, a column a case: coverage in %, RMSE over the bound."""
    table = Table(title="95 % intervals that hold the truth, in %; RMSE over the bound")
    table.add_column("parameter")
    for s in summaries:
        table.add_column(f"{s.geometry}\n{s.noise}", justify="right")
    kinds = dict.fromkeys(kind for s in summaries for kind in s.coverage if kind != ALL)
    for kind in (*kinds, ALL):
        cells = []
        for s in summaries:
            cell = f"{100 * s.coverage[kind]:.0f}" if kind in s.coverage else "–"
            if kind in s.of_bound_paired:
                cell += f"  {s.of_bound_paired[kind]:.2f}"
            cells.append(cell)
        table.add_row(kind, *cells)
    return table


@dataclass(frozen=True)
class Options:
    """Do the stated sigmas hold?"""

    scans: int = SCANS
    """Scans of each case."""
    only: tuple[GeometryName, ...] = ()
    """Geometries to run; by default all."""
    jobs: int = 1
    """Processes that share the scans; each uses the threads of its own."""
    out: Path | None = None
    """A JSON file for all numbers."""


def main(options: Options) -> list[Summary]:
    """Run the cases, print the tables, write the file."""
    cases = [case for case in CASES if not options.only or case.geometry in options.only]
    summaries = study(cases, options.scans, options.jobs)
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(overview(summaries))
    console.print(by_parameter(summaries))
    if options.out:
        content = json.dumps([asdict(summary) for summary in summaries], indent=1)
        write_atomically(options.out, content.encode() + b"\n")
    return summaries


if __name__ == "__main__":
    main(tyro.cli(Options))

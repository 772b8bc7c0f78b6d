"""Do the stated sigmas hold, and are they as small as the data allow?

Question: over five geometries, with Gaussian noise and with outliers on noise that grows with a
keypoint's scale, are errors as large as their covariance says, and no larger than the Cramer-Rao
bound?
Method: simulated scans, solved from a wrong start as `sfm-calib calibrate` solves them; the
normalised squared error (NEES) of all lens parameters and cam_from_rig a degree of freedom, how
often 95 % intervals hold the truth, and the RMSE over the bound, which is known where the noise is
Gaussian. A prior is a measurement here: its mean is drawn about the truth.
Expectation: mean NEES of 0.9 to 1.15 (heavy noise: 0.8 to 1.3), 90 to 98 % of the intervals hold
the truth, whatever the kind of parameter, and errors are at most 1.1 times the bound; more than
that by no more than chance, and no scan is refused.
Source: NEES and its chi-squared bounds: Bar-Shalom, Li, Kirubarajan, Estimation with Applications
to Tracking and Navigation, 2001, 5.4.
Run: sfm-calib run configs/studies/coverage.yaml -o out/coverage
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from experiments.coverage_summary import FEWEST_SCANS, broken, in_words, nees, summarise
from experiments.coverage_tables import by_parameter, coverage_figure, nees_figure, overview
from experiments.runner.protocol import Answer, AnswerTable, Finished, Row, Study, TrialOptions
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import Camera
from graphs.clusters import homogeneous
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.losses import SCALE_95
from graphs.model_covariance import calibration_columns
from graphs.priors import LensPrior, weak_lens_prior
from graphs.problem import Estimate, Problem
from graphs.refine import refine
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from graphs.system import assemble
from graphs.threads import threads
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

GeometryName = Literal["orbit", "handheld", "corridor", "wall", "quad"]
NoiseName = Literal["gaussian", "heavy"]

MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it
SCAN = TrackOptions(points=1500, max_points_per_image=150)
GEOMETRIES: dict[GeometryName, dict[str, object]] = {
    "orbit": {"rig": "stereo", "trajectory": "orbit"},
    "handheld": {"rig": "triple", "lens": "radtan", "trajectory": "handheld"},
    "corridor": {"rig": "stereo", "trajectory": "corridor"},
    "wall": {"rig": "mono", "trajectory": "sideways", "scene": "wall"},
    "quad": {"rig": "quad", "trajectory": "handheld"},
}
NOISES: tuple[NoiseName, ...] = ("gaussian", "heavy")


class CoverageOptions(TrialOptions):
    """One scan."""

    geometry: GeometryName = "orbit"
    """The rig, how it moves, and what it looks at."""
    noise: NoiseName = "gaussian"
    """gaussian: of one size; heavy: growing with the keypoint's scale, and with outliers."""
    sigma_px: Annotated[float, Field(ge=0.02, le=5)] = 0.5
    """Of each pixel coordinate; of the finest keypoints, where it grows."""
    outlier_share: Annotated[float, Field(ge=0, le=0.4)] = 0.05
    """Of the observations under heavy noise."""

    @property
    def case(self) -> str:
        """In few words, with what is not as usual."""
        usual = CoverageOptions()
        other = [
            f"{name} {value:g}"
            for name in ("sigma_px", "outlier_share")
            if (value := getattr(self, name)) != getattr(usual, name)
        ]
        return " ".join([self.geometry, self.noise, *other])

    @property
    def tracks(self) -> TrackOptions:
        heavy = {
            "outlier_share": self.outlier_share, "outlier_kind": "heavy", "noise_by_scale": True
        }  # fmt: skip
        update = GEOMETRIES[self.geometry] | (heavy if self.noise == "heavy" else {})
        return SCAN.model_copy(update=update | {"sigma_px": self.sigma_px})

    def rng(self, seed: int) -> np.random.Generator:
        place = list(GEOMETRIES).index(self.geometry), NOISES.index(self.noise)
        return np.random.default_rng([seed, *place])


# ---- one scan ------------------------------------------------------------------------------


def trial(options: CoverageOptions, seed: int) -> Row:
    """Simulate, calibrate and compare one scan. Raises ValueError where it is refused."""
    rng = options.rng(seed)
    problem, truth = simulate_tracks(options.tracks, rng)
    priors = tuple(measured_prior(camera, rng) for camera in truth.cameras)
    graph_options = GraphOptions(loss="cauchy", loss_scale=SCALE_95["cauchy"], lens_priors=priors)
    began = time.perf_counter()
    found = refine(problem, graph_options, MIN_PARALLAX_DEG)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, MIN_PARALLAX_DEG)
    seconds = time.perf_counter() - began
    stated, model = covariance.stated, covariance.model
    error = change(truth, found.estimate, stated.names)
    row = {
        "names": list(stated.names),
        "error": error.tolist(),
        "sigma_stated": _sigma(stated.matrix),
        "sigma_model": _sigma(model.matrix),
        "nees_stated": nees(error, stated.matrix),
        "nees_model": nees(error, model.matrix),
        "sigma_px": found.sigma_px,
        "seconds_calibrating": seconds,
    }
    if options.noise == "gaussian":
        best, bound = least_squares(problem, truth, priors, options.sigma_px)
        row |= {
            "error_efficient": best.tolist(),
            "sigma_bound": _sigma(bound),
            "nees_efficient": nees(best, bound),
        }
    return row


def _sigma(covariance: FloatArray) -> list[float]:
    sigma: list[float] = np.sqrt(np.diag(covariance)).tolist()
    return sigma


def measured_prior(camera: Camera, rng: np.random.Generator) -> LensPrior:
    """The weak prior of a true camera, off by what its sigmas say, as a measurement would be.

    A belief that is always the same leaves the same error in every scan, less than it says.
    Focal lengths, of which it knows nothing, stay; their ratio moves.
    """
    prior, mean = weak_lens_prior(camera), camera.params.copy()
    mean[1] += prior.aspect_sigma * prior.mean[0] * rng.standard_normal()
    mean[2:] += prior.sigma[2:] * rng.standard_normal(mean.size - 2)
    return replace(prior, mean=mean)


def least_squares(
    problem: Problem, truth: Estimate, priors: tuple[LensPrior, ...], sigma_px: float
) -> tuple[FloatArray, FloatArray]:
    """What least squares makes of a scan with Gaussian noise of known size, from the truth: its
    error (n,), and the Cramer-Rao bound (n, n)."""
    options = GraphOptions(sigma_px, "none", lens_priors=priors)
    graph = build(replace(problem, initial=truth), options)
    names = calibration_columns(graph, truth)[1]
    return change(truth, solve(graph)[0], names), inverse_information(graph)


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


# ---- all scans -----------------------------------------------------------------------------


def answer(trials: Sequence[Finished[CoverageOptions]]) -> Answer:
    """NEES, coverage and efficiency of each case, against what is promised."""
    summaries, refused = [], []
    for options in dict.fromkeys(one.options for one in trials):
        some = [one for one in trials if one.options == options]
        refused += [(options.case, one.seed, one.error) for one in some if one.error is not None]
        rows = [one.row for one in some if one.error is None]
        if rows:
            summaries.append(summarise(options.case, options.noise, rows, len(some) - len(rows)))
    why = AnswerTable("refused", "Scans that were refused", ("case", "seed", "why"), tuple(refused))
    tables = (why,) if refused else ()
    if not summaries:
        return Answer(f"none of {len(trials)} scans was calibrated", None, tables)
    faults = [f"{one.case}: {fault}" for one in summaries for fault in broken(one)]
    few = min(one.scans for one in summaries) < FEWEST_SCANS
    holds = None if few else not faults
    begin = "too few scans to say" if few else "no" if faults else "yes"
    also = f"; promised otherwise: {'; '.join(faults)}" if faults and not few else ""
    return Answer(
        f"{begin}: {in_words(summaries)}{also}",
        holds,
        (overview(summaries), by_parameter(summaries), *tables),
        (nees_figure(summaries), coverage_figure(summaries)),
    )


STUDY = Study(CoverageOptions, trial, answer)

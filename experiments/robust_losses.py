"""Which robust loss, at which share of outliers and which noise: what is lost, and do sigmas hold?

Method: simulated scans of a stereo rig in hand, solved from a wrong start in two ways. "library":
as `sfm-calib calibrate` does it (two rough rounds with Cauchy's loss, gross mismatches set aside at
5 sigma, a last round with the loss in question, stated covariance with the jackknife). "alone": the
same three rounds with the loss in question, nothing set aside, no jackknife: the loss has to do
it all. Noise is Gaussian or of Student's t with 3 degrees of freedom; outliers are uniform in the
image, or near the right place with heavy tails. The noise's size is estimated, or (alone) assumed
to be half or twice what it is. An error is measured by the Cramer-Rao bound of an oracle that knows
noise and outliers: rms over all lens parameters and cam_from_rig, 1 for the best there is. A scan
is broken where that exceeds 3, or where it is refused. All losses see the same scans.
Expectation: scales are chosen so that every loss keeps 95 % of the efficiency on Gaussian noise:
errors 2.6 % larger than those of least squares. In the library's way the default, Cauchy's, breaks
no scan up to 20 % of outliers, its NEES stays within 0.8 to 1.3, and no other loss is better by
more than 10 % in any condition. Alone, least squares breaks in most scans at 5 % of outliers, the
least that is tried: its breakdown point is 0.
Source: Huber, Robust Statistics, 1981; Holland and Welsch, Communications in Statistics, 1977;
Barron, CVPR 2019.
Run: sfm-calib run configs/studies/robust_losses.yaml -o out/robust_losses
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from experiments.coverage import inverse_information, measured_prior, nees
from experiments.robust_losses_answer import answer
from experiments.runner.protocol import Row, Study, TrialOptions
from experiments.standard_errors import WITHIN_95
from graphs.build import GraphOptions, build
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.losses import SCALE_95, LossChoice, LossName
from graphs.noise import adapted
from graphs.priors import LensPrior
from graphs.problem import BoolArray, Estimate, Problem
from graphs.refine import (
    FINAL_STEPS,
    ROUGH_STEPS,
    ROUND_TOLERANCES,
    Refinement,
    noise_of,
    refine,
    residuals,
)
from graphs.selection import compact, select_tracks
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from sfm_calib.simulate.keypoints import OutlierKind, with_outliers
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it
FREEDOM = 3.0  # of Student's t: it has a variance, and no fourth moment
# What an efficient estimate gains by knowing the tails: the information of a place under a t of two
# dimensions is (v + 2) / (v + 4) of a Gaussian's of the same scale (Lange, Little, Taylor 1989).
INFORMATION = {"gaussian": 1.0, "student": (FREEDOM + 2) / (FREEDOM + 4)}


class RobustLossesOptions(TrialOptions):
    """One scan by one loss."""

    loss: LossChoice = "cauchy"
    way: Literal["library", "alone"] = "library"
    """As a calibration does it, or by the loss alone, with nothing set aside."""
    outlier_share: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    outlier_kind: OutlierKind = "uniform"
    noise: Literal["gaussian", "student"] = "gaussian"
    noise_px: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Scale of each pixel coordinate's noise."""
    assumed: Annotated[float, Field(gt=0, le=100)] | None = None
    """The noise that is assumed, in units of the true one; null: estimated. Only alone."""
    frames: Annotated[int, Field(ge=5, le=200)] = 20
    points: Annotated[int, Field(ge=50, le=20_000)] = 600
    points_per_image: Annotated[int, Field(ge=10, le=2000)] = 60


@dataclass(frozen=True)
class Scan:
    """A simulated scan, and which of its observations are right."""

    problem: Problem
    truth: Estimate
    priors: tuple[LensPrior, ...]
    right: BoolArray  # (n_obs,)


def trial(options: RobustLossesOptions, seed: int) -> Row:
    """Solve one scan. Raises ValueError where it is refused."""
    scan = simulated(options, seed)
    if options.way == "library":
        if options.assumed is not None:
            raise ValueError("a calibration assumes no noise, it estimates it: give way: alone")
        solved = refine(
            scan.problem, _graph_options(options, scan), MIN_PARALLAX_DEG,
            adaptive=options.loss == "adaptive",
        )  # fmt: skip
        parallax: float | None = MIN_PARALLAX_DEG
    else:
        solved, parallax = alone(options, scan), None
    covariance = calibration_covariance(solved.graph, solved.estimate, solved.values, parallax)
    names, stated = covariance.stated.names, covariance.stated.matrix
    error = change(scan.truth, solved.estimate, names)
    return {
        "off": nees(error, bound(options, scan)) ** 0.5,
        "nees": nees(error, stated),
        "covered": float((np.abs(error) < WITHIN_95 * np.sqrt(np.diag(stated))).mean()),
        "sigma_ratio": solved.sigma_px / options.noise_px,
        "iterations": solved.iterations,
        "converged": solved.summary.converged,
        "left_out": 1 - len(solved.problem.observations) / len(scan.problem.observations),
    }


def simulated(options: RobustLossesOptions, seed: int) -> Scan:
    """A scan of the seed: the same for all losses, and noise of the same draws for all sizes."""
    rng = np.random.default_rng([seed, 0])
    tracks = TrackOptions(
        rig="stereo", trajectory="handheld", frames=options.frames, points=options.points,
        max_points_per_image=options.points_per_image, sigma_px=0.0,
    )  # fmt: skip
    problem, truth = simulate_tracks(tracks, rng)
    priors = tuple(measured_prior(camera, rng) for camera in truth.cameras)
    seen = problem.observations
    noise = np.random.default_rng([seed, 1])
    drawn = noise.standard_normal(seen.pixels.shape)
    if options.noise == "student":
        drawn /= np.sqrt(noise.chisquare(FREEDOM, (len(seen), 1)) / FREEDOM)
    noisy = seen.pixels + options.noise_px * drawn
    pixels = with_outliers(
        noisy, options.outlier_share, options.outlier_kind, tracks.size,
        np.random.default_rng([seed, 2]),
    )  # fmt: skip
    right: BoolArray = (pixels == noisy).all(1)
    return Scan(replace(problem, observations=replace(seen, pixels=pixels)), truth, priors, right)


def alone(options: RobustLossesOptions, scan: Scan) -> Refinement:
    """Three rounds as `refine` has them, by the loss in question, nothing set aside."""
    problem = select_tracks(scan.problem, MIN_PARALLAX_DEG)
    base, iterations = _graph_options(options, scan), 0
    for number, tolerance in enumerate(ROUND_TOLERANCES):
        sigma_px = noise_of(problem, base)
        if options.assumed is not None:
            sigma_px = options.assumed * options.noise_px
        weighed = replace(base, sigma_px=sigma_px)
        if options.loss == "adaptive":
            weighed = adapted(problem, weighed, residuals(problem))
        graph = build(problem, weighed)
        last = number == len(ROUND_TOLERANCES) - 1
        steps = FINAL_STEPS if last else ROUGH_STEPS
        estimate, values, summary = solve(graph, steps, tolerance)
        problem, iterations = replace(problem, initial=estimate), iterations + summary.iterations
    return Refinement(
        graph, estimate, values, summary, iterations, noise_of(problem, base), (), 0, None
    )


def bound(options: RobustLossesOptions, scan: Scan) -> FloatArray:
    """Cramer-Rao bound (n, n) of the calibration for who knows the noise and every outlier."""
    right = scan.problem.observations.subset(scan.right)
    problem = compact(replace(scan.problem, initial=scan.truth), right)
    sigma_px = options.noise_px / INFORMATION[options.noise] ** 0.5
    return inverse_information(
        build(problem, GraphOptions(sigma_px, "none", lens_priors=scan.priors))
    )


def _graph_options(options: RobustLossesOptions, scan: Scan) -> GraphOptions:
    loss: LossName = "cauchy" if options.loss == "adaptive" else options.loss
    return GraphOptions(loss=loss, loss_scale=SCALE_95[loss], lens_priors=scan.priors)


STUDY = Study(RobustLossesOptions, trial, answer)

"""A small scan of three cameras, and an earlier calibration of the rig with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import gtsam
import numpy as np

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.compare import Stated
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.joint_prior import centred_covariance, displaced, with_prior
from graphs.model_covariance import ModelCovariance, model_covariance
from graphs.prior_rig import prior_rig
from graphs.priors import weak_lens_prior
from graphs.problem import Estimate, PriorMode, PriorRig, Problem
from graphs.solve import SolveSummary, solve
from graphs.stated_covariance import factors
from sfm_calib.prior import freed, started
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

TRACKS = TrackOptions(
    rig="triple", frames=12, points=900, max_points_per_image=80, sigma_px=0.4, focal_error=0.002,
    rotation_error_deg=0.1, translation_error_m=0.005, point_error_m=0.01,
    principal_point_error_px=1.0, baseline_sigma_m=0.0,
)  # fmt: skip
MEASURED = TRACKS.model_copy(update={"baseline_sigma_m": 0.0005})
NAMES = ("cam0", "cam1", "cam2")


def scan(seed: int = 0, tracks: TrackOptions = TRACKS) -> tuple[Problem, Estimate]:
    return simulate_tracks(tracks, np.random.default_rng(seed))


@cache
def old() -> Stated:
    """In metres, with the covariance of a scan of its own."""
    found = solved(scan(5, MEASURED)[0])
    return Stated(found.estimate, found.model.covariance)


@dataclass(frozen=True)
class Solved:
    graph: CalibrationGraph
    estimate: Estimate
    values: gtsam.Values
    summary: SolveSummary
    model: ModelCovariance

    @property
    def in_unit(self) -> Estimate:
        return self.estimate.scaled(1 / self.model.unit)


def solved(problem: Problem, sigma_px: float = 0.4) -> Solved:
    graph = build(problem, options(problem, sigma_px))
    estimate, values, summary = solve(graph, 100, 1e-14)
    return Solved(graph, estimate, values, summary, model_covariance(graph, estimate, values))


def options(problem: Problem, sigma_px: float = 0.4) -> GraphOptions:
    priors = tuple(
        with_prior(camera, weak_lens_prior(camera), problem.prior)
        for camera in problem.initial.cameras
    )
    return GraphOptions(sigma_px, "none", lens_priors=priors)


def earlier(
    metric: bool = True,
    mode: PriorMode = "full",
    free: str = "all",
    stated: Stated | None = None,
) -> PriorRig:
    stated = stated or old()
    every = freed(["all"], stated.estimate.cameras, "cam0")
    held = every - freed(free.split(), stated.estimate.cameras, "cam0")
    return prior_rig(stated, NAMES, "cam0", metric, mode, held)


def drawn(prior: PriorRig, true: Estimate, rng: np.random.Generator) -> PriorRig:
    """The prior as it comes out from the truth, all of it off by its covariance."""
    root = factors(centred_covariance(prior))[0]
    return displaced(prior, true, root @ rng.standard_normal(root.shape[1]))


def with_rows(covariance: Covariance, scale: dict[str, float]) -> Covariance:
    """Some parameters' sigmas multiplied, and correlated with none."""
    alone = np.array([name in scale for name in covariance.names])
    by = np.array([scale.get(name, 1.0) for name in covariance.names])
    matrix = np.where(alone[:, None] | alone, 0.0, covariance.matrix)
    matrix[alone, alone] = (np.diag(covariance.matrix) * by**2)[alone]
    return Covariance(covariance.names, matrix)


def recalibrated(problem: Problem, prior: PriorRig, sigma_px: float = 0.4) -> Solved:
    return solved(started(problem, prior), sigma_px)


def sigmas(matrix: FloatArray) -> FloatArray:
    return np.sqrt(np.maximum(np.diag(matrix), 0.0))

"""From a Problem to a factor graph and a start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import gtsam
import numpy as np

from graphs import reference
from graphs.frames import to_gtsam_inverse
from graphs.gauge import add_gauge
from graphs.keys import frame_key, lens_key, point_key, rig_key
from graphs.priors import LensPrior, RigPrior, weak_lens_prior
from graphs.problem import Problem

NO_KNOWLEDGE = 1e6  # in place of an infinite sigma, which GTSAM does not take
LossName = Literal["cauchy", "huber", "none"]


@dataclass(frozen=True)
class GraphOptions:
    """How observations are weighed and what is believed beforehand."""

    sigma_px: float = 1.0  # of one pixel coordinate
    loss: LossName = "cauchy"
    loss_scale: float = 2.385  # in sigmas; Cauchy's 95 % efficiency on Gaussian noise
    lens_priors: tuple[LensPrior, ...] = ()  # one a camera; empty: the weak ones
    rig_priors: dict[int, RigPrior] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationGraph:
    """A problem with its factors: observations first, in their order, then everything else."""

    problem: Problem
    options: GraphOptions
    lens_priors: tuple[LensPrior, ...]
    factors: gtsam.NonlinearFactorGraph
    initial: gtsam.Values


def build(problem: Problem, options: GraphOptions) -> CalibrationGraph:
    """Observation, prior and gauge factors over lenses, cam_from_rig, frames and points.

    Raises ValueError when the scene has no size (every image taken from one point), and when a
    camera has no observation.
    """
    cameras = problem.initial.cameras
    _check_every_camera_sees(problem)
    priors = options.lens_priors or tuple(weak_lens_prior(camera) for camera in cameras)
    factors = gtsam.NonlinearFactorGraph()
    reference.add_observations(factors, problem, observation_noise(options))
    for index, (camera, prior) in enumerate(zip(cameras, priors, strict=True)):
        factors.add(reference.lens_prior_factor(index, camera, prior))
    for index, rig_prior in options.rig_priors.items():
        factors.add(_rig_prior_factor(index, rig_prior))
    add_gauge(factors, problem)
    return CalibrationGraph(problem, options, priors, factors, initial_values(problem))


def _check_every_camera_sees(problem: Problem) -> None:
    counts = np.bincount(problem.observations.camera, minlength=len(problem.initial.cameras))
    for camera, count in zip(problem.initial.cameras, counts, strict=True):
        if count == 0:
            raise ValueError(
                f"{camera.name} sees none of the {len(problem.initial.points)} points that are "
                "consistent between views: check that its images belong to these frames, and let "
                "it see textured things from several places"
            )


def observation_noise(options: GraphOptions) -> gtsam.noiseModel.Base:
    """Isotropic pixel noise under the chosen robust loss."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, options.sigma_px)
    if options.loss == "none":
        return noise
    estimators = {
        "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
        "huber": gtsam.noiseModel.mEstimator.Huber,
    }
    return gtsam.noiseModel.Robust.Create(
        estimators[options.loss].Create(options.loss_scale), noise
    )


def _rig_prior_factor(camera: int, prior: RigPrior) -> gtsam.NonlinearFactor:
    sigmas = np.array([prior.sigma_rotation] * 3 + [prior.sigma_translation] * 3)
    sigmas = np.minimum(sigmas, NO_KNOWLEDGE)
    pose = to_gtsam_inverse(prior.cam_from_rig)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas, reference.NOT_SMART)
    return gtsam.PriorFactorPose3(rig_key(camera), pose, noise)


def initial_values(problem: Problem) -> gtsam.Values:
    """Every variable of the problem at its start."""
    values = gtsam.Values()
    start = problem.initial
    for index, camera in enumerate(start.cameras):
        values.insert(lens_key(index), reference.native_lens(camera))
        values.insert(rig_key(index), to_gtsam_inverse(start.cam_from_rig[index]))
    for index, rig_from_world in enumerate(start.rig_from_world):
        values.insert(frame_key(index), to_gtsam_inverse(rig_from_world))
    for index, point in enumerate(start.points):
        values.insert(point_key(index), point)
    return values

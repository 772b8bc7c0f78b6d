"""How large the pixel noise is, and what the robust loss does to a covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.problem import Problem

# Median of the norm of a 2-D Gaussian of unit sigma (Rayleigh): sqrt(2 ln 2).
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))


def free_dimensions(problem: Problem) -> int:
    """How many numbers the observations have to determine: unknowns less gauge."""
    start = problem.initial
    lenses = sum(camera.params.size for camera in start.cameras)
    gauge = 7 if problem.scale is None else 6
    rig = 6 * (len(start.cameras) - 1)
    return lenses + rig + 6 * len(start.rig_from_world) + 3 * len(start.points) - gauge


def redundancy(problem: Problem) -> float:
    """Share of the measured coordinates left after the unknowns took theirs, in (0, 1]."""
    measured = 2 * len(problem.observations)
    return max(measured - free_dimensions(problem), 1) / measured


def robust_sigma_px(problem: Problem, residuals: FloatArray) -> float:
    """Sigma of one pixel coordinate from residuals (n_obs, 2), by their median length.

    Half of the observations may be wild. Fitting shrinks residuals; the redundancy undoes it.
    """
    norms = np.linalg.norm(residuals[np.isfinite(residuals).all(1)], axis=1)
    return float(np.median(norms) / RAYLEIGH_MEDIAN / np.sqrt(redundancy(problem)))


@dataclass(frozen=True)
class LossMoments:
    """What an M-estimator's weights do to its covariance (Huber, Robust Statistics, 1981, 7.6)."""

    curvature: float  # true curvature of the loss over the weight used in its place
    variance_factor: float  # of the data's information: 1 when noise and loss are as assumed


def loss_moments(problem: Problem, options: GraphOptions, residuals: FloatArray) -> LossMoments:
    """Curvature and variance factor of the loss at the residuals (n_obs, 2) of the optimum."""
    r = np.linalg.norm(residuals[np.isfinite(residuals).all(1)], axis=1) / options.sigma_px
    weight, slope = loss_weight_and_slope(options, r)
    curvature = float(np.mean((slope + weight) / 2) / np.mean(weight))
    score = float(np.mean((weight * r) ** 2) / 2 / redundancy(problem))
    return LossMoments(curvature, score / float(np.mean(weight)) / curvature**2)


def loss_weight_and_slope(options: GraphOptions, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """psi(r) / r and psi'(r) of the loss for whitened residual lengths r (n,)."""
    k = options.loss_scale
    if options.loss == "cauchy":
        weight = 1 / (1 + (r / k) ** 2)
        return weight, weight**2 * (1 - (r / k) ** 2)
    if options.loss == "huber":
        inside = r <= k
        return np.where(inside, 1.0, k / np.maximum(r, k)), np.where(inside, 1.0, 0.0)
    return np.ones_like(r), np.ones_like(r)

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
    """What an M-estimator's weights do to its covariance (Huber, Robust Statistics, 1981, 7.6).

    With H the weighted information of the data and P that of the priors, the cost has the
    Hessian c H + P and its gradient the covariance s H + P.
    """

    curvature: float  # c: true curvature of the loss over the weight used in its place
    score_variance: float  # s: both are 1 for Gaussian noise of the assumed sigma and no loss
    refit: float  # already in s: squared scores of the noise over those of the residuals


def loss_moments(problem: Problem, options: GraphOptions, residuals: FloatArray) -> LossMoments:
    """Curvature and score variance of the loss at the residuals (n_obs, 2) of the optimum."""
    r = np.linalg.norm(residuals[np.isfinite(residuals).all(1)], axis=1) / options.sigma_px
    weight, slope = loss_weight_and_slope(options, r)
    mean, apart = (slope + weight) / 2, (slope - weight) / 2  # curvature along and across
    curvature = float(np.mean(mean))
    scatter = float(np.mean(mean**2 + apart**2 / 2)) - curvature**2
    left = redundancy(problem)
    refit = (1 + (1 - left) * scatter / curvature**2) ** 2 / left  # Huber's K^2 n / (n - p)
    score, used = float(np.mean((weight * r) ** 2) / 2), float(np.mean(weight))
    return LossMoments(curvature / used, refit * score / used, refit)


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

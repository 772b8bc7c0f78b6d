"""How large the pixel noise is, and what the robust loss does to a covariance."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.losses import weight_and_slope
from graphs.problem import KnownSpan, Problem

# Median of the norm of a 2-D Gaussian of unit sigma (Rayleigh): sqrt(2 ln 2).
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
# Perfect data has no noise; weights need a scale above rounding.
SMALLEST_SIGMA_PX = 1e-3


def free_dimensions(problem: Problem) -> int:
    """How many numbers the observations have to determine: unknowns less gauge."""
    start, seen = problem.initial, problem.observations
    frames, points = len(np.unique(seen.frame)), len(np.unique(seen.point))
    lenses = sum(camera.params.size for camera in start.cameras)
    gauge = 7 if problem.scale is None else 6
    rig = 6 * (len(start.cameras) - 1)
    return lenses + rig + 6 * frames + 3 * points - gauge


def redundancy(problem: Problem) -> float:
    """Share of the measured coordinates left after the unknowns took theirs, in (0, 1]."""
    measured = 2 * len(problem.observations)
    return max(measured - free_dimensions(problem), 1) / measured


def robust_sigma_px(problem: Problem, residuals: FloatArray) -> float:
    """Sigma of one pixel coordinate from residuals (n_obs, 2), by their median length.

    Of an observation whose relative sigma is 1. Half of the observations may be wild. Fitting
    shrinks residuals; the redundancy undoes it.
    """
    lengths = residual_lengths(problem, residuals)
    median = float(np.median(lengths[np.isfinite(lengths)]))
    return float(median / RAYLEIGH_MEDIAN / np.sqrt(redundancy(problem)))


def residual_lengths(problem: Problem, residuals: FloatArray) -> FloatArray:
    """Lengths (n_obs,) of residuals (n_obs, 2) in px, over their relative sigmas."""
    relative = problem.observations.relative_sigma
    lengths: FloatArray = np.linalg.norm(residuals, axis=1)
    return lengths if relative is None else lengths / relative


def with_click_sigma(problem: Problem, sigma_px: float) -> Problem:
    """The problem with the ends of a KnownSpan weighed by the sigma that is stated of them.

    sigma_px: of all other observations. Where it is larger it holds for clicks too: what it is
    made of, such as a lens that does not fit, spares none of them.
    """
    scale, seen = problem.scale, problem.observations
    if not isinstance(scale, KnownSpan) or scale.click_sigma_px is None:
        return problem
    relative = np.ones(len(seen)) if seen.relative_sigma is None else seen.relative_sigma.copy()
    relative[np.isin(seen.point, scale.points)] = max(scale.click_sigma_px / sigma_px, 1.0)
    return replace(problem, observations=replace(seen, relative_sigma=relative))


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
    lengths = residual_lengths(problem, residuals)
    r = lengths[np.isfinite(lengths)] / options.sigma_px
    weight, slope = weight_and_slope(options.loss, options.loss_scale, r)
    mean, apart = (slope + weight) / 2, (slope - weight) / 2  # curvature along and across
    curvature = float(np.mean(mean))
    scatter = float(np.mean(mean**2 + apart**2 / 2)) - curvature**2
    left = redundancy(problem)
    refit = (1 + (1 - left) * scatter / curvature**2) ** 2 / left  # Huber's K^2 n / (n - p)
    score, used = float(np.mean((weight * r) ** 2) / 2), float(np.mean(weight))
    return LossMoments(curvature / used, refit * score / used, refit)


MOST_FREEDOM = 100.0  # a Student t of so many degrees of freedom is a Gaussian
LEAST_FREEDOM = 1.0  # below Cauchy's own distribution no mean exists


def student_t(lengths: FloatArray, iterations: int = 100) -> tuple[float, float]:
    """Scale and degrees of freedom of the bivariate Student t that residuals suit best.

    lengths (n,): of residuals, in any unit. Maximum likelihood by expectation-maximisation
    (Lange, Little and Taylor, JASA 1989). Its negative logarithm is a Cauchy loss of scale
    sqrt(freedom + 2) on residuals in units of `scale` sqrt(freedom / (freedom + 2)).
    """
    s = lengths[np.isfinite(lengths)] ** 2
    scale2, freedom = max(float(np.median(s)) / RAYLEIGH_MEDIAN**2, SMALLEST_SIGMA_PX**2), 4.0
    for _ in range(iterations):
        before = scale2, freedom
        weight = (freedom + 2) / (freedom + s / scale2)
        scale2 = max(float(np.mean(weight * s)) / 2, 1e-300)
        freedom = _freedom(s / scale2)
        if np.allclose(before, (scale2, freedom), rtol=1e-6, atol=0):
            break
    return scale2**0.5, freedom


def _freedom(s: FloatArray) -> float:
    """Degrees of freedom that make squared lengths, in units of the scale, most likely."""

    def unlikely(log_freedom: float) -> float:
        # of the bivariate t the constant is 1 / (2 pi), whatever its freedom
        freedom = np.exp(log_freedom)
        return float((freedom + 2) / 2 * np.mean(np.log1p(s / freedom)))

    bounds = (np.log(LEAST_FREEDOM), np.log(MOST_FREEDOM))
    return float(np.exp(minimize_scalar(unlikely, bounds=bounds, method="bounded").x))


def adapted(problem: Problem, options: GraphOptions, residuals: FloatArray) -> GraphOptions:
    """Options with the noise and loss of the Student t that residuals (n_obs, 2) suit best."""
    scale, freedom = student_t(residual_lengths(problem, residuals))
    scale /= redundancy(problem) ** 0.5
    return replace(
        options,
        sigma_px=max(scale * (freedom / (freedom + 2)) ** 0.5, SMALLEST_SIGMA_PX),
        loss="cauchy",
        loss_scale=(freedom + 2) ** 0.5,
    )

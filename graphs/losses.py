"""Robust losses of a whitened squared residual length: cost and weight.

Conventions and names as GTSAM's `noiseModel.mEstimator`: cost rho(r), weight rho'(r) / r, so that
`none` costs r^2 / 2. References: Huber, Robust Statistics, 1981; Barron, CVPR 2019.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numba import njit

from graphs.frames import FloatArray

LossName = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure"]
LOSS_NAMES: tuple[LossName, ...] = get_args(LossName)
LOSS_INDEX: dict[LossName, int] = {name: index for index, name in enumerate(LOSS_NAMES)}

# "adaptive" is Cauchy's with a scale estimated from the residuals: see `noise.student_t`.
LossChoice = Literal["none", "huber", "cauchy", "tukey", "geman_mcclure", "adaptive"]

# Scales, in sigmas, at which the estimate keeps 95 % of the efficiency of least squares on
# Gaussian noise of two dimensions (for one dimension they are 1.345, 2.385, 4.685).
SCALE_95: dict[LossName, float] = {
    "none": np.inf,
    "huber": 1.501,
    "cauchy": 2.549,
    "tukey": 5.123,
    "geman_mcclure": 4.096,
}
# The cost of an observation whose point cannot be projected: as if this far off.
INVALID_SIGMAS = 1e4


# Newton's method needs the loss's curvature along a residual, which may be negative; so much of
# the weight is kept.
LEAST_CURVATURE = 0.1


@njit(nogil=True)
def cost_weight_bend(loss: int, scale: float, s: float) -> tuple[float, float, float]:
    """rho, weight rho' / r, and (rho'' / weight - 1) / s at s = r^2, r in sigmas."""
    k2 = scale * scale
    if loss == 1 and s > k2:
        r = np.sqrt(s)
        return scale * (r - 0.5 * scale), scale / r, -1.0 / s
    if loss == 2:
        return 0.5 * k2 * np.log1p(s / k2), k2 / (k2 + s), -2.0 / (k2 + s)
    if loss == 3:
        if s >= k2:
            return k2 / 6.0, 0.0, 0.0
        left = 1.0 - s / k2
        return k2 / 6.0 * (1.0 - left * left * left), left * left, -4.0 / (k2 - s)
    if loss == 4:
        inside = k2 / (k2 + s)
        return 0.5 * s * inside, inside * inside, -4.0 / (k2 + s)
    return 0.5 * s, 1.0, 0.0


@njit(cache=True, nogil=True)
def weigh_many(
    loss: int,
    scale: float,
    projected: FloatArray,  # (n, 2), NaN where it was refused
    observed: FloatArray,  # (n, 2)
    root_information: FloatArray,  # (n, 3) upper triangles by rows
    residuals: FloatArray,  # out (n, 2), whitened, without the loss's weight
    weights: FloatArray,  # out (n,)
    bends: FloatArray,  # out (n,): along a residual r the curvature is weight (1 + bend r^2)
    costs: FloatArray,  # out (n,)
) -> None:
    """Whitened residuals, IRLS weights and costs; a refused projection weighs nothing."""
    for i in range(len(costs)):
        r0 = projected[i, 0] - observed[i, 0]
        r1 = projected[i, 1] - observed[i, 1]
        r0 = root_information[i, 0] * r0 + root_information[i, 1] * r1
        r1 = root_information[i, 2] * r1
        s = r0 * r0 + r1 * r1
        if s < np.inf:
            residuals[i, 0], residuals[i, 1] = r0, r1
            costs[i], weights[i], bend = cost_weight_bend(loss, scale, s)
            bends[i] = max(bend, (LEAST_CURVATURE - 1.0) / max(s, 1e-300))
        else:
            residuals[i, 0], residuals[i, 1], weights[i], bends[i] = 0.0, 0.0, 0.0, 0.0
            costs[i] = cost_weight_bend(loss, scale, INVALID_SIGMAS**2)[0]


def weight_and_slope(loss: LossName, scale: float, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """rho'(r) / r and rho''(r) for whitened residual lengths r (n,)."""
    s, k2 = r * r, scale * scale
    if loss == "huber":
        core = r <= scale
        return np.where(core, 1.0, scale / np.maximum(r, scale)), np.where(core, 1.0, 0.0)
    if loss == "cauchy":
        weight = k2 / (k2 + s)
        return weight, weight**2 * (1 - s / k2)
    if loss == "tukey":
        left = np.maximum(1 - s / k2, 0.0)
        return left**2, left * (1 - 5 * s / k2) * (left > 0)
    if loss == "geman_mcclure":
        inside = k2 / (k2 + s)
        return inside**2, inside**3 * (1 - 3 * s / k2)
    return np.ones_like(r), np.ones_like(r)

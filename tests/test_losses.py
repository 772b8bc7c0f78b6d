"""Losses against GTSAM's, and their slopes against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from scipy.integrate import quad

from graphs.frames import FloatArray
from graphs.losses import (
    INVALID_SIGMAS,
    LEAST_CURVATURE,
    LOSS_INDEX,
    LOSS_NAMES,
    SCALE_95,
    LossName,
    cost_weight_bend,
    weigh_many,
    weight_and_slope,
)

NATIVE = {
    "none": lambda k: gtsam.noiseModel.mEstimator.Null.Create(),
    "huber": gtsam.noiseModel.mEstimator.Huber.Create,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy.Create,
    "tukey": gtsam.noiseModel.mEstimator.Tukey.Create,
    "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure.Create,
}
SCALES = (0.3, 1.345, 4.685)
LENGTHS = np.concatenate([[0.0], np.geomspace(1e-6, 1e4, 101)])


def weighed(
    loss: LossName, scale: float, projected: FloatArray, sigma_px: float = 1.0
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Whitened residuals (n, 2), weights, bends and costs (n,) of pixels observed at (7, 5)."""
    n = len(projected)
    residuals, weights, bends, costs = np.empty((n, 2)), np.empty(n), np.empty(n), np.empty(n)
    observed, root = np.tile([7.0, 5.0], (n, 1)), np.tile([1.0, 0.0, 1.0], (n, 1)) / sigma_px
    weigh_many(LOSS_INDEX[loss], scale, projected, observed, root, residuals, weights, bends, costs)
    return residuals, weights, bends, costs


def pixels_at(lengths: FloatArray) -> FloatArray:
    """Pixels (n, 2) so far off the observed one, in a direction along no axis."""
    return lengths[:, None] * [0.6, -0.8] + [7.0, 5.0]


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_cost_and_weight_are_gtsams(loss: LossName, scale: float) -> None:
    native = NATIVE[loss](scale)
    residuals, weights, _, costs = weighed(loss, scale, pixels_at(LENGTHS))
    for r, ours, weight, cost in zip(LENGTHS, residuals, weights, costs, strict=True):
        assert np.linalg.norm(ours) == pytest.approx(r, rel=1e-12, abs=1e-14)
        if loss == "tukey" and abs(r - scale) < 1e-9:
            continue
        assert weight == pytest.approx(native.weight(r), rel=1e-9, abs=1e-12)
        assert cost == pytest.approx(native.loss(r), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_residuals_are_in_sigmas(loss: LossName) -> None:
    ours = weighed(loss, 2.0, pixels_at(0.5 * LENGTHS), sigma_px=0.5)
    for a, b in zip(ours, weighed(loss, 2.0, pixels_at(LENGTHS)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    residuals = weighed(loss, 2.0, np.array([[7.5, 4.0]]), sigma_px=0.5)[0]
    np.testing.assert_allclose(residuals, [[1.0, -2.0]])  # projected minus observed


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_the_bend_is_the_curvature_along_the_residual(loss: LossName, scale: float) -> None:
    """rho'' = weight (1 + bend r^2)."""
    index, native = LOSS_INDEX[loss], NATIVE[loss](scale)
    for r in (0.1, 0.7, 0.99, 1.01, 2.0, 3.0, 10.0):
        if loss == "tukey" and r > 4:
            continue
        length, h = r * scale, 1e-4 * scale
        _, weight, bend = cost_weight_bend(index, scale, length**2)
        ends = [native.loss(length + d) for d in (h, 0.0, -h)]
        curvature = (ends[0] - 2 * ends[1] + ends[2]) / h**2
        assert weight * (1 + bend * length**2) == pytest.approx(curvature, rel=1e-4, abs=1e-5)


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_newtons_curvature_stays_positive(loss: LossName) -> None:
    lengths = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 60)])
    _, weights, bends, _ = weighed(loss, 2.0, pixels_at(lengths))
    left = 1 + bends * lengths**2
    assert (left >= LEAST_CURVATURE * (1 - 1e-9)).all() and (left <= 1).all()
    for length, weight, share in zip(lengths, weights, left, strict=True):
        bend = cost_weight_bend(LOSS_INDEX[loss], 2.0, length**2)[2]
        if weight > 0 and 1 + bend * length**2 > LEAST_CURVATURE:
            assert share == pytest.approx(1 + bend * length**2, rel=1e-12)


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_what_cannot_be_projected_weighs_nothing_and_costs_as_if_far_off(loss: LossName) -> None:
    projected = np.array([[np.nan, np.nan], [np.inf, 3.0], [7.0, np.nan], [1e200, 5.0]])
    residuals, weights, bends, costs = weighed(loss, 2.0, projected)
    assert not residuals.any() and not weights.any() and not bends.any()
    np.testing.assert_allclose(costs, NATIVE[loss](2.0).loss(INVALID_SIGMAS), rtol=1e-12)


@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_costs_grow_with_the_residual(loss: LossName) -> None:
    costs = weighed(loss, 2.0, pixels_at(np.geomspace(1e-3, INVALID_SIGMAS, 300)))[3]
    assert (np.diff(costs) >= 0).all()
    assert costs[-1] == pytest.approx(weighed(loss, 2.0, np.full((1, 2), np.nan))[3][0])


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("loss", LOSS_NAMES)
def test_weight_and_slope_by_finite_differences(loss: LossName, scale: float) -> None:
    """Of GTSAM's costs: rho' / r and rho''."""
    native, h = NATIVE[loss](scale), 1e-4 * scale
    r = scale * np.array([0.1, 0.7, 0.98, 1.02, 2.0, 3.0, 10.0])
    ahead, here, behind = (np.array([native.loss(x + d) for x in r]) for d in (h, 0.0, -h))
    weight, slope = weight_and_slope(loss, scale, r)
    np.testing.assert_allclose(weight, (ahead - behind) / (2 * h) / r, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(slope, (ahead - 2 * here + behind) / h**2, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("loss", [name for name in LOSS_NAMES if name != "none"])
def test_the_scales_keep_95_per_cent_of_the_efficiency(loss: LossName) -> None:
    """E[psi']^2 / E[psi^2] of one coordinate over Gaussian noise of two, by quadrature."""
    scale = SCALE_95[loss]

    def mean(of: Callable[[float, float, float], float]) -> float:
        """Of a function of r, weight and slope, over a Rayleigh length r."""

        def density(r: float) -> float:
            weight, slope = weight_and_slope(loss, scale, np.array([r]))
            return of(r, float(weight[0]), float(slope[0])) * r * np.exp(-r * r / 2)

        return quad(density, 0, 12, points=[scale], limit=200)[0]

    curvature = mean(lambda r, weight, slope: (slope + weight) / 2)
    score = mean(lambda r, weight, slope: (weight * r) ** 2 / 2)
    assert curvature**2 / score == pytest.approx(0.95, abs=1e-3)

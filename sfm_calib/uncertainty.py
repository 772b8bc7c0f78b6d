"""The result's `uncertainty`: its covariance in pixels of projection and in depth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from graphs import uncertainty
from graphs.covariance import Covariance
from graphs.problem import Estimate
from graphs.uncertainty import ProjectionMap
from sfm_calib import result

Unit = Literal["m", "baseline"]
# Arm's length to across a street, for rigs of 5 cm to half a metre; the same in baselines of 0.2 m.
RANGES: dict[Unit, tuple[float, ...]] = {"m": (1, 2, 5, 10), "baseline": (5, 10, 20, 50)}
# Of perfect data, in place of zero: a depth then ends with the calibration, not with rounding.
LEAST_SIGMA_PX = 1e-3


def uncertainty_of(
    estimate: Estimate, covariance: Covariance, sigma_px: float | None, unit: Unit | None
) -> result.Uncertainty:
    """The record, at RANGES; estimate and covariance both in the result's unit of length.

    covariance: the stated one. sigma_px: noise of one pixel coordinate; without, no depths.
    unit: "m", "baseline" (of the longest, 1 long) or None where lengths have no unit: then only
    directions are told, at infinity, and no depth is.
    """
    ranges = RANGES[unit] if unit else ()
    sigma_px = None if unit is None or sigma_px is None else max(sigma_px, LEAST_SIGMA_PX)
    return result.Uncertainty(
        unit=unit,
        sigma_px=sigma_px,
        projection=_projection(estimate, covariance, ranges),
        depth=()
        if sigma_px is None
        else tuple(
            _depth(estimate, covariance, pair, ranges, sigma_px)
            for pair in uncertainty.pairs(estimate)
        ),
    )


def unit_of(calibration: result.Calibration) -> Unit | None:
    """What the lengths of a result are counted in; None for one camera, and without any unit."""
    lengths = [np.linalg.norm(t.translation) for t in calibration.rig.cam_from_rig.values()]
    if len(lengths) < 2:
        return None
    if calibration.rig.metric:
        return "m"
    # Without scale the longest is 1 long by definition, else nothing gave a unit.
    return "baseline" if np.isclose(max(lengths), 1.0, rtol=1e-6) else None


def _projection(
    estimate: Estimate, covariance: Covariance, ranges: Sequence[float]
) -> dict[str, tuple[result.ProjectionSigma, ...]]:
    maps = list(uncertainty.projection_maps(estimate, covariance))
    told = [_told("camera", one) for one in maps]
    if len(estimate.cameras) > 1:
        for distance in (*ranges, np.inf):
            of_rig = uncertainty.projection_maps(estimate, covariance, distance, "rig")
            told += [_told("rig", one) for one in of_rig]
            maps += of_rig
    return {
        camera.name: tuple(one for one, of in zip(told, maps, strict=True) if of.camera == index)
        for index, camera in enumerate(estimate.cameras)
    }


def _told(relative_to: uncertainty.RelativeTo, of: ProjectionMap) -> result.ProjectionSigma:
    return result.ProjectionSigma(
        relative_to=relative_to,
        range=of.range if np.isfinite(of.range) else None,
        centre_px=of.centre_px,
        rms_px=of.rms_px,
        corner_px=of.corner_px,
    )


def _depth(
    estimate: Estimate,
    covariance: Covariance,
    pair: tuple[int, int],
    ranges: Sequence[float],
    sigma_px: float,
) -> result.PairDepth:
    far_and_near = uncertainty.curve_ranges(estimate, pair)
    curve = uncertainty.depth_sigma(estimate, covariance, pair, far_and_near, sigma_px)
    at = uncertainty.depth_sigma(estimate, covariance, pair, np.array(ranges), sigma_px)
    common = bool(curve.in_view.any() or at.in_view.any())
    told = [
        result.DepthSigma(range=distance, sigma_noise=noise, sigma_calibration=calibration)
        if np.isfinite(noise)
        else result.DepthSigma(
            range=distance, missing="not determined" if seen else "not in both images"
        )
        for distance, seen, noise, calibration in zip(
            ranges, at.in_view, at.sigma_noise, at.sigma_calibration, strict=True
        )
    ]
    first, second = (estimate.cameras[camera].name for camera in pair)
    return result.PairDepth(
        cameras=(first, second),
        baseline=curve.baseline,
        common_view=common,
        determined_to=curve.determined_to if common else None,
        depth=tuple(told) if common else (),
    )

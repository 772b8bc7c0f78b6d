"""What an old calibration contributed to a new one, parameter by parameter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from graphs.camera import Camera
from graphs.compare import Stated
from graphs.covariance import Covariance
from graphs.frames import Transform, log_rotation
from graphs.joint_prior import shares_of_prior
from graphs.problem import PriorRig
from graphs.propagation import lens_names, pose_names
from sfm_calib.recalibration_record import Contribution


def contributions_of(
    prior: PriorRig, best: Stated, alone: Stated, model: Covariance, metric: bool
) -> dict[str, Contribution]:
    """Of every parameter that the old calibration and the result have in one frame and unit.

    best: the result; alone: the scan's own; model: the result's covariance of noise and priors,
    without what errs together. Rotations are rotation vectors, in rad.
    """
    shares = shares_of_prior(prior, model, metric)
    unit = 1.0 if metric else _unit_of(prior, best)
    was = dict(_values(prior.cameras, [place.scaled(unit) for place in prior.cam_from_rig]))
    results, others = (
        dict(_values(side.estimate.cameras, side.estimate.cam_from_rig)) for side in (best, alone)
    )
    sigma_old, sigma = prior.covariance.sigma, best.covariance.sigma
    origin = set(pose_names(prior.reference))
    return {
        name: Contribution(
            old=value,
            sigma_old=_scaled(sigma_old.get(name), unit if _is_length(name) else 1.0),
            new_alone=others[name],
            result=results[name],
            sigma=sigma.get(name, 0.0),
            prior_share=1.0 if name in prior.held else shares.get(name, 0.0),
        )
        for name, value in was.items()
        if name in results
        and name not in origin
        and (prior.metric == metric or not _is_length(name))
    }


def _is_length(name: str) -> bool:
    return ".translation_" in name


def _scaled(sigma: float | None, by: float) -> float | None:
    return None if sigma is None else by * sigma


def _unit_of(prior: PriorRig, best: Stated) -> float:
    """How long a prior's unit of length is in the result's, by the camera farthest out."""
    placed = {
        camera.name: place.translation
        for camera, place in zip(best.estimate.cameras, best.estimate.cam_from_rig, strict=True)
    }
    lengths = {
        camera.name: float(np.linalg.norm(place.translation))
        for camera, place in zip(prior.cameras, prior.cam_from_rig, strict=True)
    }
    far = max(lengths, key=lambda name: lengths[name])
    return float(np.linalg.norm(placed[far])) / lengths[far] if lengths[far] > 0 else 1.0


def _values(cameras: Sequence[Camera], places: Sequence[Transform]) -> Iterator[tuple[str, float]]:
    for camera, place in zip(cameras, places, strict=True):
        yield from zip(lens_names(camera), camera.params.tolist(), strict=True)
        values = [*log_rotation(place.rotation).tolist(), *place.translation.tolist()]
        yield from zip(pose_names(camera.name), values, strict=True)

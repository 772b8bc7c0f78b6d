"""A result with another covariance of its parameters: sigmas and what follows from them."""

from __future__ import annotations

import numpy as np

from graphs.covariance import Covariance
from graphs.problem import Estimate
from graphs.propagation import pose_names
from sfm_calib import result
from sfm_calib.uncertainty import uncertainty_of, unit_of


def restated(calibration: result.Calibration, covariance: Covariance) -> result.Calibration:
    """The same result, its covariance being this, in its frame and unit."""
    if covariance.names == calibration.covariance.names and np.array_equal(
        covariance.matrix, np.array(calibration.covariance.matrix)
    ):
        return calibration
    sigma = covariance.sigma
    names = tuple(calibration.cameras)
    estimate = Estimate(
        tuple(calibration.camera(name) for name in names),
        tuple(calibration.cam_from_rig(name) for name in names),
        (),
        np.zeros((0, 3)),
    )
    changed: dict[str, object] = {
        "cameras": {
            name: camera.model_copy(
                update={"sigma": {p: sigma.get(f"{name}.{p}", 0.0) for p in camera.params}}
            )
            for name, camera in calibration.cameras.items()
        },
        "rig": _rig(calibration.rig, sigma),
        "covariance": result.Covariance(
            names=covariance.names, matrix=tuple(map(tuple, covariance.matrix.tolist()))
        ),
    }
    if calibration.uncertainty is not None:
        changed["uncertainty"] = uncertainty_of(
            estimate, covariance, calibration.uncertainty.sigma_px, unit_of(calibration)
        )
    if calibration.noise is not None:
        sigmas = {
            name: one.model_copy(update={"stated": sigma[name]})
            for name, one in calibration.noise.sigmas.items()
        }
        changed["noise"] = calibration.noise.model_copy(update={"sigmas": sigmas})
    return calibration.model_copy(update=changed)


def _rig(rig: result.RigResult, sigma: dict[str, float]) -> result.RigResult:
    placed = {}
    for name, transform in rig.cam_from_rig.items():
        x, y, z, *move = (sigma.get(of, 0.0) for of in pose_names(name))
        turn = tuple(np.degrees([x, y, z]).tolist())
        placed[name] = transform.model_copy(
            update={"sigma_rotation_deg": turn, "sigma_translation": tuple(move)}
        )
    return rig.model_copy(update={"cam_from_rig": placed})

"""The unit of length of a result whose scan had none: the rig's own longest baseline."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.problem import Estimate

# A baseline that is not ten of its own sigmas long gives no unit.
MIN_BASELINE_SIGMAS = 10.0


def baseline_unit(estimate: Estimate, reference: int, covariance: Covariance) -> int | None:
    """The camera farthest from the reference, or None when that distance is not determined."""
    lengths = [float(np.linalg.norm(t.translation)) for t in estimate.cam_from_rig]
    far = int(np.argmax(lengths))
    if far == reference or lengths[far] <= 0:
        return None
    name = estimate.cameras[far].name
    sigma = [covariance.sigma[f"{name}.translation_{axis}"] for axis in "xyz"]
    return far if lengths[far] > MIN_BASELINE_SIGMAS * float(np.linalg.norm(sigma)) else None


def unit_jacobian(names: Sequence[str], estimate: Estimate, far: int) -> FloatArray:
    """Derivative (n, n) of parameters, translations over camera `far`'s length, by themselves.

    d(t / |b|) = dt / |b| - t (b . db) / |b|^3 for each camera's t, with b that of `far`.
    """
    index = {name: place for place, name in enumerate(names)}
    b = estimate.cam_from_rig[far].translation
    length = float(np.linalg.norm(b))
    jacobian = np.eye(len(index))
    of_far = [index[f"{estimate.cameras[far].name}.translation_{axis}"] for axis in "xyz"]
    for camera, transform in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        if f"{camera.name}.translation_x" not in index:
            continue
        rows = [index[f"{camera.name}.translation_{axis}"] for axis in "xyz"]
        jacobian[np.ix_(rows, rows)] /= length
        jacobian[np.ix_(rows, of_far)] -= np.outer(transform.translation, b) / length**3
    return jacobian


def in_unit_baseline(covariance: Covariance, estimate: Estimate, far: int) -> Covariance:
    """The covariance of translations divided by the length of camera `far`'s translation."""
    jacobian = unit_jacobian(covariance.names, estimate, far)
    return Covariance(covariance.names, jacobian @ covariance.matrix @ jacobian.T)

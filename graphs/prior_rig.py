"""From a calibration that was read to the earlier one that a problem is given."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphs.compare import Stated
from graphs.covariance import NOTHING, Covariance
from graphs.frames import FloatArray
from graphs.pose_covariance import rereferenced
from graphs.problem import Estimate, PriorMode, PriorRig
from graphs.propagation import lens_names, marginal, pose_names
from graphs.unit import in_unit_baseline


def prior_rig(
    stated: Stated,
    cameras: Sequence[str],
    reference: str,
    metric: bool,
    mode: PriorMode = "full",
    held: frozenset[str] = frozenset(),
) -> PriorRig:
    """An earlier calibration as a problem of these cameras has it, the reference among both.

    Cameras that the problem lacks are left out, which is to marginalise them. Where not metric,
    lengths are put into units of the longest baseline whose ends are known, or held.
    """
    names = [camera.name for camera in stated.estimate.cameras]
    estimate, covariance = _seen_from(stated, names.index(reference))
    kept = [names.index(name) for name in cameras if name in names]
    part = Estimate(
        tuple(estimate.cameras[i] for i in kept),
        tuple(estimate.cam_from_rig[i] for i in kept),
        (),
        _NO_POINTS,
    )
    of = {
        name for camera in part.cameras for name in (*lens_names(camera), *pose_names(camera.name))
    }
    known = [name for name in covariance.names if name in of]
    covariance = marginal(covariance, known) if known else NOTHING
    unit = None
    if not metric:
        unit = _unit(part, covariance, mode, held)
        if unit is not None:
            part, covariance = _in_unit(part, covariance, unit)
    return PriorRig(
        part.cameras,
        part.cam_from_rig,
        reference,
        covariance,
        metric,
        mode,
        None if unit is None else part.cameras[unit].name,
        held,
    )


def _seen_from(stated: Stated, reference: int) -> tuple[Estimate, Covariance]:
    """In a camera's frame, without rows of places of which not every part was stated.

    `rereferenced` takes for exactly known what has no row.
    """
    estimate, covariance = stated.estimate, stated.covariance
    placed = estimate.cam_from_rig[reference]
    if np.array_equal(placed.rotation, np.eye(3)) and not placed.translation.any():
        return estimate, covariance
    have = set(covariance.names)
    known = [
        set(pose_names(camera.name)) <= have
        or (np.array_equal(place.rotation, np.eye(3)) and not place.translation.any())
        for camera, place in zip(estimate.cameras, estimate.cam_from_rig, strict=True)
    ]
    seen, moved = rereferenced(estimate, covariance, reference)
    vague = {
        name
        for camera, whole in zip(estimate.cameras, known, strict=True)
        if not (whole and known[reference])
        for name in pose_names(camera.name)
    }
    kept = [name for name in moved.names if name not in vague]
    return seen, marginal(moved, kept) if kept else NOTHING


_NO_POINTS: FloatArray = np.zeros((0, 3))


def _unit(
    estimate: Estimate, covariance: Covariance, mode: PriorMode, held: frozenset[str]
) -> int | None:
    """The camera farthest from the reference, of those held if there are any."""
    told = {name for name in held if ".translation_" in name}
    if not told and mode == "full":
        told = set(covariance.names)
    lengths = [
        float(np.linalg.norm(placed.translation)) if f"{camera.name}.translation_x" in told else 0.0
        for camera, placed in zip(estimate.cameras, estimate.cam_from_rig, strict=True)
    ]
    far = int(np.argmax(lengths))
    return far if lengths[far] > 0 else None


def _in_unit(estimate: Estimate, covariance: Covariance, unit: int) -> tuple[Estimate, Covariance]:
    name = estimate.cameras[unit].name
    length = float(np.linalg.norm(estimate.cam_from_rig[unit].translation))
    if f"{name}.translation_x" in covariance.names:
        covariance = in_unit_baseline(covariance, estimate, unit)
    elif covariance.names:
        covariance = Stated(estimate, covariance).scaled(1 / length).covariance
    return estimate.scaled(1 / length), covariance

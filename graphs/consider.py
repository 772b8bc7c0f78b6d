"""What a recalibration's errors owe to the calibration before it.

What was held errs as it did then, and what was freed follows it: the solve's own covariance knows
neither. Schmidt's "consider" filter counts both (S. F. Schmidt, Adv. Control Systems 3, 1966): with
M the inverse of the whole graph's normal equations, all that is held in it too, a result x follows
a held h as x = S h with S = M_xh M_hh^-1, which does not depend on how firmly h is held. What is
believed, not held, reaches the result through the rows that say so, A: by M A' A.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from graphs.build import CalibrationGraph
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.joint_prior import cameras_of, offset, parameters, whitening
from graphs.model_covariance import ModelCovariance, calibration_columns, response_at
from graphs.problem import Estimate, PriorRig
from graphs.propagation import cross_covariance
from graphs.stated_covariance import CalibrationCovariance, factors
from graphs.unit import unit_jacobian


@dataclass(frozen=True)
class Sensitivity:
    """How a result follows the earlier calibration that it was held to, or leant on."""

    prior: PriorRig
    names: tuple[str, ...]  # of the result, what was held of the earlier one among them
    old: tuple[str, ...]  # of the earlier one
    by_old: FloatArray  # (n, n_old) what a change of the earlier one does to the result
    counted: FloatArray  # (n, n) the part of the solve's own covariance that it is the cause of


def sensitivity(
    graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values, basis: ModelCovariance
) -> Sensitivity:
    """At an optimum of a problem with an earlier calibration; basis: its model covariance.

    Raises ValueError when the problem determines less than it asks for.
    """
    prior = graph.problem.prior
    assert prior is not None
    columns, every, to_reported = calibration_columns(graph, estimate, held=True)
    others = graph.others.linearize(values)
    curvature = basis.moments.curvature
    response = response_at(graph, estimate, values, others, columns, curvature)[columns]
    old = parameters(prior)
    indices = cameras_of(prior, estimate)
    lenses = [estimate.cameras[i].params for i in indices]
    by_reported = offset(prior, lenses, [estimate.cam_from_rig[i] for i in indices])[1]
    place = {name: index for index, name in enumerate(every)}
    by_tangent = by_reported @ to_reported[[place[name] for name in old]]
    own = to_reported
    if basis.unit_camera is not None:
        own = unit_jacobian(every, estimate, basis.unit_camera) @ to_reported
    rows = whitening(prior)
    believed = own @ response @ (rows @ by_tangent).T
    by_old = believed @ rows
    held = [index for index, name in enumerate(old) if name in prior.held]
    if held:
        of_held = by_tangent[held] @ response
        whiten = factors(of_held @ by_tangent[held].T)[1]
        by_old[:, held] += (own @ of_held.T) @ whiten.T @ whiten
    kept = [i for i, name in enumerate(every) if name in basis.names or name in prior.held]
    return Sensitivity(
        prior,
        tuple(every[i] for i in kept),
        old,
        by_old[kept] @ _by_reported(prior),
        believed[kept] @ believed[kept].T,
    )


def _by_reported(prior: PriorRig) -> FloatArray:
    return offset(prior, [camera.params for camera in prior.cameras], prior.cam_from_rig)[1]


def considered(stated: Covariance, how: Sensitivity) -> Covariance:
    """The solve's stated covariance with all that the earlier calibration's errors do to it.

    Held parameters have the covariance that they had, and correlate with what follows them. Those
    of which it states nothing count as exactly known.
    """
    before = cross_covariance(how.prior.covariance, how.old, how.old)
    return Covariance(how.names, _own(stated, how) + how.by_old @ before @ how.by_old.T)


def completed(covariance: CalibrationCovariance, how: Sensitivity) -> CalibrationCovariance:
    """All covariances of a solve, as `considered`, with what was held among their names.

    The model's part from data stays what it was; the jackknife moved nothing that was held.
    """
    basis, jackknife = covariance.basis, covariance.jackknife
    place = np.array([[float(a == b) for b in basis.names] for a in how.names])
    from_data = place @ basis.from_data @ place.T
    model = considered(basis.covariance, how).matrix
    basis = replace(
        basis,
        names=how.names,
        from_data=from_data,
        of_priors=factors(model - from_data)[0].T,
        response=basis.response @ place.T,
    )
    if jackknife is not None:
        jackknife = replace(
            jackknife,
            names=how.names,
            moved=jackknife.moved @ place.T,
            expected=place @ jackknife.expected @ place.T,
        )
    return CalibrationCovariance(
        considered(covariance.stated, how), considered(covariance.robust, how), jackknife, basis
    )


def cov_difference(stated: Covariance, how: Sensitivity) -> Covariance:
    """Covariance of the result less the earlier calibration, of the parameters of both.

    What the result takes from the earlier one cancels: of x = W data + (1 - W) old, the difference
    is W (data - old), and zero of what was held.
    """
    both = [index for index, name in enumerate(how.names) if name in how.old]
    names = tuple(how.names[index] for index in both)
    apart = how.by_old[both] - np.array([[float(a == b) for b in how.old] for a in names])
    before = cross_covariance(how.prior.covariance, how.old, how.old)
    matrix = _own(stated, how)[np.ix_(both, both)] + apart @ before @ apart.T
    plane = _plane(how.prior, names)
    return Covariance(names, plane @ matrix @ plane.T)


def change_from(prior: PriorRig, in_unit: Estimate, names: tuple[str, ...]) -> FloatArray:
    """The result's parameters `names` (n,) less the earlier calibration's, of cameras of both.

    in_unit: the result in its own unit, which has to be the prior's. A baseline that is the unit
    turns on a sphere: what leads off the plane at the prior's is left out, here and in
    `cov_difference`.
    """
    indices = cameras_of(prior, in_unit)
    now = Estimate(
        tuple(in_unit.cameras[i] for i in indices),
        tuple(in_unit.cam_from_rig[i] for i in indices),
        (),
        in_unit.points,
    )
    before = replace(now, cameras=prior.cameras, cam_from_rig=prior.cam_from_rig)
    return _plane(prior, names) @ change(before, now, names)


def _plane(prior: PriorRig, names: tuple[str, ...]) -> FloatArray:
    """Projection (n, n) of changes onto those that leave the prior's unit as it is."""
    if prior.metric or prior.unit is None or f"{prior.unit}.translation_x" not in names:
        return np.eye(len(names))
    rig = Estimate(prior.cameras, prior.cam_from_rig, (), np.zeros((0, 3)))
    return unit_jacobian(names, rig, [camera.name for camera in prior.cameras].index(prior.unit))


def _own(stated: Covariance, how: Sensitivity) -> FloatArray:
    """What of the stated covariance (n, n) the earlier calibration has no part in."""
    matrix: FloatArray = cross_covariance(stated, how.names, how.names) - how.counted
    return matrix

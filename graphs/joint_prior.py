"""An earlier calibration in the graph: one belief in all lenses and places together.

A place is a turn rho (rad, about the camera's axes) with R = Exp(rho) R_prior, and the camera's
centre in the rig, c = -R' t: what is held of a camera that was turned in its mount is where it
stands. Where the earlier calibration has no metres, centres are compared in units of one camera's
distance from the reference: the factor says nothing of the size, whatever unit the graph is in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import scipy.linalg

from graphs.camera import Camera
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import (
    FloatArray,
    Transform,
    exp_rotation,
    from_gtsam_inverse,
    log_rotation,
    reported_from_tangent,
    skew,
)
from graphs.keys import lens_key, rig_key
from graphs.priors import PINNED_SIGMA, LensPrior
from graphs.problem import Estimate, IntArray, PriorRig, Problem
from graphs.propagation import cross_covariance, lens_names, pose_names

# Of a focal length, of a radian, of the longest baseline: nothing is believed more exactly. Below
# it the data's own information is lost in rounding (as SQUARE_SIGMA).
LEAST_SIGMA = 1e-7
# Of the variance of a parameter, correlations taken out: what is said to be surer counts as this
# sure. Real lenses' weakest combinations have 1e-6. Two focal lengths that are exactly one: 1e-6,
# 1e-8, 1e-10 and 1e-12 take 9, 13, 17 steps and a graph that is singular to rounding; the sigmas of
# all else agree to 4e-7.
LEAST_EIGENVALUE = 1e-8
# Of places, in radians and of the longest baseline. Data pull a place that is held 1 deg off by
# less than this; with pixels a thousand times as sure as any, it would give way by 3e-3 of a pull.
HELD_SIGMA = 1e-8
NO_BELIEF = 1e6  # times a weak belief that an earlier calibration takes the place of


# ---- parameters ------------------------------------------------------------------------------


def parameters(prior: PriorRig) -> tuple[str, ...]:
    """Every parameter of its cameras, stated or not: lenses first, then places."""
    lenses = [name for camera in prior.cameras for name in lens_names(camera)]
    return (*lenses, *(name for camera in _placed(prior) for name in pose_names(camera.name)))


def _placed(prior: PriorRig) -> list[Camera]:
    return [camera for camera in prior.cameras if camera.name != prior.reference]


def believed(prior: PriorRig) -> tuple[str, ...]:
    """The parameters that the graph believes as far as their covariance says."""
    if prior.mode != "full":
        return ()
    stated = set(prior.covariance.names)
    names = {name for camera in prior.cameras for name in lens_names(camera)} & stated
    for camera in _placed(prior):
        place = pose_names(camera.name)
        if set(place[:3]) <= stated:
            names |= set(place[:3])
            # A centre is where it is by the turn too.
            if set(place) <= stated and (prior.metric or prior.unit is not None):
                names |= set(place)
    return tuple(name for name in parameters(prior) if name in names)


def offset(
    prior: PriorRig, lenses: Sequence[FloatArray], places: Sequence[Transform]
) -> tuple[FloatArray, FloatArray]:
    """How far a rig is from the earlier one (n,), and that by its reported parameters (n, n).

    lenses, places: of the prior's cameras. In the order of `parameters`; places as a turn and the
    centre's shift, in the prior's unit.
    """
    apart = [params - camera.params for params, camera in zip(lenses, prior.cameras, strict=True)]
    blocks = [np.eye(len(one)) for one in apart]
    centres = []
    for camera, place, known in zip(prior.cameras, places, prior.cam_from_rig, strict=True):
        if camera.name == prior.reference:
            continue
        turn = log_rotation(place.rotation @ known.rotation.T)
        by_reported = centred(place)
        by_reported[:3, :3] = gtsam.Rot3.LogmapDerivative(-turn)
        apart += [turn, -known.inverse.translation]
        blocks.append(by_reported)
        centres.append(place.inverse.translation)
    jacobian = scipy.linalg.block_diag(*blocks)
    start = sum(len(params) for params in lenses)
    in_unit, by_centre = _in_unit(prior, np.array(centres).reshape(-1, 3))
    left = np.concatenate(apart)
    columns = _centre_columns(prior, start)
    left[columns] += in_unit.ravel()
    jacobian[columns] = by_centre @ jacobian[columns]
    return left, jacobian


def centred(cam_from_rig: Transform) -> FloatArray:
    """Derivative (6, 6) of a place's turn and centre by its reported turn and translation."""
    jacobian = np.eye(6)
    jacobian[3:, :3] = -cam_from_rig.rotation.T @ skew(cam_from_rig.translation)
    jacobian[3:, 3:] = -cam_from_rig.rotation.T
    return jacobian


def _centre_columns(prior: PriorRig, start: int) -> IntArray:
    places = start + 6 * np.arange(len(_placed(prior)))
    columns: IntArray = (places[:, None] + np.array([3, 4, 5])).ravel().astype(np.int64)
    return columns


def _in_unit(prior: PriorRig, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (k, 3) over the distance of the one that is the unit, and that by them (3k, 3k)."""
    if prior.metric or prior.unit is None:
        return centres, np.eye(centres.size)
    which = [camera.name for camera in _placed(prior)].index(prior.unit)
    length = float(np.linalg.norm(centres[which]))
    jacobian = np.eye(centres.size) / length
    along = np.outer(centres.ravel(), centres[which]) / length**3
    jacobian[:, 3 * which : 3 * which + 3] -= along
    return centres / length, jacobian


# ---- what it says ------------------------------------------------------------------------------


def centred_covariance(prior: PriorRig) -> FloatArray:
    """Its covariance (n, n) of lenses, turns and centres; zero where it states none."""
    names = parameters(prior)
    reported = cross_covariance(prior.covariance, names, names)
    by_reported = offset(prior, [c.params for c in prior.cameras], prior.cam_from_rig)[1]
    matrix: FloatArray = by_reported @ reported @ by_reported.T
    return matrix


def whitening(prior: PriorRig) -> FloatArray:
    """Rows (k, n) that take offsets to units of sigma, independent of each other.

    Singular covariances are those of exactly known combinations, but for the size of a rig in its
    own unit, of which nothing is said.
    """
    names = parameters(prior)
    known = [names.index(name) for name in believed(prior)]
    if not known:
        return np.zeros((0, len(names)))
    basis = np.eye(len(names))[:, known]
    unit = [] if prior.unit is None else [names.index(n) for n in pose_names(prior.unit)[3:]]
    if unit and not prior.metric and set(unit) <= set(known):
        index = next(i for i, camera in enumerate(prior.cameras) if camera.name == prior.unit)
        along = prior.cam_from_rig[index].inverse.translation
        across = np.linalg.svd(along[None])[2][1:]
        kept = [column for column, name in enumerate(known) if name not in unit]
        basis = np.hstack([basis[:, kept], np.eye(len(names))[:, unit] @ across.T])
    matrix = basis.T @ centred_covariance(prior) @ basis
    least = LEAST_SIGMA * np.abs(basis.T) @ _sizes(prior)
    sigma = np.maximum(np.sqrt(np.maximum(np.diag(matrix), 0.0)), least)
    values, vectors = np.linalg.eigh(matrix / np.outer(sigma, sigma))
    length = np.sqrt(np.maximum(values, LEAST_EIGENVALUE))
    rows: FloatArray = (vectors / length).T / sigma @ basis.T
    return rows


def holding(prior: PriorRig) -> FloatArray:
    """Rows (k, n) of the places that are held; lenses are held by their own priors."""
    names, sizes = parameters(prior), _sizes(prior)
    held = [i for i, name in enumerate(names) if name in prior.held and _of_place(name)]
    rows: FloatArray = np.eye(len(names))[held] / (HELD_SIGMA * sizes[held, None])
    return rows


def _of_place(name: str) -> bool:
    return name.rpartition(".")[2] in POSE_NAMES


def _sizes(prior: PriorRig) -> FloatArray:
    """What a unit of each parameter (n,) is small or large beside."""
    longest = max(float(np.linalg.norm(t.translation)) for t in prior.cam_from_rig) or 1.0
    lenses = [[c.params[0]] * 4 + [1.0] * (len(c.params) - 4) for c in prior.cameras]
    return np.concatenate([*lenses, *([[1.0] * 3 + [longest] * 3] * len(_placed(prior)))])


# ---- in the graph ------------------------------------------------------------------------------


def joint_prior_factor(problem: Problem, lens_of: tuple[int, ...]) -> gtsam.NonlinearFactor | None:
    """The problem's earlier calibration as one factor; None where it is only a start.

    Raises ValueError where a camera of it is not the problem's, or has another lens.
    """
    prior = problem.prior
    if prior is None:
        return None
    indices = cameras_of(prior, problem.initial)
    rows = np.vstack([whitening(prior), holding(prior)])
    if not len(rows):
        return None
    placed = [i for i in indices if problem.initial.cameras[i].name != prior.reference]
    lens_keys = [lens_key(lens_of[i]) for i in indices]
    of_lens = list(dict.fromkeys(lens_keys))
    sizes = [camera.params.size for camera in prior.cameras]

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        lenses = [values.atVector(key) for key in lens_keys]
        places = [
            from_gtsam_inverse(values.atPose3(rig_key(i))) if i in placed else Transform.identity()
            for i in indices
        ]
        left, by_reported = offset(prior, lenses, places)
        if jacobians is not None:
            start = sum(sizes)
            J = rows @ by_reported
            of_lenses = np.split(J[:, :start], np.cumsum(sizes)[:-1], axis=1)
            blocks = [
                np.sum([b for b, k in zip(of_lenses, lens_keys, strict=True) if k == key], axis=0)
                for key in of_lens
            ]
            for number, index in enumerate(placed):
                own = J[:, start + 6 * number : start + 6 * number + 6]
                blocks.append(own @ reported_from_tangent(places[indices.index(index)]))
            for number, block in enumerate(blocks):
                jacobians[number] = np.asfortranarray(block)
        result: FloatArray = rows @ left
        return result

    keys = of_lens + [rig_key(i) for i in placed]
    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(rows)), keys, error)


def cameras_of(prior: PriorRig, estimate: Estimate) -> list[int]:
    """Where the prior's cameras are among the estimate's.

    Raises ValueError where one is not, or has another lens.
    """
    names = [camera.name for camera in estimate.cameras]
    for camera in prior.cameras:
        if camera.name not in names:
            raise ValueError(f"the earlier calibration has {camera.name}, the scan has not")
        lens = estimate.cameras[names.index(camera.name)].lens
        if lens != camera.lens:
            raise ValueError(
                f"{camera.name} has the lens {camera.lens} in the earlier calibration, and is to "
                f"have {lens}: give both the same"
            )
    return [names.index(camera.name) for camera in prior.cameras]


def prior_rows(prior: PriorRig, estimate: Estimate, held: bool = True) -> FloatArray:
    """Derivative (k, n) of the factor's errors by the reported `parameters`, at an estimate.

    held: with the rows of the places that are held.
    """
    indices = cameras_of(prior, estimate)
    lenses = [estimate.cameras[i].params for i in indices]
    by_reported = offset(prior, lenses, [estimate.cam_from_rig[i] for i in indices])[1]
    rows = np.vstack([whitening(prior), holding(prior)]) if held else whitening(prior)
    result: FloatArray = rows @ by_reported
    return result


def with_prior(camera: Camera, weak: LensPrior, prior: PriorRig | None) -> LensPrior:
    """What is believed of one lens beside the joint belief; `weak`: without a prior.

    A lens parameter of which the prior states how sure it is loses its weak belief, in mode full;
    others keep its width, about the prior's value but in mode start.
    """
    known = None if prior is None else {c.name: c for c in prior.cameras}.get(camera.name)
    if prior is None or known is None:
        return weak
    stated = set(believed(prior))
    of_lens = lens_names(camera)
    known_well = np.array([name in stated for name in of_lens])
    held = np.array([name in prior.held for name in of_lens])
    mean = known.params if prior.mode != "start" else np.where(held, known.params, weak.mean)
    sigma = np.where(known_well, NO_BELIEF * weak.sigma, weak.sigma)
    replaced = bool((known_well | held)[:2].any())
    return LensPrior(
        np.array(mean),
        np.where(held, PINNED_SIGMA, sigma),
        np.inf if replaced else weak.aspect_sigma,
    )


def displaced(prior: PriorRig, truth: Estimate, error: FloatArray) -> PriorRig:
    """The prior as if it had come out off a truth by so much (n,), in the order of `parameters`."""
    indices = cameras_of(prior, truth)
    sizes = np.cumsum([camera.params.size for camera in prior.cameras])
    cameras = tuple(
        replace(camera, params=truth.cameras[i].params + off)
        for i, camera, off in zip(indices, prior.cameras, np.split(error, sizes), strict=False)
    )
    steps = iter(error[sizes[-1] :].reshape(-1, 2, 3))
    size = _size_of_unit(prior, truth)
    places = []
    for i, camera in zip(indices, prior.cameras, strict=True):
        place = truth.cam_from_rig[i]
        if camera.name != prior.reference:
            turn, shift = next(steps)
            rotation = exp_rotation(turn) @ place.rotation
            centre = place.inverse.translation / size + shift
            if not prior.metric and camera.name == prior.unit:
                centre = centre / np.linalg.norm(centre)
            place = Transform(rotation, -rotation @ centre)
        places.append(place)
    return replace(prior, cameras=cameras, cam_from_rig=tuple(places))


def _size_of_unit(prior: PriorRig, estimate: Estimate) -> float:
    """What the prior's unit of length is in an estimate's."""
    if prior.metric or prior.unit is None:
        return 1.0
    index = [camera.name for camera in estimate.cameras].index(prior.unit)
    return float(np.linalg.norm(estimate.cam_from_rig[index].translation))


def baseline_sigma(prior: PriorRig) -> float:
    """Relative sigma of its longest baseline, where it gives the scale."""
    lengths = [float(np.linalg.norm(placed.translation)) for placed in prior.cam_from_rig]
    far = int(np.argmax(lengths))
    names = pose_names(prior.cameras[far].name)[3:]
    along = prior.cam_from_rig[far].translation / lengths[far]
    variance = float(along @ cross_covariance(prior.covariance, names, names) @ along)
    return max(max(variance, 0.0) ** 0.5 / lengths[far], LEAST_SIGMA)


def shares_of_prior(prior: PriorRig | None, model: Covariance, metric: bool) -> dict[str, float]:
    """Variance after over variance before, of each parameter that was believed: 1 is belief alone.

    model: the model's covariance of the result, which is metric or not; translations in another
    unit than the prior's are left out.
    """
    if prior is None:
        return {}
    before, after = prior.covariance.sigma, model.sigma
    shares = {}
    for name in believed(prior):
        if name not in after or (".translation_" in name and prior.metric != metric):
            continue
        was = before[name] ** 2
        shares[name] = min(after[name] ** 2 / was, 1.0) if was > 0 else 1.0
    return shares

"""The observations as GTSAM's own factors: slow, readable, the judge of faster ones.

One `ProjectionFactorPPPC` an observation, over (frame, cam_from_rig, point, lens). GTSAM's
Cal3DS2 and Cal3Fisheye both hold nine numbers with a skew in third place, pinned to zero here
together with the coefficients that a simpler lens does not have.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import gtsam_unstable
import numpy as np

from graphs.build import GraphOptions, rig_prior_factor, root_information
from graphs.camera import Camera
from graphs.frames import NOT_SMART, FloatArray, from_gtsam_inverse, to_gtsam_inverse
from graphs.gauge import add_gauge
from graphs.keys import frame_key, lens_key, point_key, rig_key
from graphs.lenses import LensName
from graphs.priors import PINNED_SIGMA, LensPrior, weak_lens_prior
from graphs.problem import Estimate, KnownSpan, Problem, ScaleSource
from graphs.scale import range_factor

NATIVE_LENSES: tuple[LensName, ...] = (
    "pinhole", "simple_radial", "radial", "radtan", "kannala_brandt",
)  # fmt: skip
NATIVE_SIZE = 9
_BROWN_SLOTS = {"fx": 0, "fy": 1, "cx": 3, "cy": 4, "k1": 5, "k2": 6, "p1": 7, "p2": 8}
_FISHEYE_SLOTS = {"fx": 0, "fy": 1, "cx": 3, "cy": 4, "k1": 5, "k2": 6, "k3": 7, "k4": 8}


def native_slots(camera: Camera) -> list[int]:
    """Where each of the lens's parameters stands in GTSAM's nine."""
    slots = _FISHEYE_SLOTS if camera.lens == "kannala_brandt" else _BROWN_SLOTS
    return [slots[name] for name in camera.names]


def native_lens(camera: Camera) -> gtsam.Cal3DS2 | gtsam.Cal3Fisheye:
    """GTSAM's calibration with this camera's parameters."""
    native = np.zeros(NATIVE_SIZE)
    native[native_slots(camera)] = camera.params
    kind = gtsam.Cal3Fisheye if camera.lens == "kannala_brandt" else gtsam.Cal3DS2
    return kind(*native)


def lens_params(values: gtsam.Values, index: int, camera: Camera) -> FloatArray:
    """The lens's own parameters (n_params,) out of GTSAM's values."""
    if camera.lens == "kannala_brandt":  # its vector() in Python is the base class's, five long
        native = values.atCal3Fisheye(lens_key(index))
        coefficients = (native.k1(), native.k2(), native.k3(), native.k4())
        return np.array([native.fx(), native.fy(), native.px(), native.py(), *coefficients])
    return values.atCal3DS2(lens_key(index)).vector()[native_slots(camera)]


def native_prior_factor(index: int, camera: Camera, prior: LensPrior) -> gtsam.NonlinearFactor:
    """The prior on a lens, everything GTSAM has and the lens has not pinned to zero."""
    information = np.eye(NATIVE_SIZE) * PINNED_SIGMA**-2.0
    slots = native_slots(camera)
    information[np.ix_(slots, slots)] = prior.information()
    mean = native_lens(Camera(camera.name, camera.lens, camera.size, prior.mean))
    root = np.linalg.cholesky(information).T
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, NOT_SMART)
    fisheye = camera.lens == "kannala_brandt"
    kind = gtsam.PriorFactorCal3Fisheye if fisheye else gtsam.PriorFactorCal3DS2
    return kind(lens_key(index), mean, noise)


def add_observations(
    graph: gtsam.NonlinearFactorGraph, problem: Problem, options: GraphOptions
) -> None:
    """Append one factor an observation, in the order of the observations."""
    kinds = [
        gtsam_unstable.ProjectionFactorPPPCCal3Fisheye
        if camera.lens == "kannala_brandt"
        else gtsam_unstable.ProjectionFactorPPPCCal3DS2
        for camera in problem.initial.cameras
    ]
    seen = problem.observations
    noises = (observation_noise(root, options) for root in root_information(problem, options))
    rows = zip(seen.pixels, noises, seen.frame, seen.camera, seen.point, strict=True)
    for pixel, noise, frame, camera, point in rows:
        graph.push_back(
            kinds[camera](
                pixel, noise, frame_key(frame), rig_key(camera), point_key(point), lens_key(camera)
            )
        )


@dataclass(frozen=True)
class ReferenceGraph:
    """The same graph as `graphs.build.build` makes, each observation and each point in it."""

    problem: Problem
    factors: gtsam.NonlinearFactorGraph  # observations first, in their order
    initial: gtsam.Values


def build_reference(problem: Problem, options: GraphOptions) -> ReferenceGraph:
    """Observation, prior and gauge factors over lenses, cam_from_rig, frames and points."""
    cameras = problem.initial.cameras
    priors = options.lens_priors or tuple(weak_lens_prior(camera) for camera in cameras)
    factors = gtsam.NonlinearFactorGraph()
    add_observations(factors, problem, options)
    for index, (camera, prior) in enumerate(zip(cameras, priors, strict=True)):
        factors.add(native_prior_factor(index, camera, prior))
    for index, rig_prior in options.rig_priors.items():
        factors.add(rig_prior_factor(index, rig_prior))
    add_gauge(factors, problem)
    for source in problem.scales:
        factors.add(native_scale_factor(source))
    return ReferenceGraph(problem, factors, native_values(problem))


def native_scale_factor(scale: ScaleSource) -> gtsam.NonlinearFactor:
    """A measured distance, between scene points too: here they are variables."""
    if not isinstance(scale, KnownSpan):
        return range_factor(scale)
    noise = gtsam.noiseModel.Isotropic.Sigma(1, scale.sigma_m)
    keys = (point_key(scale.points[0]), point_key(scale.points[1]))
    return gtsam.RangeFactor3(*keys, scale.length_m, noise)


def solve_reference(
    graph: ReferenceGraph, max_iterations: int = 100, relative_tolerance: float = 1e-12
) -> tuple[Estimate, gtsam.Values, int]:
    """GTSAM's own Levenberg-Marquardt: the estimate, its values, and the number of iterations."""
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph.factors, graph.initial, params)
    cost = optimizer.error()
    for _ in range(max_iterations):
        optimizer.iterate()
        previous, cost = cost, optimizer.error()
        if not previous - cost > relative_tolerance * previous:
            break
    values = optimizer.values()
    return reference_estimate(values, graph.problem), values, optimizer.iterations()


def observation_noise(root: FloatArray, options: GraphOptions) -> gtsam.noiseModel.Base:
    """Pixel noise of a root information, its upper triangle (3,), under the robust loss."""
    a, b, c = root
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(np.array([[a, b], [0.0, c]]), NOT_SMART)
    if options.loss == "none":
        return noise
    kinds = {
        "huber": gtsam.noiseModel.mEstimator.Huber,
        "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
        "tukey": gtsam.noiseModel.mEstimator.Tukey,
        "geman_mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    }
    return gtsam.noiseModel.Robust.Create(kinds[options.loss].Create(options.loss_scale), noise)


def native_values(problem: Problem) -> gtsam.Values:
    """Every variable of the problem at its start."""
    values = gtsam.Values()
    start = problem.initial
    for index, camera in enumerate(start.cameras):
        values.insert(lens_key(index), native_lens(camera))
        values.insert(rig_key(index), to_gtsam_inverse(start.cam_from_rig[index]))
    for index, rig_from_world in enumerate(start.rig_from_world):
        values.insert(frame_key(index), to_gtsam_inverse(rig_from_world))
    for index, point in enumerate(start.points):
        values.insert(point_key(index), point)
    return values


def reference_estimate(values: gtsam.Values, problem: Problem) -> Estimate:
    """GTSAM's values as an Estimate, in the problem's order."""
    start = problem.initial
    cameras = tuple(
        replace(camera, params=lens_params(values, index, camera))
        for index, camera in enumerate(start.cameras)
    )
    return Estimate(
        cameras,
        tuple(from_gtsam_inverse(values.atPose3(rig_key(i))) for i in range(len(cameras))),
        tuple(
            from_gtsam_inverse(values.atPose3(frame_key(i)))
            for i in range(len(start.rig_from_world))
        ),
        np.array([values.atPoint3(point_key(i)) for i in range(len(start.points))]),
    )

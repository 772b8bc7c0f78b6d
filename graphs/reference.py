"""The observations as GTSAM's own factors: slow, readable, the judge of faster ones.

One `ProjectionFactorPPPC` an observation, over (frame, cam_from_rig, point, lens). GTSAM's
Cal3DS2 and Cal3Fisheye both hold nine numbers with a skew in third place, pinned to zero here
together with the coefficients that a simpler lens does not have.
"""

from __future__ import annotations

import gtsam
import gtsam_unstable
import numpy as np

from graphs.frames import FloatArray
from graphs.keys import frame_key, lens_key, point_key, rig_key
from graphs.lenses import Camera
from graphs.priors import PINNED_SIGMA, LensPrior
from graphs.problem import Problem

NATIVE_SIZE = 9
# "Smart" noise models turn sigmas below 1e-8 into hard constraints, on which GTSAM's LM is stuck.
NOT_SMART = False
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


def lens_prior_factor(index: int, camera: Camera, prior: LensPrior) -> gtsam.NonlinearFactor:
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
    graph: gtsam.NonlinearFactorGraph, problem: Problem, noise: gtsam.noiseModel.Base
) -> None:
    """Append one factor an observation, in the order of the observations."""
    kinds = [
        gtsam_unstable.ProjectionFactorPPPCCal3Fisheye
        if camera.lens == "kannala_brandt"
        else gtsam_unstable.ProjectionFactorPPPCCal3DS2
        for camera in problem.initial.cameras
    ]
    seen = problem.observations
    rows = zip(seen.pixels, seen.frame, seen.camera, seen.point, strict=True)
    for pixel, frame, camera, point in rows:
        graph.push_back(
            kinds[camera](
                pixel, noise, frame_key(frame), rig_key(camera), point_key(point), lens_key(camera)
            )
        )

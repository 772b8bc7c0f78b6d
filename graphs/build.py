"""From a Problem to a factor graph and a start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np

from graphs.boards import insert_board, shape_prior_factor
from graphs.clusters import Tracks, make_tracks
from graphs.frames import NOT_SMART, FloatArray, to_gtsam_inverse
from graphs.gauge import add_gauge
from graphs.joint_prior import joint_prior_factor
from graphs.keys import frame_key, lens_key, rig_key
from graphs.losses import SCALE_95, LossName
from graphs.priors import LensPrior, RigPrior, weak_lens_prior
from graphs.problem import IntArray, Problem
from graphs.scale import scale_factor
from graphs.system import Layout, make_layout, variables_of
from graphs.tracks import Variables

NO_KNOWLEDGE = 1e6  # in place of an infinite sigma, which GTSAM does not take


@dataclass(frozen=True)
class GraphOptions:
    """How observations are weighed and what is believed beforehand."""

    sigma_px: float = 1.0  # of one pixel coordinate
    loss: LossName = "cauchy"
    loss_scale: float = SCALE_95["cauchy"]  # in sigmas
    lens_priors: tuple[LensPrior, ...] = ()  # one a camera; empty: the weak ones
    rig_priors: dict[int, RigPrior] = field(default_factory=dict)
    shared_lenses: tuple[tuple[int, ...], ...] = ()  # groups of cameras with one lens variable


@dataclass(frozen=True)
class CalibrationGraph:
    """A problem as a factor graph: tracks, and everything else as GTSAM's own factors."""

    problem: Problem
    options: GraphOptions
    lens_priors: tuple[LensPrior, ...]
    tracks: Tracks
    others: gtsam.NonlinearFactorGraph
    initial: gtsam.Values
    layout: Layout

    def variables(self, values: gtsam.Values, frames: IntArray | None = None) -> Variables:
        """What tracks depend on, in the order of elimination; `frames`: positions to read."""
        layout = self.layout
        order = layout.elimination.order
        return variables_of(values, self.problem, layout.lens_of, order, frames)


def build(
    problem: Problem,
    options: GraphOptions,
    extra: gtsam.NonlinearFactorGraph | None = None,
    extra_initial: gtsam.Values | None = None,
) -> CalibrationGraph:
    """Tracks, priors and gauge over lenses, cam_from_rig and frames.

    extra: any further factors, on these variables or on others whose start is `extra_initial`.
    Raises ValueError when the scene has no size (every image taken from one point), when a camera
    has no observation, when the start is not finite, and for hard constraints among `extra`.
    """
    cameras = problem.initial.cameras
    _check_every_camera_sees(problem)
    _check_finite(problem)
    lens_of = _lens_of(problem, options.shared_lenses)
    priors = options.lens_priors or tuple(weak_lens_prior(camera) for camera in cameras)
    others = gtsam.NonlinearFactorGraph()
    for index in sorted(set(lens_of)):
        others.add(lens_prior_factor(index, priors[index]))
    for index, rig_prior in options.rig_priors.items():
        others.add(rig_prior_factor(index, rig_prior))
    add_gauge(others, problem)
    noise = root_information(problem, options)
    if problem.board is not None:
        others.add(shape_prior_factor(problem.board.board))
    for source in problem.scales:
        others.add(scale_factor(problem, source, noise, lens_of, options.loss, options.loss_scale))
    earlier = joint_prior_factor(problem, lens_of)
    if earlier is not None:
        others.add(earlier)
    initial = initial_values(problem, lens_of)
    if extra is not None:
        _check_soft(extra)
        others.push_back(extra)
    if extra_initial is not None:
        initial.insert(extra_initial)
    layout = make_layout(problem, others, initial, lens_of)
    tracks = make_tracks(
        problem,
        noise,
        layout.elimination,
        layout.of_tracks,
        options.loss,
        options.loss_scale,
    )
    return CalibrationGraph(problem, options, priors, tracks, others, initial, layout)


def _check_every_camera_sees(problem: Problem) -> None:
    counts = np.bincount(problem.observations.camera, minlength=len(problem.initial.cameras))
    for camera, count in zip(problem.initial.cameras, counts, strict=True):
        if count == 0:
            raise ValueError(
                f"{camera.name} sees none of the {len(problem.initial.points)} points that are "
                "consistent between views: check that its images belong to these frames, and let "
                "it see textured things from several places"
            )


def _check_finite(problem: Problem) -> None:
    start = problem.initial
    for camera in start.cameras:
        if not np.isfinite(camera.params).all():
            raise ValueError(f"{camera.name}: the lens starts at {camera.params.tolist()}")
    for camera, placed in zip(start.cameras, start.cam_from_rig, strict=True):
        if not np.isfinite([*placed.rotation.ravel(), *placed.translation]).all():
            raise ValueError(f"{camera.name} starts nowhere in the rig: not a finite place")
    places = np.array([[*t.rotation.ravel(), *t.translation] for t in start.rig_from_world])
    for index in np.flatnonzero(~np.isfinite(places).all(axis=1)):
        raise ValueError(f"frame {problem.frame_names[index]} starts nowhere: not a finite place")
    lost = np.count_nonzero(~np.isfinite(start.points).all(axis=1))
    if lost:
        raise ValueError(f"{lost} of {len(start.points)} points start nowhere: leave them out")


def _check_soft(extra: gtsam.NonlinearFactorGraph) -> None:
    """Our Cholesky factor knows no constraints; a sigma of a millionth does as well."""
    for index in range(extra.size()):
        factor = extra.at(index)
        if isinstance(factor, gtsam.NoiseModelFactor) and factor.noiseModel().isConstrained():
            keys = ", ".join(gtsam.DefaultKeyFormatter(key) for key in list(factor.keys()))
            raise ValueError(
                f"the factor on {keys} is a hard constraint: give it a small sigma instead"
            )


def _lens_of(problem: Problem, groups: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """The camera whose lens variable each camera uses."""
    cameras = problem.initial.cameras
    lens_of = list(range(len(cameras)))
    everyone = [camera for group in groups for camera in group]
    if len(set(everyone)) < len(everyone):
        raise ValueError("a camera is in two groups that share a lens: put both into one")
    for group in groups:
        for camera in group:
            first, other = cameras[group[0]], cameras[camera]
            if (first.lens, first.size) != (other.lens, other.size):
                raise ValueError(
                    f"{first.name} ({first.lens}, {first.size[0]} x {first.size[1]} px) and "
                    f"{other.name} ({other.lens}, {other.size[0]} x {other.size[1]} px) cannot "
                    "share one lens"
                )
            lens_of[camera] = group[0]
    return tuple(lens_of)


def root_information(problem: Problem, options: GraphOptions) -> FloatArray:
    """Of each observation's pixel, the upper triangle (n_obs, 3) by rows."""
    return problem.observations.whitening / options.sigma_px


def lens_prior_factor(camera: int, prior: LensPrior) -> gtsam.NonlinearFactor:
    """A prior on a lens as GTSAM's."""
    root = np.linalg.cholesky(prior.information()).T
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, NOT_SMART)
    return gtsam.PriorFactorVector(lens_key(camera), prior.mean, noise)


def rig_prior_factor(camera: int, prior: RigPrior) -> gtsam.NonlinearFactor:
    """A prior on cam_from_rig as GTSAM's."""
    sigmas = np.array([prior.sigma_rotation] * 3 + [prior.sigma_translation] * 3)
    sigmas = np.minimum(sigmas, NO_KNOWLEDGE)
    pose = to_gtsam_inverse(prior.cam_from_rig)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas, NOT_SMART)
    return gtsam.PriorFactorPose3(rig_key(camera), pose, noise)


def initial_values(problem: Problem, lens_of: tuple[int, ...]) -> gtsam.Values:
    """Every variable of the problem at its start."""
    values = gtsam.Values()
    start = problem.initial
    for index in sorted(set(lens_of)):
        values.insert(lens_key(index), start.cameras[index].params)
    for index, cam_from_rig in enumerate(start.cam_from_rig):
        values.insert(rig_key(index), to_gtsam_inverse(cam_from_rig))
    for index, rig_from_world in enumerate(start.rig_from_world):
        values.insert(frame_key(index), to_gtsam_inverse(rig_from_world))
    insert_board(values, problem)
    return values

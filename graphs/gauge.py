"""The only place that fixes the freedom no observation can: where the world is, and how large."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from graphs.elimination import NotPositiveDefiniteError
from graphs.frames import NOT_SMART, Transform, to_gtsam_inverse
from graphs.keys import board_key, frame_key, lens_key, rig_key, shape_key
from graphs.problem import Problem
from graphs.system import Layout, System

GAUGE_SIGMA = 1e-6  # of the scene's size, and in radians: moves nothing that is measured
REFERENCE_SIGMA = 1e-9  # of the rig's size, and in radians: enters the sigma of a baseline


@dataclass(frozen=True)
class Gauge:
    """What is held: one frame's pose, and one distance unless a scale source gives the size."""

    frame: int
    distance: float  # held, between two frames or two cameras
    frames: tuple[int, int] | None = None
    cameras: tuple[int, int] | None = None


def choose_gauge(problem: Problem) -> Gauge | None:
    """Hold the best-seen frame, and the longest distance the scene offers.

    Frames whose world is a board need no hold; None where there are no others.

    Raises ValueError when every frame and camera stands at one point: there is no size to hold.
    """
    of_scene = ~problem.board_frames
    if not of_scene.any():
        return None
    counts = np.bincount(problem.observations.frame, minlength=len(problem.frame_names))
    frame = int((counts * of_scene).argmax())
    centres = np.array([t.inverse.translation for t in problem.initial.rig_from_world])
    from_frame = np.linalg.norm(centres - centres[frame], axis=1) * of_scene
    cameras = [t.inverse.translation for t in problem.initial.cam_from_rig]
    baselines = np.linalg.norm(np.array(cameras) - cameras[problem.reference], axis=1)
    # Places held in a rig's own unit are stiff: 5 steps with that unit held, 35 with another.
    prior, names = problem.prior, [camera.name for camera in problem.initial.cameras]
    if prior is not None and f"{prior.unit}.translation_x" in prior.held:
        unit = names.index(prior.unit or "")
        if baselines[unit] > 0:
            return Gauge(frame, float(baselines[unit]), cameras=(problem.reference, unit))
    path, baseline = float(from_frame.max()), float(baselines.max())
    if max(path, baseline) <= 0:
        raise ValueError("all images were taken from one point: turn and move the camera")
    if path >= baseline:
        return Gauge(frame, path, frames=(frame, int(from_frame.argmax())))
    return Gauge(frame, baseline, cameras=(problem.reference, int(baselines.argmax())))


def add_gauge(graph: gtsam.NonlinearFactorGraph, problem: Problem) -> None:
    """Hold seven degrees of freedom and the reference camera.

    With sources of scale, measured distances or a board, only six: the size is not held.
    """
    gauge = choose_gauge(problem)
    graph.add(hold_reference(problem, gauge))
    if gauge is None:
        return
    sigma = GAUGE_SIGMA * gauge.distance
    held = gtsam.noiseModel.Diagonal.Sigmas(np.array([GAUGE_SIGMA] * 3 + [sigma] * 3), NOT_SMART)
    pose = to_gtsam_inverse(problem.initial.rig_from_world[gauge.frame])
    graph.add(gtsam.PriorFactorPose3(frame_key(gauge.frame), pose, held))
    if problem.metric:
        return
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    pair = gauge.frames or gauge.cameras
    assert pair is not None
    key = frame_key if gauge.frames else rig_key
    graph.add(gtsam.RangeFactorPose3(key(pair[0]), key(pair[1]), gauge.distance, noise))


def hold_reference(problem: Problem, gauge: Gauge | None) -> gtsam.NonlinearFactor:
    """The reference camera at the identity, for factors that ask where it is: a baseline."""
    centres = [t.inverse.translation for t in problem.initial.cam_from_rig]
    size = max(float(np.linalg.norm(c - centres[problem.reference])) for c in centres)
    sigma = REFERENCE_SIGMA * (size or (gauge.distance if gauge else 1.0))
    sigmas = np.array([REFERENCE_SIGMA] * 3 + [sigma] * 3)
    identity = to_gtsam_inverse(Transform.identity())
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas, NOT_SMART)
    return gtsam.PriorFactorPose3(rig_key(problem.reference), identity, noise)


def undetermined(
    problem: Problem, layout: Layout, system: System, weakest: int | None = None
) -> str | None:
    """One line on what nothing in the system determines: the variables and the remedy.

    With the gauge held, theory leaves no direction of zero curvature; None: there is none.
    weakest: a column whose pivot is zero but for rounding.
    """
    start = layout.elimination.n_columns - layout.elimination.border
    try:
        directions = system.null_directions()
    except NotPositiveDefiniteError as error:
        return f"the scan does not determine {_name(problem, layout, error.column)}: {REMEDY}"
    if directions.shape[1] == 0:
        if weakest is None:
            return None
        return f"the scan does not determine {_name(problem, layout, weakest)}: {REMEDY}"
    largest = np.abs(directions).max(1)
    involved = start + np.flatnonzero(largest > INVOLVED * largest.max())
    names = list(dict.fromkeys(_name(problem, layout, int(column)) for column in involved))
    free = directions.shape[1]
    return (
        f"the scan leaves {free} {'direction' if free == 1 else 'directions'} of "
        f"{', '.join(names)} undetermined: {REMEDY}"
    )


INVOLVED = 0.1  # of the largest share that a variable has in a direction
REMEDY = "take more views, moving sideways and turning, or state what you know of it in rig.yaml"


def _name(problem: Problem, layout: Layout, column: int) -> str:
    """A column of the system in words."""
    key, part = layout.variable_at(column)
    kind = "rotation" if part < 3 else "position"
    for index, camera in enumerate(problem.initial.cameras):
        if key == lens_key(index):
            return f"{camera.name}.{camera.names[part]}"
        if key == rig_key(index):
            return f"the {kind} of {camera.name} in the rig"
    for index, name in enumerate(problem.frame_names):
        if key == frame_key(index):
            return f"the {kind} of frame {name}"
    if key == board_key():
        return f"the {kind} of the board in the scene"
    if key == shape_key():
        return "the bend of the board" if part else "the size of the board"
    return str(gtsam.DefaultKeyFormatter(key))

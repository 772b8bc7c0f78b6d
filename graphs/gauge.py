"""The only place that fixes the freedom no observation can: where the world is, and how large."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from graphs.frames import Transform, to_gtsam_inverse
from graphs.keys import frame_key, rig_key
from graphs.problem import KnownBaseline, Problem
from graphs.reference import NOT_SMART

GAUGE_SIGMA = 1e-6  # of the scene's size, and in radians: far below any estimated sigma


@dataclass(frozen=True)
class Gauge:
    """What is held: one frame's pose, and one distance unless a scale source gives the size."""

    frame: int
    distance: float  # held, between two frames or two cameras
    frames: tuple[int, int] | None = None
    cameras: tuple[int, int] | None = None


def choose_gauge(problem: Problem) -> Gauge:
    """Hold the best-seen frame, and the longest distance the scene offers.

    Raises ValueError when every frame and camera stands at one point: there is no size to hold.
    """
    counts = np.bincount(problem.observations.frame, minlength=len(problem.frame_names))
    frame = int(counts.argmax())
    centres = np.array([t.inverse.translation for t in problem.initial.rig_from_world])
    from_frame = np.linalg.norm(centres - centres[frame], axis=1)
    cameras = [t.inverse.translation for t in problem.initial.cam_from_rig]
    baselines = np.linalg.norm(np.array(cameras) - cameras[problem.reference], axis=1)
    path, baseline = float(from_frame.max()), float(baselines.max())
    if max(path, baseline) <= 0:
        raise ValueError("all images were taken from one point: turn and move the camera")
    if path >= baseline:
        return Gauge(frame, path, frames=(frame, int(from_frame.argmax())))
    return Gauge(frame, baseline, cameras=(problem.reference, int(baselines.argmax())))


def add_gauge(graph: gtsam.NonlinearFactorGraph, problem: Problem) -> None:
    """Hold seven degrees of freedom and the reference camera; a scale source replaces the size."""
    gauge = choose_gauge(problem)
    sigma = GAUGE_SIGMA * gauge.distance
    held = gtsam.noiseModel.Diagonal.Sigmas(np.array([GAUGE_SIGMA] * 3 + [sigma] * 3), NOT_SMART)
    pose = to_gtsam_inverse(problem.initial.rig_from_world[gauge.frame])
    graph.add(gtsam.PriorFactorPose3(frame_key(gauge.frame), pose, held))
    identity = to_gtsam_inverse(Transform.identity())
    graph.add(gtsam.PriorFactorPose3(rig_key(problem.reference), identity, held))
    if problem.scale is not None:
        add_known_baseline(graph, problem.scale)
        return
    noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    pair = gauge.frames or gauge.cameras
    assert pair is not None
    key = frame_key if gauge.frames else rig_key
    graph.add(gtsam.RangeFactorPose3(key(pair[0]), key(pair[1]), gauge.distance, noise))


def add_known_baseline(graph: gtsam.NonlinearFactorGraph, scale: KnownBaseline) -> None:
    """A measured distance between two cameras, with the sigma of its measurement."""
    noise = gtsam.noiseModel.Isotropic.Sigma(1, scale.sigma_m)
    keys = (rig_key(scale.cameras[0]), rig_key(scale.cameras[1]))
    graph.add(gtsam.RangeFactorPose3(*keys, scale.length_m, noise))

"""The calibration problem as frozen arrays: what was measured, and a guess at every variable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera, project
from graphs.frames import FloatArray, Transform

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Observations:
    """Where points were seen; row i is one keypoint."""

    pixels: FloatArray  # (n_obs, 2)
    frame: IntArray  # (n_obs,) index into Problem.frame_names
    camera: IntArray  # (n_obs,) index into Estimate.cameras
    point: IntArray  # (n_obs,) index into Estimate.points
    relative_sigma: FloatArray | None = None  # (n_obs,) of each pixel's noise; None: all the same
    feature_scale: FloatArray | None = None  # (n_obs,) size of each keypoint in px; NaN: unknown

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, keep: NDArray[np.bool_]) -> Observations:
        sigma, scale = (
            None if each is None else each[keep]
            for each in (self.relative_sigma, self.feature_scale)
        )
        return Observations(
            self.pixels[keep], self.frame[keep], self.camera[keep], self.point[keep], sigma, scale
        )


def images_seen(observations: Observations) -> IntArray:
    """Camera and frame (n_images, 2) of every image that has observations."""
    return np.unique(np.stack([observations.camera, observations.frame], axis=1), axis=0)


def joined(parts: Sequence[Observations]) -> Observations:
    """All observations of several sets, one set after the other."""

    def column(name: str, missing: float) -> FloatArray | None:
        given = [getattr(part, name) for part in parts]
        if all(one is None for one in given):
            return None
        filled = (
            np.full(len(part), missing) if one is None else one
            for part, one in zip(parts, given, strict=True)
        )
        return np.concatenate(list(filled))

    return Observations(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.frame for part in parts]),
        np.concatenate([part.camera for part in parts]),
        np.concatenate([part.point for part in parts]),
        column("relative_sigma", 1.0),
        column("feature_scale", np.nan),
    )


@dataclass(frozen=True)
class Estimate:
    """A value for every variable of the graph."""

    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Transform, ...]  # one a camera; the reference camera's is the identity
    rig_from_world: tuple[Transform, ...]  # one a frame
    points: FloatArray  # (n_points, 3) in the world

    def scaled(self, factor: float) -> Estimate:
        """The same scene in units `factor` times smaller."""
        return replace(
            self,
            cam_from_rig=tuple(t.scaled(factor) for t in self.cam_from_rig),
            rig_from_world=tuple(t.scaled(factor) for t in self.rig_from_world),
            points=self.points * factor,
        )


@dataclass(frozen=True)
class KnownBaseline:
    """A measured distance between two cameras of the rig: a source of metric scale."""

    cameras: tuple[int, int]
    length_m: float
    sigma_m: float


@dataclass(frozen=True)
class KnownPath:
    """A measured distance between the rig's places at two frames."""

    frames: tuple[int, int]
    length_m: float
    sigma_m: float


@dataclass(frozen=True)
class KnownSpan:
    """A measured distance between two scene points."""

    points: tuple[int, int]
    length_m: float
    sigma_m: float
    click_sigma_px: float | None = None  # of the ends' pixels; None: as noisy as all others


ScaleSource = KnownBaseline | KnownPath | KnownSpan


@dataclass(frozen=True)
class Problem:
    """Everything the graph needs: observations, and where to start."""

    initial: Estimate
    observations: Observations
    frame_names: tuple[str, ...]
    reference: int = 0  # index of the camera whose frame is the rig's frame
    scales: tuple[ScaleSource, ...] = ()  # measured distances; none: the size is free


def points_in_cameras(estimate: Estimate, observations: Observations) -> FloatArray:
    """The observed point of each observation in its camera's frame (n_obs, 3)."""
    rig_rotation = np.array([t.rotation for t in estimate.rig_from_world])
    rig_translation = np.array([t.translation for t in estimate.rig_from_world])
    cam_rotation = np.array([t.rotation for t in estimate.cam_from_rig])
    cam_translation = np.array([t.translation for t in estimate.cam_from_rig])
    world = estimate.points[observations.point]
    in_rig = np.einsum("nij,nj->ni", rig_rotation[observations.frame], world)
    in_rig += rig_translation[observations.frame]
    in_cam = np.einsum("nij,nj->ni", cam_rotation[observations.camera], in_rig)
    return in_cam + cam_translation[observations.camera]


def residuals_px(estimate: Estimate, observations: Observations) -> FloatArray:
    """Projected minus observed pixel (n_obs, 2); NaN where the point cannot be projected."""
    points = points_in_cameras(estimate, observations)
    residuals = np.full((len(observations), 2), np.nan)
    for index, camera in enumerate(estimate.cameras):
        rows = observations.camera == index
        residuals[rows] = project(camera, points[rows]) - observations.pixels[rows]
    return residuals

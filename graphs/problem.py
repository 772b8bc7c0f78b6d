"""The calibration problem as frozen arrays: what was measured, and a guess at every variable."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from graphs.camera import Camera, project
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class Observations:
    """Where points were seen; row i is one keypoint."""

    pixels: FloatArray  # (n_obs, 2)
    frame: IntArray  # (n_obs,) index into Problem.frame_names
    camera: IntArray  # (n_obs,) index into Estimate.cameras
    point: IntArray  # (n_obs,) index into Estimate.points
    relative_sigma: FloatArray | None = None  # (n_obs,) of each pixel's noise; None: all the same
    feature_scale: FloatArray | None = None  # (n_obs,) size of each keypoint in px; NaN: unknown
    noise_shape: FloatArray | None = None  # (n_obs, 2, 2) of determinant 1; None: all are round
    # (n_obs,) what the matching of its patch says of each; NaN: of a keypoint as it was found
    matched_sigma_px: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, keep: BoolArray | IntArray) -> Observations:
        """Some of them, by a mask or by their rows."""
        columns = {field.name: getattr(self, field.name) for field in fields(self)}
        kept: dict[str, Any] = {k: None if v is None else v[keep] for k, v in columns.items()}
        return Observations(**kept)

    @property
    def whitening(self) -> FloatArray:
        """Upper triangles (n_obs, 3) that turn pixel errors into round ones of equal size.

        With a, b, c of an observation, errors x, y become a x + b y and c y, whose covariance is
        that of an observation whose noise is round and whose relative sigma is 1.
        """
        n = len(self)
        result = np.zeros((n, 3))
        if self.noise_shape is None:
            result[:, [0, 2]] = 1.0
        else:
            down = np.sqrt(self.noise_shape[:, 1, 1])
            result[:, 0], result[:, 2] = down, 1 / down
            result[:, 1] = -self.noise_shape[:, 0, 1] / down
        return result if self.relative_sigma is None else result / self.relative_sigma[:, None]


def images_seen(observations: Observations) -> IntArray:
    """Camera and frame (n_images, 2) of every image that has observations."""
    return np.unique(np.stack([observations.camera, observations.frame], axis=1), axis=0)


def joined(parts: Sequence[Observations]) -> Observations:
    """All observations of several sets, one set after the other."""

    def column(name: str, missing: float | FloatArray) -> FloatArray | None:
        given = [getattr(part, name) for part in parts]
        if all(one is None for one in given):
            return None
        filled = (
            np.full((len(part), *np.shape(missing)), missing) if one is None else one
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
        column("noise_shape", np.eye(2)),
        column("matched_sigma_px", np.nan),
    )


@dataclass(frozen=True)
class Estimate:
    """A value for every variable of the graph."""

    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Transform, ...]  # one a camera; the reference camera's is the identity
    rig_from_world: tuple[Transform, ...]  # one a frame
    points: FloatArray  # (n_points, 3) in the world
    world_from_board: Transform | None = None  # of the board that stays put; None: there is none
    board_shape: FloatArray | None = None  # (k,) as `graphs.boards.corners_of` takes it

    def scaled(self, factor: float) -> Estimate:
        """The same scene in units `factor` times smaller."""
        return replace(
            self,
            cam_from_rig=tuple(t.scaled(factor) for t in self.cam_from_rig),
            rig_from_world=tuple(t.scaled(factor) for t in self.rig_from_world),
            points=self.points * factor,
            world_from_board=self.world_from_board and self.world_from_board.scaled(factor),
            board_shape=None
            if self.board_shape is None
            else np.concatenate([[self.board_shape[0] + np.log(factor)], self.board_shape[1:]]),
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
class Board:
    """A flat target: its corners as stated, and what is known of its size and flatness."""

    corners: FloatArray  # (n, 3) in the board's frame, in m
    shape_mean: FloatArray  # (k,) as `graphs.boards.corners_of` takes it
    shape_sigma: FloatArray  # (k,) relative of the size, else in m; 0: held


@dataclass(frozen=True)
class BoardPoints:
    """Which points of a problem are corners of its board. Each is a corner as one frame sees it."""

    board: Board
    corner: IntArray  # (n_points,) -1: a point of the scene
    still: BoolArray  # (n_points,) the board stays put in the scene; else it is its frame's world

    @property
    def known(self) -> BoolArray:
        """Whether each point is a corner (n_points,)."""
        return self.corner >= 0


# start: where the solve begins, and no more. weak: the generic beliefs in lenses are centred on it.
# full: it is believed as far as its own covariance says.
PriorMode = Literal["start", "weak", "full"]


@dataclass(frozen=True)
class PriorRig:
    """An earlier calibration of a problem's cameras, and what is made of it.

    Lengths are metres, or in units of one camera's baseline: then only their ratios count.
    """

    cameras: tuple[Camera, ...]  # those of the problem that it knows, the reference among them
    cam_from_rig: tuple[Transform, ...]  # of each; the reference's is the identity
    reference: str
    covariance: Covariance  # in this frame and unit; a parameter without a row is not stated
    metric: bool
    mode: PriorMode = "full"
    unit: str | None = None  # whose baseline is 1, where not metric; None: its lengths say nothing
    held: frozenset[str] = frozenset()  # parameters held at its values, named as in a covariance

    @property
    def gives_scale(self) -> bool:
        """Whether it says how long a baseline is in metres."""
        told = self.held | (set(self.covariance.names) if self.mode == "full" else set())
        return self.metric and any(
            placed.translation.any() and f"{camera.name}.translation_x" in told
            for camera, placed in zip(self.cameras, self.cam_from_rig, strict=True)
        )


@dataclass(frozen=True)
class Problem:
    """Everything the graph needs: observations, and where to start."""

    initial: Estimate
    observations: Observations
    frame_names: tuple[str, ...]
    reference: int = 0  # index of the camera whose frame is the rig's frame
    scales: tuple[ScaleSource, ...] = ()  # measured distances
    board: BoardPoints | None = None
    prior: PriorRig | None = None  # an earlier calibration

    @property
    def known(self) -> BoolArray:
        """Points (n_points,) that are corners of the board."""
        if self.board is None:
            return np.zeros(len(self.initial.points), dtype=bool)
        return self.board.known

    @property
    def board_frames(self) -> BoolArray:
        """Frames (n_frames,) whose world is the board's: nothing else is seen in them."""
        frames = np.zeros(len(self.frame_names), dtype=bool)
        if self.board is not None:
            own = self.board.known & ~self.board.still
            frames[self.observations.frame[own[self.observations.point]]] = True
        return frames

    @property
    def of_board_alone(self) -> bool:
        """Whether every frame has a board as its world: there is no scan."""
        return bool(self.board_frames.all())

    @property
    def metric(self) -> bool:
        """Whether lengths of the rig are in metres: measured, seen against a board, or known."""
        known = self.prior is not None and self.prior.gives_scale
        return bool(self.scales) or self.board_gives_scale or known

    @property
    def board_gives_scale(self) -> bool:
        """Whether images that the scene or the rig links see the board where it is."""
        return len(self.frames_of_scale) > 0

    @property
    def frames_of_scale(self) -> IntArray:
        """Frames in which two cameras see the board at once, or it stands in the scene itself.

        Of a board that stands, one image places it alone: it takes two to tell a length.
        """
        if self.board is None:
            return np.empty(0, np.int64)
        seen = self.observations
        still = self.board.still[seen.point]
        stood = images_seen(seen.subset(still))[:, 1]
        both = images_seen(seen.subset(self.board.known[seen.point] & ~still))[:, 1]
        frames, count = np.unique(both, return_counts=True)
        at_once: IntArray = frames[count > 1]
        return np.union1d(at_once, stood) if len(stood) > 1 else at_once


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


def whitened(values: FloatArray, whitening: FloatArray) -> FloatArray:
    """Pixel errors, or rows that lead to them, (n, 2, ...) by upper triangles (n, 3)."""
    a, b, c = (one.reshape(-1, *[1] * (values.ndim - 2)) for one in whitening.T)
    return np.stack([a * values[:, 0] + b * values[:, 1], c * values[:, 1]], axis=1)


def residuals_px(estimate: Estimate, observations: Observations) -> FloatArray:
    """Projected minus observed pixel (n_obs, 2); NaN where the point cannot be projected."""
    points = points_in_cameras(estimate, observations)
    residuals = np.full((len(observations), 2), np.nan)
    for index, camera in enumerate(estimate.cameras):
        rows = observations.camera == index
        residuals[rows] = project(camera, points[rows]) - observations.pixels[rows]
    return residuals

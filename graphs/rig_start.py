"""From freely posed images to one rig: robust averages over frames, and who disagrees.

Structure from motion without rig constraints gives every image a pose of its own. The rig's
cam_from_rig is their robust mean over the frames; each frame then takes the pose, proposed by
one of its images, under which most of the frame's observations project where they were seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform, median_rotation
from graphs.problem import Estimate, IntArray, Observations, Problem, residuals_px

# A wrong pose sends nearly all observations of its image astray, a merely inexact rig only some.
GROSS_ERROR = 0.03  # of the image width
MIN_AGREEING = 0.5  # share of an image's observations under the frame's pose
MIN_SHARED_FRAMES = 1


@dataclass(frozen=True)
class FreeModel:
    """A reconstruction in which every image has its own pose."""

    cameras: tuple[Camera, ...]
    cam_from_world: dict[tuple[int, int], Transform]  # (camera, frame)
    points: FloatArray  # (n_points, 3)
    observations: Observations  # frame indexes the scan's frames

    def images_of(self, camera: int) -> list[int]:
        """Frames in which a camera was registered."""
        return sorted(frame for c, frame in self.cam_from_world if c == camera)


def link_cameras(model: FreeModel, reference: int) -> tuple[tuple[Transform, ...], list[int]]:
    """cam_from_rig of every camera, chained from the reference through shared frames.

    Returns identity for cameras that share no frame with any linked one, and their indices.
    """
    n = len(model.cameras)
    linked: dict[int, Transform] = {reference: Transform.identity()}
    frames = [set(model.images_of(camera)) for camera in range(n)]
    while len(linked) < n:
        count, known, new = max(
            (
                (len(frames[a] & frames[b]), a, b)
                for a in linked
                for b in range(n)
                if b not in linked
            ),
            key=lambda link: (link[0], -link[1], -link[2]),
        )
        if count < MIN_SHARED_FRAMES:
            break
        relative = [
            model.cam_from_world[new, frame] @ model.cam_from_world[known, frame].inverse
            for frame in sorted(frames[known] & frames[new])
        ]
        linked[new] = median_transform(relative) @ linked[known]
    missing = [camera for camera in range(n) if camera not in linked]
    return tuple(linked.get(camera, Transform.identity()) for camera in range(n)), missing


def median_transform(transforms: list[Transform]) -> Transform:
    """L1 mean of rotations, and the component-wise median of translations."""
    rotation = median_rotation(np.array([t.rotation for t in transforms]))
    return Transform(rotation, np.median([t.translation for t in transforms], axis=0))


def impose_rig(
    model: FreeModel,
    cam_from_rig: tuple[Transform, ...],
    frame_names: tuple[str, ...],
    reference: int,
) -> tuple[Problem, list[tuple[int, int]]]:
    """A Problem with one pose a frame, and the images (camera, frame) that contradict it.

    Every registered image proposes its frame's pose; the one under which most observations of
    the frame agree is taken. Images that still disagree are dropped with their observations.
    """
    proposals: dict[int, list[Transform]] = {}
    for (camera, frame), cam_from_world in sorted(model.cam_from_world.items()):
        rig_from_world = cam_from_rig[camera].inverse @ cam_from_world
        proposals.setdefault(frame, []).append(rig_from_world)
    seen_frames = sorted(proposals)
    seen = model.observations
    best = np.full(len(seen_frames), -1.0)
    chosen: list[Transform] = [proposals[frame][0] for frame in seen_frames]
    compact = np.full(len(frame_names), -1)
    compact[seen_frames] = np.arange(len(seen_frames))
    seen = replace(seen, frame=compact[seen.frame])
    for rank in range(max(map(len, proposals.values()))):
        trial = tuple(proposals[f][min(rank, len(proposals[f]) - 1)] for f in seen_frames)
        agrees = agreeing(Estimate(model.cameras, cam_from_rig, trial, model.points), seen)
        score = np.bincount(seen.frame, weights=agrees, minlength=len(seen_frames))
        for place in np.flatnonzero(score > best):
            chosen[place], best[place] = trial[place], score[place]
    start = Estimate(model.cameras, cam_from_rig, tuple(chosen), model.points)
    names = tuple(frame_names[frame] for frame in seen_frames)
    dropped, keep = _contradicting_images(start, seen)
    problem = Problem(start, seen.subset(keep), names, reference)
    return problem, [(camera, seen_frames[frame]) for camera, frame in dropped]


def agreeing(estimate: Estimate, observations: Observations) -> IntArray:
    """1 for each observation that projects within a gross error of where it was seen."""
    errors = np.linalg.norm(residuals_px(estimate, observations), axis=1)
    widths = np.array([camera.size[0] for camera in estimate.cameras])
    with np.errstate(invalid="ignore"):
        return (errors < GROSS_ERROR * widths[observations.camera]).astype(np.int64)


def _contradicting_images(
    start: Estimate, seen: Observations
) -> tuple[list[tuple[int, int]], np.ndarray]:
    n_cameras = len(start.cameras)
    image = seen.frame * n_cameras + seen.camera
    n_images = len(start.rig_from_world) * n_cameras
    total = np.bincount(image, minlength=n_images)
    good = np.bincount(image, weights=agreeing(start, seen), minlength=n_images)
    bad = (total > 0) & (good < MIN_AGREEING * total)
    dropped = [(int(i % n_cameras), int(i // n_cameras)) for i in np.flatnonzero(bad)]
    return dropped, ~bad[image]

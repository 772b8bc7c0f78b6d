"""Which pairs of images are worth matching, when it is known how the cameras sit and look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphs.camera import Camera, image_pixels, project, unproject
from graphs.frames import Transform
from graphs.problem import IntArray, Problem
from sfm_calib.images import Scan
from sfm_calib.pairs import Pair

VIEW_GRID = (12, 9)  # rays across and down a view
# Distances at which views may meet, in longest baselines: between cameras that face each other,
# whatever stands in a room, infinity.
RANGES = (0.5, 1.5, 3.0, 10.0, 1e3)
LEAST_SHARED_VIEW = 0.05  # of a view; a camera turned by 3 deg moves its view by as much
OWN_STEPS = (1, 2, 4, 8)  # frames, to the same camera: its lens is known, wide steps come later
OTHER_STEPS = (0, 1)  # frames, to cameras that look the same way


def shared_view(cameras: Sequence[Camera], cam_from_rig: Sequence[Transform]) -> np.ndarray:
    """The share (n, n) of camera a's view that camera b sees too, at the distance that gives most.

    A view without its end is asked on a grid of its rays; wide lenses see what they see.
    """
    centres = np.array([t.inverse.translation for t in cam_from_rig])
    longest = np.linalg.norm(centres[:, None] - centres, axis=-1).max()
    share = np.eye(len(cameras))
    for a, one in enumerate(cameras):
        rays = unproject(one, image_pixels(one.size, VIEW_GRID)[2])
        rays = rays[np.isfinite(rays[:, 0])]
        for b, other in enumerate(cameras):
            b_from_a = cam_from_rig[b] @ cam_from_rig[a].inverse
            for distance in RANGES if a != b else ():
                pixels = project(other, b_from_a @ (rays * distance * max(longest, 1e-9)))
                inside = ((pixels >= -0.5) & (pixels < np.array(other.size) - 0.5)).all(-1)
                share[a, b] = max(share[a, b], inside.mean() if len(rays) else 0.0)
    return share


def first_pairs(scan: Scan, overlapping: np.ndarray) -> list[Pair]:
    """Sorted pairs of images near in time: of one camera, and of cameras (n, n) that overlap."""
    place = scan.numbers
    pairs = set()
    for (camera, frame), number in place.items():
        for other in range(len(scan.cameras)):
            steps = (
                OWN_STEPS if other == camera else OTHER_STEPS if overlapping[camera, other] else ()
            )
            for step in steps:
                neighbour = place.get((other, frame + step))
                if neighbour is not None and neighbour != number:
                    pairs.add((min(number, neighbour), max(number, neighbour)))
    return sorted(pairs)


# Of the images that show the same points, in the order of how many: the nearest, and some far ones,
# which bridge a gap and give a point its parallax.
OWN_RANKS = (0, 1, 2, 4, 8, 16)
OTHER_RANKS = (0, 1, 2)
LEAST_SHARED_POINTS = 5


def pairs_that_share(problem: Problem, number: IntArray) -> list[Pair]:
    """Sorted pairs of images that show the same points of a problem, of whatever time.

    number: (n_cameras, n_frames) the index of each image in the scan; -1: there is none.
    """
    n_cameras, n_frames = number.shape
    seen = problem.observations
    shown = np.zeros((n_cameras * n_frames, len(problem.initial.points)), dtype=np.float32)
    shown[seen.camera * n_frames + seen.frame, seen.point] = 1.0
    shared = (shown @ shown.T).astype(np.int64)
    np.fill_diagonal(shared, 0)
    flat, pairs = number.ravel(), set()
    for image in np.flatnonzero(flat >= 0):
        for other in range(n_cameras):
            of_camera = np.arange(other * n_frames, (other + 1) * n_frames)
            ranked = of_camera[np.argsort(-shared[image, of_camera], kind="stable")]
            for rank in OWN_RANKS if other == image // n_frames else OTHER_RANKS:
                partner = ranked[rank] if rank < len(ranked) else image
                if shared[image, partner] >= LEAST_SHARED_POINTS and flat[partner] >= 0:
                    a, b = sorted((int(flat[image]), int(flat[partner])))
                    pairs.add((a, b))
    return sorted(pairs)

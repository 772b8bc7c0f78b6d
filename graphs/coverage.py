"""What a scan shows each camera: where in its image, from how far, and how the camera moved.

Plain statistics of a problem's start, before any solve. They say what a scan lacks, not how well
it calibrates: that is the covariance's to say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray, Transform, log_rotation, median_rotation
from graphs.problem import Estimate, IntArray, Observations, Problem, points_in_cameras
from graphs.selection import MIN_TRACK_LENGTH, parallax_deg

BoolArray = NDArray[np.bool_]

GRID = 10  # cells across and down an image
CORNER = 2  # cells a side of a corner region: a fifth of the width, of the height
# Of a cell that counts as covered; of a hundred cells of a fair scan (20 images of 500
# observations) each holds a hundred.
MIN_IN_CELL = 5
MIN_IN_CORNER = 10
RANGE = (0.05, 0.95)  # quantiles between which a spread is taken: mismatches lie outside
FARTHEST_POINTS = 0.9  # quantile of the distance from their middle: the depth of the rest is noise


@dataclass(frozen=True)
class ImagePlane:
    """Where in its image one camera saw points."""

    covered: float  # share of the image's cells
    corners: tuple[bool | None, ...]  # top left, top right, bottom left, bottom right; None: dark
    radius: float  # of the observation farthest from the centre but 0.5 %, over half the diagonal


@dataclass(frozen=True)
class Motion:
    """How one camera turned and moved, about and along its own axes x right, y down, z forward."""

    rotation_deg: FloatArray  # (3,) spread about x (up and down), y (to the sides), z (roll)
    path_share: FloatArray  # (3,) of its way along each axis, each 0 to 1
    extent: float  # largest extent of its places, in the problem's unit
    straightness: float  # 1 - second / largest extent of its places: 1 is a straight line


@dataclass(frozen=True)
class SeenScene:
    """The points that one camera saw; NaN where it saw none."""

    near: float  # distance in extents of the camera's places: 5 % are nearer
    far: float  # 5 % are farther
    parallax_deg: FloatArray  # (3,) 5 %, median and 95 % of tracks of three or more views
    thickness: float  # smallest over second largest principal extent of the points: 0 is a plane

    @property
    def depth_ratio(self) -> float:
        return self.far / self.near if self.near > 0 else np.nan


@dataclass(frozen=True)
class CameraCoverage:
    """What a scan shows one camera."""

    name: str
    frames: IntArray  # (n_images,) in which it sees anything, index into Problem.frame_names
    per_image: IntArray  # (n_images,) observations in each
    plane: ImagePlane
    motion: Motion
    scene: SeenScene

    @property
    def n_images(self) -> int:
        return len(self.per_image)

    @property
    def n_observations(self) -> int:
        return int(self.per_image.sum())


@dataclass(frozen=True)
class Coverage:
    """What a scan shows every camera, and what they see in common."""

    cameras: tuple[CameraCoverage, ...]
    shared_at_once: IntArray  # (n_cam, n_cam) points that both see in one and the same frame
    shared_ever: IntArray  # (n_cam, n_cam) points that both see, at any time


def coverage(
    problem: Problem, min_parallax_deg: float = 0.0, lit: BoolArray | None = None
) -> Coverage:
    """Statistics of what every camera sees, from the start of a problem.

    Counted are, as in the solve, observations of points seen three times or more and under the
    given angle; all, where there are none such. The parallax is that of points of either angle.
    lit (n_cam, GRID, GRID), rows first: cells of the image that ever receive light; all, where it
    is not given. The corners of a fisheye's image do not.
    """
    start, angle = problem.initial, _parallax_of_tracks(problem)
    with np.errstate(invalid="ignore"):
        useful = (angle >= min_parallax_deg)[problem.observations.point]
    seen = problem.observations.subset(useful) if useful.any() else problem.observations
    distance = np.linalg.norm(points_in_cameras(start, seen), axis=1)
    if lit is None:
        lit = np.ones((len(start.cameras), GRID, GRID), dtype=bool)
    cameras = []
    for index, camera in enumerate(start.cameras):
        rows = seen.camera == index
        frames, per_image = np.unique(seen.frame[rows], return_counts=True)
        motion = motion_of([start.cam_from_rig[index] @ start.rig_from_world[f] for f in frames])
        plane = image_plane(seen.pixels[rows], camera.size, lit[index])
        ever = np.unique(problem.observations.point[problem.observations.camera == index])
        scene = seen_scene(
            start.points[np.unique(seen.point[rows])], distance[rows], angle[ever], motion.extent
        )
        cameras.append(CameraCoverage(camera.name, frames, per_image, plane, motion, scene))
    return Coverage(tuple(cameras), *shared_points(start, seen))


def _parallax_of_tracks(problem: Problem) -> FloatArray:
    """Parallax (n_points,) in degrees; NaN of points that too few images see."""
    length = np.bincount(problem.observations.point, minlength=len(problem.initial.points))
    return np.where(length >= MIN_TRACK_LENGTH, parallax_deg(problem), np.nan)


def image_plane(pixels: FloatArray, size: tuple[int, int], lit: BoolArray) -> ImagePlane:
    """Coverage of an image of `size` (width, height in px) by pixels (n, 2)."""
    place = np.clip(((pixels + 0.5) / size * GRID).astype(np.int64), 0, GRID - 1)
    count = np.zeros((GRID, GRID), dtype=np.int64)
    np.add.at(count, (place[:, 1], place[:, 0]), 1)
    covered = (count >= MIN_IN_CELL)[lit]
    first, last = slice(0, CORNER), slice(GRID - CORNER, GRID)
    regions = ((first, first), (first, last), (last, first), (last, last))
    corners = tuple(
        bool(count[region].sum() >= MIN_IN_CORNER) if lit[region].any() else None
        for region in regions
    )
    half = (np.array(size) - 1) / 2
    radii = np.linalg.norm(pixels - half, axis=1) / np.linalg.norm(half)
    return ImagePlane(
        float(covered.mean()) if covered.size else 0.0,
        corners,
        float(np.quantile(radii, 0.995)) if len(radii) else 0.0,
    )


def motion_of(cam_from_world: list[Transform]) -> Motion:
    """How a camera moved through its images, given in the order they were taken."""
    if not cam_from_world:
        return Motion(np.zeros(3), np.zeros(3), 0.0, 0.0)
    rotations = np.array([t.rotation for t in cam_from_world])
    mean = median_rotation(rotations)
    turns = np.degrees([log_rotation(rotation @ mean.T) for rotation in rotations])
    low, high = np.quantile(turns, RANGE, axis=0)
    places = np.array([t.inverse.translation for t in cam_from_world])
    steps = np.einsum("nij,nj->ni", rotations[:-1], np.diff(places, axis=0))
    path = np.linalg.norm(steps, axis=1).sum()
    share = np.abs(steps).sum(0) / path if path > 0 else np.zeros(3)
    extents = _extents(places)
    straightness = float(1 - extents[1] / extents[0]) if extents[0] > 0 else 0.0
    return Motion(high - low, share, float(extents[0]), straightness)


def _extents(points: FloatArray) -> FloatArray:
    """Extents (3,) of points (n, 3) along their principal axes, the largest first."""
    axes = np.linalg.svd(points - points.mean(0), full_matrices=True)[2]
    return np.sort(np.ptp(points @ axes.T, axis=0))[::-1]


def seen_scene(
    points: FloatArray, distance: FloatArray, angle_deg: FloatArray, extent: float
) -> SeenScene:
    """What a camera saw: points (n, 3) in the world, the distance (n_obs,) of each observation,
    the parallax (n,) of each point or NaN, and the extent of the camera's places."""
    angle_deg = angle_deg[np.isfinite(angle_deg)]
    if not len(points):
        return SeenScene(np.nan, np.nan, np.full(3, np.nan), np.nan)
    near, far = np.quantile(distance, RANGE) / extent if extent > 0 else (np.nan, np.nan)
    low, high = RANGE
    parallax = np.quantile(angle_deg, (low, 0.5, high)) if len(angle_deg) else np.full(3, np.nan)
    return SeenScene(float(near), float(far), parallax, _thickness(points))


def _thickness(points: FloatArray) -> float:
    """Smallest over second largest standard deviation of points (n, 3), the farthest left out."""
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    points = points[away <= np.quantile(away, FARTHEST_POINTS)]
    if len(points) < 4:  # three always lie in a plane
        return np.nan
    sigmas = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return float(sigmas[2] / sigmas[1]) if sigmas[1] > 0 else 0.0


def shared_points(start: Estimate, seen: Observations) -> tuple[IntArray, IntArray]:
    """Points that each two cameras see in one frame (n_cam, n_cam), and at any time."""
    n_cameras, n_points = len(start.cameras), len(start.points)
    places, row = np.unique(seen.frame * n_points + seen.point, return_inverse=True)
    together = np.zeros((len(places), n_cameras), dtype=bool)
    together[row, seen.camera] = True
    ever = np.zeros((n_points, n_cameras), dtype=np.int64)
    ever[seen.point, seen.camera] = 1
    at_once = np.zeros((n_cameras, n_cameras), dtype=np.int64)
    for a in range(n_cameras):
        for b in range(n_cameras):
            both = places[together[:, a] & together[:, b]]
            at_once[a, b] = len(np.unique(both % n_points))
    return at_once, ever.T @ ever

"""How the surface around a point looks through every camera that sees it.

Of each track one view is the reference, whose image is sampled in a square. The surface is taken
for a plane, as long as nothing is known of it across the mean viewing direction; seen through the
lenses, the square is then a curved quadrilateral in every other view, to second order in the
samples. What an affine change makes of it is left to the alignment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.camera import project, unproject
from graphs.frames import FloatArray
from graphs.problem import Estimate, IntArray, Observations

HALF = 7  # samples from the middle of a patch to its edge
# Of a keypoint's scale, between samples, at least a pixel: in the patch lie what made the keypoint,
# and its surroundings. Steps of a pixel for all leave coarse keypoints without anything to see.
STEP_OF_SCALE = 1 / 1.5
LEAST_STEP_PX = 1.0


@dataclass(frozen=True)
class Warps:
    """Where each observation's image shows the samples of its track's reference patch.

    A sample x, y, in steps from the patch's middle, lies at `middle` plus `coefficients` times
    (1, x, y, x^2, x y, y^2); the first column is zero.
    """

    reference: IntArray  # (n_obs,) the observation whose image is sampled in a square
    middle: FloatArray  # (n_obs, 2) px
    coefficients: FloatArray  # (n_obs, 2, 6) px; NaN where the surface cannot be seen

    @property
    def linear(self) -> FloatArray:
        """Pixels a sample (n_obs, 2, 2) in the middle of each patch."""
        return self.coefficients[:, :, 1:3]

    @property
    def bend(self) -> FloatArray:
        """What no affine change makes of a patch: samples (n_obs, 2, 3) of x^2, x y, y^2."""
        linear = self.linear.copy()
        linear[np.linalg.det(linear) == 0] = np.nan
        return np.asarray(np.linalg.solve(linear, self.coefficients[:, :, 3:]), np.float64)

    def subset(self, rows: IntArray) -> Warps:
        """Those of whole tracks; rows (n,) ascending."""
        place = np.searchsorted(rows, self.reference[rows])
        return Warps(place, self.middle[rows], self.coefficients[rows])


def monomials(x: FloatArray, y: FloatArray) -> FloatArray:
    """1, x, y, x^2, x y, y^2 of samples (...): (..., 6)."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def warps_of(
    estimate: Estimate, seen: Observations, middle: FloatArray, normal: FloatArray | None = None
) -> Warps:
    """The warps of all observations, about the pixels (n_obs, 2) given as their middles.

    normal: of the surface around each point (n_points, 3), NaN where it is not known.
    """
    rotation, centre = places(estimate, seen)
    facing, first = faced(estimate, seen)
    reference = first[seen.point]
    normal = facing if normal is None else np.where(np.isfinite(normal), normal, facing)
    grid = HALF * np.array([(x, y) for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)])
    used = np.unique(seen.point)
    ground = np.full((len(estimate.points), len(grid), 3), np.nan)
    ground[used] = _ground(estimate, seen, rotation, centre, first[used], normal[used], grid)
    in_camera = np.einsum("nij,nkj->nki", rotation, ground[seen.point] - centre[:, None])
    pixels = by_camera(project, estimate, seen.camera, in_camera, 2)
    fit = np.linalg.pinv(monomials(*grid.T))
    coefficients = np.einsum("mk,nkc->ncm", fit, pixels - pixels[:, 4:5])
    coefficients[:, :, 0] = 0.0
    return Warps(reference, middle, coefficients)


def faced(estimate: Estimate, seen: Observations) -> tuple[FloatArray, IntArray]:
    """Where each point is seen from: the mean direction (n_points, 3), and the observation
    (n_points,) that is nearest to it; of a point that nothing sees zeros and -1."""
    _, centre = places(estimate, seen)
    away = centre - estimate.points[seen.point]
    towards = away / np.linalg.norm(away, axis=1, keepdims=True)
    mean = np.zeros_like(estimate.points)
    np.add.at(mean, seen.point, towards)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    order = np.lexsort((-(towards * mean[seen.point]).sum(1), seen.point))
    points, first = np.unique(seen.point[order], return_index=True)
    nearest = np.full(len(estimate.points), -1)
    nearest[points] = order[first]
    return mean, nearest


def places(estimate: Estimate, seen: Observations) -> tuple[FloatArray, FloatArray]:
    """Rotation (n_obs, 3, 3) and centre (n_obs, 3) in the world of each observation's camera."""
    rotation = np.empty((len(estimate.cameras), len(estimate.rig_from_world), 3, 3))
    centre = np.empty(rotation.shape[:3])
    for camera, cam_from_rig in enumerate(estimate.cam_from_rig):
        for frame, rig_from_world in enumerate(estimate.rig_from_world):
            cam_from_world = cam_from_rig @ rig_from_world
            rotation[camera, frame] = cam_from_world.rotation
            centre[camera, frame] = cam_from_world.inverse.translation
    return rotation[seen.camera, seen.frame], centre[seen.camera, seen.frame]


def _ground(
    estimate: Estimate,
    seen: Observations,
    rotation: FloatArray,
    centre: FloatArray,
    rows: IntArray,
    normal: FloatArray,
    grid: FloatArray,
) -> FloatArray:
    """Where the rays of the reference patches' samples (n_grid, 2) meet the planes around their
    points, in the world (n, n_grid, 3). rows (n,): the references; normal (n, 3)."""
    point, camera, turn, from_here = (
        estimate.points[seen.point[rows]], seen.camera[rows], rotation[rows], centre[rows]
    )  # fmt: skip
    away = point - from_here
    middle = by_camera(project, estimate, camera, np.einsum("nij,nj->ni", turn, away)[:, None], 2)
    pixels = middle + grid * steps_px(seen)[rows, None, None]
    rays = by_camera(unproject, estimate, camera, pixels, 3)
    rays = np.einsum("nji,nkj->nki", turn, rays)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (away * normal).sum(1)[:, None] / np.einsum("nkj,nj->nk", rays, normal)
    distance[~(distance > 0)] = np.nan
    return from_here[:, None] + rays * distance[..., None]


def steps_px(seen: Observations) -> FloatArray:
    """Pixels (n_obs,) between two samples where an observation is its track's reference."""
    if seen.feature_scale is None:
        return np.full(len(seen), LEAST_STEP_PX)
    scale = np.nan_to_num(seen.feature_scale, nan=0.0)
    return np.maximum(LEAST_STEP_PX, STEP_OF_SCALE * scale)


def by_camera(
    how: object, estimate: Estimate, camera: IntArray, values: FloatArray, width: int
) -> FloatArray:
    """`project` or `unproject` of values (n, k, ...) through the camera (n,) of each."""
    result = np.full((*values.shape[:2], width), np.nan)
    for index, one in enumerate(estimate.cameras):
        rows = camera == index
        result[rows] = how(one, values[rows])  # type: ignore[operator]
    return result

"""Flat boards in images: transforms from corners, and the second one that explains them as well.

A flat board that is small in its image looks nearly the same when its tilt about the line of sight
is turned over (Schweighofer and Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014): two minima of the
reprojection error, of which only the depth's slight effect tells the right one.

Views are worked on all at once: their corners lie in one row each, view after view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from graphs.board_rows import normal_equations, transform_rows
from graphs.camera import Camera, lens_arrays, unproject
from graphs.frames import FloatArray, Transform
from graphs.lenses import IntArray, project_point_many

# A corner that cannot be projected counts as this far off: less would make hiding corners pay.
UNSEEN_PX = 1000.0
DAMPING_START, DAMPING_MOST = 1e-4, 1e8
CONVERGED = 1e-7  # relative fall of the squared error
SAME_ANGLE_RAD = np.radians(1.0)  # between solutions that are one


class SeenBoard(Protocol):
    """One view of the board: what `sfm_calib.boards.views.BoardView` holds."""

    @property
    def camera(self) -> int: ...
    @property
    def frame(self) -> int: ...
    @property
    def corner(self) -> IntArray: ...  # (n,) index into the board's corners
    @property
    def pixels(self) -> FloatArray: ...  # (n, 2)
    @property
    def sigma_px(self) -> FloatArray: ...  # (n,)


@dataclass(frozen=True)
class Transforms:
    """Many rigid transforms, `a_from_b` each."""

    rotation: FloatArray  # (n, 3, 3)
    translation: FloatArray  # (n, 3)

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, which: Any) -> Transforms:
        return Transforms(self.rotation[which], self.translation[which])

    def __matmul__(self, other: Transforms) -> Transforms:
        turned = np.einsum("...ij,...j->...i", self.rotation, other.translation)
        return Transforms(self.rotation @ other.rotation, turned + self.translation)

    @property
    def inverse(self) -> Transforms:
        back = np.swapaxes(self.rotation, -1, -2)
        return Transforms(back, -np.einsum("...ij,...j->...i", back, self.translation))

    def one(self, index: int) -> Transform:
        return Transform(self.rotation[index], self.translation[index])

    def whole(self) -> Transforms:
        """The same as contiguous writable arrays, else numba compiles once more."""
        rotation, translation = (
            np.require(each, requirements=["C", "W"]) for each in (self.rotation, self.translation)
        )
        return Transforms(rotation, translation)

    @staticmethod
    def of(transforms: Sequence[Transform]) -> Transforms:
        return Transforms(
            np.array([t.rotation for t in transforms]).reshape(-1, 3, 3),
            np.array([t.translation for t in transforms]).reshape(-1, 3),
        )

    @staticmethod
    def identities(count: int) -> Transforms:
        return Transforms(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def where(self, mask: NDArray[np.bool_], other: Transforms) -> Transforms:
        """This one's rows where the mask holds, the other's elsewhere."""
        return Transforms(
            np.where(mask[:, None, None], self.rotation, other.rotation),
            np.where(mask[:, None], self.translation, other.translation),
        )


@dataclass(frozen=True)
class Corners:
    """The corners of many views, one a row, view after view; no view is empty."""

    board: FloatArray  # (n, 3) in the board's frame
    pixels: FloatArray  # (n, 2)
    weight: FloatArray  # (n,) of the squared pixel error; its mean is near one
    view: IntArray  # (n,) 0 0 0 1 1 2 ...
    camera: IntArray  # (n_views,)

    @cached_property
    def begin(self) -> IntArray:
        """First row of each view (n_views,)."""
        return np.searchsorted(self.view, np.arange(len(self.camera)))

    @cached_property
    def counts(self) -> IntArray:
        return np.bincount(self.view, minlength=len(self.camera))

    def sums(self, values: FloatArray) -> FloatArray:
        """Values (n, ...) summed over the corners of each view (n_views, ...)."""
        summed: FloatArray = np.add.reduceat(values, self.begin, axis=0)
        return summed

    def means(self, values: FloatArray) -> FloatArray:
        """Weighted means of values (n, k) over the corners of each view (n_views, k)."""
        weights = np.maximum(self.sums(self.weight), 1e-300)[:, None]
        mean: FloatArray = self.sums(self.weight[:, None] * values) / weights
        return mean

    def of_views(self, views: NDArray[np.generic]) -> Corners:
        """Only these views, in the order given: indices (m,) or a mask (n_views,)."""
        views = np.arange(len(self.camera))[views]
        counts, begin = self.counts[views], self.begin[views]
        view = np.repeat(np.arange(len(views)), counts)
        before = np.cumsum(counts) - counts
        rows = begin[view] + np.arange(len(view)) - before[view]
        return Corners(
            self.board[rows], self.pixels[rows], self.weight[rows], view, self.camera[views]
        )

    def weighted(self, by_view: FloatArray) -> Corners:
        """The same with the weights of each view (n_views,) multiplied in."""
        return replace(self, weight=self.weight * by_view[self.view])


def gather(views: Sequence[SeenBoard], corners_m: FloatArray) -> Corners:
    """The corners of all views, weighed by 1 / sigma^2 relative to the median sigma's."""
    counts = [len(view.corner) for view in views]
    sigma = np.concatenate([view.sigma_px for view in views])
    return Corners(
        corners_m[np.concatenate([view.corner for view in views])],
        np.concatenate([view.pixels for view in views]),
        (np.median(sigma) / sigma) ** 2,
        np.repeat(np.arange(len(views)), counts),
        np.array([view.camera for view in views], dtype=np.int64),
    )


def exp_rotations(vectors: FloatArray) -> FloatArray:
    """Rotation matrices (n, 3, 3) of rotation vectors in radians (n, 3), by Rodrigues."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    safe = np.maximum(angle, 1e-12)
    cross = cross_matrices(vectors / safe[..., 0])
    result: FloatArray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return result


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Cross-product matrices (n, 3, 3) of vectors (n, 3)."""
    x, y, z = vectors.T
    zero = 0 * x
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


def angles_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles in radians (...) of the rotations that take a to b, matrices (..., 3, 3)."""
    # The chord keeps the digits of small angles, which the trace's cosine loses.
    chord = np.linalg.norm(a - b, axis=(-2, -1)) / np.sqrt(8)
    result: FloatArray = 2 * np.arcsin(np.minimum(chord, 1.0))
    return result


# ---- homographies --------------------------------------------------------------------------


def _normalised(corners: Corners) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Board corners (n, 2) centred and scaled within each view; centres (v, 2), scales (v,)."""
    flat = corners.board[:, :2]
    centre = corners.means(flat)
    off = flat - centre[corners.view]
    scale = np.sqrt(corners.means((off**2).sum(1)[:, None])[:, 0] / 2)
    scale = np.maximum(scale, 1e-12)
    return off / scale[corners.view, None], centre, scale


def homographies(corners: Corners, rays: FloatArray) -> FloatArray:
    """Homographies (v, 3, 3) from each view's centred and scaled board to unit rays (n, 3).

    Direct linear transform: ray x H (x, y, 1) = 0, for rays to all sides. NaN rays do not count.
    """
    flat, _, _ = _normalised(corners)
    seen = np.isfinite(rays[:, 0])
    weight = np.where(seen, corners.weight, 0.0)
    rays = np.where(seen[:, None], rays, 0.0)
    point = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    # The cross product's three rows squared and summed: (1 - ray ray') kron point point'.
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    outer = np.einsum("n,ni,nj->nij", weight, point, point)
    squares = corners.sums(np.einsum("nij,nkl->nikjl", across, outer)).reshape(-1, 9, 9)
    found = np.linalg.eigh(squares)[1][:, :, 0].reshape(-1, 3, 3)
    towards = np.einsum("ni,nij,nj->n", rays, found[corners.view], point)
    sign = np.sign(corners.sums(weight * towards))
    result: FloatArray = found * np.where(sign == 0, 1.0, sign)[:, None, None]
    return result


def linear_transforms(corners: Corners, rays: FloatArray) -> Transforms:
    """cam_from_board of each view by its homography to rays (n, 3): a start for `fit`."""
    found = homographies(corners, rays)
    _, centre, scale = _normalised(corners)
    left, size, right = np.linalg.svd(found[:, :, :2], full_matrices=False)
    first_two = left @ right
    third = np.cross(first_two[:, :, 0], first_two[:, :, 1])
    rotation = np.concatenate([first_two, third[:, :, None]], axis=2)
    distance = scale[:, None] * found[:, :, 2] / np.maximum(size.mean(1), 1e-12)[:, None]
    offset = np.einsum("vij,vj->vi", first_two, centre)
    return Transforms(rotation, distance - offset)


# ---- least squares of many transforms at once ------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """Corners seen through `cam_from_a @ a_from_b`, of which `fit` finds the latter.

    Boards of lone views: a is the camera. Boards of a rig's frames: a is the rig, b the board.
    Cameras of a rig: a is the camera, b the rig, with the points given there.
    """

    cameras: Sequence[Camera]
    corners: Corners
    points: FloatArray  # (n, 3) in b
    group: IntArray  # (n_views,) which transform each view has
    cam_from_a: Transforms  # (n_views,)

    @cached_property
    def lenses(self) -> tuple[IntArray, FloatArray, FloatArray]:
        return lens_arrays(self.cameras)

    @staticmethod
    def of_lone_views(cameras: Sequence[Camera], corners: Corners) -> Scene:
        count = len(corners.camera)
        return Scene(
            cameras, corners, corners.board, np.arange(count), Transforms.identities(count)
        )


def residuals(scene: Scene, a_from_b: Transforms) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixel errors (n, 2), derivatives by the point in the camera (n, 2, 3), and R x_b (n, 3)."""
    corners, outer = scene.corners, scene.cam_from_a
    n = len(corners.view)
    turned, in_cam = np.empty((n, 3)), np.empty((n, 3))
    transform_rows(
        scene.points, corners.view, scene.group, a_from_b.rotation, a_from_b.translation,
        outer.rotation, outer.translation, turned, in_cam,
    )  # fmt: skip
    pixels, by_point = np.empty((n, 2)), np.empty((n, 2, 3))
    project_point_many(*scene.lenses, corners.camera[corners.view], in_cam, pixels, by_point)
    error = pixels - corners.pixels
    error[np.isnan(error[:, 0])] = UNSEEN_PX / np.sqrt(2)
    return error, by_point, turned


def rms_px(corners: Corners, error: FloatArray) -> FloatArray:
    """Root mean squared length of the pixel errors (n, 2) of each view (n_views,)."""
    result: FloatArray = np.sqrt(corners.means((error**2).sum(1)[:, None])[:, 0])
    return result


def jacobians(by_point: FloatArray, turned: FloatArray) -> FloatArray:
    """Derivatives (n, 2, 6) by a turn about the axes of a, and by the translation."""
    return np.concatenate([np.cross(turned[:, None, :], by_point), by_point], axis=2)


def moved(transforms: Transforms, step: FloatArray) -> Transforms:
    """Each transform turned and shifted by its step (n, 6)."""
    return Transforms(
        exp_rotations(step[:, :3]) @ transforms.rotation, transforms.translation + step[:, 3:]
    )


def fit(scene: Scene, start: Transforms, iterations: int = 20) -> tuple[Transforms, FloatArray]:
    """a_from_b of each group by Levenberg and Marquardt, and the rms in px of each view."""
    rows = scene.group[scene.corners.view]
    weight = scene.corners.weight

    def costs(error: FloatArray) -> FloatArray:
        squares = weight * (error**2).sum(1)
        return np.bincount(rows, weights=squares, minlength=len(start)).astype(np.float64)

    now, damping = start.whole(), np.full(len(start), DAMPING_START)
    error, by_point, turned = residuals(scene, now)
    cost = costs(error)
    for _ in range(iterations):
        square, slope = _normal(scene, error, by_point, turned, len(start))
        tried = moved(now, -damped_solve(square, slope, damping))
        tried_error, tried_by_point, tried_turned = residuals(scene, tried)
        tried_cost = costs(tried_error)
        better = tried_cost < cost
        fall = np.where(better, 1 - tried_cost / np.maximum(cost, 1e-300), 0.0)
        damping = np.where(better, damping / 10, damping * 10)
        now = tried.where(better, now)
        taken = better[rows]
        error[taken], by_point[taken] = tried_error[taken], tried_by_point[taken]
        turned[taken] = tried_turned[taken]
        cost = np.where(better, tried_cost, cost)
        if np.all((better & (fall < CONVERGED)) | (~better & (damping > 1.0))):
            break
        damping = np.minimum(damping, DAMPING_MOST)
    return now, rms_px(scene.corners, error)


def _normal(
    scene: Scene, error: FloatArray, by_point: FloatArray, turned: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    square, slope = np.zeros((count, 6, 6)), np.zeros((count, 6))
    corners = scene.corners
    normal_equations(
        corners.view, scene.group, corners.weight, error, by_point, scene.cam_from_a.rotation,
        turned, square, slope,
    )  # fmt: skip
    lower = np.tril(square, -1)
    return square + np.swapaxes(lower, 1, 2), slope


def damped_solve(square: FloatArray, slope: FloatArray, damping: FloatArray) -> FloatArray:
    """Solutions (n, 6) of (square + damping diagonal) step = slope, scaled to unit diagonals."""
    diagonal = np.sqrt(np.maximum(np.diagonal(square, axis1=1, axis2=2), 1e-20))
    scaled = square / (diagonal[:, :, None] * diagonal[:, None, :])
    scaled = scaled + (damping[:, None, None] + 1e-12) * np.eye(square.shape[-1])
    step: FloatArray = np.linalg.solve(scaled, (slope / diagonal)[..., None])[..., 0] / diagonal
    return step


# ---- both solutions ------------------------------------------------------------------------


@dataclass(frozen=True)
class BothSolutions:
    """cam_from_board of each view: the one with the lower error first, and the other minimum."""

    first: Transforms  # (n_views,)
    first_rms_px: FloatArray  # (n_views,)
    second: Transforms  # (n_views,); the first again where there is only one
    second_rms_px: FloatArray  # (n_views,) infinity where there is only one

    @property
    def apart_rad(self) -> FloatArray:
        """Angle between the two (n_views,)."""
        return angles_between(self.first.rotation, self.second.rotation)


def turned_over(corners: Corners, cam_from_board: Transforms) -> Transforms:
    """The board mirrored through the plane across its line of sight: the other minimum's start."""
    centre = corners.means(corners.board)
    middle = np.einsum("vij,vj->vi", cam_from_board.rotation, centre) + cam_from_board.translation
    sight = middle / np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    mirror = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    first_two = mirror @ cam_from_board.rotation[:, :, :2]
    third = np.cross(first_two[:, :, 0], first_two[:, :, 1])
    rotation = np.concatenate([first_two, third[:, :, None]], axis=2)
    return Transforms(rotation, middle - np.einsum("vij,vj->vi", rotation, centre))


def solve_views(
    cameras: Sequence[Camera], corners: Corners, near: Transforms | None = None
) -> BothSolutions:
    """Both solutions of every view; `near`: where to start, if anything is known."""
    scene = Scene.of_lone_views(cameras, corners)
    if near is None:
        rays = np.full((len(corners.view), 3), np.nan)
        for index in np.unique(corners.camera):
            rows = corners.camera[corners.view] == index
            rays[rows] = unproject(cameras[index], corners.pixels[rows])
        near = linear_transforms(corners, rays)
    first, first_rms = fit(scene, near)
    second, second_rms = fit(scene, turned_over(corners, first))
    swap = second_rms < first_rms
    one, other = second.where(swap, first), first.where(swap, second)
    rms, other_rms = np.minimum(first_rms, second_rms), np.maximum(first_rms, second_rms)
    same = angles_between(one.rotation, other.rotation) < SAME_ANGLE_RAD
    same |= ~(other_rms < UNSEEN_PX / 4)
    return BothSolutions(one, rms, one.where(same, other), np.where(same, np.inf, other_rms))

"""How far two calibrations project apart, and how far their sigmas let that be chance.

A calibration says where a point is seen. Two of them are compared by that: pixels of A become
points at a range in A's rig, a change of frames takes these to B's rig, and B says where it sees
them. The change of frames is the one that leaves least, the same for all cameras of the rig: how a
rig is turned, and where on it its origin is, is no difference between calibrations (the "implied
transformation" of mrcal's projection differences, https://mrcal.secretsauce.net/differencing.html).
Units and the indices of cameras are as in `graphs.propagation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from graphs.camera import image_pixels, project, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, exp_rotation, median_rotation
from graphs.problem import Estimate, IntArray
from graphs.propagation import projection
from graphs.uncertainty import SHAPE

FIT_SHAPE = (17, 13)  # pixels across and down by which the change of frames is judged; odd: centre
FAR = 1e6  # in place of infinity, of a camera's distance from the rig's origin
ITERATIONS, HALVINGS = 50, 8
CONVERGED_PX = 1e-7  # rms step in the picture


@dataclass(frozen=True)
class Stated:
    """A calibration and the covariance that it states: no names, where it states none."""

    estimate: Estimate
    covariance: Covariance

    def scaled(self, factor: float) -> Stated:
        """The same in units `factor` times smaller."""
        by = np.array([factor if ".translation_" in n else 1.0 for n in self.covariance.names])
        matrix = self.covariance.matrix * by[:, None] * by
        return Stated(self.estimate.scaled(factor), Covariance(self.covariance.names, matrix))

    @cached_property
    def root(self) -> FloatArray:
        """L (n, n) with L L' the covariance."""
        if not self.covariance.names:
            return np.zeros((0, 0))
        scale = np.sqrt(np.maximum(np.diag(self.covariance.matrix), 0.0))
        safe = np.where(scale > 0, scale, 1.0)
        values, vectors = np.linalg.eigh(self.covariance.matrix / safe[:, None] / safe)
        root: FloatArray = safe[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        return root


# ---- what is looked at ---------------------------------------------------------------------


@dataclass(frozen=True)
class Sights:
    """Pixels of A's images and the points that A sees there, at ranges from each camera."""

    camera: IntArray  # (n,) index into `Estimate.cameras`
    range: FloatArray  # (n,) inf where so far that translations do not matter
    pixels: FloatArray  # (n, 2)
    points: FloatArray  # (n, 3) in A's rig; NaN where A sees nothing

    def of(self, camera: int) -> Sights:
        """Those of one camera."""
        rows = self.camera == camera
        return Sights(self.camera[rows], self.range[rows], self.pixels[rows], self.points[rows])


def sights(
    estimate: Estimate,
    ranges: Sequence[float],
    cameras: Sequence[int],
    shape: tuple[int, int] = FIT_SHAPE,
) -> Sights:
    """A grid over each image at each range; NaN points where the lens knows no ray of a pixel."""
    owner, distance, pixels, points = [], [], [], []
    for index in cameras:
        camera, cam_from_rig = estimate.cameras[index], estimate.cam_from_rig[index]
        grid = image_pixels(camera.size, shape)[2]
        rays = unproject(camera, grid)
        far = FAR * max(float(np.linalg.norm(cam_from_rig.translation)), 1.0)
        for one in ranges:
            owner.append(np.full(len(grid), index))
            distance.append(np.full(len(grid), one))
            pixels.append(grid)
            points.append(cam_from_rig.inverse @ (min(one, far) * rays))
    return Sights(
        np.concatenate(owner), np.concatenate(distance), np.concatenate(pixels),
        np.concatenate(points),
    )  # fmt: skip


@dataclass(frozen=True)
class Change:
    """Of frames, and of the unit of length where that is not known: B's rig from A's."""

    b_from_a: Transform
    scale: float = 1.0  # B's lengths are multiplied by it


def seen_by(b: Estimate, change: Change, at: Sights) -> FloatArray:
    """Pixels (n, 2) at which B sees the points of A; NaN where it does not."""
    pixels = np.full((len(at.points), 2), np.nan)
    for index in np.unique(at.camera):
        rows = at.camera == index
        pixels[rows] = project(b.cameras[index], _cam_from_a(b, change, index) @ at.points[rows])
    return pixels


def _cam_from_a(b: Estimate, change: Change, index: int) -> Transform:
    return b.cam_from_rig[index].scaled(change.scale) @ change.b_from_a


# ---- the change of frames ------------------------------------------------------------------


def by_change(
    b: Estimate, change: Change, at: Sights, translation: bool, scale: bool
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) as `seen_by`, and derivatives (n, 2, k) by the change.

    By a turn (rad) about the axes of B's rig; then by a translation; then by the scale's
    logarithm, where they are free. Zero where B does not see the point.
    """
    pixels = np.full((len(at.points), 2), np.nan)
    J = np.zeros((len(at.points), 2, 3 + 3 * translation + scale))
    in_b = replace(b, cam_from_rig=tuple(t.scaled(change.scale) for t in b.cam_from_rig))
    for index in np.unique(at.camera):
        rows = at.camera == index
        view = projection(in_b, int(index), change.b_from_a @ at.points[rows])
        turned = at.points[rows] @ change.b_from_a.rotation.T
        pixels[rows] = view.pixels
        J[rows, :, :3] = np.cross(np.nan_to_num(turned)[:, None, :], view.by_point)
        if translation:
            J[rows, :, 3:6] = view.by_point
        if scale:
            cam_from_rig = in_b.cam_from_rig[index]
            in_rig = cam_from_rig.rotation.T @ cam_from_rig.translation
            J[rows, :, -1] = view.by_point @ in_rig
    return pixels, J


def fit_change(a: Estimate, b: Estimate, at: Sights, translation: bool, scale: bool) -> Change:
    """The change of frames, and of scale where that is free, that leaves least between A and B.

    Least squares of the pixels by Gauss-Newton, steps shortened until they gain. What B does not
    see counts as far away as the image is wide.
    """
    change = _start(a, b, sorted({int(index) for index in at.camera}), translation)
    unseen = np.array([np.hypot(*camera.size) for camera in b.cameras])[at.camera, None]

    def error(of: Change) -> FloatArray:
        left = seen_by(b, of, at) - at.pixels
        return np.where(np.isnan(left), unseen, left).ravel()

    left = error(change)
    for _ in range(ITERATIONS):
        J = by_change(b, change, at, translation, scale)[1].reshape(len(left), -1)
        size = np.maximum(np.linalg.norm(J, axis=0), np.finfo(np.float64).tiny)
        J = J / size
        step = -np.linalg.lstsq(J.T @ J, J.T @ left)[0] / size
        if np.linalg.norm(J @ (step * size)) <= CONVERGED_PX * len(left) ** 0.5:
            break
        tried = _moved(change, step, translation, scale)
        new = error(tried)
        for _ in range(HALVINGS):
            if new @ new <= left @ left:
                break
            step = step / 4
            tried = _moved(change, step, translation, scale)
            new = error(tried)
        if not new @ new <= left @ left:
            break
        change, left = tried, new
    return change


def _start(a: Estimate, b: Estimate, cameras: Sequence[int], translation: bool) -> Change:
    each = [b.cam_from_rig[i].inverse @ a.cam_from_rig[i] for i in cameras]
    rotation = median_rotation(np.array([t.rotation for t in each]))
    if not translation:
        return Change(Transform(rotation, np.zeros(3)))
    centres_a, centres_b = (
        np.array([e.cam_from_rig[i].inverse.translation for i in cameras]) for e in (a, b)
    )
    return Change(Transform(rotation, centres_b.mean(0) - rotation @ centres_a.mean(0)))


def _moved(change: Change, step: FloatArray, translation: bool, scale: bool) -> Change:
    old = change.b_from_a
    shift = step[3:6] if translation else np.zeros(3)
    moved = Transform(exp_rotation(step[:3]) @ old.rotation, old.translation + shift)
    return Change(moved, change.scale * (float(np.exp(step[-1])) if scale else 1.0))


# ---- the difference ------------------------------------------------------------------------


@dataclass(frozen=True)
class Frames:
    """What of the two calibrations is compared, and what may be changed to make them agree."""

    groups: tuple[tuple[int, ...], ...]  # cameras that share one change of frames
    ranges: tuple[float, ...]
    translation: bool  # may be changed, beside the rotation
    scale: bool


@dataclass(frozen=True)
class Difference:
    """B less A in the picture, after the change of frames that leaves least."""

    a: Estimate
    b: Estimate
    frames: Frames
    changes: tuple[Change, ...]  # of each group

    def of_camera(self, camera: int) -> Change:
        return next(
            change
            for group, change in zip(self.frames.groups, self.changes, strict=True)
            if camera in group
        )

    def over_image(
        self, camera: int, distance: float, shape: tuple[int, int] = SHAPE
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x (columns,) and y (rows,) in px, and where B sees what A sees there, less that pixel
        (rows, columns, 2); NaN where one of them sees nothing."""
        across, down, _ = image_pixels(self.a.cameras[camera].size, shape)
        moved = self.at(sights(self.a, (distance,), (camera,), shape))
        return across, down, moved.reshape(len(down), len(across), 2)

    def at(self, looked: Sights) -> FloatArray:
        """The difference (n, 2) in px at A's sights; NaN where one of them sees nothing."""
        left = np.full_like(looked.pixels, np.nan)
        for index in np.unique(looked.camera):
            some = looked.of(int(index))
            left[looked.camera == index] = (
                seen_by(self.b, self.of_camera(int(index)), some) - some.pixels
            )
        return left


def difference(a: Estimate, b: Estimate, frames: Frames) -> Difference:
    """Fit the change of frames of each group of cameras. Cameras must have the same indices."""
    changes = tuple(
        fit_change(a, b, sights(a, frames.ranges, group), frames.translation, frames.scale)
        for group in frames.groups
    )
    return Difference(a, b, frames, changes)

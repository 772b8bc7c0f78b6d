"""Clouds moved onto each other by ICP: what it found, and whether to trust it.

Point-to-plane ICP (Chen and Medioni, 1992) over the points that `overlap` says lie on the same
surface. Open3D's ICP takes every point within a distance, and pulls the borders of clouds together
that overlap but partly. Three simulated depth cameras around a head, a side one moved by 4 degrees
and 30 mm, 2 mm of noise: Open3D's ends 50 mm off with correspondences within 50 mm, 7 mm off with
20 mm; this 0.2 to 0.6 mm, and with 4 mm of noise 0.5 to 1.6 mm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphs.frames import Transform
from sfm_calib.depth.cloud import Cloud, evenly, normals_towards
from sfm_calib.depth.overlap import Overlap, overlap

Method = Literal["none", "icp"]

MAX_CORRESPONDENCE_M = 0.05
ITERATIONS = 100
# A step that moves points by less is the last: of the largest correspondence, or of the spacing of
# points where that is more, for which neighbour is nearest changes to and fro.
SETTLED, SETTLED_SPACINGS = 1e-3, 1e-2
MOST_POINTS = 20_000  # that are moved, spread evenly: ten times as many find the same
LEAST_POINTS = 100  # of an overlap: fewer are chance
WORSE = 1.05  # rms after over before: a good start is hardly improved
# Of the motion that an overlap fixes least (`hold_of`). Of a simulated head 0.010 to 0.012; of a
# wall, a sphere, an edge of two walls below 0.0001. All with noise of 0 to 5 mm.
LEAST_HOLD = 0.002


@dataclass(frozen=True)
class Registration:
    """What was found of each camera's part; a transform takes the part to where it fits."""

    transforms: tuple[Transform, ...]  # in the rig's frame; the identity where it failed
    fitness: tuple[float, ...]  # share of the points that lie on what they were moved onto
    rms_m: tuple[float, ...]  # of these, across the surface
    reasons: tuple[str, ...]  # why it failed; empty: it did not

    @property
    def failed(self) -> tuple[bool, ...]:
        return tuple(bool(reason) for reason in self.reasons)

    def corrected(self, cam_from_rig: Sequence[Transform]) -> tuple[Transform, ...]:
        """The rig by which the parts would have fitted at once."""
        return tuple(
            cam @ fit.inverse for cam, fit in zip(cam_from_rig, self.transforms, strict=True)
        )


def moved(cloud: Cloud, transforms: Sequence[Transform]) -> Cloud:
    """Each camera's part moved by its transform; points stay in their order."""
    points = cloud.points.copy()
    normals = None if cloud.normals is None else cloud.normals.copy()
    for index, transform in enumerate(transforms):
        rows = cloud.camera == index
        points[rows] = transform @ points[rows]
        if normals is not None:
            normals[rows] = normals[rows] @ transform.rotation.T
    return Cloud(points, cloud.camera, normals)


def register(
    cloud: Cloud,
    method: Method = "icp",
    max_correspondence_m: float = MAX_CORRESPONDENCE_M,
    reference: int = 0,
) -> Registration:
    """Move each camera's part onto the others; the reference's stays.

    One after the other, the one that shares most with those in place first, onto all of these.
    Where that fails, a part stays where it was, and the reason is told.
    """
    cameras = sorted({reference, *cloud.camera.tolist()})
    placed = {reference: Fit(cloud.of(reference), Transform.identity(), 1.0, 0.0, "")}
    if method == "none":
        return _registration(dict.fromkeys(cameras, placed[reference]), cameras[-1] + 1)
    left = {index: with_normals(cloud.of(index)) for index in cameras}
    placed[reference] = Fit(left.pop(reference), Transform.identity(), 1.0, 0.0, "")
    while left:
        others = joined([fit.part for fit in placed.values()])
        shared = {i: overlap(part, others, max_correspondence_m) for i, part in left.items()}
        index = max(left, key=lambda i: len(shared[i].points))
        placed[index] = fit_part(left.pop(index), others, shared[index], max_correspondence_m)
    return _registration(placed, cameras[-1] + 1)


def _registration(placed: Mapping[int, Fit], count: int) -> Registration:
    none = Fit(joined([]), Transform.identity(), 0.0, 0.0, "it has no points")
    fits = [placed.get(index, none) for index in range(count)]
    return Registration(
        tuple(fit.transform for fit in fits),
        tuple(fit.fitness for fit in fits),
        tuple(fit.rms_m for fit in fits),
        tuple(fit.reason for fit in fits),
    )


def with_normals(cloud: Cloud) -> Cloud:
    """The cloud with normals: its own, or to one side of each, whichever."""
    if cloud.normals is not None:
        return cloud
    normals = normals_towards(cloud.points, cloud.points.mean(axis=0))
    return Cloud(cloud.points, cloud.camera, normals)


def joined(parts: Sequence[Cloud]) -> Cloud:
    """One cloud of several with normals."""
    points = np.concatenate([np.zeros((0, 3)), *(part.points for part in parts)])
    camera = np.concatenate([np.zeros(0, dtype=np.int64), *(part.camera for part in parts)])
    normals = [part.normals for part in parts if part.normals is not None]
    return Cloud(points, camera, np.concatenate([np.zeros((0, 3)), *normals]))


# ---- one part ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fit:
    """A part where it was put, and why not where ICP would have it."""

    part: Cloud
    transform: Transform
    fitness: float
    rms_m: float
    reason: str


def fit_part(part: Cloud, others: Cloud, before: Overlap, max_m: float) -> Fit:
    """A part onto the others; where it was, if the fit is none. before: how it overlapped."""
    if few := _few(before, max_m):
        return Fit(part, Transform.identity(), before.share, before.rms_m, few)
    some = part.only(evenly(len(part.points), MOST_POINTS))
    settled_m = max(SETTLED * max_m, SETTLED_SPACINGS * others.spacing_m)
    fit, settled = icp(lambda at: overlap(some.moved(at), others, max_m), settled_m)
    after = overlap(part.moved(fit), others, max_m)
    reason = _few(after, max_m) or _doubt(before, after, fit, max_m)
    reason = reason or ("" if settled else f"ICP did not settle in {ITERATIONS} steps")
    if reason:
        return Fit(part, Transform.identity(), before.share, before.rms_m, reason)
    return Fit(part.moved(fit), fit, after.share, after.rms_m, "")


def _few(pairs: Overlap, max_m: float) -> str:
    """Why an overlap is none; nothing, where it is one."""
    if len(pairs.points) >= LEAST_POINTS:
        return ""
    return (
        f"{len(pairs.points)} points overlap with those of other cameras within {1e3 * max_m:g} "
        f"mm, and {LEAST_POINTS} are needed"
    )


def _doubt(before: Overlap, after: Overlap, fit: Transform, max_m: float) -> str:
    """Why a fit is none; nothing, where it may be one.

    How the surface holds is judged afterwards: of parts far apart, wrong points are matched.
    """
    if (hold := hold_of(after)) < LEAST_HOLD:
        return (
            f"its overlap is flat or round and slides along itself (hold {max(hold, 0.0):.2g}, "
            f"needs {LEAST_HOLD:g})"
        )
    shift_m = float(np.median(np.linalg.norm(fit @ before.points - before.points, axis=1)))
    if shift_m > max_m:
        return (
            f"ICP moved the overlap by {1e3 * shift_m:.0f} mm, beyond the {1e3 * max_m:g} mm in "
            "which it looks for points: it diverged"
        )
    if after.rms_m > WORSE * before.rms_m:
        return (
            f"the overlap is {1e3 * after.rms_m:.3g} mm rms apart after ICP, and was "
            f"{1e3 * before.rms_m:.3g} mm before"
        )
    return ""


def hold_of(fitted: Overlap) -> float:
    """How well an overlap fixes the motion that it fixes least: mean square of how far points
    leave the surface, over that of a shift straight across a plane. Turns count by how far they
    move points at the overlap's rms radius.

    Normals of both sides err independently: their product has no bias, as a square would.
    """
    off = fitted.points - fitted.points.mean(axis=0)
    off /= np.sqrt((off**2).sum(axis=1).mean())
    a, b = (np.hstack([n, np.cross(off, n)]) for n in (fitted.normals, fitted.facing))
    return float(np.linalg.eigvalsh((a.T @ b + b.T @ a) / (2 * len(off)))[0])


# ---- ICP -----------------------------------------------------------------------------------


def icp(
    match: Callable[[Transform], Overlap], settled_m: float, start: Transform | None = None
) -> tuple[Transform, bool]:
    """The motion that brings points onto a surface, and whether it settled.

    match: the points as a motion has them, those that lie on the surface.
    """
    found = start or Transform.identity()
    for _ in range(ITERATIONS):
        pairs = match(found)
        if not len(pairs.points):
            return found, False
        step = plane_step(pairs)
        found = step @ found
        if np.linalg.norm(step @ pairs.points - pairs.points, axis=1).max() < settled_m:
            return found, True
    return found, False


def plane_step(pairs: Overlap) -> Transform:
    """The smallest motion that brings points nearest to the planes they lie over, to first order.

    About their mean: far from the origin, a turn and a shift could not be told apart.
    """
    mean = pairs.points.mean(axis=0)
    off = pairs.points - mean
    J = np.hstack([np.cross(off, pairs.normals), pairs.normals])
    step = -np.linalg.lstsq(J.T @ J, J.T @ pairs.apart_m)[0]
    turn = Transform.exp(step[:3], step[3:])
    return Transform(turn.rotation, mean + turn.translation - turn.rotation @ mean)

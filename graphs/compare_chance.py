"""Whether the difference of two calibrations is more than their covariances explain.

See `graphs.compare` for what a difference is; here it is held against its own covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from graphs.compare import Change, Difference, Frames, Sights, Stated, by_change, difference, sights
from graphs.compare_rig import as_lens
from graphs.covariance import NOTHING
from graphs.frames import FloatArray, Transform, exp_rotation, log_rotation
from graphs.problem import Estimate
from graphs.propagation import projection

# A direction counts where draws of the covariances move the picture as their derivatives say to
# this part of a sigma; with 0.3, p-values of drawn pairs are uniform (tests/test_compare_maths.py).
MOST_NONLINEAR = 0.3
DRAWS, SEED = 8, 0
LEAST_SHARE_SEEN = 0.9  # of the pixels: a draw that loses more says nothing
LEAST_RELATIVE = 1e-5  # sigma of a direction over the largest: less is rounding
LEAST_SIGMA_PX = 1e-5  # ten times what unprojecting leaves
ROOM = 3.0  # sigmas, of what a direction that does not count may hold
NO_CHANGE = Change(Transform.identity())


@dataclass(frozen=True)
class ChiSquare:
    """The difference in the picture against the two covariances, a change of frames apart."""

    chi2: float
    rank: int  # directions that count
    n_parameters: int  # with sigmas, on the side that states more
    p_value: float  # of a larger chi2, if the sigmas are true
    difference_px: float  # rms over all images and ranges
    expected_px: float  # rms that the covariances let expect
    outside_px: float  # rms of what lies along no direction that has a sigma, or beyond it


def chi_square(a: Stated, b: Stated, frames: Frames) -> ChiSquare | None:
    """None where neither states a covariance that shows in the picture.

    The difference y of all pixels is linear in the errors of A and B, y = P (J_b e_b - J_a e_a),
    with P the projection that takes out the change of frames, and derivatives half way between the
    two. Along the eigenvectors of its covariance it is normal and independent. Counted are those
    along which drawn errors move the picture linearly but for MOST_NONLINEAR of their sigma: a
    change of frames all but absorbs some (a principal point with a rotation), and curvature may
    fill what is left. Of sigmas so large that none counts, the rank is 0 and p is 1.
    """
    found = difference(a.estimate, b.estimate, frames)
    every = [index for group in frames.groups for index in group]
    apart = found.at(sights(a.estimate, frames.ranges, every))
    halves = [_halfway(a, b, found, -1), _halfway(b, a, found, 1)]
    in_b = tuple(distance / found.changes[0].scale for distance in frames.ranges)
    asked = [frames, replace(frames, ranges=in_b)]
    looked = [
        sights(half.estimate, of.ranges, every) for half, of in zip(halves, asked, strict=True)
    ]
    kept = np.asarray(np.isfinite(np.hstack([apart, *(at.points for at in looked)])).all(1))
    without = _Without(halves[0].estimate, frames, looked[0], kept)
    root = np.hstack(
        [
            sign * without(_by_calibration(half, at)[kept] @ half.root)
            for sign, half, at in zip((-1, 1), halves, looked, strict=True)
        ]
    )
    if not np.linalg.norm(root) > LEAST_SIGMA_PX * len(root) ** 0.5:
        return None
    vectors, sigma = _directions(root)
    curvature = _nonlinear(halves, looked, asked, kept, without, vectors)
    counts = curvature <= MOST_NONLINEAR * sigma
    left = without(apart[kept])
    along = vectors.T @ left
    chi2, rank = float(((along / sigma)[counts] ** 2).sum()), int(counts.sum())
    # Along the others a difference may be as large as sigma and curvature make it, not larger.
    reached = counts | (np.abs(along) <= ROOM * np.hypot(sigma, curvature))
    inside = float(along[reached] @ along[reached])
    n_pixels = int(kept.sum())
    return ChiSquare(
        chi2,
        rank,
        max(len(a.covariance.names), len(b.covariance.names)),
        float(stats.chi2.sf(chi2, rank)) if rank else 1.0,
        float((left @ left / n_pixels) ** 0.5),
        float(((sigma**2).sum() / n_pixels) ** 0.5),
        max(float(left @ left) - inside, 0.0) ** 0.5 / n_pixels**0.5,
    )


def _directions(root: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal directions (m, k) in the picture and sigmas (k,) along them, of L L' for a root
    L (m, n), but for those that are rounding."""
    values, turned = np.linalg.eigh(root.T @ root)
    sigma: FloatArray = np.sqrt(np.maximum(values, 0.0))
    stated = sigma > max(LEAST_RELATIVE * float(sigma[-1]), LEAST_SIGMA_PX * len(root) ** 0.5)
    kept: FloatArray = sigma[stated]
    return root @ turned[:, stated] / kept, kept


def _halfway(side: Stated, other: Stated, found: Difference, sign: int) -> Stated:
    """A side half as far from the other, in its own lenses and frame; sign: -1 of A, 1 of B.

    There derivatives leave out nothing of second order of what lies between the two.
    """
    cameras, placed = [], []
    for index, camera in enumerate(side.estimate.cameras):
        alike, error_px = as_lens(Stated(other.estimate, NOTHING), index, camera.lens)
        there = alike.estimate.cameras[index].params
        half = (camera.params + there) / 2 if np.isfinite(error_px) else camera.params
        cameras.append(replace(camera, params=half))
        change = found.of_camera(index)
        target = other.estimate.cam_from_rig[index]
        if sign < 0:
            target = target.scaled(change.scale) @ change.b_from_a
        else:
            target = (target @ change.b_from_a.inverse).scaled(1 / change.scale)
        here = side.estimate.cam_from_rig[index]
        turn = exp_rotation(log_rotation(target.rotation @ here.rotation.T) / 2)
        middle = (here.translation + target.translation) / 2
        placed.append(Transform(turn @ here.rotation, middle))
    estimate = replace(side.estimate, cameras=tuple(cameras), cam_from_rig=tuple(placed))
    return Stated(estimate, side.covariance)


class _Without:
    """Takes out of moves (n, 2, ...) of pixels what a change of frames undoes: (2 n, ...)."""

    def __init__(
        self, estimate: Estimate, frames: Frames, at: Sights, kept: NDArray[np.bool_]
    ) -> None:
        J = by_change(estimate, NO_CHANGE, at, frames.translation, frames.scale)[1]
        columns = [
            np.where(np.isin(at.camera, group)[:, None, None], J, 0.0)[kept]
            for group in frames.groups
        ]
        all_ = np.concatenate(columns, axis=-1).reshape(2 * int(kept.sum()), -1)
        size = np.linalg.norm(all_, axis=0)
        vectors, values, _ = np.linalg.svd(all_[:, size > 0] / size[size > 0], full_matrices=False)
        self.basis: FloatArray = vectors[:, values > 1e-9 * values[0]]

    def __call__(self, moves: FloatArray) -> FloatArray:
        flat = moves.reshape(2 * len(moves), *moves.shape[2:])
        left: FloatArray = flat - self.basis @ (self.basis.T @ flat)
        return left


def _by_calibration(side: Stated, at: Sights) -> FloatArray:
    """Derivatives (n, 2, n_names) of where a side sees points by its covariance's parameters."""
    place = {name: index for index, name in enumerate(side.covariance.names)}
    J = np.zeros((len(at.points), 2, len(place)))
    for index in np.unique(at.camera):
        rows = np.flatnonzero(at.camera == index)
        view = projection(side.estimate, int(index), at.points[rows])
        blind = np.asarray(np.isnan(view.pixels).any(-1))
        for column, name in enumerate(view.names):
            if name in place:
                moved = view.by_calibration[:, :, column]
                J[rows, :, place[name]] = np.where(blind[:, None], 0.0, moved)
    return J


def _nonlinear(
    sides: Sequence[Stated],
    looked: Sequence[Sights],
    asked: Sequence[Frames],
    kept: NDArray[np.bool_],
    without: _Without,
    vectors: FloatArray,
) -> FloatArray:
    """rms (k,) along each direction of what linear propagation misses of drawn errors."""
    rng = np.random.default_rng(SEED)
    total = np.zeros(vectors.shape[1])
    every = [index for group in asked[0].groups for index in group]
    for side, at, frames in zip(sides, looked, asked, strict=True):
        if not side.covariance.names:
            continue
        J = _by_calibration(side, at)
        for _ in range(DRAWS):
            error = side.root @ rng.standard_normal(len(side.root))
            one, other = (
                changed(side.estimate, side.covariance.names, half * error) for half in (-0.5, 0.5)
            )
            moved = difference(one, other, frames).at(sights(one, frames.ranges, every))
            lost = np.asarray(np.isnan(moved).any(1))
            if lost[kept].mean() > 1 - LEAST_SHARE_SEEN:
                return np.full(len(total), np.inf)
            missed = np.where(lost[:, None], 0.0, moved - J @ error)
            total += (vectors.T @ without(missed[kept])) ** 2 / DRAWS
    return np.sqrt(total)


def changed(estimate: Estimate, names: Sequence[str], change: FloatArray) -> Estimate:
    """The estimate with named parameters moved by `change` (n,), in a covariance's units."""
    moves = dict(zip(names, change.tolist(), strict=True))
    cameras, transforms = [], []
    for camera, cam_from_rig in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        by = [moves.get(f"{camera.name}.{name}", 0.0) for name in camera.names]
        cameras.append(replace(camera, params=camera.params + by))
        turn, step = (
            np.array([moves.get(f"{camera.name}.{kind}_{axis}", 0.0) for axis in "xyz"])
            for kind in ("rotation", "translation")
        )
        rotation = exp_rotation(turn) @ cam_from_rig.rotation
        transforms.append(Transform(rotation, cam_from_rig.translation + step))
    return replace(estimate, cameras=tuple(cameras), cam_from_rig=tuple(transforms))

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
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, exp_rotation
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
    with P the projection that takes out the change of frames. Along the eigenvectors of its
    covariance it is normal and independent. Counted are those along which drawn errors move the
    picture linearly but for MOST_NONLINEAR of their sigma: what a change of frames all but absorbs
    (a principal point with a rotation) leaves directions so small that curvature fills them.
    Of sigmas so large that none counts, the rank is 0 and p is 1.
    """
    found = difference(a.estimate, b.estimate, frames)
    every = [index for group in frames.groups for index in group]
    at = sights(a.estimate, frames.ranges, every)
    apart = found.at(at)
    kept = np.asarray(np.isfinite(apart).all(1))
    without = _Without(found, at, kept)
    root = np.hstack(
        [
            -without(_by_calibration(a, at, None)[kept] @ a.root),
            without(_by_calibration(b, at, found)[kept] @ b.root),
        ]
    )
    if not np.linalg.norm(root) > LEAST_SIGMA_PX * len(root) ** 0.5:
        return None
    vectors, sigma = _directions(root)
    curvature = _nonlinear((a, b), frames, every, kept, without, vectors)
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
        float((max(left @ left - inside, 0.0) / n_pixels) ** 0.5),
    )


def _directions(root: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal directions (m, k) in the picture and sigmas (k,) along them, of L L' for a root
    L (m, n), but for those that are rounding."""
    values, turned = np.linalg.eigh(root.T @ root)
    sigma: FloatArray = np.sqrt(np.maximum(values, 0.0))
    stated = sigma > max(LEAST_RELATIVE * float(sigma[-1]), LEAST_SIGMA_PX * len(root) ** 0.5)
    kept: FloatArray = sigma[stated]
    return root @ turned[:, stated] / kept, kept


class _Without:
    """Takes out of moves (n, 2, ...) of pixels what a change of frames undoes: (2 n, ...)."""

    def __init__(self, found: Difference, at: Sights, kept: NDArray[np.bool_]) -> None:
        columns = []
        for group, change in zip(found.frames.groups, found.changes, strict=True):
            J = by_change(found.b, change, at, found.frames.translation, found.frames.scale)[1]
            J[~np.isin(at.camera, group)] = 0.0
            columns.append(J[kept].reshape(2 * int(kept.sum()), -1))
        all_ = np.hstack(columns)
        size = np.linalg.norm(all_, axis=0)
        vectors, values, _ = np.linalg.svd(all_[:, size > 0] / size[size > 0], full_matrices=False)
        self.basis: FloatArray = vectors[:, values > 1e-9 * values[0]]

    def __call__(self, moves: FloatArray) -> FloatArray:
        flat = moves.reshape(2 * len(moves), *moves.shape[2:])
        left: FloatArray = flat - self.basis @ (self.basis.T @ flat)
        return left


def _by_calibration(side: Stated, at: Sights, found: Difference | None) -> FloatArray:
    """Derivatives (n, 2, n_names) of where a side sees points by its covariance's parameters.

    found: how A's points are placed in the side's rig, where it is B.
    """
    place = {name: index for index, name in enumerate(side.covariance.names)}
    J = np.zeros((len(at.points), 2, len(place)))
    for index in np.unique(at.camera):
        rows = np.flatnonzero(at.camera == index)
        change = found.of_camera(int(index)) if found else NO_CHANGE
        scaled = tuple(t.scaled(change.scale) for t in side.estimate.cam_from_rig)
        estimate = replace(side.estimate, cam_from_rig=scaled)
        view = projection(estimate, int(index), change.b_from_a @ at.points[rows])
        blind = np.asarray(np.isnan(view.pixels).any(-1))
        for column, name in enumerate(view.names):
            if name in place:
                by = change.scale if ".translation_" in name else 1.0
                moved = by * view.by_calibration[:, :, column]
                J[rows, :, place[name]] = np.where(blind[:, None], 0.0, moved)
    return J


def _nonlinear(
    sides: Sequence[Stated],
    frames: Frames,
    every: Sequence[int],
    kept: NDArray[np.bool_],
    without: _Without,
    vectors: FloatArray,
) -> FloatArray:
    """rms (k,) along each direction of what linear propagation misses of drawn errors."""
    rng = np.random.default_rng(SEED)
    total = np.zeros(vectors.shape[1])
    for side in sides:
        if not side.covariance.names:
            continue
        at = sights(side.estimate, frames.ranges, every)
        J = _by_calibration(side, at, None)
        for _ in range(DRAWS):
            error = side.root @ rng.standard_normal(len(side.root))
            drawn = changed(side.estimate, side.covariance.names, error)
            moved = difference(side.estimate, drawn, frames).at(at)
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


NOTHING = Covariance((), np.zeros((0, 0)))

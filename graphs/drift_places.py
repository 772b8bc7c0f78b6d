"""Where the cameras of a rig sit to each other, twice: whether that changed, and which one moved.

Places are known relative to each other only. A change g of the rig's frame shows in every camera's
left twist as Ad(cam_from_rig) g, one of its size as (0, t): if the reference moved, all others seem
to. What is judged is free of both. The changes of some cameras are projected on what no g makes
(an S-transformation of geodesy's free networks; Koch, "Parameter estimation and hypothesis testing
in linear models", 1999): if what is left is chance, these cameras sit as they sat.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from graphs.frames import FloatArray, Transform
from graphs.pose_covariance import adjoint
from graphs.significance import Guess, Significance, degrees, significance

# Cameras that sit as they sat are taken for moved in so many of 100 cases: beyond that, of sets of
# cameras whose moving would explain a change, all are named that explain it nearly as well: chi2
# larger by no more than 2 ln 100, a likelihood a hundred times smaller.
UNLIKELY = 0.01
LESS_LIKELY_CHI2 = 2 * np.log(1 / UNLIKELY)
LEAST_GAUGE = 1e-9  # of the largest change by a frame: centres in one place have no size
# Variance of a camera that says nothing of the frame, over the largest variance.
NO_SAY = 1e6


@dataclass(frozen=True)
class Places:
    """Changes of all cameras' places, each a left twist: rotation, translation; in px."""

    change: FloatArray  # (6 n,)
    cov: FloatArray  # (6 n, 6 n) px^2
    guesses: tuple[Guess, ...]  # parts of it that rest on how much frames differ
    frames: FloatArray  # (6 n, g) orthonormal: what changes of the rig's frame, and size, can do

    @property
    def n_cameras(self) -> int:
        return len(self.change) // 6

    def without_frames(self, cameras: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """What no frame explains of some cameras' changes (m,), and B (6 k, m) orthonormal with
        that being B' change."""
        rows = _rows(cameras)
        basis, values, _ = np.linalg.svd(self.frames[rows])
        free = basis[:, int((values > LEAST_GAUGE).sum()) :]
        return free.T @ self.change[rows], free

    def gauge_free(self, cameras: Sequence[int]) -> Significance:
        """Whether some cameras sit to each other as they sat."""
        rows = _rows(cameras)
        change, free = self.without_frames(cameras)
        part = np.zeros((free.shape[1], len(self.change)))
        part[:, rows] = free.T
        cov = part @ self.cov @ part.T
        return significance(change, cov, degrees(cov, [one.carried(part) for one in self.guesses]))

    def in_frame_of(self, cameras: Collection[int]) -> FloatArray:
        """P (6 n, 6 n): P change is what is left in the frame, and of the size, of some cameras.

        Generalised least squares; that the covariance has a frame of its own does not matter to it
        (Rao 1967). What these cameras leave open, the size of a rig by one, the others decide.
        """
        largest = float(np.linalg.eigvalsh(self.cov)[-1]) or 1.0
        others = np.ones(len(self.change))
        others[_rows(sorted(cameras))] = 0.0
        cov = self.cov + largest * (self.frames @ self.frames.T + NO_SAY * np.diag(others))
        values, vectors = np.linalg.eigh(cov)
        weights = (vectors / np.maximum(values, largest / NO_SAY**2)) @ vectors.T
        U = self.frames
        return np.eye(len(U)) - U @ np.linalg.solve(U.T @ weights @ U, U.T @ weights)


def _rows(cameras: Sequence[int]) -> list[int]:
    return [row for camera in cameras for row in range(6 * camera, 6 * camera + 6)]


def frame_changes(
    cam_from_rig: Sequence[Transform], roots: Sequence[FloatArray], scale: bool
) -> FloatArray:
    """Orthonormal (6 n, g): all that a change of frames can do to the places, in px.

    roots (n,) of (6, 6): px by left twist. scale: and of the rig's size.
    """
    each = []
    for transform, root in zip(cam_from_rig, roots, strict=True):
        columns = adjoint(transform)
        if scale:
            columns = np.column_stack([columns, np.r_[np.zeros(3), transform.translation]])
        each.append(root @ columns)
    every = np.concatenate(each)
    size = np.linalg.norm(every, axis=0)
    vectors, values, _ = np.linalg.svd(every / np.where(size > 0, size, 1.0), full_matrices=False)
    return vectors[:, values > LEAST_GAUGE * values[0]]


def which_moved(places: Places, suspects: Sequence[int]) -> tuple[tuple[int, ...], ...]:
    """The smallest sets of cameras whose moving explains that the rig changed; likeliest first.

    Without them the rest sits as it sat. Fewer than half, or one of two: what most cameras agree
    on did not move. None where no set of so few does. Several: the picture cannot tell.
    """
    n = places.n_cameras
    for size in range(1, max((n - 1) // 2, 1) + 1):
        found = []
        for moved in combinations(suspects, size):
            rest = places.gauge_free([i for i in range(n) if i not in moved])
            if rest.p_value >= UNLIKELY:
                found.append((rest.chi2, moved))
        if found:
            least = min(found)[0]
            return tuple(m for chi2, m in sorted(found) if chi2 <= least + LESS_LIKELY_CHI2)
    return ()

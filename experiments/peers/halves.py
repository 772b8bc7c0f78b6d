"""Two halves of the views, each calibrated alone: how far apart, and how far by their sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from experiments.peers.calibrations import PeerCalibration
from graphs.camera import Camera, image_pixels, project, project_jacobian, unproject
from graphs.frames import FloatArray
from graphs.image_grid import GRID, without_rotation


@dataclass(frozen=True)
class Apart:
    """How far two calibrations of a camera project apart, far away, and the sigmas' promise."""

    rms_px: float
    expected_px: float  # NaN where covariances know no correlations


def projections_apart(a: Camera, b: Camera) -> float:
    """Rms over the image (px) of what b projects otherwise than a, after the best rotation."""
    return float(np.sqrt((_moved(a, b)[0] ** 2).sum(-1).mean()))


def _moved(a: Camera, b: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Moves (n, 2) after the best rotation, derivatives by it (n, 2, 3), and the rays (n, 3)."""
    pixels = image_pixels(a.size, GRID)[2]
    rays = unproject(a, pixels)
    there = project(b, rays)
    seen = np.isfinite(there[:, 0])
    by_point = project_jacobian(a, rays[seen])[1]
    by_rotation = np.cross(rays[seen][:, None, :], by_point)
    moved = (there - pixels)[seen][:, :, None]
    return without_rotation(by_rotation, moved)[:, :, 0], by_rotation, rays[seen]


def apart(a: PeerCalibration, b: PeerCalibration, camera: int) -> Apart:
    """Two calibrations of one camera from different views: difference, and what was expected."""
    first, second = a.cameras[camera], b.cameras[camera]
    left, by_rotation, rays = _moved(first, second)
    by_params = project_jacobian(first, rays)[2]
    settled = without_rotation(by_rotation, by_params)
    names = [f"{first.name}.{name}" for name in first.names]
    squared = 0.0
    for each in (a, b):
        rows = [each.covariance.names.index(name) for name in names]
        matrix = each.covariance.matrix[np.ix_(rows, rows)]
        squared += float(np.einsum("nij,jk,nik->ni", settled, matrix, settled).sum(-1).mean())
    return Apart(float(np.sqrt((left**2).sum(-1).mean())), squared**0.5)


def z_scores(a: PeerCalibration, b: PeerCalibration) -> dict[str, float]:
    """Difference of each parameter over the sigma of a difference of independent results."""
    first, second = a.covariance.sigma, b.covariance.sigma
    return {
        name: (b.values[name] - a.values[name]) / float(np.hypot(first[name], second[name]))
        for name in first
        if name in second
    }


def splits(
    frames: Sequence[int], n_random: int, seed: int = 0
) -> list[tuple[list[int], list[int]]]:
    """Every second frame and the others; then so many random halves."""
    rng = np.random.default_rng(seed)
    orders = [list(frames), *(rng.permutation(frames).tolist() for _ in range(n_random))]
    return [(sorted(order[::2]), sorted(order[1::2])) for order in orders]

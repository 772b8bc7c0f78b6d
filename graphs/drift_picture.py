"""What small changes of one camera do to its picture, group by group of its parameters.

A change of the lens moves the picture in part as a turn of the camera does: by rho = A dp, with A
the least squares of the picture over the image. That part belongs to where the camera points,
theta = w + A dp (w: its own turn), the rest to its lens. A principal point that a turn undoes is so
next to nothing in both; alone, it is a turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy.linalg

from graphs.camera import Camera
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.image_grid import image_grid
from graphs.pose_covariance import reported_from_left, rereferenced
from graphs.priors import weak_lens_prior
from graphs.problem import Estimate
from graphs.propagation import lens_names, pose_names

Group = Literal["focal", "principal point", "distortion", "rotation", "translation"]
GROUPS: tuple[Group, ...] = get_args(Group)
LENS_GROUPS: tuple[Group, ...] = GROUPS[:3]


def lens_columns(camera: Camera) -> Iterator[tuple[Group, list[int]]]:
    """The groups of a lens's parameters, and which these are; a pinhole has no distortion."""
    ends = (0, 2, 4, len(camera.names))
    for group, first, end in zip(LENS_GROUPS, ends[:-1], ends[1:], strict=True):
        if end > first:
            yield group, list(range(first, end))


@dataclass(frozen=True)
class Picture:
    """Matrices R of which |R c| is the rms in px over the image that a change c makes."""

    lens: FloatArray  # (n_params, n_params), the turn taken out that undoes most
    turn: FloatArray  # (3, 3) of where it points, rad about its axes
    move: FloatArray  # (3, 3) of its place, for points at the range asked for
    pointing: FloatArray  # (3, n_params) A: the turn that a change of the lens amounts to

    def of_lens(self, columns: list[int]) -> FloatArray:
        """R (k, k) of some of the lens's parameters."""
        return _root(self.lens[:, columns])


def picture(camera: Camera, distance: float) -> Picture:
    """Of a camera, over its image, for points at a distance."""
    alone = Estimate((camera,), (Transform.identity(),), (), np.zeros((0, 3)))
    names = (*lens_names(camera), *pose_names(camera.name))
    moved = image_grid(alone, names, [distance]).by_calibration
    J = moved.reshape(-1, len(names)) / len(moved) ** 0.5
    n = len(camera.names)
    lens, turn, move = J[:, :n], J[:, n : n + 3], J[:, n + 3 :]
    pointing = np.linalg.lstsq(turn, lens)[0]
    return Picture(_root(lens - turn @ pointing), _root(turn), _root(move), pointing)


def _root(J: FloatArray) -> FloatArray:
    """R (k, k) with R' R = J' J, of J (m, k)."""
    R: FloatArray = scipy.linalg.qr(J, mode="economic")[1]
    return np.pad(R, ((0, J.shape[1] - len(R)), (0, 0)))


def share(sigma_px: float, n_directions: int, n_groups: int = 1) -> float:
    """Variance in px^2 of each direction of `n_groups` groups of a camera, of which all together
    err by sigma_px rms in the picture, all groups alike."""
    return sigma_px**2 * n_groups / len(GROUPS) / n_directions


def assumed_covariance(
    estimate: Estimate, sigma_px: float, distance: float, reference: int = 0
) -> Covariance:
    """The covariance of a calibration that states none, were it right to sigma_px in the picture.

    Every camera errs by sigma_px rms over its image, in equal parts by each of its groups, of
    points at `distance`; parameters that do not show stay as near to an ideal lens's as weak
    priors have them. The frame is the reference camera's, which has no place of its own.
    """
    names: list[str] = []
    blocks = []
    for camera, cam_from_rig in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        seen = picture(camera, distance)
        believed = weak_lens_prior(camera).sigma
        of_groups = [
            _inverse(seen.of_lens(columns), share(sigma_px, len(columns)), believed[columns])
            for _, columns in lens_columns(camera)
        ]
        of_groups += [_inverse(R, share(sigma_px, 3)) for R in (seen.turn, seen.move)]
        n = len(camera.names)
        by_group = np.eye(n + 6)
        by_group[n : n + 3, :n] = -seen.pointing
        by_group[n:] = reported_from_left(cam_from_rig) @ by_group[n:]
        blocks.append(by_group @ scipy.linalg.block_diag(*of_groups) @ by_group.T)
        names += [*lens_names(camera), *pose_names(camera.name)]
    whole = Covariance(tuple(names), scipy.linalg.block_diag(*blocks))
    return rereferenced(estimate, whole, reference)[1]


def _inverse(R: FloatArray, variance_px: float, believed: FloatArray | None = None) -> FloatArray:
    """Covariance of changes c whose R c has a variance along each direction."""
    information = R.T @ R / variance_px
    if believed is not None:
        information = information + np.diag(believed**-2.0)
    size = np.sqrt(np.diag(information))
    inverse: FloatArray = np.linalg.inv(information / np.outer(size, size)) / np.outer(size, size)
    return inverse

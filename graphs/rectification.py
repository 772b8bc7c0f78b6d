"""Two cameras turned until a point lies in the same row, or column, of both images.

Fusiello, Trucco and Verri, Machine Vision and Applications 2000: one axis along the baseline, the
optical axis as near to that of both cameras as it can be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform, exp_rotation, log_rotation


@dataclass(frozen=True)
class Rectification:
    """How two cameras have to be turned, and how far they are from what allows it."""

    first: int  # 0 or 1: which of the two is on the left, or above
    is_vertical: bool
    turns: tuple[FloatArray, FloatArray]  # rectified_from_cam (3, 3), in the order given
    baseline: float  # unit of the transforms
    angle_apart: float  # between the optical axes, radians
    angle_off_axis: float  # of the baseline from the mean optical axis, radians, at most pi / 2


def rectification(cam_from_rig: tuple[Transform, Transform]) -> Rectification | None:
    """None where the cameras are in one place.

    The pair is vertical where the baseline is more along the mean camera's y than along its x.
    """
    a_from_b = cam_from_rig[0] @ cam_from_rig[1].inverse
    baseline = float(np.linalg.norm(a_from_b.translation))
    if not baseline > 0:
        return None
    half = exp_rotation(log_rotation(a_from_b.rotation) / 2)  # a_from_mean, mean_from_b
    to_second = half.T @ a_from_b.translation / baseline
    is_vertical = bool(abs(to_second[1]) > abs(to_second[0]))
    first = int(to_second[1 if is_vertical else 0] < 0)
    along = -to_second if first else to_second
    axes = np.array([half.T[:, 2], half[:, 2]])  # both optical axes
    forward = axes.sum(axis=0)
    forward -= (forward @ along) * along
    forward = unit(forward)
    across = np.cross(along, forward) if is_vertical else along
    rectified_from_mean = np.array([across, np.cross(forward, across), forward])
    mean_axis = unit(axes.sum(axis=0))
    return Rectification(
        first,
        is_vertical,
        (rectified_from_mean @ half.T, rectified_from_mean @ half),
        baseline,
        float(np.arccos(np.clip(axes[0] @ axes[1], -1.0, 1.0))),
        float(np.arccos(np.clip(abs(mean_axis @ along), 0.0, 1.0))),
    )


def unit(vector: FloatArray) -> FloatArray:
    """A vector (3,) of length one; of no length, where it has none."""
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def projection_matrices(
    virtual: Camera, baseline: float, is_vertical: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """P1, P2 (3, 4) and Q (4, 4) of a rectified pair, as OpenCV's stereoRectify has them.

    Q takes (x, y, disparity, 1) to the point in the first camera, in the baseline's unit:
    disparity is x, or y, in the first image less that in the second. fx and fy have to be equal.
    """
    focal, (cx, cy) = virtual.params[0], virtual.params[2:4]
    P1 = np.array([[focal, 0, cx, 0], [0, focal, cy, 0], [0, 0, 1, 0]])
    P2 = P1.copy()
    P2[1 if is_vertical else 0, 3] = -focal * baseline
    Q = np.array([[1, 0, 0, -cx], [0, 1, 0, -cy], [0, 0, 0, focal], [0, 0, 1 / baseline, 0]])
    return P1, P2, Q

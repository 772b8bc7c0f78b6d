"""Rigid transforms named `a_from_b`, and the border to GTSAM's opposite convention.

`cam_from_world = cam_from_rig @ rig_from_world`: neighbouring frames cancel. Quaternions are
wxyz. GTSAM stores `world_from_x` and perturbs on the right, rotation first; only the rows of the
track factor (`graphs.rows`) and the twists of `graphs.pose_covariance` have to know besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import gtsam
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
# "Smart" noise models turn sigmas below 1e-8 into hard constraints, on which GTSAM's LM is stuck.
NOT_SMART = False


@dataclass(frozen=True)
class Transform:
    """A rigid transform `a_from_b`: x_a = rotation @ x_b + translation."""

    rotation: FloatArray  # (3, 3)
    translation: FloatArray  # (3,)

    @staticmethod
    def identity() -> Transform:
        return Transform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_wxyz(rotation_wxyz: Sequence[float], translation: Sequence[float]) -> Transform:
        """From a quaternion (w, x, y, z), normalised here, and a translation.

        Raises ValueError when the quaternion is zero or not finite.
        """
        q = np.asarray(rotation_wxyz, dtype=np.float64)
        norm = float(np.linalg.norm(q))
        if not np.isfinite(norm) or norm < 1e-6:
            raise ValueError(f"the quaternion {q.tolist()} has no direction")
        rotation = gtsam.Rot3.Quaternion(*(q / norm)).matrix()
        return Transform(rotation, np.asarray(translation, dtype=np.float64))

    @staticmethod
    def exp(rotation_vector: FloatArray, translation: FloatArray) -> Transform:
        """From a rotation vector in radians (3,) and a translation (3,)."""
        return Transform(exp_rotation(rotation_vector), np.asarray(translation, dtype=np.float64))

    @property
    def rotation_wxyz(self) -> FloatArray:
        """Unit quaternion (w, x, y, z) with w >= 0."""
        q = gtsam.Rot3(self.rotation).toQuaternion()
        wxyz = np.array([q.w(), q.x(), q.y(), q.z()])
        return wxyz if wxyz[0] >= 0 else -wxyz

    @property
    def inverse(self) -> Transform:
        return Transform(self.rotation.T, -self.rotation.T @ self.translation)

    @overload
    def __matmul__(self, other: Transform) -> Transform: ...
    @overload
    def __matmul__(self, other: FloatArray) -> FloatArray: ...
    def __matmul__(self, other: Transform | FloatArray) -> Transform | FloatArray:
        """a_from_b @ b_from_c, or a_from_b @ points of shape (..., 3)."""
        if isinstance(other, Transform):
            return Transform(
                self.rotation @ other.rotation,
                self.rotation @ other.translation + self.translation,
            )
        return other @ self.rotation.T + self.translation

    def scaled(self, factor: float) -> Transform:
        """The same transform in units `factor` times smaller."""
        return Transform(self.rotation, self.translation * factor)


def exp_rotation(rotation_vector: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a rotation vector in radians (3,)."""
    return gtsam.Rot3.Expmap(np.asarray(rotation_vector, dtype=np.float64)).matrix()


def log_rotation(rotation: FloatArray) -> FloatArray:
    """Rotation vector in radians (3,) of a rotation matrix (3, 3)."""
    return gtsam.Rot3.Logmap(gtsam.Rot3(rotation))


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Angle in radians of the rotation that takes `a` to `b`, matrices (3, 3)."""
    return float(np.linalg.norm(log_rotation(a.T @ b)))


def to_gtsam_inverse(b_from_a: Transform) -> gtsam.Pose3:
    """GTSAM's variable for `b_from_a`: the pose of b in a."""
    a_from_b = b_from_a.inverse
    return gtsam.Pose3(gtsam.Rot3(a_from_b.rotation), a_from_b.translation)


def from_gtsam_inverse(a_pose_b: gtsam.Pose3) -> Transform:
    """`b_from_a` from GTSAM's variable, the pose of b in a."""
    return Transform(a_pose_b.rotation().matrix(), np.asarray(a_pose_b.translation())).inverse


def skew(v: FloatArray) -> FloatArray:
    """Cross-product matrix (3, 3) of a vector (3,)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def reported_from_tangent(b_from_a: Transform) -> FloatArray:
    """Jacobian (6, 6) from GTSAM's tangent of the inverse pose to what we report of `b_from_a`.

    GTSAM perturbs a_from_b on the right: a_from_b Exp(xi). Then b_from_a becomes
    Exp(-xi) b_from_a: its rotation turns by -xi_rotation about the axes of b, its translation
    moves by -xi_translation + t x xi_rotation. Reported are that turn (radians, axes of b) and
    the change of the translation vector itself.
    """
    jacobian = -np.eye(6)
    jacobian[3:, :3] = skew(b_from_a.translation)
    return jacobian


def median_rotation(rotations: FloatArray, iterations: int = 50) -> FloatArray:
    """L1 mean of rotations (n, 3, 3) by Weiszfeld's algorithm (Hartley et al., CVPR 2011)."""
    quaternions = np.array([Transform(r, np.zeros(3)).rotation_wxyz for r in rotations])
    scatter = np.einsum("ni,nj->ij", quaternions, quaternions)  # sign-free chordal mean
    start = np.linalg.eigh(scatter)[1][:, -1]
    mean = Transform.from_wxyz(start.tolist(), [0, 0, 0]).rotation
    for _ in range(iterations):
        steps = np.array([log_rotation(mean.T @ r) for r in rotations])
        weights = 1.0 / np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
        step = (weights[:, None] * steps).sum(0) / weights.sum()
        mean = mean @ exp_rotation(step)
        if np.linalg.norm(step) < 1e-12:
            break
    return mean

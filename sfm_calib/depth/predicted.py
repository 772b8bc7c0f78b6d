"""How uncertain fused points are by the calibration alone, from its stated covariance.

A depth image says: at this pixel, so far away. Which point of the rig's frame that is depends on
the lens and on the camera's place; the depth itself is taken as it is. To first order, J C J'.
"""

from __future__ import annotations

import numpy as np

from graphs.camera import Camera, project_jacobian
from graphs.frames import FloatArray, Transform
from graphs.propagation import by_reported_pose, cross_covariance, lens_names, pose_names
from sfm_calib.depth.cloud import DepthKind, evenly
from sfm_calib.depth.overlap import Overlap
from sfm_calib.formats import CameraRig

MOST_POINTS = 500  # of which the mean is taken


def point_jacobian(
    camera: Camera, cam_from_rig: Transform, points: FloatArray, kind: DepthKind = "z"
) -> FloatArray:
    """Derivatives (n, 3, k) of fused points (n, 3) by `calibration_names` of their camera.

    Pixel and depth stay: by_point dp + by_lens dlens = 0, and dp is across the depth's direction.
    NaN where the lens does not see the point.
    """
    seen = cam_from_rig @ points
    pixels, by_point, by_lens = project_jacobian(camera, seen)
    along = np.broadcast_to([0.0, 0.0, 1.0], seen.shape) if kind == "z" else seen
    held = np.concatenate([by_point, along[:, None, :]], axis=1)
    held[np.isnan(pixels).any(axis=1)] = np.eye(3)
    moved = np.concatenate([by_lens, np.zeros((len(seen), 1, by_lens.shape[2]))], axis=1)
    in_camera = -np.linalg.solve(held, moved)
    by_pose = -by_reported_pose(seen - cam_from_rig.translation)
    jacobian = cam_from_rig.rotation.T @ np.concatenate([in_camera, by_pose], axis=-1)
    jacobian[np.isnan(pixels).any(axis=1)] = np.nan
    return jacobian


def calibration_names(camera: Camera) -> tuple[str, ...]:
    """What a camera's points depend on: its lens, then its place."""
    return (*lens_names(camera), *pose_names(camera.name))


def sigma_of_points(
    rig: CameraRig, camera: int, points: FloatArray, kind: DepthKind = "z"
) -> float | None:
    """Rms over points (n, 3) of one camera of their sigma in m, all directions together.

    None where the calibration states no sigmas, or there are no points.
    """
    if not rig.states_sigmas or rig.cam_from_rig is None or not len(points):
        return None
    some = points[evenly(len(points), MOST_POINTS)]
    jacobian = point_jacobian(rig.cameras[camera], rig.cam_from_rig[camera], some, kind)
    names = calibration_names(rig.cameras[camera])
    cov = cross_covariance(rig.covariance, names, names)
    return _root_mean(np.einsum("nik,kl,nil->n", jacobian, cov, jacobian))


def sigma_apart(
    rig: CameraRig, cameras: tuple[int, int], found: Overlap, kind: DepthKind = "z"
) -> float | None:
    """Rms over an overlap of the sigma in m of how far its two cameras' points are apart.

    found: points of the first camera over the second's. None as in `sigma_of_points`.
    """
    if not rig.states_sigmas or rig.cam_from_rig is None or not len(found.points):
        return None
    rows = evenly(len(found.points), MOST_POINTS)
    sides = []
    for camera, points in zip(cameras, (found.points[rows], found.others[rows]), strict=True):
        jacobian = point_jacobian(rig.cameras[camera], rig.cam_from_rig[camera], points, kind)
        sides.append(np.einsum("ni,nik->nk", found.normals[rows], jacobian))
    names = [name for camera in cameras for name in calibration_names(rig.cameras[camera])]
    both = np.hstack([sides[0], -sides[1]])
    cov: FloatArray = cross_covariance(rig.covariance, names, names)
    return _root_mean(np.einsum("nk,kl,nl->n", both, cov, both))


def _root_mean(variances: FloatArray) -> float | None:
    known = variances[np.isfinite(variances)]
    return float(np.sqrt(max(known.mean(), 0.0))) if known.size else None

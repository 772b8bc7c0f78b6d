"""The covariance of the rig's transforms in other parametrisations and other frames.

Reported is of cam_from_rig = (R, t): the turn rho (rad, about the camera's axes), R' = Exp(rho)
R, and the change tau of the translation vector, t' = t + tau. All else passes through twists,
rotation first as in GTSAM's Pose3, which the adjoint carries from frame to frame (Sola, Deray and
Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, section II-F). Units, held
parameters and the indices of cameras are as in `graphs.propagation`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, skew
from graphs.problem import Estimate
from graphs.propagation import pose_names, replaced, transformed

Form = Literal["reported", "left_twist", "right_twist"]


def adjoint(a_from_b: Transform) -> FloatArray:
    """Ad (6, 6) of T = a_from_b: T Exp(xi) = Exp(Ad xi) T; rotation first."""
    turn = a_from_b.rotation
    return np.block([[turn, np.zeros((3, 3))], [skew(a_from_b.translation) @ turn, turn]])


def form_from_reported(a_from_b: Transform, form: Form) -> FloatArray:
    """Jacobian (6, 6) from the reported change of a_from_b to the twist in T' = Exp(xi) T, left,
    or T' = T Exp(xi), right."""
    if form == "reported":
        return np.eye(6)
    left = np.eye(6)
    left[3:, :3] = skew(a_from_b.translation)
    return left if form == "left_twist" else adjoint(a_from_b.inverse) @ left


def reported_from_left(a_from_b: Transform) -> FloatArray:
    """Inverse (6, 6) of `form_from_reported` to the left twist."""
    matrix = np.eye(6)
    matrix[3:, :3] = -skew(a_from_b.translation)
    return matrix


def form_names(name: str, form: Form) -> tuple[str, ...]:
    """`cam1.rotation_x`, ...; of twists `cam1.left_twist.rotation_x`, ...

    Rotations in rad; translations in the unit of the rig.
    """
    return pose_names(name) if form == "reported" else pose_names(f"{name}.{form}")


def poses_as(
    covariance: Covariance, estimate: Estimate, form: Form, given: Form = "reported"
) -> Covariance:
    """The whole covariance with every cam_from_rig in another parametrisation, as `form_names`."""
    for camera, transform in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        back = np.linalg.inv(form_from_reported(transform, given))
        jacobian = form_from_reported(transform, form) @ back
        names, of = form_names(camera.name, form), form_names(camera.name, given)
        covariance = replaced(covariance, names, jacobian, of)
    return covariance


def relative_jacobians(a_from_c: Transform, b_from_c: Transform) -> tuple[FloatArray, FloatArray]:
    """Jacobians (6, 6) of the reported change of a_from_b by those of a_from_c and of b_from_c.

    With left twists, Exp(x_a) T_a (Exp(x_b) T_b)^-1 = Exp(x_a) Exp(-Ad x_b) T_ab.
    """
    a_from_b = a_from_c @ b_from_c.inverse
    reported = reported_from_left(a_from_b)
    by_a = reported @ form_from_reported(a_from_c, "left_twist")
    by_b = -reported @ adjoint(a_from_b) @ form_from_reported(b_from_c, "left_twist")
    return by_a, by_b


def inverse_jacobian(a_from_b: Transform) -> FloatArray:
    """Jacobian (6, 6) from the reported change of a_from_b to that of b_from_a."""
    return relative_jacobians(Transform.identity(), a_from_b)[1]


def inverted(covariance: Covariance, estimate: Estimate) -> Covariance:
    """The whole covariance with every cam_from_rig replaced by its inverse.

    Named `rig_from_cam1.rotation_x` (rad, about the rig's axes) and
    `rig_from_cam1.translation_x` (of the camera's centre in the rig), ...
    """
    for camera, transform in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        names = pose_names(f"rig_from_{camera.name}")
        jacobian = inverse_jacobian(transform)
        covariance = replaced(covariance, names, jacobian, pose_names(camera.name))
    return covariance


def relative(covariance: Covariance, estimate: Estimate, a: int, b: int) -> Covariance:
    """Covariance (6, 6) of cam_a_from_cam_b, from both transforms and their cross-covariance.

    a, b: indices of cameras. Named `cam2_from_cam1.rotation_x` (rad, about the axes of a) and
    `cam2_from_cam1.translation_x`, ...
    """
    jacobians = relative_jacobians(estimate.cam_from_rig[a], estimate.cam_from_rig[b])
    name_a, name_b = estimate.cameras[a].name, estimate.cameras[b].name
    names, of = pose_names(f"{name_a}_from_{name_b}"), (*pose_names(name_a), *pose_names(name_b))
    return transformed(covariance, names, np.hstack(jacobians), of)


def rereferenced(
    estimate: Estimate, covariance: Covariance, reference: int
) -> tuple[Estimate, Covariance]:
    """The same rig in the frame of another camera, and its whole covariance.

    reference: index of the camera whose frame becomes the rig's; its transform leaves the
    covariance, and the former reference's enters. Lenses keep their rows, scene points their
    place, lengths their unit.
    """
    new_from_rig = estimate.cam_from_rig[reference]
    blocks = [pose_names(camera.name) for camera in estimate.cameras]
    uncertain = [not set(block).isdisjoint(covariance.names) for block in blocks]
    jacobian = np.zeros((len(blocks), 6, len(blocks), 6))
    for i, cam_from_rig in enumerate(estimate.cam_from_rig):
        by_i, by_new = relative_jacobians(cam_from_rig, new_from_rig)
        jacobian[i, :, i] += by_i
        jacobian[i, :, reference] += by_new
    moved = [
        i for i in range(len(blocks)) if i != reference and (uncertain[i] or uncertain[reference])
    ]
    names = [name for i in moved for name in blocks[i]]
    of = [name for block in blocks for name in block]
    whole = jacobian[moved].reshape(len(names), len(of))
    rig_from_new = new_from_rig.inverse
    cam_from_new = [cam_from_rig @ rig_from_new for cam_from_rig in estimate.cam_from_rig]
    cam_from_new[reference] = Transform.identity()  # exactly
    seen_from_new = replace(
        estimate,
        cam_from_rig=tuple(cam_from_new),
        rig_from_world=tuple(new_from_rig @ transform for transform in estimate.rig_from_world),
    )
    return seen_from_new, replaced(covariance, names, whole, of)

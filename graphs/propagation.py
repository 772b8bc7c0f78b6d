"""What follows from a labelled covariance: other lens parameters, and pixels.

To first order, as J C J'. A parameter that a covariance does not name was held, and counts as
exactly known. Lengths have the unit of the estimate and its covariance, which must be the same: of
a result without scale, `in_unit_baseline` and `Estimate.scaled` first. Cameras are indices into
`Estimate.cameras`. Poses in other frames and parametrisations: `graphs.pose_covariance`; points
in space: `graphs.triangulation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import scipy.linalg

from graphs.camera import Camera, project_jacobian, unproject
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import FloatArray, skew
from graphs.problem import Estimate

# ---- labelled Jacobians --------------------------------------------------------------------


def lens_names(camera: Camera) -> tuple[str, ...]:
    """Names of a lens's parameters in a covariance, in the lens's order: `cam0.fx`, ..."""
    return tuple(f"{camera.name}.{name}" for name in camera.names)


def pose_names(name: str) -> tuple[str, ...]:
    """Names of a transform's turn (rad) and translation in a covariance: `cam1.rotation_x`, ..."""
    return tuple(f"{name}.{part}" for part in POSE_NAMES)


def cross_covariance(
    covariance: Covariance, rows: Sequence[str], columns: Sequence[str]
) -> FloatArray:
    """Covariance of some parameters with others (n_rows, n_columns); zero where one was held."""
    place = {name: index for index, name in enumerate(covariance.names)}
    padded = np.pad(covariance.matrix, (0, 1))  # the last row and column: exactly known
    return padded[np.ix_([place.get(n, -1) for n in rows], [place.get(n, -1) for n in columns])]


def marginal(covariance: Covariance, names: Sequence[str]) -> Covariance:
    """Covariance of those of `names` that it has, in their order.

    Raises ValueError when it has none.
    """
    found = tuple(name for name in names if name in covariance.names)
    if not found:
        raise ValueError(
            f"the covariance has no {' '.join(names)}: held parameters are not in it; "
            f"it has {' '.join(covariance.names)}"
        )
    return Covariance(found, cross_covariance(covariance, found, found))


def transformed(
    covariance: Covariance,
    names: Sequence[str],
    jacobian: FloatArray,
    of: Sequence[str] | None = None,
) -> Covariance:
    """Covariance of other quantities, under their names.

    jacobian (len(names), len(of)): their derivatives by the parameters `of`, in that order; by
    the covariance's own where `of` is not given.
    """
    of = covariance.names if of is None else of
    matrix = jacobian @ cross_covariance(covariance, of, of) @ jacobian.T
    return Covariance(tuple(names), matrix)


def replaced(
    covariance: Covariance, names: Sequence[str], jacobian: FloatArray, of: Sequence[str]
) -> Covariance:
    """The whole covariance with the parameters `of` replaced by others, in their place.

    jacobian (len(names), len(of)) as in `transformed`. Where all of `of` were held, so are the
    new ones: nothing changes.
    """
    places = [index for index, name in enumerate(covariance.names) if name in of]
    if not places:
        return covariance
    before = covariance.names[: places[0]]
    after = tuple(name for name in covariance.names[places[0] :] if name not in of)
    whole = scipy.linalg.block_diag(np.eye(len(before)), jacobian, np.eye(len(after)))
    return transformed(covariance, (*before, *names, *after), whole, (*before, *of, *after))


# ---- lenses --------------------------------------------------------------------------------

Field = Literal["horizontal", "vertical", "diagonal"]
FIELDS: tuple[Field, ...] = get_args(Field)
OPPOSITE = 1e-6  # length of the sum of two rays, below which it has no direction


def focal_and_aspect(covariance: Covariance, camera: Camera) -> Covariance:
    """`cam.fx`, `cam.fy` replaced by `cam.focal`, their mean in px, and `cam.aspect` = fy / fx."""
    fx, fy = camera.params[:2]
    jacobian = np.array([[0.5, 0.5], [-fy / fx**2, 1 / fx]])
    names = [f"{camera.name}.{name}" for name in ("focal", "aspect")]
    return replaced(covariance, names, jacobian, lens_names(camera)[:2])


def ray_jacobian(camera: Camera, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit rays (..., 3) as `unproject`, and their derivatives by parameter (..., 3, n).

    With the pixel u(ray, params) fixed, u_ray dray = -u_params dparams across the ray, which is
    where u_ray's pseudo-inverse leads. Zero where the ray is NaN.
    """
    rays = unproject(camera, pixels)
    _, by_ray, by_params = project_jacobian(camera, rays)
    return rays, -np.linalg.pinv(by_ray) @ by_params


def field_of_view(
    covariance: Covariance, camera: Camera, fields: Sequence[Field] = FIELDS
) -> tuple[FloatArray, Covariance]:
    """Angles (len(fields),) in degrees that the real lens sees, and their covariance in deg^2.

    Between the outer edges of the outermost pixels: halfway up, halfway across, and from the
    upper left corner to the lower right; beyond 180 degrees too. Named
    `cam.fov_horizontal_deg`, ... Raises ValueError where the lens sees nothing at such an edge.
    """
    right, low = np.array(camera.size) - 0.5  # pixel centres are at integers
    x, y = camera.centre
    edges = {
        "horizontal": ((-0.5, y), (right, y)),
        "vertical": ((x, -0.5), (x, low)),
        "diagonal": ((-0.5, -0.5), (right, low)),
    }
    rays, by_params = ray_jacobian(camera, np.array([edges[field] for field in fields]))
    for field, pair in zip(fields, rays, strict=True):
        if np.isnan(pair).any():
            raise ValueError(
                f"{camera.name}: its {camera.lens} lens sees nothing at an image edge: it has no "
                f"{field} field of view. Ask for another, or choose a lens that reaches the edges"
            )
    between = rays.sum(1)
    between = np.where(between[:, 2:] < 0, -between, between)  # the way that leads through the axis
    opposite = np.linalg.norm(between, axis=-1, keepdims=True) < OPPOSITE
    between = np.where(opposite, [0.0, 0.0, 1.0], between)[:, None]
    # Turned away from what lies between them, the rays open by as much.
    off = np.linalg.norm(np.cross(rays, between), axis=-1)
    along = (rays * between).sum(-1)
    opening = (along[..., None] * rays - between) / off[..., None]
    angles = np.degrees(np.arctan2(off, along).sum(-1))
    jacobian = np.degrees(np.einsum("fri,frik->fk", opening, by_params))
    names = [f"{camera.name}.fov_{field}_deg" for field in fields]
    return angles, transformed(covariance, names, jacobian, lens_names(camera))


# ---- pixels --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Projection:
    """Pixels of points in one camera, and what moves them."""

    pixels: FloatArray  # (..., 2); NaN where the lens refuses, and zero derivatives
    by_point: FloatArray  # (..., 2, 3)
    names: tuple[str, ...]  # the camera's lens, and its cam_from_rig where it matters
    by_calibration: FloatArray  # (..., 2, len(names))


def projection(
    estimate: Estimate,
    camera: int,
    points: FloatArray,
    given_in: Literal["rig", "camera"] = "rig",
) -> Projection:
    """Where points (..., 3) fixed in the rig's frame, or in the camera's, are seen."""
    lens, cam_from_rig = estimate.cameras[camera], estimate.cam_from_rig[camera]
    if given_in == "camera":
        pixels, by_point, by_lens = project_jacobian(lens, points)
        return Projection(pixels, by_point, lens_names(lens), by_lens)
    in_camera = cam_from_rig @ points
    pixels, by_point, by_lens = project_jacobian(lens, in_camera)
    by_pose = by_point @ by_reported_pose(in_camera - cam_from_rig.translation)
    names = (*lens_names(lens), *pose_names(lens.name))
    by_calibration = np.concatenate([by_lens, by_pose], axis=-1)
    return Projection(pixels, by_point @ cam_from_rig.rotation, names, by_calibration)


def by_reported_pose(turned: FloatArray) -> FloatArray:
    """Derivative (..., 3, 6) of R p + t by the reported turn and translation, from R p (..., 3)."""
    by_turn = -np.einsum("...k,kij->...ij", turned, np.array([skew(axis) for axis in np.eye(3)]))
    return np.concatenate([by_turn, np.broadcast_to(np.eye(3), by_turn.shape)], axis=-1)


def projection_covariance(
    estimate: Estimate,
    covariance: Covariance,
    camera: int,
    points: FloatArray,
    given_in: Literal["rig", "camera"] = "rig",
) -> FloatArray:
    """Covariance (..., 2, 2) in px^2 of where points (..., 3) are seen, from the calibration alone.

    Of points fixed in the rig's frame: from the lens and cam_from_rig, cross terms included. Of
    points in the camera's frame: from the lens. NaN where the lens refuses the point.
    """
    seen = projection(estimate, camera, points, given_in)
    of_calibration = cross_covariance(covariance, seen.names, seen.names)
    cov_px = seen.by_calibration @ of_calibration @ seen.by_calibration.mT
    cov_px[np.isnan(seen.pixels).any(-1)] = np.nan
    return cov_px

"""The linearised rows of tracks: how each residual moves with its point, frame, camera and lens.

A point is homogeneous about a fixed anchor, where a camera started: x = anchor + d / w with a
unit bearing d and an inverse distance w > 0, so that far points are as harmless as near ones. It
moves by two angles (`bearing_basis`) and the inverse distance. Frames and cameras move as GTSAM's
Pose3 does: world_from_rig and rig_from_cam, on the right, rotation first.

Everything here runs without the GIL on one chunk of rows, one row an observation. Kernels of
different files exchange arrays only: numba's cache on disk does not notice a change of a function
that another file has compiled in.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from graphs.frames import FloatArray
from graphs.problem import IntArray

FAST = {"contract", "arcp", "reassoc", "nsz"}


@njit(cache=True, nogil=True, fastmath=FAST)
def into_cameras(
    active: IntArray,  # (n_active,) points
    begins: IntArray,  # (n_points + 1,) first observation of each point
    frame: IntArray,  # (n_obs,)
    camera: IntArray,  # (n_obs,)
    anchors: FloatArray,  # (n_points, 3)
    points: FloatArray,  # (n_points, 4) bearing and inverse distance
    rig_rotation: FloatArray,  # (n_frames, 3, 3) world_from_rig
    rig_centre: FloatArray,  # (n_frames, 3)
    cam_rotation: FloatArray,  # (n_cameras, 3, 3) rig_from_cam
    cam_centre: FloatArray,  # (n_cameras, 3)
    rows: IntArray,  # out (n, 4): observation, point, frame, camera
    in_rig: FloatArray,  # out (n, 3), times w
    in_cam: FloatArray,  # out (n, 3), times w
) -> int:
    """Active points in the frames of the rigs and cameras that see them; the number of rows."""
    n = 0
    for j in active:
        d0, d1, d2, w = points[j, 0], points[j, 1], points[j, 2], points[j, 3]
        for o in range(begins[j], begins[j + 1]):
            f, c = frame[o], camera[o]
            R, E = rig_rotation[f], cam_rotation[c]
            h0 = d0 + w * (anchors[j, 0] - rig_centre[f, 0])
            h1 = d1 + w * (anchors[j, 1] - rig_centre[f, 1])
            h2 = d2 + w * (anchors[j, 2] - rig_centre[f, 2])
            p0 = R[0, 0] * h0 + R[1, 0] * h1 + R[2, 0] * h2
            p1 = R[0, 1] * h0 + R[1, 1] * h1 + R[2, 1] * h2
            p2 = R[0, 2] * h0 + R[1, 2] * h1 + R[2, 2] * h2
            in_rig[n, 0], in_rig[n, 1], in_rig[n, 2] = p0, p1, p2
            p0 -= w * cam_centre[c, 0]
            p1 -= w * cam_centre[c, 1]
            p2 -= w * cam_centre[c, 2]
            in_cam[n, 0] = E[0, 0] * p0 + E[1, 0] * p1 + E[2, 0] * p2
            in_cam[n, 1] = E[0, 1] * p0 + E[1, 1] * p1 + E[2, 1] * p2
            in_cam[n, 2] = E[0, 2] * p0 + E[1, 2] * p1 + E[2, 2] * p2
            rows[n, 0], rows[n, 1], rows[n, 2], rows[n, 3] = o, j, f, c
            n += 1
    return n


@njit(cache=True, nogil=True, fastmath=FAST)
def carry_points(
    begins: IntArray,
    frame: IntArray,
    camera: IntArray,
    anchors: FloatArray,
    rig_rotation: FloatArray,  # as in `into_cameras`, before the move
    rig_centre: FloatArray,
    cam_rotation: FloatArray,
    cam_centre: FloatArray,
    rig_rotation_after: FloatArray,
    rig_centre_after: FloatArray,
    cam_rotation_after: FloatArray,
    cam_centre_after: FloatArray,
    points: FloatArray,  # in and out (n_points, 4)
) -> None:
    """Move points along with the camera nearest to them.

    A track that ends right before a camera would else find itself behind it, and unable to return.
    """
    p, h = np.empty(3), np.empty(3)
    for j in range(len(points)):
        w, nearest, best = points[j, 3], np.inf, -1
        for o in range(begins[j], begins[j + 1]):
            f, c = frame[o], camera[o]
            square = 0.0
            for k in range(3):
                h[k] = rig_centre[f, k]
                for m in range(3):
                    h[k] += rig_rotation[f, k, m] * cam_centre[c, m]
                square += (points[j, k] + w * (anchors[j, k] - h[k])) ** 2
            if square < nearest:
                nearest, best = square, o
        f, c = frame[best], camera[best]
        R, E = rig_rotation[f], cam_rotation[c]
        for k in range(3):
            h[k] = points[j, k] + w * (anchors[j, k] - rig_centre[f, k])
        for k in range(3):
            p[k] = R[0, k] * h[0] + R[1, k] * h[1] + R[2, k] * h[2] - w * cam_centre[c, k]
        for k in range(3):
            h[k] = E[0, k] * p[0] + E[1, k] * p[1] + E[2, k] * p[2]  # in the camera
        E, R = cam_rotation_after[c], rig_rotation_after[f]
        for k in range(3):
            p[k] = E[k, 0] * h[0] + E[k, 1] * h[1] + E[k, 2] * h[2] + w * cam_centre_after[c, k]
        size = 0.0
        for k in range(3):
            h[k] = R[k, 0] * p[0] + R[k, 1] * p[1] + R[k, 2] * p[2]
            h[k] += w * (rig_centre_after[f, k] - anchors[j, k])
            size += h[k] * h[k]
        size = np.sqrt(size)
        for k in range(3):
            points[j, k] = h[k] / size
        points[j, 3] = w / size


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def bearing_basis(d: Any, b: Any) -> None:
    """Two unit vectors b (2, 3) across the unit bearing d (Duff et al., JCGT 2017)."""
    sign = 1.0 if d[2] >= 0 else -1.0
    a = -1.0 / (sign + d[2])
    c = d[0] * d[1] * a
    b[0, 0], b[0, 1], b[0, 2] = 1.0 + sign * d[0] * d[0] * a, sign * c, -sign * d[0]
    b[1, 0], b[1, 1], b[1, 2] = c, sign + d[1] * d[1] * a, -d[1]


@njit(cache=True, nogil=True)
def move_points(
    points: FloatArray,  # (n, 4)
    steps: FloatArray,  # (n, 3) along the two vectors of the basis and the inverse distance
    smallest_w: float,
    moved: FloatArray,  # out (n, 4)
) -> None:
    """Points after a step; none goes beyond the distance 1 / smallest_w."""
    basis, d = np.empty((2, 3)), np.empty(3)
    for j in range(len(points)):
        bearing_basis(points[j], basis)
        for k in range(3):
            d[k] = points[j, k] + steps[j, 0] * basis[0, k] + steps[j, 1] * basis[1, k]
        size = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        for k in range(3):
            moved[j, k] = d[k] / size
        moved[j, 3] = max((points[j, 3] + steps[j, 2]) / size, smallest_w)


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _by_rig_and_point(
    j: Any, E: Any, R: Any, basis: Any, anchor: Any, centre: Any, cam_centre: Any, e: Any, b: Any
) -> None:
    """From a row j (3,) by the point in the camera: e (3,) by the point in the rig, b (3,) by the
    point's own three directions."""
    for k in range(3):
        e[k] = j[0] * E[k, 0] + j[1] * E[k, 1] + j[2] * E[k, 2]
    f0 = e[0] * R[0, 0] + e[1] * R[0, 1] + e[2] * R[0, 2]
    f1 = e[0] * R[1, 0] + e[1] * R[1, 1] + e[2] * R[1, 2]
    f2 = e[0] * R[2, 0] + e[1] * R[2, 1] + e[2] * R[2, 2]
    b[0] = f0 * basis[0, 0] + f1 * basis[0, 1] + f2 * basis[0, 2]
    b[1] = f0 * basis[1, 0] + f1 * basis[1, 1] + f2 * basis[1, 2]
    b[2] = f0 * (anchor[0] - centre[0]) + f1 * (anchor[1] - centre[1])
    b[2] += f2 * (anchor[2] - centre[2])
    b[2] -= e[0] * cam_centre[0] + e[1] * cam_centre[1] + e[2] * cam_centre[2]


@njit(cache=True, nogil=True, fastmath=FAST)
def point_rows(
    n: int,
    rows: IntArray,  # (n, 4) of `into_cameras`
    anchors: FloatArray,
    points: FloatArray,
    rig_rotation: FloatArray,
    rig_centre: FloatArray,
    cam_rotation: FloatArray,
    cam_centre: FloatArray,
    root_information: FloatArray,  # (n_obs, 3) upper triangles by rows
    by_point: FloatArray,  # (n, 2, 3) by the point in the camera
    of_point: FloatArray,  # out (n, 2, 3) by the point's own directions, whitened
) -> None:
    """Rows by the points alone, for triangulation."""
    basis, e, Jq = np.empty((2, 3)), np.empty(3), np.empty((2, 3))
    before = -1
    for i in range(n):
        o, j, f, c = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        if j != before:
            bearing_basis(points[j], basis)
            before = j
        w00, w01, w11 = root_information[o]
        for k in range(3):
            Jq[0, k] = w00 * by_point[i, 0, k] + w01 * by_point[i, 1, k]
            Jq[1, k] = w11 * by_point[i, 1, k]
        for a in range(2):
            _by_rig_and_point(
                Jq[a], cam_rotation[c], rig_rotation[f], basis, anchors[j], rig_centre[f],
                cam_centre[c], e, of_point[i, a],
            )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=FAST)
def all_rows(
    n: int,
    rows: IntArray,
    anchors: FloatArray,
    points: FloatArray,
    rig_rotation: FloatArray,
    rig_centre: FloatArray,
    cam_rotation: FloatArray,
    cam_centre: FloatArray,
    root_information: FloatArray,
    by_point: FloatArray,
    by_params: FloatArray,  # (n, 2, n_params), weighted in place
    in_rig: FloatArray,  # (n, 3)
    in_cam: FloatArray,  # (n, 3)
    weights: FloatArray,  # (n,)
    bends: FloatArray,  # (n,)
    residuals: FloatArray,  # (n, 2), weighted in place
    of_point: FloatArray,  # out (n, 2, 3)
    of_frame: FloatArray,  # out (n, 2, 6)
    of_rig: FloatArray,  # out (n, 2, 6)
) -> None:
    """Weighted rows by everything that an observation depends on.

    With S^T S = weight (1 + bend r r^T), the curvature of the loss, whitened rows J become S J and
    residuals S^-T weight r (Triggs et al., Bundle adjustment: a modern synthesis, 2000, 4.3).
    """
    basis, e, Jq = np.empty((2, 3)), np.empty(3), np.empty((2, 3))
    before = -1
    for i in range(n):
        o, j, f, c = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        if j != before:
            bearing_basis(points[j], basis)
            before = j
        w = points[j, 3]
        r0, r1 = residuals[i, 0], residuals[i, 1]
        root, along = np.sqrt(weights[i]), np.sqrt(1.0 + bends[i] * (r0 * r0 + r1 * r1))
        residuals[i, 0], residuals[i, 1] = r0 * root / along, r1 * root / along
        beta = bends[i] / (1.0 + along)
        w00, w01, w11 = root_information[o]
        across = root * beta * r0 * r1
        first, second = root * (1 + beta * r0 * r0), root * (1 + beta * r1 * r1)
        s00, s01 = first * w00, first * w01 + across * w11
        s10, s11 = across * w00, across * w01 + second * w11
        for k in range(3):
            Jq[0, k] = s00 * by_point[i, 0, k] + s01 * by_point[i, 1, k]
            Jq[1, k] = s10 * by_point[i, 0, k] + s11 * by_point[i, 1, k]
        for k in range(by_params.shape[2]):
            x, y = by_params[i, 0, k], by_params[i, 1, k]
            by_params[i, 0, k], by_params[i, 1, k] = s00 * x + s01 * y, s10 * x + s11 * y
        for a in range(2):
            _by_rig_and_point(
                Jq[a], cam_rotation[c], rig_rotation[f], basis, anchors[j], rig_centre[f],
                cam_centre[c], e, of_point[i, a],
            )  # fmt: skip
            _by_pose(e, in_rig[i], w, of_frame[i, a])
            _by_pose(Jq[a], in_cam[i], w, of_rig[i, a])


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _by_pose(j: Any, p: Any, w: Any, row: Any) -> None:
    """Row (6,) by the tangent of the pose in which the point is p / w, from the row j (3,) by p."""
    row[0] = j[1] * p[2] - j[2] * p[1]
    row[1] = j[2] * p[0] - j[0] * p[2]
    row[2] = j[0] * p[1] - j[1] * p[0]
    row[3], row[4], row[5] = -w * j[0], -w * j[1], -w * j[2]

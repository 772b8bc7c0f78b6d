"""Zhang's closed form: a camera from views of a flat board by linear least squares alone.

Z. Zhang, A flexible new technique for camera calibration, PAMI 22(11), 2000: homographies (appendix
A), the image of the absolute conic (section 3.1), where the board is, k1 and k2 (section 3.3). What
he refines together afterwards is left to others.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from experiments.peers.calibrations import PeerCalibration, residuals_of, rms
from graphs.boards import N_WHOLE
from graphs.camera import Camera, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from sfm_calib.boards.views import BoardView, BoardViews

# fx, fy, cx, cy and skew; without skew; and with fx = fy too.
Unknowns = Literal[5, 4, 3]
# b = B11 B12 B22 B13 B23 B33, as combinations of what is unknown.
CONICS: dict[int, FloatArray] = {
    5: np.eye(6),
    4: np.eye(6)[:, [0, 2, 3, 4, 5]],
    3: np.array([[1, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], *np.eye(4)[1:]], dtype=float),
}
MIN_CORNERS = 4  # of a homography
REFINEMENTS, CONVERGED = 20, 1e-10  # steps at most, and relative fall of the squared error
LEAST_VIEWS = {5: 3, 4: 2, 3: 2}


@dataclass(frozen=True)
class ZhangOptions:
    """Which of the closed forms."""

    unknowns: Unknowns = 4  # a skew that is found is not kept
    refined: bool = True  # homographies by least squares of pixels, as Zhang has them
    alternations: int = 0  # times all is found anew from pixels with the distortion taken out


def calibrate(views: BoardViews, corners: FloatArray, options: ZhangOptions) -> PeerCalibration:
    """One camera with k1 and k2, and where the board is, from views of corners (n, 3), z = 0.

    Raises ValueError where the linear solution is no camera, or there are too few views.
    """
    begin = time.perf_counter()
    (name,), (size,) = views.cameras, views.sizes
    if len(views.views) < LEAST_VIEWS[options.unknowns]:
        raise ValueError(
            f"{len(views.views)} views do not determine {options.unknowns} unknowns: give "
            f"{LEAST_VIEWS[options.unknowns]} or more"
        )
    straight = [view.pixels for view in views.views]
    for _ in range(options.alternations + 1):
        camera, boards = _from_straight(name, size, views.views, straight, corners, options)
        camera = with_distortion(camera, boards, views.views, corners)
        straight = [_straightened(camera, view.pixels) for view in views.views]
    found = PeerCalibration(
        "Zhang", (camera,), (Transform.identity(),),
        {view.frame: board for view, board in zip(views.views, boards, strict=True)},
        np.zeros(N_WHOLE), Covariance((), np.zeros((0, 0))), 0.0,
        seconds=time.perf_counter() - begin,
    )  # fmt: skip
    return replace(found, rms_px=rms(residuals_of(found, views, corners)))


def _from_straight(
    name: str,
    size: tuple[int, int],
    views: Sequence[BoardView],
    straight: Sequence[FloatArray],
    corners: FloatArray,
    options: ZhangOptions,
) -> tuple[Camera, list[Transform]]:
    """A pinhole, and cam_from_board of each view, from pixels (n, 2) without distortion."""
    middle, scale = (np.array(size) - 1) / 2, max(size) / 2  # numbers near one
    found = [
        homography(corners[view.corner, :2], (pixels - middle) / scale, options.refined)
        for view, pixels in zip(views, straight, strict=True)
    ]
    K = camera_matrix(found, options.unknowns)
    inverse = np.linalg.inv(K)
    boards = [board_from_homography(inverse @ H) for H in found]
    focal, centre = scale * np.diag(K)[:2], middle + scale * K[:2, 2]
    return Camera(name, "radial", size, np.array([*focal, *centre, 0.0, 0.0])), boards


def homography(flat: FloatArray, pixels: FloatArray, refined: bool = False) -> FloatArray:
    """H (3, 3) of length one from the board's plane (n, 2) to pixels (n, 2).

    Normalised direct linear transform (Hartley and Zisserman, algorithm 4.2); refined: then least
    squares of the pixels.
    """
    if len(flat) < MIN_CORNERS:
        raise ValueError(f"{len(flat)} corners do not determine a homography: it takes 4")
    (a, from_flat), (b, from_pixels) = _normalised(flat), _normalised(pixels)
    one = np.column_stack([a, np.ones(len(a))])
    zero = np.zeros_like(one)
    rows = np.concatenate([
        np.hstack([one, zero, -b[:, :1] * one]), np.hstack([zero, one, -b[:, 1:] * one]),
    ])  # fmt: skip
    H = np.linalg.svd(rows, full_matrices=False)[2][-1]
    if refined:
        H = _refined(H, one, b)
    H = np.linalg.solve(from_pixels, H.reshape(3, 3) @ from_flat)
    # The board is before the camera: h3 (x, y, 1) is positive there.
    sign = np.sign((H[2] @ np.column_stack([flat, np.ones(len(flat))]).T).sum())
    result: FloatArray = sign * H / np.linalg.norm(H)
    return result


def _refined(H: FloatArray, points: FloatArray, pixels: FloatArray) -> FloatArray:
    """The homography (9,) by least squares of pixels (n, 2) of points (n, 3): Gauss and Newton."""
    best, least = H, np.inf
    for _ in range(REFINEMENTS):
        seen = points @ H.reshape(3, 3).T
        error = seen[:, :2] / seen[:, 2:] - pixels
        cost = float((error**2).sum())
        if not cost < (1 - CONVERGED) * least:
            break
        best, least = H, cost
        over = points / seen[:, 2:]
        J = np.zeros((len(points), 2, 9))
        J[:, 0, 0:3] = J[:, 1, 3:6] = over
        J[:, :, 6:9] = -(error + pixels)[:, :, None] * over[:, None]
        # Its length is free: the shortest step leaves it.
        H = H - np.linalg.lstsq(J.reshape(-1, 9), error.ravel())[0]
    return best


def _normalised(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points (n, 2) about their middle, sqrt(2) away on average, and the map (3, 3) there."""
    middle = points.mean(0)
    scale = np.sqrt(2) / np.linalg.norm(points - middle, axis=1).mean()
    T = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])
    return scale * (points - middle), T


def camera_matrix(found: Sequence[FloatArray], unknowns: Unknowns) -> FloatArray:
    """K (3, 3) from homographies: h1' B h2 = 0 and h1' B h1 = h2' B h2, B = K^-T K^-1 (eq. 8, 9).

    Raises ValueError where B is of no real camera.
    """
    rows = [row for H in found for row in (_row(H, 0, 1), _row(H, 0, 0) - _row(H, 1, 1))]
    basis = CONICS[unknowns]
    b = basis @ np.linalg.svd(np.array(rows) @ basis, full_matrices=False)[2][-1]
    B = np.array([[b[0], b[1], b[3]], [b[1], b[2], b[4]], [b[3], b[4], b[5]]])
    try:
        lower = np.linalg.cholesky(B * np.sign(B[0, 0]))
    except np.linalg.LinAlgError as error:
        raise ValueError("the linear solution is no camera: its conic is not definite") from error
    K = np.linalg.inv(lower).T
    result: FloatArray = K / K[2, 2]
    return result


def _row(H: FloatArray, i: int, j: int) -> FloatArray:
    """v_ij (6,) with h_i' B h_j = v_ij' b."""
    a, b = H[:, i], H[:, j]
    return np.array([
        a[0] * b[0], a[0] * b[1] + a[1] * b[0], a[1] * b[1],
        a[2] * b[0] + a[0] * b[2], a[2] * b[1] + a[1] * b[2], a[2] * b[2],
    ])  # fmt: skip


def board_from_homography(H: FloatArray) -> Transform:
    """cam_from_board of K^-1 H (3, 3), its rotation the nearest one (appendix C)."""
    scale = 2 / np.linalg.norm(H[:, :2], axis=0).sum()
    first, second, shift = scale * H.T
    left, _, right = np.linalg.svd(np.column_stack([first, second, np.cross(first, second)]))
    return Transform(left @ right, shift)


def with_distortion(
    camera: Camera, boards: Sequence[Transform], views: Sequence[BoardView], corners: FloatArray
) -> Camera:
    """k1 and k2 by linear least squares of the pixels (eq. 13)."""
    design, moved = [], []
    for view, board in zip(views, boards, strict=True):
        at = board @ corners[view.corner]
        off = camera.params[:2] * at[:, :2] / at[:, 2:]  # px
        square = ((at[:, :2] / at[:, 2:]) ** 2).sum(1)
        design.append(np.stack([off * square[:, None], off * square[:, None] ** 2], -1))
        moved.append(view.pixels - camera.params[2:4] - off)
    k = np.linalg.lstsq(np.concatenate(design).reshape(-1, 2), np.concatenate(moved).ravel())[0]
    return replace(camera, params=np.array([*camera.params[:4], *k]))


def _straightened(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Where pixels (n, 2) were without distortion. Raises ValueError where no ray leads there."""
    rays = unproject(camera, pixels)
    if np.isnan(rays).any():
        raise ValueError("the distortion folds the picture: corners lie beyond the fold")
    result: FloatArray = camera.params[:2] * rays[:, :2] / rays[:, 2:] + camera.params[2:4]
    return result

"""OpenCV's calibration of cameras and pairs from the corners of a board."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from experiments.peers.calibrations import (
    PeerCalibration,
    gauss_newton_covariance,
    residuals_of,
    rms,
)
from experiments.peers.sightings import common, of_camera
from graphs.boards import N_SHAPE
from graphs.camera import Camera
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.lenses import FOCAL_AND_CENTRE, LENSES, LensName
from sfm_calib.boards.views import BoardView, BoardViews

_NO_K3, _NO_TANGENT = cv2.CALIB_FIX_K3, cv2.CALIB_ZERO_TANGENT_DIST
FLAGS: dict[LensName, int] = {
    "pinhole": cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | _NO_K3 | _NO_TANGENT,
    "radial": _NO_K3 | _NO_TANGENT,
    "radtan": _NO_K3,
    "brown": 0,
    "rational": cv2.CALIB_RATIONAL_MODEL,
}
DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
SingleArray = NDArray[np.float32]
# OpenCV's own criteria stop after 30 steps or a change of 2e-16.
CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12)


def calibrate_camera(views: BoardViews, corners: FloatArray, lens: LensName) -> PeerCalibration:
    """One camera alone, by `cv2.calibrateCameraExtended`, with the sigmas that it states.

    views: of that camera; corners (n, 3) of the board. Its sigmas are without correlations.
    """
    begin = time.perf_counter()
    (name,), (size,) = views.cameras, views.sizes
    boards, seen = _points(views.views, corners)
    _, K, coefficients, turns, shifts, sigmas, _, _ = cv2.calibrateCameraExtended(
        boards, seen, size, None, None, flags=FLAGS[lens], criteria=CRITERIA
    )
    camera = _camera(name, lens, size, K, coefficients)
    names = camera.names
    by_name = dict(zip((*FOCAL_AND_CENTRE, *DISTORTION), sigmas.ravel(), strict=False))
    stated = np.diag([by_name[each] ** 2 for each in names])
    placed = {
        view.frame: _transform(turn, shift)
        for view, turn, shift in zip(views.views, turns, shifts, strict=True)
    }
    covariance = Covariance(tuple(f"{name}.{each}" for each in names), stated)
    return _finished(
        PeerCalibration(
            "OpenCV", (camera,), (Transform.identity(),), placed, np.zeros(N_SHAPE), covariance,
            0.0, seconds=time.perf_counter() - begin,
        ),
        views, corners,
    )  # fmt: skip


def calibrate_pair(
    views: BoardViews, corners: FloatArray, lens: LensName, refined: bool
) -> PeerCalibration:
    """Two cameras by `cv2.stereoCalibrateExtended`, each calibrated alone before.

    Of the pair it takes only corners that both cameras see at once.
    refined: lenses are estimated anew with the pair; else they are held. OpenCV states no sigmas
    of a pair: these are Gauss-Newton's at its optimum, of what it has estimated; held lenses keep
    the sigmas of each camera alone.
    """
    begin = time.perf_counter()
    alone = [calibrate_camera(of_camera(views, index), corners, lens) for index in (0, 1)]
    both = common(views)  # all that OpenCV takes
    left, right = ([view for view in both.views if view.camera == index] for index in (0, 1))
    boards, of_left = _points(left, corners)
    of_right = _points(right, corners)[1]
    start = [_matrices(calibration.cameras[0]) for calibration in alone]
    flags = FLAGS[lens] | cv2.CALIB_USE_INTRINSIC_GUESS if refined else cv2.CALIB_FIX_INTRINSIC
    _, K1, d1, K2, d2, R, t, _, _, turns, shifts, _ = cv2.stereoCalibrateExtended(
        boards, of_left, of_right, *start[0], *start[1], views.sizes[0], None, None,
        flags=flags, criteria=CRITERIA,
    )  # fmt: skip
    cameras = tuple(
        _camera(views.cameras[index], lens, views.sizes[index], K, coefficients)
        for index, (K, coefficients) in enumerate(((K1, d1), (K2, d2)))
    )
    placed = {
        view.frame: _transform(turn, shift)
        for view, turn, shift in zip(left, turns, shifts, strict=True)
    }
    pair = PeerCalibration(
        "OpenCV, refined" if refined else "OpenCV", cameras,
        (Transform.identity(), Transform(R, t.ravel())), placed, np.zeros(N_SHAPE),
        Covariance((), np.zeros((0, 0))), 0.0, seconds=time.perf_counter() - begin,
    )  # fmt: skip
    pair = _finished(pair, both, corners)
    lenses = [f"{camera.name}.{name}" for camera in cameras for name in camera.names]
    rig = [f"{cameras[1].name}.{name}" for name in POSE_NAMES]
    if refined:
        covariance = gauss_newton_covariance(pair, both, corners, [*lenses, *rig])
    else:
        of_rig = gauss_newton_covariance(pair, both, corners, rig)
        covariance = _joined([*(each.covariance for each in alone), of_rig])
    return replace(pair, covariance=covariance)


def _joined(parts: Sequence[Covariance]) -> Covariance:
    names = tuple(name for part in parts for name in part.names)
    matrix, start = np.zeros((len(names), len(names))), 0
    for part in parts:
        end = start + len(part.names)
        matrix[start:end, start:end] = part.matrix
        start = end
    return Covariance(names, matrix)


def _finished(
    calibration: PeerCalibration, views: BoardViews, corners: FloatArray
) -> PeerCalibration:
    return replace(calibration, rms_px=rms(residuals_of(calibration, views, corners)))


def _points(
    views: Sequence[BoardView], corners: FloatArray
) -> tuple[list[SingleArray], list[SingleArray]]:
    # OpenCV takes single precision here, and nothing else: 3e-5 px in a thousand.
    boards = [corners[view.corner].astype(np.float32) for view in views]
    return boards, [view.pixels[:, None].astype(np.float32) for view in views]


def _camera(
    name: str, lens: LensName, size: tuple[int, int], K: FloatArray, coefficients: FloatArray
) -> Camera:
    known = dict(zip(DISTORTION, np.ravel(coefficients).tolist(), strict=False))
    start = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    names = LENSES[lens].coefficients
    return Camera(name, lens, size, np.array([*start, *(known[each] for each in names)]))


def _matrices(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """OpenCV's camera matrix (3, 3) and coefficients (5 or 8,)."""
    known = camera.named()
    K = np.array([[known["fx"], 0, known["cx"]], [0, known["fy"], known["cy"]], [0, 0, 1]])
    count = 8 if camera.lens == "rational" else 5
    return K, np.array([known.get(name, 0.0) for name in DISTORTION[:count]])


def _transform(turn: FloatArray, shift: FloatArray) -> Transform:
    return Transform(exp_rotation(np.ravel(turn)), np.ravel(shift).astype(np.float64))


def place_board(camera: Camera, view: BoardView, board: FloatArray) -> Transform:
    """cam_from_board by PnP, refined, of a board with corners (n, 3)."""
    K, coefficients = _matrices(camera)
    points, pixels = board[view.corner], view.pixels
    _, turn, shift = cv2.solvePnP(points, pixels, K, coefficients, flags=cv2.SOLVEPNP_ITERATIVE)
    turn, shift = cv2.solvePnPRefineLM(points, pixels, K, coefficients, turn, shift)
    return _transform(turn, shift)

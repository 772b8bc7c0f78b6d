"""Boards in rendered images: every corner where it is, under its own number, with a true sigma."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest

from sfm_calib.boards.detect import detect
from sfm_calib.boards.disc import _model as disc_model
from sfm_calib.boards.picture import view_image
from sfm_calib.boards.saddle import _model as saddle_model
from sfm_calib.boards.spec import Aprilgrid, Charuco, Checkerboard, Circles

SIZE = (640, 480)
CHECKERBOARD = Checkerboard(inner_corners=(8, 5), square_m=0.03)
CHARUCO = Charuco(squares=(7, 5), square_m=0.035, marker_m=0.026)
APRILGRID = Aprilgrid(tags=(5, 4), tag_m=0.035, spacing=0.3)
CIRCLES = Circles(circles=(4, 11), spacing_m=0.02)
FOUR = pytest.mark.parametrize(
    "board", [CHECKERBOARD, CHARUCO, APRILGRID, CIRCLES], ids=lambda board: board.type
)
TILTED, FLAT_ON, TURNED = (25, -20, 10), (1, 2, 3), (-35, 25, -95)


def homography(board, tilt_deg, size=SIZE, distance_m=0.5, focal_px=600.0):
    """Pixels from places on the board, whose middle is seen near the middle of the image."""
    rotation = cv2.Rodrigues(np.radians(np.array(tilt_deg, dtype=float)))[0]
    middle = (board.corners_m.min(axis=0) + board.corners_m.max(axis=0)) / 2
    translation = np.array([0, 0, distance_m]) - rotation @ middle
    x, y = size[0] / 2 - 0.3, size[1] / 2 + 0.2
    camera = np.array([[focal_px, 0, x], [0, focal_px, y], [0, 0, 1]])
    return camera @ np.column_stack([rotation[:, 0], rotation[:, 1], translation])


def mapped(matrix, points):
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def render(board, tilt_deg, size=SIZE, **view):
    """The image and the true pixels of all corners."""
    image, truth = _rendered(board, tilt_deg, size, tuple(view.items()))
    return image.copy(), truth


@functools.cache
def _rendered(board, tilt_deg, size, view):
    seen = homography(board, tilt_deg, size, **dict(view))
    image = view_image(board, lambda pixels: mapped(np.linalg.inv(seen), pixels), size)
    return image, mapped(seen, board.corners_m[:, :2])


def errors(found, board, truth):
    """Differences to the truth under the one of the board's numberings that fits best."""
    numberings = (np.arange(len(truth)), *board.symmetries)
    every = [found.pixels - truth[numbers][found.corner] for numbers in numberings]
    return min(every, key=lambda each: np.abs(each).max())


@FOUR
def test_corners_are_found_without_bias(board):
    """Tilts that draw circles' centres by up to 0.4 px among them."""
    every = []
    for tilt in (TILTED, FLAT_ON, TURNED):
        image, truth = render(board, tilt)
        found = detect(image, board)
        assert found is not None and len(found.corner) >= 0.9 * len(truth)
        every.append(errors(found, board, truth))
        assert np.abs(every[-1].mean(axis=0)).max() < 0.02
    assert np.sqrt(np.mean(np.concatenate(every) ** 2)) < 0.03


@pytest.mark.parametrize(
    "board",
    [
        Checkerboard(inner_corners=(8, 6), square_m=0.03),
        Checkerboard(inner_corners=(5, 5), square_m=0.03),
        Checkerboard(inner_corners=(4, 4), square_m=0.04),
        Charuco(squares=(5, 6), square_m=0.035, marker_m=0.026, legacy=True, inverted=True),
        Aprilgrid(tags=(3, 3), tag_m=0.05, spacing=0.25, border_bits=1, first_id=20),
        Circles(circles=(5, 8), spacing_m=0.02),
        Circles(circles=(7, 5), spacing_m=0.03, asymmetric=False, inverted=True),
    ],
    ids=lambda board: board.described,
)
@pytest.mark.parametrize("turn_deg", [0, 100, 190])
def test_numbers_are_those_of_the_front(board, turn_deg):
    """Whichever way the board is turned; errors() knows of no mirrored numbering."""
    image, truth = render(board, (15, -20, turn_deg))
    found = detect(image, board)
    assert found is not None and len(found.corner) >= 0.9 * len(truth)
    assert np.abs(errors(found, board, truth)).max() < 0.1


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=lambda board: board.type)
def test_markers_are_found_in_part(board):
    image, truth = render(board, TILTED)
    image[:, :300] = 90
    found = detect(image, board)
    assert found is not None and 6 <= len(found.corner) < len(truth)
    assert np.abs(errors(found, board, truth)).max() < 0.1
    assert (found.pixels[:, 0] > 299).all()


def test_a_mirrored_image_of_markers_is_no_board():
    image, truth = render(CHARUCO, TILTED)
    mirrored = np.ascontiguousarray(image[:, ::-1])
    assert detect(mirrored, CHARUCO) is None
    found = detect(mirrored, CHARUCO.model_copy(update={"two_sided": True}))
    assert found is not None
    expected = [SIZE[0] - 1, 0] + truth[found.corner] * [-1, 1]
    assert np.abs(found.pixels - expected).max() < 0.1


@pytest.mark.parametrize("wanted", [(7, 5), (8, 4), (6, 4), (9, 5)])
def test_part_of_another_checkerboard_is_not_this_one(wanted):
    for tilt in (TILTED, FLAT_ON):
        image, _ = render(CHECKERBOARD, tilt)
        assert detect(image, CHECKERBOARD.model_copy(update={"inner_corners": wanted})) is None


@pytest.mark.parametrize(
    ("board", "wanted"),
    [
        (CHARUCO, CHARUCO.model_copy(update={"squares": (6, 5)})),
        (APRILGRID, APRILGRID.model_copy(update={"tags": (4, 5)})),
        (CIRCLES, CIRCLES.model_copy(update={"circles": (4, 9)})),
    ],
    ids=lambda board: board.described,
)
def test_another_layout_is_not_this_board(board, wanted):
    image, _ = render(board, TILTED)
    assert detect(image, wanted) is None


@FOUR
def test_nothing_is_found_where_there_is_nothing(board):
    noise = np.random.default_rng(0).integers(0, 255, SIZE[::-1], np.uint8)
    assert detect(cv2.GaussianBlur(noise, (0, 0), 2), board) is None
    assert detect(np.full(SIZE[::-1], 128, np.uint8), board) is None


@pytest.mark.slow
def test_large_images_are_refined_at_full_scale():
    image, truth = render(CHECKERBOARD, TILTED, size=(1600, 1200), focal_px=1500.0)
    found = detect(image, CHECKERBOARD)
    assert found is not None and np.abs(errors(found, CHECKERBOARD, truth)).max() < 0.05


def test_a_finger_on_a_corner_costs_that_corner():
    image, truth = render(CHECKERBOARD, TILTED)
    x, y = truth[19].round().astype(int)
    cv2.circle(image, (int(x) + 2, int(y) + 1), 7, 128, -1)
    found = detect(image, CHECKERBOARD)
    assert found is not None and 19 not in found.corner and len(found.corner) >= len(truth) - 2
    assert np.abs(errors(found, CHECKERBOARD, truth)).max() < 0.1


@FOUR
@pytest.mark.parametrize(("blur_px", "noise"), [(0.6, 2), (0.6, 8), (1.5, 4)])
def test_sigmas_track_the_scatter(board, blur_px, noise):
    """Within a factor of 2, from sharp to blurred and from quiet to noisy."""
    image, truth = render(board, (15, -10, 5))
    image = cv2.GaussianBlur(image, (0, 0), blur_px).astype(float) * 0.6 + 40
    rng = np.random.default_rng(1)
    off, sigma = [], []
    for _ in range(3):
        noisy = np.clip(np.rint(image + noise * rng.standard_normal(image.shape)), 0, 255)
        found = detect(noisy.astype(np.uint8), board)
        assert found is not None
        off.append(errors(found, board, truth))
        sigma.append(found.sigma_px)
    scatter = np.sqrt(np.mean(np.concatenate(off) ** 2))
    stated = np.sqrt(np.mean(np.concatenate(sigma) ** 2))
    assert 0.5 < stated / scatter < 2


def test_noise_that_is_correlated_counts_for_more():
    """Demosaicing and codecs smear noise over neighbouring pixels."""
    image, truth = render(CHECKERBOARD, (15, -10, 5))
    rng = np.random.default_rng(0)
    off, sigma = [], []
    for _ in range(4):
        grain = cv2.GaussianBlur(rng.standard_normal(image.shape), (0, 0), 0.8) * 20
        noisy = np.clip(np.rint(image * 0.6 + 50 + grain), 0, 255).astype(np.uint8)
        found = detect(noisy, CHECKERBOARD)
        assert found is not None
        off.append(errors(found, CHECKERBOARD, truth))
        sigma.append(found.sigma_px)
    scatter, stated = (np.sqrt(np.mean(np.concatenate(each) ** 2)) for each in (off, sigma))
    assert 0.5 < stated / scatter < 2


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        (saddle_model, [0.2, -0.3, 0.1, 1.5, -0.3, 50, 120, 0.5, -0.4]),
        (disc_model, [0.2, -0.3, 0.2, 0.05, 0.25, -0.2, -50, 120, 0.5, -0.4]),
    ],
    ids=["saddle", "disc"],
)
def test_jacobians_are_differences(model, parameters):
    at = np.array([parameters])
    offsets = np.random.default_rng(0).normal(size=(30, 2)) * 4
    _, jacobian = model(at, offsets)
    for place in range(at.shape[1]):
        step = np.zeros_like(at)
        step[0, place] = 1e-6
        difference = (model(at + step, offsets)[0] - model(at - step, offsets)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[..., place], difference, atol=1e-4, rtol=1e-5)

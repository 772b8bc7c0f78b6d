"""How sharp an image is: the width of its edges, and which images are blurred beside others."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from graphs.coverage import GRID
from sfm_calib.findings import blurred_images
from sfm_calib.images import ScanImage
from sfm_calib.sharpness import ImageQuality, edge_width_px, quality_of

IMAGE = ScanImage(0, 0, "0.png")


def chequered(blur_px=0.0, motion_px=(1, 1), noise=0.0):
    """Bright and dark squares of 20 px, blurred, smeared and noisy."""
    rng = np.random.default_rng(0)
    squares = np.kron(rng.integers(0, 2, (30, 40)) * 150.0 + 40, np.ones((20, 20)))
    image = cv2.GaussianBlur(squares, (0, 0), blur_px) if blur_px else squares
    image = cv2.blur(image, motion_px) + noise * rng.standard_normal(image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0, 2])
@pytest.mark.parametrize("blur_px", [1.2, 1.6, 2.0])
def test_the_width_of_edges_is_that_of_their_blur(blur_px, noise):
    assert edge_width_px(chequered(blur_px, noise=noise)) == pytest.approx(blur_px, rel=0.2)


def test_sharp_edges_are_narrow():
    assert edge_width_px(chequered()) < 0.8


@pytest.mark.parametrize("smear", [(12, 1), (1, 12)])
def test_motion_along_one_direction_is_blur(smear):
    assert edge_width_px(chequered(motion_px=smear)) > 1.5


def test_an_image_without_edges_has_no_width():
    assert np.isnan(edge_width_px(np.full((100, 100), 128, np.uint8)))


def test_large_images_are_reduced():
    image = cv2.GaussianBlur(np.kron(chequered(), np.ones((2, 2), np.uint8)), (0, 0), 2)
    shrink = np.sqrt(1e6 / image.size)
    assert quality_of(IMAGE, image).edge_px == pytest.approx(shrink * edge_width_px(image), rel=0.1)


def quality(edge_px=0.3, white=0.0, black=0.0, frame=0, brightness=100.0):
    cells = np.full((GRID, GRID), brightness)
    return ImageQuality(ScanImage(0, frame, f"{frame}.png"), edge_px, 100.0, black, white, cells)


@pytest.mark.parametrize(
    ("widths", "blurred"),
    [
        ([0.3] * 9, []),
        ([0.3] * 9 + [1.0], [9]),  # beside sharp ones
        ([0.5] * 9 + [1.0], []),
        ([1.0] * 9 + [1.1], []),
        ([1.6] * 9 + [0.5], list(range(9))),  # all of them
        ([np.nan] * 3 + [0.3, 2.0], [4]),
    ],
)
def test_blurred_images_are_named(widths, blurred):
    own = [quality(width, frame=i) for i, width in enumerate(widths)]
    assert [each.image.frame for each in blurred_images(own)] == blurred

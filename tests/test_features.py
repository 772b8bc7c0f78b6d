"""SIFT features on blobs whose places and sizes are known."""

import cv2
import numpy as np
import pytest

from sfm_calib.features import Features, features_of, load, save


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    """An image of Gaussian blobs; their centres and sigmas (n, 3) in px."""
    rng = np.random.default_rng(0)
    down, across = np.mgrid[:300, :400]
    image, known = np.full(down.shape, 60.0), []
    for row in range(5):
        for column in range(7):
            x, y = 40 + 54 * column + rng.uniform(-1, 1), 35 + 56 * row + rng.uniform(-1, 1)
            sigma = rng.uniform(2, 6)
            off = (across - x) ** 2 + (down - y) ** 2
            image += 150 * np.exp(-off / (2 * sigma**2))
            known.append((x, y, sigma))
    path = tmp_path_factory.mktemp("blobs") / "blobs.png"
    cv2.imwrite(str(path), image.round().astype(np.uint8))
    return path, np.array(known)


@pytest.mark.parametrize("image_scale", [1.0, 0.5, 0.7])
def test_pixel_centres_are_at_integers_and_scales_are_the_blobs(blobs, image_scale):
    """Half a pixel off would be COLMAP's origin, a quarter OpenCV's doubled image."""
    path, known = blobs
    found = features_of(path, 10_000, image_scale)
    apart = np.linalg.norm(found.pixels[:, None] - known[None, :, :2], axis=-1)
    nearest = apart.argmin(0)
    there = apart.min(0) < 1.0
    assert there.mean() > (0.9 if image_scale > 0.6 else 0.6)  # reduced, the smallest are no blobs
    off = (found.pixels[nearest] - known[:, :2])[there]
    assert np.abs(off.mean(0)).max() < 0.03 and np.abs(off).max() < 0.2
    assert 0.75 < np.median(found.scales[nearest] / known[:, 2]) < 1.25


def test_the_largest_come_first_and_levels_are_whole(blobs):
    everything, some = (features_of(blobs[0], count) for count in (10_000, 12))
    assert (np.diff(everything.scales) <= 0).all()
    assert 12 <= len(some) < len(everything)
    np.testing.assert_array_equal(some.pixels, everything.pixels[: len(some)])
    level = np.round(3 * np.log2(2 * everything.scales))
    assert level[len(some) - 1] > level[len(some)]


def test_features_are_loaded_as_they_were_saved(blobs, tmp_path):
    found = features_of(blobs[0], 20)
    none = Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
    save([found, none, found.largest(3)], tmp_path)
    again = load(tmp_path)
    assert [len(one) for one in again] == [len(found), 0, 3]
    for one, other in zip(again, (found, none, found.largest(3)), strict=True):
        for name in ("pixels", "scales", "descriptors"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))

"""Which pairs are matched: neighbours in time, loops by appearance, the same every time."""

from pathlib import Path

import numpy as np
import pytest

from sfm_calib import pairs
from sfm_calib.images import Scan, ScanImage
from sfm_calib.pairs import choose_pairs, near_in_time, root_sift, similar


def scan_of(n_cameras, n_frames):
    images = tuple(ScanImage(c, f, f"{c}/{f}") for c in range(n_cameras) for f in range(n_frames))
    names = tuple(f"cam{c}" for c in range(n_cameras))
    return Scan(Path(), names, ((64, 48),) * n_cameras, tuple(map(str, range(n_frames))), images)


def descriptors_of(places, n=60, seed=0):
    """Features of images that show places: image i shows what all images of its place show."""
    world = np.random.default_rng(seed).integers(0, 255, (max(places) + 1, n, 128))
    noise = np.random.default_rng(seed + 1)

    def read(number):
        seen = world[places[number]] + noise.integers(-3, 4, (n, 128))
        return np.clip(seen, 0, 255).astype(np.uint8)

    cache = [read(number) for number in range(len(places))]
    return lambda number: cache[number]


def test_a_small_scan_is_matched_in_full():
    chosen = choose_pairs(scan_of(2, 4), "auto", descriptors_of([0] * 8), 0)
    assert chosen == [(i, j) for i in range(8) for j in range(i + 1, 8)]


def test_a_large_scan_is_not(monkeypatch):
    scan, descriptors = scan_of(1, 60), descriptors_of(list(range(60)))
    assert len(choose_pairs(scan, "auto", descriptors, 0)) == 60 * 59 // 2
    monkeypatch.setattr(pairs, "MAX_COMPARISONS", 1000)
    chosen = choose_pairs(scan, "auto", descriptors, 0)
    assert len(chosen) < 60 * 59 // 2 and chosen == choose_pairs(scan, "selected", descriptors, 0)
    assert len(choose_pairs(scan, "all", descriptors, 0)) == 60 * 59 // 2


def test_pairs_are_sorted_and_different():
    chosen = choose_pairs(scan_of(2, 30), "selected", descriptors_of(list(range(60))), 0)
    assert chosen == sorted(set(chosen)) and all(0 <= i < j < 60 for i, j in chosen)


def test_neighbours_in_time():
    scan = scan_of(2, 10)
    chosen = near_in_time(scan)
    for frame in range(10):
        assert (frame, 10 + frame) in chosen  # the other camera at the same time
        for camera in (0, 1):
            if frame < 9:
                assert (10 * camera + frame, 10 * camera + frame + 1) in chosen
    assert all(i != j for i, j in chosen)


@pytest.mark.parametrize("seed", range(3))
def test_loops_are_found_by_appearance(seed):
    # Sixty images walk past thirty places and then past the same thirty again.
    places = [*range(30), *range(30)]
    found = similar(60, descriptors_of(places), seed)
    assert all((place, place + 30) in found for place in range(30))
    assert not any((place, place + 30) in near_in_time(scan_of(1, 60)) for place in range(30))


def test_a_large_scan_is_matched_with_its_loops():
    places = [*range(30), *range(30)]
    chosen = choose_pairs(scan_of(1, 60), "selected", descriptors_of(places), 0)
    assert {(place, place + 30) for place in range(30)} | near_in_time(scan_of(1, 60)) <= set(
        chosen
    )


def test_the_choice_is_the_same_every_time():
    descriptors = descriptors_of(list(range(40)))
    assert similar(40, descriptors, 5) == similar(40, descriptors, 5)


def test_images_without_features():
    empty = np.zeros((0, 128), np.uint8)
    assert all(i < j for i, j in similar(5, lambda i: empty, 0))
    some = descriptors_of([0, 0, 0])
    found = similar(4, lambda i: empty if i == 3 else some(i), 0)
    assert {(0, 1), (0, 2), (1, 2)} <= found
    assert choose_pairs(scan_of(1, 3), "auto", lambda i: empty, 0) == [(0, 1), (0, 2), (1, 2)]


def test_root_sift_has_length_one():
    lengths = np.linalg.norm(root_sift(descriptors_of([0])(0)), axis=1)
    np.testing.assert_allclose(lengths, 1.0, rtol=1e-5)
    assert not root_sift(np.zeros((2, 128), np.uint8)).any()

"""Which pairs are matched: neighbours in time and on the rig, loops, and never too many."""

from pathlib import Path

import numpy as np
import pytest

from sfm_calib import pairs, retrieval
from sfm_calib.images import Scan, ScanImage
from sfm_calib.pairs import choose_pairs, in_frames, in_order, in_sequence, likely_pairs
from sfm_calib.retrieval import draw_vocabulary, signatures

STEP, SEEN = 8, 80  # points of a street: between two images, and in one


def silent(stage, done, total):
    """Progress that nobody watches."""


def scan_of(n_cameras, n_frames, taken=lambda camera, frame: True):
    images = tuple(
        ScanImage(c, f, f"{c}/{f}")
        for c in range(n_cameras)
        for f in range(n_frames)
        if taken(c, f)
    )
    names = tuple(f"cam{c}" for c in range(n_cameras))
    return Scan(Path(), names, ((64, 48),) * n_cameras, tuple(map(str, range(n_frames))), images)


def street(places, seed=0, blank=(), step=STEP, changed=()):
    """Features of images along a street: those `step` apart share all but `step` of their points.

    changed: images in which half of what was there is gone, and something else is there.
    """
    rng = np.random.default_rng(seed)
    world = rng.integers(0, 200, (step * (max(places) + 1) + SEEN, 64))
    later = np.where(rng.random((len(world), 1)) < 0.5, rng.permutation(world), world)
    found = []
    for number, place in enumerate(places):
        now = later if number in changed else world
        seen = now[step * place :][:SEEN][rng.random(SEEN) < 0.7]
        kept = 0 if number in blank else len(seen)
        found.append((seen + rng.integers(0, 9, seen.shape)).astype(np.uint8)[:kept])
    return found.__getitem__


def chosen_of(scan, descriptors, how="selected", seed=0):
    return choose_pairs(scan, how, descriptors, seed, silent)


def signatures_of(places):
    descriptors = street(places)
    vocabulary = draw_vocabulary(len(places), descriptors, 0)
    return signatures(len(places), descriptors, vocabulary, silent)


def components(n, chosen):
    return len(set(pairs._groups(n, set(chosen)).tolist()))


def test_a_small_scan_is_matched_in_full():
    every = [(i, j) for i in range(8) for j in range(i + 1, 8)]
    assert chosen_of(scan_of(2, 4), street(range(8)), "auto") == every


def test_a_large_scan_is_not():
    n = 500  # five minutes, even with so few features
    scan, descriptors = scan_of(1, n), street(range(n))
    chosen = chosen_of(scan, descriptors, "auto")
    assert len(chosen) < 20 * n and chosen == chosen_of(scan, descriptors)
    assert len(chosen_of(scan, descriptors, "all")) == n * (n - 1) // 2


@pytest.mark.parametrize(("features", "expected"), [(100, 435), (20000, None)])
def test_how_long_matching_takes_is_what_makes_a_scan_large(features, expected, monkeypatch):
    monkeypatch.setattr(pairs, "MAX_SECONDS", 20.0)
    rng = np.random.default_rng(0)
    found = [rng.integers(0, 200, (features, 8)).astype(np.uint8) for _ in range(30)]
    n_chosen = len(chosen_of(scan_of(1, 30), found.__getitem__, "auto"))
    assert n_chosen == expected if expected else n_chosen < 400


def test_pairs_are_sorted_and_different():
    chosen = chosen_of(scan_of(2, 30), street([*range(30), *range(30)]))
    assert chosen == sorted(set(chosen)) and all(0 <= i < j < 60 for i, j in chosen)


def test_their_number_grows_with_the_images():
    a_image = [
        len(chosen_of(scan_of(3, n // 3), street([*range(n // 3)] * 3))) / n for n in (120, 480)
    ]
    assert a_image[1] < 1.1 * a_image[0] and a_image[1] < 20


def test_neighbours_in_time():
    found = in_sequence([[3, 1, 4, 0, 2]])
    ahead = {(1, 3), (1, 4), (0, 4), (0, 2)}  # one apart
    assert found == ahead | {(3, 4), (0, 1), (2, 4), (0, 3), (1, 2)}  # two and three apart
    assert {b for a, b in in_sequence([list(range(50))]) if a == 10} == {
        10 + step for step in pairs.OWN_STEPS
    }


def test_photographs_in_no_order_are_not_taken_for_a_sequence():
    n = 120
    shuffled = np.random.default_rng(1).permutation(n)
    assert in_order(signatures_of(range(n)), list(range(n)))
    assert not in_order(signatures_of(shuffled), list(range(n)))
    chosen = chosen_of(scan_of(1, n), street(shuffled))
    apart = np.array([abs(shuffled[a] - shuffled[b]) for a, b in chosen])
    assert 8 * n < len(chosen) < 14 * n and np.mean(apart < SEEN / STEP) > 0.6
    place = np.argsort(shuffled)  # of the images along the street
    linked = {tuple(sorted((place[k], place[k + 1]))) for k in range(n - 1)}
    assert len(linked - set(chosen)) < 0.02 * n


@pytest.mark.parametrize("seed", range(3))
def test_loops_of_a_slow_video_are_found(seed):
    # At its second visit half the street has changed: what is most alike are neighbours in time.
    n, frames = 100, 200
    descriptors = street([*range(n)] * 2, seed, step=3, changed=range(n, frames))
    found = chosen_of(scan_of(1, frames), descriptors, seed=seed)
    loops = {k for a, b in found for k in (a, b) if abs(b - a - n) <= 12}
    assert len(loops) > 0.985 * frames and len(found) < 16 * frames


def test_images_of_one_frame():
    scan = scan_of(3, 6, lambda camera, frame: camera < 2 or frame in (1, 4))
    number = {(image.camera, image.frame): k for k, image in enumerate(scan.images)}
    found = in_frames(scan, pairs._sequences(scan), signatures_of([0] * len(scan.images)))
    expected = {(number[0, f], number[1, f]) for f in range(6)}
    expected |= {(number[c, f], number[2, f]) for c in (0, 1) for f in (1, 4)}
    assert found == expected


@pytest.mark.parametrize("later", [1, 3])
def test_cameras_that_take_turns_are_paired_with_the_nearest_in_time(later):
    scan = scan_of(2, 16, lambda camera, frame: frame % 4 == later * camera)
    found = in_frames(scan, pairs._sequences(scan), signatures_of([0] * 8))
    times = [(scan.images[a].frame, scan.images[b].frame) for a, b in found]
    expected = {1: [(0, 1), (4, 5), (8, 9), (12, 13)], 3: [(0, 3), (4, 3), (8, 7), (12, 11)]}
    assert sorted(times) == expected[later]


def test_of_many_cameras_those_that_see_the_same_are_paired():
    n_cameras, n_frames = 30, 4
    ring = [camera for camera in range(n_cameras) for _ in range(n_frames)]
    scan, of = scan_of(n_cameras, n_frames), signatures_of(ring)
    found = in_frames(scan, pairs._sequences(scan), of)
    cameras = [{scan.images[a].camera, scan.images[b].camera} for a, b in found]
    assert len(found) <= n_frames * n_cameras * pairs.RIG_NEIGHBOURS
    assert {scan.images[a].frame == scan.images[b].frame for a, b in found} == {True}
    assert all({c, c + 1} in cameras for c in range(n_cameras - 1)) and {0, 29} not in cameras


def test_cameras_that_see_a_place_one_after_the_other_are_paired():
    # The second camera looks back: it sees what the first saw 12 frames before.
    frames, behind = 60, 12
    places = [*range(behind, frames + behind), *range(frames)]
    found = set(chosen_of(scan_of(2, frames), street(places)))
    again = range(frames - behind)
    linked = [
        any((k, frames + k + behind + d) in found for d in range(-4, 5) if k + behind + d < frames)
        for k in again
    ]
    assert np.mean(linked) > 0.95


def test_what_the_choice_leaves_apart_is_joined():
    # Three heaps of photographs of one thing each, mixed up, under one sky.
    heap = np.random.default_rng(0).permutation([0] * 50 + [1] * 50 + [2] * 50)
    own, sky = street(100 * heap), street([0], seed=1)(0)[:5]
    chosen = chosen_of(scan_of(1, 150), lambda i: np.concatenate([sky, own(i)]))
    assert components(150, chosen) == 1
    across = [(a, b) for a, b in chosen if heap[a] != heap[b]]
    assert 2 * pairs.LINKS <= len(across) <= 4 * pairs.LINKS


def test_groups_are_joined_where_they_are_most_alike():
    own = street([0] * 20 + [100] * 20)
    found = [np.concatenate([own(i), own(30)[:5]]) if i in (7, 8) else own(i) for i in range(40)]
    vocabulary = draw_vocabulary(40, found.__getitem__, 0)
    of = signatures(40, found.__getitem__, vocabulary, silent)
    heaps = {(i, i + 1) for i in range(39) if i != 19}
    joined = pairs.links(of, heaps)
    assert len(joined) == pairs.LINKS and {a for a, _ in joined} == {7, 8}
    assert not pairs.links(of, heaps | joined)


def test_the_choice_is_the_same_every_time():
    scan, descriptors = scan_of(2, 40), street([*range(40), *range(40)])
    assert chosen_of(scan, descriptors) == chosen_of(scan, descriptors)


def test_images_without_features_are_left_to_their_neighbours():
    empty = np.zeros((0, 64), np.uint8)
    assert chosen_of(scan_of(1, 3), lambda i: empty, "auto") == [(0, 1), (0, 2), (1, 2)]
    assert chosen_of(scan_of(1, 9), lambda i: empty) == []
    found = chosen_of(scan_of(1, 40), street(range(40), blank=[7]))
    assert {(6, 7), (7, 8)} <= set(found) and (7, 39) not in found


def test_the_signatures_make_the_choice(monkeypatch):
    monkeypatch.setattr(retrieval, "SAMPLED_IMAGES", 10)
    n, read = 60, []
    descriptors = street(range(n))
    chosen = chosen_of(scan_of(1, n), lambda i: read.append(i) or descriptors(i))
    assert len(read) == n + 10
    vocabulary = draw_vocabulary(n, descriptors, 0)
    of = signatures(n, descriptors, vocabulary, silent)
    assert chosen == likely_pairs(scan_of(1, n), of)

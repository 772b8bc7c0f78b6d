"""Which images look alike: whatever their descriptors are, and without reading them twice."""

import numpy as np
import pytest

from sfm_calib import retrieval
from sfm_calib.retrieval import draw_vocabulary, likeness, signatures, unit_length


def silent(stage, done, total):
    """Progress that nobody watches."""


def images_of(places, width=128, kind=np.uint8, n=120, seed=0):
    """Features of images that show places, each with what it shows alone among them."""
    rng = np.random.default_rng(seed)
    world = rng.integers(0, 200, (max(places) + 1, n, width))
    found = []
    for place in places:
        seen = world[place][rng.random(n) < 0.7] + rng.integers(-8, 9, (1, width))
        own = rng.integers(0, 200, (len(seen), width))
        mixed = rng.permutation(np.concatenate([seen, own]))
        found.append(np.clip(mixed, 0, 255).astype(np.uint8))
    return [one if kind == np.uint8 else one.astype(kind) / 512 for one in found]


def signatures_of(found, seed=0):
    vocabulary = draw_vocabulary(len(found), lambda i: found[i], seed)
    return signatures(len(found), lambda i: found[i], vocabulary, silent)


def dense(of):
    return np.array([row for _, row in likeness(of, np.arange(of.shape[0]))])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("width", "kind"), [(128, np.uint8), (64, np.float32), (256, np.float64)])
def test_images_of_one_place_are_most_alike(width, kind, seed):
    found = images_of([*range(40), *range(40)], width, kind, seed=seed)
    alike = dense(signatures_of(found, seed))
    np.testing.assert_allclose(np.diag(alike), 1, rtol=1e-5)
    assert alike.min() >= 0 and alike.max() < 1 + 1e-5
    np.fill_diagonal(alike, 0)
    np.testing.assert_array_equal(np.argmax(alike, axis=1), [*range(40, 80), *range(40)])


def test_bytes_and_floats_of_the_same_features_are_the_same():
    a, b = (signatures_of(images_of([0, 1, 0, 2], kind=kind)) for kind in (np.uint8, np.float32))
    np.testing.assert_allclose(a.toarray(), b.toarray(), atol=1e-6)


def test_what_every_image_shows_says_nothing():
    common = np.random.default_rng(5).integers(0, 200, (200, 128)).astype(np.uint8)
    found = images_of([*range(20), *range(20)], n=60)
    alike = dense(signatures_of([np.concatenate([common, one]) for one in found]))
    np.fill_diagonal(alike, 0)
    np.testing.assert_array_equal(np.argmax(alike, axis=1), [*range(20, 40), *range(20)])
    other = [alike[i, j] for i in range(20) for j in range(20) if i != j]
    assert np.median(other) < 0.2  # they share three features in four


def test_a_pattern_that_repeats_counts_little():
    rng = np.random.default_rng(6)
    tile = rng.integers(0, 200, (1, 128)).repeat(100, axis=0).astype(np.uint8)
    places = images_of([0, 0, 1, 1, 2, 3, 4, 5])
    tiled = [np.concatenate([tile, one]) if i in (0, 2) else one for i, one in enumerate(places)]
    alike = dense(signatures_of(tiled))
    assert alike[0, 1] > alike[0, 2] and alike[2, 3] > alike[0, 2]


def test_blocks_and_subsets_are_parts_of_the_whole(monkeypatch):
    of = signatures_of(images_of([*range(12), *range(12)]))
    whole = (of @ of.T).toarray()
    monkeypatch.setattr(retrieval, "ROWS", 5)
    np.testing.assert_allclose(dense(of), whole, atol=1e-6)
    rows, columns = np.array([7, 3, 20]), np.array([1, 19, 2])
    part = list(likeness(of, rows, columns))
    assert [number for number, _ in part] == [7, 3, 20]
    np.testing.assert_allclose([row for _, row in part], whole[np.ix_(rows, columns)], atol=1e-6)


def test_an_image_is_read_once_and_some_once_more_for_the_words(monkeypatch):
    monkeypatch.setattr(retrieval, "SAMPLED_IMAGES", 7)
    found, read, steps = images_of(range(30)), [], []
    vocabulary = draw_vocabulary(30, lambda i: read.append(i) or found[i], 0)
    assert len(read) == len(set(read)) == 7
    assert vocabulary.mean_features == np.mean([len(found[i]) for i in read])
    read.clear()
    signatures(30, lambda i: read.append(i) or found[i], vocabulary, lambda *s: steps.append(s))
    assert read == list(range(30))
    assert steps[-1] == ("choosing pairs", 30, 30)


def test_the_words_are_few_enough_to_be_shared_and_never_too_many(monkeypatch):
    found = images_of(range(30), n=100)
    n_features = sum(map(len, found))
    words = draw_vocabulary(30, lambda i: found[i], 0).words
    assert n_features / 8 < len(words) < n_features / 5
    monkeypatch.setattr(retrieval, "WORDS", 100)
    assert 100 <= len(draw_vocabulary(30, lambda i: found[i], 0).words) < 130


def test_the_largest_features_alone_are_looked_at(monkeypatch):
    monkeypatch.setattr(retrieval, "FEATURES", 50)
    found = images_of(range(6))
    again = [np.concatenate([one[:50], found[0]]) for one in found]
    np.testing.assert_array_equal(signatures_of(found).toarray(), signatures_of(again).toarray())


def test_images_without_features():
    empty = np.zeros((0, 128), np.uint8)
    assert not dense(signatures_of([empty] * 4)).any()
    some = images_of([0, 0, 1])
    alike = dense(signatures_of([some[0], empty, some[1], some[2]]))
    assert not alike[1].any() and not alike[:, 1].any() and alike[0, 2] > alike[0, 3]


def test_unit_length():
    found = unit_length(np.random.default_rng(0).integers(0, 255, (9, 128), np.uint8))
    assert found.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, rtol=1e-5)
    assert not unit_length(np.zeros((2, 64), np.float32)).any()

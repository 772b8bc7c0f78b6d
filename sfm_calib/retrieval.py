"""Which images look alike: bags of visual words, of the scan's own features.

After Sivic and Zisserman, "Video Google" (ICCV 2003). The words are features drawn from the scan
itself: nothing is trained and nothing downloaded, and descriptors of any length and type will do.
Measured on scans of 100 to 360 images whose pairs had all been matched, it ranks images as their
verified matches do, and where views hardly overlap clearly better than VLAD of 64 trained words.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from graphs.problem import IntArray
from graphs.threads import at_most, threads
from sfm_calib.images import Progress

Descriptors = Callable[[int], NDArray[Any]]  # of an image: (n, d), bytes or floats, largest first

WORDS = 8192  # 4096 and 16384 rank as well
FEATURES_A_WORD = 6  # at least; with fewer, what is alike falls into words of its own
FEATURES = 500  # of an image, its largest: they rank better than 1500 do
SAMPLED_IMAGES = 300  # that words are drawn from
IMAGES_A_BATCH = 32  # for progress
ROWS = 256  # of the likeness at a time: 10 MB of 5,000 images


@dataclass(frozen=True)
class Vocabulary:
    """Features that others are counted as."""

    words: NDArray[np.float32]  # (n_words, d), of length one
    mean_features: float  # of an image, in the images that words were drawn from


def draw_vocabulary(n: int, descriptors: Descriptors, seed: int) -> Vocabulary:
    """Words drawn from n images, or from some of them."""
    rng = np.random.default_rng(seed)
    sampled = np.sort(rng.permutation(n)[:SAMPLED_IMAGES])
    each = -(-WORDS // max(len(sampled), 1))
    drawn, counts = [], []
    for image in sampled:
        found = descriptors(int(image))
        counts.append(len(found))
        largest = found[:FEATURES]
        size = min(each, -(-len(largest) // FEATURES_A_WORD))
        if size:
            drawn.append(unit_length(largest[np.sort(rng.permutation(len(largest))[:size])]))
    words = np.concatenate(drawn) if drawn else np.zeros((0, 1), np.float32)
    return Vocabulary(words, float(np.mean(counts)))


def unit_length(descriptors: NDArray[Any]) -> NDArray[np.float32]:
    """Descriptors (n, d) of any type as vectors of length one; those of zeros stay."""
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-6)


def signatures(
    n: int, descriptors: Descriptors, vocabulary: Vocabulary, progress: Progress
) -> csr_array:
    """Word counts (n, n_words) of n images, each row of length one; products of rows are likeness.

    A word counts with the root of how often it occurs, which tames repeated patterns, and less
    the more images have it. Each image is read once, and a few kB of it are kept.
    """
    words, columns, counts = vocabulary.words, [], []
    with threads() as pool, at_most(1):  # an image is too little work to be shared out
        for begin in range(0, n, IMAGES_A_BATCH):
            batch = range(begin, min(begin + IMAGES_A_BATCH, n))
            found = [descriptors(image)[:FEATURES] for image in batch]
            for column, count in pool.map(lambda one: _words_in(one, words), found):
                columns.append(column)
                counts.append(np.sqrt(count))
            progress("choosing pairs", len(columns), n)
    ends = np.cumsum([0, *map(len, columns)])
    column, value = np.concatenate(columns), np.concatenate(counts)
    having = np.bincount(column, minlength=len(words))
    value = value * np.log((n + 1) / np.maximum(having, 1))[column]
    row = np.repeat(np.arange(n), np.diff(ends))
    lengths = np.sqrt(np.bincount(row, value**2, minlength=n))
    value = (value / np.maximum(lengths, 1e-12)[row]).astype(np.float32)
    return csr_array((value, column, ends), shape=(n, max(len(words), 1)))


def _words_in(
    descriptors: NDArray[Any], words: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The words that descriptors (n, d) are nearest to, and how many to each."""
    if not (len(descriptors) and len(words)):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    nearest = np.argmax(unit_length(descriptors) @ words.T, axis=1)
    return np.unique(nearest, return_counts=True)


def likeness(
    of: csr_array, rows: IntArray, columns: IntArray | None = None
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Row by row, the images `rows` (m,) and how alike the images `columns` are to each, 0 to 1."""
    others = (of if columns is None else of[columns]).T.tocsr()
    for begin in range(0, len(rows), ROWS):
        block = rows[begin : begin + ROWS]
        yield from zip(block.tolist(), (of[block] @ others).toarray(), strict=True)

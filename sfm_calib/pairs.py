"""Which image pairs are worth matching: all of a small scan, likely neighbours of a large one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_calib.images import Scan

MAX_COMPARISONS = 2e10  # of descriptors: about a minute on two cores
# Neighbours in time; the wide steps are what fixes the focal length of a forward drive.
OWN_STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24)  # frames, to the same camera
OTHER_STEPS = (0, 1, 2)  # frames, to other cameras
SIMILAR_IMAGES = 10  # neighbours in appearance: loops, unordered photographs
VOCABULARY_SIZE = 64
DESCRIPTORS_A_IMAGE = 300  # sampled for the vocabulary
Pair = tuple[int, int]  # indices into Scan.images


def choose_pairs(
    scan: Scan,
    how: Literal["auto", "all", "selected"],
    descriptors: Callable[[int], NDArray[np.uint8]],
    seed: int,
) -> list[Pair]:
    """Sorted pairs of image indices. `descriptors(i)` reads the features (n, 128) of image i."""
    n = len(scan.images)
    counts = np.array([len(descriptors(i)) for i in range(n)], dtype=np.float64)
    comparisons = (counts.sum() ** 2 - (counts**2).sum()) / 2
    if how == "all" or (how == "auto" and comparisons <= MAX_COMPARISONS):
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    return sorted(near_in_time(scan) | similar(n, descriptors, seed))


def near_in_time(scan: Scan) -> set[Pair]:
    """Pairs of images of one camera OWN_STEPS frames apart, of two OTHER_STEPS apart."""
    place = {(image.camera, image.frame): number for number, image in enumerate(scan.images)}
    pairs = set()
    for (camera, frame), number in place.items():
        for other in range(len(scan.cameras)):
            for step in OWN_STEPS if other == camera else OTHER_STEPS:
                neighbour = place.get((other, frame + step))
                if neighbour is not None and neighbour != number:
                    pairs.add((min(number, neighbour), max(number, neighbour)))
    return pairs


def similar(n: int, descriptors: Callable[[int], NDArray[np.uint8]], seed: int) -> set[Pair]:
    """Each image with those most like it by VLAD (Jegou et al., CVPR 2010)."""
    features = [root_sift(descriptors(i)) for i in range(n)]
    rng = np.random.default_rng(seed)
    sample = [f[rng.permutation(len(f))[:DESCRIPTORS_A_IMAGE]] for f in features]
    words = _vocabulary(np.concatenate(sample), seed)
    signatures = np.array([_vlad(f, words) for f in features])
    likeness = signatures @ signatures.T
    np.fill_diagonal(likeness, -np.inf)
    closest = np.argsort(-likeness, axis=1, kind="stable")[:, :SIMILAR_IMAGES]
    return {(min(i, int(j)), max(i, int(j))) for i in range(n) for j in closest[i] if i != j}


def root_sift(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Descriptors (n, d) as unit vectors."""
    floats = descriptors.astype(np.float32)
    return floats / np.maximum(np.linalg.norm(floats, axis=1, keepdims=True), 1e-6)


def _vocabulary(sample: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    size = min(VOCABULARY_SIZE, len(sample))
    if size == 0:
        return np.zeros((1, 128), np.float32)
    cv2.setRNGSeed(seed)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 1e-3)
    return cv2.kmeans(sample, size, None, criteria, 1, cv2.KMEANS_PP_CENTERS)[2]


def _vlad(features: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    if len(features) == 0:
        return np.zeros(words.size, np.float32)
    nearest = np.argmax(features @ words.T - 0.5 * (words**2).sum(1), axis=1)
    residual = np.zeros_like(words)
    np.add.at(residual, nearest, features - words[nearest])
    residual = np.sign(residual) * np.sqrt(np.abs(residual))
    flat = residual.ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-6)

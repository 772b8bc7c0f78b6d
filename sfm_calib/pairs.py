"""Which image pairs are worth matching: all of a small scan, likely neighbours of a large one.

Likely are neighbours in time, images of one frame, and images that look alike: loops, and
photographs in no order. Their number grows with the images, not with their square.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from graphs.problem import IntArray
from sfm_calib.images import Progress, Scan
from sfm_calib.retrieval import Descriptors, draw_vocabulary, likeness, signatures

# COLMAP's matching of two images on two cores: 6 ms with 500 features each, 93 ms with 8192.
SECONDS_A_PAIR, SECONDS_A_FEATURE = 2e-3, 1.1e-5
MAX_SECONDS = 180.0  # of matching, for which all pairs are matched
# Images of one camera so far apart in its sequence; the wide steps fix a forward drive's focal
# length. In two real drives a pair 12 apart matches as a rule, 21 apart one in four.
OWN_STEPS = (1, 2, 3, 5, 8, 13, 21)
RIG_NEIGHBOURS = 8  # other cameras, those most alike, whose image of the same frame is matched
# Of the images that look alike, in their order: the nearest, and some far ones, which bridge gaps
# and give parallax where the nearest stand in one place.
RANKS = (0, 1, 2, 3, 4, 6, 9, 13)
RANKS_ALONE = (0, 1, 2, 3, 4, 5, 7, 9, 12, 15, 19, 24, 30, 38)  # without neighbours in time
BESIDE = 1  # images apart in a sequence: what shows the one shows the other
# An image's share of others that are less alike than its next: 0.96 to 1 of videos, 0.7 to 0.96 of
# every fifth frame, 0.4 to 0.6 of shuffled images.
IN_ORDER = 0.65
ASKED_OF_ORDER = 200  # images of a camera, spread over its sequence
LINKS = 5  # pairs that join what the choice left apart
Pair = tuple[int, int]  # indices into Scan.images


def choose_pairs(
    scan: Scan,
    how: Literal["auto", "all", "selected"],
    descriptors: Descriptors,
    seed: int,
    progress: Progress,
    times_sift: float = 1.0,
) -> list[Pair]:
    """Sorted pairs of image indices. `descriptors(i)` reads the features (n, d) of image i.

    times_sift: how many times as long as SIFT's a pair takes to be matched.
    """
    n = len(scan.images)
    every = n * (n - 1) // 2
    if how != "all":
        vocabulary = draw_vocabulary(n, descriptors, seed)
        seconds = SECONDS_A_PAIR + SECONDS_A_FEATURE * vocabulary.mean_features
        if how == "selected" or every * seconds * times_sift > MAX_SECONDS:
            return likely_pairs(scan, signatures(n, descriptors, vocabulary, progress))
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def likely_pairs(scan: Scan, of: csr_array) -> list[Pair]:
    """Sorted pairs of neighbours in time, of one frame, and of images alike by their signatures."""
    sequences = _sequences(scan)
    ordered = [own for own in sequences if in_order(of, own)]
    pairs = in_sequence(ordered) | in_frames(scan, sequences, of)
    pairs |= alike(of, ordered, pairs)
    return sorted(pairs | links(of, pairs))


def _sequences(scan: Scan) -> list[list[int]]:
    """The images of each camera, by frame."""
    sequences: list[list[int]] = [[] for _ in scan.cameras]
    for number in sorted(range(len(scan.images)), key=lambda i: scan.images[i].frame):
        sequences[scan.images[number].camera].append(number)
    return sequences


def in_order(of: csr_array, sequence: list[int]) -> bool:
    """Whether a camera's images are more like the next than like the others."""
    if len(sequence) < 3:
        return True
    own = np.array(sequence)
    asked = np.unique(np.linspace(0, len(own) - 2, ASKED_OF_ORDER).astype(np.int64))
    shares = []
    for k, (_, row) in zip(asked, likeness(of, own[asked], own), strict=True):
        more = np.sign(row[k + 1] - np.delete(row, [k, k + 1]))
        shares.append(0.5 + 0.5 * more.mean())  # what is equally alike counts as half
    return float(np.mean(shares)) >= IN_ORDER


def in_sequence(sequences: list[list[int]]) -> set[Pair]:
    """Pairs of images OWN_STEPS apart in each sequence."""
    return {
        _pair(a, b)
        for own in sequences
        for step in OWN_STEPS
        for a, b in zip(own[:-step], own[step:], strict=True)
    }


def in_frames(scan: Scan, sequences: list[list[int]], of: csr_array) -> set[Pair]:
    """Pairs of images that two cameras took together, or one after the other."""
    frames = [[scan.images[number].frame for number in own] for own in sequences]
    together: dict[Pair, list[Pair]] = {}
    for a in range(len(sequences)):
        for b in range(a + 1, len(sequences)):
            few, many = (a, b) if len(frames[a]) <= len(frames[b]) else (b, a)
            together[a, b] = [
                _pair(number, sequences[many][_nearest(frames[many], frame)])
                for number, frame in zip(sequences[few], frames[few], strict=True)
            ]
    if len(sequences) > RIG_NEIGHBOURS + 1:
        together = _most_alike(together, len(sequences), of)
    return {pair for pairs in together.values() for pair in pairs}


def _nearest(frames: list[int], frame: int) -> int:
    after = min(bisect_left(frames, frame), len(frames) - 1)
    before = max(after - 1, 0)
    return before if frame - frames[before] < abs(frames[after] - frame) else after


def _most_alike(
    together: dict[Pair, list[Pair]], n_cameras: int, of: csr_array
) -> dict[Pair, list[Pair]]:
    """Of pairs of cameras those that are, to one of them, among its RIG_NEIGHBOURS most alike."""
    alike = np.full((n_cameras, n_cameras), -np.inf)
    for (a, b), pairs in together.items():
        first, second = np.array(pairs).T
        alike[a, b] = alike[b, a] = (of[first] * of[second]).sum() / len(pairs)
    kept = np.argsort(-alike, axis=1, kind="stable")[:, :RIG_NEIGHBOURS]
    chosen = {_pair(a, int(b)) for a in range(n_cameras) for b in kept[a]}
    return {cameras: pairs for cameras, pairs in together.items() if cameras in chosen}


def alike(of: csr_array, ordered: list[list[int]], known: set[Pair]) -> set[Pair]:
    """Pairs of each image with those that look like it, by their rank.

    Left out are its pairs that are `known`, and images beside one it has already in a sequence
    that is `ordered`.
    """
    n = of.shape[0]
    beside = [[image] for image in range(n)]
    for own in ordered:
        for place, image in enumerate(own):
            beside[image] = own[max(place - BESIDE, 0) : place + BESIDE + 1]
    partners = [{image} for image in range(n)]
    for a, b in known:
        partners[a].add(b)
        partners[b].add(a)
    in_time = {image for own in ordered for image in own}
    pairs = set()
    for image, row in likeness(of, np.arange(n)):
        ranks = RANKS if image in in_time else RANKS_ALONE
        taken = {b for a in partners[image] for b in beside[a]}
        for rank, other in enumerate(_new(row, taken, beside)):
            if rank in ranks:
                pairs.add(_pair(image, other))
            if rank >= ranks[-1]:
                break
    return pairs


def _new(row: NDArray[np.float32], taken: set[int], beside: list[list[int]]) -> Iterator[int]:
    """Images by their likeness (n,), without those taken and those beside one that came before."""
    for other in np.argsort(-row, kind="stable").tolist():
        if row[other] <= 0:
            return
        if other not in taken:
            taken.update(beside[other])
            yield other


def links(of: csr_array, pairs: set[Pair]) -> set[Pair]:
    """The pairs most alike between groups of images that no pair joins."""
    found: set[Pair] = set()
    while True:
        group = _groups(of.shape[0], pairs | found)
        new: set[Pair] = set()
        for number in np.argsort(np.bincount(group), kind="stable")[:-1]:
            new |= _links_of(of, np.flatnonzero(group == number), np.flatnonzero(group != number))
        if not new - found:
            return found
        found |= new


def _groups(n: int, pairs: set[Pair]) -> IntArray:
    a, b = np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2).T
    graph = csr_array((np.ones(len(a)), (a, b)), shape=(n, n))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _links_of(of: csr_array, inside: IntArray, outside: IntArray) -> set[Pair]:
    best = [
        (float(-row[k]), image, int(outside[k]))
        for image, row in likeness(of, inside, outside)
        for k in np.argsort(-row, kind="stable")[:LINKS]
        if row[k] > 0
    ]
    return {_pair(a, b) for _, a, b in sorted(best)[:LINKS]}


def _pair(a: int, b: int) -> Pair:
    return (a, b) if a < b else (b, a)

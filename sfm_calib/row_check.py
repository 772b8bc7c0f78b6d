"""Whether a rectified pair is one: the rows in which both cameras see the same points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np

from graphs.frames import FloatArray
from sfm_calib.images import Progress, read_image
from sfm_calib.resample import Pixels, Resampling, frames_of
from sfm_calib.sources import Source

MOST_PAIRS = 10  # a few thousand matches: the median is then known to a hundredth of a pixel
FRAMES_LOOKED_AT = 300  # of a video: frames cannot be sought exactly
MOST_FEATURES = 2000  # an image
RATIO = 0.7  # Lowe, IJCV 2004: of the distances to the nearest and the next descriptor
FEWEST_MATCHES = 30  # fewer say nothing
EDGE_PX = 9  # SIFT sees the border of what is black as texture


@dataclass(frozen=True)
class RowCheck:
    """Features matched between rectified images."""

    n_pairs: int  # of images
    n_matches: int
    median_px: float  # row (vertical pairs: column) in the first image less that in the second
    sigma_px: float  # robust
    negative: float  # share of the matches whose disparity is negative: behind the cameras

    @property
    def is_enough(self) -> bool:
        return self.n_matches >= FEWEST_MATCHES


def check_rows(
    pair: Sequence[Source], by: Sequence[Resampling], is_vertical: bool, progress: Progress
) -> RowCheck:
    """Match SIFT features of up to MOST_PAIRS pairs of images, given before rectification."""
    masks = [mask_of(one) for one in by]
    found: list[FloatArray] = []
    n_pairs = 0
    for n_pairs, images in enumerate(spread_pairs(pair), 1):
        progress("checking rows", n_pairs, MOST_PAIRS)
        grays = [gray(one(image)) for one, image in zip(by, images, strict=True)]
        found.append(matches(grays, masks))
    moved = np.concatenate([*found, np.zeros((0, 2))])
    disparity, off = (moved[:, ::-1] if is_vertical else moved).T
    if not len(off):
        return RowCheck(n_pairs, 0, 0.0, 0.0, 0.0)
    median = float(np.median(off))
    sigma = float(1.4826 * np.median(np.abs(off - median)))
    return RowCheck(n_pairs, len(off), median, sigma, float((disparity < 0).mean()))


def spread_pairs(pair: Sequence[Source]) -> Iterator[tuple[Pixels, Pixels]]:
    """Pairs of one stem, or of one frame number of videos, spread over all there are."""
    if any(source.is_video for source in pair):
        if all(source.is_video for source in pair):
            both = zip(*(frames_of(source.paths[0]) for source in pair), strict=False)
            yield from islice(both, 0, FRAMES_LOOKED_AT, FRAMES_LOOKED_AT // MOST_PAIRS)
        return
    second = {path.stem: path for path in pair[1].paths}
    common = [(path, second[path.stem]) for path in pair[0].paths if path.stem in second]
    picked = np.unique(np.linspace(0, len(common) - 1, min(MOST_PAIRS, len(common))).round())
    for index in picked.astype(int):
        images = [read_image(path, cv2.IMREAD_UNCHANGED) for path in common[index]]
        if images[0] is not None and images[1] is not None:
            yield images[0], images[1]


def mask_of(by: Resampling) -> Pixels:
    """Where a resampled image has something to see around a pixel."""
    seen = cv2.resize(255 * (~by.unseen).astype(np.uint8), by.size, interpolation=cv2.INTER_AREA)
    padded = cv2.erode(seen, np.ones((EDGE_PX, EDGE_PX), np.uint8))
    return np.where(padded == 255, 255, 0).astype(np.uint8)


def gray(image: Pixels) -> Pixels:
    """An image of any depth and channels in 8-bit grey levels."""
    if image.ndim == 3:
        image = image[..., :3].mean(axis=-1)
    if image.dtype != np.uint8:
        image = cv2.normalize(image.astype(np.float32), None, 0, 255, cv2.NORM_MINMAX)
    return np.asarray(image).round().astype(np.uint8)


def matches(grays: Sequence[Pixels], masks: Sequence[Pixels]) -> FloatArray:
    """x and y (n, 2) in the first image less those in the second, of features alike in both."""
    sift = cv2.SIFT.create(nfeatures=MOST_FEATURES)
    found = [sift.detectAndCompute(g, mask) for g, mask in zip(grays, masks, strict=True)]
    if min(len(keypoints) for keypoints, _ in found) < 2:
        return np.zeros((0, 2))
    points = [np.array([k.pt for k in keypoints]) for keypoints, _ in found]
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    nearest = [
        matcher.knnMatch(found[i][1], found[1 - i][1], k=2)
        for i in (0, 1)
    ]  # fmt: skip
    best = [
        {m.queryIdx: m.trainIdx for m, n in pairs if m.distance < RATIO * n.distance}
        for pairs in nearest
    ]
    mutual = np.array([(q, t) for q, t in best[0].items() if best[1].get(t) == q], dtype=int)
    mutual = mutual.reshape(-1, 2)
    return np.asarray(points[0][mutual[:, 0]] - points[1][mutual[:, 1]], dtype=np.float64)

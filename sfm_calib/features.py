"""SIFT features by OpenCV: a fifth of the time that COLMAP takes for them on a CPU.

COLMAP describes every feature of the doubled image, and then leaves most of them out.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import IntArray
from graphs.threads import threads
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan

FILE = "features.npz"
CONTRAST = 0.02  # COLMAP's; OpenCV's own, 0.04, finds half as many
LEVELS_AN_OCTAVE = 3  # of scale, kept or left out whole, as COLMAP does
BYTES_A_ROOT = 512.0  # COLMAP's scale of RootSIFT in a byte


@dataclass(frozen=True)
class Features:
    """Features of one image, the largest first."""

    pixels: FloatArray  # (n, 2)
    scales: FloatArray  # (n,) px, sigma of the blob
    descriptors: NDArray[np.uint8]  # (n, 128) RootSIFT

    def __len__(self) -> int:
        return len(self.pixels)

    def largest(self, count: int) -> Features:
        """The first `count` of them."""
        return Features(self.pixels[:count], self.scales[:count], self.descriptors[:count])

    def spots(self) -> IntArray:
        """The first feature (n,) at the same pixel: a blob of two orientations is two features."""
        _, first, inverse = np.unique(
            self.pixels, axis=0, return_index=True, return_inverse=True
        )  # `first` is the earliest of each
        return first[inverse.ravel()].astype(np.int64)


def extract(
    scan: Scan, max_features: int, image_scale: float, place: Path, progress: Progress
) -> None:
    """Find the features of every image and keep them in `place`."""
    cv2.setNumThreads(1)  # images are shared out, not rows
    found = []
    with threads() as pool:
        paths = [scan.root / image.path for image in scan.images]
        for one in pool.map(lambda path: features_of(path, max_features, image_scale), paths):
            found.append(one)
            progress("extracting features", len(found), len(paths))
    save(found, place)


def features_of(path: Path, max_features: int, image_scale: float = 1.0) -> Features:
    """The largest features of one image file, found at this share of its size.

    Raises CalibrationError where it cannot be read.
    """
    image = cv2.imread(os.fspath(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise CalibrationError(f"{path.name} cannot be read: convert it to PNG or JPEG")
    height, width = image.shape
    if image_scale < 1:
        reduced = round(image_scale * width), round(image_scale * height)
        image = cv2.resize(image, reduced, interpolation=cv2.INTER_AREA)
    # Without the precise upscale every feature is a quarter of a pixel off.
    sift = cv2.SIFT_create(contrastThreshold=CONTRAST, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(image, None)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
    enlarged = np.array([width, height]) / (image.shape[1], image.shape[0])
    sizes = enlarged.mean() * np.array([keypoint.size for keypoint in keypoints])
    largest = np.argsort(-sizes, kind="stable")[: _whole_levels(sizes, max_features)]
    pixels = enlarged * (cv2.KeyPoint.convert(keypoints).astype(np.float64) + 0.5) - 0.5
    return Features(pixels[largest], sizes[largest] / 2, _rooted(descriptors[largest]))


def _whole_levels(sizes: FloatArray, max_features: int) -> int:
    """How many of the largest features there are in the levels that the `max_features`th ends."""
    if len(sizes) <= max_features:
        return len(sizes)
    level = np.round(LEVELS_AN_OCTAVE * np.log2(sizes))
    return int((level >= np.sort(level)[-max_features]).sum())


def _rooted(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    shares = descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    return np.minimum(np.sqrt(shares) * BYTES_A_ROOT, 255).round().astype(np.uint8)


def save(features: Sequence[Features], place: Path) -> None:
    """Write the features of all images into a folder."""
    np.savez(
        place / FILE,
        counts=np.array([len(one) for one in features]),
        pixels=np.concatenate([one.pixels for one in features]),
        scales=np.concatenate([one.scales for one in features]),
        descriptors=np.concatenate([one.descriptors for one in features]),
    )


def load(place: Path) -> list[Features]:
    """The features that `save` wrote."""
    with np.load(place / FILE) as file:
        return list(_split(*(file[k] for k in ("counts", "pixels", "scales", "descriptors"))))


def _split(
    counts: IntArray, pixels: FloatArray, scales: FloatArray, descriptors: NDArray[np.uint8]
) -> Iterator[Features]:
    ends = np.cumsum(counts)
    for begin, end in zip(ends - counts, ends, strict=True):
        yield Features(pixels[begin:end], scales[begin:end], descriptors[begin:end])

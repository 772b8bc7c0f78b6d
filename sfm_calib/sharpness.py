"""How sharp and how well exposed every image of a scan is, judged by its pixels alone.

The width of the sharpest edges is taken from how much one more blur weakens their gradients
(Zhuo and Sim, Defocus map estimation from a single image, Pattern Recognition 2011): an edge of
Gaussian width s, blurred by b, keeps s / sqrt(s^2 + b^2) of its slope. Across and down are measured
apart, and the wider counts: a moving camera blurs along one direction only.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.coverage import GRID
from sfm_calib.images import Progress, Scan, ScanImage

GrayImage = NDArray[np.uint8]
FloatImage = NDArray[np.float32]

PIXELS = 1_000_000  # an image is reduced to about so many: what counts is blur beside its size
FIRST_PX, SECOND_PX = 0.7, 1.6  # sigmas of the two blurs; the first quietens the sensor
# Of the gradients across an image, those of edges; below lies the grain of the sensor.
EDGE_QUANTILE = 0.98
LEAST_SLOPE = 4.0  # grey levels per px: flat images have no edges
SHARPEST = 0.25  # quantile of the widths: shadows and things out of focus are wide in any image
FEWEST_EDGES = 50
WIDEST_RATIO = 0.99  # of slopes: an edge of 12 px; wider ones are not told apart
BLACK, WHITE = 5, 250  # grey levels from which on nothing can be told apart
LIT = 16  # grey levels, the mean of a cell that the lens throws light on


@dataclass(frozen=True)
class ImageQuality:
    """What one image's pixels say of it."""

    image: ScanImage
    edge_px: float  # sigma of its sharpest edges at about 1 MP; NaN without edges
    detail: float  # variance of the Laplacian, in grey levels
    black: float  # share of the pixels
    white: float
    brightness: NDArray[np.float64]  # (GRID, GRID) mean grey level of each cell, rows first


def measure_images(scan: Scan, progress: Progress) -> tuple[ImageQuality, ...]:
    """The quality of every image of a scan, in its order."""
    found = []
    with ThreadPoolExecutor(max_workers=2) as pool:
        for quality in pool.map(lambda image: _measure(scan, image), scan.images):
            found.append(quality)
            progress("looking at sharpness", len(found), len(scan.images))
    return tuple(found)


def _measure(scan: Scan, image: ScanImage) -> ImageQuality:
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    data = np.fromfile(scan.root / image.path, np.uint8)
    return quality_of(image, cv2.imdecode(data, flags))


def quality_of(image: ScanImage, pixels: GrayImage) -> ImageQuality:
    """The quality of an image, given its grey levels (height, width)."""
    shrink = np.sqrt(PIXELS / pixels.size)
    small = pixels
    if shrink < 1:
        small = cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    cells = cv2.resize(small, (GRID, GRID), interpolation=cv2.INTER_AREA)
    return ImageQuality(
        image,
        edge_width_px(small),
        float(cv2.Laplacian(small, cv2.CV_64F).var()),
        float((small <= BLACK).mean()),
        float((small >= WHITE).mean()),
        np.asarray(cells, dtype=np.float64),
    )


def edge_width_px(pixels: GrayImage) -> float:
    """Gaussian sigma in px of the sharpest edges of an image (height, width), the wider of across
    and down; NaN where it has too few."""
    once, twice = (
        cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), sigma)
        for sigma in (FIRST_PX, SECOND_PX)
    )
    widths = [_edge_width(once, twice, axis) for axis in (0, 1)]
    return max((width for width in widths if np.isfinite(width)), default=float("nan"))


def _edge_width(once: FloatImage, twice: FloatImage, axis: int) -> float:
    """Sigma in px of the edges that run across one axis."""
    slope = np.abs(_central_difference(once, axis))
    along = np.abs(_central_difference(once, 1 - axis))
    least = max(float(np.quantile(slope, EDGE_QUANTILE)), LEAST_SLOPE)
    edge = (slope >= least) & (slope > 2 * along) & _is_ridge(slope, axis)
    if np.count_nonzero(edge) < FEWEST_EDGES:
        return float("nan")
    kept = np.abs(_central_difference(twice, axis))[edge] / slope[edge]
    ratio = min(float(np.quantile(kept, SHARPEST)), WIDEST_RATIO)
    squared = (ratio**2 * SECOND_PX**2 - FIRST_PX**2) / (1 - ratio**2)
    return float(np.sqrt(max(squared, 0.0)))


def _central_difference(image: FloatImage, axis: int) -> FloatImage:
    kernel = np.array([-0.5, 0.0, 0.5], np.float32)
    shape = (1, 3) if axis == 1 else (3, 1)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel.reshape(shape)), dtype=np.float32)


def _is_ridge(slope: FloatImage, axis: int) -> NDArray[np.bool_]:
    """Where the slope is greatest along the axis: the middle of an edge."""
    shape = (1, 3) if axis == 1 else (3, 1)
    highest = cv2.dilate(slope, np.ones(shape, np.uint8))
    return np.asarray(slope >= highest, dtype=np.bool_)


def lit_cells(quality: Iterable[ImageQuality], camera: int) -> NDArray[np.bool_]:
    """Cells (GRID, GRID) of a camera's image that are ever lit; a fisheye's corners are not."""
    own = [each.brightness for each in quality if each.image.camera == camera]
    return np.asarray(np.max(own, axis=0) > LIT) if own else np.ones((GRID, GRID), dtype=bool)


def dark_share(quality: ImageQuality, own: Iterable[ImageQuality]) -> float:
    """Share of the pixels that the lens lights which are black in one image of a camera's `own`."""
    lit = float(lit_cells(own, quality.image.camera).mean())
    return max(quality.black - (1 - lit), 0.0) / lit if lit > 0 else 1.0

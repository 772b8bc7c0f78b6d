"""kornia's networks, each as a map of where features are and what describes them there.

A network's own keypoints are whole pixels (XFeat, DISK) or a soft maximum that leans towards one
(ALIKED). Here a feature is the maximum of a parabola through the network's map, in logarithms.
How far apart photographs (two of fountain, 768 px wide) and themselves, turned by 8 degrees, put
the same feature, in px of one coordinate of one image, robust; and made smaller to 0.8:

    SIFT 0.03, 0.04; ALIKED 0.08, 0.19 (kornia's keypoints 0.17, 0.25); XFeat 0.12, 0.19 (0.45,
    0.51); DISK 0.15, 0.20 (0.35, 0.42)

Pixels: all three maps are as large as the image and of its grid (a cell of XFeat's is 8 x 8 pixels,
row by row), so pixel i of the map is pixel i of the image, centre on centre; no half pixel is to be
added. But a network may lean to one side, by what it was trained on, and a lean of all features is
an error of the principal point, as large. It shows in a photograph against itself turned or scaled
by a known warp: R the warp's linear part and b the lean, features differ from where the warp puts
them by (1 - R) b. The mean b in px of the network's image (six photographs by five cameras; turned
by 8 and -20 degrees; scaled by 0.67, 0.8 and 1.25):

    SIFT, which tests the test     turned (0.00, 0.01)     scaled (-0.01, 0.00)
    ALIKED, n16rot                        (0.31, 0.33)             (0.13, 0.26)
    DISK                                  (0.33, 0.14)             (0.42, 0.46)
    XFeat                                 (0.49, -1.50)            (-0.50, -0.23)

What undoes that is half a turn: in an image turned by it the lean is the opposite one, and the mean
of both maps has its maxima between. Of ALIKED, which finds most of its features again, (0.01, 0.00)
and (-0.08, 0.08) are left, and it scatters less. DISK does not, and loses three features in four:
the mean of its lean is taken off instead, of which it keeps 0.2 px (rms) of either sign. XFeat's
depends on what is done to the image, and is left in: least-squares matching has to take it away.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm_calib.errors import CalibrationError
from sfm_calib.learned.weights import FEATURES, FeatureName, load_into, read_weights
from sfm_calib.torch_import import Device, import_kornia, import_torch

PURPOSE = "learned features"
STRIDE = 32  # of pixels: every network's maps then are as large as the image
WINDOW = 5  # pixels, in which a feature is the only maximum: kornia's
TINY = 1e-9  # likelihoods above have a logarithm
CELL = 8  # pixels, XFeat's
CELL_STEP = 2
UNLIKELY = 1e-4  # in a cell: what is below counts as this
FEWEST_TO_JUDGE = 50  # features of one image, to say whether a half turn keeps them
# Of them: on nine images of five cameras ALIKED's n16rot keeps 0.81 to 1.19, its n16 0.02 to 0.18.
LEFT_OF_TURNED = 0.4
DISK_LEAN_PX = (0.38, 0.30)  # the mean of all that is said above


@dataclass(frozen=True)
class Maps:
    """What a network says of an image of (h, w) px."""

    peaks: Any  # (h, w) tensor, a logarithm: features are its maxima
    strength: Any  # (h, w) tensor: the strongest features are kept
    describe: Callable[[Any], Any]  # of pixels (n, 2), unit descriptors (n, d)


@dataclass(frozen=True)
class Detector:
    """A network with its weights."""

    maps: Callable[[Any], Maps]  # of an image (1, 3, h, w) in [0, 1], sides multiples of STRIDE
    threshold: float  # of peaks: what is below is no feature
    both_ways: bool  # look at every image turned by half a turn too
    width: int  # of descriptors
    path: Path  # of its weights
    lean_px: tuple[float, float] = (0.0, 0.0)  # right and down: its peaks are so far off


def build_detector(name: FeatureName, path: Path, device: Device) -> Detector:
    """The network of these features with the weights in `path`.

    Raises CalibrationError where torch, the device or the weights are missing or do not fit.
    """
    torch = import_torch(PURPOSE, device)
    make = {"xfeat": _xfeat, "aliked": _aliked, "disk": _disk}[name]
    with torch.inference_mode():
        return make(path, device)


def _xfeat(path: Path, device: Device) -> Detector:
    torch, features = import_torch(PURPOSE), import_kornia("feature", PURPOSE)
    functional = torch.nn.functional
    network = features.XFeat()
    load_into(network.net, read_weights(path), FEATURES["xfeat"].network, path)
    network = network.eval().to(device)

    def maps(image: Any) -> Maps:
        size = image.shape[2:]
        descriptors, _, reliable = network.net(image)
        peaks = _without_cells(network.net, image)
        reliable = functional.interpolate(reliable, size=size, mode="bilinear", align_corners=False)
        normed = functional.normalize(descriptors, dim=1)

        def describe(pixels: Any) -> Any:
            sampled = network.interpolator(normed, pixels[None], H=size[0], W=size[1])
            return functional.normalize(sampled[0], dim=-1)

        return Maps(peaks, peaks + (reliable[0, 0] + TINY).log(), describe)

    return Detector(maps, math.log(network.detection_threshold), False, 64, path)


def _without_cells(network: Any, image: Any) -> Any:
    """XFeat's map (h, w), the mean over cells that begin at every second pixel.

    It looks for a feature in a cell of 8 x 8 pixels at a time, of which it sees nothing but these
    64: where its cells happen to begin moves the features by half a pixel.
    """
    torch = import_torch(PURPOSE)
    functional = torch.nn.functional
    height, width = image.shape[2:]
    normed = network.norm(image.mean(1, keepdim=True))
    beyond = functional.pad(normed, (CELL, CELL, CELL, CELL), mode="replicate")
    total = normed.new_zeros((height, width))
    shifts = range(0, CELL, CELL_STEP)
    for down, right in itertools.product(shifts, shifts):
        part = beyond[..., down : down + height + CELL, right : right + width + CELL]
        logits = network.keypoint_head(functional.pixel_unshuffle(part, CELL))
        # 64 pixels of a cell and one more for "none": kornia's Convention of XFeatModel.
        likely = functional.pixel_shuffle(logits.softmax(1)[:, : CELL**2], CELL)[0, 0]
        top, left = CELL - down, CELL - right
        total += (likely[top : top + height, left : left + width] + UNLIKELY).log()
    return total / len(shifts) ** 2


def _aliked(path: Path, device: Device) -> Detector:
    torch, features = import_torch(PURPOSE), import_kornia("feature", PURPOSE)
    network = features.ALIKED("aliked-n16rot")
    load_into(network, read_weights(path), FEATURES["aliked"].network, path, ("dkd.hw_grid",))
    network = network.to(device)

    def maps(image: Any) -> Maps:
        dense, likely = network.extract_dense_map(image)
        peaks = torch.logit(likely[0, 0], eps=TINY)
        last = torch.tensor([image.shape[3] - 1, image.shape[2] - 1], device=image.device)

        def describe(pixels: Any) -> Any:
            return network.desc_head(dense, [2 * pixels / last - 1])[0][0]

        return Maps(peaks, peaks, describe)

    threshold = network.detection_threshold
    return Detector(maps, math.log(threshold / (1 - threshold)), True, 128, path)


def _disk(path: Path, device: Device) -> Detector:
    torch, features = import_torch(PURPOSE), import_kornia("feature", PURPOSE)
    network = features.DISK()
    weights = read_weights(path)
    load_into(network, weights.get("extractor", weights), FEATURES["disk"].network, path)
    network = network.to(device)

    def maps(image: Any) -> Maps:
        heat, dense = network.heatmap_and_dense_descriptors(image)

        def describe(pixels: Any) -> Any:
            x, y = pixels.round().long().T
            return torch.nn.functional.normalize(dense[0][:, y, x].T, dim=-1)

        return Maps(heat[0, 0], heat[0, 0], describe)

    return Detector(maps, 0.0, False, 128, path, DISK_LEAN_PX)


def detect(detector: Detector, image: Any, most: int) -> tuple[Any, Any]:
    """Pixels (n, 2) of the features of an image (3, h, w) in [0, 1], and descriptors (n, d).

    The strongest come first. Raises CalibrationError where weights see nothing again in an image
    that is turned, and it takes both.
    """
    torch = import_torch(PURPOSE)
    height, width = image.shape[1:]
    beyond = (0, -width % STRIDE, 0, -height % STRIDE)  # at the right and below: nothing moves
    with torch.inference_mode():
        padded = torch.nn.functional.pad(image[None], beyond, mode="replicate")
        # The turned image first: its descriptors, a GB, are gone when the upright ones come.
        turned = detector.maps(padded.flip(2, 3)).peaks if detector.both_ways else None
        maps = detector.maps(padded)
        if turned is not None:
            maps = _both_ways(detector, maps, turned.flip(0, 1))
        whole = _maxima(maps.peaks, detector.threshold)
        whole = whole[(whole[:, 0] < width) & (whole[:, 1] < height)]
        x, y = whole.T
        order = maps.strength[y, x].argsort(descending=True, stable=True)[:most]
        pixels = refined(maps.peaks, whole[order])
        if len(pixels) == 0:
            return pixels, pixels.new_zeros((0, detector.width))
        return pixels - pixels.new_tensor(detector.lean_px), maps.describe(pixels)


def _both_ways(detector: Detector, upright: Maps, turned: Any) -> Maps:
    """Maps with peaks that are the mean of both: the upright image's, and the turned one's."""
    mean = (upright.peaks + turned) / 2
    before, after = (len(_maxima(peaks, detector.threshold)) for peaks in (upright.peaks, mean))
    if before >= FEWEST_TO_JUDGE and after < LEFT_OF_TURNED * before:
        raise CalibrationError(
            f"{detector.path}: of {before} features of an image only {after} are left when it is "
            "seen upside down too; give weights that were trained on turned images, as "
            "aliked-n16rot.pth"
        )
    return Maps(mean, mean, upright.describe)


def _maxima(peaks: Any, threshold: float) -> Any:
    """Whole pixels (n, 2) of the maxima of a map (h, w) above a threshold, row by row."""
    torch = import_torch(PURPOSE)
    nms2d = import_kornia("geometry.subpix", PURPOSE).nms2d
    there = nms2d(peaks[None, None], (WINDOW, WINDOW), mask_only=True)[0, 0] & (peaks > threshold)
    return torch.nonzero(there).flip(1)


def refined(peaks: Any, whole: Any) -> Any:
    """Where in pixels (n, 2) a map (h, w) has its maxima that are at whole pixels (n, 2).

    Of the parabola through nine pixels; where that has no maximum within one pixel, the whole one.
    """
    torch = import_torch(PURPOSE)
    x, y = whole.T

    def at(right: int, down: int) -> Any:
        return peaks[y + down, x + right]

    centre = at(0, 0)
    gx, gy = (at(1, 0) - at(-1, 0)) / 2, (at(0, 1) - at(0, -1)) / 2
    xx, yy = at(1, 0) + at(-1, 0) - 2 * centre, at(0, 1) + at(0, -1) - 2 * centre
    xy = (at(1, 1) + at(-1, -1) - at(1, -1) - at(-1, 1)) / 4
    det = xx * yy - xy**2
    offset = torch.stack([xy * gy - yy * gx, xy * gx - xx * gy], 1) / det[:, None]
    fits = (det > 0) & (offset.abs() <= 1).all(1)  # of a strict maximum xx is negative
    return whole + torch.where(fits[:, None], offset, torch.zeros_like(offset))

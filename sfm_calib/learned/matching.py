"""Matches between learned features: nearest descriptors, or LightGlue."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from graphs.problem import IntArray
from sfm_calib.images import Progress, Scan
from sfm_calib.learned.choice import Learned
from sfm_calib.learned.extract import LearnedFeatures, load
from sfm_calib.learned.networks import PURPOSE
from sfm_calib.learned.weights import MATCHERS, FeatureName, load_into, read_weights
from sfm_calib.pairs import Pair
from sfm_calib.torch_import import Device, import_kornia, import_torch

Matcher = Callable[[LearnedFeatures, LearnedFeatures, tuple[int, int], tuple[int, int]], IntArray]

# Of the distances to the nearest descriptor and the next. Two images of different scenes then have
# 0 to 9 matches, all of one epipolar geometry by chance, where COLMAP asks for 15; without a limit
# 21 (DISK) to 59 (XFeat). Of the right ones 0.72 to 0.97 are left, in hard pairs 0.3 to 0.7.
MAX_RATIO = 0.9
ROWS_AT_ONCE = 2048  # of the table of all distances: 64 MB beside 8192 features
# LightGlue's time grows with the square: a pair of 2048 of ALIKED takes 4 s on two cores, of 4096
# 10 s; the nearest of 8192 0.3 s.
LIGHTGLUE_FEATURES = 2048
IMAGES_IN_MEMORY = 64  # pairs come sorted: one side stays, the other walks


def match(
    scan: Scan,
    pairs: Sequence[Pair],
    learned: Learned,
    features: Path,
    write: Callable[[str, str, IntArray], None],
    progress: Progress,
) -> None:
    """Match pairs of images whose features are kept in `features`.

    `write(path, path, matches)` is told the indices (n, 2) of features that match. Raises
    CalibrationError where weights or device are not there.
    """
    if learned.lightglue is None:
        matcher = nearest_matcher(learned.device)
    else:
        matcher = lightglue_matcher(learned.name, learned.lightglue, learned.device)
    read = functools.lru_cache(IMAGES_IN_MEMORY)(lambda index: load(features, index))
    for done, (a, b) in enumerate(pairs, 1):
        first, second = scan.images[a], scan.images[b]
        sizes = scan.sizes[first.camera], scan.sizes[second.camera]
        found = matcher(read(a), read(b), *sizes)
        write(first.path, second.path, found)
        progress("matching", done, len(pairs))


def nearest_matcher(device: Device) -> Matcher:
    """Features that are each other's nearest, and clearly so: a `Matcher`."""
    torch = import_torch(PURPOSE, device)

    def matcher(
        a: LearnedFeatures, b: LearnedFeatures, size_a: tuple[int, int], size_b: tuple[int, int]
    ) -> IntArray:
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), np.int64)
        with torch.inference_mode():
            first, second = (torch.from_numpy(f.descriptors).to(device) for f in (a, b))
            rows, there = _clear_and_mutual(torch, first, second)
            return torch.stack([rows, there], 1).cpu().numpy().astype(np.int64)

    return matcher


def _clear_and_mutual(torch: Any, a: Any, b: Any) -> tuple[Any, Any]:
    """Rows of unit vectors a (n, d) and b (m, d) that are each other's nearest, and clearly so."""
    best, there = [], []
    best_of_b = a.new_full((len(b),), -math.inf)
    for rows in a.split(ROWS_AT_ONCE):
        likeness = rows @ b.T
        two = likeness.topk(2, dim=1)
        best.append(two.values)
        there.append(two.indices[:, 0])
        best_of_b = torch.maximum(best_of_b, likeness.amax(0))
    nearest, index = torch.cat(best), torch.cat(there)
    apart = (2 - 2 * nearest).clamp(min=0)  # squared
    clear = apart[:, 0] <= MAX_RATIO**2 * apart[:, 1]
    kept = torch.nonzero(clear & (nearest[:, 0] == best_of_b[index]))[:, 0]
    return kept, index[kept]


def lightglue_matcher(name: FeatureName, path: Path, device: Device) -> Matcher:
    """LightGlue for these features, with the weights in `path`: a `Matcher`.

    Raises CalibrationError where torch, the device or the weights are missing or do not fit.
    """
    torch = import_torch(PURPOSE, device)
    network = build_lightglue(name, path).to(device)

    def matcher(
        a: LearnedFeatures, b: LearnedFeatures, size_a: tuple[int, int], size_b: tuple[int, int]
    ) -> IntArray:
        if not (len(a) and len(b)):
            return np.zeros((0, 2), np.int64)
        data = {}
        for side, (found, size) in enumerate(((a, size_a), (b, size_b))):
            few = found.strongest(LIGHTGLUE_FEATURES)
            data[f"image{side}"] = {
                "keypoints": torch.from_numpy(few.pixels).float().to(device)[None],
                "descriptors": torch.from_numpy(few.descriptors).to(device)[None],
                "image_size": torch.tensor([size], device=device),
            }
        with torch.inference_mode():
            return network(data)["matches"][0].cpu().numpy().astype(np.int64)

    return matcher


def build_lightglue(name: FeatureName, path: Path) -> Any:
    """kornia's network with the weights in `path`, whichever of their two ways they are named."""
    import_torch(PURPOSE)
    lightglue = import_kornia("feature", PURPOSE).LightGlue
    shape = {k: v for k, v in lightglue.features[name].items() if k != "weights"}
    network = lightglue(None, **shape)
    weights = {}
    for key, tensor in read_weights(path).items():
        block, _, rest = key.removeprefix("matcher.").partition(".")
        number, _, inner = rest.partition(".")
        if block in ("self_attn", "cross_attn"):  # of its authors; kornia has them by layer
            weights[f"transformers.{number}.{block}.{inner}"] = tensor
        else:
            weights[key.removeprefix("matcher.")] = tensor
    layers = tuple(f"log_assignment.{i}.r" for i in range(shape.get("n_layers", 9)))
    unused = ("extractor.", *layers)  # XFeat's own, and what DISK's was trained with
    what = MATCHERS[name].network
    load_into(network, weights, what, path, ("confidence_thresholds",), unused)
    return network

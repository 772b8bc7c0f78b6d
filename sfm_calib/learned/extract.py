"""Features that a network finds in the images of a scan."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan, read_image
from sfm_calib.learned.choice import Learned
from sfm_calib.learned.networks import PURPOSE, Detector, build_detector, detect
from sfm_calib.learned.weights import FeatureName
from sfm_calib.torch_import import Device, import_torch

FOLDER = "learned"  # beside the database: COLMAP's own descriptors are bytes
# Larger images are shrunk. Of six photographs of fountain (3072 px wide) noise is 0.32 px with
# 1024 px and 0.23 px with 1600 px (ALIKED), 0.40 and 0.26 px (DISK); SIFT's at full size 0.20 px.
# 1600 px take 17, 17 and 4 s of one core an image (ALIKED, DISK, XFeat) and 3.3, 4.2 and 0.7 GB.
LONGEST_SIDE_PX: dict[FeatureName, int] = {"xfeat": 1600, "aliked": 1600, "disk": 1600}


@dataclass(frozen=True)
class LearnedFeatures:
    """Features of one image, the strongest first."""

    pixels: FloatArray  # (n, 2)
    descriptors: NDArray[np.float32]  # (n, d) unit vectors

    def __len__(self) -> int:
        return len(self.pixels)

    def strongest(self, count: int) -> LearnedFeatures:
        """The first `count` of them."""
        return LearnedFeatures(self.pixels[:count], self.descriptors[:count])


def extract(
    scan: Scan,
    learned: Learned,
    max_features: int,
    image_scale: float,
    place: Path,
    write: Callable[[str, FloatArray], None],
    progress: Progress,
) -> None:
    """Find the features of every image, at this share of its size, and keep them in `place`.

    `write(path, pixels)` is told where they are in each. Raises CalibrationError where weights or
    device are not there, or an image cannot be read.
    """
    detector = build_detector(learned.name, learned.weights, learned.device)
    (place / FOLDER).mkdir()
    for index, image in enumerate(scan.images):
        rgb = read_rgb(scan.root / image.path)
        longest = round(image_scale * min(LONGEST_SIDE_PX[learned.name], max(rgb.shape)))
        found = features_of(rgb, detector, longest, learned.device, max_features)
        save(found, place, index)
        write(image.path, found.pixels)
        progress("extracting features", index + 1, len(scan.images))


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """An image (h, w, 3) as it is stored. Raises CalibrationError where it cannot be read."""
    image = read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise CalibrationError(f"{path.name} cannot be read: convert it to PNG or JPEG")
    return np.ascontiguousarray(image[..., ::-1])


def features_of(
    image: NDArray[np.uint8], detector: Detector, longest_px: int, device: Device, most: int
) -> LearnedFeatures:
    """The strongest features of an image (h, w, 3), seen with its longest side at most so long."""
    torch = import_torch(PURPOSE)
    seen = shrunk(image, longest_px)
    tensor = torch.from_numpy(seen).to(device).permute(2, 0, 1).float() / 255
    pixels, descriptors = detect(detector, tensor, most)
    return LearnedFeatures(
        in_full(pixels.double().cpu().numpy(), seen, image),
        descriptors.float().cpu().numpy(),
    )


def shrunk(image: NDArray[np.uint8], longest_px: int) -> NDArray[np.uint8]:
    """An image with its longest side at most so long, every pixel the mean of what it covers."""
    height, width = image.shape[:2]
    factor = longest_px / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def in_full(pixels: FloatArray, seen: NDArray[Any], image: NDArray[Any]) -> FloatArray:
    """Pixels (n, 2) of a shrunken image in the image itself, whole numbers the centres in both.

    Corners fall on corners: the shrunken one's first pixel has its centre at half its own width.
    """
    scale = np.array(image.shape[1::-1]) / np.array(seen.shape[1::-1])
    result: FloatArray = (pixels + 0.5) * scale - 0.5
    return result


def save(features: LearnedFeatures, place: Path, index: int) -> None:
    """Keep the features of one image, of this index in the scan, in `place`."""
    np.savez(_file(place, index), pixels=features.pixels, descriptors=features.descriptors)


def load(place: Path, index: int) -> LearnedFeatures:
    """What `save` kept."""
    with np.load(_file(place, index)) as file:
        return LearnedFeatures(file["pixels"], file["descriptors"])


def _file(place: Path, index: int) -> Path:
    return place / FOLDER / f"{index:06d}.npz"

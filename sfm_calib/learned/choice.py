"""Which features are tracked and how they are matched; of torch and kornia nothing is imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256
from sfm_calib.learned.weights import FEATURES, FeatureName, find_features, find_matcher
from sfm_calib.torch_import import Device, check_torch, import_torch, torch_versions

VERSION = 1  # counted up where other features are found or matched: caches ask
# A pair's time of matching, for the nearest descriptors and for LightGlue, by that of SIFT's.
TIMES_NEAREST, TIMES_LIGHTGLUE = 3.0, 160.0


@dataclass(frozen=True)
class Learned:
    """Learned features: their network, its weights, and what matches them."""

    name: FeatureName
    weights: Path
    lightglue: Path | None  # its weights; None: the nearest descriptors match
    device: Device

    @property
    def network(self) -> str:
        """Its name in words."""
        return FEATURES[self.name].network

    @property
    def times_sift(self) -> float:
        """How many times as long as SIFT's a pair of images takes to be matched."""
        return TIMES_LIGHTGLUE if self.lightglue else TIMES_NEAREST

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of the weights, by their files' names."""
        files = (self.weights, self.lightglue)
        return {file.name: sha256(file) for file in files if file is not None}

    @property
    def features_from(self) -> list[object]:
        """All that makes the features besides the images, for the cache."""
        return [VERSION, self.name, sha256(self.weights), self.device, torch_versions()]

    @property
    def matches_from(self) -> list[object]:
        """All that makes their matches besides, for the cache."""
        return [sha256(self.lightglue) if self.lightglue else "nearest"]


def check_choice(config: RigConfig) -> None:
    """Raises CalibrationError for features and matchers that do not go together."""
    if config.features != "sift":
        check_torch(f"features {config.features}")
    elif config.matcher == "lightglue":
        raise CalibrationError(
            "matcher lightglue is for learned features, and features is sift: add --features "
            "aliked (or xfeat, disk), or leave the matcher out"
        )
    elif config.weights is not None:
        raise CalibrationError(
            f"weights {config.weights} is given, and features is sift, which needs none: add "
            "--features aliked (or xfeat, disk), or leave the weights out"
        )


def check_torch_of(config: RigConfig) -> None:
    """Raises CalibrationError where torch or its device is asked for in vain."""
    if config.refine:
        check_torch("--refine")
    if config.device == "cuda":
        if not config.refine and config.features == "sift":
            raise CalibrationError(
                "device cuda is where torch computes, and nothing asks for torch: add --refine or "
                "learned features, or leave the device out"
            )
        import_torch("device cuda", config.device)


def refuse_learned(config: RigConfig, command: str) -> None:
    """Raises CalibrationError for learned features: `command` knows SIFT's alone."""
    if config.features != "sift":
        raise CalibrationError(
            f"{command} tracks SIFT features alone, and features is {config.features}: say "
            "--features sift, or run calibrate and compare the two"
        )


def choose(config: RigConfig) -> Learned | None:
    """What a configuration asks for, with its weights; None: SIFT.

    Raises CalibrationError as `check_choice`, and where weights are nowhere.
    """
    check_choice(config)
    if config.features == "sift":
        return None
    name = config.features
    weights = find_features(name, config.weights)
    glue = find_matcher(name, config.weights) if config.matcher == "lightglue" else None
    return Learned(name, weights, glue, config.device)

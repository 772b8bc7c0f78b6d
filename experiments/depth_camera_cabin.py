"""By how much does calibration improve the 3-D model of a head, and can a scan replace the boards?

Method: a simulated cabin after a published study: three time-of-flight cameras (Kinect v2: infrared
512 x 424 with k1, k2, k3, colour 1920 x 1080), one before a head and two beside it, 0.5 to 0.9 m
off. A cabin a seed: its lenses differ as devices do, and its places are known by hand to 2 degrees
and 2 cm. It is calibrated in three ways. Boards: 30 views a device and 20 for each pair with the
front, of 36 mm squares. Scan: a papered box is turned and carried about for 60 frames, and its
features are tracked; lengths come from a tape between two devices, or from the places by hand.
Scan and one board: the same scan, no tape, and the board shown once to each pair. Each solve is the
library's own, from corners and tracks (not from rendered images). Then each device takes one depth
image of the head, with noise that grows with range and obliqueness; points come through the whole
lens, its distortion inverted, by factory or calibrated lenses; clouds are put together by places by
hand or calibrated, and perhaps registered with each other by ICP. The model is laid on the true
surface by ICP, and its distances to it are measured. Of single devices too: from the infrared
camera, and with depth registered to the colour camera, as drivers offer.
Left out: multi-path, flying pixels, the wave of depth errors, hair, motion, wrong corners.
Expectation: calibrated lenses and places make the model better by more than chance; places by hand
often fail to register; a scan with one board comes within 10 % of the boards' RMS.
Source: the study of the cabin as the project's plan quotes it: mean 3.02 to 2.18 mm and RMS 3.84 to
2.95 mm by intrinsic calibration; 2.36, 2.95 and at most 15.9 mm for the fused model; without
extrinsic calibration registration often fails. Noise: Fankhauser et al., ICAR 2015.
Run: sfm-calib run configs/studies/depth_camera_cabin.yaml -o out/depth_camera_cabin
"""

from __future__ import annotations

import time
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from experiments.cabin_answer import answer
from experiments.cabin_calibration import Calibrated, Scale, Shown, Way, calibrate_cabin
from experiments.cabin_model import Model, measured_model, taken
from experiments.runner.protocol import Cell, Row, Study, TrialOptions
from graphs.frames import FloatArray, angle_between
from sfm_calib.simulate.cabin import HEAD_M, Cabin, draw_cabin
from sfm_calib.simulate.carried import CarryOptions
from sfm_calib.simulate.rigs import SimulatedRig


class CabinOptions(TrialOptions):
    """One cabin, calibrated in one way, and one head that it takes."""

    way: Literal[Way, "none"] = "boards"
    """What it is calibrated by."""
    intrinsics: Literal["factory", "calibrated", "true"] = "calibrated"
    """Lenses that depth is made points with. With calibrated places, factory lenses are held while
    these are found."""
    extrinsics: Literal["hand", "calibrated", "true"] = "calibrated"
    """Places by which clouds are put together."""
    scale: Scale = "tape"
    """What gives a scan its lengths; none: the places by hand."""
    hand_deg: Annotated[float, Field(ge=0, le=30)] = 2.0
    """Rms of how far the side devices are turned from their places by hand."""
    hand_mm: Annotated[float, Field(ge=0, le=300)] = 20.0
    """And of how far they are shifted."""
    alone: Annotated[int, Field(ge=0, le=200)] = 30
    """Views of the board by each device, of way boards."""
    together: Annotated[int, Field(ge=1, le=200)] = 20
    """Views by each pair of devices, of way boards."""
    added: Annotated[int, Field(ge=1, le=50)] = 1
    """Views by each pair of devices, of way scan_board."""
    scan_frames: Annotated[int, Field(ge=10, le=400)] = 60
    """How often the box is seen in a scan."""
    features: Annotated[int, Field(ge=20, le=500)] = 60
    """Features of an image of the box, at most."""
    feature_px: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Noise of a feature."""
    depth_noise: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Noise of depth, times a Kinect's."""

    @model_validator(mode="after")
    def _calibrated_by_something(self) -> CabinOptions:
        if self.way == "none" and "calibrated" in (self.intrinsics, self.extrinsics):
            raise ValueError("way none calibrates nothing: give intrinsics and extrinsics of "
                             "factory, hand or true, or another way")  # fmt: skip
        if self.way == "boards" and self.intrinsics == "calibrated" and self.alone < 3:
            raise ValueError(f"{self.alone} views do not calibrate a device: give alone 3 or more")
        return self


# ---- one cabin -----------------------------------------------------------------------------


def trial(options: CabinOptions, seed: int) -> Row:
    """Calibrate a cabin, take a head with it, and measure the model.

    Raises CalibrationError where Open3D is missing or the cabin cannot be calibrated.
    """
    began = time.perf_counter()
    cabin = draw_cabin(
        np.random.default_rng([seed, 0]), options.hand_deg, 1e-3 * options.hand_mm
    )
    scene = taken(cabin, np.random.default_rng([seed, 1]), options.depth_noise)
    found = None
    if options.way != "none":
        found = calibrate_cabin(
            cabin, options.way, _shown(options), _carry(options), options.scale,
            options.intrinsics == "factory", np.random.default_rng([seed, 2]),
        )  # fmt: skip
    seconds = time.perf_counter() - began
    model = measured_model(scene, used(cabin, found, options))
    return {
        **of_calibration(cabin, found),
        **of_model(model),
        "seconds_calibration": seconds,
        "seconds_model": time.perf_counter() - began - seconds,
    }


def _shown(options: CabinOptions) -> Shown:
    if options.way == "scan_board":
        return Shown(0, options.added)
    return Shown(options.alone, options.together)


def _carry(options: CabinOptions) -> CarryOptions:
    return CarryOptions(
        frames=options.scan_frames,
        points=POINTS_A_FEATURE * options.features,
        max_points_per_image=options.features,
        sigma_px=options.feature_px,
    )


def used(cabin: Cabin, found: Calibrated | None, options: CabinOptions) -> SimulatedRig:
    """The rig that depth is made a model with."""
    rigs = {"factory": cabin.nominal, "hand": cabin.nominal, "true": cabin.true}
    if found is not None:
        rigs["calibrated"] = found.rig
    return SimulatedRig(
        rigs[options.intrinsics].cameras, rigs[options.extrinsics].cam_from_rig
    )

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

import numpy as np

from experiments.cabin_answer import answer
from experiments.cabin_calibration import CabinOptions, Calibrated, calibrate_cabin
from experiments.cabin_model import model_row, taken
from experiments.runner.protocol import Row, Study
from experiments.standard_errors import WITHIN_95, rms
from graphs.frames import angle_between
from sfm_calib.simulate.cabin import Cabin, draw_cabin
from sfm_calib.simulate.rigs import SimulatedRig


def trial(options: CabinOptions, seed: int) -> Row:
    """Calibrate a cabin, take a head with it, and measure the model.

    Raises CalibrationError where Open3D is missing or the cabin cannot be calibrated.
    """
    began = time.perf_counter()
    cabin = draw_cabin(np.random.default_rng([seed, 0]), options.hand_deg, options.hand_mm / 1e3)
    scene = taken(cabin, np.random.default_rng([seed, 1]), options.depth_noise)
    found = None
    if options.way != "none":
        found = calibrate_cabin(cabin, options, np.random.default_rng([seed, 2]))
    seconds = time.perf_counter() - began
    row = model_row(scene, used(cabin, found, options))
    return {
        **row,
        **({} if found is None else calibration_row(cabin, found)),
        "seconds_calibration": seconds,
        "seconds_model": time.perf_counter() - began - seconds,
    }


def used(cabin: Cabin, found: Calibrated | None, options: CabinOptions) -> SimulatedRig:
    """The rig by which depth becomes a model."""
    rigs = {"factory": cabin.nominal, "hand": cabin.nominal, "exact": cabin.true}
    if found is not None:
        rigs["calibrated"] = found.rig
    return SimulatedRig(rigs[options.intrinsics].cameras, rigs[options.extrinsics].cam_from_rig)


def calibration_row(cabin: Cabin, found: Calibrated) -> Row:
    """Errors of a calibration, rms over devices, and whether its sigmas hold."""
    true, rig = cabin.true, found.rig
    turn, shift = [], []
    for side in cabin.infrared[1:]:
        here, there = rig.cam_from_rig[side], true.cam_from_rig[side]
        turn.append(np.degrees(angle_between(here.rotation, there.rotation)))
        shift.append(here.inverse.translation - there.inverse.translation)
    row: dict[str, float | int] = {
        "turn_deg": rms(turn),
        "shift_mm": 1e3 * rms(np.linalg.norm(shift, axis=1)),
        "nees": found.nees,
        "covered": float(np.mean(np.abs(found.z) < WITHIN_95)),
        "parameters": len(found.names),
    }
    for kind, cameras in (("infrared", cabin.infrared), ("colour", cabin.colour)):
        off = np.array([rig.cameras[i].params[:4] - true.cameras[i].params[:4] for i in cameras])
        row[f"{kind}_focal_px"] = rms(off[:, 0])
        row[f"{kind}_centre_px"] = rms(np.linalg.norm(off[:, 2:], axis=1))
    return row


STUDY = Study(CabinOptions, trial, answer)

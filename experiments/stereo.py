"""A simulated stereo rig, a calibration of it from a scan, and points to measure with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.coverage import measured_prior
from graphs.build import GraphOptions
from graphs.camera import Camera, project, unproject
from graphs.compare import Stated
from graphs.frames import FloatArray, Transform
from graphs.losses import SCALE_95
from graphs.problem import Estimate
from graphs.refine import refine
from graphs.stated_covariance import calibration_covariance
from sfm_calib.simulate.rigs import SimulatedRig
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

LensShape = Literal["straight", "barrel"]
RADIAL: dict[LensShape, tuple[float, float]] = {  # k1, k2
    "straight": (0.0, 0.0),
    "barrel": (-0.15, 0.03),  # about what the presets of `sfm_calib.simulate.rigs` have
}
SIZE_IN_FOCALS = (1.5, 1.125)  # of an image: 74 deg across, whatever the focal length
PAIR = (0, 1)

MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it
BASELINE_SIGMA = 0.001  # of its length: 0.2 mm of 20 cm, what a good caliper measures
SCAN = TrackOptions(
    rig="stereo", trajectory="orbit", lens="radial", points=1500, max_points_per_image=120
)
# Of so many places drawn in the first image, enough are seen by the second too.
DRAWN_A_POINT = 20


def parallel_pair(focal_px: float, baseline_m: float, shape: LensShape) -> SimulatedRig:
    """Two equal cameras side by side that look the same way; the first is the reference."""
    size = (round(SIZE_IN_FOCALS[0] * focal_px), round(SIZE_IN_FOCALS[1] * focal_px))
    centre = [(side - 1) / 2 for side in size]
    params = np.array([focal_px, focal_px, *centre, *RADIAL[shape]])
    cameras = tuple(Camera(name, "radial", size, params) for name in ("cam0", "cam1"))
    beside = Transform(np.eye(3), np.array([-baseline_m, 0.0, 0.0]))
    return SimulatedRig(cameras, (Transform.identity(), beside))


def as_estimate(rig: SimulatedRig) -> Estimate:
    """The rig alone, without frames and points."""
    return Estimate(rig.cameras, rig.cam_from_rig, (), np.zeros((0, 3)))


def seen_by_both(estimate: Estimate, points: FloatArray) -> FloatArray:
    """Exact pixels (..., 2, 2) of points (..., 3) in the first and the second camera."""
    return np.stack(
        [project(estimate.cameras[i], estimate.cam_from_rig[i] @ points) for i in PAIR], axis=-2
    )


def points_at(
    estimate: Estimate, depth_m: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Points (count, 3) at a depth before the first camera, anywhere in both images.

    Raises ValueError where the images share too little at that depth.
    """
    first = estimate.cameras[0]
    high = np.array(first.size) - 1.0
    pixels = rng.uniform(0.0, high, (DRAWN_A_POINT * count, 2))
    rays = unproject(first, pixels)
    points: FloatArray = depth_m * rays / rays[:, 2:]
    in_second = seen_by_both(estimate, points)[:, 1]
    high = np.array(estimate.cameras[1].size) - 1.0
    kept = points[((in_second >= 0) & (in_second <= high)).all(1)][:count]
    if len(kept) < count:
        raise ValueError(
            f"at {depth_m:g} m hardly a point is in both images: measure farther away, or with a "
            "shorter baseline"
        )
    return kept


@dataclass(frozen=True)
class Calibrated:
    """A rig, and what a scan says of it."""

    truth: Estimate
    stated: Stated
    sigma_px: float  # estimated, of one pixel coordinate


def calibrated(
    rig: SimulatedRig, frames: int, sigma_px: float, rng: np.random.Generator
) -> Calibrated:
    """Scan the rig and calibrate it as `sfm-calib calibrate` does, its baseline measured.

    Raises ValueError when the scan determines too little.
    """
    baseline_m = float(np.linalg.norm(rig.cam_from_rig[1].translation))
    scan = SCAN.model_copy(
        update={
            "size": rig.cameras[0].size,
            "frames": frames,
            "sigma_px": sigma_px,
            "baseline_sigma_m": BASELINE_SIGMA * baseline_m,
        }
    )
    problem, truth = simulate_tracks(scan, rng, rig)
    priors = tuple(measured_prior(camera, rng) for camera in truth.cameras)
    options = GraphOptions(loss="cauchy", loss_scale=SCALE_95["cauchy"], lens_priors=priors)
    found = refine(problem, options, MIN_PARALLAX_DEG)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, MIN_PARALLAX_DEG)
    return Calibrated(truth, Stated(found.estimate, covariance.stated), found.sigma_px)

"""The cabin of `depth_camera_cabin` calibrated: by boards, by a scan, by a scan and one board."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from experiments.runner.protocol import TrialOptions
from graphs.boards import corners_of
from graphs.frames import FloatArray
from graphs.jackknife import change
from graphs.problem import Estimate, KnownBaseline, Problem
from graphs.refine import Refinement
from graphs.stated_covariance import calibration_covariance, factors
from sfm_calib.anchors import SeenBoards, anchored
from sfm_calib.boards.spec import Checkerboard
from sfm_calib.boards.views import BoardViews
from sfm_calib.calibrate import refusals, solve_problem
from sfm_calib.config import CameraConfig, RigConfig
from sfm_calib.simulate.board_views import (
    BoardViewOptions,
    corners_seen,
    place_board,
    scan_of,
)
from sfm_calib.simulate.cabin import HEAD_M, Cabin
from sfm_calib.simulate.carried import CarryOptions, carry_box
from sfm_calib.simulate.rigs import SimulatedRig
from sfm_calib.target import graph_board, started_problem

POINTS_A_FEATURE = 16  # on the box, for each that one image of it has: it is seen from all sides

# The study's squares; 9 x 6 of them, on A3. It is as large and as flat as our own description
# believes; single corners are where they belong, or a solve would take ten times as long.
BOARD = Checkerboard(inner_corners=(8, 5), square_m=0.036, corner_sigma_m=0.0)
CORNER_PX = 0.2  # noise of a corner
TAPE_M = 0.005  # sigma of a tape between two housings, whose lenses' centres nobody sees
# Cameras by index, infrared and colour of front, right and left. A device is shown the board on
# its own, or together with the front one; right and left face each other.
DEVICES: tuple[tuple[int, ...], ...] = ((0, 1), (2, 3), (4, 5))
PAIRS = ((0, 1, 2, 3), (0, 1, 4, 5))
FAR = (0, 4)  # the front and left infrared cameras, between which the tape is held
ALONE = BoardViewOptions(distance_m=(0.45, 0.9), tilt_deg=(0.0, 45.0), least_seen=0.7)
# The board faces halfway between two devices, 40 to 45 degrees off both axes already.
TOGETHER = BoardViewOptions(
    distance_m=(0.5, 0.9), tilt_deg=(0.0, 25.0), coverage=0.6, least_seen=0.7
)


class CabinOptions(TrialOptions):
    """One cabin, calibrated in one way, and one head that it takes."""

    way: Literal["none", "boards", "scan", "scan_board"] = "boards"
    """What it is calibrated by."""
    intrinsics: Literal["factory", "calibrated", "exact"] = "calibrated"
    """Lenses that depth becomes points by. With calibrated places, factory lenses are held while
    these are found."""
    extrinsics: Literal["hand", "calibrated", "exact"] = "calibrated"
    """Places that clouds are put together by."""
    scale: Literal["tape", "none"] = "tape"
    """What gives a scan its lengths; none: the places by hand."""
    hand_deg: Annotated[float, Field(ge=0, le=30)] = 2.0
    """Rms of how far the side devices are turned from their places by hand."""
    hand_mm: Annotated[float, Field(ge=0, le=300)] = 20.0
    """And of how far they are shifted."""
    alone: Annotated[int, Field(ge=3, le=200)] = 30
    """Views of the board by each device, of way boards."""
    together: Annotated[int, Field(ge=1, le=200)] = 20
    """Views by each pair of devices, of way boards."""
    added: Annotated[int, Field(ge=1, le=50)] = 1
    """Views by each pair of devices, of way scan_board."""
    scan_frames: Annotated[int, Field(ge=10, le=400)] = 60
    """How often the box is seen in a scan."""
    features: Annotated[int, Field(ge=20, le=500)] = 100
    """Features of an image of the box, at most."""
    feature_px: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Noise of a feature."""
    depth_noise: Annotated[float, Field(ge=0, le=20)] = 1.0
    """Noise of depth, times a Kinect's."""

    @model_validator(mode="after")
    def _calibrated_by_something(self) -> CabinOptions:
        if self.way == "none" and "calibrated" in (self.intrinsics, self.extrinsics):
            raise ValueError(
                "way none calibrates nothing: give intrinsics factory or exact and extrinsics hand "
                "or exact, or another way"
            )
        return self


@dataclass(frozen=True)
class Calibrated:
    """What came of it, in metres, beside its errors and its own covariance."""

    rig: SimulatedRig
    names: tuple[str, ...]  # of the parameters that were free
    error: FloatArray  # (n,) of each; without a scale, lengths in units of the longest baseline
    cov: FloatArray  # (n, n) stated

    @property
    def z(self) -> FloatArray:
        """Errors (n,) in sigmas; zero of what is exactly known."""
        sigma = np.sqrt(np.diag(self.cov))
        return np.divide(self.error, sigma, out=np.zeros_like(sigma), where=sigma > 0)

    @property
    def nees(self) -> float:
        """Normalised squared error a degree of freedom: 1 on average where the sigmas hold.

        Without a scale one length is the unit, and has no error.
        """
        _, whiten = factors(self.cov)
        return float(((whiten @ self.error) ** 2).sum()) / len(whiten)


# ---- the ways ------------------------------------------------------------------------------


def calibrate_cabin(cabin: Cabin, options: CabinOptions, rng: np.random.Generator) -> Calibrated:
    """Calibrate a cabin as its user would.

    Raises CalibrationError where its views do not allow it.
    """
    config = config_of(cabin, held=options.intrinsics == "factory")
    if options.way == "boards":
        views = show_board(cabin, options.alone, options.together, rng)
        problem = started_problem(views, BOARD, config, scan_of(views))[1]
        return judged(cabin, solve_problem(problem, config, _unsaid))
    problem = scanned(cabin, options, rng)
    if options.way == "scan" and options.scale == "tape":
        problem = replace(problem, scales=(taped(cabin, rng),))
    found = solve_problem(problem, config, _unsaid)
    if options.way == "scan":
        return judged(cabin, found)
    views = show_board(cabin, 0, options.added, rng)
    with refusals():
        joined, _ = anchored(found, BOARD, SeenBoards(replace(views, views=()), views, ()))
    return judged(cabin, solve_problem(joined, config, _unsaid))


def scanned(cabin: Cabin, options: CabinOptions, rng: np.random.Generator) -> Problem:
    """Tracks of a papered box, started from the factory's lenses and the places by hand."""
    carry = CarryOptions(
        frames=options.scan_frames,
        points=POINTS_A_FEATURE * options.features,
        max_points_per_image=options.features,
        sigma_px=options.feature_px,
    )
    kinds = (cabin.infrared, cabin.colour)
    return carry_box(carry, cabin.true, cabin.nominal, kinds, np.array(HEAD_M), rng)[0]


def config_of(cabin: Cabin, held: bool) -> RigConfig:
    """What rig.yaml says: the lens model; where they are held, all that the factory says."""
    lenses = {
        camera.name: CameraConfig(lens="brown", params=camera.named(), fixed=camera.names)
        for camera in cabin.nominal.cameras
    }
    reference = cabin.true.cameras[0].name
    return RigConfig(lens="brown", reference=reference, cameras=lenses if held else {})


def show_board(cabin: Cabin, alone: int, together: int, rng: np.random.Generator) -> BoardViews:
    """What every camera finds of a board that is off its description as that believes.

    alone, together: how often it is shown to each device, and to each pair of devices.
    """
    rig, known = cabin.true, graph_board(BOARD)
    shape = known.shape_sigma * rng.standard_normal(known.shape_sigma.size)
    corners = corners_of(known, shape)[0]
    asked = [(group, ALONE) for group in DEVICES for _ in range(alone)]
    asked += [(group, TOGETHER) for group in PAIRS for _ in range(together)]
    places = [place_board(rig, group, corners, how, rng) for group, how in asked]
    return BoardViews(
        tuple(camera.name for camera in rig.cameras),
        tuple(camera.size for camera in rig.cameras),
        tuple(f"board{frame:03d}" for frame in range(len(places))),
        corners_seen(rig, places, corners, CORNER_PX, rng),
    )


def taped(cabin: Cabin, rng: np.random.Generator) -> KnownBaseline:
    """The longest distance between two devices, as a tape has it."""
    length_m = far_m(cabin.true) + TAPE_M * rng.standard_normal()
    return KnownBaseline(FAR, length_m, TAPE_M)


def far_m(rig: SimulatedRig) -> float:
    """Distance of the cameras between which the tape is held."""
    a, b = (rig.cam_from_rig[camera].inverse.translation for camera in FAR)
    return float(np.linalg.norm(a - b))


def judged(cabin: Cabin, found: Refinement) -> Calibrated:
    """A result in metres, and its errors against what it states.

    Without a scale its lengths are those of the rig by hand. No jackknife: errors that frames
    share, which it looks for, are not simulated, and it takes ten solves.
    """
    covariance = calibration_covariance(found.graph, found.estimate, found.values)
    names, unit = covariance.stated.names, covariance.basis.unit_camera
    estimate = found.estimate
    true = Estimate(cabin.true.cameras, cabin.true.cam_from_rig, (), np.zeros((0, 3)))
    alike = replace(estimate, rig_from_world=(), points=true.points)
    if found.problem.metric:
        error = change(true, alike, names)
    else:
        assert unit is not None
        error = change(_in_unit(true, unit), _in_unit(alike, unit), names)
        own = SimulatedRig(estimate.cameras, estimate.cam_from_rig)
        alike = alike.scaled(far_m(cabin.nominal) / far_m(own))
    rig = SimulatedRig(alike.cameras, alike.cam_from_rig)
    return Calibrated(rig, names, error, covariance.stated.matrix)


def _in_unit(estimate: Estimate, camera: int) -> Estimate:
    return estimate.scaled(1 / float(np.linalg.norm(estimate.cam_from_rig[camera].translation)))


def _unsaid(stage: str, done: int, total: int) -> None:
    pass

"""One calibration of the study `targetless_vs_target`: from a scan, from boards, or from both."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from experiments.runner.protocol import Row, TrialOptions
from graphs.compare import Frames, Stated, difference, sights
from graphs.frames import angle_between
from graphs.pose_covariance import relative
from graphs.problem import Estimate
from graphs.propagation import cross_covariance
from graphs.refine import Refinement
from graphs.stated_covariance import calibration_covariance
from graphs.uncertainty import projection_maps
from sfm_calib.anchors import SeenBoards, anchored
from sfm_calib.boards.spec import Checkerboard
from sfm_calib.boards.views import BoardViews
from sfm_calib.calibrate import refusals, solve_problem
from sfm_calib.config import RigConfig
from sfm_calib.simulate.board_views import BoardViewOptions, calibrate_views, simulate_boards
from sfm_calib.simulate.rigs import SimulatedRig, make_rig
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

MotionName = Literal["handheld", "orbit", "sideways", "corridor"]

CONFIG = RigConfig(lens="radtan")
SCAN = TrackOptions(
    rig="stereo", lens="radtan", outlier_share=0.05, outlier_kind="heavy", baseline_sigma_m=0.0
)
# Points of the room at a time for each feature of an image: as many as leave nearly all images
# with all of their features. Sideways looks at a quarter of the room.
POINTS_A_FEATURE: dict[MotionName, int] = {
    "handheld": 12,
    "orbit": 12,
    "sideways": 40,
    "corridor": 12,
}
# Half a metre wide: in both cameras it fills a third to two thirds of the picture's width.
BOARD = Checkerboard(inner_corners=(9, 6), square_m=0.06)
HELD = BoardViewOptions(rig="stereo", lens="radtan", tilt_deg=(0.0, 45.0), distance_m=(0.6, 1.2))


class TargetlessOptions(TrialOptions):
    """One calibration."""

    source: Literal["scan", "boards"] = "scan"
    """What is calibrated from."""
    images: Annotated[int, Field(ge=3, le=2000)] = 50
    """Of each camera: of the scan, or views of the board."""
    motion: MotionName = "handheld"
    """How the scan's rig moves."""
    features: Annotated[int, Field(ge=20, le=2000)] = 200
    """Texture: how many an image of the scan has at most."""
    board_views: Annotated[int, Field(ge=0, le=50)] = 0
    """Of a board, by both cameras at once, beside the scan."""
    sigma_px: Annotated[float, Field(ge=0.02, le=5)] = 0.5
    """Noise of a feature's pixel coordinates."""
    corner_sigma_px: Annotated[float, Field(ge=0.02, le=5)] = 0.1
    """Noise of a corner's."""

    @property
    def scan(self) -> TrackOptions:
        """A point is seen in one run of frames: a longer scan needs more of them."""
        at_a_time = POINTS_A_FEATURE[self.motion] * self.features
        runs = self.images / SCAN.max_track_frames + 1
        return SCAN.model_copy(
            update={
                "trajectory": self.motion,
                "frames": self.images,
                "points": round(at_a_time * runs),
                "max_points_per_image": self.features,
                "sigma_px": self.sigma_px,
            }
        )

    def held(self, views: int) -> BoardViewOptions:
        return HELD.model_copy(update={"views": views, "sigma_px": self.corner_sigma_px})


def trial(options: TargetlessOptions, seed: int) -> Row:
    """Simulate, calibrate and hold it against the truth. Raises CalibrationError where refused."""
    rng = np.random.default_rng([seed, options.source == "scan"])
    rig = make_rig("stereo", "radtan")
    if options.source == "boards":
        seen = simulate_boards(options.held(options.images), rng, rig, BOARD)
        of_boards = calibrate_views(seen.views, BOARD, CONFIG)
        return errors(rig, Stated(of_boards.estimate, of_boards.covariance), True)
    problem, _ = simulate_tracks(options.scan, rng, rig)
    with refusals():
        found = solve_problem(problem, CONFIG, _unsaid)
        if options.board_views:
            seen = simulate_boards(options.held(options.board_views), rng, rig, BOARD)
            found = with_board(found, seen.views)
        covariance = calibration_covariance(found.graph, found.estimate, found.values).stated
    images = len(problem.frame_names) * len(rig.cameras)
    features = {"features": len(problem.observations) / images}
    return errors(rig, Stated(found.estimate, covariance), found.problem.metric) | features


def with_board(alone: Refinement, views: BoardViews) -> Refinement:
    """A scan that was solved, solved again with views of a board that are none of its own."""
    in_scan = BoardViews(views.cameras, views.sizes, alone.problem.frame_names, ())
    problem, _ = anchored(alone, BOARD, SeenBoards(in_scan, views, ()))
    return solve_problem(problem, CONFIG, _unsaid)


def errors(rig: SimulatedRig, found: Stated, metric: bool) -> dict[str, Any]:
    """How far a calibration is off, and how far it says it may be.

    px: rms length over both pictures, what a rotation of each camera undoes left out. Focal
    lengths (mean of fx and fy, of each camera) and the baseline, known where it is metric, in %.
    """
    every = range(len(rig.cameras))
    truth = Estimate(rig.cameras, rig.cam_from_rig, (), np.zeros((0, 3)))
    frames = Frames(tuple((i,) for i in every), (np.inf,), translation=False, scale=False)
    apart = difference(truth, found.estimate, frames).at(sights(truth, (np.inf,), list(every)))
    maps = projection_maps(found.estimate, found.covariance)
    expected = [np.nanmean(np.trace(one.cov_px, axis1=-2, axis2=-1)) for one in maps]
    focal, sigma_focal = zip(*(_focal(found, rig, index) for index in every), strict=True)
    place, true_place = found.estimate.cam_from_rig[1], rig.cam_from_rig[1]
    cov = relative(found.covariance, found.estimate, 1, 0).matrix
    length, true_length = (float(np.linalg.norm(t.translation)) for t in (place, true_place))
    along = place.translation / length
    sigma_length = float(along @ cov[3:, 3:] @ along) ** 0.5
    return {
        "px": float(np.sqrt(np.nanmean((apart**2).sum(1)))),
        "px_stated": float(np.sqrt(np.mean(expected))),
        "focal_percent": list(focal),
        "sigma_focal_percent": list(sigma_focal),
        "rotation_deg": float(np.degrees(angle_between(place.rotation, true_place.rotation))),
        "sigma_rotation_deg": float(np.degrees(np.trace(cov[:3, :3]) ** 0.5)),
        "baseline_percent": 100 * (length / true_length - 1) if metric else None,
        "sigma_baseline_percent": 100 * sigma_length / true_length if metric else None,
    }


def _focal(found: Stated, rig: SimulatedRig, camera: int) -> tuple[float, float]:
    """Error and sigma of a camera's mean focal length, in % of the true one."""
    names = [f"{rig.cameras[camera].name}.{parameter}" for parameter in ("fx", "fy")]
    true_px = float(rig.cameras[camera].params[:2].mean())
    error_px = float(found.estimate.cameras[camera].params[:2].mean()) - true_px
    sigma_px = float(cross_covariance(found.covariance, names, names).mean()) ** 0.5
    return 100 * error_px / true_px, 100 * sigma_px / true_px


def _unsaid(stage: str, done: int, total: int) -> None:
    pass

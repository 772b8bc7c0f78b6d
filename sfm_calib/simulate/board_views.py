"""Views of a board without images: what detection would find of it, the truth, and a calibration.

A board is held before cameras at random, again and again; a corner is its projection plus Gaussian
noise, or an outlier. Boards that reach beyond the picture are cut at its border.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from graphs.board_start import MIN_CORNERS, BoardStart
from graphs.boards import corners_of
from graphs.camera import project, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.lenses import LensName
from graphs.problem import BoolArray, Estimate
from graphs.refine import Refinement
from sfm_calib.boards import spec
from sfm_calib.boards.views import BoardView, BoardViews
from sfm_calib.calibrate import choose_lens, covariance_of, solve_problem
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan, ScanImage
from sfm_calib.nominal import check_config
from sfm_calib.simulate.keypoints import OutlierKind, with_outliers
from sfm_calib.simulate.rigs import RigName, SimulatedRig, make_rig
from sfm_calib.target import graph_board, started_problem

# As exact as its description says, so that an error is one of the corners in the image.
PLAIN_BOARD = spec.Checkerboard(inner_corners=(9, 6), square_m=0.03, warp=False, corner_sigma_m=0.0)
TRIES = 300  # for a place of the board that a frame's cameras see
EXACT_PX = 1e-3  # sigma of corners without noise: weights are its inverse
BACK_DEG = 85.0  # between line of sight and the board's normal: beyond it nothing is seen

Range = tuple[float, float]


class BoardViewOptions(BaseModel):
    """What to simulate. Ranges are drawn from uniformly."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rig: RigName = "mono"
    """Cameras and how they sit on the rig."""
    lens: LensName = "radtan"
    """Lens model of every camera."""
    size: tuple[Annotated[int, Field(ge=64)], Annotated[int, Field(ge=64)]] = (640, 480)
    """Width and height of every image in px."""
    views: Annotated[int, Field(ge=1, le=10_000)] = 20
    """How often the board is held before the cameras: frames."""
    together: tuple[tuple[int, ...], ...] = ()
    """Cameras that are to see the board at once, in turn; empty: the first camera with each other
    one. Others see what they see."""
    tilt_deg: Range = (0.0, 45.0)
    """Between the board's normal and the optical axis, of cameras together their axes' mean."""
    distance_m: Range = (0.3, 0.6)
    """From the first of a frame's cameras to the board's middle."""
    coverage: Annotated[float, Field(ge=0, le=1)] = 1.0
    """Share of the picture, about its centre, in which the board's middle may lie: 0 holds it in
    the centre, 1 takes it to the corners, where it is cut."""
    least_seen: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of its corners that each of a frame's cameras sees, at least; 1: whole boards alone."""
    sigma_px: Annotated[float, Field(ge=0)] = 0.2
    """Gaussian noise of each pixel coordinate."""
    outlier_share: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the corners that are wrong."""
    outlier_kind: OutlierKind = "heavy"
    """uniform: anywhere in the image; heavy: Student's t around the right place."""

    @model_validator(mode="after")
    def _ranges_rise(self) -> BoardViewOptions:
        for name, least, most in (("tilt_deg", 0.0, BACK_DEG), ("distance_m", 1e-6, np.inf)):
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise ValueError(
                    f"{name} is {low:g} to {high:g}: give rising numbers of "
                    f"{least:g} or more" + ("" if most == np.inf else f", {most:g} at most")
                )
        return self


@dataclass(frozen=True)
class SimulatedBoards:
    """A board in many places, what was seen of it, and the truth."""

    board: spec.Board
    views: BoardViews
    truth: Estimate  # rig_from_world is rig_from_board, one a frame; board_shape as it really is


@dataclass(frozen=True)
class CalibratedBoards:
    """What came of views of a board."""

    start: BoardStart
    refinement: Refinement
    covariance: Covariance  # stated

    @property
    def estimate(self) -> Estimate:
        return self.refinement.estimate


# ---- simulation ----------------------------------------------------------------------------


def simulate_boards(
    options: BoardViewOptions,
    rng: np.random.Generator,
    rig: SimulatedRig | None = None,
    board: spec.Board = PLAIN_BOARD,
) -> SimulatedBoards:
    """Views of a board by a preset rig, or by another one; the first camera's frame is its own.

    The board is as large, as flat and as well printed as its description believes: how far it is
    off is drawn from that.
    Raises CalibrationError where no place of the board is seen as the options ask for.
    """
    rig = rig or make_rig(options.rig, options.lens, options.size)
    known = graph_board(board)
    shape = known.shape_sigma * rng.standard_normal(known.shape_sigma.size)
    corners = corners_of(known, shape)[0]
    groups = options.together or _with_the_first(len(rig.cameras))
    rig_from_board = tuple(
        place_board(rig, groups[frame % len(groups)], corners, options, rng)
        for frame in range(options.views)
    )
    exact = corners_seen(rig, rig_from_board, corners, options.sigma_px, rng)
    views = _with_outliers(exact, rig, options, rng)
    names = tuple(f"board{frame:03d}" for frame in range(options.views))
    points = np.tile(corners, (options.views, 1))
    truth = Estimate(rig.cameras, rig.cam_from_rig, rig_from_board, points, None, shape)
    cameras = rig.cameras
    return SimulatedBoards(
        board,
        BoardViews(tuple(c.name for c in cameras), tuple(c.size for c in cameras), names, views),
        truth,
    )


def _with_the_first(n_cameras: int) -> tuple[tuple[int, ...], ...]:
    return tuple((0, other) for other in range(1, n_cameras)) or ((0,),)


def place_board(
    rig: SimulatedRig,
    group: Sequence[int],
    corners: FloatArray,
    options: BoardViewOptions,
    rng: np.random.Generator,
) -> Transform:
    """rig_from_board at random, with the corners (n, 3) in view of all cameras of a group.

    Raises CalibrationError where no such place is found.
    """
    first = group[0]
    camera, rig_from_cam = rig.cameras[first], rig.cam_from_rig[first].inverse
    axes = np.array([rig.cam_from_rig[index].rotation[2] for index in group])
    towards = axes.mean(0) / np.linalg.norm(axes.mean(0))
    middle = (corners.min(0) + corners.max(0)) / 2
    half = np.sqrt(options.coverage) * (np.array(camera.size) - 1) / 2
    for _ in range(TRIES):
        pixel = camera.centre + rng.uniform(-half, half)
        distance_m = rng.uniform(*options.distance_m)
        tilt, about, spin = (
            np.radians(rng.uniform(*options.tilt_deg)), *rng.uniform(0, 2 * np.pi, 2)
        )  # fmt: skip
        place = rig_from_cam @ (distance_m * unproject(camera, pixel))
        axis = np.array([np.cos(about), np.sin(about), 0.0])
        turn = _facing(towards) @ exp_rotation(tilt * axis) @ exp_rotation(np.array([0, 0, spin]))
        rig_from_board = Transform(turn, place - turn @ middle)
        if np.isfinite(place).all() and all(
            visible(rig, index, rig_from_board, corners)[1].mean() >= options.least_seen
            for index in group
        ):
            return rig_from_board
    who = " and ".join(rig.cameras[index].name for index in group)
    raise CalibrationError(
        f"none of {TRIES} places of the board shows {who} {100 * options.least_seen:.0f} % of its "
        "corners: hold it farther away (distance_m), tilt it less, or ask for fewer (least_seen)"
    )


def _facing(towards: FloatArray) -> FloatArray:
    """A rotation (3, 3) that takes z to a unit vector (3,), the shortest way."""
    axis = np.cross([0.0, 0.0, 1.0], towards)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, towards[2])
    return exp_rotation(angle * (axis / sine if sine > 0 else np.array([1.0, 0.0, 0.0])))


def visible(
    rig: SimulatedRig, camera: int, rig_from_board: Transform, corners: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Exact pixels (n, 2) of corners (n, 3), and which of them (n,) are in the picture."""
    lens = rig.cameras[camera]
    cam_from_board = rig.cam_from_rig[camera] @ rig_from_board
    at = cam_from_board @ corners
    pixels = project(lens, at)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels <= np.array(lens.size) - 1)).all(1)
    steepness = at @ cam_from_board.rotation[:, 2] / np.linalg.norm(at, axis=1)
    return pixels, inside & (steepness > np.cos(np.radians(BACK_DEG)))


def corners_seen(
    rig: SimulatedRig,
    rig_from_board: Sequence[Transform],
    corners: FloatArray,
    sigma_px: float,
    rng: np.random.Generator,
    seen: float = 1.0,
) -> tuple[BoardView, ...]:
    """Views with noise of a board in many places, frame by frame, those with too few left out.

    seen: share of the corners in the picture that a view has, drawn at random.
    """
    views = []
    for frame, placed in enumerate(rig_from_board):
        for index in range(len(rig.cameras)):
            pixels, inside = visible(rig, index, placed, corners)
            corner = np.flatnonzero(inside & (rng.uniform(size=len(corners)) < seen))
            noise = sigma_px * rng.standard_normal((len(corner), 2))
            if len(corner) >= MIN_CORNERS:
                sigmas = np.full(len(corner), max(sigma_px, EXACT_PX))
                views.append(BoardView(index, frame, corner, pixels[corner] + noise, sigmas))
    return tuple(views)


def _with_outliers(
    views: Sequence[BoardView],
    rig: SimulatedRig,
    options: BoardViewOptions,
    rng: np.random.Generator,
) -> tuple[BoardView, ...]:
    found = []
    for index, camera in enumerate(rig.cameras):
        own = [view for view in views if view.camera == index]
        if not own:
            continue
        pixels = with_outliers(
            np.concatenate([view.pixels for view in own]),
            options.outlier_share, options.outlier_kind, camera.size, rng,
        )  # fmt: skip
        ends = np.cumsum([len(view.corner) for view in own])[:-1]
        for view, moved in zip(own, np.split(pixels, ends), strict=True):
            found.append(BoardView(index, view.frame, view.corner, moved, view.sigma_px))
    return tuple(sorted(found, key=lambda view: (view.frame, view.camera)))


# ---- calibration ---------------------------------------------------------------------------


def calibrate_views(
    views: BoardViews, board: spec.Board, config: RigConfig | None = None
) -> CalibratedBoards:
    """Calibrate from corners as `sfm-calib target` does: from nothing, with the stated covariance.

    config: `lens` spares the search for one. Raises CalibrationError as `calibrate_target`.
    """
    config = config or RigConfig()
    scan = scan_of(views)
    check_config(config, scan)
    start, problem = started_problem(views, board, config, scan)
    ladder = choose_lens(problem, config, _unsaid)
    refinement = solve_problem(problem, config, _unsaid, ladder)
    covariance, _ = covariance_of(refinement, config, _unsaid)
    return CalibratedBoards(start, refinement, covariance.stated)


def scan_of(views: BoardViews) -> Scan:
    """The images that views would have come from."""
    images = tuple(
        ScanImage(view.camera, view.frame, f"{views.cameras[view.camera]}/{view.frame}.png")
        for view in views.views
    )
    return Scan(Path(), views.cameras, views.sizes, views.frames, images)


def _unsaid(stage: str, done: int, total: int) -> None:
    pass

"""Views of a board as detection has them, by a rig whose truth is known: corners projected."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from graphs.build import GraphOptions
from graphs.camera import project
from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate, Problem
from graphs.refine import Refinement, refine
from sfm_calib.board_use import BoardUse
from sfm_calib.boards.spec import Board, Checkerboard
from sfm_calib.boards.views import BoardView, BoardViews
from sfm_calib.calibrate import Outcome, Stopwatch, determine
from sfm_calib.config import RigConfig
from sfm_calib.images import Scan
from sfm_calib.mapping import Mapped
from sfm_calib.run import Given
from synthetic.problems import small_problem
from synthetic.scans import silent

SIGMA_PX = 0.2
N_FRAMES, UNIT_M = 8, 2.5
NAMES = tuple(f"{frame:06d}" for frame in range(N_FRAMES))
# Metres ahead of a rig whose points are 3 to 7 m away; half a turn shows it the same.
BOARD = Checkerboard(inner_corners=(8, 6), square_m=0.2, warp=False)
FEWEST = 12  # corners of a view: fewer are at the image's edge


@dataclass(frozen=True)
class Anchored:
    """A scan in a unit of its own, solved, and the truth in metres."""

    alone: Refinement
    truth: Estimate


@functools.cache
def solved_scan() -> Anchored:
    """Eight frames of two cameras past points, in units of 2.5 m, as mapping may have it."""
    problem, truth = small_problem(
        "radial", cameras=2, frames=N_FRAMES, points=120, sigma_px=SIGMA_PX, start_error=0.0
    )
    problem = replace(problem, initial=problem.initial.scaled(1 / UNIT_M))
    return Anchored(refine(problem, GraphOptions(), 1.0), truth)


def outcome_of(scan: Anchored, problem: Problem, use: BoardUse) -> Outcome:
    """The result of a scan that a board has joined."""
    cameras = tuple(lens.name for lens in scan.truth.cameras)
    sizes = tuple(lens.size for lens in scan.truth.cameras)
    given = Given(
        Scan(Path(), cameras, sizes, NAMES, ()),
        RigConfig(lens="radial"),
        Mapped(problem, use.messages, {}),
        "",
        use,
        scan.alone.problem,
    )
    return determine(given, problem, Stopwatch(), silent)


def board_view(
    truth: Estimate,
    camera: int,
    frame: int,
    rig_from_board: Transform,
    rng: np.random.Generator,
    board: Board = BOARD,
) -> BoardView | None:
    """What a camera sees of a board, with noise; None: too little of it."""
    lens = truth.cameras[camera]
    at = project(lens, truth.cam_from_rig[camera] @ (rig_from_board @ board.corners_m))
    inside = np.flatnonzero(((at > 0) & (at < np.array(lens.size) - 1)).all(1))
    if len(inside) < FEWEST:
        return None
    pixels = at[inside] + SIGMA_PX * rng.standard_normal((len(inside), 2))
    return BoardView(camera, frame, inside, pixels, np.full(len(inside), SIGMA_PX))


def board_views(
    truth: Estimate,
    places: Mapping[int, Transform],
    frames: Sequence[str],
    seen_by: Mapping[int, Sequence[int]] | None = None,
    seed: int = 0,
) -> BoardViews:
    """A board at these places, rig_from_board by frame, in the images of the cameras that see it.

    seen_by: cameras of each frame; default: all.
    """
    rng = np.random.default_rng(seed)
    every = range(len(truth.cameras))
    views = [
        board_view(truth, camera, frame, placed, rng)
        for frame, placed in sorted(places.items())
        for camera in (every if seen_by is None else seen_by[frame])
    ]
    names = tuple(lens.name for lens in truth.cameras)
    sizes = tuple(lens.size for lens in truth.cameras)
    found = tuple(view for view in views if view is not None)
    return BoardViews(names, sizes, tuple(frames), found)


def places_before(n: int, rng: np.random.Generator) -> dict[int, Transform]:
    """rig_from_board of n frames: 2.2 to 3.5 m ahead, tilted by up to 40 degrees."""
    middle = (BOARD.corners_m.min(axis=0) + BOARD.corners_m.max(axis=0)) / 2
    found = {}
    for frame in range(n):
        turn = Transform.exp(rng.uniform(-0.7, 0.7, 3), np.zeros(3)).rotation
        place = rng.uniform([-0.3, -0.2, 2.2], [0.3, 0.2, 3.5])
        found[frame] = Transform(turn, place - turn @ middle)
    return found


def standing_before(truth: Estimate) -> dict[int, Transform]:
    """rig_from_board of every frame, of a board that stands in the scene and is seen by most."""
    middle_frame = truth.rig_from_world[len(truth.rig_from_world) // 2]
    middle = (BOARD.corners_m.min(axis=0) + BOARD.corners_m.max(axis=0)) / 2
    turn = Transform.exp(np.array([0.3, -0.25, 0.2]), np.zeros(3)).rotation
    rig_from_board = Transform(turn, np.array([0.0, 0.1, 4.5]) - turn @ middle)
    world_from_board = middle_frame.inverse @ rig_from_board
    return {i: placed @ world_from_board for i, placed in enumerate(truth.rig_from_world)}


def turned_half(view: BoardView) -> BoardView:
    """The same view, numbered from the other end of the board."""
    (half,) = BOARD.symmetries
    order = np.argsort(half[view.corner])
    corner: FloatArray = half[view.corner][order]
    return BoardView(
        view.camera, view.frame, corner.astype(np.int64), view.pixels[order], view.sigma_px[order]
    )

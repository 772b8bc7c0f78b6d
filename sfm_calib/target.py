"""The story of a target-based calibration: images of a board in, a Calibration out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphs.board_problem import SeenCorners, board_problem
from graphs.board_start import BoardScene, BoardStart, start_from_board
from graphs.board_thin import redundant, thin
from graphs.camera import fit_lens
from graphs.planar import SeenBoard
from graphs.problem import Board, IntArray, Problem
from sfm_calib.board_use import BoardUse
from sfm_calib.boards import spec
from sfm_calib.boards.find import find_board
from sfm_calib.boards.views import BoardViews
from sfm_calib.cache import Cache
from sfm_calib.calibrate import Outcome, Stopwatch, determine, refusals
from sfm_calib.config import RigConfig, TargetOptions
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan
from sfm_calib.mapping import Mapped, reference_of, some
from sfm_calib.nominal import check_config, known_cameras, lens_of, on_ladder, start_from_config
from sfm_calib.run import Given
from sfm_calib.target_images import read_target

# Of the board's longer side, how far its middle may stand out: two boards of real sets do by 1.3 to
# 2.4 thousandths, mrcal's of a metre by one or two mm. Held-out errors of those sets are smallest
# with 1.5e-4 to 5e-4, and by 0.5 % larger with 1e-2.
BEND_SIGMA = 0.001
# Of the frames that two cameras share, so many have to agree on where one stands beside the other.
FRAMES_TO_AGREE, AGREEING_SHARE = 4, 0.3
MIN_VIEWS = 3  # of a camera: each gives two numbers on its lens beyond the board's place


def calibrate_target(
    images: Path,
    board: spec.Board,
    options: TargetOptions,
    config: RigConfig,
    cache: Cache,
    progress: Progress,
    command: str = "",
) -> Outcome:
    """Calibrate cameras, and the rig they sit on, from images of a board.

    `progress(stage, done, total)` is called throughout; a total of 0 means unknown.
    Raises CalibrationError with cause, number and remedy when the images do not allow it.
    """
    watch = Stopwatch()
    with watch.stage("reading images"):
        scan = read_target(
            images, cache, options.frames, options.video_frames, options.tolerance_s, progress
        )
        check_config(config, scan)
    with watch.stage("finding the board"):
        found = find_board(scan, board, progress)
    with watch.stage("starting values"):
        views = found.views
        started, problem = started_problem(views, board, config, scan)
    use = BoardUse(
        board,
        left_out(started, views.views, views),
        repeated(started, views.views, views, board),
    )
    messages = (*found.messages, *started.notes, *use.messages)
    hashes = scan.hashes
    mapped = Mapped(problem, messages, hashes)
    given = Given(scan, config, mapped, command, use)
    return determine(given, problem, watch, progress)


def started_problem(
    views: BoardViews, board: spec.Board, config: RigConfig, scan: Scan
) -> tuple[BoardStart, Problem]:
    """Where to start from, and the problem that starts there as rig.yaml has it.

    Raises CalibrationError as `start`.
    """
    started = diverse(start(views, board, config, scan), views, board, config.video_frames)
    problem = problem_of(started, views, board, reference_of(scan, config))
    return started, start_from_config(with_lenses(problem, config), config)


def graph_board(board: spec.Board) -> Board:
    """The board as the graph takes it: its corners, and how well their places are known."""
    corners = board.corners_m
    length = float(np.ptp(corners[:, :2], axis=0).max())
    bend = BEND_SIGMA * length if board.warp else 0.0
    sigma = np.array([board.relative_sigma, bend, bend])
    if board.misprint_m > 0:
        sigma = np.concatenate([sigma, np.full(corners.size, board.misprint_m)])
    return Board(corners, np.zeros(len(sigma)), sigma)


def diverse(started: BoardStart, views: BoardViews, board: spec.Board, most: int) -> BoardStart:
    """Of more frames than `most`, those that differ most in how the board lies in them."""
    kept = [views.views[index] for index in started.kept]
    if len({view.frame for view in kept}) <= most:
        return started
    chosen = thin(kept, most, board.corners_m, views.sizes)
    return replace(started, kept=tuple(started.kept[index] for index in chosen))


def start(views: BoardViews, board: spec.Board, config: RigConfig, scan: Scan) -> BoardStart:
    """Lenses, rig and the board's places to start from, of all cameras.

    Raises CalibrationError for cameras that saw too little of the board, or cannot be linked.
    """
    counts = Counter(view.camera for view in views.views)
    for index, name in enumerate(views.cameras):
        if counts[index] < MIN_VIEWS and not _is_known(config, name):
            images = sum(image.camera == index for image in scan.images)
            raise CalibrationError(
                f"{name} shows {board.described} in {counts[index]} of {images} images (needs "
                f"{MIN_VIEWS}): take more, with the board tilted to all sides"
            )
    known = known_cameras(config, scan)
    scene = BoardScene(
        views.views, board.corners_m, views.cameras, views.sizes, board.symmetries,
        known=known, reference=reference_of(scan, config),
    )  # fmt: skip
    with refusals():
        started = start_from_board(scene)
    for link in started.links:
        if link.frames >= FRAMES_TO_AGREE and link.agreeing < AGREEING_SHARE * link.frames:
            a, b = (views.cameras[camera] for camera in link.cameras)
            raise CalibrationError(
                f"only {link.agreeing} of {link.frames} frames in which {a} and {b} both see the "
                f"board agree on where {b} stands: their images were not taken together (try "
                "--frames order or time), or those of one are mirrored"
            )
    return started


def _is_known(config: RigConfig, name: str) -> bool:
    entry = config.cameras.get(name)
    return entry is not None and {"fx", "fy"} <= set(entry.params)


def problem_of(
    started: BoardStart, views: BoardViews, board: spec.Board, reference: int
) -> Problem:
    """The problem whose frames are those of the start that saw the board."""
    kept = [(index, views.views[index]) for index in started.kept]
    frames = sorted({view.frame for _, view in kept})
    return board_problem(
        graph_board(board),
        seen_corners(
            [view for _, view in kept],
            [started.corner[index] for index, _ in kept],
            [frames.index(view.frame) for _, view in kept],
        ),
        started.cameras,
        started.cam_from_rig,
        [started.rig_from_board[frame] for frame in frames],
        [views.frames[frame] for frame in frames],
        reference,
    )


def with_lenses(problem: Problem, config: RigConfig) -> Problem:
    """The problem with the lenses that the configuration gives; others are chosen later."""
    names = [camera.name for camera in problem.initial.cameras]
    open_to_choice = set(on_ladder(config, names))
    cameras = tuple(
        camera
        if index in open_to_choice
        else fit_lens(camera, lens_of(config, camera.name, len(names)))[0]
        for index, camera in enumerate(problem.initial.cameras)
    )
    return replace(problem, initial=replace(problem.initial, cameras=cameras))


def seen_corners(
    views: Sequence[SeenBoard], corners: Sequence[IntArray], frames: Sequence[int]
) -> SeenCorners:
    """All corners of some views, renumbered; `frames`: of each view, among the problem's."""
    lengths = [len(view.pixels) for view in views]
    return SeenCorners(
        np.concatenate([view.pixels for view in views]),
        np.repeat(frames, lengths),
        np.repeat([view.camera for view in views], lengths),
        np.concatenate(list(corners)),
        np.concatenate([view.sigma_px for view in views]),
    )


def left_out(started: BoardStart, given: Sequence[SeenBoard], names: BoardViews) -> tuple[str, ...]:
    """Views of the board that were not used, and why; `given`: those that the start was given."""
    return tuple(
        f"{names.cameras[given[one.view].camera]}/{names.frames[given[one.view].frame]}: "
        f"{one.reason}"
        for one in started.dropped
    )


def repeated(
    started: BoardStart, given: Sequence[SeenBoard], names: BoardViews, board: spec.Board
) -> tuple[str, ...]:
    """Groups of frames in which the board lies alike, in words."""
    kept = [given[index] for index in started.kept]
    groups = redundant(kept, len(board.corners_m), names.sizes)
    return tuple(some([names.frames[frame] for frame in group]) for group in groups)

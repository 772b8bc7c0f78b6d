"""The story of a scan with a board: views of it by the same cameras join the scan's graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from graphs.board_join import PlacedFrame, place_boards, still_board
from graphs.board_problem import SeenCorners, beside, board_problem, standing_in
from graphs.problem import Problem
from graphs.refine import Refinement
from sfm_calib.board_use import BoardUse
from sfm_calib.boards import spec
from sfm_calib.boards.find import find_board
from sfm_calib.boards.views import BoardViews
from sfm_calib.cache import Cache
from sfm_calib.calibrate import (
    Outcome,
    Stopwatch,
    checked_scan,
    determine,
    enough_placed,
    mapped_scan,
    refusals,
    solve_problem,
)
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.images import Progress, Scan
from sfm_calib.target import graph_board, left_out, repeated, seen_corners
from sfm_calib.target_images import read_target

OWN_FRAME = "board:"  # before the name of a frame whose world is the board's


def calibrate_with_board(
    scan_path: Path,
    board: spec.Board,
    board_images: Path | None,
    config: RigConfig,
    cache: Cache,
    progress: Progress,
    command: str = "",
) -> Outcome:
    """Calibrate a scan together with a board seen in it, or in images of its own.

    As `calibrate`. Raises CalibrationError also where the board is found nowhere.
    """
    watch = Stopwatch()
    scan = checked_scan(scan_path, config, cache, progress, watch)
    with watch.stage("finding the board"):  # before the mapping, which takes far longer
        views = views_of_board(scan, board, board_images, config, cache, progress)
    given, problem = mapped_scan(scan, config, cache, progress, command, watch)
    with enough_placed(problem, len(scan.images)):
        with watch.stage("placing the board"):
            alone = solve_problem(problem, config, progress)
            with refusals():
                joined, use = anchored(alone, board, views)
        messages = (*given.mapped.messages, *views.messages, *use.messages)
        mapped = replace(given.mapped, problem=joined, messages=messages)
        given = replace(given, mapped=mapped, board=use, scan_alone=problem)
        return determine(given, joined, watch, progress)


@dataclass(frozen=True)
class SeenBoards:
    """Views of the board in the scan, and in images of their own; cameras as the scan's."""

    in_scan: BoardViews
    apart: BoardViews | None
    messages: tuple[str, ...]


def views_of_board(
    scan: Scan,
    board: spec.Board,
    board_images: Path | None,
    config: RigConfig,
    cache: Cache,
    progress: Progress,
) -> SeenBoards:
    """Look for the board in the scan, and in other images of its cameras.

    Raises CalibrationError where it is in neither, and where those images are of other cameras.
    """
    if board_images is None:
        found = find_board(scan, board, progress, "any")
        return SeenBoards(found.views, None, found.messages)
    others = read_target(
        board_images, cache, config.frames, config.video_frames, None, progress, least=1
    )
    check_same_cameras(scan, others)
    apart = find_board(others, board, progress, "any")
    in_scan = find_board(scan, board, progress, "none")
    messages = (*others.warnings, *apart.messages)
    return SeenBoards(in_scan.views, _numbered_as(apart.views, scan), messages)


def check_same_cameras(scan: Scan, others: Scan) -> None:
    """Raises CalibrationError where images of the board are not by the scan's cameras."""
    for name, size in zip(others.cameras, others.sizes, strict=True):
        if name not in scan.cameras:
            raise CalibrationError(
                f"--board-images has a camera {name!r} that the scan has not; "
                f"{nearest(name, scan.cameras)}"
            )
        known = scan.sizes[scan.cameras.index(name)]
        if size != known:
            raise CalibrationError(
                f"camera {name}: its images of the board are {size[0]}x{size[1]} and its scan is "
                f"{known[0]}x{known[1]}; take both with the same settings"
            )


def _numbered_as(views: BoardViews, scan: Scan) -> BoardViews:
    place = [scan.cameras.index(name) for name in views.cameras]
    moved = tuple(replace(view, camera=place[view.camera]) for view in views.views)
    return BoardViews(scan.cameras, scan.sizes, views.frames, moved)


def anchored(alone: Refinement, board: spec.Board, seen: SeenBoards) -> tuple[Problem, BoardUse]:
    """The scan's problem at its optimum joined with the board, in metres where that tells them.

    Raises ValueError where the views cannot be placed before the rig.
    """
    problem = replace(alone.problem, initial=alone.estimate)
    in_scan, missed = of_placed_frames(seen.in_scan, problem)
    known = board.corners_m, board.symmetries
    inside = place_boards(problem.initial, in_scan.views, *known)
    apart = place_boards(problem.initial, seen.apart.views if seen.apart else (), *known)
    scale = apart.scale or inside.scale
    still = still_board(problem.initial, inside.frames, *known, scale)
    scale = scale or (still.scale if still else None)
    if scale is not None and not problem.metric:
        problem = replace(problem, initial=problem.initial.scaled(scale))
    if still is not None:
        corners = corners_of_frames(still.frames, [one.frame for one in still.frames])
        problem = standing_in(problem, graph_board(board), corners, still.world_from_board)
    elif inside.frames:
        problem = beside(problem, in_own_worlds(problem, board, inside.frames, in_scan.frames))
    if seen.apart is not None and apart.frames:
        problem = beside(problem, in_own_worlds(problem, board, apart.frames, seen.apart.frames))
    used = [(inside, in_scan), (apart, seen.apart)]
    said = [
        (start, given, views)
        for placed, views in used
        if views is not None
        for start, given in placed.starts
    ]
    where: Literal["", "still", "waved"] = "still" if still else "waved" if inside.frames else ""
    return problem, BoardUse(
        board,
        (*missed, *(line for each in said for line in left_out(*each))),
        tuple(line for each in said for line in repeated(*each, board)),
        where,
    )


def of_placed_frames(views: BoardViews, problem: Problem) -> tuple[BoardViews, tuple[str, ...]]:
    """Views of a scan numbered by the frames of its problem, and those of frames it has not."""
    place = {name: index for index, name in enumerate(problem.frame_names)}
    kept, missed = [], []
    for view in views.views:
        name = views.frames[view.frame]
        if name in place:
            kept.append(replace(view, frame=place[name]))
        else:
            missed.append(f"{views.cameras[view.camera]}/{name}: the scan has no place for it")
    found = BoardViews(views.cameras, views.sizes, problem.frame_names, tuple(kept))
    return found, tuple(missed)


def corners_of_frames(placed: Sequence[PlacedFrame], frames: Sequence[int]) -> SeenCorners:
    """All corners of placed frames; `frames`: the problem's frame of each."""
    return seen_corners(
        [view for one in placed for view in one.views],
        [corner for one in placed for corner in one.corners],
        [frame for one, frame in zip(placed, frames, strict=True) for _ in one.views],
    )


def in_own_worlds(
    scan: Problem, board: spec.Board, placed: Sequence[PlacedFrame], names: Sequence[str]
) -> Problem:
    """The problem of a board before the scan's rig, a world of its own in each frame.

    Views that no common frame links are frames of their own, though of one name.
    """
    return board_problem(
        graph_board(board),
        corners_of_frames(placed, range(len(placed))),
        scan.initial.cameras,
        scan.initial.cam_from_rig,
        [one.rig_from_board for one in placed],
        [OWN_FRAME + names[one.frame] for one in placed],
        scan.reference,
    )

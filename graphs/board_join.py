"""Where a board was, in the views of a rig that a scan already knows; and whether it moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphs.board_rig import turns_of
from graphs.board_start import BoardScene, BoardStart, start_from_board
from graphs.frames import FloatArray, Transform, angle_between, median_rotation
from graphs.planar import SeenBoard
from graphs.problem import Estimate, IntArray

# Places of a board that stood still, by a scan's own frames: within 1 deg and 1 % of its distance
# in simulated scans; of one that is waved, tens of degrees apart.
STILL_DEG, STILL_SHARE = 5.0, 0.1
FEWEST_STILL = 2  # frames; one shows nothing
# Of the rig's way past a board, by which its scale is told, what the way leaves of how the board's
# places differ (rms): 0.005 in simulated scans past one that stands, 5 to 30 of one carried along.
MOST_UNTOLD = 0.2


@dataclass(frozen=True)
class PlacedFrame:
    """The board as one frame's views have it."""

    frame: int
    rig_from_board: Transform  # in the board's unit
    views: tuple[SeenBoard, ...]
    corners: tuple[IntArray, ...]  # of each view, renumbered where it was


@dataclass(frozen=True)
class PlacedBoards:
    """All views of a board that could be placed before a rig."""

    frames: tuple[PlacedFrame, ...]
    scale: float | None  # board's units in one of the rig's; None: no two cameras saw it at once
    starts: tuple[tuple[BoardStart, tuple[SeenBoard, ...]], ...]  # each with the views given to it


@dataclass(frozen=True)
class StillBoard:
    """A board that stood in one place while a scan went by."""

    world_from_board: Transform  # in the board's unit
    scale: float  # board's units in one of the scan's
    frames: tuple[PlacedFrame, ...]  # numbered alike


def place_boards(
    rig: Estimate,
    views: Sequence[SeenBoard],
    corners_m: FloatArray,
    symmetries: Sequence[IntArray],
) -> PlacedBoards:
    """Place the board of each frame before a rig, whose lenses and rotations are as they are.

    Cameras that see the board at once, directly or through others, are placed together; their
    distances give the scale. Raises ValueError where a camera's views cannot be used.
    """
    parts = []
    for cameras in _seeing_together(views, len(rig.cameras)):
        own = tuple(view for view in views if view.camera in cameras)
        scene = BoardScene(
            [_Renumbered(view, cameras.index(view.camera)) for view in own],
            corners_m,
            [rig.cameras[camera].name for camera in cameras],
            [rig.cameras[camera].size for camera in cameras],
            symmetries,
            known={place: rig.cameras[camera] for place, camera in enumerate(cameras)},
        )
        parts.append((cameras, start_from_board(scene), own))
    scale = _scale(rig, [(cameras, start) for cameras, start, _ in parts])
    frames = [
        placed
        for cameras, start, own in parts
        for placed in _frames(rig.scaled(scale or 1.0), cameras[0], start, own)
    ]
    return PlacedBoards(
        tuple(sorted(frames, key=lambda placed: placed.frame)),
        scale,
        tuple((start, own) for _, start, own in parts),
    )


class _Renumbered:
    """A view whose camera has another number."""

    def __init__(self, view: SeenBoard, camera: int) -> None:
        self.camera, self.frame = camera, view.frame
        self.corner, self.pixels, self.sigma_px = view.corner, view.pixels, view.sigma_px


def _seeing_together(views: Sequence[SeenBoard], n_cameras: int) -> list[list[int]]:
    """Cameras (indices, ascending) in groups that share frames, directly or through others."""
    group = list(range(n_cameras))
    for frame in {view.frame for view in views}:
        cameras = sorted({view.camera for view in views if view.frame == frame})
        for camera in cameras[1:]:
            old, new = group[camera], group[cameras[0]]
            group = [new if one == old else one for one in group]
    seeing = {view.camera for view in views}
    return [
        [camera for camera in range(n_cameras) if group[camera] == number and camera in seeing]
        for number in dict.fromkeys(group[camera] for camera in sorted(seeing))
    ]


def _scale(rig: Estimate, parts: Sequence[tuple[list[int], BoardStart]]) -> float | None:
    """What the rig's distances have to be multiplied by to be the board's; the longest count."""
    theirs, ours = 0.0, 0.0
    for cameras, start in parts:
        for a, camera_a in enumerate(cameras):
            for b, camera_b in list(enumerate(cameras))[a + 1 :]:
                theirs += _apart(start.cam_from_rig[a], start.cam_from_rig[b])
                ours += _apart(rig.cam_from_rig[camera_a], rig.cam_from_rig[camera_b])
    return theirs / ours if ours > 0 and theirs > 0 else None


def _apart(a_from_rig: Transform, b_from_rig: Transform) -> float:
    between = a_from_rig.inverse.translation - b_from_rig.inverse.translation
    return float(np.linalg.norm(between))


def _frames(
    rig: Estimate, first: int, start: BoardStart, views: Sequence[SeenBoard]
) -> list[PlacedFrame]:
    rig_from_first = rig.cam_from_rig[first].inverse
    found = []
    for frame, first_from_board in start.rig_from_board.items():
        kept = [index for index in start.kept if views[index].frame == frame]
        found.append(
            PlacedFrame(
                frame,
                rig_from_first @ first_from_board,
                tuple(views[index] for index in kept),
                tuple(start.corner[index] for index in kept),
            )
        )
    return found


def still_board(
    scan: Estimate,
    placed: Sequence[PlacedFrame],
    corners_m: FloatArray,
    symmetries: Sequence[IntArray],
    scale: float | None,
) -> StillBoard | None:
    """The one place of a board in a scan's world, or None where its frames have it in several.

    placed: by frames of the scan. scale: as `PlacedBoards` has it; None: the scan's own way past
    the board tells it.
    """
    if len(placed) < FEWEST_STILL:
        return None
    numbers = [np.arange(len(corners_m)), *symmetries]
    turns = turns_of(corners_m, symmetries)
    aligned: list[tuple[PlacedFrame, FloatArray]] = []
    for one in placed:
        world_from_rig = scan.rig_from_world[one.frame].rotation.T
        rotations = [
            world_from_rig @ (one.rig_from_board @ turns.one(i).inverse).rotation
            for i in range(len(numbers))
        ]
        first = aligned[0][1] if aligned else rotations[0]
        best = int(np.argmin([angle_between(first, rotation) for rotation in rotations]))
        renumbered = PlacedFrame(
            one.frame,
            one.rig_from_board @ turns.one(best).inverse,
            one.views,
            tuple(numbers[best][corner] for corner in one.corners),
        )
        aligned.append((renumbered, rotations[best]))
    rotations = [rotation for _, rotation in aligned]
    rotation = median_rotation(np.array(rotations))
    off_deg = np.degrees([angle_between(rotation, one) for one in rotations])
    if not np.median(off_deg) < STILL_DEG or not off_deg.max() < 4 * STILL_DEG:
        return None
    frames = tuple(one for one, _ in aligned)
    place, scale, off = _one_place(scan, frames, scale)
    if not (scale > 0 and off < STILL_SHARE):
        return None
    return StillBoard(Transform(rotation, place), scale, frames)


def _one_place(
    scan: Estimate, placed: Sequence[PlacedFrame], scale: float | None
) -> tuple[FloatArray, float, float]:
    """Where the board stands (3,), the scale (0: none), and how far frames have it elsewhere (a
    median, of its distance): place - scale * centre = offset, in least squares."""
    centres = np.array([scan.rig_from_world[one.frame].inverse.translation for one in placed])
    offsets = np.array(
        [
            scan.rig_from_world[one.frame].rotation.T @ one.rig_from_board.translation
            for one in placed
        ]
    )
    if scale is None:
        of_centres, of_offsets = centres - centres.mean(0), offsets - offsets.mean(0)
        spread = float((of_centres**2).sum())
        scale = -float((of_centres * of_offsets).sum()) / spread if spread > 0 else 0.0
        untold = float(((of_offsets + scale * of_centres) ** 2).sum())
        if untold > MOST_UNTOLD**2 * scale**2 * spread:
            scale = 0.0
    places = offsets + scale * centres
    place = np.median(places, axis=0)
    distance = np.linalg.norm(offsets, axis=1)
    return place, scale, float(np.median(np.linalg.norm(places - place, axis=1) / distance))

"""When is a flat board seen from the wrong side of its line of sight, and what resolves it?

Two tilts explain a view of a flat board, one the other's mirror image through the plane across the
line of sight; only the depth's slight effect tells them apart. Method: views of a square board at a
distance in its sides, tilted, by a known camera; `graphs.planar` finds both solutions. Counted is
how often the answer is nearer to the mirror image than to the truth: of the one with the least rms
(`lone`); of a sequence of frames in which the tilt turns slowly round, judged together
(`sequence`); of two cameras that see the board at once from `apart_deg` apart, where the rig is
known (`known_rig`) and where it is not, as `sfm-calib target` starts, by votes of the frames
(`votes`; `half_turns`: of a board that looks the same upside down, numbered at random); and of what
`target` does with a lone camera (`target`): it leaves views out that both tilts explain.
Expectation: the second solution's squared error exceeds the first's by D^2 in noise variances, so
that a lone view is wrong with a chance of Phi(-D / 2), where to second order in size over distance
D = 2 w^2 sin(tilt) sqrt(sum over corners of cos(tilt)^2 (a^2)'^2 + (ab)'^2) / (focal sigma): w the
board's side in px, a and b a corner's place across and along the tilt's axis in sides, ' less its
best affine fit. And a second camera 15 degrees away leaves none in a hundred wrong.
Source: of two minima: Schweighofer and Pinz, PAMI 2006; Collins and Bartoli, IJCV 2014. D is what
follows from them for Gaussian noise.
Run: sfm-calib run configs/studies/planar_pose.yaml -o out/planar_pose
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.stats import norm

from experiments.planar_pose_answer import answered
from experiments.runner.protocol import Answer, Finished, Row, Study, TrialOptions
from graphs.board_frames import SeenFrames, resolve_frames
from graphs.board_rig import Candidates, turns_of
from graphs.board_start import BoardScene, start_from_board
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.planar import Transforms, angles_between, gather, solve_views, turned_over
from graphs.problem import IntArray
from sfm_calib.boards.spec import Board, Charuco, Checkerboard
from sfm_calib.boards.views import BoardView
from sfm_calib.simulate.board_views import corners_seen
from sfm_calib.simulate.rigs import SimulatedRig

SIDE_M = 0.2
SIZE = (1280, 960)
TURN_DEG = 5.0  # of the tilt's axis from frame to frame of a sequence
How = Literal["lone", "sequence", "known_rig", "votes", "half_turns", "target"]


class PlanarOptions(TrialOptions):
    """Views of one board that differ in the directions they are tilted in."""

    how: How = "lone"
    """By what a view's tilt is chosen."""
    distance: Annotated[float, Field(ge=1, le=1000)] = 25.0
    """Of the board, in its sides."""
    tilt_deg: Annotated[float, Field(gt=0, lt=85)] = 30.0
    """Between the board's normal and the line of sight."""
    noise_px: Annotated[float, Field(gt=0, le=10)] = 0.3
    """Of the corners."""
    focal_px: Annotated[float, Field(ge=100, le=100_000)] = 600.0
    """Of the camera."""
    corners: Annotated[int, Field(ge=3, le=19)] = 7
    """In a row and in a column."""
    apart_deg: Annotated[float, Field(ge=0, le=90)] = 15.0
    """Between the lines of sight of two cameras."""
    frames: Annotated[int, Field(ge=1, le=100)] = 5
    """Of a sequence."""
    roam_deg: Annotated[float, Field(ge=0, le=20)] = 8.0
    """How far the board's middle is off the first camera's axis, at most."""
    views: Annotated[int, Field(ge=10, le=10_000)] = 200
    """Of each camera, in one trial."""


@dataclass(frozen=True)
class Seen:
    """Views of a board, and the truth of each."""

    rig: SimulatedRig
    board: Board
    views: tuple[BoardView, ...]
    cam_from_board: Transforms  # (n_views,)


@dataclass(frozen=True)
class Chosen:
    """Of each view that was used, where the board is, and how many views were not."""

    views: IntArray  # (n,) indices into Seen.views
    cam_from_board: Transforms  # (n,)
    n_left_out: int = 0
    n_misnumbered: int = 0
    guessed: bool = False  # where the second camera stands, and it was said so


# ---- what is seen --------------------------------------------------------------------------


def trial(options: PlanarOptions, seed: int) -> Row:
    """See the board, choose, and count what is wrong."""
    rng = np.random.default_rng([seed, 0])
    seen = simulated(options, rng)
    chosen = CHOOSE[options.how](seen, options, rng)
    corners = gather(seen.views, seen.board.corners_m)
    flipped = turned_over(corners, seen.cam_from_board)[chosen.views]
    found, truth = chosen.cam_from_board.rotation, seen.cam_from_board[chosen.views].rotation
    off = angles_between(found, truth)
    wrong = angles_between(found, flipped.rotation) < off
    distances = np.array([
        predicted_distance(seen.board.corners_m[view.corner, :2], seen.cam_from_board.one(index),
                           options)
        for index, view in enumerate(seen.views)
    ])[chosen.views]  # fmt: skip
    together = options.frames if options.how == "sequence" else 1
    return {
        "n_views": len(seen.views),
        "n_used": len(chosen.views),
        "n_wrong": int(wrong.sum()),
        "n_left_out": chosen.n_left_out,
        "n_misnumbered": chosen.n_misnumbered,
        "guessed": chosen.guessed,
        "predicted_wrong": float(norm.cdf(-np.sqrt(together) * distances / 2).mean()),
        "error_deg": float(np.degrees(np.sqrt((off**2).mean()))) if off.size else None,
    }


def simulated(options: PlanarOptions, rng: np.random.Generator) -> Seen:
    """Views by one camera, or two; those of a sequence follow each other."""
    board = board_of(options)
    middle = board.corners_m.mean(0)
    place = np.array([0.0, 0.0, options.distance * SIDE_M])
    placed = [
        Transform(sight @ turn, sight @ place - sight @ turn @ middle)
        for sight, turn in zip(sights(options, rng), turns(options, rng), strict=True)
    ]
    rig = rig_of(options, place)
    views = corners_seen(rig, placed, board.corners_m, options.noise_px, rng)
    truth = Transforms.of([rig.cam_from_rig[v.camera] @ placed[v.frame] for v in views])
    return Seen(rig, board, views, truth)


def sights(options: PlanarOptions, rng: np.random.Generator) -> list[FloatArray]:
    """Rotations (3, 3) from the camera's axis to where the board is."""
    off = np.radians(options.roam_deg) * np.sqrt(rng.uniform(size=options.views))
    to = rng.uniform(0, 2 * np.pi, options.views)
    return [
        exp_rotation(r * np.array([np.cos(a), np.sin(a), 0.0]))
        for r, a in zip(off, to, strict=True)
    ]


def turns(options: PlanarOptions, rng: np.random.Generator) -> list[FloatArray]:
    """Rotations (3, 3) of the board, all tilted alike, about other axes."""
    count = options.views
    about, spin = rng.uniform(0, 2 * np.pi, (2, count))
    if options.how == "sequence":
        first = np.arange(count) // options.frames * options.frames
        spin = spin[first]
        about = about[first] + np.radians(TURN_DEG) * (np.arange(count) - first)
    tilt = np.radians(options.tilt_deg)
    return [
        exp_rotation(tilt * np.array([np.cos(a), np.sin(a), 0.0]))
        @ exp_rotation(np.array([0.0, 0.0, s]))
        for a, s in zip(about, spin, strict=True)
    ]


def board_of(options: PlanarOptions) -> Board:
    """A square board that looks different from all sides, or but for half turns."""
    count, square_m = options.corners, SIDE_M / (options.corners - 1)
    if options.how == "half_turns":
        return Checkerboard(inner_corners=(count, count), square_m=square_m)
    return Charuco(
        squares=(count + 1, count + 1), square_m=square_m, marker_m=0.7 * square_m,
        dictionary="DICT_4X4_250",
    )  # fmt: skip


def rig_of(options: PlanarOptions, place: FloatArray) -> SimulatedRig:
    """One camera that looks at a place (3,), or a second one beside it that does so too."""
    centre = (np.array(SIZE) - 1) / 2
    params = np.array([options.focal_px, options.focal_px, *centre])
    count = 2 if options.how in ("known_rig", "votes", "half_turns") else 1
    turn = exp_rotation(np.array([0.0, np.radians(options.apart_deg), 0.0]))
    beside = Transform(turn, place - turn @ place)
    cameras = tuple(Camera(f"cam{index}", "pinhole", SIZE, params) for index in range(count))
    return SimulatedRig(cameras, (Transform.identity(), beside)[:count])


def predicted_distance(
    flat: FloatArray, cam_from_board: Transform, options: PlanarOptions
) -> float:
    """D, between the two solutions' pixels in sigmas, of corners (n, 2)."""
    middle = cam_from_board @ np.append(flat.mean(0), 0.0)
    away = float(np.linalg.norm(middle))
    depth = cam_from_board.rotation.T @ (middle / away)  # in the board's frame
    sine = float(np.linalg.norm(depth[:2]))
    along = depth[:2] / sine
    off = (flat - flat.mean(0)) / SIDE_M
    a, b = off @ along, off @ np.array([-along[1], along[0]])
    curved = np.stack([np.sqrt(1 - sine**2) * a * a, a * b], axis=1)
    affine = np.stack([np.ones(len(a)), a, b], axis=1)
    left = curved - affine @ np.linalg.lstsq(affine, curved)[0]
    side_px = options.focal_px * SIDE_M / away
    scale = 2 * side_px**2 * sine / (options.focal_px * options.noise_px)
    return float(scale * np.linalg.norm(left))


# ---- what chooses --------------------------------------------------------------------------


def by_rms(seen: Seen, options: PlanarOptions, rng: np.random.Generator) -> Chosen:
    """The solution with the least rms, each view alone."""
    both = solve_views(seen.rig.cameras, gather(seen.views, seen.board.corners_m))
    return Chosen(np.arange(len(seen.views)), both.first)


def by_sequence(seen: Seen, options: PlanarOptions, rng: np.random.Generator) -> Chosen:
    """Of two chains of solutions, each the nearest to the one before, the one with least rms."""
    both = solve_views(seen.rig.cameras, gather(seen.views, seen.board.corners_m))
    rotations = np.stack([both.first.rotation, both.second.rotation])  # (2, n, 3, 3)
    squares = np.stack([both.first_rms_px, both.second_rms_px]) ** 2
    pick = np.zeros(len(seen.views), dtype=np.int64)
    for begin in range(0, len(seen.views), options.frames):
        chains = []
        for start in (0, 1):
            chain = [start]
            for view in range(begin + 1, min(begin + options.frames, len(seen.views))):
                before = rotations[chain[-1], view - 1]
                chain.append(int(angles_between(rotations[:, view], before).argmin()))
            total = squares[chain, np.arange(begin, begin + len(chain))].sum()
            chains.append((total, chain))
        pick[begin : begin + len(chains[0][1])] = min(chains)[1]
    return Chosen(np.arange(len(seen.views)), both.second.where(pick == 1, both.first))


def by_known_rig(seen: Seen, options: PlanarOptions, rng: np.random.Generator) -> Chosen:
    """One board for both cameras of a frame, where the rig is known."""
    corners = gather(seen.views, seen.board.corners_m)
    both = solve_views(seen.rig.cameras, corners)
    alone = turns_of(seen.board.corners_m, ())
    frame = np.array([view.frame for view in seen.views])
    frames = SeenFrames(seen.rig.cameras, corners, frame, Candidates.of(both, alone), alone)
    placed = resolve_frames(frames, seen.rig.cam_from_rig, 0)
    of_view = placed.rig_from_board[np.searchsorted(placed.frames, frame)]
    camera = np.array([view.camera for view in seen.views])
    return Chosen(np.arange(len(seen.views)), placed.cam_from_rig[camera] @ of_view)


def by_target(seen: Seen, options: PlanarOptions, rng: np.random.Generator) -> Chosen:
    """As `sfm-calib target` starts, but that the lenses are known."""
    views = list(seen.views)
    if seen.board.symmetries:
        views = [_numbered_at_random(view, seen.board, rng) for view in views]
    cameras = seen.rig.cameras
    start = start_from_board(
        BoardScene(
            views, seen.board.corners_m, [c.name for c in cameras], [c.size for c in cameras],
            seen.board.symmetries, known=dict(enumerate(cameras)),
        )
    )  # fmt: skip
    kept = np.array(start.kept, dtype=np.int64)
    found = Transforms.of([
        start.cam_from_rig[views[i].camera] @ start.rig_from_board[views[i].frame] for i in kept
    ])  # fmt: skip
    # A symmetric board may be turned, as long as all of a frame's views have it so.
    turned = np.array([_turned_by(seen.views[i].corner, start.corner[i], seen.board) for i in kept])
    upright = found @ turns_of(seen.board.corners_m, seen.board.symmetries)[turned]
    frame = np.array([views[i].frame for i in kept])
    misnumbered = sum(
        int((frame == each).sum() - np.bincount(turned[frame == each]).max())
        for each in np.unique(frame)
    )
    guessed = any(link.ambiguous for link in start.links)
    return Chosen(kept, upright, len(start.dropped), misnumbered, guessed)


def _turned_by(true: IntArray, found: IntArray, board: Board) -> int:
    """Which of the board's symmetries takes one numbering (n,) to another; 0: the identity."""
    ways = [true, *(symmetry[true] for symmetry in board.symmetries)]
    return next(index for index, way in enumerate(ways) if np.array_equal(way, found))


def _numbered_at_random(view: BoardView, board: Board, rng: np.random.Generator) -> BoardView:
    """A view of the second camera, numbered from any end of the board."""
    which = int(rng.integers(len(board.symmetries) + 1))
    if view.camera == 0 or which == 0:
        return view
    return replace(view, corner=board.symmetries[which - 1][view.corner])


CHOOSE = {
    "lone": by_rms,
    "sequence": by_sequence,
    "known_rig": by_known_rig,
    "votes": by_target,
    "half_turns": by_target,
    "target": by_target,
}


def answer(trials: Sequence[Finished[PlanarOptions]]) -> Answer:
    """How often each way is wrong."""
    return answered(trials, PlanarOptions())


STUDY = Study(PlanarOptions, trial, answer)

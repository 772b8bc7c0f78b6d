"""One place of the board in each frame of a rig, and the views that contradict it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.board_rig import AGREEING, FARTHEST, TIMES_MEDIAN, Candidates, distances
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.lenses import IntArray
from graphs.planar import Corners, Scene, Transforms, fit

# Boards and cameras are placed in turn; each round about halves what is left of the error.
ROUNDS, PASSES = 4, 2
FIT_ITERATIONS = 5
OUTLYING = 3.0  # times the median rms: a view's weight falls to a quarter there
# A view so much worse than the rig's median was taken at another time, or its corners are wrong.
ODD_TIMES, ODD_WIDTHS = 6.0, 0.003  # the latter of the image width


@dataclass(frozen=True)
class RigFrames:
    """The rig and its boards from all views together."""

    cam_from_rig: Transforms  # (n_cameras,)
    rig_from_board: Transforms  # (n_frames,) by `frames`
    frames: IntArray  # (n_frames,) ascending
    renumbering: IntArray  # (n_views,) index into the symmetries; 0: as numbered
    rms_px: FloatArray  # (n_views,) with one board a frame
    odd: NDArray[np.bool_]  # (n_views,) contradict the rest


@dataclass(frozen=True)
class SeenFrames:
    """Views of a board by frame, and all that they may mean."""

    cameras: Sequence[Camera]
    corners: Corners
    frame: IntArray  # (n_views,)
    candidates: Candidates
    turns: Transforms  # (n_symmetries + 1,) renumbered_from_board, the identity first

    def of_pair(self, first: IntArray, second: IntArray) -> SeenFrames:
        """Only these views of two cameras, which become cameras 0 and 1."""
        views = np.concatenate([first, second])
        corners = self.corners.of_views(views)
        cameras = [self.cameras[int(self.corners.camera[own[0]])] for own in (first, second)]
        camera = np.repeat([0, 1], [len(first), len(second)])
        return SeenFrames(
            cameras,
            replace(corners, camera=camera),
            self.frame[views],
            self.candidates[views],
            self.turns,
        )


def resolve_frames(
    seen_frames: SeenFrames, cam_from_rig: Sequence[Transform], reference: int
) -> RigFrames:
    """Choose what each view means, then place boards and cameras in turn."""
    cameras, corners = seen_frames.cameras, seen_frames.corners
    candidates, frame = seen_frames.candidates, seen_frames.frame
    rig = Transforms.of(cam_from_rig)
    frames, group = np.unique(frame, return_inverse=True)
    for _ in range(PASSES if len(cameras) > 1 else 1):
        boards, chosen, apart = _choose(rig, corners, group, candidates)
        renumbering = candidates.renumbering[chosen]
        board = _renumbered(corners.board, seen_frames.turns[renumbering[corners.view]])
        seen = _Seen(cameras, replace(corners, board=board), group)
        rig, boards, rms = _settle(seen, rig, boards, _trusted(apart), reference)
    widths = np.array([camera.size[0] for camera in cameras])[corners.camera]
    most = np.maximum(ODD_WIDTHS * widths, ODD_TIMES * float(np.median(rms)))
    boards, rms, odd = _without_odd(seen, rig, boards, rms, most)
    return RigFrames(rig, boards, frames, renumbering, rms, odd)


def _renumbered(board: FloatArray, turns: Transforms) -> FloatArray:
    """Corners (n, 3) turned by each row's own symmetry (n,)."""
    turned = np.einsum("nij,nj->ni", turns.rotation, board)
    result: FloatArray = turned + turns.translation
    return result


@dataclass(frozen=True)
class _Seen:
    cameras: Sequence[Camera]
    corners: Corners  # of the boards as renumbered
    group: IntArray  # (n_views,) place of each view's frame


def _trusted(apart: FloatArray) -> NDArray[np.bool_]:
    """Views (n_views,) near enough to where their frame's other views have the board."""
    typical = float(np.median(apart[apart > 0])) if np.any(apart > 0) else 0.0
    return apart < min(max(AGREEING, TIMES_MEDIAN * typical), FARTHEST)


def _settle(
    seen: _Seen, rig: Transforms, boards: Transforms, trusted: NDArray[np.bool_], reference: int
) -> tuple[Transforms, Transforms, FloatArray]:
    """Cameras, boards and the rms of all views, boards and cameras placed in turn."""
    boards, rms = _place_boards(seen, rig, boards, trusted.astype(np.float64))
    for _ in range(ROUNDS if len(seen.cameras) > 1 else 0):
        weight = np.where(trusted, _view_weights(rms, trusted), 0.0)
        rig, boards = _place_cameras(seen, rig, boards, weight, reference)
        boards, rms = _place_boards(seen, rig, boards, weight)
    return rig, boards, rms


def _without_odd(
    seen: _Seen, rig: Transforms, boards: Transforms, rms: FloatArray, most: FloatArray
) -> tuple[Transforms, FloatArray, NDArray[np.bool_]]:
    """Boards and rms without the views whose removal lets the rest of their frame agree."""
    odd = np.zeros(len(rms), dtype=bool)
    rotation, translation, rms = boards.rotation.copy(), boards.translation.copy(), rms.copy()
    for number in np.unique(seen.group[rms > most]):
        views = np.flatnonzero(seen.group == number)
        part = _Seen(seen.cameras, seen.corners.of_views(views), np.zeros(len(views), np.int64))
        board, kept = boards[number : number + 1], np.ones(len(views), dtype=bool)
        error = rms[views]
        while kept.sum() > 1 and np.any(error[kept] > most[views][kept]):
            board, kept, error = _one_fewer(part, rig, board, kept, most[views])
        rotation[number], translation[number] = board.rotation[0], board.translation[0]
        odd[views], rms[views] = ~kept, error
    return Transforms(rotation, translation), rms, odd


def _one_fewer(
    part: _Seen, rig: Transforms, board: Transforms, kept: NDArray[np.bool_], most: FloatArray
) -> tuple[Transforms, NDArray[np.bool_], FloatArray]:
    """One frame without the view whose removal helps most; among equals that of fewest corners."""
    tried = []
    for view in np.flatnonzero(kept):
        rest = kept.copy()
        rest[view] = False
        placed, rms = _place_boards(part, rig, board, rest.astype(np.float64))
        wrong = int((rms[rest] > most[rest]).sum())
        tried.append(
            ((wrong, int(part.corners.counts[view]), float(rms[rest].max())), view, placed, rms)
        )
    _, view, placed, rms = min(tried, key=lambda each: each[0])
    rest = kept.copy()
    rest[view] = False
    return placed, rest, rms


def _view_weights(rms: FloatArray, trusted: NDArray[np.bool_]) -> FloatArray:
    typical = max(float(np.median(rms[trusted])), 1e-6)
    weight: FloatArray = 1 / (1 + (rms / (OUTLYING * typical)) ** 2) ** 2
    return weight


def _choose(
    rig: Transforms, corners: Corners, group: IntArray, candidates: Candidates
) -> tuple[Transforms, IntArray, FloatArray]:
    """rig_from_board of each frame, the candidate of each view, and its distance from it.

    Each view proposes where the board is, numbered as it has it; the proposal wins to which the
    candidates of all views of the frame are nearest. Among equals the view with most corners.
    """
    cam = rig[corners.camera]
    back = Transforms(cam.rotation[:, None], cam.translation[:, None]).inverse
    proposals = back @ candidates.transforms  # rig_from_board (n_views, k)
    depth = np.linalg.norm(candidates.transforms.translation, axis=-1)
    as_numbered = candidates.renumbering == 0
    chosen, apart = np.zeros(len(group), dtype=np.int64), np.zeros(len(group))
    boards: list[Transform] = []
    for number in range(int(group.max()) + 1):
        views = np.flatnonzero(group == number)
        views = views[np.argsort(-corners.counts[views], kind="stable")]
        which, k = np.nonzero(candidates.valid[views] & as_numbered)
        tried = proposals[views[which], k]
        every = Transforms(
            proposals.rotation[views][None], proposals.translation[views][None]
        )  # (1, v, k)
        each = Transforms(tried.rotation[:, None, None], tried.translation[:, None, None])
        far = distances(every, each, depth[views][None])
        far = np.where(candidates.valid[views][None], far, np.inf)
        cost = np.minimum(far.min(2), FARTHEST).sum(1)
        preference = candidates.cost[k]
        best = np.lexsort([np.arange(len(k)), preference, cost.round(6)])[0]
        boards.append(tried.one(int(best)))
        chosen[views], apart[views] = far[best].argmin(1), far[best].min(1)
    return Transforms.of(boards), chosen, apart


def _place_boards(
    seen: _Seen, rig: Transforms, boards: Transforms, weight: FloatArray
) -> tuple[Transforms, FloatArray]:
    """rig_from_board of each frame with the cameras held, and the rms of all views."""
    corners = seen.corners
    scene = Scene(
        seen.cameras, corners.weighted(weight), corners.board, seen.group, rig[corners.camera]
    )
    placed, _ = fit(scene, boards, FIT_ITERATIONS)
    return placed, fit(replace(scene, corners=corners), placed, 0)[1]


def _place_cameras(
    seen: _Seen, rig: Transforms, boards: Transforms, weight: FloatArray, reference: int
) -> tuple[Transforms, Transforms]:
    """cam_from_rig of each camera with the boards held, and both seen from the reference."""
    corners = seen.corners
    at = boards[seen.group[corners.view]]
    points = np.einsum("nij,nj->ni", at.rotation, corners.board) + at.translation
    alone = Transforms.identities(len(seen.group))
    scene = Scene(seen.cameras, corners.weighted(weight), points, corners.camera, alone)
    placed, _ = fit(scene, rig, FIT_ITERATIONS)
    own = placed[reference : reference + 1]
    rig = placed @ own.inverse
    rig.rotation[reference], rig.translation[reference] = np.eye(3), 0.0  # to the last digit
    return rig, own @ boards

"""Where to start calibrating from views of one flat board: lenses, the rig, and the boards.

Nothing need be known but the board and the image sizes. Views that make no sense, or that another
place of the board explains as well, are left out, each with its reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphs.board_frames import RigFrames, SeenFrames, resolve_frames
from graphs.board_lens import LensChoice, LensStart, start_lens, views_of
from graphs.board_links import check_linked, links_between
from graphs.board_rig import Candidates, Link, chained, turns_of
from graphs.board_thin import thin
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.lenses import IntArray
from graphs.planar import (
    BothSolutions,
    Corners,
    SeenBoard,
    gather,
    homographies,
    solve_views,
)

DropKind = Literal["few", "line", "small", "misdetected", "oblique", "ambiguous", "disagrees"]
# A homography has 8 numbers: 6 corners leave 4 to tell whether they were detected rightly.
MIN_CORNERS = 6
ON_A_LINE = 0.02  # spread of corners across, relative to along
SMALLEST_SPREAD_PX = 3.0  # rms across the narrower side: neighbours are about 3 px apart
# Corners that no homography explains, relative to their spread. Shuffled ones are 0.98 off and
# more (of six corners, nine in ten more than 0.48), a board that fills a fisheye's 180 degrees
# is 0.24 off.
SCRAMBLED = 0.4
FAR_TIMES, FAR_PX, FAR_WIDTHS = 5.0, 1.0, 0.001  # times the camera's median, and at least that
STEEPEST_DEG = 80.0  # between line of sight and the board's normal; corners blur together there
# The second solution's squared error, in noise variances above the first's: less may be chance.
AMBIGUOUS_CHI2, AMBIGUOUS_RATIO, AMBIGUOUS_DEG = 25.0, 1.15, 15.0
ENOUGH_VIEWS = 5  # of a camera; with fewer left, ambiguous ones are better than none
LENS_VIEWS = 40  # diverse ones tell a lens as well as hundreds


@dataclass(frozen=True)
class BoardScene:
    """What was seen of one flat board, and what is known beforehand."""

    views: Sequence[SeenBoard]
    corners_m: FloatArray  # (n_corners, 3), z = 0
    names: Sequence[str]  # of the cameras
    sizes: Sequence[tuple[int, int]]  # width, height
    symmetries: Sequence[IntArray] = ()  # renumberings (n_corners,), closed under composition
    lens: LensChoice = "auto"  # of all cameras that are not known
    known: Mapping[int, Camera] | None = None
    reference: int = 0


@dataclass(frozen=True)
class DroppedView:
    """A view left out, and why."""

    view: int  # index into the views given
    kind: DropKind
    reason: str


@dataclass(frozen=True)
class BoardStart:
    """A value for everything that a board graph has; the board's frame is the world."""

    cameras: tuple[Camera, ...]
    cam_from_rig: tuple[Transform, ...]
    rig_from_board: dict[int, Transform]  # by frame, of frames with a kept view
    corner: tuple[IntArray, ...]  # (n,) of each view given, renumbered where it was
    kept: tuple[int, ...]  # indices of views
    dropped: tuple[DroppedView, ...]
    lenses: tuple[LensStart, ...]
    links: tuple[Link, ...]  # the tree from the reference
    rms_px: dict[int, float]  # of the corners' distances, by kept view

    @property
    def notes(self) -> tuple[str, ...]:
        """What is weak, in plain words."""
        weak = [
            f"the views hardly tell {each.camera.name}'s focal length (sigma "
            f"{100 * each.focal_sigma:.0f} %): tilt the board by 30 degrees and more"
            for each in self.lenses
            if each.weak
        ]
        return (*weak, *(self._link_note(each) for each in self.links if each.weak))

    def _link_note(self, each: Link) -> str:
        a, b = (self.cameras[camera].name for camera in each.cameras)
        frames = f"{each.agreeing} of {each.frames} shared frames"
        if each.ambiguous:
            return (
                f"where {b} stands beside {a} is a guess: another place fits {frames} as well; "
                "take more frames with the board tilted differently, or a board without symmetry"
            )
        return (
            f"where {b} stands beside {a} rests on {frames} alone: show both the board more often"
        )


def start_from_board(scene: BoardScene) -> BoardStart:
    """Everything to start from. Raises ValueError where a camera has no view or no link."""
    dropped = _unusable(scene)
    views = np.array([i for i in range(len(scene.views)) if i not in dropped], dtype=np.int64)
    if views.size:
        _drop_scrambled(scene, views, dropped)
    views = np.array([v for v in views if int(v) not in dropped], dtype=np.int64)
    _check_seen(scene, views, dropped)
    corners = gather([scene.views[v] for v in views], scene.corners_m)
    lenses = tuple(_lens(scene, corners, views, index) for index in range(len(scene.names)))
    cameras = tuple(each.camera for each in lenses)
    both = solve_views(cameras, corners)
    _drop_misdetected(cameras, corners, both, views, dropped)
    _drop_oblique(corners, both, views, dropped)
    good = np.array([i for i, v in enumerate(views) if int(v) not in dropped], dtype=np.int64)
    views, corners, both = views[good], corners.of_views(good), _of_views(both, good)
    _check_seen(scene, views, dropped)
    frame = np.array([scene.views[v].frame for v in views])
    turns = turns_of(scene.corners_m, scene.symmetries)
    seen = SeenFrames(cameras, corners, frame, Candidates.of(both, turns), turns)
    links = links_between(seen)
    found, used = chained(links, len(cameras), scene.reference)
    check_linked(scene.names, found, links, seen)
    rig = [found[index] for index in range(len(cameras))]
    resolved = resolve_frames(seen, rig, scene.reference)
    _drop_odd(resolved, views, dropped)
    _drop_ambiguous(resolved, corners, both, views, frame, dropped)
    return _assembled(scene, lenses, resolved, views, frame, used, dropped)


def _of_views(both: BothSolutions, keep: IntArray) -> BothSolutions:
    return BothSolutions(
        both.first[keep], both.first_rms_px[keep], both.second[keep], both.second_rms_px[keep]
    )


# ---- views that cannot be used ---------------------------------------------------------------


def _unusable(scene: BoardScene) -> dict[int, DroppedView]:
    """Views with too few corners, or corners on a line, or too small."""
    dropped: dict[int, DroppedView] = {}

    def drop(index: int, kind: DropKind, reason: str) -> None:
        dropped[index] = DroppedView(index, kind, reason)

    for index, view in enumerate(scene.views):
        count = len(view.corner)
        if count < MIN_CORNERS:
            drop(index, "few", f"only {count} corners (needs {MIN_CORNERS})")
            continue
        along, across = _spread(scene.corners_m[view.corner, :2])
        if across < ON_A_LINE * along:
            drop(index, "line", f"its {count} corners lie on one line of the board")
            continue
        narrow_px = _spread(view.pixels)[1]
        if narrow_px < SMALLEST_SPREAD_PX:
            drop(
                index,
                "small",
                f"the board is {narrow_px:.1f} px narrow in the image (rms of its {count} corners; "
                f"needs {SMALLEST_SPREAD_PX:.0f})",
            )
    return dropped


def _spread(points: FloatArray) -> tuple[float, float]:
    """Rms of points (n, 2) about their middle, along and across."""
    sizes = np.linalg.svd(points - points.mean(0), compute_uv=False) / np.sqrt(len(points))
    return float(sizes[0]), float(sizes[1])


def _drop_scrambled(scene: BoardScene, views: IntArray, dropped: dict[int, DroppedView]) -> None:
    """Drop views whose corners no homography comes near to: they would mislead the lens."""
    corners = gather([scene.views[v] for v in views], scene.corners_m)
    middle = corners.means(corners.pixels)
    off = corners.pixels - middle[corners.view]
    spread = np.sqrt(corners.means((off**2).sum(1)[:, None])[:, 0])
    at = np.concatenate([off / spread[corners.view, None], np.ones((len(off), 1))], axis=1)
    length = np.linalg.norm(at, axis=1, keepdims=True)
    found = homographies(corners, at / length)
    flat = corners.board[:, :2] - corners.means(corners.board[:, :2])[corners.view]
    size = np.sqrt(corners.means((flat**2).sum(1)[:, None])[:, 0] / 2)
    point = np.concatenate([flat / size[corners.view, None], np.ones((len(flat), 1))], axis=1)
    seen = np.einsum("nij,nj->ni", found[corners.view], point)
    depth = np.where(np.abs(seen[:, 2]) > 1e-6, seen[:, 2], 1e-6)
    error = np.minimum(np.linalg.norm(seen[:, :2] / depth[:, None] - at[:, :2], axis=1), 2.0)
    rms = np.sqrt(corners.means((error**2)[:, None])[:, 0])
    for place in np.flatnonzero(rms > SCRAMBLED):
        index = int(views[place])
        dropped[index] = DroppedView(
            index,
            "misdetected",
            f"its corners do not lie as on a flat board: {100 * rms[place]:.0f} % of the board's "
            f"size off (most {100 * SCRAMBLED:.0f} %)",
        )


def _drop_misdetected(
    cameras: Sequence[Camera],
    corners: Corners,
    both: BothSolutions,
    views: IntArray,
    dropped: dict[int, DroppedView],
) -> None:
    """Drop views that fit their camera far worse than its others do."""
    rms = both.first_rms_px
    for index, camera in enumerate(cameras):
        own = views_of(corners, index)
        median = float(np.median(rms[own]))
        most = max(FAR_TIMES * median, FAR_PX, FAR_WIDTHS * camera.size[0])
        for place in own[rms[own] > most]:
            _drop_at(
                dropped, views, place, "misdetected",
                f"its reprojection rms of {rms[place]:.1f} px is {rms[place] / median:.0f} times "
                f"the camera's median of {median:.2f} px: corners are wrong",
            )  # fmt: skip


def _drop_oblique(
    corners: Corners, both: BothSolutions, views: IntArray, dropped: dict[int, DroppedView]
) -> None:
    middle = corners.means(corners.board)
    rotation = both.first.rotation
    sight = np.einsum("vij,vj->vi", rotation, middle) + both.first.translation
    cosine = np.abs((sight * rotation[:, :, 2]).sum(1)) / np.linalg.norm(sight, axis=1)
    tilt_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    for place in np.flatnonzero(tilt_deg > STEEPEST_DEG):
        _drop_at(
            dropped, views, place, "oblique",
            f"the board is seen {tilt_deg[place]:.0f} degrees from its front (most "
            f"{STEEPEST_DEG:.0f})",
        )  # fmt: skip


def _drop_at(
    dropped: dict[int, DroppedView],
    views: IntArray,
    place: int | np.signedinteger,
    kind: DropKind,
    reason: str,
) -> None:
    index = int(views[place])
    dropped.setdefault(index, DroppedView(index, kind, reason))


def _drop_odd(resolved: RigFrames, views: IntArray, dropped: dict[int, DroppedView]) -> None:
    median = float(np.median(resolved.rms_px))
    for place in np.flatnonzero(resolved.odd):
        _drop_at(
            dropped, views, place, "disagrees",
            f"it is {resolved.rms_px[place]:.1f} px from where the rig's other cameras see the "
            f"board (median {median:.2f} px): not synchronised, or the board moved",
        )  # fmt: skip


def _drop_ambiguous(
    resolved: RigFrames,
    corners: Corners,
    both: BothSolutions,
    views: IntArray,
    frame: IntArray,
    dropped: dict[int, DroppedView],
) -> None:
    """Drop lone views of a frame that two tilts explain, while their camera has enough others."""
    ratio = both.second_rms_px / np.maximum(both.first_rms_px, 1e-9)
    freedom = np.maximum(2 * corners.counts - 6, 1)
    chance = np.maximum(AMBIGUOUS_RATIO, np.sqrt(1 + AMBIGUOUS_CHI2 / freedom))
    apart_deg = np.degrees(both.apart_rad)
    kept = ~resolved.odd
    _, group = np.unique(frame, return_inverse=True)
    lone = np.bincount(group, weights=kept)[group] == 1
    doubtful = kept & lone & (ratio < chance) & (apart_deg > AMBIGUOUS_DEG)
    for camera in np.unique(corners.camera):
        own = corners.camera == camera
        if (own & kept & ~doubtful).sum() < ENOUGH_VIEWS:
            continue
        for place in np.flatnonzero(own & doubtful):
            _drop_at(
                dropped, views, place, "ambiguous",
                f"two tilts of the board, {apart_deg[place]:.0f} degrees apart, explain it: rms "
                f"{both.first_rms_px[place]:.2f} and {both.second_rms_px[place]:.2f} px",
            )  # fmt: skip


# ---- cameras ---------------------------------------------------------------------------------


def _check_seen(scene: BoardScene, views: IntArray, dropped: dict[int, DroppedView]) -> None:
    usable = np.bincount([scene.views[v].camera for v in views], minlength=len(scene.names))
    for camera in np.flatnonzero(usable == 0):
        given = [i for i, view in enumerate(scene.views) if view.camera == camera]
        reasons = [dropped[i].reason for i in given if i in dropped]
        why = f", the first because {reasons[0]}" if reasons else ""
        raise ValueError(
            f"{scene.names[int(camera)]} has no usable view of the board: {len(given)} given, "
            f"{len(reasons)} dropped{why}"
        )


def _lens(scene: BoardScene, corners: Corners, views: IntArray, camera: int) -> LensStart:
    known = (scene.known or {}).get(camera)
    if known is not None:
        return LensStart(known, float("nan"), 0.0, False)
    own = views_of(corners, camera)
    seen = [scene.views[v] for v in views[own]]
    some = own[list(thin(seen, LENS_VIEWS, scene.corners_m, scene.sizes))]
    name, size = scene.names[camera], scene.sizes[camera]
    return start_lens(name, size, corners.of_views(some), scene.lens)


# ---- the result ------------------------------------------------------------------------------


def _assembled(
    scene: BoardScene,
    lenses: tuple[LensStart, ...],
    resolved: RigFrames,
    views: IntArray,
    frame: IntArray,
    links: list[Link],
    dropped: dict[int, DroppedView],
) -> BoardStart:
    corner = [view.corner for view in scene.views]
    for place, view in enumerate(views):
        which = int(resolved.renumbering[place])
        if which:
            corner[view] = scene.symmetries[which - 1][corner[view]]
    kept = [place for place, view in enumerate(views) if int(view) not in dropped]
    with_views = {int(frame[place]) for place in kept}
    return BoardStart(
        tuple(each.camera for each in lenses),
        tuple(resolved.cam_from_rig.one(i) for i in range(len(scene.names))),
        {
            int(f): resolved.rig_from_board.one(i)
            for i, f in enumerate(resolved.frames)
            if int(f) in with_views
        },
        tuple(corner),
        tuple(int(views[place]) for place in kept),
        tuple(dropped[index] for index in sorted(dropped)),
        lenses,
        tuple(links),
        {int(views[place]): float(resolved.rms_px[place]) for place in kept},
    )

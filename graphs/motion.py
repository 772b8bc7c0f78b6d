"""What the views of a scan are like: how they move and turn, and how deep the scene is.

Some motions leave a calibration open whatever the number of images; here they get their names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from graphs.boards import corners_of, shape_of
from graphs.frames import FloatArray
from graphs.problem import Problem, points_in_cameras
from graphs.selection import parallax_deg

# Points shift by 0.1 deg or less in nine of ten tracks of a simulated rig that stands still (pixel
# noise), by 1.8 deg where a rig turns about one of its cameras, by 7.5 deg or more in real ones.
NO_PARALLAX_DEG = 0.5
# A simulated panorama whose camera wanders by 2 cm (1.4 deg) could not be solved; by 5 cm (3.6 deg)
# it could.
LITTLE_PARALLAX_DEG = 2.0
# Real scans turn by 50 deg and more, the views of one that stands still by less than 0.1 deg.
NO_TURN_DEG = 3.0
# Of the squared distances between views, what lies along the optical axis: 0.999 in a simulated
# straight drive, 0.72 and 0.79 in real drives with a bend.
FORWARD_SHARE = 0.97
# Optical axes of parallel views: 0.2 and 1.9 deg apart (rms) in simulated ones, once solved; 28 deg
# and more in real scans.
PARALLEL_DEG = 5.0
# Depth of a scene off its plane, of its distance: 0.018 for a stone wall whose relief is 0.04 of
# it (curved into a bowl, as doming does), 0.06 for a facade with a fountain, 0.1 for streets.
FLAT_RELIEF = 0.03
HEAD_ON_DEG = 15.0  # between optical axes and a plane's normal: it shrinks by 3 % at most
# Spread of the views' places along an image axis, of the scene's distance: 0.003 to 0.013 in real
# scans from a tripod and from vehicles, 0.08 in a handheld one.
SAME_PLACE = 0.03
LEVEL_DEG = 10.0  # rms of the turns about the optical axis: 1 to 2 deg in real scans, 20 by hand
MOST_VIEWS = 200  # of a long scan, evenly spread, where all pairs of views count

Lack = Literal[
    "static rig",
    "pure rotation",
    "pure forward motion",
    "single plane seen head-on",
    "parallel views",
]


@dataclass(frozen=True)
class Views:
    """How one camera moved, turned, and what lay before it."""

    parallax_deg: float  # by its motion alone; nine of ten points are seen under less
    turn_deg: float  # greatest angle between any view and the mean one
    axes_deg: float  # rms angle of the optical axes from their mean
    roll_deg: float  # rms turn about the optical axis
    turn_axis: tuple[float, float, float]  # about which it turned most, in its own axes
    turn_share: float  # of its turns (squared), about that axis
    motion_axis: tuple[float, float, float]  # along which it moved most, in its own axes
    motion_share: float  # of the ways between views (squared), along that axis
    forward: float  # the same along the optical axis
    spread: tuple[float, float, float]  # of its places along the mean view's x, y, z, of `distance`
    distance: float  # median, of the points it observed; the estimate's unit
    relief: float  # of the scene off its plane, of `distance`
    tilt_deg: float  # of the optical axes from that plane's normal: nine of ten views have less

    @property
    def lacks(self) -> tuple[Lack, ...]:
        """Names of what is degenerate about these views; none for a good scan."""
        if self.parallax_deg < NO_PARALLAX_DEG:
            return ("static rig",) if self.turn_deg < NO_TURN_DEG else ("pure rotation",)
        found: list[Lack] = []
        parallel = self.axes_deg < PARALLEL_DEG
        if self.forward > FORWARD_SHARE and parallel:
            return ("pure forward motion",)
        if self.relief < FLAT_RELIEF and self.tilt_deg < HEAD_ON_DEG:
            found.append("single plane seen head-on")
        if parallel:
            found.append("parallel views")
        return tuple(found)


def views_of(problem: Problem) -> tuple[Views, ...]:
    """What each camera's views are like, at the problem's start: best once it is solved.

    A camera that sees nothing is left out. Where all frames see a board, it is the scene; else its
    corners do not count.
    """
    problem = _of_scene(problem)
    start, seen = problem.initial, problem.observations
    n = len(start.cameras)
    # A track of each camera by itself: what moves between frames, not between cameras.
    alone = replace(
        problem,
        initial=replace(start, points=np.repeat(start.points, n, axis=0)),
        observations=replace(seen, point=seen.point * n + seen.camera),
    )
    parallax = parallax_deg(alone).reshape(-1, n)
    length = np.linalg.norm(points_in_cameras(start, seen), axis=1)
    rotations = np.array([t.rotation for t in start.rig_from_world])
    translations = np.array([t.translation for t in start.rig_from_world])
    views = []
    for index, cam_from_rig in enumerate(start.cam_from_rig):
        rows = seen.camera == index
        if not rows.any():
            continue
        frames, points = np.unique(seen.frame[rows]), np.unique(seen.point[rows])
        R = cam_from_rig.rotation @ rotations[frames]
        t = translations[frames] @ cam_from_rig.rotation.T + cam_from_rig.translation
        widest = float(np.percentile(parallax[points, index], 90))
        distance = float(np.median(length[rows]))
        near = np.unique(seen.point[rows][length[rows] < FARTHEST * distance])
        views.append(_views(R, t, start.points[near], distance, widest))
    return tuple(views)


def _of_scene(problem: Problem) -> Problem:
    """The problem whose points are the scene's, or those of the board that all frames see."""
    if problem.board is None:
        return problem
    seen, start = problem.observations, problem.initial
    if not problem.of_board_alone:
        return replace(problem, observations=seen.subset(~problem.known[seen.point]), board=None)
    corners = corners_of(problem.board.board, shape_of(start, problem.board.board))[0]
    return replace(
        problem,
        initial=replace(start, points=corners),
        observations=replace(seen, point=problem.board.corner[seen.point]),
        board=None,
    )


def shared_lacks(views: Sequence[Views]) -> tuple[Lack, ...]:
    """What is degenerate about the views of every camera."""
    if not views:
        return ()
    return tuple(lack for lack in views[0].lacks if all(lack in one.lacks for one in views))


def of_board_in_words(lack: Lack, views: Sequence[Views]) -> str:
    """As `in_words`, where the scene is a board that is shown to the cameras."""
    if lack in ("static rig", "pure rotation"):
        return (
            "the board hardly moved: its views differ by "
            f"{max(v.turn_deg for v in views):.1f} deg at most; show it in other places, tilted to "
            "all sides"
        )
    if lack == "pure forward motion":
        return "the board only came nearer and went away: tilt it to all sides"
    return (
        "near-frontal views: the board faces the cameras within "
        f"{max(v.tilt_deg for v in views):.0f} deg in nine of ten views, which leaves the focal "
        "length open: tilt it by 30 to 45 deg, to all sides"
    )


def in_words(lack: Lack, views: Sequence[Views]) -> str:
    """One line on what is degenerate, with its number and the remedy."""
    if lack == "static rig":
        return (
            "static rig: all frames were taken from one place, looking one way (within "
            f"{max(v.turn_deg for v in views):.1f} deg): move it between frames, sideways, and "
            "turn it"
        )
    if lack == "pure rotation":
        return (
            f"pure rotation: the views turn by {max(v.turn_deg for v in views):.0f} deg but hardly "
            "move: step sideways between frames"
        )
    if lack == "pure forward motion":
        return (
            f"pure forward motion: {min(v.forward for v in views):.0%} of the motion is along the "
            "optical axis, without turns: move sideways too, or drive a bend"
        )
    if lack == "parallel views":
        return (
            "parallel views: all look the same way, within "
            f"{max(v.axes_deg for v in views):.1f} deg (rms): take oblique ones too"
        )
    return (
        "single plane seen head-on: the scene is flat to "
        f"{max(v.relief for v in views):.1%} of its distance, and all views look straight at it: "
        "look at it from the side, or bring things of other depths into view"
    )


def too_little_motion(problem: Problem, parallax_found: bool = True) -> str | None:
    """In words, why a problem cannot be solved, where its views hardly moved; None: they did.

    For a problem that was refused. parallax_found: False where that was for want of parallax, which
    a start that is not solved yet may hide.
    """
    views = views_of(problem)
    if parallax_found and max(one.parallax_deg for one in views) > LITTLE_PARALLAX_DEG:
        return None
    still = max(one.turn_deg for one in views) < NO_TURN_DEG
    return in_words("static rig" if still else "pure rotation", views)


def _views(
    R: FloatArray, t: FloatArray, points: FloatArray, distance: float, parallax: float
) -> Views:
    """From cam_from_world's rotations (n, 3, 3) and translations (n, 3)."""
    U, _, Vt = np.linalg.svd(R.sum(0))
    mean = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt  # chordal mean of cam_from_world
    turn = R @ mean.T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    roll = np.degrees(np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1]))
    axes = R[:, 2]
    off_axis = np.degrees(np.arccos(np.clip(axes @ mean[2], -1, 1)))
    centres = -np.einsum("nji,nj->ni", R, t)
    spread = ((centres - centres.mean(0)) @ mean.T).std(axis=0) / distance
    normal, relief = _plane(points, distance)
    tilt = np.degrees(np.arccos(np.clip(np.abs(axes @ normal), 0, 1)))
    ways = _ways(R, centres)
    motion_axis, motion_share = _main_axis(ways)
    # sin(angle) axis: what is not symmetric in a rotation matrix
    turns = np.stack([turn[:, j, i] - turn[:, i, j] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
    turn_axis, turn_share = _main_axis(turns)
    return Views(
        parallax_deg=parallax,
        turn_deg=float(angle.max()),
        axes_deg=_rms(off_axis),
        roll_deg=_rms(roll),
        turn_axis=turn_axis,
        turn_share=turn_share,
        motion_axis=motion_axis,
        motion_share=motion_share,
        forward=float((ways[:, 2] ** 2).sum() / max((ways**2).sum(), 1e-300)),
        spread=(float(spread[0]), float(spread[1]), float(spread[2])),
        distance=distance,
        relief=relief,
        tilt_deg=float(np.percentile(tilt, 90)),
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _ways(R: FloatArray, centres: FloatArray) -> FloatArray:
    """Ways (m, 3) from view to view, in the axes of the view that they start from."""
    some = np.unique(np.linspace(0, len(R) - 1, MOST_VIEWS).round().astype(int))
    apart = centres[some] - centres[some][:, None]
    return np.asarray(np.einsum("iab,ijb->ija", R[some], apart).reshape(-1, 3))


def _main_axis(vectors: FloatArray) -> tuple[tuple[float, float, float], float]:
    """The line closest to vectors (n, 3), and its share of the sum of their squares."""
    values, axes = np.linalg.eigh(vectors.T @ vectors)
    x, y, z = axes[:, -1].tolist()
    return (x, y, z), float(values[-1] / max(values.sum(), 1e-300))


def _plane(points: FloatArray, distance: float) -> tuple[FloatArray, float]:
    """Normal (3,) of the plane that fits points (n, 3), and their depth off it, of the distance."""
    off = points - points.mean(axis=0)
    normal = np.linalg.eigh(off.T @ off)[1][:, 0]
    along = off @ normal
    # 1.48: a median of lengths as a sigma
    return normal, float(1.48 * np.median(np.abs(along - np.median(along))) / distance)


FARTHEST = 5.0  # distances: points beyond are sky, or triangulated badly

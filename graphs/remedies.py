"""What a weak direction is called, in words, and what would make it strong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from graphs.frames import FloatArray
from graphs.motion import LEVEL_DEG, NO_TURN_DEG, SAME_PLACE, Views
from graphs.problem import Estimate

Kind = Literal[
    "focal length against depth",
    "focal length across",
    "focal length down",
    "principal point",
    "distortion",
    "doming",
    "rotation in the rig",
    "translation in the rig",
    "scale",
]
Group = Literal["focal", "centre", "distortion", "rotation", "translation"]
GROUPS: tuple[Group, ...] = get_args(Group)
GROUP: dict[Kind, Group] = {  # that a kind is named after
    "focal length against depth": "focal",
    "focal length across": "focal",
    "focal length down": "focal",
    "principal point": "centre",
    "distortion": "distortion",
    "doming": "distortion",
    "rotation in the rig": "rotation",
    "translation in the rig": "translation",
    "scale": "translation",
}
# fx and fy move together where their relative moves are of one sign and differ by less than this.
TOGETHER = 0.5
ALIGNED = 0.9  # cosine of the angle between directions that are called the same
# Of the squared turns or ways, about or along one axis: a vehicle's, that hardly leaves its plane.
ONE_AXIS = 0.95
# Of the motion (squared) along the optical axis: 0.72 and 0.79 in real drives, a third by hand.
MOSTLY_FORWARD = 0.7
INVOLVED = 0.1  # of a direction's sum of squares: a group that takes part in it
# Of a slide, what is left of it at the corners where lens parameters make up for one another: 0.07,
# 0.12 and 0.32 in good scans (kannala_brandt, double_sphere, brown); 0.7 on the fountain, and 0.4
# to 2.3 in degenerate scans.
CANCELLED = 0.4


@dataclass(frozen=True)
class Move:
    """One stated sigma along a direction, and what it does to the picture."""

    names: tuple[str, ...]  # of the parameters that it moves; `cam0.fx`, ...
    px: FloatArray  # (n,) how far it moves each, as what each would move the picture by alone
    own: FloatArray  # (n,) the same in the parameters' own units
    centre_px: float  # what is left of all that in the picture: at its centre
    corner_px: float  # and at its corners

    @property
    def share(self) -> dict[Group, float]:
        """Of each group of parameters in the sum of the squares of `px`."""
        total: dict[Group, float] = dict.fromkeys(GROUPS, 0.0)
        for name, value in zip(self.names, self.px, strict=True):
            total[group_of(name)] += float(value**2)
        whole = sum(total.values())
        return {group: value / whole for group, value in total.items()}

    def of_camera(self, camera: str, part: str) -> FloatArray:
        """A camera's moves (3,) in `rotation` or `translation`; zero where it is held."""
        own = dict(zip(self.names, self.own.tolist(), strict=True))
        return np.array([own.get(f"{camera}.{part}_{axis}", 0.0) for axis in "xyz"])


def group_of(name: str) -> Group:
    """Which group a parameter belongs to."""
    parameter = name.rsplit(".", 1)[1]
    if parameter.startswith("rotation_"):
        return "rotation"
    if parameter.startswith("translation_"):
        return "translation"
    if parameter in ("fx", "fy"):
        return "focal"
    return "centre" if parameter[0] in "cp" else "distortion"  # p1, p2: a principal point's twins


def classify(estimate: Estimate, move: Move, views: Sequence[Views]) -> Kind:
    """The kind of a weak direction, by what leads in it."""
    share = move.share
    lead = max(share, key=lambda group: share[group])
    if lead == "translation":
        return "scale" if _is_scale(estimate, move, share) else "translation in the rig"
    if lead == "rotation":
        return "rotation in the rig"
    if lead == "centre":
        return "principal point"
    index = _leading_camera(estimate, move, lead)
    lacks = views[index].lacks if views else ()
    slide = float(np.linalg.norm(move.px))
    if lead == "distortion":
        bends = "parallel views" in lacks or "single plane seen head-on" in lacks
        return "doming" if bends and move.corner_px > CANCELLED * slide else "distortion"
    if share["distortion"] > INVOLVED and move.corner_px < CANCELLED * slide:
        return "distortion"
    fx, fy = _focal_moves(estimate, move, index)
    if fx * fy > 0 and min(abs(fx), abs(fy)) > TOGETHER * max(abs(fx), abs(fy)):
        return "focal length against depth"
    return "focal length across" if abs(fx) > abs(fy) else "focal length down"


def in_words(kind: Kind, move: Move, estimate: Estimate, views: Sequence[Views]) -> str:
    """A weak direction: its parameters, those that name it first, and what they are up to."""
    cameras = [camera.name for camera in estimate.cameras]
    first = [name for name in move.names if group_of(name) == GROUP[kind]]
    others = [name for name in move.names if name not in first]
    along = f", with {listed_parameters(others, cameras)}" if others else ""
    return f"{listed_parameters(first, cameras)}{along}: {_meaning(kind, move, estimate, views)}"


def _meaning(kind: Kind, move: Move, estimate: Estimate, views: Sequence[Views]) -> str:
    share, group = move.share, GROUP[kind]
    moved = {name.rsplit(".", 1)[0] for name in move.names if group_of(name) == group}
    whose = _and([camera.name for camera in estimate.cameras if camera.name in moved])
    one = len(moved) == 1
    if kind == "rotation in the rig":
        against = " against the principal points" if share["centre"] > INVOLVED else ""
        return f"how {whose} {'is' if one else 'are'} turned in the rig{against}"
    if kind == "translation in the rig":
        index = _leading_camera(estimate, move, group)
        direction = move.of_camera(estimate.cameras[index].name, "translation")
        along = _along(direction, index, views) if one else ""
        return f"where {whose} {'sits' if one else 'sit'} in the rig{along}"
    if kind == "distortion":
        against = " and against the focal length" if share["focal"] > INVOLVED else ""
        return f"distortion terms among themselves{against}"
    both = len({name.rsplit(".", 1)[1] for name in move.names if group_of(name) == group}) > 1
    than = "more than" if both else "apart from"
    decentred = any("p1" in camera.names for camera in estimate.cameras)
    return {
        "focal length against depth": "the focal length against depth",
        "focal length across": f"the focal length across the image, {than} that down it",
        "focal length down": f"the focal length down the image, {than} that across it",
        "principal point": f"the principal point against tilt{' and p1, p2' if decentred else ''}",
        "doming": "radial distortion against a bulge of the scene (doming)",
        "scale": "the size of the rig and the scene",
    }[kind]


def listed_parameters(names: Sequence[str], cameras: Sequence[str]) -> str:
    """Parameters in words, a camera's or several cameras' together: `cx, p2 of left and right`."""
    of: dict[str, set[str]] = {}
    for name in names:
        camera, parameter = name.rsplit(".", 1)
        of.setdefault(parameter, set()).add(camera)
    groups: dict[frozenset[str], list[str]] = {}
    for parameter, some in of.items():
        groups.setdefault(frozenset(some), []).append(parameter)
    parts = []
    for own, parameters in groups.items():
        whose = _and([camera for camera in cameras if camera in own])
        if len(own) == len(cameras) > 2:
            whose = "every camera"
        parts.append(", ".join(parameters) + (f" of {whose}" if len(cameras) > 1 else ""))
    return "; ".join(parts)


def _and(words: Sequence[str]) -> str:
    return " and ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)


# ---- remedies ------------------------------------------------------------------------------

NO_MOTION = {
    "static rig": "move the rig between frames, sideways, and turn it",
    "pure rotation": "step sideways between frames",
}
OR_A_BOARD = "or show it a board a few times (--board)"
NONE_NEEDED = "none is needed: together they are known; a lens with fewer of them might do"
ON_ITS_SIDE = "with the camera turned by 90 degrees about its optical axis"


def remedy(kind: Kind, move: Move, estimate: Estimate, views: Sequence[Views]) -> str:
    """What to do for the direction to become strong, in view of what the scan's views lack."""
    own = views[_leading_camera(estimate, move, GROUP[kind])] if views else None
    if kind == "distortion" and move.corner_px < CANCELLED * float(np.linalg.norm(move.px)):
        return NONE_NEEDED
    for lack, what in NO_MOTION.items():
        if own is not None and lack in own.lacks:
            return what
    if kind.startswith("focal"):
        return _for_focal(kind, own)
    if kind == "principal point":
        return _for_centre(own)
    if kind == "rotation in the rig":
        shared = "let the cameras see the same things, be it in different frames"
        rolled = own is not None and own.roll_deg > LEVEL_DEG
        return shared if rolled else f"turn the rig about its optical axis, and {shared}"
    if kind == "translation in the rig":
        turned = "turn the rig while it moves"
        if own is not None and own.turn_deg > NO_TURN_DEG and own.turn_share > ONE_AXIS:
            turned = "turn the rig about other axes too"
        return f"{turned}, and bring near objects into view"
    return {
        "scale": "measure a longer distance, or measure it more exactly",
        "doming": f"take oblique views too, some of them {ON_ITS_SIDE}, or from other distances",
    }.get(kind, "let things of the scene pass through the corners of the image")


def board_remedy(kind: Kind, move: Move) -> str:
    """As `remedy`, where a board is all that was seen."""
    if kind == "distortion" and move.corner_px < CANCELLED * float(np.linalg.norm(move.px)):
        return NONE_NEEDED
    if kind.startswith("focal"):
        return "tilt the board by 30 to 45 deg, to all sides, near and far"
    if kind == "principal point":
        return "show the board tilted in every corner of the image, and turned by 90 deg in it"
    return {
        "rotation in the rig": "show the board to the cameras at once, tilted, near and far",
        "translation in the rig": "show the board to the cameras at once, near them",
        "scale": "measure the squares over the whole board, and say how well (square_sigma_m)",
    }.get(kind, "bring the board to the edges and into the corners of the image")


def _for_focal(kind: Kind, own: Views | None) -> str:
    if own is not None:
        level = own.roll_deg < LEVEL_DEG
        if kind == "focal length down" and own.spread[1] < SAME_PLACE and level:
            return (
                "all views stand at one height: take some from higher and lower, or some "
                f"{ON_ITS_SIDE}"
            )
        if kind == "focal length across" and own.spread[0] < SAME_PLACE and level:
            return (
                f"no view stands to the side of another: move sideways, or take some {ON_ITS_SIDE}"
            )
        if "single plane seen head-on" in own.lacks:
            return "look at the plane from the side, or bring things of other depths into view"
        if own.forward > MOSTLY_FORWARD:
            return "most of the motion is along the optical axis: move sideways too, or drive bends"
        if "parallel views" in own.lacks:
            return "all views look the same way: take oblique ones too"
    return "bring near and far things into view, and look at them from several sides"


def _for_centre(own: Views | None) -> str:
    if own is None or own.roll_deg > LEVEL_DEG:
        return f"take more views, turned differently about the optical axis, {OR_A_BOARD}"
    return (
        "turn the rig about its optical axis: take some views with the camera on its side, "
        f"{OR_A_BOARD}"
    )


# ---- what leads ----------------------------------------------------------------------------


def _leading_camera(estimate: Estimate, move: Move, group: Group) -> int:
    """The camera (an index) whose parameters of a group move most."""
    amount = dict.fromkeys((camera.name for camera in estimate.cameras), 0.0)
    for name, value in zip(move.names, move.px, strict=True):
        if group_of(name) == group:
            amount[name.rsplit(".", 1)[0]] += float(value**2)
    return max(range(len(estimate.cameras)), key=lambda i: amount[estimate.cameras[i].name])


def _focal_moves(estimate: Estimate, move: Move, camera: int) -> tuple[float, float]:
    """Relative moves of a camera's fx and fy; zero where one is held."""
    own = dict(zip(move.names, move.own.tolist(), strict=True))
    lens = estimate.cameras[camera]
    fx, fy = (
        own.get(f"{lens.name}.{name}", 0.0) / value
        for name, value in zip(("fx", "fy"), lens.params[:2].tolist(), strict=True)
    )
    return fx, fy


def _is_scale(estimate: Estimate, move: Move, share: dict[Group, float]) -> bool:
    """Whether all translations grow by one factor, and nothing else moves to speak of."""
    factors = []
    for camera, placed in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        t, moved = placed.translation, move.of_camera(camera.name, "translation")
        if (length := float(np.linalg.norm(t))) > 0:
            if _cosine(moved, t) < ALIGNED:
                return False
            factors.append(float(moved @ t) / length**2)
    if not factors:  # all cameras in one place
        return False
    least, most = min(factors), max(factors)
    alike = least * most > 0 and min(abs(least), abs(most)) > TOGETHER * max(abs(least), abs(most))
    return alike and share["translation"] > ALIGNED


def _along(direction: FloatArray, camera: int, views: Sequence[Views]) -> str:
    """What a direction in a camera's axes is in terms of its motion, where that has one axis."""
    if not views:
        return ""
    own = views[camera]
    if own.motion_share > ONE_AXIS and _cosine(direction, np.array(own.motion_axis)) > ALIGNED:
        return ", along the motion"
    if own.turn_share > ONE_AXIS and _cosine(direction, np.array(own.turn_axis)) > ALIGNED:
        return ", along the axis it turns about"
    return ""


def _cosine(a: FloatArray, b: FloatArray) -> float:
    """Of the angle between two lines."""
    return float(abs(a @ b)) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)

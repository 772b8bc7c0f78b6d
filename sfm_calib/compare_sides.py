"""Two calibrations brought side by side: the same cameras, image sizes and unit of length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from graphs.camera import Camera
from graphs.compare import Frames, Stated
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.formats import NO_SIZE, CameraRig
from sfm_calib.uncertainty import RANGES, Unit

LEAST_SPREAD = 1e-9  # of camera centres: closer together, they have no baseline


@dataclass(frozen=True)
class Sides:
    """A and B with the same cameras, of A's names and in A's order, and in one unit of length."""

    a: Stated
    b: Stated
    names_b: tuple[str, ...]  # what B's cameras are called there
    unit: Unit | None  # None: they are compared camera by camera, without any rig
    frames: Frames
    is_metric: tuple[bool, bool]
    b_per_a: float  # A's unit of length in B's, as the cameras' distances say
    notes: tuple[str, ...]


def side_by_side(
    a: CameraRig, b: CameraRig, cameras: Sequence[str] | None, ranges: Sequence[float] | None
) -> Sides:
    """Match cameras, image sizes and units; `ranges` in metres, or in baselines without a scale.

    cameras: `name in A=name in B`, where the names themselves do not tell.
    Raises CalibrationError where cameras cannot be matched, and where image sizes differ.
    """
    pairs, notes = match(a, b, cameras)
    chosen_a, chosen_b = (read.only([p[i] for p in pairs]) for i, read in enumerate((a, b)))
    names = tuple(p[0] for p in pairs)
    chosen_b = renamed(chosen_b, names)
    chosen_a, chosen_b, of_sizes = _same_sizes(chosen_a, chosen_b)
    notes += of_sizes
    is_rig = len(pairs) > 1
    for letter, read in (("A", chosen_a), ("B", chosen_b)):
        if is_rig and read.cam_from_rig is None:
            notes += (f"{letter} does not say how its cameras sit: each is compared alone",)
    states = [read.stated for read in (chosen_a, chosen_b)]
    both = chosen_a.cam_from_rig is not None and chosen_b.cam_from_rig is not None
    if not is_rig or not both or min(_spread(s) for s in states) < LEAST_SPREAD:
        alone = tuple((index,) for index in range(len(pairs)))
        frames = Frames(alone, (np.inf,), translation=False, scale=False)
        lone = [_lenses_alone(s) for s in states]
        return Sides(
            lone[0], lone[1], chosen_b_names(pairs), None, frames, (False, False), 1.0, tuple(notes)
        )
    metric = (chosen_a.unit == "m", chosen_b.unit == "m")
    in_a, in_b, unit = _one_unit(states[0], states[1], metric)
    if not all(metric):
        notes += (_unit_note(metric),)
    chosen = tuple(sorted(ranges or RANGES[unit]))
    group = (tuple(range(len(pairs))),)
    frames = Frames(group, (*chosen, np.inf), translation=True, scale=not all(metric))
    per_a = _spread(states[1]) / _spread(states[0])
    return Sides(in_a, in_b, chosen_b_names(pairs), unit, frames, metric, per_a, tuple(notes))


def chosen_b_names(pairs: Sequence[tuple[str, str]]) -> tuple[str, ...]:
    """What B calls the cameras."""
    return tuple(b for _, b in pairs)


def _unit_note(metric: tuple[bool, bool]) -> str:
    if not any(metric):
        return (
            "neither states metres: B's scale is fitted too, and lengths are in baselines of A "
            "(--metres-a and --metres-b say what their units are)"
        )
    which, flag = ("A", "--metres-a") if metric[1] else ("B", "--metres-b")
    return f"{which} states no metres: its scale is fitted too ({flag} says what its unit is)"


# ---- cameras -------------------------------------------------------------------------------


def match(
    a: CameraRig, b: CameraRig, wanted: Sequence[str] | None
) -> tuple[list[tuple[str, str]], tuple[str, ...]]:
    """Pairs of names, and what is to be said of them: as wanted, by name, or else by order.

    Raises CalibrationError where neither tells.
    """
    if wanted:
        return _as_wanted(a, b, wanted), ()
    common = [name for name in a.names if name in b.names]
    if common:
        left = [
            f"{letter}'s {', '.join(n for n in read.names if n not in common)}"
            for letter, read in (("A", a), ("B", b))
            if set(read.names) - set(common)
        ]
        notes = (f"not compared, for the other has no such camera: {'; '.join(left)}",)
        return [(name, name) for name in common], notes if left else ()
    if len(a.names) == len(b.names):
        pairs = list(zip(a.names, b.names, strict=True))
        said = ", ".join(f"{one} = {other}" for one, other in pairs)
        note = f"cameras are called otherwise in B: matched by their order, {said}"
        return pairs, () if len(pairs) == 1 else (note,)
    raise CalibrationError(
        f"the cameras do not match: {a.path} has {', '.join(a.names)} and {b.path} has "
        f"{', '.join(b.names)}: say which are the same with --cameras "
        f"{a.names[0]}={b.names[0]}"
    )


def _as_wanted(a: CameraRig, b: CameraRig, wanted: Sequence[str]) -> list[tuple[str, str]]:
    pairs = []
    for entry in wanted:
        one, equals, other = entry.partition("=")
        if not equals:
            other = one
        for name, read in ((one, a), (other, b)):
            if name not in read.names:
                raise CalibrationError(
                    f"--cameras {entry}: {read.path} has no camera {name!r}: "
                    f"{nearest(name, read.names)}"
                )
        pairs.append((one, other))
    for place in (0, 1):
        if len({p[place] for p in pairs}) < len(pairs):
            raise CalibrationError(f"--cameras {' '.join(wanted)} names a camera twice")
    return pairs


def renamed(read: CameraRig, names: Sequence[str]) -> CameraRig:
    """The same with its cameras called otherwise, one after the other."""
    new = dict(zip(read.names, names, strict=True))
    parts = [name.rpartition(".") for name in read.covariance.names]
    return replace(
        read,
        cameras=tuple(replace(c, name=new[c.name]) for c in read.cameras),
        covariance=Covariance(
            tuple(f"{new[camera]}.{parameter}" for camera, _, parameter in parts),
            read.covariance.matrix,
        ),
    )


def _same_sizes(a: CameraRig, b: CameraRig) -> tuple[CameraRig, CameraRig, tuple[str, ...]]:
    """Sizes that one does not state are the other's. Raises CalibrationError where they differ."""
    cameras: tuple[list[Camera], list[Camera]] = ([], [])
    missing = set()
    for one, other in zip(a.cameras, b.cameras, strict=True):
        known = [c.size for c in (one, other) if c.size != NO_SIZE]
        if not known:
            raise CalibrationError(
                f"neither {a.path} nor {b.path} states the image size of {one.name}: add "
                "image_width and image_height to one of them"
            )
        if len(known) == 2 and known[0] != known[1]:
            raise CalibrationError(
                f"{one.name} is {known[0][0]} x {known[0][1]} px in A and {known[1][0]} x "
                f"{known[1][1]} px in B: compare calibrations of one image size, or scale fx, fy, "
                "cx, cy of one of them with its images first"
            )
        missing |= {name for name, c in (("A", one), ("B", other)) if c.size == NO_SIZE}
        for place, camera in zip(cameras, (one, other), strict=True):
            place.append(replace(camera, size=known[0]))
    notes = tuple(
        f"{side} states no image size: {'AB'.replace(side, '')}'s is taken"
        for side in sorted(missing)
    )
    return replace(a, cameras=tuple(cameras[0])), replace(b, cameras=tuple(cameras[1])), notes


# ---- lengths -------------------------------------------------------------------------------


def _lenses_alone(side: Stated) -> Stated:
    """Every camera in a rig of its own."""
    names = side.covariance.names
    kept = [i for i, n in enumerate(names) if ".rotation_" not in n and ".translation_" not in n]
    estimate = replace(
        side.estimate, cam_from_rig=(Transform.identity(),) * len(side.estimate.cameras)
    )
    matrix = side.covariance.matrix[np.ix_(kept, kept)]
    return Stated(estimate, Covariance(tuple(names[i] for i in kept), matrix))


def _centres(side: Stated) -> FloatArray:
    return np.array([t.inverse.translation for t in side.estimate.cam_from_rig])


def _spread(side: Stated) -> float:
    """rms distance of the cameras from their middle."""
    centres = _centres(side)
    return float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))


def _one_unit(
    a: Stated, b: Stated, metric: tuple[bool, bool]
) -> tuple[Stated, Stated, Literal["m", "baseline"]]:
    """Metres where one has them, the other as large; else both so that A's longest is 1 long."""
    if all(metric):
        return a, b, "m"
    if metric[0]:
        return a, b.scaled(_spread(a) / _spread(b)), "m"
    if metric[1]:
        return a.scaled(_spread(b) / _spread(a)), b, "m"
    centres = _centres(a)
    longest = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    return a.scaled(1 / longest), b.scaled(_spread(a) / _spread(b) / longest), "baseline"

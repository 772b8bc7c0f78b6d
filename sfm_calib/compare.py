"""`sfm-calib compare A B`: what two calibrations of any origin say differently, and if by chance.

Parameters alone mislead: a principal point that moved is all but undone by a turn of the camera.
So the two are held against each other in the picture and in depths, and their sigmas with them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from graphs.compare import Difference, Stated, difference
from graphs.compare_chance import chi_square
from graphs.compare_rig import DepthError, PairPlace, as_lens, depth_errors, holds, pair_place
from graphs.frames import FloatArray, log_rotation
from graphs.lenses import PARAMETER_NAMES
from graphs.uncertainty import pairs
from sfm_calib.compare_record import (
    CameraMatch,
    Chance,
    ChangeOfFrames,
    Comparison,
    ComparisonVerdict,
    DepthDifference,
    PairDifference,
    ParameterDifference,
    ProjectionDifference,
    Side,
)
from sfm_calib.compare_sides import Sides, side_by_side
from sfm_calib.compare_verdict import verdict_of
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import CameraRig, read_calibration

OTHER_UNIT = 5.0  # between two lengths of one baseline: more is no error of a calibration
IN_PX = ("fx", "fy", "cx", "cy")
ONE_SIDED = "{} states no sigmas: it is taken as exact, and its own error is not in z or p"
NO_SIGMAS = "neither states sigmas: there is no z and no p"
INDEPENDENT = "z and p hold for calibrations from different data: from the same, errors are shared"
NOT_COUNTED = "the sigmas are of what a change of frames undoes, or all but zero: there is no p"


@dataclass(frozen=True)
class CompareOptions:
    """What is held against what, and where."""

    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="A=B")] = ()
    """Which cameras are the same, as name in A=name in B; default: by name, else by order."""
    ranges: Annotated[tuple[float, ...], tyro.conf.arg(metavar="M")] = ()
    """Ranges from the camera in m, or in baselines without a scale; default: 1 2 5 10 m."""
    metres_a: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """How many metres the unit of A's lengths is, where the file does not say (0.001: mm)."""
    metres_b: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """The same of B's."""

    def __post_init__(self) -> None:
        for name in ("metres_a", "metres_b"):
            metres = getattr(self, name)
            if metres is not None and not 0 < metres < np.inf:
                flag = f"--{name.replace('_', '-')}"
                raise CalibrationError(f"{flag} {metres:g}: a unit of length is positive")
        if not all(0 < r < np.inf for r in self.ranges):
            raise CalibrationError(
                f"--ranges {' '.join(f'{r:g}' for r in self.ranges)}: ranges are positive; "
                "infinity is always among them"
            )


@dataclass(frozen=True)
class Compared:
    """The record, and what its page draws."""

    record: Comparison
    found: Difference


def compare_files(a: Path, b: Path, options: CompareOptions | None = None) -> Compared:
    """Read two calibrations and compare them.

    Raises CalibrationError where one cannot be read, or they are not of the same cameras.
    """
    options = options or CompareOptions()
    reads = [read_calibration(path) for path in (a, b)]
    for index, metres in enumerate((options.metres_a, options.metres_b)):
        if metres is not None:
            reads[index] = reads[index].metric(metres)
    return compare(reads[0], reads[1], options)


def compare(a: CameraRig, b: CameraRig, options: CompareOptions) -> Compared:
    """Compare two calibrations as they were read."""
    wanted = [one for entry in options.cameras for one in entry.split(",")]
    sides = side_by_side(a, b, wanted, options.ranges)
    _check_units(sides)
    found = difference(sides.a.estimate, sides.b.estimate, sides.frames)
    chance = chi_square(sides.a, sides.b, sides.frames)
    stated = [bool(side.root.any()) for side in (sides.a, sides.b)]
    ours, theirs = _in_one_scale(sides, found)
    of_a, of_b, errors_px = _alike(sides.a, sides.b)
    about = _notes(sides, errors_px, stated, chance is not None)
    record = Comparison(
        a=_side(a, stated[0]),
        b=_side(b, stated[1]),
        cameras=_matches(sides, errors_px),
        unit=sides.unit,
        taken_out=_taken_out(sides, found),
        parameters=tuple(_parameters(of_a, of_b, sides)),
        projection={
            camera.name: tuple(_projection(found, index, r) for r in sides.frames.ranges)
            for index, camera in enumerate(sides.a.estimate.cameras)
        },
        pairs=_pairs(sides, ours, theirs) if sides.unit else (),
        chance=None if chance is None else Chance(**vars(chance)),
        notes=(
            *a.notes,
            *b.notes,
            *sides.notes,
            *about,
        ),
        verdict=ComparisonVerdict(kind="same", lines=()),
    )
    return Compared(record.model_copy(update={"verdict": verdict_of(record)}), found)


def _side(read: CameraRig, states_sigmas: bool) -> Side:
    return Side(
        path=str(read.path), format=read.format, cameras=read.names, states_sigmas=states_sigmas
    )


def _check_units(sides: Sides) -> None:
    """Raises CalibrationError where the lengths of two metric rigs are of other units."""
    if not all(sides.is_metric):
        return
    lengths = [
        max((float(np.linalg.norm(t.translation)) for t in side.estimate.cam_from_rig), default=0)
        for side in (sides.a, sides.b)
    ]
    if min(lengths) <= 0 or 1 / OTHER_UNIT < lengths[1] / lengths[0] < OTHER_UNIT:
        return
    larger, flag = ("B", "--metres-b") if lengths[1] > lengths[0] else ("A", "--metres-a")
    raise CalibrationError(
        f"lengths of {larger} are {max(lengths) / min(lengths):.4g} times those of the other: if "
        f"they are in mm, add {flag} 0.001"
    )


def _in_one_scale(sides: Sides, found: Difference) -> tuple[Stated, Stated]:
    """A and B once the fitted scale is applied, to the side that has no metres of its own."""
    scale = found.changes[0].scale
    if sides.is_metric[1] and not sides.is_metric[0]:
        return sides.a.scaled(1 / scale), sides.b
    return sides.a, sides.b.scaled(scale)


def _alike(a: Stated, b: Stated) -> tuple[Stated, Stated, list[float]]:
    """Both with every camera in one lens, and how far off the pictures are then.

    That which holds the other, for then nothing is lost; else A's.
    """
    errors_px = []
    for index, (one, other) in enumerate(zip(a.estimate.cameras, b.estimate.cameras, strict=True)):
        error_px = 0.0
        if holds(other.lens, one.lens):
            a = as_lens(a, index, other.lens)[0]
        else:
            b, error_px = as_lens(b, index, one.lens)
        errors_px.append(error_px)
    return a, b, errors_px


def _matches(sides: Sides, errors_px: Sequence[float]) -> tuple[CameraMatch, ...]:
    return tuple(
        CameraMatch(
            name=one.name, name_b=name_b, lens=one.lens, lens_b=other.lens, fit_error_px=error_px
        )
        for one, other, name_b, error_px in zip(
            sides.a.estimate.cameras, sides.b.estimate.cameras, sides.names_b, errors_px,
            strict=True,
        )
    )  # fmt: skip


def _notes(
    sides: Sides, errors_px: Sequence[float], stated: Sequence[bool], has_chance: bool
) -> Iterator[str]:
    """What has to be known to read the numbers."""
    both = zip(sides.a.estimate.cameras, sides.b.estimate.cameras, errors_px, strict=True)
    for one, other, error_px in both:
        if not (holds(one.lens, other.lens) or holds(other.lens, one.lens)):
            yield (
                f"{one.name} is {one.lens} in A and {other.lens} in B: for its parameters B was "
                f"fitted as {one.lens}, {error_px:.2g} px off (rms); differences of parameters "
                "are no finer than that, those in the picture are B's own"
            )
        elif one.lens != other.lens:
            special = "B" if holds(one.lens, other.lens) else "A"
            yield (
                f"{one.name} is {one.lens} in A and {other.lens} in B; {special}'s is a special "
                "case of the other"
            )
    if not any(stated):
        yield NO_SIGMAS
    elif not all(stated):
        yield ONE_SIDED.format("B" if stated[0] else "A")
    else:
        yield INDEPENDENT
    if any(stated) and not has_chance:
        yield NOT_COUNTED


def _taken_out(sides: Sides, found: Difference) -> tuple[ChangeOfFrames, ...]:
    names = [camera.name for camera in sides.a.estimate.cameras]
    out = []
    for group, change in zip(sides.frames.groups, found.changes, strict=True):
        x, y, z = np.degrees(log_rotation(change.b_from_a.rotation)).tolist()
        t = change.b_from_a.translation.tolist()
        out.append(
            ChangeOfFrames(
                cameras=tuple(names[index] for index in group),
                rotation_deg=(x, y, z),
                translation=(t[0], t[1], t[2]),
                scale=sides.b_per_a / change.scale if sides.frames.scale else None,
            )
        )
    return tuple(out)


# ---- parameters ----------------------------------------------------------------------------


def _parameters(a: Stated, b: Stated, sides: Sides) -> Iterator[ParameterDifference]:
    """Of lenses, and of every camera's place beside the first; B in A's lenses and scale."""
    sigma_a, sigma_b = a.covariance.sigma, b.covariance.sigma
    for one, other in zip(a.estimate.cameras, b.estimate.cameras, strict=True):
        for index, parameter in enumerate(PARAMETER_NAMES[one.lens]):
            name = f"{one.name}.{parameter}"
            yield _row(
                name,
                "px" if parameter in IN_PX else "",
                (float(one.params[index]), float(other.params[index])),
                float(other.params[index] - one.params[index]),
                (sigma_a.get(name, 0.0), sigma_b.get(name, 0.0)),
            )
    if sides.unit is None:
        return
    places = [pair_place(a, b, (0, i)) for i in range(1, len(a.estimate.cameras))]
    longest = max(place.baselines[0] for place in places)
    for camera, place in zip(a.estimate.cameras[1:], places, strict=True):
        is_unit = sides.frames.scale and place.baselines[0] == longest
        yield from _place_rows(camera.name, place, sides.unit, is_unit)


def _place_rows(
    name: str, place: PairPlace, unit: str, is_unit: bool
) -> Iterator[ParameterDifference]:
    """Of one camera; is_unit: its length was made the same in both, and says nothing."""
    along = int(np.abs(place.b_from_a[0].translation).argmax()) if is_unit else None
    turns = [np.degrees(log_rotation(t.rotation)) for t in place.b_from_a]
    sigmas = [np.sqrt(np.maximum(np.diag(cov), 0.0)) for cov in place.cov]
    for axis, letter in enumerate("xyz"):
        yield _row(
            f"{name}.rotation_{letter}",
            "deg",
            (float(turns[0][axis]), float(turns[1][axis])),
            float(np.degrees(place.change[axis])),
            (float(np.degrees(sigmas[0][axis])), float(np.degrees(sigmas[1][axis]))),
        )
    for axis, letter in enumerate("xyz"):
        known = axis != along
        yield _row(
            f"{name}.translation_{letter}",
            unit,
            (
                float(place.b_from_a[0].translation[axis]),
                float(place.b_from_a[1].translation[axis]),
            ),
            float(place.change[3 + axis]),
            (float(known * sigmas[0][3 + axis]), float(known * sigmas[1][3 + axis])),
        )


def _row(
    name: str,
    unit: str,
    values: tuple[float, float],
    apart: float,
    sigmas: tuple[float, float],
) -> ParameterDifference:
    both = float(np.hypot(*sigmas))
    return ParameterDifference(
        name=name, unit=unit, a=values[0], b=values[1], difference=apart,
        sigma_a=sigmas[0], sigma_b=sigmas[1], z=apart / both if both > 0 else None,
    )  # fmt: skip


# ---- in the picture ------------------------------------------------------------------------


def _projection(found: Difference, camera: int, distance: float) -> ProjectionDifference:
    size = np.linalg.norm(found.over_image(camera, distance)[2], axis=-1)  # (rows, columns)
    seen = size[np.isfinite(size)]
    if not seen.size:
        name = found.a.cameras[camera].name
        raise CalibrationError(
            f"{name}: A and B share no part of its image: they are not of the same camera, or one "
            "of them cannot be right"
        )
    rows, columns = size.shape
    return ProjectionDifference(
        range=distance if np.isfinite(distance) else None,
        mean_px=float(seen.mean()),
        rms_px=float(np.sqrt((seen**2).mean())),
        max_px=float(seen.max()),
        centre_px=_or_none(size[rows // 2, columns // 2]),
        corner_px=_largest(size[np.ix_([0, -1], [0, -1])]),
        seen_share=seen.size / size.size,
    )


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _largest(values: FloatArray) -> float | None:
    return None if np.isnan(values).all() else float(np.nanmax(values))


# ---- pairs of cameras ----------------------------------------------------------------------


def _pairs(sides: Sides, a: Stated, b: Stated) -> tuple[PairDifference, ...]:
    """Places as large as each other where scales are not known, depths in the fitted scale."""
    ranges = [r for r in sides.frames.ranges if np.isfinite(r)]
    names = [camera.name for camera in a.estimate.cameras]
    return tuple(
        pair_difference(
            (names[pair[0]], names[pair[1]]),
            pair_place(sides.a, sides.b, pair),
            depth_errors(a, b, pair, ranges),
            # Of two cameras with a fitted scale, the baselines are the scale.
            scaled=sides.frames.scale and len(names) == 2,
        )
        for pair in pairs(a.estimate)
    )


def pair_difference(
    names: tuple[str, str], place: PairPlace, depths: Sequence[DepthError], scaled: bool
) -> PairDifference:
    """Of two cameras; scaled: their baselines were made as long as each other."""
    (ours, theirs), sigmas = place.baselines, place.sigma_baselines
    stated = any(cov.any() for cov in place.cov)
    longer = None if scaled or ours == 0 else 100 * (theirs / ours - 1)
    sigma = float(np.hypot(*sigmas)) / ours * 100 if ours else 0.0
    return PairDifference(
        cameras=names,
        turn_deg=place.turn_deg,
        sigma_turn_deg=place.sigma_turn_deg if stated else None,
        baseline_a=ours,
        baseline_b=theirs,
        baseline_percent=longer,
        sigma_baseline_percent=sigma if stated and longer is not None else None,
        depth=tuple(_depth(one) for one in depths),
    )


def _depth(one: DepthError) -> DepthDifference:
    if not one.n_common:
        return DepthDifference(range=one.range, missing="not in both images")
    if np.isnan(one.median):
        return DepthDifference(range=one.range, no_depth_share=1.0, missing="rays do not meet")
    return DepthDifference(
        range=one.range,
        median_percent=100 * one.median,
        worst_percent=100 * one.worst,
        middle_percent=None if np.isnan(one.middle) else 100 * one.middle,
        sigma_percent=100 * one.sigma_middle if one.sigma_middle > 0 else None,
        no_depth_share=one.no_depth,
    )

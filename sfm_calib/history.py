"""Calibrations of one rig over time: the same numbers of each, and how they changed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from graphs.camera import Camera
from graphs.compare import Stated
from graphs.frames import FloatArray, log_rotation
from graphs.lens_shape import SHAPE_NAMES, lens_shape
from graphs.lenses import LENSES
from graphs.pose_covariance import relative
from graphs.propagation import cross_covariance, lens_names, pose_names
from sfm_calib.compare_sides import match, renamed
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.formats import NO_SIZE, CameraRig
from sfm_calib.history_files import FoundCalibration, find_calibrations
from sfm_calib.history_record import GROUPS, Group, History, HistoryEntry, Quantity
from sfm_calib.partial import reference_of, seen_from

GROUP_OF_SHAPE: dict[str, Group] = {
    "focal": "focal", "focal_x": "focal", "focal_y": "focal",
    "cx": "principal_point", "cy": "principal_point",
    "corner": "distortion", "corner_x": "distortion", "corner_y": "distortion",
}  # fmt: skip
METRES = "m"
NOTHING_PX = 1e-6  # of an effect in the corners: rounding of numeric derivatives
ROUNDING = 1e-12  # of the variances that cancel in a baseline that is the unit


@dataclass(frozen=True)
class HistoryOptions:
    """What is listed."""

    camera: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Cameras to list; default: all."""
    parameters: Annotated[tuple[Group, ...], tyro.conf.arg(metavar="GROUP...")] = GROUPS
    """Groups of parameters to list: focal, principal_point, distortion (in the image's corners),
    pointing, translation, baseline."""
    since: Annotated[str | None, tyro.conf.arg(metavar="DATE")] = None
    """Leave out calibrations before this day, as 2026-05-31, or moment (UTC)."""

    def moment(self) -> datetime | None:
        """`since` in UTC. Raises CalibrationError where it is no date."""
        if self.since is None:
            return None
        try:
            since = datetime.fromisoformat(self.since)
        except ValueError as error:
            raise CalibrationError(
                f"--since {self.since}: no date; write it as 2026-05-31"
            ) from error
        return since.replace(tzinfo=UTC) if since.tzinfo is None else since


@dataclass(frozen=True)
class Number:
    """One quantity of one calibration, and by what it may be compared."""

    name: str
    group: Group
    value: float
    sigma: float | None
    unit: str
    key: object  # of its size or unit: equal ones are compared
    rotation: FloatArray | None = None  # (3, 3) where it is one axis of it


@dataclass
class Compared:
    """What came before, by name and key, as the calibrations are gone through."""

    first: dict[object, Number] = field(default_factory=dict)
    before: dict[object, Number] = field(default_factory=dict)


def history_of(folder: Path, options: HistoryOptions | None = None) -> History:
    """All calibrations in a folder, the oldest first, each beside the one before.

    Raises CalibrationError where the folder holds none, or none of the cameras asked for.
    """
    options = options or HistoryOptions()
    found, skipped = find_calibrations(folder)
    since = options.moment()
    listed = [one for one in found if since is None or one.when >= since]
    if not listed:
        raise CalibrationError(
            f"none of the {len(found)} calibrations in {folder} is of {options.since} or later: "
            f"the newest is of {found[-1].when:%Y-%m-%d}"
        )
    listed, of_names = _same_names(listed)
    names = tuple(dict.fromkeys(name for one in reversed(listed) for name in one.read.names))
    for name in options.camera:
        if name not in names:
            raise CalibrationError(
                f"--camera {name}: no calibration has it: {nearest(name, names)}"
            )
    reference = _reference(listed)
    listed, of_sizes = _with_sizes(listed)
    wide = _wide(listed)
    numbers = [tuple(_numbers(one, reference, wide, options)) for one in listed]
    newest = _newest_keys(numbers)
    so_far = Compared()
    entries = []
    for index, own in enumerate(numbers):
        notes = [*of_names[index], *of_sizes[index], *_notes(listed, index, reference)]
        notes += _not_compared(own, newest)
        quantities = tuple(_quantity(number, newest, so_far) for number in own)
        entries.append(_entry(listed, index, folder, quantities, notes))
    return History(
        folder=str(folder),
        reference=reference,
        cameras=options.camera or names,
        entries=tuple(entries),
        n_skipped=skipped,
        n_older=len(found) - len(listed),
    )


def _entry(
    listed: Sequence[FoundCalibration],
    index: int,
    folder: Path,
    quantities: tuple[Quantity, ...],
    notes: Sequence[str],
) -> HistoryEntry:
    one, result = listed[index], listed[index].result
    recalibration = result.recalibration if result else None
    return HistoryEntry(
        number=index + 1,
        path=str(one.path.relative_to(folder)),
        also=tuple(str(path.relative_to(folder)) for path in one.also),
        format=one.read.format,
        sha256=one.sha256,
        when=one.when,
        when_from=one.when_from,
        usable=result.verdict.usable if result and result.verdict else None,
        drift=recalibration.drift.verdict if recalibration and recalibration.drift else None,
        replaces=_parent(listed, index),
        cameras=one.read.names,
        kept=recalibration.kept if recalibration else (),
        quantities=quantities,
        notes=tuple(notes),
    )


def _parent(listed: Sequence[FoundCalibration], index: int) -> int | None:
    """Number of the calibration that it says it replaces."""
    result = listed[index].result
    old = result.provenance.replaces if result else None
    hashes = [one.sha256 for one in listed]
    return hashes.index(old.sha256) + 1 if old and old.sha256 in hashes else None


# ---- the same cameras ----------------------------------------------------------------------


def _same_names(
    listed: Sequence[FoundCalibration],
) -> tuple[list[FoundCalibration], list[list[str]]]:
    """Cameras by name; those of a file that shares none with the one before by their order."""
    out: list[FoundCalibration] = []
    notes: list[list[str]] = []
    for one in listed:
        before, said = out[-1].read if out else one.read, list[str]()
        strangers = set(one.read.names).isdisjoint(before.names)
        if strangers and len(one.read.names) == len(before.names):
            names = [a for a, _ in match(before, one.read, None)[0]]
            called = ", ".join(f"{a} = {b}" for a, b in zip(names, one.read.names, strict=True))
            said.append(f"cameras are called otherwise: matched by their order, {called}")
            one = replace(one, read=renamed(one.read, names))
        out.append(one)
        notes.append(said)
    return out, notes


def _with_sizes(
    listed: Sequence[FoundCalibration],
) -> tuple[list[FoundCalibration], list[list[str]]]:
    """Where a file states no image size, the newest that is stated of that camera."""
    known: dict[str, tuple[int, int]] = {}
    for one in listed:
        known |= {c.name: c.size for c in one.read.cameras if c.size != NO_SIZE}
    out, notes = [], []
    for one in listed:
        missing = [c.name for c in one.read.cameras if c.size == NO_SIZE]
        cameras = tuple(
            replace(c, size=known.get(c.name, NO_SIZE)) if c.name in missing else c
            for c in one.read.cameras
        )
        out.append(replace(one, read=replace(one.read, cameras=cameras)))
        said = f"states no image size of {', '.join(missing)}: taken to be the others'"
        notes.append([said] if missing else [])
    return out, notes


def _reference(listed: Sequence[FoundCalibration]) -> str | None:
    """That of the newest rig; None where no file says how cameras sit."""
    rigs = (one.read for one in reversed(listed) if _is_rig(one.read))
    newest = next(rigs, None)
    return None if newest is None else reference_of(newest)


def _is_rig(read: CameraRig) -> bool:
    return read.cam_from_rig is not None and len(read.cameras) > 1


def _wide(listed: Sequence[FoundCalibration]) -> frozenset[str]:
    """Cameras to which some calibration gives a lens that sees sideways."""
    cameras = (camera for one in listed for camera in one.read.cameras)
    return frozenset(camera.name for camera in cameras if LENSES[camera.lens].wide)


# ---- numbers -------------------------------------------------------------------------------


def _numbers(
    one: FoundCalibration, reference: str | None, wide: frozenset[str], options: HistoryOptions
) -> Iterator[Number]:
    side = one.read.stated
    wanted = options.camera or one.read.names
    for camera in side.estimate.cameras:
        if camera.name in wanted:
            own = _of_lens(side, camera, camera.name in wide)
            yield from (n for n in own if n.group in options.parameters)
    if not _is_rig(one.read):
        return
    unit, key = _unit(one)
    if reference in one.read.names:
        from_reference = seen_from(side, reference)
        for index, name in enumerate(one.read.names):
            if name != reference and name in wanted:
                placed = _of_place(from_reference, index, one.read.states_sigmas, unit, key)
                yield from (n for n in placed if n.group in options.parameters)
    if "baseline" in options.parameters:
        for a, b in combinations(range(len(one.read.names)), 2):
            if {one.read.names[a], one.read.names[b]} & set(wanted):
                yield _baseline(side, (a, b), one.read.states_sigmas, unit, key)


def _of_lens(side: Stated, camera: Camera, wide: bool) -> Iterator[Number]:
    values, by_params = lens_shape(camera, wide)
    names = lens_names(camera)
    stated = not set(names).isdisjoint(side.covariance.names)
    cov = by_params @ cross_covariance(side.covariance, names, names) @ by_params.T
    for name, value, variance in zip(SHAPE_NAMES, values, np.diag(cov), strict=True):
        group = GROUP_OF_SHAPE[name]
        if not np.isfinite(value) or (group == "distortion" and camera.size == NO_SIZE):
            continue
        sigma = float(max(variance, 0.0)) ** 0.5
        if max(abs(float(value)), sigma) < NOTHING_PX:  # of a lens that has no such term
            value, sigma = 0.0, 0.0
        spread = sigma if stated else None
        yield Number(f"{camera.name}.{name}", group, float(value), spread, "px", camera.size)


def _of_place(side: Stated, index: int, stated: bool, unit: str, key: object) -> Iterator[Number]:
    name, placed = side.estimate.cameras[index].name, side.estimate.cam_from_rig[index]
    turn, sigma = np.degrees(log_rotation(placed.rotation)), side.covariance.sigma
    values = (*turn.tolist(), *placed.translation.tolist())
    for place, (full, value) in enumerate(zip(pose_names(name), values, strict=True)):
        spread = sigma.get(full, 0.0) if stated else None
        if place < 3:
            degrees = None if spread is None else float(np.degrees(spread))
            yield Number(full, "pointing", value, degrees, "deg", None, placed.rotation)
        else:
            yield Number(full, "translation", value, spread, unit, key)


def _baseline(side: Stated, pair: tuple[int, int], stated: bool, unit: str, key: object) -> Number:
    a, b = (side.estimate.cam_from_rig[index] for index in pair)
    first, second = (side.estimate.cameras[index].name for index in pair)
    apart = (b @ a.inverse).translation
    length = float(np.linalg.norm(apart))
    cov = relative(side.covariance, side.estimate, pair[1], pair[0]).matrix[3:, 3:]
    along = apart / max(length, 1e-300)
    variance = float(along @ cov @ along)
    sigma = variance**0.5 if variance > ROUNDING * float(np.trace(cov)) else 0.0
    name = f"{first} to {second}.baseline"
    return Number(name, "baseline", length, sigma if stated else None, unit, key)


def _unit(one: FoundCalibration) -> tuple[str, object]:
    """The unit of a file's lengths in print, and what has to be equal to compare them."""
    if one.read.unit == "m":
        return "m", METRES
    if one.result is not None:
        source = one.result.rig.scale.source.removeprefix("none: unit is the ")
        return "baseline", source if one.read.unit == "baseline" else one.sha256
    return one.read.unit, one.sha256  # its own: nobody knows


# ---- beside the ones before ----------------------------------------------------------------


def _newest_keys(numbers: Sequence[Sequence[Number]]) -> dict[str, object]:
    """By what each number is compared: as the newest has it, but metres before any other unit."""
    newest: dict[str, object] = {}
    for number in (number for own in numbers for number in own):
        if newest.get(number.name) != METRES:
            newest[number.name] = number.key
    return newest


def _quantity(number: Number, newest: dict[str, object], so_far: Compared) -> Quantity:
    place = (number.name, number.key)
    first, before = so_far.first.setdefault(place, number), so_far.before.get(place)
    so_far.before[place] = number
    change = None if before is None else _difference(number, before)
    sigmas = None if before is None else (number.sigma, before.sigma)
    z = None
    if change is not None and sigmas and sigmas[0] is not None and sigmas[1] is not None:
        combined = float(np.hypot(sigmas[0], sigmas[1]))
        z = change / combined if combined > 0 else None
    return Quantity(
        name=number.name,
        group=number.group,
        value=number.value,
        sigma=number.sigma,
        unit=number.unit,
        compared=newest[number.name] == number.key,
        since_first=_difference(number, first),
        change=change,
        z=z,
    )


def _difference(number: Number, other: Number) -> float:
    """Of two values; of two rotations the turn about the camera's axis."""
    if number.rotation is None or other.rotation is None:
        return number.value - other.value
    turn = np.degrees(log_rotation(number.rotation @ other.rotation.T))
    return float(turn["xyz".index(number.name[-1])])


def _notes(listed: Sequence[FoundCalibration], index: int, reference: str | None) -> Iterator[str]:
    """What has to be known to read one calibration beside the others."""
    one = listed[index]
    if index:
        before = {c.name: c.lens for c in listed[index - 1].read.cameras}
        now = {c.name: c.lens for c in one.read.cameras}
        if lacking := [name for name in before if name not in now]:
            yield f"lacks {', '.join(lacking)}"
        if more := [name for name in now if name not in before]:
            yield f"has {', '.join(more)} besides"
        for name, lens in now.items():
            if lens != before.get(name, lens):
                yield f"{name} is {lens}, before it was {before[name]}"
    if not one.read.states_sigmas:
        yield "states no sigmas"
    if len(one.read.cameras) > 1 and one.read.cam_from_rig is None:
        yield "does not say how its cameras sit"
    elif _is_rig(one.read) and reference not in one.read.names:
        yield f"lacks the reference {reference}: how its cameras sit is told by baselines alone"
    recalibration = one.result.recalibration if one.result else None
    if recalibration and recalibration.kept:
        yield f"{', '.join(recalibration.kept)} copied from {recalibration.old.path}"
    if recalibration and recalibration.prior == "full":
        yield (
            f"had {recalibration.old.path} as a prior: its change from that is not independent, "
            "and z too small"
        )


def _not_compared(own: Sequence[Number], newest: dict[str, object]) -> Iterator[str]:
    """Numbers in other pixels or another unit of length than the newest's."""
    other = [number for number in own if newest[number.name] != number.key]
    sizes = {n.name.rpartition(".")[0]: n.key for n in other if n.unit == "px"}
    for name, size in sizes.items():
        if isinstance(size, tuple):
            yield f"{name} has {size[0]} x {size[1]} px: not compared in pixels"
    units = {number.unit for number in other if number.group in ("translation", "baseline")}
    for unit in units:
        yield f"lengths in {unit if unit == 'm' else 'no metres'}: not compared"

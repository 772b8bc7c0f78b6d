"""Times as files give them: which unit they have, and which images were taken at one moment."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sfm_calib.errors import CalibrationError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NUMBER = re.compile(r"[+-]?[0-9]+(\.[0-9]*)?([eE][+-]?[0-9]{1,2})?")  # NumPy writes exponents
# Seconds since 1970 from 1985 to 2286: the ranges of the four units do not overlap.
EPOCH_S = (Decimal(500_000_000), Decimal(10_000_000_000))
SECONDS = {"s": Decimal(1), "ms": Decimal("1e-3"), "us": Decimal("1e-6"), "ns": Decimal("1e-9")}
# A clock since boot, in us, may lie in the range of seconds since 1970; then its images would be
# hours apart.
LONGEST_EPOCH_SPACING_S = 600
# Other clocks are told by their spacing alone: 4 ms (250 Hz) to 4 s is taken as likely, which is
# the factor of 1000 that makes one unit fit.
LEAST_SPACING_S = 4e-3
# Up to a third of the spacing, no image is within reach of two that follow each other evenly.
TOLERANCE_OF_SPACING = 1 / 3
ROUNDING_S = 1e-9


@dataclass(frozen=True)
class Times:
    """When each camera's images were taken, in seconds from the earliest of all."""

    of: Mapping[str, FloatArray]  # (n,) of each camera, in the order of its images
    unit: str  # they were written in: s, ms, us or ns


@dataclass(frozen=True)
class Moments:
    """Which images of several cameras were taken together, in order of time."""

    images: IntArray  # (n_moments, n_cameras): place in the camera's images, or -1
    tolerance_s: float
    widest_s: float  # between two images of one moment

    @property
    def n_alone(self) -> int:
        """Images that found no partner."""
        return int(np.count_nonzero((self.images >= 0).sum(axis=1) == 1))


def number_of(text: str) -> Decimal | None:
    """A time as it is written, to the last digit; None where it is no number."""
    return Decimal(text) if NUMBER.fullmatch(text) else None


def read_times(texts: Mapping[str, Sequence[str]]) -> Times:
    """The times of each camera's images from numbers as they are written.

    Decimals are seconds; the unit of integers is told from their size and spacing.
    Raises ValueError where a text is no number: `number_of` says which.
    """
    written = {camera: [_number(text) for text in own] for camera, own in texts.items()}
    every = [value for own in written.values() for value in own]
    decimal = any(
        value != value.to_integral_value() or ("." in text and "e" not in text.lower())
        for camera, own in written.items()
        for text, value in zip(texts[camera], own, strict=True)
    )
    # Decimals until the difference is taken: 19 digits do not fit into a float.
    first = min(every)
    shifted = {name: np.array([float(v - first) for v in own]) for name, own in written.items()}
    unit = "s" if decimal else _unit(sorted(every)[len(every) // 2], _spacing(shifted.values()))
    scale = float(SECONDS[unit])
    return Times({camera: own * scale for camera, own in shifted.items()}, unit)


def _number(text: str) -> Decimal:
    value = number_of(text)
    if value is None:
        raise ValueError(f"{text!r} is no number")
    return value


def _unit(middle: Decimal, spacing: float | None) -> str:
    for unit, scale in SECONDS.items():
        since_1970 = EPOCH_S[0] <= middle * scale < EPOCH_S[1]
        if since_1970 and (spacing or 0) * float(scale) <= LONGEST_EPOCH_SPACING_S:
            return unit
    if spacing is None:
        return "s"
    return next(
        (
            unit
            for unit, scale in SECONDS.items()
            if spacing * float(scale) < LEAST_SPACING_S * 1000
        ),
        "ns",
    )


def _spacing(times: Iterable[FloatArray]) -> float | None:
    """Median time between images of one camera that follow each other; None without any."""
    steps = [np.diff(np.sort(own)) for own in times]
    every = np.concatenate(steps)
    return float(np.median(every[every > 0])) if (every > 0).any() else None


def group_by_time(
    times: Mapping[str, FloatArray],
    tolerance_s: float | None,
    name: Callable[[str, int], str],
) -> Moments:
    """Which images were taken together: the nearest of each camera, within a tolerance.

    `name(camera, place)` is what messages call an image. Without a tolerance, it is a third of
    the median spacing of a camera's images.
    Raises CalibrationError when no tolerance can be told, or a camera has two images within it.
    """
    tolerance = tolerance_s
    if tolerance is None:
        spacing = _spacing(times.values())
        if spacing is None:
            raise CalibrationError(
                "no camera has two images, so their spacing says nothing of how near in time two "
                "cameras' images must be: give tolerance_s"
            )
        tolerance = spacing * TOLERANCE_OF_SPACING
    _check_unambiguous(times, tolerance, name)
    camera = np.repeat(np.arange(len(times)), [len(own) for own in times.values()])
    place = np.concatenate([np.arange(len(own)) for own in times.values()])
    seconds = np.concatenate(list(times.values()))
    order = np.argsort(seconds, kind="stable")
    camera, place, seconds = camera[order], place[order], seconds[order]
    groups = _nearest_groups(seconds, camera, tolerance + ROUNDING_S)
    images = np.full((len(groups), len(times)), -1, np.int64)
    for row, members in enumerate(groups):
        images[row, camera[members]] = place[members]
    widest = max(float(np.ptp(seconds[members])) for members in groups)
    return Moments(images, tolerance, widest)


def _check_unambiguous(
    times: Mapping[str, FloatArray], tolerance_s: float, name: Callable[[str, int], str]
) -> None:
    reach = tolerance_s + ROUNDING_S
    ordered = {camera: np.argsort(own, kind="stable") for camera, own in times.items()}
    for camera, own in times.items():
        order = ordered[camera]
        twice = np.flatnonzero(np.diff(own[order]) == 0)
        if twice.size:
            one, two = (name(camera, int(order[twice[0] + k])) for k in (0, 1))
            raise CalibrationError(
                f"camera {camera}: {one} and {two} were taken at the same time: remove one of them"
            )
    for one, other in [pair for both in combinations(times, 2) for pair in (both, both[::-1])]:
        order = ordered[other]
        theirs = times[other][order]
        first = np.searchsorted(theirs, times[one] - reach, "left")
        several = np.flatnonzero(np.searchsorted(theirs, times[one] + reach, "right") - first > 1)
        if several.size:
            middle = int(several[0])
            a, b = (int(order[first[middle] + k]) for k in (0, 1))
            raise CalibrationError(
                f"camera {other}: {name(other, a)} and {name(other, b)} both lie within "
                f"{tolerance_s * 1e3:.3g} ms of {one}'s {name(one, middle)}: give a tolerance_s "
                "below half the shortest time between two images, or remove one of them"
            )


def _nearest_groups(seconds: FloatArray, camera: IntArray, reach_s: float) -> list[list[int]]:
    """Groups of images (in order of time) of different cameras that lie within reach of each
    other; the nearest two of all are joined first."""
    found: list[tuple[float, int, int]] = []
    for step in range(1, len(seconds)):
        gaps = seconds[step:] - seconds[:-step]
        near = np.flatnonzero(gaps <= reach_s)
        if not near.size:
            break
        near = near[camera[near] != camera[near + step]]
        found += [(float(gaps[i]), int(i), int(i + step)) for i in near]
    group = list(range(len(seconds)))
    members = [[i] for i in group]
    for _, one, other in sorted(found):
        into, gone = group[one], group[other]
        union = members[into] + members[gone]
        cameras = {int(camera[i]) for i in union}
        if into == gone or len(cameras) < len(union) or np.ptp(seconds[union]) > reach_s:
            continue
        for i in members[gone]:
            group[i] = into
        members[into], members[gone] = union, []
    return sorted((sorted(own) for own in members if own), key=lambda own: seconds[own[0]])


def told_of(moments: Moments, unit: str, what: str) -> str:
    """One line on how well images, called `what`, were matched."""
    n = int(np.count_nonzero(moments.images >= 0))
    return (
        f"{what} matched by time (read as {unit}): {n - moments.n_alone} of {n} found a partner "
        f"within {moments.tolerance_s * 1e3:.3g} ms, {moments.n_alone} found none; the largest "
        f"accepted gap is {moments.widest_s * 1e3:.3g} ms"
    )

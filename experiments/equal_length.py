"""At how many images one way of calibrating errs as much as another, from trials of many seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.standard_errors import mean_and_error, rms

DRAWS, SEED = 400, 0  # of the seeds, with replacement
INTERVAL = (0.16, 0.84)  # as one standard error to each side


@dataclass(frozen=True)
class Curve:
    """What came of one way to calibrate: an error by the number of images, and by the seed."""

    errors: Mapping[int, Mapping[int, float]]

    @property
    def images(self) -> tuple[int, ...]:
        return tuple(sorted(self.errors))

    def rms(self, images: int) -> float:
        """Over all seeds."""
        return rms(list(self.errors[images].values()))

    def rms_error(self, images: int) -> float:
        """Standard error of the rms, from the scatter of the seeds; infinite of a single one."""
        square = np.square(list(self.errors[images].values()))
        mean, error = mean_and_error(square)
        return error / (2 * mean**0.5)

    def drawn(self, seeds: Sequence[int]) -> Curve:
        """Of these seeds, some of them often; without lengths of which none is left."""
        errors = {
            images: {place: of[seed] for place, seed in enumerate(seeds) if seed in of}
            for images, of in self.errors.items()
        }
        return Curve({images: of for images, of in errors.items() if of})


@dataclass(frozen=True)
class Equal:
    """The number of images from which on a curve is no higher than a level.

    0: from the shortest on already. inf: not up to the longest.
    """

    images: float
    interval: tuple[float, float]
    shortest: int
    longest: int

    def __str__(self) -> str:
        low, high = (self.words(value) for value in self.interval)
        return self.short if low == high == self.short else f"{self.short} ({low} to {high})"

    @property
    def short(self) -> str:
        """Without the interval."""
        return self.words(self.images)

    def words(self, images: float) -> str:
        """A number of images, or which side of all that were tried it lies."""
        if images == 0:
            return f"{self.shortest} or fewer"
        return f"{images:.0f}" if np.isfinite(images) else f"more than {self.longest}"


def first_below(images: Sequence[int], values: Sequence[float], level: float) -> float:
    """The number of images from which on values stay at the level or below, between two of them
    as a power law has it."""
    above = [index for index, value in enumerate(values) if value > level]
    if not above:
        return 0.0
    last = above[-1]
    if last + 1 == len(values):
        return float("inf")
    x, y = np.log(images[last : last + 2]), np.log(np.maximum(values[last : last + 2], 1e-300))
    return float(np.exp(x[0] + (np.log(level) - y[0]) / (y[1] - y[0]) * (x[1] - x[0])))


def equal(curve: Curve, other: Curve, images: int) -> Equal:
    """Where a curve comes down to what the other has at a number of images.

    The interval is a bootstrap over the seeds, the same ones of both.
    """
    found = [_once(curve, other, images)]
    seeds = sorted({s for of in (*curve.errors.values(), *other.errors.values()) for s in of})
    rng = np.random.default_rng(SEED)
    for _ in range(DRAWS):
        some = rng.choice(seeds, len(seeds)).tolist()
        a, b = curve.drawn(some), other.drawn(some)
        if len(a.images) == len(curve.images) and images in b.images:
            found.append(_once(a, b, images))
    ordered = np.sort(found)
    low, high = (float(ordered[int(q * (len(ordered) - 1) + 0.5)]) for q in INTERVAL)
    return Equal(found[0], (low, high), curve.images[0], curve.images[-1])


def _once(curve: Curve, other: Curve, images: int) -> float:
    return first_below(curve.images, [curve.rms(n) for n in curve.images], other.rms(images))

"""Which parameters hang on the choice of the lens, where held-out frames do not settle it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.camera import Camera, project, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.image_grid import image_grid, without_rotation
from graphs.jackknife import change
from graphs.ladder import Ladder, RungResult
from graphs.problem import Estimate

MOVED_SIGMAS = 1.0  # stated sigmas by which another lens has to move a parameter to be told


@dataclass(frozen=True)
class LensDoubt:
    """A lens that predicts frames no worse than the chosen one, and what it would change."""

    label: str  # of the rival
    gain_px: float  # held-out error that it removes
    gain_sigmas: float
    verdict: str  # why the ladder did not take it
    parameters: tuple[str, ...]  # that it moves by more than MOVED_SIGMAS, the most moved first
    moves: tuple[float, ...]  # in their own units
    moves_sigmas: tuple[float, ...]
    effect_px: float  # rms over the images, each turned as suits best
    corner_px: float  # at the worst place of any image


def lens_doubt(ladder: Ladder, stated: Covariance) -> LensDoubt | None:
    """The rival that would change the picture most; None: none does as well and matters.

    stated: of the final result.
    """
    best = ladder.best
    rivals = [
        rung
        for rung in ladder.rungs[ladder.chosen + 1 :]
        if rung.against == ladder.chosen and rung.gain_px > 0
    ]
    doubts = [doubt for rung in rivals if (doubt := _doubt(best, rung, stated)) is not None]
    return max(doubts, key=lambda doubt: doubt.effect_px, default=None)


def _doubt(best: RungResult, rival: RungResult, stated: Covariance) -> LensDoubt | None:
    shared = [
        name
        for name in stated.names
        if ".translation_" not in name  # one of them is the unit
        and name in best.covariance.stated.names
        and name in rival.covariance.stated.names
    ]
    before, after = best.estimate, rival.estimate
    moved = dict(zip(shared, change(before, after, tuple(shared)), strict=True))
    sigmas = {name: move / stated.sigma[name] for name, move in moved.items()}
    named = sorted(
        (name for name in shared if abs(sigmas[name]) > MOVED_SIGMAS),
        key=lambda name: -abs(sigmas[name]),
    )
    if not named:
        return None
    effects = [_apart(a, b) for a, b in zip(before.cameras, after.cameras, strict=True)]
    return LensDoubt(
        rival.rung.label,
        rival.gain_px,
        rival.gain_sigmas,
        rival.verdict,
        tuple(named),
        tuple(float(moved[name]) for name in named),
        tuple(float(sigmas[name]) for name in named),
        max(float(np.sqrt((effect**2).mean())) for effect in effects),
        max(float(effect.max()) for effect in effects),
    )


def _apart(a: Camera, b: Camera) -> FloatArray:
    """Lengths (n,) in px by which two cameras project the same rays apart, one turned as suits."""
    alone = Estimate((a,), (Transform.identity(),), (), np.zeros((0, 3)))
    grid = image_grid(alone, (), [np.inf])
    apart = project(b, unproject(a, grid.pixels)) - grid.pixels
    seen = np.isfinite(apart[:, 0])
    left = without_rotation(grid.by_rotation[seen], apart[seen, :, None])
    lengths: FloatArray = np.linalg.norm(left[..., 0], axis=1)
    return lengths

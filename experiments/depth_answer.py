"""What the trials of `depth_error` say together: exponents and ratios."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.depth_laws import LAWS, Effect
from experiments.runner.protocol import Row
from experiments.scatter import (
    FEWEST,
    STANDARD_ERRORS,
    Value,
    in_digits,
    mean_of,
    root_of,
    stacked,
    within,
)
from experiments.stereo import LensShape
from graphs.frames import FloatArray

# Of second order, and of the parallax: 8 m are 27 to 80 baselines, 0.3 px there up to 9 % of the
# depth (4.5 times its square: ratio 1.03), and the two cameras' radii differ by b / Z.
EXPONENT_ROOM = 0.05
RATIO_ROOM = 0.02
# Of scans: `coverage` promises a NEES of 0.9 to 1.15.
Z_RMS = (0.9**0.5, 1.15**0.5)


@dataclass(frozen=True)
class Group:
    """All trials of one effect and one kind of lens."""

    effect: Effect | Literal["scan"]
    shape: LensShape
    trials: int
    at: FloatArray  # (n,) depths in m, or radii
    rms_m: FloatArray  # (n,)
    propagated_m: FloatArray  # (n,)
    noise_m: FloatArray | None  # (n,) of scans
    expected: float | None  # exponent; None: the law is one of straight lenses, or of none
    exponent: Value | tuple[None, None]
    exponent_propagated: float
    ratio: Value  # rms over propagated; of scans, RMS of z
    ratio_at: tuple[Value, ...]  # the same point by point
    of_closed: float | None  # propagated over the textbook's, mean
    total: Value | tuple[None, None]  # of scans: RMS of z with the pixels' noise
    bias: float  # mean error over the RMS, where it is most

    @property
    def said(self) -> str:
        return LAWS[self.effect].said if self.effect != "scan" else "sigma stated by a scan"


def group_of(effect: Effect | Literal["scan"], shape: LensShape, rows: Sequence[Row]) -> Group:
    """The rows of one effect together; rigs may differ."""
    at, rms, propagated = (stacked(rows, key) for key in ("at", "rms_m", "propagated_m"))
    scan = effect == "scan"
    square = stacked(rows, "z_square") if scan else (rms / propagated) ** 2
    law = None if effect == "scan" else LAWS[effect]
    pooled_m = np.sqrt((propagated**2).mean(0))
    return Group(
        effect,
        shape,
        len(rows),
        at[0],
        np.sqrt((rms**2).mean(0)),
        pooled_m,
        np.sqrt((stacked(rows, "noise_m") ** 2).mean(0)) if scan else None,
        law.exponent if law and (shape == "straight" or law.over == "depth") else None,
        (None, None) if scan else mean_of(stacked(rows, "exponent")),
        float(stacked(rows, "exponent_propagated").mean()),
        root_of(square.mean(1)),
        tuple(root_of(column) for column in square.T),
        None if scan else float((propagated / stacked(rows, "closed_m")).mean()),
        root_of(stacked(rows, "z_square_total").mean(1)) if scan else (None, None),
        float(np.abs((stacked(rows, "bias_m") / rms).mean(0)).max()),
    )


# ---- the verdict ---------------------------------------------------------------------------


def judged(groups: Sequence[Group]) -> bool | None:
    """Whether each effect is as expected; None: of some there are too few trials to say."""
    if any(g.trials < FEWEST for g in groups):
        return None
    return not broken(groups)


def broken(groups: Sequence[Group]) -> list[Group]:
    """Groups that are not as expected, by more than chance."""
    return [g for g in groups if not (_exponent_holds(g) and _ratio_holds(g))]


def _exponent_holds(group: Group) -> bool:
    value, error = group.exponent
    if group.expected is None or value is None:
        return True
    return abs(value - group.expected) <= EXPONENT_ROOM + STANDARD_ERRORS * (error or 0.0)


def _ratio_holds(group: Group) -> bool:
    if group.effect != "scan":
        return within(group.ratio, 1 - RATIO_ROOM, 1 + RATIO_ROOM)
    value, error = group.total
    assert value is not None
    return within(group.ratio, *Z_RMS) and within((value, error), *Z_RMS)


def in_words(groups: Sequence[Group]) -> str:
    """The numbers that decide, in one line."""
    parts = []
    for g in groups:
        if g.effect == "scan" or g.exponent[0] is None:
            continue
        of_lens = "" if g.shape == "straight" else f", {g.shape} lens"
        over = "Z" if LAWS[g.effect].over == "depth" else "r"
        bar = "" if not g.exponent[1] else f" ± {g.exponent[1]:.2f}"
        parts.append(f"{g.effect}{of_lens} {over}^{g.exponent[0]:.2f}{bar}")
    said = [", ".join(parts)] if parts else []
    ratios = [g.ratio for g in groups if g.effect != "scan"]
    if ratios:
        low, high = min(r[0] for r in ratios), max(r[0] for r in ratios)
        said.append(f"Monte Carlo / propagated {low:.3f} to {high:.3f}")
    for g in groups:
        if g.effect == "scan":
            noisy = "" if g.total[0] is None else f", {g.total[0]:.2f} with the noise of pixels"
            said.append(
                f"{g.trials} calibrated scans: depth errors {in_digits(g.ratio)} of their stated "
                f"sigma{noisy}"
            )
    names = [
        g.effect if g.shape == "straight" else f"{g.effect} ({g.shape})" for g in broken(groups)
    ]
    if names:
        said.append(f"not as expected: {', '.join(names)}")
    return "; ".join(said)

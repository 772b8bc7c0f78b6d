"""How `lens: auto` was decided: every lens that was tried, and why it was taken or not."""

from __future__ import annotations

from dataclasses import dataclass

from sfm_calib.report.digits import short
from sfm_calib.result import Calibration, LensChoice, Rung

NONE = "–"


@dataclass(frozen=True)
class RungRow:
    """One lens of the ladder, ready to print."""

    lens: str
    chosen: bool
    held_out: str
    gain: str
    gain_sigmas: str
    against: str
    focal: str
    centre: str
    sigma_fx: str
    sigma_cx: str
    weak: tuple[str, ...]
    verdict: str


@dataclass(frozen=True)
class LensLadder:
    """The ladder's reason and its rungs."""

    reason: str
    n_frames: int
    n_observations: int
    rows: tuple[RungRow, ...]


def lens_ladder(calibration: Calibration) -> LensLadder | None:
    """The ladder; None where every lens was given."""
    choice = calibration.lens_choice
    if choice is None:
        return None
    rows = tuple(_row(choice, index) for index in range(len(choice.rungs)))
    return LensLadder(choice.reason, choice.n_frames, choice.n_observations, rows)


def rung_label(rung: Rung) -> str:
    """The lens, and what it holds."""
    return rung.lens + (f" without {', '.join(rung.held)}" if rung.held else "")


def _row(choice: LensChoice, index: int) -> RungRow:
    rung = choice.rungs[index]
    compared, judged = rung.against != index, rung.held_out_px is not None
    return RungRow(
        rung_label(rung),
        index == choice.chosen,
        NONE if rung.held_out_px is None else f"{rung.held_out_px:.4f}",
        f"{rung.gain_px:+.4f}" if compared and judged else NONE,
        f"{rung.gain_sigmas:+.1f}" if compared and judged else NONE,
        rung_label(choice.rungs[rung.against]) if compared else NONE,
        f"{rung.shift_focal_px:.1f}" if compared else NONE,
        f"{rung.shift_centre_px:.1f}" if compared else NONE,
        _largest(rung, "fx"),
        _largest(rung, "cx"),
        rung.weak,
        rung.verdict,
    )


def _largest(rung: Rung, parameter: str) -> str:
    """Of all cameras."""
    own = [s for name, s in rung.sigma.items() if name.rpartition(".")[2] == parameter]
    return short(max(own)) if own else NONE

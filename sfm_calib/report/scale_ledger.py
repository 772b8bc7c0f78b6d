"""Every measured length beside what the solve and all others make of it."""

from __future__ import annotations

from dataclasses import dataclass

from sfm_calib.report.digits import decimals_for, number, short
from sfm_calib.result import Calibration, ScaleEntry

NONE = "–"


@dataclass(frozen=True)
class LedgerRow:
    """One source of scale, ready to print."""

    what: str
    measured: str
    sigma: str
    estimated: str
    residual_mm: str
    residual_percent: str
    predicted: str
    sigma_predicted: str
    z: str
    p_value: str
    contradicts: bool
    flag: str


@dataclass(frozen=True)
class LedgerSection:
    """Whether the sources agree, and each of them."""

    summary: str
    rows: tuple[LedgerRow, ...]


def ledger_section(calibration: Calibration) -> LedgerSection | None:
    """The ledger; None for results without a metric scale, or from before there was one."""
    scale = calibration.rig.scale
    if not scale.ledger:
        return None
    return LedgerSection(_summary(calibration), tuple(_row(entry) for entry in scale.ledger))


def _summary(calibration: Calibration) -> str:
    scale = calibration.rig.scale
    if len(scale.ledger) == 1 and scale.ledger[0].z is None:
        return (
            "One length was measured, and gives all others their unit: nothing tests it. A second "
            "one, of another kind, would."
        )
    if not scale.contradicted:
        return "The measured lengths agree with each other within their sigmas."
    return (
        "The measured lengths contradict each other. All lengths of this result are a compromise "
        "between them, and their sigmas do not allow for that."
    )


def _row(entry: ScaleEntry) -> LedgerRow:
    decimals = decimals_for(entry.sigma_m)
    predicted, sigma = entry.predicted_by_others_m, entry.sigma_predicted_m
    return LedgerRow(
        what=entry.what,
        measured=number(entry.measured_m, decimals),
        sigma=number(entry.sigma_m, decimals),
        estimated=number(entry.estimated_m, decimals),
        residual_mm=number(1000 * entry.residual_m, decimals_for(1000 * entry.sigma_m)),
        residual_percent=f"{entry.residual_percent:+.2g}",
        predicted=NONE if predicted is None else number(predicted, decimals_for(sigma or 0.0)),
        sigma_predicted=NONE if sigma is None else short(sigma),
        z=NONE if entry.z is None else f"{entry.z:+.1f}",
        p_value=NONE if entry.p_value is None else f"{entry.p_value:.2g}",
        contradicts=entry.contradicts,
        flag="may be wrong" if entry.suspect else "",
    )

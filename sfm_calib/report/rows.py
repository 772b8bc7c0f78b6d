"""The tables: every estimated quantity with its sigma, what the prior did, and the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphs.frames import log_rotation
from graphs.lenses import PARAMETER_NAMES
from sfm_calib.report.digits import decimals_for, number
from sfm_calib.report.weak import Mark, length_unit, marks_of
from sfm_calib.result import PRIOR_DECIDES_SHARE, Calibration, CameraResult

AXES = "xyz"
# A normal error beyond 4 sigma comes once in 16,000: the sigma, not chance, is then to blame.
Z_ALARM = 4.0
HELD = "held fixed"
ROUNDING = 1e-12  # of the variances that cancel in a baseline that is the unit
UNIT_OF_PARAMETER = {"fx": "px", "fy": "px", "cx": "px", "cy": "px"}


@dataclass(frozen=True)
class TruthRow:
    """One quantity beside its truth.

    `name` as in the covariance (`camera.fx`, `camera.rotation_x`, `camera.translation_x`);
    rotations in degrees, lengths in the estimate's unit. z = error / sigma.
    """

    name: str
    estimate: float
    truth: float
    error: float
    sigma: float
    z: float

    @property
    def alarming(self) -> bool:
        """Whether the stated sigma cannot explain the error."""
        return abs(self.z) > Z_ALARM


@dataclass(frozen=True)
class TruthCells:
    """The truth as the table prints it."""

    truth: str
    error: str
    z: str
    alarming: bool


@dataclass(frozen=True)
class QuantityRow:
    """One line of a table, ready to print."""

    name: str  # as in the covariance
    label: str
    value: str
    sigma: str
    unit: str
    prior_share: float | None
    truth: TruthCells | None
    marks: tuple[Mark, ...] = ()

    @property
    def held(self) -> bool:
        """Whether it was not estimated: what its prior did is then no question."""
        return self.sigma == HELD

    @property
    def prior_percent(self) -> float | None:
        """The share as the length of its bar."""
        return None if self.prior_share is None else min(max(100 * self.prior_share, 0.0), 100.0)

    @property
    def prior_decides(self) -> bool:
        """Whether the value is more belief than data."""
        return not self.held and (self.prior_share or 0.0) > PRIOR_DECIDES_SHARE


@dataclass(frozen=True)
class CameraTable:
    """The rows of one camera under its name."""

    name: str
    caption: str
    rows: tuple[QuantityRow, ...]


Truths = Mapping[str, TruthRow]


def quantity(
    name: str,
    label: str,
    value: float,
    sigma: float | None,
    unit: str,
    truths: Truths,
    prior_share: float | None = None,
) -> QuantityRow:
    """One row; a missing sigma means not estimated, a sigma of zero held fixed."""
    decimals = decimals_for(sigma) if sigma is not None else None
    if sigma is None:
        spread = "not estimated"
    elif sigma == 0:
        spread = HELD
    else:
        spread = number(sigma, decimals) if decimals is not None else "unknown"
    truth = truths.get(name)
    cells = None if truth is None else truth_cells(truth)
    return QuantityRow(name, label, number(value, decimals), spread, unit, prior_share, cells)


def truth_cells(row: TruthRow) -> TruthCells:
    """The truth's columns, with the digits that the sigma supports."""
    decimals = decimals_for(row.sigma)
    z = f"{row.z:+.1f}" if math.isfinite(row.z) else "–"
    return TruthCells(number(row.truth, decimals), number(row.error, decimals), z, row.alarming)


def camera_tables(
    calibration: Calibration, truth_rows: Sequence[TruthRow] = ()
) -> tuple[CameraTable, ...]:
    """The lens parameters of every camera."""
    truths, marks = {row.name: row for row in truth_rows}, marks_of(calibration)
    return tuple(
        CameraTable(name, _camera_caption(entry), marked(_lens_rows(name, entry, truths), marks))
        for name, entry in calibration.cameras.items()
    )


def marked(
    rows: Sequence[QuantityRow], marks: Mapping[str, tuple[Mark, ...]]
) -> tuple[QuantityRow, ...]:
    """The rows with their marks."""
    return tuple(replace(row, marks=marks.get(row.name, ())) for row in rows)


def _camera_caption(entry: CameraResult) -> str:
    caption = f"{entry.lens}, {entry.size[0]} × {entry.size[1]} px"
    if entry.kept_from:
        caption += "; not in the scan: kept as the old calibration has it"
    if entry.n_images:
        caption += f", {entry.n_images:,} images, {entry.n_observations:,} observations"
    if entry.prior_share.get("fy/fx", 0.0) > PRIOR_DECIDES_SHARE:
        caption += "; fy/fx is decided mostly by the prior"
    return caption


def _lens_rows(name: str, entry: CameraResult, truths: Truths) -> tuple[QuantityRow, ...]:
    known = [p for p in PARAMETER_NAMES[entry.lens] if p in entry.params]
    further = [p for p in entry.params if p not in known]
    return tuple(
        quantity(
            f"{name}.{p}",
            p,
            entry.params[p],
            entry.sigma.get(p),
            UNIT_OF_PARAMETER.get(p, ""),
            truths,
            entry.prior_share.get(p),
        )
        for p in (*known, *further)
    )


def rig_tables(
    calibration: Calibration, truth_rows: Sequence[TruthRow] = ()
) -> tuple[CameraTable, ...]:
    """Rotation, translation and distance of every camera but the reference."""
    truths, marks = {row.name: row for row in truth_rows}, marks_of(calibration)
    return tuple(
        CameraTable(
            name,
            _rig_caption(calibration, name),
            marked(_rig_rows(calibration, name, truths), marks),
        )
        for name in calibration.rig.cam_from_rig
        if name != calibration.rig.reference
    )


def _rig_caption(calibration: Calibration, name: str) -> str:
    angle_deg = np.degrees(np.linalg.norm(log_rotation(calibration.cam_from_rig(name).rotation)))
    return f"seen from {calibration.rig.reference}, turned by {angle_deg:.3f}° in all"


def _rig_rows(calibration: Calibration, name: str, truths: Truths) -> tuple[QuantityRow, ...]:
    entry, transform = calibration.rig.cam_from_rig[name], calibration.cam_from_rig(name)
    unit = length_unit(calibration)
    vector_deg = np.degrees(log_rotation(transform.rotation))
    centre_distance = float(np.linalg.norm(transform.translation))
    turns = [
        quantity(f"{name}.rotation_{a}", f"rotation {a}", float(v), s, "°", truths)
        for a, v, s in zip(AXES, vector_deg, entry.sigma_rotation_deg, strict=True)
    ]
    shifts = [
        quantity(f"{name}.translation_{a}", f"translation {a}", float(v), s, unit, truths)
        for a, v, s in zip(AXES, transform.translation, entry.sigma_translation, strict=True)
    ]
    baseline = quantity(
        f"{name}.baseline",
        "baseline length",
        centre_distance,
        baseline_sigma(calibration, name),
        unit,
        truths,
    )
    return (*turns, *shifts, baseline)


def baseline_sigma(calibration: Calibration, name: str) -> float:
    """Sigma of the distance between a camera and the rig's origin, in the rig's unit.

    First order: u' C u with u the direction of the translation; without a covariance in the
    file, C is the diagonal of the stated sigmas. Zero where the baseline is itself the unit.
    """
    entry, names = calibration.rig.cam_from_rig[name], calibration.covariance.names
    translation = np.array(entry.translation)
    direction = translation / max(float(np.linalg.norm(translation)), 1e-300)
    wanted = [f"{name}.translation_{a}" for a in AXES]
    if all(w in names for w in wanted):
        index = [names.index(w) for w in wanted]
        cov = np.array(calibration.covariance.matrix)[np.ix_(index, index)]
    else:
        cov = np.diag(np.square(entry.sigma_translation))
    variance = float(direction @ cov @ direction)
    return variance**0.5 if variance > ROUNDING * float(np.trace(cov)) else 0.0


def rows_without_table(
    tables: Sequence[CameraTable], truth_rows: Sequence[TruthRow]
) -> tuple[QuantityRow, ...]:
    """Comparisons of quantities that no table shows, as rows of their own."""
    shown = {row.name for table in tables for row in table.rows}
    return tuple(
        quantity(row.name, row.name, row.estimate, row.sigma, "", {row.name: row})
        for row in truth_rows
        if row.name not in shown
    )

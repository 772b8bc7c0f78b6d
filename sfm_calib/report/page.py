"""The page itself: figures and tables in reading order, in one file that needs no network."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup
from plotly.offline import get_plotlyjs

from graphs.problem import Estimate, Problem
from sfm_calib.files import write_atomically
from sfm_calib.provenance import Provenance
from sfm_calib.report.board import board_section
from sfm_calib.report.checks import checks_of
from sfm_calib.report.contributions import contribution_section
from sfm_calib.report.correlation import correlation_figure, strongest_pairs, z_figure
from sfm_calib.report.drift import drift_section
from sfm_calib.report.headline import banner, key_figures, truth_summary
from sfm_calib.report.image_plane import (
    arrows_figure,
    coverage_figure,
    empty_share,
    noise_of_cell_mean,
    systematic_figure,
)
from sfm_calib.report.lens_ladder import lens_ladder
from sfm_calib.report.noise import noise_panel
from sfm_calib.report.residuals import (
    CameraResiduals,
    frames_figure,
    histogram_figure,
    radius_figure,
    residuals_by_camera,
    summary,
)
from sfm_calib.report.rows import (
    TruthRow,
    camera_tables,
    rig_tables,
    rows_without_table,
)
from sfm_calib.report.scale_ledger import ledger_section
from sfm_calib.report.scene import rig_figure, scan_figure
from sfm_calib.report.sigmas import sigma_section
from sfm_calib.report.theme import Panel, figure_html, page_template
from sfm_calib.report.uncertainty import uncertainty_section
from sfm_calib.report.weak import length_unit, weak_cards
from sfm_calib.result import Calibration

TITLE = "Calibration report"
RECALIBRATION = "Recalibration report"


@dataclass(frozen=True)
class CameraSection:
    """What the image plane of one camera shows."""

    name: str
    summary: str
    panels: tuple[Panel, ...]


@dataclass(frozen=True)
class Stage:
    """One stage's share of the time."""

    name: str
    seconds: float
    percent_of_longest: float


def write_report(
    calibration: Calibration,
    problem: Problem,
    estimate: Estimate,
    path: Path,
    truth_rows: Sequence[TruthRow] = (),
    title: str = TITLE,
) -> None:
    """Write the report as one HTML file that loads nothing from anywhere.

    `problem` and `estimate` must be those that `calibration` came from, in the same unit of
    length. Raises CalibrationError when the file cannot be written; then nothing is left.
    """
    page = render(calibration, problem, estimate, truth_rows, title)
    # File names that are not UTF-8 reach the page as lone surrogates: a "?" beats no report.
    write_atomically(path, page.encode("utf-8", "replace"))


def render(
    calibration: Calibration,
    problem: Problem,
    estimate: Estimate,
    truth_rows: Sequence[TruthRow] = (),
    title: str = TITLE,
) -> str:
    """The page as text."""
    is_rig = len(calibration.cameras) > 1
    unit = length_unit(calibration)
    sigma_px = calibration.noise.sigma_px if calibration.noise else None
    parts = residuals_by_camera(problem, estimate, sigma_px)
    lenses = camera_tables(calibration, truth_rows)
    rig = rig_tables(calibration, truth_rows) if is_rig else ()
    has_covariance = bool(calibration.covariance.names)
    drift = calibration.recalibration.drift if calibration.recalibration else None
    return page_template("page.html").render(
        title=RECALIBRATION if drift and title == TITLE else title,
        calibration=calibration,
        banner=banner(calibration),
        checks=checks_of(calibration.verdict),
        weak_cards=weak_cards(calibration),
        key_figures=key_figures(calibration, problem),
        lens_tables=lenses,
        ladder=lens_ladder(calibration),
        rig_tables=rig,
        board=board_section(calibration, problem, estimate),
        scale_ledger=ledger_section(calibration),
        drift=drift_section(drift) if drift else "",
        contributions=contribution_section(calibration.recalibration, calibration.rig.metric),
        other_rows=rows_without_table((*lenses, *rig), truth_rows),
        has_truth=bool(truth_rows),
        truth_summary=truth_summary(truth_rows),
        z_figure=figure_html(z_figure(truth_rows), "truth-z") if truth_rows else "",
        correlation=figure_html(correlation_figure(calibration), "heat") if has_covariance else "",
        sigmas=sigma_section(calibration),
        noise=noise_panel(calibration),
        uncertainty=uncertainty_section(calibration, problem, estimate) if has_covariance else None,
        pairs=strongest_pairs(calibration.covariance) if has_covariance else (),
        cameras=[camera_section(part, problem.frame_names) for part in parts],
        rig_figure=figure_html(rig_figure(estimate, problem.reference, unit), "rig-3d")
        if is_rig
        else "",
        scan_figure=figure_html(scan_figure(problem, estimate, unit), "scan-3d"),
        stages=stages(calibration),
        provenance=provenance_lines(calibration.provenance),
        config=json.dumps(calibration.provenance.config, indent=2, default=str),
        plotly_js=Markup(get_plotlyjs()),
    )


def camera_section(part: CameraResiduals, frame_names: Sequence[str]) -> CameraSection:
    """The six figures of one camera; none when nothing of it can be projected."""
    if not len(part.pixels):
        return CameraSection(part.camera.name, summary(part), ())
    key = f"camera-{part.index}"
    single, single_factor = arrows_figure(part)
    shared, shared_factor = systematic_figure(part)
    noise_px = noise_of_cell_mean(part)
    by_chance = "" if noise_px is None else f" Noise alone leaves about {noise_px:.3f} px."
    panels = (
        Panel(
            "Single residuals",
            f"Arrows from the observed to the projected pixel, {single_factor:g} times as long as "
            "they are. Mismatches are cut at 4 sigma. Directions should look random.",
            figure_html(single, f"{key}-single"),
        ),
        Panel(
            "What residuals share",
            f"Mean residual of each cell, arrows {shared_factor:g} times as long.{by_chance} "
            "A pattern means that the lens model does not fit.",
            figure_html(shared, f"{key}-shared"),
        ),
        Panel(
            "Coverage",
            f"Observations in each cell; {100 * empty_share(part):.0f} % of the image saw none. "
            "Distortion is only known where points were seen.",
            figure_html(coverage_figure(part), f"{key}-coverage"),
        ),
        Panel(
            "Size against chance",
            "Normal noise follows the curve; a heavier tail is mismatches, which the robust loss "
            "weighs down.",
            figure_html(histogram_figure(part), f"{key}-size"),
        ),
        Panel(
            "Mean against radius",
            "Bars are two standard errors, outward is positive. A radial mean that leaves zero by "
            "more than its bars is distortion that the lens model misses.",
            figure_html(radius_figure(part), f"{key}-radius"),
        ),
        Panel(
            "Image by image",
            "The dashed line is what normal noise would give. An image that stands out was "
            "blurred, wrongly matched or taken at another moment.",
            figure_html(frames_figure(part, frame_names), f"{key}-frames"),
        ),
    )
    return CameraSection(part.camera.name, summary(part), panels)


def stages(calibration: Calibration) -> tuple[Stage, ...]:
    """The stages in the order they ran."""
    seconds = calibration.solve.seconds if calibration.solve else {}
    longest = max(seconds.values(), default=0.0) or 1.0
    return tuple(Stage(name, value, 100 * value / longest) for name, value in seconds.items())


def provenance_lines(provenance: Provenance) -> tuple[tuple[str, str], ...]:
    """Where the result came from, as pairs of term and text."""
    libraries = ", ".join(f"{name} {version}" for name, version in provenance.versions.items())
    old = provenance.replaces
    lines = (
        ("sfm_calib", provenance.version or "unknown"),
        ("Written", provenance.created.isoformat() if provenance.created else ""),
        ("Replaces", f"{old.path} (SHA-256 {old.sha256})" if old else ""),
        ("Command", provenance.command),
        ("Seed", str(provenance.seed)),
        ("Libraries", libraries),
        ("Pixel convention", provenance.pixel_convention),
    )
    return tuple((term, text) for term, text in lines if text)

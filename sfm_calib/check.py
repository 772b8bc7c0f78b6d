"""The story of a check: can this scan calibrate this rig, and if not, what should be added?

The images are judged by their pixels, the scan by what its mapping sees and how its cameras moved,
and a quick solve of few observations states what the lenses would be known to. Reading, features,
matches and mapping are those of `calibrate`, out of the same cache.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np

from graphs.coverage import CameraCoverage, Coverage, coverage
from graphs.stated_covariance import calibration_covariance
from sfm_calib.cache import Cache
from sfm_calib.calibrate import solve_problem
from sfm_calib.config import RigConfig
from sfm_calib.coverage_findings import coverage_findings
from sfm_calib.errors import BrokenDownError, CalibrationError
from sfm_calib.findings import Finding, blurred_images, image_findings, solve_findings
from sfm_calib.images import Progress, Scan, read_scan
from sfm_calib.mapping import Mapped, map_scan
from sfm_calib.nominal import check_config, known_cameras, lens_of, start_from_config
from sfm_calib.record import Record
from sfm_calib.result import Calibration
from sfm_calib.run import Run
from sfm_calib.sharpness import ImageQuality, lit_cells, measure_images
from sfm_calib.summary import summarise

Verdict = Literal["good", "doubtful", "cannot"]
FORMAT: Final = "sfm_calib_check/1"
# A second's work; sigmas are up to twice those of 160,000 (street 1.36 and 0.80 px of fx).
QUICK_OBSERVATIONS = 20_000


class Seen(Record):
    """What one camera saw and how it moved; null where there is no such number."""

    n_placed: int  # images
    n_observations: int  # usable ones
    per_image: tuple[int, int]  # median and least
    covered: float  # share of the image's cells
    corners: tuple[bool | None, ...]  # top left, top right, bottom left, bottom right; null: dark
    radius: float  # reached, over half the diagonal
    rotation_deg: tuple[float, float, float]  # spread up and down, to the sides, roll
    path_share: tuple[float, float, float]  # of its way along x right, y down, z forward
    straightness: float  # of its way: 1 is a line
    near: float | None  # distance of what it saw, in extents of its way: 5 % are nearer
    far: float | None  # 5 % are farther
    parallax_deg: tuple[float, float, float] | None  # 5 %, median, 95 %
    thickness: float | None  # of what it saw: 0 is a plane
    shared_at_once: dict[str, int]  # points seen in one frame with each other camera
    shared_ever: dict[str, int]


class CameraCheck(Record):
    """One camera: whether it can be calibrated, and the numbers behind that."""

    verdict: Verdict
    n_images: int
    edge_px: float | None  # median sigma of sharp edges, images reduced to 1 MP
    blurred: tuple[str, ...]  # frames
    seen: Seen | None  # null where mapping failed
    params: dict[str, float]  # of a quick solve; empty where it failed
    sigma: dict[str, float]
    prior_share: dict[str, float]


class ScanCheck(Record):
    """Whether a scan can calibrate its rig, and what it lacks."""

    format: Literal["sfm_calib_check/1"] = FORMAT
    verdict: Verdict  # the worst of all cameras'
    cameras: dict[str, CameraCheck]
    findings: tuple[Finding, ...]  # the worst first
    messages: tuple[str, ...]  # what was skipped or dropped, as in calibration.json


def check_scan(scan_path: Path, config: RigConfig, cache: Cache, progress: Progress) -> ScanCheck:
    """Say whether a scan can calibrate its rig, camera by camera, and what to add.

    A scan that cannot be mapped or solved is a finding, not an error.
    Raises CalibrationError for what is no scan, or no configuration of it.
    """
    scan = read_scan(scan_path, cache, config.frames, config.video_frames, progress)
    check_config(config, scan)
    quality = measure_images(scan, progress)
    found = image_findings(scan, quality)
    mapped = _mapped(scan, config, cache, progress)
    if isinstance(mapped, Finding):
        return _concluded(scan, quality, [*found, mapped], scan.warnings)
    problem = mapped.problem
    lit = np.array([lit_cells(quality, camera) for camera in range(len(scan.cameras))])
    covered = coverage(problem, config.min_parallax_deg, lit)
    found += coverage_findings(scan, problem.frame_names, covered)
    solved = _solved(scan, config, mapped, progress)
    found += [solved] if isinstance(solved, Finding) else solve_findings(solved)
    messages = (*scan.warnings, *mapped.messages)
    calibration = None if isinstance(solved, Finding) else solved
    return _concluded(scan, quality, found, messages, covered, calibration)


def _mapped(scan: Scan, config: RigConfig, cache: Cache, progress: Progress) -> Mapped | Finding:
    lenses = [lens_of(config, name, len(scan.cameras)) for name in scan.cameras]
    try:
        return map_scan(scan, config, lenses, known_cameras(config, scan), cache, progress)
    except CalibrationError as error:
        # A full disk, a damaged cache, memory that ran out: not the scan's fault.
        if error.__cause__ is not None or isinstance(error, BrokenDownError):
            raise
        return _failure("mapping", error)


def _solved(
    scan: Scan, config: RigConfig, mapped: Mapped, progress: Progress
) -> Calibration | Finding:
    """A calibration from a few observations, for its sigmas alone (without the jackknife's)."""
    few = min(config.max_observations, QUICK_OBSERVATIONS)
    quick = config.model_copy(update={"max_observations": few})
    try:
        problem = start_from_config(mapped.problem, quick)
        refined = solve_problem(problem, quick, progress)
        covariance = calibration_covariance(refined.graph, refined.estimate, refined.values)
    except (CalibrationError, ValueError) as error:
        return _failure("solve", error)
    return summarise(Run(scan, quick, mapped, refined, covariance, {}, ""))[0]


def _failure(topic: str, error: Exception) -> Finding:
    """What went wrong; an error's message ends with its remedy."""
    what, _, remedy = str(error).partition("; ")
    if not remedy and ": " in what:
        what, _, remedy = what.rpartition(": ")
    return Finding(camera=None, severity="cannot", topic=topic, what=what, remedy=remedy)


def _concluded(
    scan: Scan,
    quality: Sequence[ImageQuality],
    found: Sequence[Finding],
    messages: tuple[str, ...],
    covered: Coverage | None = None,
    calibration: Calibration | None = None,
) -> ScanCheck:
    cameras = {}
    for index, name in enumerate(scan.cameras):
        own = [each for each in quality if each.image.camera == index]
        widths = [each.edge_px for each in own if np.isfinite(each.edge_px)]
        solved = calibration.cameras[name] if calibration else None
        cameras[name] = CameraCheck(
            verdict=worst_of([each for each in found if each.camera in (None, name)]),
            n_images=len(own),
            edge_px=float(np.median(widths)) if widths else None,
            blurred=tuple(scan.frames[each.image.frame] for each in blurred_images(own)),
            seen=_seen(covered, index) if covered else None,
            params=solved.params if solved else {},
            sigma=solved.sigma if solved else {},
            prior_share=solved.prior_share if solved else {},
        )
    order = ("cannot", "doubtful", "note")
    return ScanCheck(
        verdict=worst_of(found),
        cameras=cameras,
        findings=tuple(sorted(found, key=lambda each: order.index(each.severity))),
        messages=messages,
    )


def worst_of(findings: Sequence[Finding]) -> Verdict:
    """The verdict that findings amount to: that of the worst."""
    severities = {each.severity for each in findings}
    if "cannot" in severities:
        return "cannot"
    return "doubtful" if "doubtful" in severities else "good"


def _seen(covered: Coverage, index: int) -> Seen:
    camera: CameraCoverage = covered.cameras[index]
    plane, motion, scene = camera.plane, camera.motion, camera.scene
    others = [i for i in range(len(covered.cameras)) if i != index]
    names = [each.name for each in covered.cameras]
    parallax = scene.parallax_deg.tolist() if np.isfinite(scene.parallax_deg).all() else None
    counts = camera.per_image
    return Seen(
        n_placed=camera.n_images,
        n_observations=camera.n_observations,
        per_image=(int(np.median(counts)), int(counts.min())) if counts.size else (0, 0),
        covered=plane.covered,
        corners=plane.corners,
        radius=plane.radius,
        rotation_deg=tuple(motion.rotation_deg.tolist()),
        path_share=tuple(motion.path_share.tolist()),
        straightness=motion.straightness,
        near=_number(scene.near),
        far=_number(scene.far),
        parallax_deg=parallax,
        thickness=_number(scene.thickness),
        shared_at_once={names[i]: int(covered.shared_at_once[index, i]) for i in others},
        shared_ever={names[i]: int(covered.shared_ever[index, i]) for i in others},
    )


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if np.isfinite(value) else None

"""The story of a calibration: a scan in, a Calibration out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from graphs.build import GraphOptions
from graphs.covariance import CalibrationCovariance, calibration_covariance
from graphs.losses import SCALE_95, LossName
from graphs.problem import Problem
from graphs.refine import Refinement, refine
from sfm_calib.cache import Cache
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, read_scan
from sfm_calib.mapping import map_scan
from sfm_calib.nominal import (
    check_config,
    known_cameras,
    lens_of,
    lens_priors,
    rig_priors,
    shared_lenses,
    start_from_config,
)
from sfm_calib.result import Calibration
from sfm_calib.summary import Run, summarise


@dataclass
class Stopwatch:
    """Seconds of each stage, by name."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block under this name."""
        start = time.monotonic()
        yield
        self.seconds[name] = round(time.monotonic() - start, 2)


@dataclass(frozen=True)
class Outcome:
    """The result, and the optimum behind it for the report."""

    calibration: Calibration
    refinement: Refinement
    unit: float  # the result's lengths over the optimum's


def calibrate(
    scan_path: Path, config: RigConfig, cache: Cache, progress: Progress, command: str = ""
) -> Outcome:
    """Calibrate every camera of a scan, and the rig they sit on.

    `progress(stage, done, total)` is called throughout; a total of 0 means unknown.
    Raises CalibrationError with cause, number and remedy when the scan does not allow it.
    """
    watch = Stopwatch()
    with watch.stage("reading images"):
        scan = read_scan(scan_path, cache, config.frames, config.video_frames, progress)
        check_config(config, scan)
    lenses = [lens_of(config, name, len(scan.cameras)) for name in scan.cameras]
    with watch.stage("tracks and mapping"):
        mapped = map_scan(scan, config, lenses, known_cameras(config, scan), cache, progress)
    with watch.stage("solving"):
        problem = start_from_config(mapped.problem, config)
        refinement = solve_problem(problem, config, progress)
    with watch.stage("covariance"):
        progress("covariance", 0, 0)
        covariance = covariance_of(refinement)
    run = Run(scan, config, mapped, refinement, covariance, watch.seconds, command)
    calibration, unit = summarise(run)
    return Outcome(calibration, refinement, unit)


def solve_problem(problem: Problem, config: RigConfig, progress: Progress) -> Refinement:
    """The graph's optimum under the configuration's priors."""
    adaptive = config.loss == "adaptive"
    loss: LossName = "cauchy" if config.loss == "adaptive" else config.loss
    options = GraphOptions(
        loss=loss,
        loss_scale=SCALE_95[loss],
        lens_priors=lens_priors(problem.initial, config),
        rig_priors=rig_priors(problem.initial, config, problem.reference),
        shared_lenses=shared_lenses(problem, config),
    )
    try:
        return refine(
            problem,
            options,
            config.min_parallax_deg,
            config.max_observations,
            on_iteration=lambda iteration, cost: progress("solving", iteration, 0),
            adaptive=adaptive,
        )
    except ValueError as error:
        raise CalibrationError(str(error)) from error


def covariance_of(refinement: Refinement) -> CalibrationCovariance:
    """The joint covariance at the optimum, as `calibration_covariance`."""
    try:
        return calibration_covariance(refinement.graph, refinement.estimate, refinement.values)
    except ValueError as error:
        raise CalibrationError(str(error)) from error

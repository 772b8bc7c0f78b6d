"""The story of a calibration: a scan in, a Calibration out."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from graphs.build import GraphOptions
from graphs.consider import completed, sensitivity
from graphs.ladder import Ladder, climb, on_rung_of
from graphs.losses import SCALE_95, LossName
from graphs.motion import too_little_motion
from graphs.problem import Problem, images_seen
from graphs.refine import Refinement, refine
from graphs.selection import NoParallaxError
from graphs.split_check import SplitCheck, split_check
from graphs.stated_covariance import CalibrationCovariance, calibration_covariance
from graphs.twin import Certificate, certify
from sfm_calib.board_use import Without
from sfm_calib.cache import Cache
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan, read_scan
from sfm_calib.learned.choice import check_torch_of
from sfm_calib.mapping import Mapped, map_scan
from sfm_calib.nominal import (
    check_config,
    known_cameras,
    lens_of,
    lens_priors,
    on_ladder,
    rig_priors,
    shared_lenses,
    start_from_config,
)
from sfm_calib.refine import refine_tracks
from sfm_calib.result import Calibration
from sfm_calib.run import Given, Run
from sfm_calib.summary import summarise

FEW_PLACED = 0.5  # of the images: of scans that went well, nine in ten and more are
FRAMES_TO_JUDGE = 6  # fewer, placed together, do not show how a rig moved through its scan


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
    scan = checked_scan(scan_path, config, cache, progress, watch)
    given, problem = mapped_scan(scan, config, cache, progress, command, watch)
    with enough_placed(problem, len(scan.images)):
        return determine(given, problem, watch, progress)


def checked_scan(
    scan_path: Path, config: RigConfig, cache: Cache, progress: Progress, watch: Stopwatch
) -> Scan:
    """The images of a scan, which the configuration fits."""
    check_torch_of(config)  # before minutes of mapping
    with watch.stage("reading images"):
        scan = read_scan(scan_path, cache, config.frames, config.video_frames, progress)
        check_config(config, scan)
    return scan


def mapped_scan(
    scan: Scan,
    config: RigConfig,
    cache: Cache,
    progress: Progress,
    command: str,
    watch: Stopwatch,
) -> tuple[Given, Problem]:
    """A scan's problem, started as rig.yaml has it, and what it came from."""
    lenses = [lens_of(config, name, len(scan.cameras)) for name in scan.cameras]
    with watch.stage("tracks and mapping"):
        mapped = map_scan(scan, config, lenses, known_cameras(config, scan), cache, progress)
    if config.refine:
        with watch.stage("matching patches"):
            mapped = remeasured(mapped, scan, config, cache, progress)
    given = Given(scan, config, mapped, command)
    return given, start_from_config(mapped.problem, config)


def remeasured(
    mapped: Mapped, scan: Scan, config: RigConfig, cache: Cache, progress: Progress
) -> Mapped:
    """What was mapped, its tracks measured anew in the scan's images.

    Raises CalibrationError as `refine_tracks`, and where the problem determines too little.
    """
    with refusals(mapped.problem):
        options = options_of(mapped.problem, config)
        refined = refine_tracks(mapped.problem, scan, options, config, cache, progress)
    messages = (*mapped.messages, refined.message)
    return replace(mapped, problem=refined.problem, messages=messages)


def determine(given: Given, problem: Problem, watch: Stopwatch, progress: Progress) -> Outcome:
    """From a problem to its result: the lens, the optimum, how sure it is, and what to say of it.

    Raises CalibrationError where the problem determines too little.
    """
    config = given.config
    with watch.stage("choosing the lens"):
        ladder = choose_lens(problem, config, progress)
    with watch.stage("solving"):
        refinement = solve_problem(problem, config, progress, ladder)
    with watch.stage("covariance"):
        covariance, split = covariance_of(refinement, config, progress)
    with watch.stage("certificate"):
        certificate = certificate_of(refinement, config, progress)
    board = given.board
    if board is not None and given.scan_alone is not None:
        with watch.stage("without the board"):
            board = replace(
                board, without=without_board(given.scan_alone, config, ladder, progress)
            )
    run = Run(
        given.scan, config, given.mapped, refinement, covariance, watch.seconds, given.command,
        ladder, split, certificate, board,
    )  # fmt: skip
    calibration, unit = summarise(run)
    return Outcome(calibration, refinement, unit)


def without_board(
    scan: Problem, config: RigConfig, ladder: Ladder | None, progress: Progress
) -> Without | None:
    """What the scan alone says, through the lens that was chosen with the board; None: nothing."""

    def told(stage: str, done: int, total: int) -> None:
        progress(f"without the board: {stage}", done, total)

    try:
        alone = solve_problem(scan, config, told, ladder)
        return Without(alone.estimate, covariance_of(alone, config, told)[0])
    except CalibrationError:
        return None


def options_of(problem: Problem, config: RigConfig) -> GraphOptions:
    """Loss and priors of a configuration, for the lenses that the problem has."""
    loss: LossName = "cauchy" if config.loss == "adaptive" else config.loss
    return GraphOptions(
        loss=loss,
        loss_scale=SCALE_95[loss],
        lens_priors=lens_priors(problem.initial, config, problem.board is not None, problem.prior),
        rig_priors=rig_priors(problem.initial, config, problem.reference, problem.metric),
        shared_lenses=shared_lenses(problem, config),
    )


def choose_lens(problem: Problem, config: RigConfig, progress: Progress) -> Ladder | None:
    """The lenses that were tried on cameras without a given one; None: all have one."""
    autos = on_ladder(config, [camera.name for camera in problem.initial.cameras])
    if not autos:
        return None
    with refusals(problem):
        return climb(
            problem,
            lambda changed: options_of(changed, config),
            autos,
            config.min_parallax_deg,
            on_rung=lambda done, total: progress("choosing the lens", done, total),
        )


def solve_problem(
    problem: Problem, config: RigConfig, progress: Progress, ladder: Ladder | None = None
) -> Refinement:
    """The graph's optimum under the configuration's priors, with the lens that a ladder chose."""
    if ladder is None:
        options = options_of(problem, config)
    else:
        problem, options = on_rung_of(
            problem,
            ladder.best.rung,
            lambda changed: options_of(changed, config),
            on_ladder(config, [camera.name for camera in problem.initial.cameras]),
        )
    with refusals(problem):
        return refine(
            problem,
            options,
            config.min_parallax_deg,
            config.max_observations,
            on_iteration=lambda iteration, cost: progress("solving", iteration, 0),
            adaptive=config.loss == "adaptive",
        )


@contextmanager
def enough_placed(problem: Problem, n_images: int) -> Iterator[None]:
    """Where most images could not be placed, that is what is wrong with a scan that is refused."""
    try:
        yield
    except CalibrationError as error:
        placed = len(images_seen(problem.observations))
        if placed >= FEW_PLACED * n_images:
            raise
        raise CalibrationError(
            f"only {placed} of {n_images} images could be placed, too few to calibrate from: take "
            "the views closer together, and let them see textured things"
        ) from error


@contextmanager
def refusals(problem: Problem | None = None) -> Iterator[None]:
    """What the maths refuses, in one line; of a `problem` without motion, by its name."""
    try:
        yield
    except ValueError as error:
        why = None
        if problem is not None and len(problem.frame_names) >= FRAMES_TO_JUDGE:
            no_parallax = isinstance(error, NoParallaxError)
            why = too_little_motion(problem, parallax_found=not no_parallax)
        raise CalibrationError(why or str(error)) from error


def covariance_of(
    refinement: Refinement, config: RigConfig, progress: Progress
) -> tuple[CalibrationCovariance, SplitCheck | None]:
    """The joint covariance at the optimum, with the jackknife, and what halves of the scan say."""
    covariance, split = own_covariance_of(refinement, config, progress)
    if refinement.problem.prior is not None:
        with refusals():
            how = sensitivity(
                refinement.graph, refinement.estimate, refinement.values, covariance.basis
            )
        covariance = completed(covariance, how)
    return covariance, split


def own_covariance_of(
    refinement: Refinement, config: RigConfig, progress: Progress
) -> tuple[CalibrationCovariance, SplitCheck | None]:
    """As `covariance_of`, but what is held of an earlier calibration counts as exactly known."""
    progress("covariance", 0, 0)
    with refusals():
        covariance = calibration_covariance(
            refinement.graph, refinement.estimate, refinement.values, config.min_parallax_deg,
            on_block=lambda done, total: progress("leaving out frames", done, total),
        )  # fmt: skip
        split = split_check(
            refinement.graph, refinement.estimate, covariance, config.min_parallax_deg
        )
        return covariance, split


def certificate_of(
    refinement: Refinement, config: RigConfig, progress: Progress
) -> Certificate | None:
    """How the stated sigmas do on simulated twins of the scan, where that is asked for."""
    if config.certify == 0:
        return None
    with refusals():
        return certify(
            refinement, config.certify, config.seed, config.min_parallax_deg,
            adaptive=config.loss == "adaptive",
            on_trial=lambda done, total: progress("certifying", done, total),
        )  # fmt: skip

"""One calibration of the study `sharper_tracks`: what its tracks err by, what it errs by, and when.

Its options are those of the study `calibrations`, from the same definition.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, create_model, model_validator

from experiments.calibration_options import CalibrationOptions, Command, of_commands
from experiments.calibration_rows import columns_of, row_of
from experiments.calibration_sources import Source, source_of
from experiments.calibrations import CACHE, line_of, outcome_of
from experiments.coverage_summary import nees
from experiments.runner.protocol import TIMING, Cell, Row
from experiments.true_noise import noise_about, true_estimate, true_frames, true_noise
from graphs.frames import angle_between
from graphs.jackknife import blocks_of, change
from graphs.lenses import PARAMETER_NAMES
from graphs.model_covariance import model_covariance
from graphs.problem import BoolArray, IntArray
from graphs.split_check import difference_px
from sfm_calib.cache import Cache
from sfm_calib.calibrate import Outcome
from sfm_calib.colmap import quiet
from sfm_calib.compare import CompareOptions, compare
from sfm_calib.compare_record import Comparison
from sfm_calib.compare_sides import match, renamed
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.files import RESULT_FILE
from sfm_calib.formats import CameraRig
from sfm_calib.formats.ours import rig_of
from sfm_calib.output import check_apart, dated, output_folder
from sfm_calib.result import Calibration, save_calibration

ROTATION = "rotation_deg"  # how far a camera is turned from the rig's reference, in a reference
KNOWN_NUMBERS = {ROTATION, *(p for names in PARAMETER_NAMES.values() for p in names)}
Number = float | tuple[float, Annotated[float, Field(ge=0)]]  # a value, or a value and its sigma
FRAMES_FILE = "truth_frames.json"  # beside a simulated scan
DRAWN_BASELINE, DRAWN_HALVES = 1, 2  # streams of the trial's random numbers
SOLVE_STAGES = ("choosing the lens", "solving", "covariance")


class SharperOptions(CalibrationOptions):
    """One calibration, from a rendered scan or from images with a reference to compare with."""

    command: Command = "calibrate"
    """What is done; calibrate alone."""
    report: bool = False
    """Leave report.html beside calibration.json: 5 MB."""
    reference_params: dict[str, dict[str, Number]] | None = None
    """What another calibration says of a scan's cameras, by name, where no file has it: fx, cx, ...
    and rotation_deg from the reference camera; a number, or a number and its sigma."""
    halves: Annotated[int, Field(ge=0, le=100)] = 4
    """In so many ways the frames are halved; the halves of each are calibrated and compared."""

    @model_validator(mode="after")
    def _is_of_images(self) -> Self:
        if self.command != "calibrate":
            raise ValueError(f"the command is {self.command}, and this study compares calibrate's")
        if self.simulate == "tracks":
            raise ValueError("simulated tracks have no patches: say simulate: images, or scan")
        if self.reference_params and (self.simulate or self.truth):
            raise ValueError(
                "reference_params is for a scan without a truth: leave it out, or simulate or truth"
            )
        for name in sorted({key for of in (self.reference_params or {}).values() for key in of}):
            if name not in KNOWN_NUMBERS:
                raise ValueError(
                    f"reference_params: {name!r}: {nearest(name, sorted(KNOWN_NUMBERS))}"
                )
        return self


SharperTrial: type[SharperOptions] = create_model(
    "SharperTrial", __base__=SharperOptions, __module__=__name__, **of_commands()
)
SharperTrial.__doc__ = SharperOptions.__doc__


@dataclass(frozen=True)
class TimedCache(Cache):
    """A cache that knows how long it took to make each stage; None: the stage was there."""

    seconds: dict[str, float | None] = field(default_factory=dict)

    def stage(self, name: str, inputs: object, make: Callable[[Path], None]) -> Path:
        """As of any cache."""
        self.seconds[name] = None

        def timed(place: Path) -> None:
            began = time.monotonic()
            make(place)
            self.seconds[name] = time.monotonic() - began

        return super().stage(name, inputs, timed)


# ---- the trial -----------------------------------------------------------------------------


def trial(options: SharperOptions, seed: int, folder: Path) -> Row:
    """Calibrate, leave calibration.json in `folder`, and compare.

    Raises CalibrationError as the command, and where the reference is of other cameras.
    """
    quiet(False)
    if options.scan:
        check_apart(options.scan, folder)
    with output_folder(folder):
        cache = TimedCache(folder.parent / CACHE, shared=True)
        source = source_of(options, seed, folder, cache)
        if options.simulate:
            source = replace(source, config=measured_anew(source.config, seed))
        line = line_of(options, source, seed, folder)
        outcome = dated(outcome_of(options, source, seed, cache, line))
        save_calibration(outcome.calibration, folder / RESULT_FILE)
    row = {k: v for k, v in row_of(outcome.calibration).items() if not k.startswith(TIMING)}
    row |= dict(tracks(outcome))
    row |= seconds(outcome.calibration, cache.seconds)
    row |= dict(halves(outcome, options, source.config, seed))
    row |= errors(outcome, options, source, folder)
    return row


def measured_anew(config: RigConfig, seed: int) -> RigConfig:
    """The configuration of a simulated scan, its baseline measured again, with an error.

    What is always measured rightly would leave smaller errors than are stated.
    """
    rng = np.random.default_rng([seed, DRAWN_BASELINE])
    drawn = tuple(
        one.model_copy(update={"length_m": one.length_m + one.sigma_m * rng.standard_normal()})
        for one in config.scale.baseline
    )
    return config.model_copy(update={"scale": config.scale.model_copy(update={"baseline": drawn})})


def tracks(outcome: Outcome) -> Iterator[tuple[str, Cell]]:
    """How many there are, and what they say of their noise: as stated, and in px as it is."""
    solve, found = outcome.calibration.solve, outcome.refinement
    assert solve is not None
    yield "n_tracks", solve.n_points
    yield "n_rejected", solve.n_rejected
    left = noise_about(found.estimate, found.problem.observations)
    yield "residual_px", left.sigma_px
    yield "residual_90_px", left.quantile_px


def seconds(calibration: Calibration, made: Mapping[str, float | None]) -> Row:
    """What each stage took; None of what was there already, made for another trial."""
    assert calibration.solve is not None
    watched = calibration.solve.seconds
    row: dict[str, Cell] = {
        "seconds_features": made.get("features"),
        "seconds_matches": made.get("matches"),
        "seconds_mapping": made.get("models"),
        "seconds_solve": sum(watched.get(stage, 0.0) for stage in SOLVE_STAGES),
    }
    patches = watched.get("matching patches")
    if patches is not None:
        row["seconds_patches"] = None if made.get("patches") is None else patches
    return row


# ---- halves of the scan --------------------------------------------------------------------


def halves(
    outcome: Outcome, options: SharperOptions, config: RigConfig, seed: int
) -> Iterator[tuple[str, Cell]]:
    """How far halves of the frames project apart, each calibrated alone: median over drawn halves.

    A half that determines little may lie anywhere, and would make a mean of few its own.
    """
    found, rng = outcome.refinement, np.random.default_rng([seed, DRAWN_HALVES])
    angle = options.said.get("min_parallax_deg", config.min_parallax_deg)
    model = model_covariance(found.graph, found.estimate, found.values)
    block = blocks_of(found.problem)
    drawn = second_halves(block, options.halves, rng)
    apart = [difference_px(found.graph, found.estimate, model, one, angle) for one in drawn]
    told = [one for one in apart if one is not None]
    yield "halves_px", float(np.median(told)) if told else None
    yield "n_halves", len(told)


def second_halves(block: IntArray, most: int, rng: np.random.Generator) -> list[BoolArray]:
    """Frames (n_frames,) of the second half, in several ways: of every two blocks in a row one.

    By lot, no way twice; fewer than `most` where there are no more.
    """
    n_blocks = int(block.max()) + 1
    n_pairs = (n_blocks + 1) // 2
    found = []
    for number in rng.permutation(2 ** (n_pairs - 1))[:most] if n_blocks > 1 else ():
        coins = number >> np.arange(n_pairs) & 1
        is_second = (np.arange(n_blocks) + np.repeat(coins, 2)[:n_blocks]) % 2 == 1
        found.append(is_second[block])
    return found


# ---- errors --------------------------------------------------------------------------------


def errors(outcome: Outcome, options: SharperOptions, source: Source, folder: Path) -> Row:
    """Of every parameter against the truth or a reference, with what is stated of it.

    Lists of one length: `names`, `error`, `sigma`, `sigma_noise` (of noise alone), and
    `sigma_reference` (0: exact). Rotations in degrees.
    """
    found = rig_of(outcome.calibration, folder / RESULT_FILE)
    if source.truth is not None:
        truth = called_alike(source.truth, found)
        record = compare(truth, found, CompareOptions()).record
        row = dict(columns_of(record)) | listed(from_record(record, outcome.calibration))
        if options.simulate:
            assert isinstance(source.scan, Path)
            row |= against_truth(outcome, found, truth, source.scan.parent / FRAMES_FILE)
        return row
    if options.reference_params:
        return listed(from_numbers(outcome.calibration, options.reference_params))
    return {}


def called_alike(truth: CameraRig, found: CameraRig) -> CameraRig:
    """The truth with its cameras called as in the scan; a lone camera has no name there.

    Raises CalibrationError where they cannot be matched.
    """
    pairs, _ = match(truth, found, None)
    return renamed(truth.only([a for a, _ in pairs]), [b for _, b in pairs])


@dataclass(frozen=True)
class ParameterError:
    """Of one parameter; rotations in degrees."""

    name: str
    error: float
    sigma: float
    sigma_noise: float
    sigma_reference: float


def listed(errors: list[ParameterError]) -> dict[str, Cell]:
    """As columns of a row."""
    return {
        "names": [one.name for one in errors],
        "error": [one.error for one in errors],
        "sigma": [one.sigma for one in errors],
        "sigma_noise": [one.sigma_noise for one in errors],
        "sigma_reference": [one.sigma_reference for one in errors],
    }


def from_record(record: Comparison, calibration: Calibration) -> list[ParameterError]:
    """From a comparison with a truth, as A; what is held, in both, is no error."""
    found = []
    for one in record.parameters:
        noise = _of_noise(calibration, one.name)
        if one.sigma_b > 0:
            found.append(ParameterError(one.name, one.difference, one.sigma_b, noise, one.sigma_a))
    return found


def _of_noise(calibration: Calibration, name: str) -> float:
    """The sigma that noise alone would leave a parameter; 0 where it is not estimated."""
    assert calibration.noise is not None
    sigmas = calibration.noise.sigmas.get(name)
    if sigmas is None:
        return 0.0
    return float(np.degrees(sigmas.model)) if ".rotation_" in name else sigmas.model


def from_numbers(
    calibration: Calibration, reference: Mapping[str, Mapping[str, Number]]
) -> list[ParameterError]:
    """From numbers of a reference. Raises CalibrationError for cameras and lenses without them."""
    found = []
    for camera, numbers in reference.items():
        if camera not in calibration.cameras:
            raise CalibrationError(
                f"reference_params: the scan has no camera {camera!r}: "
                f"{nearest(camera, list(calibration.cameras))}"
            )
        for parameter, given in numbers.items():
            value, sigma_reference = given if isinstance(given, tuple) else (given, 0.0)
            name = f"{camera}.{parameter}"
            ours, sigma = _stated(calibration, camera, parameter)
            noise = 0.0 if parameter == ROTATION else _of_noise(calibration, name)
            found.append(ParameterError(name, ours - value, sigma, noise, sigma_reference))
    return found


def _stated(calibration: Calibration, camera: str, parameter: str) -> tuple[float, float]:
    """A parameter and its sigma; of a rotation the angle, and the largest sigma of the three."""
    if parameter == ROTATION:
        turned = calibration.cam_from_rig(camera).rotation
        sigmas = calibration.rig.cam_from_rig[camera].sigma_rotation_deg
        return float(np.degrees(angle_between(turned, np.eye(3)))), float(max(sigmas))
    one = calibration.cameras[camera]
    if parameter not in one.params:
        raise CalibrationError(
            f"reference_params: {camera} is {one.lens}, which has no {parameter}: leave it out, or "
            "give the lens that has it (lens: ...)"
        )
    return one.params[parameter], one.sigma.get(parameter, 0.0)


def against_truth(outcome: Outcome, found: CameraRig, truth: CameraRig, frames: Path) -> Row:
    """The true noise, and the squared errors by the stated covariance and by that of noise alone.

    Of lenses and rig; of a rig without a scale, lengths are left out.
    """
    problem, refinement = outcome.refinement.problem, outcome.refinement
    noise = true_noise(problem, true_estimate(problem, truth, true_frames(frames)))
    names = [
        name for name in found.covariance.names if found.unit == "m" or ".translation_" not in name
    ]
    at = [found.covariance.names.index(name) for name in names]
    error = change(truth.stated.estimate, found.stated.estimate, tuple(names))
    model = model_covariance(refinement.graph, refinement.estimate, refinement.values)
    of_model = [model.names.index(name) for name in names]
    return {
        "noise_true_px": noise.sigma_px,
        "noise_true_90_px": noise.quantile_px,
        "noise_weighed_px": noise.weighed_px,
        "nees_stated": nees(error, found.covariance.matrix[np.ix_(at, at)]),
        "nees_noise": nees(error, model.matrix[np.ix_(of_model, of_model)]),
        "n_parameters": len(names),
    }

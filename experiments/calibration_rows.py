"""A finished calibration as a row: verdict, parameters with sigmas, and errors by a truth."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from experiments.runner.protocol import TIMING, Cell, Row
from graphs.frames import log_rotation
from graphs.lenses import PARAMETER_NAMES
from sfm_calib.compare import CompareOptions, compare
from sfm_calib.compare_record import Comparison
from sfm_calib.drift_record import DriftRecord, DriftTest
from sfm_calib.drift_verdict import change_text
from sfm_calib.formats import CameraRig
from sfm_calib.report.rows import AXES, baseline_sigma
from sfm_calib.result import Calibration

SIGMA, Z = ".sigma", ".z"  # after the name of a parameter


def row_of(calibration: Calibration) -> Row:
    """Of its verdict, its solve, its drift where that was tested, and every parameter.

    `camera.fx` as in the covariance, `camera.fx.sigma` beside it (0: held); rotations in degrees;
    lengths, `camera.baseline` among them, in m or in baselines (`metric`).
    """
    return (
        dict(_verdict(calibration))
        | dict(_solve(calibration))
        | dict(_drift(calibration))
        | dict(_lenses(calibration))
        | dict(_places(calibration))
    )


def _verdict(calibration: Calibration) -> Iterator[tuple[str, Cell]]:
    verdict = calibration.verdict
    assert verdict is not None
    yield "usable", verdict.usable
    yield "weak", "; ".join(dict.fromkeys(one.kind or one.what for one in verdict.weak))
    yield "n_weak", len(verdict.weak)
    yield "halves_p", verdict.split.p_value if verdict.split else None


def _solve(calibration: Calibration) -> Iterator[tuple[str, Cell]]:
    solve, noise = calibration.solve, calibration.noise
    assert solve is not None and noise is not None
    yield "converged", solve.converged
    yield "iterations", solve.iterations
    yield "rms_px", solve.rms_px
    yield "noise_px", noise.sigma_px
    yield "inflation", noise.inflation
    yield "n_frames", solve.n_frames
    yield "n_images", solve.n_images
    yield "n_observations", solve.n_observations
    yield "metric", calibration.rig.metric
    for stage, seconds in solve.seconds.items():
        yield "_".join((TIMING, *re.findall("[a-z]+", stage))), seconds


def _drift(calibration: Calibration) -> Iterator[tuple[str, Cell]]:
    record = calibration.recalibration and calibration.recalibration.drift
    if not record:
        return
    worst = _largest(record)
    yield "drift", record.verdict
    yield "drifted", ", or ".join(" and ".join(one) for one in _cameras(record))
    yield "p", min((test.p_corrected for test in record.tests), default=None)
    yield "change", None if worst is None else change_text(worst)
    yield "change_px", None if worst is None else worst.effect_px
    yield "detectable_px", record.detectable_px
    yield "said", record.lines[0]


def _cameras(record: DriftRecord) -> tuple[tuple[str, ...], ...]:
    """Those that drifted; several, where it cannot be told which of them."""
    return record.moved or ((record.drifted,) if record.drifted else ())


def _largest(record: DriftRecord) -> DriftTest | None:
    """The test of the largest change among those that found drift, else among all.

    All of a lens, and the rig as a whole, say again what a group says.
    """
    found = [test for test in record.tests if test.found] or list(record.tests)
    parts = [test for test in found if test.group not in ("lens", "places")] or found
    return max(parts, key=lambda test: test.effect_px, default=None)


def _lenses(calibration: Calibration) -> Iterator[tuple[str, Cell]]:
    for name, camera in calibration.cameras.items():
        yield f"{name}.lens", camera.lens
        for parameter in PARAMETER_NAMES[camera.lens]:
            yield f"{name}.{parameter}", camera.params[parameter]
            yield f"{name}.{parameter}{SIGMA}", camera.sigma.get(parameter, 0.0)


def _places(calibration: Calibration) -> Iterator[tuple[str, Cell]]:
    rig = calibration.rig
    for name, placed in rig.cam_from_rig.items():
        if name == rig.reference:
            continue
        turn = np.degrees(log_rotation(calibration.cam_from_rig(name).rotation)).tolist()
        for axis, value, sigma in zip(AXES, turn, placed.sigma_rotation_deg, strict=True):
            yield f"{name}.rotation_{axis}", value
            yield f"{name}.rotation_{axis}{SIGMA}", sigma
        shift = zip(AXES, placed.translation, placed.sigma_translation, strict=True)
        for axis, value, sigma in shift:
            yield f"{name}.translation_{axis}", value
            yield f"{name}.translation_{axis}{SIGMA}", sigma
        yield f"{name}.baseline", float(np.linalg.norm(placed.translation))
        yield f"{name}.baseline{SIGMA}", baseline_sigma(calibration, name)


def truth_columns(calibration: CameraRig, truth: CameraRig) -> Row:
    """How a calibration lies to a truth, or to another calibration with sigmas of its own.

    `camera.fx.z`: its error over the sigmas of both. `z_rms`: of the directions that show in the
    picture, each in its own sigma (`z_directions`): 1 where the sigmas are true. `error_px`: rms
    over all images and ranges, a change of frames taken out; `expected_px` by the sigmas.
    Raises CalibrationError where they are not of the same cameras.
    """
    return columns_of(compare(truth, calibration, CompareOptions()).record)


def columns_of(record: Comparison) -> Row:
    """The same of a comparison with the truth as A."""
    row: dict[str, Cell] = {f"{p.name}{Z}": p.z for p in record.parameters if p.z is not None}
    chance = record.chance
    if chance is None:
        rms = [p.rms_px for places in record.projection.values() for p in places]
        return row | {"error_px": float(np.sqrt(np.mean(np.square(rms))))}
    return row | {
        "error_px": chance.difference_px,
        "expected_px": chance.expected_px,
        "truth_p": chance.p_value,
        "z_rms": (chance.chi2 / chance.rank) ** 0.5 if chance.rank else None,
        "z_directions": chance.rank,
    }

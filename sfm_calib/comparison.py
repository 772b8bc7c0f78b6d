"""An estimate beside the truth of a simulation, parameter by parameter."""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np

from graphs.frames import Transform, log_rotation
from graphs.lenses import PARAMETER_NAMES
from sfm_calib.errors import CalibrationError
from sfm_calib.report.rows import TruthRow
from sfm_calib.result import Calibration


def compare_with_truth(estimate: Calibration, truth: Calibration) -> list[TruthRow]:
    """One row a parameter; rotations in degrees about the camera's axes.

    A truth in metres is brought to the estimate's unit when the estimate is not metric.
    Raises CalibrationError when the cameras are not the same.
    """
    check_same_cameras(estimate.cameras, truth)
    rows = [row for name in estimate.cameras for row in _lens_rows(name, estimate, truth)]
    unit = _unit(estimate, truth)
    for name in estimate.cameras:
        if name != estimate.rig.reference:
            rows += _rig_rows(name, estimate, truth, unit)
    return rows


def compare_in_both(estimate: Calibration, truth: Calibration) -> list[TruthRow]:
    """As `compare_with_truth`, of the cameras that both have: its reference must be one of them."""
    both = [name for name in estimate.cameras if name in truth.cameras]
    return compare_with_truth(_only(estimate, both), _only(truth, both))


def _only(calibration: Calibration, names: Collection[str]) -> Calibration:
    cameras = {name: calibration.cameras[name] for name in names}
    placed = {name: calibration.rig.cam_from_rig[name] for name in names}
    rig = calibration.rig.model_copy(update={"cam_from_rig": placed})
    return calibration.model_copy(update={"cameras": cameras, "rig": rig})


def check_same_cameras(names: Collection[str], truth: Calibration) -> None:
    """Raises CalibrationError when a truth is not of these cameras."""
    if set(names) != set(truth.cameras):
        raise CalibrationError(
            f"the truth is of {len(truth.cameras)} cameras ({', '.join(truth.cameras)}) and the "
            f"scan of {len(names)} ({', '.join(names)}): give the truth of this scan"
        )


def _row(name: str, estimate: float, truth: float, error: float, sigma: float) -> TruthRow:
    return TruthRow(name, estimate, truth, error, sigma, error / sigma if sigma > 0 else np.nan)


def _lens_rows(name: str, estimate: Calibration, truth: Calibration) -> Iterator[TruthRow]:
    ours, true = estimate.cameras[name], truth.cameras[name]
    for parameter in PARAMETER_NAMES[ours.lens]:
        value, expected = ours.params[parameter], true.params.get(parameter, 0.0)
        yield _row(
            f"{name}.{parameter}", value, expected, value - expected, ours.sigma.get(parameter, 0.0)
        )


def _unit(estimate: Calibration, truth: Calibration) -> float:
    """The truth's length of the estimate's unit baseline."""
    lengths = {n: np.linalg.norm(t.translation) for n, t in estimate.rig.cam_from_rig.items()}
    if estimate.rig.metric or not lengths or max(lengths.values()) == 0:
        return 1.0
    far = max(lengths, key=lambda n: lengths[n])
    relative = truth.cam_from_rig(far) @ truth.cam_from_rig(estimate.rig.reference).inverse
    length = float(np.linalg.norm(relative.translation))
    return length / float(lengths[far]) if length > 0 else 1.0


def _rig_rows(
    name: str, estimate: Calibration, truth: Calibration, unit: float
) -> Iterator[TruthRow]:
    entry, ours = estimate.rig.cam_from_rig[name], estimate.cam_from_rig(name)
    expected: Transform = (
        truth.cam_from_rig(name) @ truth.cam_from_rig(estimate.rig.reference).inverse
    )
    turn = np.degrees(log_rotation(ours.rotation @ expected.rotation.T))
    vectors = [np.degrees(log_rotation(t.rotation)) for t in (ours, expected)]
    for axis, letter in enumerate("xyz"):
        yield _row(
            f"{name}.rotation_{letter}",
            float(vectors[0][axis]),
            float(vectors[1][axis]),
            float(turn[axis]),
            entry.sigma_rotation_deg[axis],
        )
    moved = ours.translation - expected.translation / unit
    for axis, letter in enumerate("xyz"):
        yield _row(
            f"{name}.translation_{letter}",
            float(ours.translation[axis]),
            float(expected.translation[axis] / unit),
            float(moved[axis]),
            entry.sigma_translation[axis],
        )

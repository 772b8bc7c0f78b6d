"""Estimate beside truth, in one unit and one reference frame."""

import numpy as np
import pytest
from test_result import rig

from graphs.frames import Transform
from sfm_calib.comparison import compare_with_truth
from sfm_calib.errors import CalibrationError
from sfm_calib.result import Calibration, CamFromRig


def placed(calibration, transforms, metric, reference="left", sigma=0.1):
    """The calibration with other rig transforms."""
    entries = {
        name: CamFromRig(
            rotation_wxyz=tuple(t.rotation_wxyz.tolist()),
            translation=tuple(t.translation.tolist()),
            sigma_rotation_deg=(sigma,) * 3,
            sigma_translation=(sigma,) * 3,
        )
        for name, t in transforms.items()
    }
    changes = {"cam_from_rig": entries, "metric": metric, "reference": reference}
    return calibration.model_copy(update={"rig": calibration.rig.model_copy(update=changes)})


def by_name(rows):
    return {row.name: row for row in rows}


def test_a_truth_agrees_with_itself():
    rows = compare_with_truth(rig(), rig())
    assert len(rows) == 2 * 8 + 6
    assert all(row.error == 0 and np.isnan(row.z) for row in rows)


def test_errors_are_measured_in_sigmas():
    estimate = rig()
    camera = estimate.cameras["left"].model_copy(
        update={"params": estimate.cameras["left"].params | {"fx": 503.0}, "sigma": {"fx": 1.5}}
    )
    estimate = estimate.model_copy(update={"cameras": estimate.cameras | {"left": camera}})
    row = by_name(compare_with_truth(estimate, rig()))["left.fx"]
    assert (row.estimate, row.truth, row.error, row.sigma, row.z) == (503.0, 500.0, 3.0, 1.5, 2.0)


def test_a_turn_is_measured_about_the_cameras_axes():
    true = rig()
    small = Transform.from_wxyz([np.cos(0.005), np.sin(0.005), 0.0, 0.0], [0.0, 0.0, 0.0])
    turned = {n: true.cam_from_rig(n) for n in true.cameras}
    turned["right"] = small @ turned["right"]
    rows = by_name(compare_with_truth(placed(true, turned, True), true))
    errors = [rows[f"right.rotation_{axis}"].error for axis in "xyz"]
    np.testing.assert_allclose(errors, [np.degrees(0.01), 0.0, 0.0], atol=1e-9)


def test_a_truth_in_metres_is_brought_to_baselines():
    true = rig()
    length = np.linalg.norm(true.cam_from_rig("right").translation)
    scaled = {n: true.cam_from_rig(n).scaled(1 / length) for n in true.cameras}
    rows = compare_with_truth(placed(true, scaled, metric=False), true)
    np.testing.assert_allclose([row.error for row in rows], 0.0, atol=1e-9)
    rows = by_name(compare_with_truth(placed(true, scaled, metric=True), true))
    assert abs(rows["right.translation_x"].error) > 0.5


def test_another_reference_is_no_error():
    true = rig()
    right = true.cam_from_rig("right")
    other = {name: true.cam_from_rig(name) @ right.inverse for name in true.cameras}
    rows = compare_with_truth(placed(true, other, True, "right"), true)
    assert {row.name.split(".")[0] for row in rows if "rotation" in row.name} == {"left"}
    np.testing.assert_allclose([row.error for row in rows], 0.0, atol=1e-9)


def test_a_truth_of_cameras_at_one_place():
    at_one_place = {name: Transform.identity() for name in rig().cameras}
    true = placed(rig(), at_one_place, True)
    rows = compare_with_truth(
        placed(rig(), {n: rig().cam_from_rig(n) for n in at_one_place}, False), true
    )
    assert all(np.isfinite(row.error) for row in rows)


def test_other_cameras_are_refused():
    with pytest.raises(CalibrationError, match=r"of 1 cameras \(left\) and the scan of 2"):
        compare_with_truth(rig(), rig(("left",)))
    assert isinstance(rig(("left",)), Calibration)

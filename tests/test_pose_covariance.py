"""Transforms in other forms and frames: by finite differences, by GTSAM, there and back."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic.calibrated import (
    HELD,
    assert_equal,
    assert_same,
    change_of,
    covariance_of,
    numeric,
    rig,
    shuffled,
)

from graphs.build import GraphOptions, build
from graphs.covariance import POSE_NAMES, Covariance
from graphs.frames import FloatArray, Transform, exp_rotation, reported_from_tangent
from graphs.pose_covariance import (
    Form,
    adjoint,
    form_from_reported,
    form_names,
    inverse_jacobian,
    inverted,
    poses_as,
    relative,
    relative_jacobians,
    reported_from_left,
    rereferenced,
)
from graphs.problem import Estimate
from graphs.propagation import cross_covariance, lens_names, marginal, pose_names
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.4

number = st.floats(-1.5, 1.5)
vectors = st.tuples(number, number, number).map(np.array)
transforms = st.builds(Transform.exp, vectors, vectors)


# ---- other forms -----------------------------------------------------------------------------


@given(transforms)
def test_the_adjoint_is_gtsams(a_from_b: Transform) -> None:
    pose = gtsam.Pose3(gtsam.Rot3(a_from_b.rotation), a_from_b.translation)
    np.testing.assert_allclose(adjoint(a_from_b), pose.AdjointMap(), atol=1e-9)


@given(transforms)
def test_twists_by_finite_differences(a_from_b: Transform) -> None:
    pose = gtsam.Pose3(gtsam.Rot3(a_from_b.rotation), a_from_b.translation)
    step = 1e-6

    def reported(twist: FloatArray, form: Form) -> FloatArray:
        by = gtsam.Pose3.Expmap(twist)
        after = by.compose(pose) if form == "left_twist" else pose.compose(by)
        return change_of(a_from_b, Transform(after.rotation().matrix(), after.translation()))

    for form in ("left_twist", "right_twist"):
        columns = [(reported(d, form) - reported(-d, form)) / 2 / step for d in step * np.eye(6)]
        back = np.stack(columns, axis=1)
        np.testing.assert_allclose(form_from_reported(a_from_b, form) @ back, np.eye(6), atol=1e-7)
    np.testing.assert_array_equal(form_from_reported(a_from_b, "reported"), np.eye(6))


@given(transforms)
def test_our_left_twist_is_minus_gtsams_tangent_of_the_inverse(b_from_a: Transform) -> None:
    left = form_from_reported(b_from_a, "left_twist")
    np.testing.assert_allclose(left @ reported_from_tangent(b_from_a), -np.eye(6), atol=1e-12)
    np.testing.assert_allclose(left @ reported_from_left(b_from_a), np.eye(6), atol=1e-12)


@given(transforms, transforms)
def test_relative_transforms_by_finite_differences(a: Transform, b: Transform) -> None:
    step = 1e-6

    def by(d: FloatArray, of_a: bool) -> FloatArray:
        def changed(t: Transform) -> Transform:
            return Transform(exp_rotation(d[:3]) @ t.rotation, t.translation + d[3:])

        after = changed(a) @ b.inverse if of_a else a @ changed(b).inverse
        return change_of(a @ b.inverse, after)

    for jacobian, of_a in zip(relative_jacobians(a, b), (True, False), strict=True):
        columns = [(by(d, of_a) - by(-d, of_a)) / (2 * step) for d in step * np.eye(6)]
        np.testing.assert_allclose(jacobian, np.stack(columns, axis=1), atol=1e-7)


@given(transforms)
def test_the_inverse_of_the_inverse_is_the_transform(a_from_b: Transform) -> None:
    there, back = inverse_jacobian(a_from_b), inverse_jacobian(a_from_b.inverse)
    np.testing.assert_allclose(back @ there, np.eye(6), atol=1e-9)


@pytest.mark.parametrize("form", ["left_twist", "right_twist"])
def test_poses_in_another_form_and_back(form: Form) -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    twists = poses_as(covariance, estimate, form)
    assert twists.names == tuple(
        name.replace(".rotation", f".{form}.rotation").replace(
            ".translation", f".{form}.translation"
        )
        for name in covariance.names
    )
    assert_equal(poses_as(twists, estimate, "reported", given=form), covariance)
    names = form_names("cam2", form)
    jacobian = form_from_reported(estimate.cam_from_rig[2], form)
    expected = jacobian @ marginal(covariance, pose_names("cam2")).matrix @ jacobian.T
    np.testing.assert_allclose(marginal(twists, names).matrix, expected)
    np.testing.assert_allclose(  # what a lens has in common with the rig goes along
        cross_covariance(twists, ["cam0.fx"], names),
        cross_covariance(covariance, ["cam0.fx"], pose_names("cam2")) @ jacobian.T,
    )


def test_left_and_right_twists_differ_by_the_adjoint() -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    left, right = (
        marginal(poses_as(covariance, estimate, form), form_names("cam1", form)).matrix
        for form in ("left_twist", "right_twist")
    )
    carry = adjoint(estimate.cam_from_rig[1])
    assert_same(carry @ right @ carry.T, left, 1e-9)


def test_inverted_by_finite_differences() -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    before = [t.inverse for t in estimate.cam_from_rig[1:]]

    def rig_from_cams(changed: Estimate) -> FloatArray:
        after = [t.inverse for t in changed.cam_from_rig[1:]]
        return np.concatenate([change_of(a, b) for a, b in zip(before, after, strict=True)])

    ours = inverted(covariance, estimate)
    names = (*pose_names("rig_from_cam1"), *pose_names("rig_from_cam2"))
    assert ours.names[-12:] == names and ours.names[:-12] == covariance.names[:-12]
    assert_same(marginal(ours, names).matrix, numeric(covariance, estimate, rig_from_cams))


@pytest.mark.parametrize(("a", "b"), [(1, 2), (2, 1), (0, 1), (2, 0)])
def test_relative_by_finite_differences(a: int, b: int) -> None:
    estimate = rig()
    covariance = covariance_of(estimate)

    def a_from_b(changed: Estimate) -> Transform:
        return changed.cam_from_rig[a] @ changed.cam_from_rig[b].inverse

    ours = relative(covariance, estimate, a, b)
    assert ours.names == pose_names(f"cam{a}_from_cam{b}")
    assert ours.names[0] == f"cam{a}_from_cam{b}.{POSE_NAMES[0]}"
    before = a_from_b(estimate)
    expected = numeric(covariance, estimate, lambda e: change_of(before, a_from_b(e)))
    assert_same(ours.matrix, expected)
    again = relative(shuffled(covariance), estimate, a, b)
    assert_same(again.matrix, expected)
    if 0 not in (a, b):  # the test would notice that cross terms are missing
        apart = covariance.matrix.copy()
        of_a = [name.startswith(f"cam{a}.") for name in covariance.names]
        apart[np.not_equal.outer(of_a, of_a)] = 0
        wrong = relative(Covariance(covariance.names, apart), estimate, a, b)
        with pytest.raises(AssertionError):
            assert_same(wrong.matrix, expected, 0.1)


def test_a_camera_from_itself_is_exactly_known() -> None:
    estimate = rig()
    for index in range(3):
        none = relative(covariance_of(estimate), estimate, index, index)
        np.testing.assert_allclose(none.matrix, 0, atol=1e-15)


# ---- another reference ---------------------------------------------------------------------


@pytest.mark.parametrize("reference", [1, 2])
def test_rereferenced_by_finite_differences(reference: int) -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    there, ours = rereferenced(estimate, covariance, reference)
    others = [i for i in range(3) if i != reference]
    poses = tuple(name for i in others for name in pose_names(f"cam{i}"))
    assert set(ours.names) == set(covariance.names[:-12]) | set(poses)

    def everything(changed: Estimate) -> FloatArray:
        back = changed.cam_from_rig[reference].inverse
        lenses = [c.params for c in changed.cameras]
        lenses[1] = np.delete(lenses[1], changed.cameras[1].names.index(HELD.split(".")[1]))
        turns = [change_of(there.cam_from_rig[i], changed.cam_from_rig[i] @ back) for i in others]
        return np.concatenate([*lenses, *turns])

    assert ours.names[-12:] == poses
    assert_same(ours.matrix, numeric(covariance, estimate, everything))
    np.testing.assert_array_equal(there.cam_from_rig[reference].rotation, np.eye(3))
    for old, new in zip(estimate.cam_from_rig, there.cam_from_rig, strict=True):
        seen = old @ (estimate.rig_from_world[0] @ estimate.points)
        again = new @ (there.rig_from_world[0] @ there.points)
        np.testing.assert_allclose(again, seen, atol=1e-12)


def test_rereferenced_there_and_back() -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    assert_equal(rereferenced(estimate, covariance, 0)[1], covariance)
    home, back = rereferenced(*rereferenced(estimate, covariance, 2), 0)
    assert_equal(back, covariance)
    np.testing.assert_allclose(
        home.cam_from_rig[1].translation, estimate.cam_from_rig[1].translation
    )
    round_trip = rereferenced(*rereferenced(*rereferenced(estimate, covariance, 2), 1), 0)[1]
    assert_equal(round_trip, covariance)


def test_relative_transforms_do_not_know_the_reference() -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    for reference in (1, 2):
        there, ours = rereferenced(estimate, covariance, reference)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            expected = relative(covariance, estimate, a, b)
            assert_equal(relative(ours, there, a, b), expected)


def test_a_held_transform_stays_known_unless_the_reference_moves() -> None:
    """cam2 is bolted to cam0: seen from cam1 both move, as one."""
    estimate = rig()
    whole = covariance_of(estimate)
    covariance = marginal(whole, [name for name in whole.names if not name.startswith("cam2.r")])
    covariance = marginal(covariance, [n for n in covariance.names if "cam2.t" not in n])
    there, from_1 = rereferenced(estimate, covariance, 1)
    assert {*pose_names("cam0"), *pose_names("cam2")} <= set(from_1.names)
    np.testing.assert_allclose(relative(from_1, there, 0, 2).matrix, 0, atol=1e-15)
    _, from_2 = rereferenced(estimate, covariance, 2)
    assert set(from_2.names) == set(covariance.names)  # cam0 is as exactly known as cam2 was
    only_lenses = marginal(covariance, lens_names(estimate.cameras[0]))
    assert rereferenced(estimate, only_lenses, 1)[1] is only_lenses


def test_a_scan_calibrated_from_another_reference_has_the_rereferenced_covariance() -> None:
    """The whole chain against the graph itself, which knows nothing of propagation."""
    options = TrackOptions(
        rig="triple", frames=8, points=500, max_points_per_image=40, sigma_px=SIGMA_PX,
        focal_error=0.003, rotation_error_deg=0.1, translation_error_m=0.003, point_error_m=0.01,
    )  # fmt: skip
    problem = simulate_tracks(options, np.random.default_rng(0))[0]
    nothing = Covariance(("none",), np.eye(1))
    start, _ = rereferenced(problem.initial, nothing, 2)
    found = []
    for one in (problem, replace(problem, initial=start, reference=2)):
        graph = build(one, GraphOptions(SIGMA_PX))
        estimate, values, _ = solve(graph, max_iterations=300, relative_tolerance=1e-10)
        found.append((estimate, calibration_covariance(graph, estimate, values).model))
    _, ours = rereferenced(*found[0], 2)
    assert_same(ours.matrix, marginal(found[1][1], ours.names).matrix, 5e-3)

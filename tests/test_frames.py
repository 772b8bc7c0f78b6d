"""Transforms: the axioms of the group, GTSAM's tangent by finite differences, robust means."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphs.frames import (
    FloatArray,
    Transform,
    angle_between,
    exp_rotation,
    from_gtsam_inverse,
    log_rotation,
    median_rotation,
    reported_from_tangent,
    skew,
    to_gtsam_inverse,
)


def vectors(size: float) -> st.SearchStrategy[FloatArray]:
    number = st.floats(-size, size, allow_nan=False)
    return st.tuples(number, number, number).map(np.array)


turns = vectors(1.7)  # at most 2.95 rad long: short of half a turn, where the log is ambiguous
transforms = st.builds(Transform.exp, turns, vectors(10.0))


def matrix(transform: Transform) -> FloatArray:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = transform.rotation, transform.translation
    return whole


def close(a: Transform, b: Transform) -> bool:
    return np.allclose(matrix(a), matrix(b), atol=1e-9)


# ---- the group -----------------------------------------------------------------------------


@given(transforms)
def test_inverse_undoes(a_from_b: Transform) -> None:
    assert close(a_from_b @ a_from_b.inverse, Transform.identity())
    assert close(a_from_b.inverse @ a_from_b, Transform.identity())


@given(transforms, transforms, vectors(10.0))
def test_composition_is_the_product_of_matrices(
    a_from_b: Transform, b_from_c: Transform, point: FloatArray
) -> None:
    a_from_c = a_from_b @ b_from_c
    assert np.allclose(matrix(a_from_c), matrix(a_from_b) @ matrix(b_from_c), atol=1e-9)
    assert np.allclose(a_from_c @ point, a_from_b @ (b_from_c @ point), atol=1e-8)


@given(transforms)
def test_points_of_any_shape_are_moved_alike(a_from_b: Transform) -> None:
    points = np.arange(24.0).reshape(2, 4, 3)
    moved = a_from_b @ points
    expected = (matrix(a_from_b) @ np.append(points[1, 2], 1))[:3]
    np.testing.assert_allclose(moved[1, 2], expected, atol=1e-9)


@given(transforms)
def test_quaternions_round_trip_with_w_first_and_not_negative(a_from_b: Transform) -> None:
    q = a_from_b.rotation_wxyz
    assert q[0] >= 0 and np.linalg.norm(q) == pytest.approx(1)
    assert close(Transform.from_wxyz((-3 * q).tolist(), a_from_b.translation.tolist()), a_from_b)


def test_a_quarter_turn_about_z_by_hand() -> None:
    half = np.sqrt(0.5)
    turned = Transform.from_wxyz([half, 0, 0, half], [1, 2, 3])
    np.testing.assert_allclose(turned @ np.array([1.0, 0, 0]), [1, 3, 3], atol=1e-12)
    np.testing.assert_allclose(log_rotation(turned.rotation), [0, 0, np.pi / 2], atol=1e-12)


@pytest.mark.parametrize("q", [[0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 0]])
def test_a_quaternion_without_direction_is_refused(q: list[float]) -> None:
    with pytest.raises(ValueError, match="no direction"):
        Transform.from_wxyz(q, [0, 0, 0])


@given(turns)
def test_log_undoes_exp(turn: FloatArray) -> None:
    rotation = exp_rotation(turn)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(log_rotation(rotation), turn, atol=1e-7)
    assert angle_between(np.eye(3), rotation) == pytest.approx(np.linalg.norm(turn), abs=1e-7)


@given(turns, turns)
def test_the_angle_between_is_symmetric_and_free_of_the_frame(a: FloatArray, b: FloatArray) -> None:
    first, second = exp_rotation(a), exp_rotation(b)
    angle = angle_between(first, second)
    assert angle == pytest.approx(angle_between(second, first), abs=1e-6)
    assert angle == pytest.approx(angle_between(first @ first, first @ second), abs=1e-6)


@given(transforms, st.floats(0.01, 100))
def test_scaling_keeps_the_geometry(a_from_b: Transform, factor: float) -> None:
    point = np.array([0.3, -2.0, 5.0])
    scaled = a_from_b.scaled(factor) @ (factor * point)
    np.testing.assert_allclose(scaled, factor * (a_from_b @ point), atol=1e-9)


@given(vectors(10.0), vectors(10.0))
def test_skew_is_the_cross_product(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-9)


# ---- the border to GTSAM -------------------------------------------------------------------


@given(transforms)
def test_gtsam_holds_the_inverse_and_gives_it_back(b_from_a: Transform) -> None:
    pose = to_gtsam_inverse(b_from_a)
    np.testing.assert_allclose(pose.matrix(), np.linalg.inv(matrix(b_from_a)), atol=1e-9)
    assert close(from_gtsam_inverse(pose), b_from_a)


@given(transforms)
def test_reported_from_tangent_by_finite_differences(b_from_a: Transform) -> None:
    pose, step = to_gtsam_inverse(b_from_a), 1e-6

    def reported(tangent: FloatArray) -> FloatArray:
        moved = from_gtsam_inverse(pose.retract(tangent))
        turn = log_rotation(moved.rotation @ b_from_a.rotation.T)  # about the axes of b
        return np.concatenate([turn, moved.translation - b_from_a.translation])

    numeric = np.stack(
        [(reported(d) - reported(-d)) / (2 * step) for d in step * np.eye(6)], axis=1
    )
    np.testing.assert_allclose(reported_from_tangent(b_from_a), numeric, atol=1e-6)


def test_gtsam_perturbs_on_the_right_rotation_first() -> None:
    """The convention that the Jacobian above stands on."""
    pose = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, -0.2, 0.1), np.array([1.0, 2, 3]))
    tangent = 1e-4 * np.array([1.0, -2, 3, 4, -5, 6])
    expected = pose.compose(gtsam.Pose3.Expmap(tangent))
    np.testing.assert_allclose(pose.retract(tangent).matrix(), expected.matrix(), atol=1e-7)


# ---- robust means --------------------------------------------------------------------------


def spread(centre: FloatArray, turn: float, count: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return np.array([centre @ exp_rotation(turn * rng.standard_normal(3)) for _ in range(count)])


@given(turns)
def test_the_median_of_equal_rotations_is_that_rotation(turn: FloatArray) -> None:
    rotation = exp_rotation(turn)
    assert angle_between(median_rotation(np.array([rotation] * 4)), rotation) < 1e-6


@pytest.mark.parametrize("share", [0.02, 0.2, 0.4])
def test_the_median_rotation_ignores_outliers(share: float) -> None:
    centre = exp_rotation(np.array([0.4, -1.2, 2.0]))
    rng = np.random.default_rng(3)
    rotations = spread(centre, 0.01, 50, 1)
    wrong = rng.permutation(50)[: round(50 * share)]
    rotations[wrong] = [
        centre @ exp_rotation(np.array([0.8, 0.5, -0.3]) + 0.1 * rng.standard_normal(3))
        for _ in wrong
    ]
    assert angle_between(median_rotation(rotations), centre) < 0.012


def test_the_median_rotation_minimises_the_sum_of_angles() -> None:
    rotations = spread(exp_rotation(np.array([1.0, 0.5, -0.2])), 0.5, 9, 2)

    def cost(rotation: FloatArray) -> float:
        return sum(angle_between(rotation, r) for r in rotations)

    median = median_rotation(rotations, iterations=500)
    for move in (*(1e-3 * np.eye(3)), *(-1e-3 * np.eye(3))):
        assert cost(median @ exp_rotation(move)) > cost(median)


def test_the_median_rotation_moves_with_its_frame() -> None:
    rotations = spread(np.eye(3), 0.3, 7, 4)
    turned = exp_rotation(np.array([0.0, 3.0, 0.4]))
    assert (
        angle_between(median_rotation(turned @ rotations), turned @ median_rotation(rotations))
        < 1e-6
    )

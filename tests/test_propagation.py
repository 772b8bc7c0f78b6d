"""What follows from a covariance: every Jacobian by re-evaluation, and by drawing calibrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.calibrated import (
    assert_drawn_from,
    assert_same,
    covariance_of,
    draws,
    moved,
    numeric,
    points_of_rig,
    rig,
    shuffled,
)
from synthetic.cameras import SIZE, camera_of

from graphs.camera import Camera, project, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.lenses import LENS_NAMES, LensName
from graphs.pose_covariance import rereferenced
from graphs.problem import Estimate
from graphs.propagation import (
    Field,
    cross_covariance,
    field_of_view,
    focal_and_aspect,
    lens_names,
    marginal,
    projection,
    projection_covariance,
    ray_jacobian,
    replaced,
    transformed,
)

# ---- names ---------------------------------------------------------------------------------


def test_marginals_and_cross_covariances_go_by_name() -> None:
    covariance = Covariance(("a", "b", "c"), np.array([[4.0, 1, 2], [1, 9, 3], [2, 3, 16]]))
    found = marginal(covariance, ["c", "held", "a"])
    assert found.names == ("c", "a")
    np.testing.assert_array_equal(found.matrix, [[16, 2], [2, 4]])
    np.testing.assert_array_equal(
        cross_covariance(covariance, ["b"], ["c", "held", "b"]), [[3, 0, 9]]
    )
    with pytest.raises(ValueError, match=r"has no cam9.fx: .* it has a b c"):
        marginal(covariance, ["cam9.fx"])


def test_transformed_and_replaced_by_hand() -> None:
    covariance = Covariance(("a", "b", "c"), np.array([[4.0, 1, 2], [1, 9, 3], [2, 3, 16]]))
    total = transformed(covariance, ["sum"], np.ones((1, 3)))
    assert total.names == ("sum",) and total.matrix == pytest.approx(41)
    difference = transformed(covariance, ["c-a"], np.array([[-1.0, 1.0, 5.0]]), ["a", "c", "held"])
    assert difference.matrix == pytest.approx(16)
    other = replaced(covariance, ["b+c", "b-c"], np.array([[1.0, 1], [1, -1]]), ["b", "c"])
    assert other.names == ("a", "b+c", "b-c")
    np.testing.assert_allclose(other.matrix, [[4, 3, -1], [3, 31, -7], [-1, -7, 19]])
    assert replaced(covariance, ["d"], np.eye(1), ["held"]) is covariance


def test_what_was_between_stays_in_its_order() -> None:
    covariance = Covariance(("a", "b", "c", "d"), np.diag([1.0, 2, 3, 4]))
    other = replaced(covariance, ["x", "y"], np.array([[0.0, 2], [3, 0]]), ["d", "b"])
    assert other.names == ("a", "x", "y", "c")
    np.testing.assert_array_equal(other.matrix, np.diag([1, 8, 36, 3]))


# ---- lenses --------------------------------------------------------------------------------


def test_focal_and_aspect_by_finite_differences() -> None:
    estimate = rig()
    covariance = covariance_of(estimate)
    camera = estimate.cameras[1]

    def pair(changed: Estimate) -> FloatArray:
        fx, fy = changed.cameras[1].params[:2]
        return np.array([(fx + fy) / 2, fy / fx])

    ours = focal_and_aspect(covariance, camera)
    assert [n for n in ours.names if "cam1." in n][:3] == ["cam1.focal", "cam1.aspect", "cam1.cx"]
    found = marginal(ours, ["cam1.focal", "cam1.aspect"]).matrix
    assert_same(found, numeric(covariance, estimate, pair))
    np.testing.assert_array_equal(
        cross_covariance(ours, ["cam0.fx"], ["cam2.fx"]),
        cross_covariance(covariance, ["cam0.fx"], ["cam2.fx"]),
    )


def test_a_held_focal_length_is_exactly_known() -> None:
    camera = rig().cameras[0]
    fx = camera.params[0]
    ours = focal_and_aspect(Covariance(("cam0.fy",), np.array([[4.0]])), camera)
    assert ours.sigma == pytest.approx({"cam0.focal": 1.0, "cam0.aspect": 2 / fx})
    both_held = Covariance(("cam0.cx",), np.array([[4.0]]))
    assert focal_and_aspect(both_held, camera) is both_held


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_rays_by_finite_differences(lens: LensName) -> None:
    camera = camera_of(lens)
    pixels = np.array([[12.0, 30.0], [330.0, 232.0], [601.0, 455.0], [100.0, 440.0]])
    rays, jacobian = ray_jacobian(camera, pixels)
    np.testing.assert_array_equal(rays, unproject(camera, pixels))
    for index, step in enumerate([1e-3] * 4 + [1e-6] * (camera.params.size - 4)):
        change = step * np.eye(camera.params.size)[index]
        after, before = (
            unproject(replace(camera, params=camera.params + sign * change), pixels)
            for sign in (1, -1)
        )
        slope = (after - before) / (2 * step)
        np.testing.assert_allclose(jacobian[..., index], slope, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("index", range(3))
def test_field_of_view_by_finite_differences(index: int) -> None:
    estimate = rig()
    covariance = covariance_of(estimate)

    def fields(changed: Estimate) -> FloatArray:
        return field_of_view(covariance, changed.cameras[index])[0]

    angles, ours = field_of_view(covariance, estimate.cameras[index])
    assert ours.names == tuple(
        f"cam{index}.fov_{field}_deg" for field in ("horizontal", "vertical", "diagonal")
    )
    assert angles[1] < angles[0] < angles[2]
    assert_same(ours.matrix, numeric(covariance, estimate, fields))
    again = field_of_view(shuffled(covariance), estimate.cameras[index], ["vertical"])[1]
    assert again.sigma[ours.names[1]] == pytest.approx(ours.sigma[ours.names[1]])


@pytest.mark.parametrize("across_deg", [60.0, 180.0, 220.0])
@pytest.mark.parametrize(("field", "length_px"), [("horizontal", 640), ("diagonal", 800)])
def test_the_field_of_view_of_a_fisheye_by_hand(
    field: Field, length_px: float, across_deg: float
) -> None:
    """Equidistant: fov = length / f through the principal point, at a half turn and beyond too.

    That is off the image's centre: opposite rays leave no more than rounding between them.
    """
    f = length_px / np.radians(across_deg)
    centre = (0.45 * 640 - 0.5, 239.5 if field == "horizontal" else 0.45 * 480 - 0.5)
    camera = Camera("cam", "kannala_brandt", SIZE, np.array([f, f, *centre, *[0] * 4]))
    covariance = Covariance(("cam.fx", "cam.fy"), np.full((2, 2), 0.25))
    angles, ours = field_of_view(covariance, camera, [field])
    assert angles == pytest.approx([across_deg])
    assert ours.sigma == pytest.approx({f"cam.fov_{field}_deg": 0.5 * across_deg / f})


def test_the_field_of_view_of_a_pinhole_by_hand() -> None:
    camera = Camera("cam", "pinhole", SIZE, np.array([320.0, 240.0, 319.5, 239.5]))
    angles, _ = field_of_view(Covariance(("cam.fx",), np.eye(1)), camera)
    assert angles == pytest.approx([90, 90, 2 * np.degrees(np.arctan(np.sqrt(2)))])


def test_a_lens_that_folds_back_has_no_diagonal() -> None:
    camera = camera_of("simple_radial", (-0.5,))
    covariance = Covariance(("cam.fx",), np.eye(1))
    with pytest.raises(
        ValueError, match=r"cam: its simple_radial lens sees nothing .* no diagonal"
    ):
        field_of_view(covariance, camera, ["vertical", "diagonal"])
    assert field_of_view(covariance, camera, ["vertical"])[0][0] > 0


# ---- pixels --------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", range(3))
@pytest.mark.parametrize("given_in", ["rig", "camera"])
def test_projection_covariance_by_finite_differences(camera: int, given_in: str) -> None:
    estimate, points = rig(), points_of_rig()
    covariance = covariance_of(estimate)

    def pixels(changed: Estimate) -> FloatArray:
        transform = changed.cam_from_rig[camera] if given_in == "rig" else Transform.identity()
        return project(changed.cameras[camera], transform @ points)

    ours = projection_covariance(estimate, covariance, camera, points, given_in)
    assert ours.shape == (12, 2, 2)
    assert_same(ours, numeric(covariance, estimate, pixels), 1e-5)
    again = projection_covariance(estimate, shuffled(covariance), camera, points, given_in)
    np.testing.assert_allclose(again, ours, rtol=1e-9)
    assert (np.linalg.eigvalsh(ours) > -1e-12).all()
    seen = projection(estimate, camera, points, given_in)
    step = 1e-6
    for axis, change in enumerate(step * np.eye(3)):
        after = projection(estimate, camera, points + change, given_in).pixels
        before = projection(estimate, camera, points - change, given_in).pixels
        slope = (after - before) / (2 * step)
        np.testing.assert_allclose(seen.by_point[..., axis], slope, rtol=1e-5, atol=1e-4)


def test_projection_covariance_by_drawing_calibrations() -> None:
    estimate, point = rig(), np.array([0.3, -0.2, 3.0])
    covariance = covariance_of(estimate, 0.3)
    sample = []
    for change in draws(covariance, 1500):
        drawn = moved(estimate, covariance.names, change)
        sample.append(project(drawn.cameras[1], drawn.cam_from_rig[1] @ point))
    assert_drawn_from(np.array(sample), projection_covariance(estimate, covariance, 1, point))
    apart = Covariance(covariance.names, np.diag(np.diag(covariance.matrix)))
    with pytest.raises(AssertionError):
        assert_drawn_from(np.array(sample), projection_covariance(estimate, apart, 1, point))


def test_a_point_that_the_lens_refuses_has_no_covariance() -> None:
    estimate = rig()
    points = np.array([[[0.1, 0.1, 3.0], [0.0, 0.0, -1.0]]])
    ours = projection_covariance(estimate, covariance_of(estimate), 1, points)
    assert ours.shape == (1, 2, 2, 2)
    assert np.isfinite(ours[0, 0]).all() and np.isnan(ours[0, 1]).all()


def test_a_held_calibration_projects_exactly() -> None:
    estimate = rig()
    other = marginal(covariance_of(estimate), lens_names(estimate.cameras[0]))
    assert (projection_covariance(estimate, other, 2, points_of_rig()) == 0).all()


def test_pixels_do_not_know_the_reference() -> None:
    """The spread of what moves with one camera, seen by another, is the same in any frame."""
    estimate = rig()
    covariance = covariance_of(estimate)
    in_1 = estimate.cam_from_rig[1] @ points_of_rig()
    there, ours = rereferenced(estimate, covariance, 1)
    pixels = project(estimate.cameras[2], there.cam_from_rig[2] @ in_1)

    def from_1(changed: Estimate) -> FloatArray:
        one, two = changed.cam_from_rig[1:]
        return project(changed.cameras[2], two @ one.inverse @ in_1)

    np.testing.assert_allclose(from_1(estimate), pixels)
    expected = numeric(covariance, estimate, from_1)
    assert_same(projection_covariance(there, ours, 2, in_1), expected, 1e-5)

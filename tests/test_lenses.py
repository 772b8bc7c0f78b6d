"""Lenses against OpenCV, COLMAP, GTSAM and their own formulas; where they refuse to project."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from synthetic.cameras import (
    COEFFICIENTS,
    SIZE,
    camera_of,
    complex_step,
    formula,
    points_ahead,
    rays_at,
    wide,
)

from graphs.camera import Camera, lens_arrays, project, project_jacobian, valid_limit
from graphs.frames import FloatArray
from graphs.lenses import (
    LENS_NAMES,
    LENSES,
    MAX_PARAMS,
    MODEL_INDEX,
    PARAMETER_NAMES,
    LensName,
    project_many,
    project_point_many,
)
from graphs.reference import NATIVE_LENSES, native_lens
from sfm_calib.colmap import colmap_camera
from sfm_calib.colmap_lenses import EXACT_MODEL

ON_PLANE = [lens for lens in LENS_NAMES if not wide(lens)]
WIDE = [lens for lens in LENS_NAMES if wide(lens)]


def everywhere(camera: Camera, count: int = 300) -> FloatArray:
    """Points (count, 3) over all that a lens sees, near and far, on all sides."""
    rng = np.random.default_rng(7)
    limit = valid_limit(camera)
    widest = limit if wide(camera.lens) else np.arctan(min(limit, 3.0))
    rays = rays_at(0.95 * widest * rng.uniform(0, 1, count), rng.uniform(0, 2 * np.pi, count))
    return rays * 10 ** rng.uniform(-2, 2, (count, 1))


# ---- other people's projections ------------------------------------------------------------


def opencv(camera: Camera, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """OpenCV's pixels (n, 2), and its Jacobians by point (n, 2, 3) and parameters (n, 2, P)."""
    fx, fy, cx, cy = camera.params[:4]
    matrix, still = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    if camera.lens == "kannala_brandt":
        distortion = camera.params[4:]
        pixels, jacobian = cv2.fisheye.projectPoints(
            points[:, None, :], still, still, matrix, distortion
        )
        order = {"translation": slice(11, 14), "params": slice(0, 8)}
    else:
        distortion = np.zeros(max(4, camera.params.size - 4))
        distortion[: camera.params.size - 4] = camera.params[4:]
        pixels, jacobian = cv2.projectPoints(points, still, still, matrix, distortion)
        order = {"translation": slice(3, 6), "params": slice(6, 6 + camera.params.size)}
    jacobian = jacobian.reshape(len(points), 2, -1)
    return pixels[:, 0], jacobian[..., order["translation"]], jacobian[..., order["params"]]


@pytest.mark.parametrize("lens", [*ON_PLANE, "kannala_brandt"])
def test_projects_as_opencv_does_and_changes_as_opencv_says(lens: LensName) -> None:
    camera, points = camera_of(lens), points_ahead()
    expected, expected_by_point, expected_by_params = opencv(camera, points)
    pixels, by_point, by_params = project_jacobian(camera, points)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    scale = 1 / points[:, 2, None, None]  # derivatives by point are large near the camera
    np.testing.assert_allclose(by_point / scale, expected_by_point / scale, atol=1e-8)
    np.testing.assert_allclose(by_params, expected_by_params, atol=1e-8)


def test_the_names_are_in_opencvs_order() -> None:
    """As OpenCV documents distCoeffs: (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]])."""
    distortion = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
    for lens, count in (("radtan", 4), ("brown", 5), ("rational", 8), ("thin_prism", 12)):
        assert PARAMETER_NAMES[lens] == ("fx", "fy", "cx", "cy", *distortion[:count])
    assert PARAMETER_NAMES["kannala_brandt"] == ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


@pytest.mark.parametrize("lens", EXACT_MODEL)
def test_projects_as_colmap_does_half_a_pixel_on(lens: LensName) -> None:
    camera, points = camera_of(lens), points_ahead()
    theirs = colmap_camera(camera, EXACT_MODEL[lens])
    expected = np.array([theirs.img_from_cam(point) for point in points])
    np.testing.assert_allclose(project(camera, points) + 0.5, expected, atol=1e-9)


def test_a_division_lens_looks_sideways_and_back_as_colmaps_does() -> None:
    camera = camera_of("division")
    rays = rays_at(np.radians([60.0, 89, 91, 120, 150]), 0.7)
    theirs = colmap_camera(camera, "DIVISION")
    expected = np.array([theirs.img_from_cam(ray) for ray in rays])
    np.testing.assert_allclose(project(camera, rays) + 0.5, expected, rtol=1e-12)


@pytest.mark.parametrize("lens", NATIVE_LENSES)
def test_projects_as_gtsam_does(lens: LensName) -> None:
    camera, points = camera_of(lens), points_ahead()
    native = native_lens(camera)
    expected = [native.uncalibrate(point[:2] / point[2]) for point in points]
    np.testing.assert_allclose(project(camera, points), expected, atol=1e-9)


def test_a_point_by_hand() -> None:
    camera = Camera("cam", "radtan", SIZE, np.array([100.0, 200, 10, 20, 0.1, 0.01, 0.02, 0.03]))
    # a = 1, b = 2, r2 = 5, d = 1.75; tangential: 0.08 + 0.21 and 0.26 + 0.12
    pixel = project(camera, np.array([2.0, 4.0, 2.0]))
    np.testing.assert_allclose(pixel, [100 * 2.04 + 10, 200 * 3.88 + 20])


# ---- their own formulas, and automatic differentiation of them -------------------------------


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_projects_as_its_formula_says(lens: LensName) -> None:
    camera = camera_of(lens)
    points = everywhere(camera)
    expected = formula(lens, camera.params.astype(complex), points.astype(complex)).real
    np.testing.assert_allclose(project(camera, points), expected, rtol=1e-11, atol=1e-9)


def worst_difference(ours: FloatArray, theirs: FloatArray) -> float:
    """The largest difference of two Jacobians (n, 2, m), relative to each row's largest entry."""
    scale = np.abs(theirs).max(axis=(1, 2), keepdims=True)
    return float((np.abs(ours - theirs) / scale).max())


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_jacobians_are_those_of_complex_steps(lens: LensName) -> None:
    camera = camera_of(lens)
    points = everywhere(camera)
    _, by_point, by_params = project_jacobian(camera, points)
    expected_by_point, expected_by_params = complex_step(lens, camera.params, points)
    assert worst_difference(by_point, expected_by_point) < 1e-12
    for column, name in enumerate(PARAMETER_NAMES[lens]):
        expected = expected_by_params[..., column]
        np.testing.assert_allclose(
            by_params[..., column], expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max(),
            err_msg=name,
        )  # fmt: skip


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_jacobians_are_right_on_the_axis_too(lens: LensName) -> None:
    """Where formulas divide by the distance from the axis: the limit, from a point close by."""
    camera = camera_of(lens)
    near = np.array([[1e-7, 2e-7, 0.7], [-3e-9, 1e-9, 0.7], [2e-13, 1e-13, 0.7], [0.0, 0.0, 0.7]])
    pixels, by_point, by_params = project_jacobian(camera, near)
    np.testing.assert_allclose(pixels[3], camera.params[2:4])
    for row in range(1, 4):
        np.testing.assert_allclose(by_point[row], by_point[0], rtol=1e-5, atol=1e-3)
        np.testing.assert_allclose(by_params[row], by_params[0], atol=1e-3)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_nothing_changes_along_the_ray(lens: LensName) -> None:
    camera = camera_of(lens)
    points = everywhere(camera)
    by_point = project_jacobian(camera, points)[1]
    along = np.einsum("nij,nj->ni", by_point, points)
    scale = np.linalg.norm(by_point, axis=(1, 2)) * np.linalg.norm(points, axis=1)
    assert (np.abs(along) < 1e-12 * scale[:, None]).all()


@given(st.floats(-60, 60))
@settings(deadline=None)
def test_a_projection_does_not_know_the_unit_of_length(exponent: float) -> None:
    point = np.array([0.3, -0.2, 0.9])
    for lens in LENS_NAMES:
        camera = camera_of(lens)
        pixel, by_point, by_params = project_jacobian(camera, point)
        scaled = project_jacobian(camera, 10.0**exponent * point)
        np.testing.assert_allclose(scaled[0], pixel, atol=1e-9)
        np.testing.assert_allclose(scaled[1] * 10.0**exponent, by_point, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(scaled[2], by_params, atol=1e-9)


# ---- where there is nothing to see ---------------------------------------------------------


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_refuses_what_is_no_direction(lens: LensName) -> None:
    nan, inf = np.nan, np.inf
    points = np.array(
        [[0, 0, 0], [0, 0, -2], [nan, 0, 1], [0, nan, 1], [0, 0, nan], [nan] * 3, [inf, 0, 1]]
    )
    pixels, by_point, by_params = project_jacobian(camera_of(lens), points)
    assert np.isnan(pixels).all()
    assert not by_point.any() and not by_params.any()


@pytest.mark.parametrize("lens", ON_PLANE)
def test_a_lens_on_the_plane_refuses_what_is_beside_and_behind_the_camera(lens: LensName) -> None:
    points = np.array([[0.1, 0.2, -1.0], [1e-3, 0.0, -2.0], [1.0, 0, 0], [1, 1, -1e-300]])
    assert np.isnan(project(camera_of(lens), points)).all()


def test_a_fisheye_sees_sideways_and_a_little_behind_but_not_its_own_back() -> None:
    camera = camera_of("kannala_brandt", (0.0, 0.0, 0.0, 0.0))
    sideways = project(camera, np.array([2.0, 0.0, 0.0]))
    np.testing.assert_allclose(sideways, [330 + 300 * np.pi / 2, 231])
    assert project(camera, np.array([1.0, 0.0, -0.5]))[0] > sideways[0]
    assert np.isnan(project(camera, np.array([[0.0, 0, -1], [1e-14, 0, -1], [0, 0, 0]]))).all()


# Coefficients with which each lens ends well before its own horizon, and where: by hand, where a
# hand can. 1 - 0.9 r^2; 1 - 0.9 s + 0.05 s^2; theta (1 - 0.2 theta^2): 1 - 0.6 theta^2;
# r / (1 - r^2 / 2) is infinite; 1 - 4 k tan^2; cos = -(1 - alpha) / alpha, or -alpha / (1 - alpha)
FOLDS: list[tuple[LensName, tuple[float, ...], float | None]] = [
    ("simple_radial", (-0.3,), 0.9**-0.5),
    ("radial", (-0.3, 0.01), np.sqrt((0.9 - np.sqrt(0.81 - 0.2)) / 0.1)),
    ("radtan", (-0.3, 0.01, 0.0, 0.0), np.sqrt((0.9 - np.sqrt(0.81 - 0.2)) / 0.1)),
    ("brown", (0.0, 0.0, 0.0, 0.0, -0.1), 0.7 ** (-1 / 6)),
    ("rational", (0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0), np.sqrt(2)),
    ("rational", (0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0), np.sqrt(2)),
    ("rational", (-0.2, 0.1, 0.0, 0.0, -0.3, 0.1, 0.3, 0.1), None),
    ("thin_prism", (0.1, 0.0, 0.0, 0.0, 0.0, 0.9, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0), None),
    ("kannala_brandt", (-0.2, 0.0, 0.0, 0.0), 0.6**-0.5),
    ("division", (0.25,), np.pi / 4),
    ("eucm", (0.8, 1.0), np.arccos(-0.25)),
    ("eucm", (0.3, 1.0), np.arccos(-3 / 7)),
    ("eucm", (0.8, 2.0), None),
    ("eucm", (0.2, 0.4), None),
    ("double_sphere", (0.0, 0.8), np.arccos(-0.25)),
    ("double_sphere", (-0.3, 0.7), None),
    ("double_sphere", (0.4, 0.3), None),
    ("double_sphere", (2.0, 0.5), np.arccos(-0.5)),
]


@pytest.mark.parametrize(("lens", "coefficients", "by_hand"), FOLDS)
def test_refuses_what_lies_beyond_the_fold(
    lens: LensName, coefficients: tuple[float, ...], by_hand: float | None
) -> None:
    camera = camera_of(lens, coefficients)
    limit = valid_limit(camera)
    assert by_hand is None or limit == pytest.approx(by_hand)
    steps = limit * np.array([0.97, 0.99, 0.9999, 1.0001, 1.01, 1.3])
    for around in (0.0, 2.0, 4.0):
        pixels = project(camera, rays_at(steps if wide(lens) else np.arctan(steps), around))
        assert (np.isfinite(pixels).all(1) == [True, True, True, False, False, False]).all()
        radii = np.linalg.norm(pixels - camera.params[2:4], axis=1)
        assert radii[2] > radii[1] > radii[0]  # still growing just before it


STRENGTH = {"k1": 0.4, "k2": 0.2, "k3": 0.1, "k4": 0.4, "k5": 0.2, "k6": 0.1}
RANGE = {"alpha": (-0.2, 1.2), "beta": (0.3, 2.0), "xi": (-0.9, 1.5)}


@st.composite
def radial_lenses(draw: st.DrawFn) -> Camera:
    """Any lens with any radial coefficients, its tangential and prism terms at zero."""
    lens = draw(st.sampled_from(LENS_NAMES))
    spans = (
        RANGE.get(name, (-STRENGTH.get(name, 0.0), STRENGTH.get(name, 0.0)))
        for name in LENSES[lens].coefficients
    )
    return camera_of(lens, tuple(draw(st.floats(*span)) for span in spans))


def first_end(camera: Camera, radii: FloatArray) -> float:
    """The last of these radii (angles) up to which the formula's pixel moves outwards."""
    rays = rays_at(radii if wide(camera.lens) else np.arctan(radii)).astype(complex)
    with np.errstate(all="ignore"):
        pixels = formula(camera.lens, camera.params.astype(complex), rays)
    reach = np.where(np.abs(pixels[:, 0].imag) > 1e-9, np.nan, pixels[:, 0].real - camera.params[2])
    growing = (np.diff(reach) > 0) & (reach[1:] > 0)
    if {"k4", "k5", "k6"} <= set(camera.names):  # a pole, also where the numerator cancels it
        k4, k5, k6 = camera.params[9:12]
        growing &= (1 + k4 * radii**2 + k5 * radii**4 + k6 * radii**6 > 0)[1:]
    return float(radii[-1] if growing.all() else radii[np.argmin(growing)])


@given(radial_lenses())
@settings(deadline=None, max_examples=300)
def test_the_limit_is_where_the_formula_stops_growing(camera: Camera) -> None:
    """By looking, in 3000 steps."""
    if camera.lens == "division":
        assume(camera.params[4] == 0 or abs(camera.params[4]) > 1e-9)  # else rounding decides
    horizon = np.pi - 1e-3 if wide(camera.lens) else 4.0
    radii = np.linspace(1e-3, horizon, 3000)
    seen, limit = first_end(camera, radii), min(valid_limit(camera), horizon)
    assert seen == pytest.approx(limit, abs=2 * (radii[1] - radii[0]))


def test_refuses_the_fold_itself() -> None:
    """1 + 3 k1 r^2 and z^2 - 4 k1 rho^2 are zero: the Jacobian has no inverse, or is infinite."""
    for camera in (camera_of("simple_radial", (-1 / 3,)), camera_of("division", (0.25,))):
        pixels, by_point, by_params = project_jacobian(camera, np.array([1.0, 0.0, 1.0]))
        assert np.isnan(pixels).all() and not by_point.any() and not by_params.any()


def test_a_tangential_term_folds_the_plane_too() -> None:
    """u + 3 p2 u^2 turns back at u = -1 / (6 p2), on one side only; the radial part never does."""
    camera = camera_of("radtan", (0.0, 0.0, 0.0, -0.25))
    assert valid_limit(camera) == np.inf
    at = np.array([-0.9, 0.6, 0.66, 0.67, 0.9])
    pixels = project(camera, np.column_stack([at, 0 * at, 1 + 0 * at]))
    assert (np.isfinite(pixels).all(1) == [True, True, True, False, False]).all()
    prism = camera_of("thin_prism", (*(0.0,) * 10, -0.5, 0.0))  # v - 0.5 v^2, at v = 1
    pixels = project(prism, np.array([[0, 0.99, 1], [0, 1.01, 1], [0, -2.0, 1]]))
    assert (np.isfinite(pixels).all(1) == [True, False, True]).all()


@given(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3))
@settings(deadline=None)
def test_vanishing_coefficients_still_have_a_limit(k1: float, k2: float) -> None:
    assert valid_limit(camera_of("radial", (k1, k2))) > 3


def test_lenses_that_never_end() -> None:
    assert valid_limit(camera_of("pinhole")) == np.inf
    assert valid_limit(camera_of("simple_radial", (0.4,))) == np.inf
    assert valid_limit(camera_of("kannala_brandt", (0, 0, 0, 0))) == pytest.approx(np.pi)
    assert valid_limit(camera_of("division", (-0.2,))) == pytest.approx(np.pi)


def test_a_double_sphere_that_looks_backwards_sees_nothing() -> None:
    camera = camera_of("double_sphere", (-1.05, 0.6))
    assert valid_limit(camera) == 0.0
    assert np.isnan(project(camera, rays_at(np.linspace(0, 3, 30)))).all()


def test_a_negative_beta_ends_where_its_root_does() -> None:
    """d = sqrt(z^2 - rho^2) at 45 degrees."""
    camera = camera_of("eucm", (0.6, -1.0))
    assert valid_limit(camera) == pytest.approx(np.pi / 4)
    pixels = project(camera, rays_at(np.array([0.0, 0.7853, 0.7855, 2.0])))
    assert (np.isfinite(pixels).all(1) == [True, True, False, False]).all()


def test_a_division_lens_inverts_fitzgibbons_ray() -> None:
    camera = camera_of("division")
    a, b = np.meshgrid(np.linspace(-3, 3, 9), np.linspace(-2, 2, 7))
    rays = np.stack([a, b, 1 + camera.params[4] * (a**2 + b**2)], axis=-1)
    expected = np.stack([a, b], axis=-1) * camera.params[:2] + camera.params[2:4]
    np.testing.assert_allclose(project(camera, rays), expected, rtol=1e-12)


# ---- many cameras at once ------------------------------------------------------------------


def test_many_cameras_at_once_are_each_camera_alone() -> None:
    cameras = [camera_of(lens) for lens in LENS_NAMES]
    rng = np.random.default_rng(3)
    camera = rng.integers(0, len(cameras), 500)
    points = points_ahead(500, spread=1.2)
    points[::7, 2] *= -1
    arrays = lens_arrays(cameras)
    assert arrays[1].shape == (len(cameras), MAX_PARAMS)
    columns = MAX_PARAMS + 3  # more than any lens needs
    pixels, by_point = np.empty((500, 2)), np.empty((500, 2, 3))
    by_params = np.full((500, 2, columns), np.inf)
    project_many(*arrays, camera, points, pixels, by_point, by_params)
    assert 10 < np.isnan(pixels[:, 0]).sum() < 250
    for index, one in enumerate(cameras):
        rows, count = camera == index, one.params.size
        alone = project_jacobian(one, points[rows])
        np.testing.assert_array_equal(pixels[rows], alone[0])
        np.testing.assert_array_equal(by_point[rows], alone[1])
        np.testing.assert_array_equal(by_params[rows, :, :count], alone[2])
        assert not by_params[rows, :, count:].any()
    cheap, cheap_by_point = np.empty((500, 2)), np.empty((500, 2, 3))
    project_point_many(*arrays, camera, points, cheap, cheap_by_point)
    np.testing.assert_allclose(cheap, pixels, rtol=1e-14)
    np.testing.assert_allclose(cheap_by_point, by_point, rtol=1e-12, atol=1e-12)


def test_every_lens_has_one_block_and_one_number_and_is_tried_above() -> None:
    assert {lens for lens, _, _ in FOLDS} == set(LENS_NAMES) - {"pinhole"}
    assert set(LENSES) == set(LENS_NAMES) == set(PARAMETER_NAMES) == set(COEFFICIENTS)
    assert [MODEL_INDEX[lens] for lens in LENS_NAMES] == list(range(len(LENS_NAMES)))
    assert max(len(names) for names in PARAMETER_NAMES.values()) == MAX_PARAMS
    assert all(len(LENSES[lens].nominal) == len(LENSES[lens].coefficients) for lens in LENS_NAMES)

"""Lens models against OpenCV, COLMAP and GTSAM, and the edges beyond which they refuse."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphs.frames import FloatArray
from graphs.lenses import (
    LENS_NAMES,
    PARAMETER_NAMES,
    Camera,
    LensName,
    nominal_params,
    project,
    unproject,
    valid_limit,
)
from graphs.reference import native_lens
from sfm_calib.colmap import EXACT_MODEL, colmap_camera

SIZE = (640, 480)
# Sizes of real lenses and beyond; every number different, so that no two can change places.
COEFFICIENTS: dict[LensName, tuple[float, ...]] = {
    "pinhole": (),
    "simple_radial": (-0.21,),
    "radial": (-0.28, 0.09),
    "radtan": (-0.31, 0.11, 0.004, -0.007),
    "kannala_brandt": (-0.031, 0.012, -0.008, 0.0015),
}
STRONG = (0.4, 0.15, 0.003, 0.003)
BROWN: tuple[LensName, ...] = ("pinhole", "simple_radial", "radial", "radtan")


def camera_of(lens: LensName, coefficients: tuple[float, ...] | None = None) -> Camera:
    focal = 300.0 if lens == "kannala_brandt" else 520.0
    if coefficients is None:
        coefficients = COEFFICIENTS[lens]
    return Camera("cam", lens, SIZE, np.array([focal, focal + 9, 330.0, 231.0, *coefficients]))


def points_ahead(count: int = 200, spread: float = 0.8) -> FloatArray:
    rng = np.random.default_rng(5)
    depth = rng.uniform(0.2, 30, count)
    return np.column_stack([rng.uniform(-spread, spread, (count, 2)) * depth[:, None], depth])


# ---- other people's projections ------------------------------------------------------------


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_projects_as_opencv_does(lens: LensName) -> None:
    camera, points = camera_of(lens), points_ahead()
    fx, fy, cx, cy = camera.params[:4]
    matrix, still = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    if lens == "kannala_brandt":
        columns = points[:, None, :]
        expected, _ = cv2.fisheye.projectPoints(columns, still, still, matrix, camera.params[4:])
    else:
        coefficients = np.zeros(4)
        coefficients[: camera.params.size - 4] = camera.params[4:]
        expected, _ = cv2.projectPoints(points, still, still, matrix, coefficients)
    np.testing.assert_allclose(project(camera, points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_projects_as_colmap_does_half_a_pixel_on(lens: LensName) -> None:
    camera, points = camera_of(lens), points_ahead()
    theirs = colmap_camera(camera, EXACT_MODEL[lens])
    expected = np.array([theirs.img_from_cam(point) for point in points])
    np.testing.assert_allclose(project(camera, points) + 0.5, expected, atol=1e-9)


@pytest.mark.parametrize("lens", LENS_NAMES)
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


# ---- there and back ------------------------------------------------------------------------


def lenses_and_rays() -> st.SearchStrategy[tuple[Camera, FloatArray]]:
    """Any lens with coefficients up to strong ones, and a ray well inside its valid region."""

    @st.composite
    def draw(draw: st.DrawFn) -> tuple[Camera, FloatArray]:
        lens = draw(st.sampled_from(LENS_NAMES))
        strength = (0.15, 0.05, 0.02, 0.004) if lens == "kannala_brandt" else STRONG
        coefficients = tuple(
            draw(st.floats(-most, most))
            for _, most in zip(PARAMETER_NAMES[lens][4:], strength, strict=False)
        )
        camera = camera_of(lens, coefficients)
        widest = 1.9 if lens == "kannala_brandt" else 1.6
        reach = draw(st.floats(0, 0.9)) * min(valid_limit(camera), widest)
        around = draw(st.floats(0, 2 * np.pi))
        angle = reach if lens == "kannala_brandt" else np.arctan(reach)
        across = np.sin(angle) * np.array([np.cos(around), np.sin(around)])
        return camera, np.array([*across, np.cos(angle)])

    return draw()


@given(lenses_and_rays(), st.floats(1e-3, 1e3))
def test_unproject_undoes_project(case: tuple[Camera, FloatArray], depth: float) -> None:
    camera, ray = case
    pixel = project(camera, depth * ray)
    assert np.isfinite(pixel).all()
    np.testing.assert_allclose(unproject(camera, pixel), ray, atol=1e-7)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_every_pixel_of_a_real_lens_has_a_ray(lens: LensName) -> None:
    camera = camera_of(lens)
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 479, 25)), axis=-1)
    rays = unproject(camera, grid)
    assert rays.shape == (25, 33, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1)
    np.testing.assert_allclose(project(camera, 7 * rays), grid, atol=1e-6)


@pytest.mark.parametrize("k1", [-0.5, -0.35, 0.4])
def test_corners_under_strong_distortion(k1: float) -> None:
    """Where the folded lens never reaches, there is no ray; where it does, the right one."""
    camera = camera_of("simple_radial", (k1,))
    corners = np.array([[0.0, 0], [639, 0], [0, 479], [639, 479]])
    a = (corners - camera.params[2:4]) / camera.params[:2]
    distorted = np.linalg.norm(a, axis=1)
    limit = valid_limit(camera)
    reachable = distorted < (limit * (1 + k1 * limit**2) if np.isfinite(limit) else np.inf)
    rays = unproject(camera, corners)
    assert (np.isfinite(rays).all(1) == reachable).all()
    radius = np.hypot(rays[:, 0], rays[:, 1])[reachable] / rays[reachable, 2]
    assert (radius <= limit).all()
    np.testing.assert_allclose(radius * (1 + k1 * radius**2), distorted[reachable], rtol=1e-9)


def test_the_corner_cases_above_are_both_there() -> None:
    """k1 = -0.5 folds inside the image, 0.4 never folds."""
    assert np.isnan(unproject(camera_of("simple_radial", (-0.5,)), np.array([0.0, 0.0]))).all()
    assert valid_limit(camera_of("simple_radial", (0.4,))) == np.inf


# ---- where there is nothing to see ---------------------------------------------------------


@pytest.mark.parametrize("lens", BROWN)
def test_refuses_what_is_behind_the_camera(lens: LensName) -> None:
    points = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, -2.0], [1.0, 0, 0], [0, 0, 0]])
    assert np.isnan(project(camera_of(lens), points)).all()


def test_a_fisheye_sees_sideways_and_a_little_behind_but_not_its_own_back() -> None:
    camera = camera_of("kannala_brandt", (0.0, 0.0, 0.0, 0.0))
    sideways = project(camera, np.array([2.0, 0.0, 0.0]))
    np.testing.assert_allclose(sideways, [330 + 300 * np.pi / 2, 231])
    assert project(camera, np.array([1.0, 0.0, -0.5]))[0] > sideways[0]
    assert np.isnan(project(camera, np.array([[0.0, 0, -1], [1e-14, 0, -1], [0, 0, 0]]))).all()


@given(st.floats(-12, 12))
def test_a_projection_does_not_know_the_unit_of_length(exponent: float) -> None:
    point = np.array([0.3, -0.2, 0.9])
    for lens in LENS_NAMES:
        pixel = project(camera_of(lens), 10.0**exponent * point)
        np.testing.assert_allclose(pixel, project(camera_of(lens), point), atol=1e-9)


@pytest.mark.parametrize("lens", LENS_NAMES[1:])
def test_refuses_what_lies_beyond_the_fold(lens: LensName) -> None:
    strong: dict[LensName, tuple[float, ...]] = {
        "simple_radial": (-0.3,),
        "radial": (-0.3, 0.01),
        "radtan": (-0.3, 0.01, 0.0, 0.0),
        "kannala_brandt": (-0.2, 0.0, 0.0, 0.0),
    }
    camera = camera_of(lens, strong[lens])
    limit = valid_limit(camera)
    assert np.isfinite(limit)
    steps = limit * np.array([0.97, 0.99, 1.01, 1.5])
    angle = steps if lens == "kannala_brandt" else np.arctan(steps)
    pixels = project(camera, np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)]))
    assert (np.isfinite(pixels).all(1) == [True, True, False, False]).all()
    assert pixels[1, 0] > pixels[0, 0]  # still growing just before it


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_the_limit_is_where_the_radius_stops_growing(lens: LensName) -> None:
    camera = camera_of(lens)
    limit = valid_limit(camera)
    tried = np.linspace(0, min(limit, 3.0) * 0.999, 2000)
    no_tangential = camera_of(lens)
    if lens == "radtan":
        no_tangential.params[6:] = 0
    angle = tried if lens == "kannala_brandt" else np.arctan(tried)
    pixels = project(no_tangential, np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)]))
    assert (np.diff(pixels[:, 0]) > 0).all()


def test_the_limit_by_hand() -> None:
    """1 - 3 * 0.75 r^2 = 0 at r = 2/3; an ideal lens has none, a fisheye half a turn."""
    assert valid_limit(camera_of("simple_radial", (-0.75,))) == pytest.approx(2 / 3)
    assert valid_limit(camera_of("pinhole")) == np.inf
    assert valid_limit(camera_of("kannala_brandt", (0, 0, 0, 0))) == pytest.approx(np.pi)


@given(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3))
def test_vanishing_coefficients_still_have_a_limit(k1: float, k2: float) -> None:
    assert valid_limit(camera_of("radial", (k1, k2))) > 3


# ---- names and sizes -----------------------------------------------------------------------


def test_names_are_those_of_opencv_in_its_order() -> None:
    assert PARAMETER_NAMES["radtan"] == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    assert PARAMETER_NAMES["kannala_brandt"] == ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
    assert camera_of("radtan").named()["p2"] == -0.007


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_a_nominal_lens_is_centred_and_square(lens: LensName) -> None:
    camera = Camera("cam", lens, SIZE, nominal_params(lens, SIZE, 500.0))
    np.testing.assert_allclose(project(camera, np.array([0.0, 0, 2])), [319.5, 239.5])
    np.testing.assert_array_equal(camera.centre, [319.5, 239.5])
    small = np.array([1e-6, 1e-6, 1.0])
    np.testing.assert_allclose(project(camera, small) - camera.centre, [5e-4, 5e-4], rtol=1e-6)


def test_a_wrong_number_of_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match=r"cam: lens radial takes 6 parameters \(fx fy cx cy k1"):
        Camera("cam", "radial", SIZE, np.ones(5))


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_gtsam_holds_every_parameter_under_its_own_name(lens: LensName) -> None:
    """fx() ... k4() of the native class, so that no two slots can be swapped."""
    camera = camera_of(lens)
    native = native_lens(camera)
    accessors = {"fx": "fx", "fy": "fy", "cx": "px", "cy": "py", "k1": "k1", "k2": "k2"}
    if lens == "kannala_brandt":
        assert isinstance(native, gtsam.Cal3Fisheye)
        accessors |= {"k3": "k3", "k4": "k4"}
    for name, accessor in accessors.items():
        assert getattr(native, accessor)() == camera.named().get(name, 0.0)
    assert native.skew() == 0

"""A camera: there and back, another lens for it, a start when nothing is known."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from synthetic.cameras import SIZE, camera_of, points_ahead, rays_at, wide

from graphs.camera import (
    Camera,
    carries_over,
    fit_lens,
    lens_arrays,
    nominal_params,
    project,
    project_jacobian,
    unproject,
    valid_limit,
)
from graphs.frames import FloatArray
from graphs.lenses import (
    LENS_NAMES,
    LENSES,
    PARAMETER_NAMES,
    LensName,
    project_many,
    project_point_many,
)
from graphs.priors import DISTORTION_SIGMA, SQUARE_SIGMA, weak_lens_prior
from sfm_calib.colmap import colmap_camera
from sfm_calib.colmap_lenses import EXACT_MODEL

NOT_PINHOLE = LENS_NAMES[1:]
# Up to strong ones; radial terms of the others are numerators and denominators of N / D.
MOST = {"k1": 0.4, "k2": 0.15, "k3": 0.05, "k4": 0.3, "k5": 0.1, "k6": 0.03}
MOST |= {"p1": 0.003, "p2": 0.003, "s1": 0.003, "s2": 0.003, "s3": 0.003, "s4": 0.003}
MOST_FISHEYE = {"k1": 0.15, "k2": 0.05, "k3": 0.02, "k4": 0.004}
BETWEEN = {"alpha": (0.1, 0.9), "beta": (0.5, 1.8), "xi": (-0.7, 0.7)}


@st.composite
def lenses_and_rays(draw: st.DrawFn) -> tuple[Camera, FloatArray]:
    """Any lens with coefficients up to strong ones, and a ray anywhere in its valid region."""
    lens = draw(st.sampled_from(LENS_NAMES))
    most = MOST_FISHEYE if lens == "kannala_brandt" else MOST
    coefficients = []
    for name in LENSES[lens].coefficients:
        low, high = BETWEEN.get(name) or (-most[name], most[name])
        coefficients.append(draw(st.floats(low, high)))
    if lens == "division" and -1e-3 < coefficients[0] < 0:
        coefficients = [0.0]  # what lies behind such a lens is in the image at infinity
    camera = camera_of(lens, tuple(coefficients))
    reach = draw(st.floats(0, 0.9995)) * min(valid_limit(camera), 1.9 if wide(lens) else 1.6)
    angle = reach if wide(lens) else np.arctan(reach)
    return camera, rays_at(np.array([angle]), draw(st.floats(0, 2 * np.pi)))[0]


# ---- there and back ------------------------------------------------------------------------


@given(lenses_and_rays(), st.floats(1e-3, 1e3))
@settings(deadline=None, max_examples=300)
def test_unproject_undoes_project(case: tuple[Camera, FloatArray], depth: float) -> None:
    camera, ray = case
    pixel = project(camera, depth * ray)
    if {"p1", "s1"} & set(camera.names):  # may fold a little before the radial terms do
        assume(np.isfinite(pixel).all())
    assert np.isfinite(pixel).all()
    # 1e-6 px are 1e-5 rad where the pixel hardly moves any more
    np.testing.assert_allclose(unproject(camera, pixel), ray, atol=2e-5)


@pytest.mark.parametrize(
    ("lens", "coefficients"),
    [
        ("pinhole", ()),
        ("simple_radial", (-0.3,)),
        ("rational", (0, 0, 0, 0, 0, -0.5, 0, 0)),
        ("division", (0.0,)),
        ("division", (0.25,)),
        ("eucm", (0.3, 1.0)),
        ("double_sphere", (-0.3, 0.7)),
    ],
)
def test_rays_are_found_up_to_the_edge(lens: LensName, coefficients: tuple[float, ...]) -> None:
    """Where the pixel hardly moves, or runs to infinity, plain Newton steps out of the region."""
    camera = camera_of(lens, coefficients)
    reach = np.array([0.9, 0.99, 0.999]) * min(valid_limit(camera), 1000.0)
    rays = rays_at(reach if wide(lens) else np.arctan(reach), 1.0)
    np.testing.assert_allclose(unproject(camera, project(camera, rays)), rays, atol=1e-7)


def pixel_grid() -> FloatArray:
    return np.stack(np.meshgrid(np.linspace(0, 639, 33), np.linspace(0, 479, 25)), axis=-1)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_every_pixel_of_a_real_lens_has_a_ray(lens: LensName) -> None:
    camera, grid = camera_of(lens), pixel_grid()
    rays = unproject(camera, grid)
    assert rays.shape == (25, 33, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1)
    np.testing.assert_allclose(project(camera, 7 * rays), grid, atol=1e-9)


@pytest.mark.parametrize("lens", EXACT_MODEL)
def test_unprojects_as_colmap_does(lens: LensName) -> None:
    camera, grid = camera_of(lens), pixel_grid().reshape(-1, 2)
    theirs = colmap_camera(camera, EXACT_MODEL[lens]).cam_from_img(grid + 0.5)
    ours = unproject(camera, grid)
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], theirs, atol=1e-8)


@pytest.mark.parametrize("lens", ["radtan", "brown", "rational", "thin_prism"])
def test_unprojects_as_opencv_does(lens: LensName) -> None:
    camera, grid = camera_of(lens), pixel_grid().reshape(-1, 2)
    fx, fy, cx, cy = camera.params[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    patient = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-12)
    theirs = cv2.undistortPoints(
        grid[:, None], matrix, camera.params[4:], None, None, None, criteria=patient
    )
    ours = unproject(camera, grid)
    np.testing.assert_allclose(ours[:, :2] / ours[:, 2:], theirs[:, 0], atol=1e-8)


@pytest.mark.parametrize("lens", ["eucm", "double_sphere"])
def test_unprojects_as_the_papers_closed_forms_say(lens: LensName) -> None:
    """Khomutenko et al., equation 14; Usenko et al., equations 46 to 48."""
    camera, grid = camera_of(lens), pixel_grid().reshape(-1, 2)
    m = (grid - camera.params[2:4]) / camera.params[:2]
    r2 = (m**2).sum(1)
    if lens == "eucm":
        alpha, beta = camera.params[4:]
        root = np.sqrt(1 - (2 * alpha - 1) * beta * r2)
        rays = np.column_stack([m, (1 - beta * alpha**2 * r2) / (alpha * root + 1 - alpha)])
    else:
        xi, alpha = camera.params[4:]
        z = (1 - alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
        scale = (z * xi + np.sqrt(z**2 + (1 - xi**2) * r2)) / (z**2 + r2)
        rays = scale[:, None] * np.column_stack([m, z]) - [0, 0, xi]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(unproject(camera, grid), rays, atol=1e-10)


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


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_what_is_no_pixel_has_no_ray_and_the_rest_keep_theirs(lens: LensName) -> None:
    camera = camera_of(lens)
    pixels = np.array([[np.nan, 100.0], [100.0, np.nan], [320.0, 240.0], camera.params[2:4]])
    rays = unproject(camera, pixels)
    assert (np.isfinite(rays).all(1) == [False, False, True, True]).all()
    np.testing.assert_allclose(rays[3], [0, 0, 1], atol=1e-12)
    assert np.isnan(unproject(camera, np.array([[np.inf, 0.0]]))).all()


@pytest.mark.parametrize("shape", [(), (0,), (4,), (2, 3)])
def test_shapes_go_through(shape: tuple[int, ...]) -> None:
    camera = camera_of("brown")
    points = np.broadcast_to([0.1, 0.2, 1.0], (*shape, 3))
    pixels, by_point, by_params = project_jacobian(camera, points)
    assert pixels.shape == (*shape, 2) == project(camera, points).shape
    assert by_point.shape == (*shape, 2, 3) and by_params.shape == (*shape, 2, 9)
    assert unproject(camera, pixels).shape == points.shape


def test_no_layout_of_points_is_compiled_anew() -> None:
    """A read-only or strided array is another type to numba, and seconds of compiling."""
    points = points_ahead()
    project_jacobian(camera_of("brown"), points)
    unproject(camera_of("brown"), pixel_grid())
    compiled = len(project_many.signatures), len(project_point_many.signatures)
    fixed = points.copy()
    fixed.flags.writeable = False
    for layout in (fixed, points[::2], np.asfortranarray(points), points.astype(np.float32)):
        project_jacobian(camera_of("brown"), layout)
        project(camera_of("brown"), layout)
    assert (len(project_many.signatures), len(project_point_many.signatures)) == compiled


def test_another_process_finds_the_kernels_compiled() -> None:
    """Compiling takes seconds: the chain of blocks must not keep numba from caching on disk."""
    program = (
        "import numpy as np\n"
        "from graphs.camera import Camera, nominal_params, project_jacobian, project\n"
        "from graphs.lenses import project_many, project_point_many\n"
        "camera = Camera('a', 'brown', (9, 9), nominal_params('brown', (9, 9), 5.0))\n"
        "project_jacobian(camera, np.ones((1, 3)))\n"
        "for kernel in (project_many, project_point_many):\n"
        "    hits = kernel.stats.cache_hits\n"
        "    assert list(hits.values()) == [1], (kernel, kernel.stats)\n"
    )
    project_jacobian(camera_of("brown"), np.ones((1, 3)))
    root = Path(__file__).resolve().parent.parent
    subprocess.run([sys.executable, "-c", program], cwd=root, check=True)


# ---- another lens --------------------------------------------------------------------------


def worst_px(camera: Camera, other: Camera) -> float:
    """The farthest apart that the two put any ray of the first one's image."""
    grid = pixel_grid()
    return float(np.linalg.norm(project(other, unproject(camera, grid)) - grid, axis=-1).max())


NESTED: list[tuple[LensName, LensName]] = [
    ("pinhole", "division"), ("simple_radial", "radial"), ("radial", "radtan"),
    ("radtan", "brown"), ("brown", "rational"), ("rational", "thin_prism"), ("division", "eucm"),
]  # fmt: skip


@pytest.mark.parametrize(("lens", "larger"), NESTED)
def test_a_lens_that_contains_the_other_fits_exactly(lens: LensName, larger: LensName) -> None:
    """division in eucm: (a, b, 1 + k r^2) is the paraboloid alpha = 1/2 with beta = -4 k."""
    camera = camera_of(lens)
    fitted, error_px = fit_lens(camera, larger)
    assert (fitted.name, fitted.size, fitted.lens) == (camera.name, camera.size, larger)
    assert error_px < 1e-6
    assert worst_px(camera, fitted) < 1e-5
    if larger == "eucm":
        np.testing.assert_allclose(fitted.named()["alpha"], 0.5, atol=1e-6)
        np.testing.assert_allclose(fitted.named()["beta"], -4 * camera.params[4], atol=1e-5)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_a_lens_fits_itself_from_its_own_numbers(lens: LensName) -> None:
    camera = camera_of(lens)
    fitted, error_px = fit_lens(camera, lens)
    assert error_px < 1e-9
    np.testing.assert_allclose(fitted.params, camera.params, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("lens", ["eucm", "double_sphere"])
@pytest.mark.parametrize("other", ["kannala_brandt", "eucm", "double_sphere"])
def test_fisheyes_fit_each_other_to_a_fraction_of_a_pixel(lens: LensName, other: LensName) -> None:
    camera = camera_of(other)
    fitted, error_px = fit_lens(camera, lens)
    assert error_px < 0.2
    grid = pixel_grid()
    apart = np.linalg.norm(project(fitted, unproject(camera, grid)) - grid, axis=-1)
    assert np.sqrt((apart**2).mean()) == pytest.approx(error_px, rel=0.2)


def test_coefficients_that_are_not_free_stay_nominal() -> None:
    camera = camera_of("eucm")
    fitted, error_px = fit_lens(camera, "kannala_brandt", free=("k1", "k2"))
    every, smaller_px = fit_lens(camera, "kannala_brandt")
    assert (fitted.params[6:] == 0).all() and (fitted.params[4:6] != 0).all()
    assert smaller_px < error_px < 1.0
    assert (every.params[4:] != 0).all()
    shorter, _ = fit_lens(camera_of("kannala_brandt"), "kannala_brandt", free=("k1", "k2"))
    assert (shorter.params[6:] == 0).all()


def test_rays_that_the_new_lens_cannot_see_are_an_error() -> None:
    """A fisheye past 90 degrees is no pinhole; every ray counts."""
    camera = camera_of("kannala_brandt", (0.0, 0.0, 0.0, 0.0))
    camera = replace(camera, params=np.array([150.0, 150, 319.5, 239.5, 0, 0, 0, 0]))
    assert fit_lens(camera, "pinhole")[1] > 100
    blind = camera_of("double_sphere", (-1.5, 0.6))
    assert fit_lens(blind, "eucm")[1] == np.inf


def test_another_lens_is_never_worse_than_a_pinhole() -> None:
    """From this fisheye a fit of k1 with all the rest ends at a fold, four times farther off."""
    camera = camera_of("kannala_brandt", (-0.01, 0.01, 1e-3, 1e-4))
    camera = replace(camera, params=np.array([300.0, 302, 318, 242, *camera.params[4:]]))
    pinhole_px = fit_lens(camera, "pinhole")[1]
    assert fit_lens(camera, "simple_radial")[1] < 0.9 * pinhole_px
    assert fit_lens(camera, "rational")[1] < 0.01  # and this one, a coefficient at a time, at 2.6


def test_whose_coefficients_mean_the_same() -> None:
    assert carries_over("radial", "thin_prism") and carries_over("rational", "simple_radial")
    assert carries_over("eucm", "eucm")
    assert not carries_over("kannala_brandt", "radial") and not carries_over("radial", "division")
    assert not carries_over("kannala_brandt", "division")


# ---- names, sizes, starts ------------------------------------------------------------------


def test_parameters_by_name() -> None:
    assert camera_of("radtan").named()["p2"] == -0.007
    assert camera_of("brown").named()["k3"] == -0.021
    assert camera_of("double_sphere").names[4:] == ("xi", "alpha")


def test_a_wrong_number_of_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match=r"cam: lens radial takes 6 parameters \(fx fy cx cy k1"):
        Camera("cam", "radial", SIZE, np.ones(5))


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_a_nominal_lens_is_centred_and_square(lens: LensName) -> None:
    camera = Camera("cam", lens, SIZE, nominal_params(lens, SIZE, 500.0))
    np.testing.assert_allclose(project(camera, np.array([0.0, 0, 2])), [319.5, 239.5])
    np.testing.assert_array_equal(camera.centre, [319.5, 239.5])
    small = np.array([1e-6, 1e-6, 1.0])
    np.testing.assert_allclose(project(camera, small) - camera.centre, [5e-4, 5e-4], rtol=1e-6)


@pytest.mark.parametrize("lens", NOT_PINHOLE)
def test_from_a_nominal_lens_every_parameter_can_be_found(lens: LensName) -> None:
    """No derivative vanishes there, nor is any the others' sum; N / D alone has k1 - k4 at first
    order, which the belief in small ones holds."""
    camera = Camera("cam", lens, SIZE, nominal_params(lens, SIZE, 300.0))
    jacobian = project_jacobian(camera, points_ahead(400))[2].reshape(-1, camera.params.size)
    if lens in ("rational", "thin_prism"):
        jacobian = np.delete(jacobian, [camera.names.index(k) for k in ("k4", "k5", "k6")], axis=1)
    singular = np.linalg.svd(jacobian / np.linalg.norm(jacobian, axis=0), compute_uv=False)
    assert singular[-1] > 3e-4 * singular[0]


def test_a_double_sphere_without_xi_could_not_find_it() -> None:
    """Why the nominal xi is not zero."""
    camera = camera_of("double_sphere", (0.0, 0.6))
    jacobian = project_jacobian(camera, points_ahead(400))[2].reshape(-1, 6)
    singular = np.linalg.svd(jacobian / np.linalg.norm(jacobian, axis=0), compute_uv=False)
    assert singular[-1] < 1e-12 * singular[0]


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_the_weak_prior_knows_every_coefficient(lens: LensName) -> None:
    camera = camera_of(lens)
    prior = weak_lens_prior(camera)
    assert set(camera.names[4:]) <= set(DISTORTION_SIGMA)
    np.testing.assert_allclose(prior.mean[:2], camera.params[:2].mean())
    np.testing.assert_array_equal(prior.mean[4:], LENSES[lens].nominal)
    np.linalg.cholesky(prior.information())


@pytest.mark.parametrize("aspect_sigma", [SQUARE_SIGMA, 1e-12, 1e-300])
def test_square_pixels_leave_the_focal_length_free(aspect_sigma: float) -> None:
    prior = weak_lens_prior(camera_of("radtan"), aspect_sigma=aspect_sigma)
    root = np.linalg.inv(np.linalg.cholesky(prior.information()))
    cov = root.T @ root
    focal = prior.mean[0]
    assert np.sqrt(cov[0, 0]) == pytest.approx(focal / np.sqrt(2), rel=0.02)
    difference = cov[0, 0] + cov[1, 1] - 2 * cov[0, 1]
    assert np.sqrt(difference) == pytest.approx(SQUARE_SIGMA * focal, rel=0.1)


def test_a_free_aspect_ratio_ties_nothing() -> None:
    information = weak_lens_prior(camera_of("radtan"), aspect_sigma=np.inf).information()
    assert information[0, 1] == 0


def test_cameras_of_several_lenses_become_padded_arrays() -> None:
    cameras = [camera_of("pinhole"), camera_of("brown"), camera_of("simple_radial", (-0.3,))]
    models, params, limits = lens_arrays(cameras)
    assert models.dtype == np.int64 and params.shape == (3, 9)
    assert [LENS_NAMES[model] for model in models] == ["pinhole", "brown", "simple_radial"]
    for row, camera in zip(params, cameras, strict=True):
        np.testing.assert_array_equal(row, [*camera.params, *[0] * (9 - camera.params.size)])
    np.testing.assert_allclose(limits, [valid_limit(camera) for camera in cameras])
    assert PARAMETER_NAMES["brown"] == cameras[1].names

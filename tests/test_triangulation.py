"""Points in space: found as least squares finds them, spread as drawn calibrations spread them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from synthetic.calibrated import (
    assert_drawn_from,
    assert_same,
    covariance_of,
    draws,
    moved,
    numeric,
    pixels_of,
    points_of_rig,
    rig,
    shuffled,
)
from synthetic.cameras import SIZE

from graphs import triangulation
from graphs.camera import Camera
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from graphs.problem import Estimate
from graphs.propagation import transformed
from graphs.triangulation import MIN_DEPTH_SIGMAS, triangulate, triangulated_covariance

SIGMA_PX = 0.4
EXACT = Covariance(("other.fx",), np.eye(1))  # of none of the cameras

PAIRS = [(0, 1), (2, 1), (0, 1, 2)]


@pytest.mark.parametrize("cameras", PAIRS)
def test_triangulation_finds_the_points(cameras: tuple[int, ...]) -> None:
    estimate, points = rig(), points_of_rig()
    pixels = pixels_of(estimate, cameras, points)
    found = triangulate(estimate, cameras, pixels, SIGMA_PX)
    np.testing.assert_allclose(found, points, atol=1e-9)
    shaped = triangulate(estimate, cameras, pixels.reshape(3, 4, -1, 2), SIGMA_PX)
    np.testing.assert_array_equal(shaped, found.reshape(3, 4, 3))
    alone = triangulate(estimate, cameras, pixels[5], SIGMA_PX)
    np.testing.assert_allclose(alone, points[5], atol=1e-9)
    assert triangulate(estimate, cameras, pixels[:0], SIGMA_PX).shape == (0, 3)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_triangulation_is_the_weighted_least_squares(seed: int) -> None:
    """Against scipy, with noise of several pixels and each camera's own sigma."""
    rng = np.random.default_rng(seed)
    estimate, point = rig(), rng.uniform([-0.6, -0.5, 2.0], [0.6, 0.5, 5.0])
    sigma = rng.uniform(0.2, 3.0, 3)
    pixels = pixels_of(estimate, (0, 1, 2), point) + sigma[:, None] * rng.standard_normal((3, 2))

    def residuals(x: FloatArray) -> FloatArray:
        return ((pixels_of(estimate, (0, 1, 2), x) - pixels) / sigma[:, None]).ravel()

    expected = least_squares(residuals, point, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    ours = triangulate(estimate, (0, 1, 2), pixels, sigma)
    np.testing.assert_allclose(ours, expected, atol=1e-6)
    order = np.array([2, 0, 1])
    again = triangulate(estimate, order.tolist(), pixels[order], sigma[order])
    np.testing.assert_allclose(again, ours, atol=1e-9)


@pytest.mark.parametrize("cameras", PAIRS)
def test_triangulated_covariance_by_finite_differences(cameras: tuple[int, ...]) -> None:
    estimate, points = rig(), points_of_rig()
    covariance = covariance_of(estimate)
    pixels = pixels_of(estimate, cameras, points)
    sigma = np.array([0.3, 0.5, 0.9])[: len(cameras)]
    ours = triangulated_covariance(estimate, covariance, cameras, pixels, sigma)
    np.testing.assert_allclose(ours.points, points, atol=1e-9)
    np.testing.assert_allclose(ours.residuals_px, 0, atol=1e-9)

    def points_and_depth(changed: Estimate) -> FloatArray:
        found = triangulate(changed, cameras, pixels, sigma)
        centre = changed.cam_from_rig[cameras[0]].inverse.translation
        return np.column_stack([found, np.linalg.norm(found - centre, axis=1)])

    expected = numeric(covariance, estimate, points_and_depth)
    assert_same(ours.cov_calibration, expected[:, :3, :3], 1e-4)
    np.testing.assert_allclose(ours.sigma_depth_calibration**2, expected[:, 3, 3], rtol=1e-4)
    np.testing.assert_allclose(ours.depth, points_and_depth(estimate)[:, 3])
    from_noise = 0.0
    for place in np.ndindex(len(cameras), 2):
        change = np.zeros((len(cameras), 2))
        change[place] = 1e-3
        after, before = (
            triangulate(estimate, cameras, pixels + sign * change, sigma) for sign in (1, -1)
        )
        slope = (after - before) / 2e-3
        from_noise += sigma[place[0]] ** 2 * slope[:, :, None] * slope[:, None, :]
    assert_same(ours.cov_noise, from_noise, 1e-4)


def test_triangulated_covariance_adds_up_and_goes_by_name() -> None:
    estimate, points = rig(), points_of_rig()
    covariance = covariance_of(estimate)
    pixels = pixels_of(estimate, (1, 2), points)
    ours = triangulated_covariance(estimate, covariance, (1, 2), pixels, SIGMA_PX)
    for cov in (ours.cov_noise, ours.cov_calibration, ours.cov):
        assert (np.linalg.eigvalsh(cov)[:, 0] > -1e-12 * np.trace(cov, axis1=1, axis2=2)).all()
    np.testing.assert_array_equal(ours.cov, ours.cov_noise + ours.cov_calibration)
    np.testing.assert_allclose(
        ours.sigma_depth**2, ours.sigma_depth_noise**2 + ours.sigma_depth_calibration**2
    )
    again = triangulated_covariance(estimate, shuffled(covariance), (1, 2), pixels, SIGMA_PX)
    np.testing.assert_allclose(again.cov, ours.cov, rtol=1e-9)
    joint = transformed(covariance, ["x", "y", "z"], ours.by_calibration[3], ours.names)
    np.testing.assert_allclose(joint.matrix, ours.cov_calibration[3])
    alone = triangulated_covariance(estimate, covariance, (1, 2), pixels[3], SIGMA_PX)
    np.testing.assert_allclose(alone.cov, ours.cov[3], rtol=1e-6)
    assert alone.depth == pytest.approx(ours.depth[3]) and np.ndim(alone.sigma_depth) == 0
    exact = triangulated_covariance(estimate, EXACT, (1, 2), pixels, SIGMA_PX)
    assert (exact.cov_calibration == 0).all() and (exact.sigma_depth_calibration == 0).all()


def stereo(lens: LensName) -> Estimate:
    """Side by side, 0.2 apart, f = 500 px."""
    params = np.append([500.0, 500, 319.5, 239.5], [0] * (4 if lens == "kannala_brandt" else 0))
    cameras = tuple(Camera(name, lens, SIZE, params) for name in ("left", "right"))
    right_from_left = Transform(np.eye(3), np.array([-0.2, 0, 0]))
    return Estimate(cameras, (Transform.identity(), right_from_left), (), np.empty((0, 3)))


def test_depth_of_a_stereo_pair_by_hand() -> None:
    """Of z = f b / d: sigma_z = z^2 / (f b) sqrt(2) sigma_px, and z / b sigma_b."""
    estimate, baseline, z = stereo("pinhole"), 0.2, 4.0
    covariance = Covariance(("right.translation_x",), np.array([[0.002**2]]))
    pixels = pixels_of(estimate, (0, 1), np.array([0.0, 0.0, z]))
    found = triangulated_covariance(estimate, covariance, (0, 1), pixels, SIGMA_PX)
    by_hand = z**2 / (500 * baseline) * np.sqrt(2) * SIGMA_PX
    assert found.sigma_depth_noise == pytest.approx(by_hand)
    assert found.sigma_depth_calibration == pytest.approx(z * 0.002 / baseline)
    # cx shared by both cameras, as one lens: no parallax, the point only moves sideways
    names = ("left.cx", "right.cx")
    shared = Covariance(names, np.ones((2, 2)))
    moves = triangulated_covariance(estimate, shared, (0, 1), pixels, SIGMA_PX)
    assert moves.sigma_depth_calibration == pytest.approx(0, abs=1e-7)
    assert moves.cov_calibration[0, 0] == pytest.approx((z / 500) ** 2)
    apart = triangulated_covariance(
        estimate, Covariance(names, np.eye(2)), (0, 1), pixels, SIGMA_PX
    )
    assert apart.sigma_depth_calibration == pytest.approx(by_hand / SIGMA_PX)


@pytest.mark.slow
def test_triangulated_covariance_by_drawing_calibrations_and_noise() -> None:
    estimate, point = rig(), np.array([0.3, -0.2, 3.0])
    covariance = covariance_of(estimate, 0.3)
    exact = pixels_of(estimate, (0, 1), point)
    found = triangulated_covariance(estimate, covariance, (0, 1), exact, SIGMA_PX)
    changes = draws(covariance, 250)
    noise = SIGMA_PX * np.random.default_rng(6).standard_normal((len(changes), 2, 2))
    sample = [
        triangulate(moved(estimate, covariance.names, change), (0, 1), exact + one, SIGMA_PX)
        for change, one in zip(changes, noise, strict=True)
    ]
    assert_drawn_from(np.array(sample), found.cov)
    apart = Covariance(covariance.names, np.diag(np.diag(covariance.matrix)))
    wrong = triangulated_covariance(estimate, apart, (0, 1), exact, SIGMA_PX)
    for cov in (found.cov_noise, found.cov_calibration, wrong.cov):
        with pytest.raises(AssertionError):
            assert_drawn_from(np.array(sample), cov)


def stereo_towards(point: FloatArray) -> tuple[Estimate, Covariance, FloatArray]:
    estimate = rig()
    return estimate, covariance_of(estimate, 1e-6), pixels_of(estimate, (0, 1), point)


def test_parallel_rays_are_refused() -> None:
    """At infinity exactly, and as far as the noise can tell; one bad point is named."""
    estimate, covariance, far = stereo_towards(np.array([1e9, 2e8, 1e10]))
    message = "the rays of cam0, cam1 do not meet, or are parallel .* farther apart, or leave it"
    with pytest.raises(ValueError, match=f"^{message}"):
        triangulated_covariance(estimate, covariance, (0, 1), far, SIGMA_PX)
    near = pixels_of(estimate, (0, 1), np.array([0.1, 0.1, 3.0]))
    with pytest.raises(ValueError, match=f"^point 1: {message}"):
        triangulated_covariance(estimate, covariance, (0, 1), np.stack([near, far]), SIGMA_PX)
    direction = np.array([0.1, 0.05, 1.0])
    # sigma_depth grows with the square of the depth: this one is as many sigmas as is refused
    pixels = pixels_of(estimate, (0, 1), 3 * direction)
    at_3 = triangulated_covariance(estimate, covariance, (0, 1), pixels, SIGMA_PX)
    limit = 3 * at_3.depth / at_3.sigma_depth / MIN_DEPTH_SIGMAS
    seen = pixels_of(estimate, (0, 1), 0.8 * limit * direction)
    triangulated_covariance(estimate, covariance, (0, 1), seen, SIGMA_PX)
    beyond = pixels_of(estimate, (0, 1), 1.3 * limit * direction)
    with pytest.raises(ValueError, match=message):
        triangulated_covariance(estimate, covariance, (0, 1), beyond, SIGMA_PX)


@pytest.mark.parametrize("lens", ["pinhole", "kannala_brandt"])
@pytest.mark.parametrize("disparity_px", [0.0, -20.0])
def test_rays_of_a_stereo_pair_that_do_not_meet(lens: LensName, disparity_px: float) -> None:
    """On the axis, where the normal equations are singular exactly; a fisheye sees behind too."""
    pixels = np.array([[319.5, 239.5], [319.5 - disparity_px, 239.5]])
    with pytest.raises(ValueError, match="the rays of left, right do not meet"):
        triangulate(stereo(lens), (0, 1), pixels, SIGMA_PX)


def test_without_noise_rounding_is_the_limit() -> None:
    """5e8 baselines away: what is found is 50 times too near, with any sigma."""
    estimate = stereo("pinhole")
    near, far = (pixels_of(estimate, (0, 1), np.array([0.0, 0.1 * z, z])) for z in (1e4, 1e8))
    found = triangulated_covariance(estimate, EXACT, (0, 1), near, 1e-12)
    assert found.points[2] == pytest.approx(1e4, rel=1e-6)
    with pytest.raises(ValueError, match="do not meet, or are parallel"):
        triangulated_covariance(estimate, EXACT, (0, 1), far, 1e-12)


def test_rays_that_part_are_refused() -> None:
    estimate, _, pixels = stereo_towards(np.array([0.1, 0.1, 30.0]))
    pixels[1, 0] += 40  # to the far side of infinity
    with pytest.raises(ValueError, match="the rays of cam0, cam1 do not meet"):
        triangulate(estimate, (0, 1), pixels, SIGMA_PX)


def test_what_cannot_be_triangulated_is_refused() -> None:
    estimate, covariance, pixels = stereo_towards(np.array([0.1, 0.1, 3.0]))
    for cameras, seen in (((0,), pixels[:1]), ((0, 0), pixels)):
        with pytest.raises(ValueError, match="two or more cameras, each once"):
            triangulated_covariance(estimate, covariance, cameras, seen, SIGMA_PX)
    with pytest.raises(ValueError, match=r"3 cameras need pixels \(\.\.\., 3, 2\)"):
        triangulate(estimate, (0, 1, 2), np.zeros((6, 2)), SIGMA_PX)
    with pytest.raises(ValueError, match="sigma_px must be positive"):
        triangulate(estimate, (0, 1), pixels, 0.0)
    pixels[1] = np.nan
    with pytest.raises(ValueError, match=r"cam1: its lens sees nothing at pixel \(nan, nan\)"):
        triangulate(estimate, (0, 1), pixels, SIGMA_PX)


def test_noisy_points_take_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounding of a cost that is not zero once kept every large batch going for all steps."""
    estimate, rng = rig(), np.random.default_rng(0)
    points = rng.uniform([-0.6, -0.5, 2.0], [0.6, 0.5, 5.0], (2000, 3))
    pixels = pixels_of(estimate, (0, 1), points)
    steps = 0
    whole = triangulation._normal_equations

    def counted(*given: Any) -> Any:
        nonlocal steps
        steps += 1
        return whole(*given)

    monkeypatch.setattr(triangulation, "_normal_equations", counted)
    triangulate(estimate, (0, 1), pixels + SIGMA_PX * rng.standard_normal(pixels.shape), SIGMA_PX)
    assert steps <= 10

"""What lenses of all models have in common: against formulas by hand, and between models."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.cameras import camera_of, wide

from graphs.camera import Camera, fit_lens, project_jacobian
from graphs.compare import Stated
from graphs.compare_rig import as_lens
from graphs.covariance import Covariance
from graphs.frames import Transform
from graphs.lens_shape import SHAPE_NAMES, lens_shape
from graphs.lenses import LENSES, LensName
from graphs.problem import Estimate
from graphs.propagation import lens_names


def test_a_pinhole_moves_no_corner() -> None:
    camera = Camera("c", "pinhole", (640, 480), np.array([500.0, 510.0, 330.0, 231.0]))
    values, by_params = lens_shape(camera, wide=False)
    np.testing.assert_allclose(values, [505, 500, 510, 330, 231, 0, 0, 0], atol=1e-9)
    expected = np.zeros((len(SHAPE_NAMES), 4))
    expected[0, :2], expected[1:5] = 0.5, np.eye(4)
    np.testing.assert_allclose(by_params, expected, atol=1e-6)


def test_radial_and_tangential_terms_by_hand() -> None:
    """To first order k1 r^3 f outwards, p2 (r^2 + 2 x^2) f to the right, p1 (...) f down."""
    k1, p1, p2, f = 1e-5, 2e-6, -3e-6, 500.0
    camera = Camera("c", "radtan", (601, 401), np.array([f, f, 310.0, 190.0, k1, 0.0, p1, p2]))
    x, y = 300 / f, 200 / f
    r = np.hypot(x, y)
    corner = lens_shape(camera, wide=False)[0][5:]
    expected = [k1 * r**3 * f, p2 * (r**2 + 2 * x**2) * f, p1 * (r**2 + 2 * y**2) * f]
    np.testing.assert_allclose(corner, expected, rtol=1e-4)


def test_an_equidistant_lens_moves_no_corner_of_a_wide_image() -> None:
    camera = Camera("c", "kannala_brandt", (640, 480), np.array([200.0, 200, 320, 240, 0, 0, 0, 0]))
    np.testing.assert_allclose(lens_shape(camera, wide=True)[0][5:], 0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_derivatives_are_those_of_the_corner_that_moves(lens: LensName) -> None:
    """A change of coefficients moves a corner as the lens projects its ray, to first order."""
    camera = camera_of(lens)
    values, by_params = lens_shape(camera, wide(lens))
    rng = np.random.default_rng(0)
    change = rng.normal(0, 1e-4, camera.params.size)
    change[:4] *= 100
    ends = [
        lens_shape(replace(camera, params=camera.params + s * change), wide(lens))[0]
        for s in (1, -1)
    ]
    np.testing.assert_allclose((ends[0] - ends[1]) / 2, by_params @ change, rtol=1e-3, atol=1e-6)
    axis = np.array([[0.0, 0.0, 1.0]])
    on_axis = project_jacobian(camera, axis)[1][0]
    np.testing.assert_allclose(values[1:3], np.diag(on_axis[:, :2]))
    np.testing.assert_allclose(by_params[3:5, 2:4], np.eye(2), atol=1e-9)


def test_another_model_of_the_same_lens_has_the_same_shape_and_sigmas() -> None:
    radtan = Camera(
        "c", "radtan", (640, 480), np.array([520.0, 521, 330, 231, -0.2, 0.05, 1e-3, -5e-4])
    )
    names = lens_names(radtan)
    sigma = np.array([1.0, 1, 2, 2, 2e-3, 3e-3, 1e-4, 1e-4])
    side = Stated(
        Estimate((radtan,), (Transform.identity(),), (), np.zeros((0, 3))),
        Covariance(names, np.diag(sigma**2)),
    )
    other, error_px = as_lens(side, 0, "rational")
    shapes = []
    for one in (side, other):
        values, by_params = lens_shape(one.estimate.cameras[0], wide=False)
        own = one.covariance.matrix
        shapes.append((values, np.sqrt(np.diag(by_params @ own @ by_params.T))))
    assert error_px == 0
    np.testing.assert_allclose(shapes[0][0], shapes[1][0], rtol=1e-9)
    np.testing.assert_allclose(shapes[0][1], shapes[1][1], rtol=1e-6)
    fisheye, error_px = fit_lens(radtan, "kannala_brandt")
    values = lens_shape(fisheye, wide=False)[0]
    np.testing.assert_allclose(values[5:], shapes[0][0][5:], atol=20 * error_px + 0.5)


def test_a_lens_that_sees_no_corner_has_no_effect_there() -> None:
    camera = Camera("c", "simple_radial", (640, 480), np.array([300.0, 300, 320, 240, -0.5]))
    values, _ = lens_shape(camera, wide=False)
    assert np.isnan(values[5:]).all() and np.isfinite(values[:5]).all()

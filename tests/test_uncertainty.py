"""Pixels and depths of a covariance: by hand, by drawing calibrations, and as the file says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.calibrated import covariance_of, moved, pixels_of, rig
from synthetic.cameras import SIZE

from graphs.camera import Camera, project, unproject
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.problem import Estimate
from graphs.propagation import lens_names
from graphs.triangulation import triangulate, triangulated_covariance
from graphs.uncertainty import (
    FIT_RADIUS,
    SHAPE,
    Fit,
    ProjectionMap,
    RelativeTo,
    curve_ranges,
    depth_sigma,
    middle_of_view,
    pairs,
    projection_maps,
)
from sfm_calib import result
from sfm_calib.uncertainty import RANGES, uncertainty_of, unit_of

SIGMA_PX = 0.4
FOCAL_PX, BASELINE = 500.0, 0.2


def camera(name: str, *distortion: float) -> Camera:
    params = np.array([FOCAL_PX, FOCAL_PX, 319.5, 239.5, *distortion])
    return Camera(name, "radtan" if distortion else "pinhole", SIZE, params)


def stereo(turn: float = 0.0) -> Estimate:
    """Side by side; the right one turned by an angle about the downward axis."""
    right_from_left = Transform(np.eye(3), np.array([-BASELINE, 0, 0]))
    turned = Transform.exp(np.array([0.0, turn, 0.0]), np.zeros(3)) @ right_from_left
    cameras = (camera("left"), camera("right"))
    return Estimate(cameras, (Transform.identity(), turned), (), np.empty((0, 3)))


def alone(one: Camera) -> Estimate:
    return Estimate((one,), (Transform.identity(),), (), np.empty((0, 3)))


# ---- over the image ------------------------------------------------------------------------


def test_a_focal_length_by_hand() -> None:
    """Moves pixels outward by r / f of itself, which no rotation undoes."""
    covariance = Covariance(("left.fx", "left.fy"), np.full((2, 2), 3.0**2))
    (found,) = projection_maps(alone(camera("left")), covariance)
    assert found.sigma_px.shape == SHAPE[::-1] and found.range == np.inf
    x, y = np.meshgrid(found.across - 319.5, found.down - 239.5)
    np.testing.assert_allclose(found.sigma_px, 3.0 * np.hypot(x, y) / FOCAL_PX, atol=1e-9)
    assert found.centre_px == pytest.approx(0, abs=1e-9)
    assert found.corner_px == pytest.approx(3.0 * np.hypot(319.5, 239.5) / FOCAL_PX)
    assert found.rms_px == pytest.approx(np.sqrt((found.sigma_px**2).mean()))


@pytest.mark.parametrize(
    ("cov", "sigma"),
    [
        ([[1.0, 0.0], [0.0, 1.0]], 1.0),
        ([[1.0, 0.0], [0.0, 9.0]], 3.0),
        ([[2.0, -1.0], [-1.0, 2.0]], 3**0.5),
        ([[4.0, 4.0], [4.0, 4.0]], 8**0.5),
    ],
)
def test_sigma_is_that_of_the_worst_direction(cov: list[list[float]], sigma: float) -> None:
    whole = np.broadcast_to(np.array(cov), (3, 5, 2, 2))
    found = ProjectionMap(0, np.inf, np.arange(5.0), np.arange(3.0), whole)
    np.testing.assert_allclose(found.sigma_px, np.full((3, 5), sigma))
    assert found.centre_px == found.corner_px == found.rms_px == pytest.approx(sigma)


def test_a_turn_is_fitted_within_a_sixth_of_the_height_about_the_centre() -> None:
    """To 1 px of cx: in units of the focal length, over a disc of radius r, what is left of it in
    the middle is r^2 / 4 + O(r^4)."""
    covariance = Covariance(("left.cx",), np.array([[1.0]]))
    (aimed,) = projection_maps(alone(camera("left")), covariance, fit="centre", shape=(129, 97))
    r2 = (480 / 6 / FOCAL_PX) ** 2
    turn = (1 + r2 / 4) / (1 + r2 / 2 + r2**2 / 6)  # E[1 + x^2] / E[(1 + x^2)^2 + x^2 y^2]
    assert aimed.centre_px == pytest.approx(1 - turn, rel=0.05)


def test_a_principal_point_passes_for_a_turned_camera() -> None:
    """All but the part that grows as the square of the angle, which the fit spreads out."""
    covariance = Covariance(("left.cx",), np.array([[1.0]]))
    (found,) = projection_maps(alone(camera("left")), covariance)
    (aimed,) = projection_maps(alone(camera("left")), covariance, fit="centre")
    assert found.rms_px < 0.25
    assert aimed.centre_px < 0.03 < 0.1 < found.centre_px and aimed.corner_px > found.corner_px
    narrow = camera("left")
    narrow = replace(narrow, params=narrow.params * [100.0, 100.0, 1, 1])
    (flat,) = projection_maps(alone(narrow), covariance)
    assert flat.corner_px < 1e-4


def test_turned_and_shifted_cameras_by_hand() -> None:
    """The right camera turned by an angle: shared with the left one, half of it is left for each.

    Shifted, it errs by f / range; at infinity by nothing.
    """
    estimate = stereo()
    narrow = tuple(replace(c, params=c.params * [100, 100, 1, 1]) for c in estimate.cameras)
    estimate = replace(estimate, cameras=narrow)
    turned = Covariance(("right.rotation_y",), np.array([[1e-4**2]]))
    for one in projection_maps(estimate, turned, relative_to="rig"):
        np.testing.assert_allclose(one.sigma_px, 1e-4 * 100 * FOCAL_PX / 2, rtol=1e-3)
    lenses = projection_maps(estimate, turned)
    assert all((one.sigma_px == 0).all() for one in lenses)
    shifted = Covariance(("right.translation_x",), np.array([[1e-3**2]]))
    for one in projection_maps(estimate, shifted, 40.0, "rig"):
        np.testing.assert_allclose(one.sigma_px, 1e-3 / 40 * 100 * FOCAL_PX / 2, rtol=1e-2)
    assert projection_maps(estimate, shifted, np.inf, "rig")[1].rms_px < 1e-4


Case = tuple[RelativeTo, float, Fit]
CASES: list[Case] = [
    ("camera", np.inf, "image"),
    ("camera", np.inf, "centre"),
    ("rig", 2.5, "image"),
    ("rig", 2.5, "centre"),
    ("rig", np.inf, "image"),
]


def draws(cov: FloatArray, count: int) -> FloatArray:
    """Draws (count, n) whose own covariance is exactly `cov`: what then differs is not chance."""
    white = np.linalg.qr(np.random.default_rng(4).standard_normal((count, len(cov))))[0]
    values, vectors = np.linalg.eigh(cov)
    return np.sqrt(count) * white @ (vectors * np.sqrt(np.maximum(values, 0))).T


def settled(
    estimate: Estimate, changed: Estimate, points: list[FloatArray], near: FloatArray
) -> FloatArray:
    """Pixels (n, 2) by which fixed points move once the rig turned as it fits them best.

    By Gauss-Newton, with numeric derivatives at the start: the turns are small.
    """

    def pixels(of: Estimate, turn: FloatArray) -> FloatArray:
        turned = [p @ exp_rotation(turn).T for p in points]
        seen = zip(of.cameras, of.cam_from_rig, turned, strict=True)
        return np.concatenate([project(c, t @ p) for c, t, p in seen])

    step = 1e-6
    slope = [(pixels(estimate, w) - pixels(estimate, -w)) / (2 * step) for w in step * np.eye(3)]
    jacobian = np.stack(slope, axis=-1)[near].reshape(-1, 3)
    turn, before = np.zeros(3), pixels(estimate, np.zeros(3))
    for _ in range(3):
        left = pixels(changed, turn) - before
        turn = turn - np.linalg.lstsq(jacobian, left[near].ravel())[0]
    return pixels(changed, turn) - before


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_projection_maps_by_drawing_calibrations(case: Case) -> None:
    relative_to, distance, fit = case
    estimate, shape, count = rig(), (7, 5), 60
    covariance = covariance_of(estimate, 0.5)
    if relative_to == "camera":
        estimate = alone(estimate.cameras[1])
        names = [n for n in lens_names(estimate.cameras[0]) if n in covariance.names]
        rows = [covariance.names.index(name) for name in names]
        covariance = Covariance(tuple(names), covariance.matrix[np.ix_(rows, rows)])
    maps = projection_maps(estimate, covariance, distance, relative_to, fit, shape)
    points, near = [], []
    for one, seen_by, cam_from_rig in zip(
        maps, estimate.cameras, estimate.cam_from_rig, strict=True
    ):
        pixels = np.stack(np.meshgrid(one.across, one.down), axis=-1).reshape(-1, 2)
        rays = unproject(seen_by, pixels)
        points.append(cam_from_rig.inverse @ (min(distance, 1e6) * rays))
        off = np.linalg.norm(pixels - seen_by.centre, axis=1)
        near.append(off <= FIT_RADIUS * SIZE[1] if fit == "centre" else off >= 0)
    changes = draws(covariance.matrix, count)
    changed = [moved(estimate, covariance.names, change) for change in changes]
    sample = np.array([settled(estimate, one, points, np.concatenate(near)) for one in changed])
    drawn = np.einsum("dni,dnj->nij", sample, sample) / count
    cov_px = np.concatenate([one.cov_px.reshape(-1, 2, 2) for one in maps])
    variance, expected = (np.trace(cov, axis1=1, axis2=2) for cov in (drawn, cov_px))
    assert variance.sum() == pytest.approx(expected.sum(), rel=0.03)
    np.testing.assert_allclose(variance, expected, rtol=0.05, atol=0.01 * expected.mean())


def test_pixels_that_the_lens_does_not_know_are_nan() -> None:
    folds = camera("left", -0.6, 0.0, 0.0, 0.0)  # back before the corner
    covariance = Covariance(("left.k1",), np.array([[1e-4]]))
    (found,) = projection_maps(alone(folds), covariance)
    assert np.isnan(found.sigma_px[0, 0]) and np.isfinite(found.centre_px)
    assert found.corner_px == np.nanmax(found.sigma_px) and np.isfinite(found.rms_px)


# ---- over range ----------------------------------------------------------------------------


def test_depth_of_a_rectified_pair_by_hand() -> None:
    """sigma_Z = Z^2 / (f b) sigma_disparity; Z sigma_b / b; Z^2 / b sigma_angle."""
    estimate, ranges = stereo(), np.array([2.0, 5.0, 10.0, 20.0])
    exact = Covariance(("other.fx",), np.eye(1))
    found = depth_sigma(estimate, exact, (0, 1), ranges, SIGMA_PX)
    assert found.in_view.all() and found.baseline == pytest.approx(BASELINE)
    by_hand = ranges**2 / (FOCAL_PX * BASELINE) * np.sqrt(2) * SIGMA_PX
    np.testing.assert_allclose(found.sigma_noise, by_hand, rtol=5e-3)
    assert (found.sigma_calibration == 0).all()
    for name, expected in (
        ("right.translation_x", ranges / BASELINE * 1e-3),
        ("right.rotation_y", ranges**2 / BASELINE * 1e-3),
    ):
        covariance = Covariance((name,), np.array([[1e-3**2]]))
        found = depth_sigma(estimate, covariance, (0, 1), ranges, SIGMA_PX)
        np.testing.assert_allclose(found.sigma_calibration, expected, rtol=5e-3)
        np.testing.assert_allclose(found.sigma, np.hypot(expected, by_hand), rtol=5e-3)


@pytest.mark.parametrize("pair", [(0, 1), (1, 2)])
def test_depth_by_drawing_calibrations_and_noise(pair: tuple[int, int]) -> None:
    estimate, count = rig(), 60
    covariance = covariance_of(estimate, 0.2)
    found = depth_sigma(estimate, covariance, pair, np.array([2.0, 4.0]), SIGMA_PX)
    points, in_view = middle_of_view(estimate, pair, found.ranges)
    assert in_view.all()
    pixels = pixels_of(estimate, pair, points)

    def depths(changed: Estimate, seen: FloatArray) -> FloatArray:
        centre = changed.cam_from_rig[pair[0]].inverse.translation
        return np.linalg.norm(triangulate(changed, pair, seen, SIGMA_PX) - centre, axis=-1)

    np.testing.assert_allclose(depths(estimate, pixels), found.ranges)
    changes = draws(covariance.matrix, count)
    changed = [moved(estimate, covariance.names, change) for change in changes]
    of_calibration = np.array([depths(one, pixels) for one in changed])
    noise = draws(SIGMA_PX**2 * np.eye(8), 100).reshape(-1, *pixels.shape)
    of_noise = depths(estimate, pixels + noise)
    for sample, sigma in (
        (of_calibration, found.sigma_calibration),
        (of_noise, found.sigma_noise),
    ):
        np.testing.assert_allclose(
            np.sqrt(((sample - found.ranges) ** 2).mean(0)), sigma, rtol=0.03
        )


def test_a_curve_ends_where_depths_do() -> None:
    estimate = stereo()
    covariance = Covariance(("right.rotation_y",), np.array([[2e-3**2]]))
    ranges = curve_ranges(estimate, (0, 1))
    assert ranges[[0, -1]] == pytest.approx([0.5 * BASELINE, 200 * BASELINE])
    found = depth_sigma(estimate, covariance, (0, 1), ranges, SIGMA_PX)
    points, in_view = middle_of_view(estimate, (0, 1), ranges)
    np.testing.assert_array_equal(found.in_view, in_view)
    for k in range(len(ranges)):
        if not in_view[k]:
            assert np.isnan(points[k]).all() and not found.determined[k]
        elif found.determined[k]:
            at = pixels_of(estimate, (0, 1), points[k])
            one = triangulated_covariance(estimate, covariance, (0, 1), at, SIGMA_PX)
            assert one.depth == pytest.approx(ranges[k])
            assert one.sigma_depth == pytest.approx(found.sigma[k])
        else:
            at = pixels_of(estimate, (0, 1), points[k])
            with pytest.raises(ValueError, match="parallel within their sigma"):
                triangulated_covariance(estimate, covariance, (0, 1), at, SIGMA_PX)
    assert found.determined.sum() < in_view.sum() < len(ranges)
    assert found.determined_to == ranges[found.determined].max()
    assert depth_sigma(estimate, covariance, (0, 1), ranges, 1e-3).determined_to is not None
    nothing = depth_sigma(estimate, covariance, (0, 1), ranges, 1e4)
    assert nothing.determined_to == 0 and not nothing.determined.any()
    exact = Covariance(("other.fx",), np.eye(1))
    assert depth_sigma(estimate, exact, (0, 1), ranges, 1e-3).determined_to is None


@pytest.mark.parametrize(("turn", "at_ends"), [(1.2, [1, 0]), (-0.5, [0, 1]), (np.pi, [0, 0])])
def test_the_middle_of_what_two_cameras_see(turn: float, at_ends: list[bool]) -> None:
    """Crossed eyes lose far points, averted ones near points, cameras back to back all."""
    estimate = stereo(turn)
    ranges = curve_ranges(estimate, (0, 1))
    points, in_view = middle_of_view(estimate, (0, 1), ranges)
    for pixels in np.moveaxis(pixels_of(estimate, (0, 1), points[in_view]), 1, 0):
        assert ((pixels > -0.5) & (pixels < np.array(SIZE) - 0.5)).all()
    np.testing.assert_allclose(np.linalg.norm(points[in_view], axis=1), ranges[in_view])
    assert in_view[[0, -1]].tolist() == at_ends
    found = depth_sigma(estimate, covariance_of(estimate, 1e-3), (0, 1), ranges, 1e-2)
    np.testing.assert_array_equal(found.determined, in_view)
    assert found.determined_to is None


def test_how_the_rigs_axes_lie_does_not_matter_to_what_two_cameras_see() -> None:
    estimate = stereo(0.3)
    rig_from_other = Transform.exp(np.array([0.3, -1.2, 0.8]), np.array([2.0, -1.0, 0.5]))
    turned = tuple(t @ rig_from_other for t in estimate.cam_from_rig)
    other = replace(estimate, cam_from_rig=turned)
    ranges = curve_ranges(estimate, (0, 1))
    for pair in ((0, 1), (1, 0)):
        points, in_view = middle_of_view(estimate, pair, ranges)
        again, still_in_view = middle_of_view(other, pair, ranges)
        np.testing.assert_array_equal(still_in_view, in_view)
        assert 5 < in_view.sum() < len(ranges)
        np.testing.assert_allclose((rig_from_other @ again)[in_view], points[in_view], atol=1e-8)


# ---- as the file tells them ----------------------------------------------------------------


def told(estimate: Estimate, covariance: Covariance, unit: str = "m") -> result.Uncertainty:
    return uncertainty_of(estimate, covariance, SIGMA_PX, "m" if unit == "m" else "baseline")


def test_the_record_says_what_the_maths_says() -> None:
    estimate = rig()
    covariance = covariance_of(estimate, 0.1)
    record = told(estimate, covariance)
    assert result.Uncertainty.model_validate_json(record.model_dump_json()) == record
    assert list(record.projection) == ["cam0", "cam1", "cam2"]
    for index, rows in enumerate(record.projection.values()):
        assert [(one.relative_to, one.range) for one in rows] == [
            ("camera", None), *(("rig", r) for r in RANGES["m"]), ("rig", None)
        ]  # fmt: skip
        expected = projection_maps(estimate, covariance, 2.0, "rig")[index]
        assert rows[2].rms_px == expected.rms_px and rows[2].centre_px == expected.centre_px
        assert rows[2].corner_px == expected.corner_px
    assert [one.cameras for one in record.depth] == [
        ("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam2")
    ]  # fmt: skip
    for pair, entry in zip(pairs(estimate), record.depth, strict=True):
        expected = depth_sigma(estimate, covariance, pair, np.array(RANGES["m"]), SIGMA_PX)
        sigmas = [(one.sigma_noise, one.sigma_calibration) for one in entry.depth]
        assert entry.common_view and entry.baseline == expected.baseline
        np.testing.assert_array_equal(np.array(sigmas).T, [
            expected.sigma_noise, expected.sigma_calibration
        ])  # fmt: skip
    in_baselines = told(estimate, covariance, "baseline")
    assert [one.range for one in in_baselines.depth[0].depth] == list(RANGES["baseline"])


def test_what_has_no_depth_is_null_with_a_reason() -> None:
    covariance = Covariance(("right.rotation_y",), np.array([[0.015**2]]))
    (entry,) = told(stereo(), covariance).depth
    assert [one.missing for one in entry.depth] == ["", "", *["not determined"] * 2]
    assert entry.depth[2].sigma_noise is None and entry.determined_to is not None
    (crossed,) = told(stereo(1.2), covariance).depth
    assert crossed.common_view and crossed.determined_to is None
    assert [one.missing for one in crossed.depth] == ["", "", *["not in both images"] * 2]
    (blind,) = told(stereo(np.pi), covariance).depth
    assert not blind.common_view and blind.depth == () and blind.determined_to is None


def test_without_noise_unit_or_company() -> None:
    covariance = Covariance(("left.fx",), np.eye(1))
    assert uncertainty_of(stereo(), covariance, None, "m").depth == ()
    directions = uncertainty_of(stereo(), covariance, SIGMA_PX, None)
    assert directions.depth == () and directions.unit is None
    assert [one.range for one in directions.projection["left"]] == [None, None]
    mono = uncertainty_of(alone(camera("left")), covariance, SIGMA_PX, None)
    assert [one.relative_to for one in mono.projection["left"]] == ["camera"]
    perfect = uncertainty_of(stereo(), covariance, 0.0, "m")
    assert all(one.missing == "" for one in perfect.depth[0].depth)
    held = uncertainty_of(stereo(), Covariance((), np.zeros((0, 0))), SIGMA_PX, "m")
    assert held.projection["left"][0].corner_px == 0
    assert held.depth[0].depth[0].sigma_calibration == 0


def test_the_unit_of_a_result() -> None:
    estimate = stereo()
    metric = result.truth(list(estimate.cameras), list(estimate.cam_from_rig), "0")
    assert unit_of(metric) == "m" and metric.uncertainty is None
    rig_only = metric.rig.model_copy(update={"metric": False})
    assert unit_of(metric.model_copy(update={"rig": rig_only})) is None
    transforms = list(estimate.scaled(1 / BASELINE).cam_from_rig)
    scaled = result.truth(list(estimate.cameras), transforms, "0").rig
    scaled = scaled.model_copy(update={"metric": False})
    assert unit_of(metric.model_copy(update={"rig": scaled})) == "baseline"
    assert unit_of(result.truth([camera("left")], [Transform.identity()], "0")) is None

"""Points of depth images, their fusion, registration and sigmas."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic.depths import (
    BALL,
    BESIDE,
    LENSES,
    RADIUS,
    SIGMAS,
    SIZE,
    camera,
    needs_open3d,
    ranges,
    two,
    z_of,
)

from graphs.camera import project, unproject
from graphs.covariance import NOTHING
from graphs.frames import Transform, exp_rotation
from sfm_calib.depth.cloud import DepthLimits, depth_points
from sfm_calib.depth.fuse import fuse_clouds, register, thinned
from sfm_calib.depth.overlap import overlap
from sfm_calib.depth.predicted import calibration_names, point_jacobian, sigma_apart
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import read_calibration

# ---- points --------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", sorted(LENSES))
@pytest.mark.parametrize("kind", ["z", "range"])
def test_a_ball_comes_back_through_a_distorted_lens(lens, kind):
    taker = camera(lens)
    range_m = ranges(taker)
    depth = range_m if kind == "range" else z_of(taker, range_m)
    points, pixels = depth_points(depth, taker, kind)
    assert len(points) == (range_m > 0).sum() > 500
    assert np.abs(np.linalg.norm(points - BALL, axis=1) - RADIUS).max() < 1e-9
    assert np.abs(project(taker, points) - pixels[:, ::-1]).max() < 1e-6
    other = depth_points(depth, taker, "z" if kind == "range" else "range")[0]
    assert np.abs(np.linalg.norm(other - BALL, axis=1) - RADIUS).max() > 1e-3


def test_limits_and_what_is_no_measurement():
    taker = camera()
    depth = np.full(SIZE[::-1], 1.0)
    depth[0, :4] = np.nan, np.inf, -1.0, 0.0
    assert len(depth_points(depth, taker)[0]) == depth.size - 4
    depth[10], depth[20] = 0.5, 2.0
    points, _ = depth_points(depth, taker, limits=DepthLimits(near_m=0.6, far_m=1.5))
    assert len(points) == depth.size - 4 - 2 * SIZE[0] and points[:, 2] == pytest.approx(1.0)
    with pytest.raises(CalibrationError, match=r"40 x 30 px.*192 x 160 px"):
        depth_points(np.ones((30, 40)), taker)


def test_flying_pixels_go_and_edges_stay():
    depth = np.full(SIZE[::-1], 1.0)
    depth[:, 80:] = 0.6
    depth[:, 80] = np.linspace(0.62, 0.98, SIZE[1])  # between the two
    kept = {tuple(p) for p in depth_points(depth, camera(), limits=DepthLimits(edge=0.02))[1]}
    corners = {(0, 0), (0, 191), (159, 0), (159, 191)}
    lost = {tuple(p) for p in np.ndindex(depth.shape)} - kept - corners
    flying = {(row, 80) for row in range(SIZE[1]) if 0.62 < depth[row, 80] < 0.96}
    assert flying <= lost and {p for p in lost if p[0] not in (0, 159)} <= {
        (row, 80) for row in range(SIZE[1])
    }


def test_thinning_keeps_a_point_of_each_camera_in_each_cube():
    parts = [np.random.default_rng(i).random((400, 3)) for i in (0, 1)]
    cloud = fuse_clouds(parts, [Transform.identity()] * 2)
    kept = cloud.only(thinned(cloud, 0.5))
    assert len(kept.points) == 16 and (np.bincount(kept.camera) == 8).all()
    assert {tuple(p) for p in kept.points} <= {tuple(p) for p in cloud.points}


# ---- registration --------------------------------------------------------------------------


def seen_by_two(noise_m=0.0, shape="lumps"):
    rng = np.random.default_rng(1)
    parts = []
    for taker, place in ((camera(), Transform.identity()), (camera(name="b"), BESIDE)):
        taker = replace(taker, size=(288, 240), params=taker.params * np.r_[[1.5] * 4, [1.0] * 5])
        found = ranges(taker, place, shape)
        noisy = np.where(found > 0, found + noise_m * rng.standard_normal(found.shape), 0.0)
        parts.append(depth_points(noisy, taker, "range")[0])
    return parts


@needs_open3d
@pytest.mark.parametrize(("noise_m", "most_m"), [(0.0, 2e-4), (0.001, 1e-3)])
def test_icp_finds_a_known_motion(noise_m, most_m):
    parts = seen_by_two(noise_m)
    motion = Transform(
        exp_rotation(np.array([0.02, -0.01, 0.015])), np.array([0.006, 0.004, -0.01])
    )
    found = register(fuse_clouds(parts, [Transform.identity(), motion @ BESIDE], True))
    assert found.failed == (False, False)
    right = found.corrected([Transform.identity(), motion @ BESIDE])[1]
    before, after = (
        np.linalg.norm(rig.inverse @ parts[1] - BESIDE.inverse @ parts[1], axis=1).max()
        for rig in (motion @ BESIDE, right)
    )
    assert before > 0.008 and after < most_m
    again = register(fuse_clouds(parts, [Transform.identity(), motion @ BESIDE], True))
    assert np.array_equal(again.transforms[1].translation, found.transforms[1].translation)


@needs_open3d
@pytest.mark.parametrize(
    ("shape", "shift_m", "word"), [("ball", 0.002, "slides"), ("lumps", 0.6, "points overlap")]
)
def test_icp_says_where_it_fails_and_leaves_the_part(shape, shift_m, word):
    parts = seen_by_two(shape=shape)
    rig = [Transform.identity(), Transform(BESIDE.rotation, BESIDE.translation + shift_m)]
    found = register(fuse_clouds(parts, rig, True))
    assert found.failed == (False, True) and word in found.reasons[1]
    assert np.array_equal(found.transforms[1].rotation, np.eye(3))


@needs_open3d
def test_an_overlap_is_measured_across_the_surface():
    """Two planes 3 mm apart, one half beside the other's border."""
    x, y = np.meshgrid(np.arange(80) / 1000, np.arange(40) / 1000)
    plane = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.5)])
    rig = [Transform.identity(), Transform(np.eye(3), np.array([0.0402, 0.0003, -0.003]))]
    cloud = fuse_clouds([plane, rig[1] @ (plane + np.array([0.0402, 0.0003, 0.003]))], rig, True)
    assert cloud.normals[:, 2] == pytest.approx(-1.0)  # to the cameras
    found = overlap(cloud.of(0), cloud.of(1), 0.05)
    assert found.apart_m == pytest.approx(0.003) and found.rms_m == pytest.approx(0.003)
    assert found.share == pytest.approx(0.5, abs=0.05)
    assert not len(overlap(cloud.of(0), cloud.of(1), 0.002).points)


# ---- sigmas --------------------------------------------------------------------------------


def drawn(taker, place, by):
    """A camera and its place with reported changes added."""
    turned = exp_rotation(by[-6:-3]) @ place.rotation
    return replace(taker, params=taker.params + by[:-6]), Transform(
        turned, place.translation + by[-3:]
    )


def lifted(taker, place, pixels, depth, kind="z"):
    """Points in the rig's frame of pixels (n, 2) with depths (n,)."""
    rays = unproject(taker, pixels)
    return place.inverse @ (rays * (depth / (rays[:, 2] if kind == "z" else 1.0))[:, None])


@pytest.mark.parametrize("lens", sorted(LENSES))
@pytest.mark.parametrize("kind", ["z", "range"])
def test_derivatives_of_points_are_those_of_finite_differences(lens, kind):
    taker, rng = camera(lens), np.random.default_rng(2)
    pixels, depth = rng.uniform([30, 25], [160, 135], (20, 2)), rng.uniform(0.4, 1.2, 20)
    found = point_jacobian(taker, BESIDE, lifted(taker, BESIDE, pixels, depth, kind), kind)
    assert len(calibration_names(taker)) == found.shape[2]
    for index, step in enumerate(1e-6 * np.eye(found.shape[2])):
        up, down = (
            lifted(*drawn(taker, BESIDE, sign * step), pixels, depth, kind) for sign in (1, -1)
        )
        assert (up - down) / 2e-6 == pytest.approx(found[..., index], abs=1e-6)


@needs_open3d
def test_sigmas_of_an_overlap_are_what_drawn_calibrations_do(tmp_path):
    rig = read_calibration(two(tmp_path, sigmas=SIGMAS)[0])
    sides = list(zip(rig.cameras, rig.cam_from_rig, strict=True))
    parts = [depth_points(z_of(c, ranges(c, t, "lumps")), c)[0] for c, t in sides]
    true = fuse_clouds(parts, rig.cam_from_rig, True)
    found = overlap(true.of(0), true.of(1), 0.01)
    seen = [t @ p for (_, t), p in zip(sides, (found.points, found.others), strict=True)]
    given = [(project(c, p), p[:, 2]) for (c, _), p in zip(sides, seen, strict=True)]
    sigma = [np.array([SIGMAS.get(n, 0.0) for n in calibration_names(c)]) for c, _ in sides]
    rng, squares = np.random.default_rng(0), []
    for _ in range(200):
        a, b = (
            lifted(*drawn(*side, rng.standard_normal(len(s)) * s), *where)
            for side, s, where in zip(sides, sigma, given, strict=True)
        )
        moved = (a - b - found.points + found.others) * found.normals
        squares.append((moved.sum(axis=1) ** 2).mean())
    # Chance of 200 draws, few of whose directions count: 10 %.
    assert sigma_apart(rig, (0, 1), found) == pytest.approx(np.sqrt(np.mean(squares)), rel=0.15)
    assert sigma_apart(replace(rig, covariance=NOTHING), (0, 1), found) is None

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphs.camera import project, unproject
from graphs.frames import Transform, angle_between
from graphs.problem import residuals_px
from sfm_calib.errors import CalibrationError
from sfm_calib.simulate.cabin import (
    FACTORY_COLOUR,
    HEAD_M,
    PLACES_M,
    draw_cabin,
    head_place,
    resized,
)
from sfm_calib.simulate.carried import BOX_M, CarryOptions, carried, carry_box, on_box
from sfm_calib.simulate.depth_image import depth_image, depth_sigma_m, to_be_seen
from sfm_calib.simulate.head import icosphere, make_head

MIDDLE = np.array(HEAD_M)


def some_cabin(seed: int = 0):  # type: ignore[no-untyped-def]
    return draw_cabin(np.random.default_rng(seed), 2.0, 0.02)


# ---- the head ------------------------------------------------------------------------------


@pytest.mark.parametrize("subdivisions", [0, 1, 3])
def test_an_icosphere_is_closed_and_looks_outwards(subdivisions: int) -> None:
    vertices, triangles = icosphere(subdivisions)
    assert len(vertices) == 10 * 4**subdivisions + 2
    assert len(triangles) == 20 * 4**subdivisions
    assert np.allclose(np.linalg.norm(vertices, axis=1), 1)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges)  # each edge once in each direction: closed, one side out
    assert {(b, a) for a, b in directed} == directed
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    volume = (np.cross(a, b) * c).sum() / 6
    assert 0.6 * 4 / 3 * np.pi < volume < 4 / 3 * np.pi


def test_a_head_has_a_heads_size_and_no_symmetry() -> None:
    vertices, triangles = make_head(3)
    size = np.ptp(vertices, axis=0)
    assert np.all(np.abs(size - [0.17, 0.22, 0.21]) < 0.02)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    outward = (np.cross(b - a, c - a) * (a + b + c)).sum(axis=1)
    assert np.all(outward > 0)  # star-shaped still
    mirrored = vertices * [-1, 1, 1]
    gaps = np.linalg.norm(mirrored[:, None] - vertices[None], axis=-1).min(axis=1)
    assert gaps.max() > 0.003


# ---- the rig -------------------------------------------------------------------------------


def test_devices_stand_where_the_study_has_them_and_look_at_the_head() -> None:
    cabin = some_cabin()
    for device, place in zip(cabin.infrared, PLACES_M, strict=True):
        cam_from_rig = cabin.true.cam_from_rig[device]
        assert np.allclose(cam_from_rig.inverse.translation, place)
        at = cam_from_rig @ MIDDLE
        assert 0.5 < np.linalg.norm(at) < 0.9
        assert np.hypot(*at[:2]) < 0.05 * at[2]
    for side in cabin.infrared[1:]:
        turned = np.degrees(angle_between(np.eye(3), cabin.true.cam_from_rig[side].rotation))
        assert 75 < turned < 92


def test_places_by_hand_are_off_as_said() -> None:
    turns, shifts = [], []
    for seed in range(60):
        cabin = some_cabin(seed)
        for side in cabin.infrared[1:]:
            off = cabin.nominal.cam_from_rig[side] @ cabin.true.cam_from_rig[side].inverse
            turns.append(np.degrees(angle_between(np.eye(3), off.rotation)))
            shifts.append(np.linalg.norm(off.translation))
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(2.0, rel=0.2)
    assert np.sqrt(np.mean(np.square(shifts))) == pytest.approx(0.02, rel=0.2)


def test_the_factory_knows_no_device() -> None:
    cabin = some_cabin()
    for true, factory in zip(cabin.true.cameras, cabin.nominal.cameras, strict=True):
        assert true.name == factory.name and true.size == factory.size
        assert not factory.params[4:].any() and true.params[4:].all()
    assert cabin.nominal.cameras[1].named()["cx"] == FACTORY_COLOUR["cx"]
    assert not np.array_equal(some_cabin(1).true.cameras[0].params, cabin.true.cameras[0].params)


def test_the_whole_infrared_picture_can_be_inverted() -> None:
    for seed in range(20):
        camera = some_cabin(seed).true.cameras[0]
        corners = np.array([[0.0, 0.0], [511.0, 0.0], [511.0, 423.0], [0.0, 423.0]])
        assert np.allclose(project(camera, unproject(camera, corners)), corners, atol=1e-6)


@given(st.sampled_from([0.5, 0.25, 2.0]))
def test_a_resized_camera_sees_the_same(factor: float) -> None:
    camera = some_cabin().true.cameras[1]
    points = np.array([[0.1, 0.2, 0.7], [-0.2, 0.1, 0.6]])
    there = (project(camera, points) + 0.5) * factor - 0.5
    assert np.allclose(project(resized(camera, factor), points), there)


# ---- depth images --------------------------------------------------------------------------


def wall() -> tuple[np.ndarray, np.ndarray]:
    """A square of 1 m at z = 0, seen from -z."""
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


def test_a_wall_has_the_depth_it_stands_at() -> None:
    camera = some_cabin().true.cameras[0]
    surface = to_be_seen(*wall())
    placed = Transform(np.eye(3), np.array([0.0, 0.0, 0.8]))
    depth = depth_image(surface, camera, placed, np.random.default_rng(0), noise=0.0)
    assert depth.shape == (424, 512)
    assert np.allclose(depth[depth > 0], 0.8, atol=1e-6)
    v, u = np.nonzero(depth)
    rays = unproject(camera, np.stack([u, v], axis=-1).astype(float))
    assert np.abs(rays / rays[:, 2:] * 0.8)[:, :2].max() < 0.501  # no more than the wall
    assert len(u) > 0.9 * (1 / 0.8 * 365) ** 2  # nor less; the lens draws it in a little


def test_noise_is_the_sensors() -> None:
    camera = some_cabin().true.cameras[0]
    surface = to_be_seen(*wall())
    placed = Transform(np.eye(3), np.array([0.0, 0.0, 1.5]))
    depth = depth_image(surface, camera, placed, np.random.default_rng(0))
    squarely = depth[190:230, 230:280]
    assert (squarely > 0).all()
    expected = 1e-3 * (1.5 - 0.5 * 1.5 + 0.3 * 1.5**2)
    assert squarely.std() == pytest.approx(expected, rel=0.06)
    assert squarely.mean() == pytest.approx(1.5, abs=4 * expected / squarely.size**0.5)


@settings(max_examples=30)
@given(st.floats(0.9, 4.0), st.floats(0.0, 1.2))
def test_noise_grows_with_range_and_with_the_angle(depth_m: float, angle: float) -> None:
    here, farther, flatter = depth_sigma_m(
        np.array([depth_m, depth_m + 0.1, depth_m]), np.array([angle, angle, angle + 0.1])
    )
    assert 1e-3 < here < farther and here < flatter


def test_what_is_behind_or_beside_is_refused() -> None:
    camera = some_cabin().true.cameras[0]
    surface, rng = to_be_seen(*wall()), np.random.default_rng(0)
    behind = Transform(np.eye(3), np.array([0.0, 0.0, -1.0]))
    with pytest.raises(CalibrationError, match="front_infrared does not see the surface"):
        depth_image(surface, camera, behind, rng)
    beside = Transform(np.eye(3), np.array([5.0, 0.0, 1.0]))
    with pytest.raises(CalibrationError, match="beside the picture"):
        depth_image(surface, camera, beside, rng)


def test_every_device_sees_the_head_from_its_side() -> None:
    cabin, rng = some_cabin(), np.random.default_rng(0)
    surface, rig_from_head = to_be_seen(*make_head(4)), head_place(rng)
    for device in cabin.infrared:
        camera, cam_from_rig = cabin.true.cameras[device], cabin.true.cam_from_rig[device]
        depth = depth_image(surface, camera, cam_from_rig @ rig_from_head, rng)
        seen = depth[depth > 0]
        assert len(seen) > 4000 and 0.4 < seen.min() < seen.max() < 0.95


# ---- the box -------------------------------------------------------------------------------


def test_points_lie_on_the_box() -> None:
    points, normals = on_box(500, np.random.default_rng(0))
    half = np.array(BOX_M) / 2
    assert np.all(np.abs(points) <= half + 1e-12)
    assert np.allclose((points * normals).sum(1), np.abs(normals) @ half)
    for axis in range(3):
        assert {-1.0, 1.0} <= set(normals[:, axis])


def test_the_box_is_carried_clear_of_the_cameras() -> None:
    for seed in range(20):
        for placed in carried(60, MIDDLE, np.random.default_rng(seed)):
            for place in PLACES_M:
                inside = np.abs(placed.inverse @ np.array(place)) < np.array(BOX_M) / 2 + 0.05
                assert not inside.all()


def test_tracks_agree_with_the_truth_and_join_devices_of_a_kind_alone() -> None:
    cabin, options = some_cabin(), CarryOptions(frames=40, points=500, outlier_share=0.0)
    kinds = (cabin.infrared, cabin.colour)
    rng = np.random.default_rng(0)
    problem, truth = carry_box(options, cabin.true, cabin.nominal, kinds, MIDDLE, rng)
    seen = problem.observations
    assert residuals_px(truth, seen).std() == pytest.approx(options.sigma_px, rel=0.03)
    by_camera = [set(seen.point[seen.camera == camera].tolist()) for camera in range(6)]
    assert not (set().union(*(by_camera[i] for i in cabin.infrared))
                & set().union(*(by_camera[i] for i in cabin.colour)))  # fmt: skip
    for side in cabin.infrared[1:]:
        assert len(by_camera[0] & by_camera[side]) > 100  # as the box is turned
    assert problem.initial.cameras == cabin.nominal.cameras
    assert np.bincount(seen.camera * 40 + seen.frame).max() <= options.max_points_per_image


def test_a_feature_is_found_from_about_where_it_looks_alike() -> None:
    cabin, options = some_cabin(), CarryOptions(frames=40, points=400)
    rng = np.random.default_rng(1)
    problem, truth = carry_box(options, cabin.true, cabin.nominal, (cabin.infrared,), MIDDLE, rng)
    seen = problem.observations
    directions = np.array([
        (truth.rig_from_world[f].inverse @ truth.cam_from_rig[c].inverse.translation)
        - truth.points[p]
        for f, c, p in zip(seen.frame, seen.camera, seen.point, strict=True)
    ])  # fmt: skip
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for point in np.unique(seen.point)[:50]:
        own = directions[seen.point == point]
        assert np.degrees(np.arccos(np.clip(own @ own.T, -1, 1))).max() <= 80.0 + 1e-6

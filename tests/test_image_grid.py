from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.problems import small_problem

from graphs.camera import project, unproject
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.image_grid import GRID, ImageGrid, centre, corners, image_grid
from graphs.lenses import LensName
from graphs.problem import Estimate
from graphs.propagation import lens_names, pose_names

DISTANCES = (4.0, 6.0)


def rig(lens: LensName = "radtan") -> Estimate:
    return small_problem(lens, cameras=2)[1]


def names_of(estimate: Estimate) -> tuple[str, ...]:
    lenses = [name for camera in estimate.cameras for name in lens_names(camera)]
    return (*lenses, *pose_names(estimate.cameras[1].name))


def points_seen(estimate: Estimate, grid: ImageGrid) -> list[FloatArray]:
    """Points of each camera's pixels, in the rig's frame."""
    return [
        estimate.cam_from_rig[i].inverse
        @ (DISTANCES[i] * unproject(camera, grid.pixels[grid.camera == i]))
        for i, camera in enumerate(estimate.cameras)
    ]


def pixels(estimate: Estimate, points: list[FloatArray]) -> FloatArray:
    views = zip(estimate.cameras, estimate.cam_from_rig, points, strict=True)
    return np.concatenate([project(camera, placed @ seen) for camera, placed, seen in views])


def moved(estimate: Estimate, full_name: str, step: float) -> Estimate:
    camera, name = full_name.split(".")
    index = [one.name for one in estimate.cameras].index(camera)
    cameras, placed = list(estimate.cameras), list(estimate.cam_from_rig)
    along = step * np.eye(3)["xyz".index(name[-1])] if name[-1] in "xyz" else np.zeros(3)
    if name.startswith("rotation_"):
        turned = exp_rotation(along) @ placed[index].rotation
        placed[index] = replace(placed[index], rotation=turned)
    elif name.startswith("translation_"):
        placed[index] = replace(placed[index], translation=placed[index].translation + along)
    else:
        params = cameras[index].params.copy()
        params[cameras[index].names.index(name)] += step
        cameras[index] = replace(cameras[index], params=params)
    return replace(estimate, cameras=tuple(cameras), cam_from_rig=tuple(placed))


@pytest.mark.parametrize("lens", ["radtan", "kannala_brandt"])
def test_derivatives_by_calibration_are_those_of_pixels(lens: LensName) -> None:
    estimate = rig(lens)
    grid = image_grid(estimate, names_of(estimate), DISTANCES)
    points = points_seen(estimate, grid)
    for column, name in enumerate(grid.names):
        step = 1e-3 if name[-1] in "xy" and "_" not in name else 1e-6
        ahead, back = (pixels(moved(estimate, name, s), points) for s in (step, -step))
        numeric = (ahead - back) / (2 * step)
        np.testing.assert_allclose(grid.by_calibration[:, :, column], numeric, rtol=1e-4, atol=1e-3)


def test_derivatives_by_rotation_turn_the_points_about_the_rigs_axes() -> None:
    estimate = rig()
    grid = image_grid(estimate, (), DISTANCES)
    points = points_seen(estimate, grid)
    for axis in range(3):
        turn = Transform.exp(1e-6 * np.eye(3)[axis], np.zeros(3))
        ahead = pixels(estimate, [turn @ one for one in points])
        back = pixels(estimate, [turn.inverse @ one for one in points])
        np.testing.assert_allclose(grid.by_rotation[:, :, axis], (ahead - back) / 2e-6, rtol=1e-5)


def test_what_a_turn_of_the_rig_undoes_is_settled() -> None:
    estimate = rig()
    grid = image_grid(estimate, names_of(estimate), DISTANCES)
    # turned by as much against the rig's own turn, both cameras' pixels stay where they are
    turned = replace(grid, names=("x", "y", "z"), by_calibration=-grid.by_rotation)
    assert np.abs(turned.settled).max() < 1e-9 * np.abs(grid.by_rotation).max()
    # what is left is across every turn, and never larger
    left = np.einsum("nij,nik->jk", grid.by_rotation, grid.settled)
    assert np.abs(left).max() < 1e-9 * np.abs(grid.by_rotation).max() ** 2 * len(grid.camera)
    whole, rest = ((g**2).sum((0, 1)) for g in (grid.by_calibration, grid.settled))
    assert (rest <= whole * (1 + 1e-12)).all()


def test_a_principal_point_is_mostly_undone_by_a_turn_and_a_focal_length_is_not() -> None:
    estimate = small_problem("radial", cameras=1)[1]
    name = estimate.cameras[0].name
    grid = image_grid(estimate, (f"{name}.cx", f"{name}.fx"), (5.0,))
    whole, rest = (np.sqrt((g**2).sum(1).mean(0)) for g in (grid.by_calibration, grid.settled))
    assert whole[0] == pytest.approx(1)
    assert rest[0] < 0.3
    assert rest[1] > 0.9 * whole[1]


def test_parameters_that_are_not_named_are_held_and_of_other_cameras_do_nothing() -> None:
    estimate = rig()
    first, second = (camera.name for camera in estimate.cameras)
    names = (f"{second}.k1", f"{first}.cy")
    grid = image_grid(estimate, names, DISTANCES)
    assert grid.by_calibration.shape == (2 * GRID[0] * GRID[1], 2, 2)
    assert not grid.by_calibration[grid.camera == 0, :, 0].any()
    assert not grid.by_calibration[grid.camera == 1, :, 1].any()
    one = image_grid(estimate, names, DISTANCES, cameras=[1], shape=(5, 4))
    assert len(one.pixels) == 20 and (one.camera == 1).all()


def test_of_points_at_infinity_translations_do_not_matter() -> None:
    estimate = rig()
    names = pose_names(estimate.cameras[1].name)
    near = image_grid(estimate, names, DISTANCES)
    far = image_grid(estimate, names, (np.inf, np.inf))
    assert np.abs(near.by_calibration[..., 3:]).max() > 10
    assert np.abs(far.by_calibration[..., 3:]).max() < 1e-2
    assert np.isfinite(far.settled).all()


def test_nothing_moves_where_everything_is_held() -> None:
    assert image_grid(rig(), (), DISTANCES).settled.shape == (2 * GRID[0] * GRID[1], 2, 0)


def test_the_centre_and_the_corners_of_each_image() -> None:
    estimate = rig()
    grid = image_grid(estimate, (), DISTANCES)
    for index, camera in enumerate(estimate.cameras):
        found = grid.pixels[corners(grid, index, camera.size)]
        width, height = camera.size
        wanted = {(x, y) for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)}
        assert {tuple(pixel) for pixel in found.tolist()} == wanted
        middle = centre(grid, index, camera.size)
        assert grid.camera[middle] == index
        step = np.array(camera.size) / GRID
        assert (np.abs(grid.pixels[middle] - (np.array(camera.size) - 1) / 2) < step).all()


def test_pixels_that_the_lens_does_not_know_are_left_out() -> None:
    estimate = small_problem("double_sphere", cameras=1)[1]
    camera = estimate.cameras[0]
    params = camera.params.copy()
    params[:2] /= 4  # a circle of light within the image
    estimate = replace(estimate, cameras=(replace(camera, params=params),))
    grid = image_grid(estimate, (f"{camera.name}.fx",), (5.0,))
    assert 0 < len(grid.pixels) < GRID[0] * GRID[1]
    assert np.isfinite(grid.by_calibration).all()
    assert 1 <= len(corners(grid, 0, camera.size)) <= 4

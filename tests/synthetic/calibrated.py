"""A rig with a covariance as a calibration leaves it, and judges of what follows from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from graphs.camera import project
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform, exp_rotation, log_rotation
from graphs.lenses import LensName
from graphs.problem import Estimate
from graphs.propagation import lens_names, pose_names
from synthetic.cameras import camera_of

HELD = "cam1.p1"


def rig() -> Estimate:
    """Three cameras of three lenses, all looking at what is two to five units ahead."""
    lenses: tuple[LensName, ...] = ("radial", "radtan", "kannala_brandt")
    cameras = tuple(replace(camera_of(lens), name=f"cam{i}") for i, lens in enumerate(lenses))
    cam_from_rig = (
        Transform.identity(),
        Transform.exp(np.array([0.05, -0.2, 0.1]), np.array([-0.6, 0.05, 0.1])),
        Transform.exp(np.array([-0.1, 0.3, 0.2]), np.array([0.5, -0.2, 0.05])),
    )
    frames = (Transform.exp(np.array([0.3, 0.1, -0.2]), np.array([1.0, 2.0, 3.0])),)
    return Estimate(cameras, cam_from_rig, frames, np.array([[0.1, 0.2, 3.0]]))


def covariance_of(estimate: Estimate, size: float = 1.0) -> Covariance:
    """Strongly correlated, of the size of a real calibration's; one coefficient held."""
    names, scale = [], []
    for camera in estimate.cameras:
        names += lens_names(camera)
        scale += [1.0, 1.0, 2.0, 2.0, *[2e-3] * (len(camera.names) - 4)]
    for camera in estimate.cameras[1:]:
        names += pose_names(camera.name)
        scale += [2e-3] * 3 + [4e-3] * 3
    root = np.random.default_rng(3).standard_normal((len(names), 2 * len(names)))
    root[:, 0] += 6.0  # much in common
    root *= size * np.array(scale)[:, None] / np.linalg.norm(root, axis=1, keepdims=True)
    free = [index for index, name in enumerate(names) if name != HELD]
    return Covariance(tuple(names[i] for i in free), root[free] @ root[free].T)


def moved(estimate: Estimate, names: Sequence[str], change: FloatArray) -> Estimate:
    """The estimate with named parameters changed, written once more from the convention."""
    cameras, transforms_ = list(estimate.cameras), list(estimate.cam_from_rig)
    index = {camera.name: i for i, camera in enumerate(cameras)}
    turn = np.zeros((len(cameras), 3))
    for full_name, value in zip(names, change, strict=True):
        camera, name = full_name.split(".")
        i = index[camera]
        if name.startswith("rotation_"):
            turn[i, "xyz".index(name[-1])] += value
        elif name.startswith("translation_"):
            step = value * np.eye(3)["xyz".index(name[-1])]
            transforms_[i] = replace(transforms_[i], translation=transforms_[i].translation + step)
        else:
            params = cameras[i].params.copy()
            params[cameras[i].names.index(name)] += value
            cameras[i] = replace(cameras[i], params=params)
    turned = [
        replace(t, rotation=exp_rotation(one) @ t.rotation)
        for one, t in zip(turn, transforms_, strict=True)
    ]
    return replace(estimate, cameras=tuple(cameras), cam_from_rig=tuple(turned))


def numeric(
    covariance: Covariance, estimate: Estimate, of: Callable[[Estimate], FloatArray]
) -> FloatArray:
    """J C J' with J by central differences, each parameter by a thousandth of its sigma."""
    steps = 1e-3 * np.sqrt(np.diag(covariance.matrix))
    columns = [
        (of(moved(estimate, [name], [step])) - of(moved(estimate, [name], [-step]))) / (2 * step)
        for name, step in zip(covariance.names, steps, strict=True)
    ]
    jacobian = np.stack(columns, axis=-1)
    return jacobian @ covariance.matrix @ jacobian.mT


def assert_same(ours: FloatArray, expected: FloatArray, tolerance: float = 1e-6) -> None:
    """Each entry, relative to the sigmas of its row and column."""
    sigma = np.sqrt(np.diagonal(expected, axis1=-2, axis2=-1))
    assert (sigma > 0).all()
    apart = np.abs(ours - expected) / (sigma[..., :, None] * sigma[..., None, :])
    assert apart.max() < tolerance


def assert_equal(ours: Covariance, expected: Covariance) -> None:
    assert ours.names == expected.names
    assert_same(ours.matrix, expected.matrix, 1e-9)


def shuffled(covariance: Covariance) -> Covariance:
    order = np.random.default_rng(8).permutation(len(covariance.names))
    names = tuple(covariance.names[i] for i in order)
    return Covariance(names, covariance.matrix[np.ix_(order, order)])


def change_of(before: Transform, after: Transform) -> FloatArray:
    turn = log_rotation(after.rotation @ before.rotation.T)
    return np.concatenate([turn, after.translation - before.translation])


def points_of_rig(count: int = 12) -> FloatArray:
    rng = np.random.default_rng(1)
    return rng.uniform([-0.6, -0.5, 2.0], [0.6, 0.5, 5.0], (count, 3))


def draws(covariance: Covariance, count: int) -> FloatArray:
    values, vectors_ = np.linalg.eigh(covariance.matrix)
    root = vectors_ * np.sqrt(np.maximum(values, 0))
    return np.random.default_rng(4).standard_normal((count, len(root))) @ root.T


def assert_drawn_from(sample: FloatArray, cov: FloatArray) -> None:
    """A whitened sample covariance of n differs from I by sqrt(2 / n) and 1 / sqrt(n): 5 of it."""
    white = np.linalg.solve(np.linalg.cholesky(cov), (sample - sample.mean(0)).T)
    apart = white @ white.T / (len(sample) - 1) - np.eye(len(cov))
    assert np.abs(apart).max() < 5 * np.sqrt(2 / len(sample))


def pixels_of(estimate: Estimate, cameras: Sequence[int], points: FloatArray) -> FloatArray:
    seen = [project(estimate.cameras[c], estimate.cam_from_rig[c] @ points) for c in cameras]
    return np.stack(seen, axis=-2)

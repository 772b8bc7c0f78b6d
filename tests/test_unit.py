"""The unit of length of a scan without one: the rig's longest baseline."""

from __future__ import annotations

import numpy as np
import pytest

from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate
from graphs.unit import baseline_unit, in_unit_baseline
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks


def unit_rig() -> tuple[Estimate, Covariance]:
    options = TrackOptions(rig="triple", frames=6, points=900, max_points_per_image=60)
    estimate = simulate_tracks(options, np.random.default_rng(0))[0].initial
    kinds = [f"{kind}_{axis}" for kind in ("rotation", "translation") for axis in "xyz"]
    names = ["cam1.fx", *(f"cam{i}.{kind}" for i in (1, 2) for kind in kinds)]
    root = np.random.default_rng(0).standard_normal((13, 13))
    return estimate, Covariance(tuple(names), root @ root.T)


@pytest.mark.parametrize("far", [1, 2])
def test_in_unit_baseline_by_finite_differences(far: int) -> None:
    estimate, covariance = unit_rig()

    def reported(change: FloatArray) -> FloatArray:
        """fx, then each camera's turn and translation over the length of `far`'s."""
        moved = [
            Transform(t.rotation, t.translation + change[1 + 6 * i + 3 : 1 + 6 * i + 6])
            for i, t in enumerate(estimate.cam_from_rig[1:])
        ]
        length = np.linalg.norm(moved[far - 1].translation)
        parts = [
            np.concatenate([change[1 + 6 * i : 4 + 6 * i], t.translation / length])
            for i, t in enumerate(moved)
        ]
        return np.concatenate([change[:1], *parts])

    step = 1e-6
    jacobian = np.stack(
        [(reported(d) - reported(-d)) / (2 * step) for d in step * np.eye(13)], axis=1
    )
    expected = jacobian @ covariance.matrix @ jacobian.T
    ours = in_unit_baseline(covariance, estimate, far)
    assert ours.names == covariance.names
    np.testing.assert_allclose(ours.matrix, expected, rtol=1e-6, atol=1e-6)
    along = np.zeros(13)
    along[1 + 6 * (far - 1) + 3 : 1 + 6 * far] = estimate.cam_from_rig[far].translation
    assert along @ ours.matrix @ along == pytest.approx(0, abs=1e-9)


def test_the_farthest_camera_gives_the_unit_when_it_is_determined() -> None:
    estimate, covariance = unit_rig()
    lengths = [float(np.linalg.norm(t.translation)) for t in estimate.cam_from_rig]
    far = int(np.argmax(lengths))
    places = [i for i, name in enumerate(covariance.names) if f"cam{far}.translation" in name]
    exact, vague = np.eye(13), np.eye(13)
    exact[places, places] = (lengths[far] / 20) ** 2 / 3
    vague[places, places] = (lengths[far] / 5) ** 2 / 3
    assert baseline_unit(estimate, 0, Covariance(covariance.names, exact)) == far
    assert baseline_unit(estimate, 0, Covariance(covariance.names, vague)) is None

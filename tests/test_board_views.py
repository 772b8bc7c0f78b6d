"""Simulated views of a board: held as the options say, and calibrated to the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from graphs.camera import project
from graphs.frames import Transform
from graphs.jackknife import change
from sfm_calib.boards.spec import Checkerboard
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.simulate.board_views import (
    BACK_DEG,
    BoardViewOptions,
    SimulatedBoards,
    calibrate_views,
    simulate_boards,
    visible,
)
from sfm_calib.simulate.rigs import SimulatedRig

EXACT = BoardViewOptions(views=10, sigma_px=0.0)


def simulated(seed: int = 0, **changes: object) -> SimulatedBoards:
    options = BoardViewOptions(**(EXACT.model_dump() | changes))
    return simulate_boards(options, np.random.default_rng(seed))


@settings(max_examples=20, deadline=None)
@given(low=st.floats(0, 50), wide=st.floats(0, 20), seed=st.integers(0, 99))
def test_boards_are_tilted_and_as_far_away_as_asked(low: float, wide: float, seed: int) -> None:
    found = simulated(seed, tilt_deg=(low, low + wide), distance_m=(0.4, 0.5), least_seen=0.2)
    corners = found.truth.points[:54]
    for cam_from_board in found.truth.rig_from_world:
        tilt_deg = np.degrees(np.arccos(np.clip(cam_from_board.rotation[2, 2], -1, 1)))
        assert low - 1e-4 <= tilt_deg <= low + wide + 1e-4
        middle = cam_from_board @ ((corners.min(0) + corners.max(0)) / 2)
        assert 0.3999 <= np.linalg.norm(middle) <= 0.5001


def test_coverage_takes_the_board_from_the_centre_to_the_border() -> None:
    centred, anywhere = simulated(coverage=0.0), simulated(coverage=1.0)
    camera = centred.truth.cameras[0]
    middle = (centred.truth.points[:54].min(0) + centred.truth.points[:54].max(0)) / 2
    for placed in centred.truth.rig_from_world:
        assert np.allclose(project(camera, (placed @ middle)[None])[0], camera.centre, atol=1e-6)
    assert all(len(view.corner) == 54 for view in centred.views.views)
    cut = [len(view.corner) for view in anywhere.views.views]
    assert min(cut) < 54
    assert min(cut) >= 27  # half of them, as least_seen has it
    assert all(len(view.corner) == 54 for view in simulated(least_seen=1.0).views.views)


def test_views_hold_the_projections_of_the_truth() -> None:
    found = simulated(rig="stereo")
    assert {view.camera for view in found.views.views} == {0, 1}
    for view in found.views.views:
        truth = found.truth
        placed = truth.cam_from_rig[view.camera] @ truth.rig_from_world[view.frame]
        at = project(truth.cameras[view.camera], placed @ truth.points[view.corner])
        assert np.allclose(at, view.pixels, atol=1e-9)


def test_noise_is_as_large_as_asked_and_outliers_as_many() -> None:
    exact = simulated(views=40)
    assert all(
        np.array_equal(a.pixels, b.pixels)
        for a, b in zip(exact.views.views, simulated(views=40).views.views, strict=True)
    )
    noisy = simulated(views=40, sigma_px=0.3)
    truth = noisy.truth
    error = np.concatenate([
        view.pixels - project(truth.cameras[0], truth.rig_from_world[view.frame]
                              @ truth.points[view.corner])
        for view in noisy.views.views
    ])  # fmt: skip
    assert error.std() == pytest.approx(0.3, rel=0.05)
    wild = simulated(views=40, outlier_share=0.1)
    moved = np.concatenate([
        (a.pixels != b.pixels).any(1)
        for a, b in zip(exact.views.views, wild.views.views, strict=True)
    ])  # fmt: skip
    assert moved.mean() == pytest.approx(0.1, abs=0.001)


def test_a_board_shows_no_camera_its_back() -> None:
    found = simulated()
    rig = SimulatedRig(found.truth.cameras, found.truth.cam_from_rig)
    corners, placed = found.truth.points[:54], found.truth.rig_from_world[0]
    assert visible(rig, 0, placed, corners)[1].any()
    middle = (corners.min(0) + corners.max(0)) / 2
    turned = placed.rotation @ np.diag([1.0, -1.0, -1.0])
    from_behind = Transform(turned, placed @ middle - turned @ middle)
    assert not visible(rig, 0, from_behind, corners)[1].any()


def test_a_board_is_as_wrong_as_its_description_believes() -> None:
    board = Checkerboard(inner_corners=(9, 6), square_m=0.03)
    shapes = np.array([
        simulate_boards(BoardViewOptions(views=1), np.random.default_rng(seed), board=board)
        .truth.board_shape for seed in range(30)
    ])  # fmt: skip
    assert shapes[:, 0].std() == pytest.approx(board.relative_sigma, rel=0.5)
    assert shapes[:, 3:].std() == pytest.approx(board.misprint_m, rel=0.05)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"distance_m": (0.05, 0.06)}, "hold it farther away"),
        ({"rig": "quad", "lens": "radtan", "together": ((0, 2),)}, "cam0 and cam2"),
    ],
)
def test_what_no_camera_can_see_is_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        simulated(**changes)


@pytest.mark.parametrize(
    "changes",
    [{"tilt_deg": (40, 20)}, {"tilt_deg": (0, BACK_DEG + 1)}, {"distance_m": (0, 1)}, {"tilt": 1}],
)
def test_impossible_options_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        BoardViewOptions(**changes)


def test_views_calibrate_to_the_truth_from_nothing() -> None:
    found = simulated(rig="stereo", views=12, sigma_px=0.1, outlier_share=0.02)
    got = calibrate_views(found.views, found.board, RigConfig(lens="radtan"))
    assert got.covariance.names[0] == "cam0.fx"
    z = change(found.truth, got.estimate, got.covariance.names) / list(
        got.covariance.sigma.values()
    )
    assert np.abs(z).max() < 5
    assert got.covariance.sigma["cam0.fx"] < 2.0

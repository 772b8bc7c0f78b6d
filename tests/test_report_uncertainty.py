"""The report's pixels and depths: of one camera, of rigs, of pairs that share no view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.calibrated import covariance_of

from graphs.camera import Camera
from graphs.covariance import Covariance
from graphs.frames import Transform
from graphs.problem import Estimate, Observations, Problem
from graphs.uncertainty import projection_maps
from sfm_calib import result
from sfm_calib.report.page import render
from sfm_calib.report.uncertainty import (
    UncertaintySection,
    map_figure,
    typical_range,
    uncertainty_section,
)
from sfm_calib.uncertainty import uncertainty_of

SIGMA_PX = 0.4
TURNS = (0.0, 0.1, np.pi)  # the third looks back


def scene(turns: tuple[float, ...], size: float = 1.0) -> tuple[Problem, Estimate]:
    """Cameras 0.3 side by side, of which the first sees points at depths of 3 to 5."""
    params = np.array([500.0, 500.0, 320.0, 240.0, -0.1, 0.01])
    cameras = tuple(Camera(f"c{k}", "radial", (640, 480), params) for k in range(len(turns)))
    cam_from_rig = tuple(
        Transform.exp(np.array([0.0, turn, 0.0]), np.zeros(3))
        @ Transform(np.eye(3), size * np.array([-0.3 * k, 0.0, 0.0]))
        for k, turn in enumerate(turns)
    )
    points = size * np.random.default_rng(0).uniform([-1, -1, 3], [1, 1, 5], (40, 3))
    estimate = Estimate(cameras, cam_from_rig, (Transform.identity(),), points)
    index = np.arange(40)
    seen = Observations(np.full((40, 2), 300.0), 0 * index, 0 * index, index)
    return Problem(estimate, seen, ("frame",)), estimate


def stated(
    estimate: Estimate,
    covariance: Covariance,
    metric: bool = True,
    sigma_px: float | None = SIGMA_PX,
) -> result.Calibration:
    exact = result.truth(list(estimate.cameras), list(estimate.cam_from_rig), "0")
    matrix = tuple(map(tuple, covariance.matrix.tolist()))
    return exact.model_copy(
        update={
            "rig": exact.rig.model_copy(update={"metric": metric}),
            "covariance": result.Covariance(names=covariance.names, matrix=matrix),
            "noise": None if sigma_px is None else result.Noise(sigma_px=sigma_px),
        }
    )


def section(
    turns: tuple[float, ...], size: float = 1.0, spread: float = 0.05, **given: object
) -> UncertaintySection:
    problem, estimate = scene(turns, size)
    calibration = stated(estimate, covariance_of(estimate, spread), **given)
    return uncertainty_section(calibration, problem, estimate)


def titles(of: UncertaintySection) -> list[str]:
    return [panel.title for panel in of.maps]


def test_a_rig_with_a_camera_that_looks_back() -> None:
    shown = section(TURNS)
    assert shown.is_rig and shown.unit == "m"
    assert titles(shown)[:2] == ["c0: the lens alone", "c0: in the rig, at 4.3 m"]
    assert len(shown.maps) == 6 and "px in the worst corner" in shown.maps[0].caption
    (curve,) = shown.curves
    assert curve.title == "c0 and c1, 0.3 m apart" and "depth-0-1" in curve.figure
    assert shown.remarks == ("No common view, hence no depth: c0 and c2; c1 and c2.",)
    assert [row.range for row in shown.depth_rows] == ["1", "2", "5", "10"]
    assert {row.pair for row in shown.depth_rows} == {"c0 and c1"}
    assert [row.what for row in shown.rows[:3]] == [
        "the lens alone", "in the rig, at 1 m", "in the rig, at 2 m"
    ]  # fmt: skip


def test_a_rig_without_scale_counts_in_baselines() -> None:
    shown = section(TURNS[:2], size=1 / 0.3, metric=False)
    assert shown.unit == "baselines" and titles(shown)[1] == "c0: in the rig, at 14 baselines"
    assert [panel.title for panel in shown.curves] == ["c0 and c1"]
    assert [row.range for row in shown.depth_rows] == ["5", "10", "20", "50"]


def test_a_rig_without_any_unit_tells_directions() -> None:
    shown = section(TURNS[:2], metric=False)
    assert titles(shown)[1] == "c0: in the rig, at infinity"
    assert not shown.curves and not shown.depth_rows
    assert shown.remarks == (
        "This result states no unit of length: nothing can be said of depths.",
    )
    (remark,) = section(TURNS[:2], sigma_px=None).remarks
    assert "states no noise" in remark


def test_one_camera_has_no_depths() -> None:
    shown = section(TURNS[:1])
    assert not shown.is_rig and titles(shown) == ["c0: the lens alone"]
    assert not shown.curves and not shown.remarks and len(shown.rows) == 1


def test_depths_that_nothing_determines_are_said() -> None:
    shown = section(TURNS[:2], spread=300.0)
    assert not shown.curves
    assert shown.remarks == ("A common view, but no depth is determined: c0 and c1.",)
    assert {row.missing for row in shown.depth_rows} == {"not determined"}
    (curve,) = section(TURNS[:2], spread=3.0).curves
    assert "Beyond about" in curve.caption and "not determined" in curve.caption
    assert "calibration is the larger part everywhere" in curve.caption
    (quiet,) = section(TURNS[:2], spread=0.1).curves
    assert "Up to about" in quiet.caption
    (noisy,) = section(TURNS[:2], spread=1e-6).curves
    assert "noise of one measurement is the larger part everywhere" in noisy.caption


def test_the_tables_say_what_the_file_says() -> None:
    """Whatever the covariance would give now."""
    problem, estimate = scene(TURNS[:2])
    covariance = covariance_of(estimate, 0.05)
    record = uncertainty_of(estimate, covariance, SIGMA_PX, "m")
    pair = record.depth[0]
    depth = (result.DepthSigma(range=7, sigma_noise=0.3, sigma_calibration=0.4),)
    other = record.model_copy(update={"depth": (pair.model_copy(update={"depth": depth}),)})
    calibration = stated(estimate, covariance).model_copy(update={"uncertainty": other})
    (row,) = uncertainty_section(calibration, problem, estimate).depth_rows
    assert (row.range, row.noise, row.calibration, row.total, row.percent) == (
        "7", "0.30", "0.40", "0.50", "7.1"
    )  # fmt: skip


@pytest.mark.parametrize("turns", [TURNS, TURNS[:1]])
def test_everything_held_is_a_page_too(turns: tuple[float, ...]) -> None:
    problem, estimate = scene(turns)
    covariance = Covariance(("c0.fx",), np.zeros((1, 1)))
    calibration = stated(estimate, covariance)
    assert 'id="camera-0-sigma-camera"' in render(calibration, problem, estimate)
    (found,) = projection_maps(replace(estimate, cameras=estimate.cameras[:1]), covariance)
    figure = map_figure(found, estimate, 1.0)
    assert figure.data[0].zmax == 1.0 and not np.any(figure.data[0].z)


def test_the_typical_range_is_that_of_the_observed_points() -> None:
    problem, estimate = scene(TURNS)
    expected = np.median(np.linalg.norm(estimate.points, axis=1))
    assert typical_range(problem, estimate) == pytest.approx(expected)
    nothing = problem.observations.subset(np.zeros(40, dtype=bool))
    assert typical_range(replace(problem, observations=nothing), estimate) == np.inf

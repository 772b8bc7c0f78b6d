"""Boards in the graph: the same variables, rows that are right, and what they determine."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from synthetic.boards import flat_board, waved
from synthetic.problems import small_problem

from graphs.board_problem import SeenCorners, beside, standing_in
from graphs.boards import corners_of
from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import project
from graphs.clusters import homogeneous
from graphs.factors import factor_graph
from graphs.frames import FloatArray, Transform
from graphs.jackknife import change
from graphs.keys import board_key, frame_key, lens_key, rig_key, shape_key
from graphs.model_covariance import model_covariance
from graphs.problem import Estimate, Problem
from graphs.refine import refine
from graphs.solve import solve
from graphs.stated_covariance import calibration_covariance
from graphs.system import assemble
from graphs.threads import threads
from graphs.tracks import triangulate

SIGMA_PX = 0.2


def still_board(
    noise_px: float = SIGMA_PX, shape: FloatArray | None = None
) -> tuple[Problem, Estimate]:
    """A rig that passes a board among the points of a scene, and the truth."""
    problem, truth = small_problem(
        "radtan", cameras=2, frames=5, points=60, sigma_px=noise_px, start_error=0.0
    )
    rng = np.random.default_rng(3)
    board = flat_board((1e-3, 1e-3, 1e-3))
    board = replace(board, corners=board.corners * 20)  # 4.2 m wide, 5 m ahead
    shape = np.zeros(3) if shape is None else shape
    world_from_board = Transform.exp(np.array([0.3, -0.2, 0.4]), np.array([-1.0, -1.0, 5.0]))
    places = world_from_board @ corners_of(board, shape)[0]
    pixels, frames, cameras, corners = [], [], [], []
    for frame, placed in enumerate(truth.rig_from_world):
        for index, (lens, to_camera) in enumerate(
            zip(truth.cameras, truth.cam_from_rig, strict=True)
        ):
            at = project(lens, to_camera @ (placed @ places))
            inside = np.flatnonzero(((at > 0) & (at < np.array(lens.size) - 1)).all(1))
            pixels.append(at[inside] + noise_px * rng.standard_normal((len(inside), 2)))
            frames.append(np.full(len(inside), frame))
            cameras.append(np.full(len(inside), index))
            corners.append(inside)
    seen = SeenCorners(
        np.concatenate(pixels), np.concatenate(frames), np.concatenate(cameras),
        np.concatenate(corners), np.ones(sum(map(len, corners))),
    )  # fmt: skip
    return standing_in(problem, board, seen, world_from_board), truth


def test_rows_are_those_of_finite_differences() -> None:
    """The gradient of the whole cost by every variable, a bent board standing in a scene."""
    problem, _ = still_board()
    bent = replace(problem.initial, board_shape=np.array([0.001, 0.02, -0.05]))
    graph = build(replace(problem, initial=bent), GraphOptions(SIGMA_PX, "cauchy", 2.5))
    start, values = homogeneous(graph.tracks, problem.initial.points), graph.initial
    with threads() as pool:

        def cost(at: gtsam.Values) -> float:
            tracks = triangulate(graph.tracks, graph.variables(at), start, pool, 1e-15)[1]
            return float(tracks + graph.others.error(at))

        points, _ = triangulate(graph.tracks, graph.variables(values), start, pool, 1e-15)
        others = graph.others.linearize(values)
        system = assemble(graph.tracks, others, graph.layout, graph.variables(values), points, pool)
        for key in (board_key(), shape_key(), lens_key(0), rig_key(1), frame_key(2)):
            columns = graph.layout.columns(key)
            # the step that moves pixels alike, however much a unit of a variable does
            steps = 1e-3 / np.sqrt(system.diagonal[columns])
            for column, step in zip(columns, steps, strict=True):
                ends = []
                for sign in (1, -1):
                    by = np.zeros(len(system.gradient))
                    by[column] = sign * step
                    ends.append(cost(values.retract(vector_values(graph, by))))
                numeric = (ends[0] - ends[1]) / 2
                assert system.gradient[column] * step == pytest.approx(numeric, rel=1e-3, abs=1e-6)


def vector_values(graph: CalibrationGraph, change: FloatArray) -> gtsam.VectorValues:
    """A change (n_columns,) of all variables as GTSAM takes it."""
    delta = gtsam.VectorValues()
    for key in graph.layout.first_column:
        delta.insert(key, change[graph.layout.columns(key)])
    return delta


@pytest.mark.parametrize("which", ["waved", "still"])
def test_gtsam_finds_the_same_marginals(which: str) -> None:
    """One Jacobian, factorised by GTSAM on its own factors, and by us."""
    if which == "waved":
        problem, _ = waved(
            np.random.default_rng(0), 5, SIGMA_PX, board=flat_board((1e-3, 1e-3, 1e-3))
        )
    else:
        problem, _ = still_board()
    graph = build(problem, GraphOptions(SIGMA_PX, "none", np.inf))
    estimate, values, summary = solve(graph)
    assert summary.converged
    factors = factor_graph(graph)
    assert factors.error(values) == pytest.approx(summary.cost, rel=1e-9)
    marginals = gtsam.Marginals(factors, values)
    ours = model_covariance(graph, estimate, values)
    sigma = ours.covariance.sigma
    share = ours.moments.score_variance / ours.moments.curvature
    for index, camera in enumerate(estimate.cameras):
        theirs = np.sqrt(np.diag(marginals.marginalCovariance(lens_key(index))))
        mine = np.array([sigma[f"{camera.name}.{name}"] for name in camera.names])
        np.testing.assert_allclose(mine / theirs, share**0.5, rtol=0.02)


def test_a_waved_board_gives_lenses_and_a_metric_rig() -> None:
    problem, truth = waved(np.random.default_rng(1), 12, SIGMA_PX)
    off = tuple(
        replace(camera, params=camera.params * np.array([1.05, 0.97, 1, 1, 0, 0, 0, 0]))
        for camera in truth.cameras
    )
    problem = replace(problem, initial=replace(problem.initial, cameras=off))
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, 1.0)
    error = change(truth, found.estimate, covariance.basis.names)
    sigma = np.array([covariance.stated.sigma[name] for name in covariance.basis.names])
    assert np.abs(error / sigma).max() < 4.5
    assert covariance.basis.unit_camera is None  # metres
    assert found.sigma_px == pytest.approx(SIGMA_PX, rel=0.1)
    assert 1.0 <= covariance.inflation < 1.2


def test_the_size_of_the_squares_is_as_uncertain_as_it_is_said_to_be() -> None:
    problem, _ = waved(np.random.default_rng(1), 12, 0.02, board=flat_board((5e-3, 0.0, 0.0)))
    found = refine(problem, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, 1.0)
    baseline = np.linalg.norm(found.estimate.cam_from_rig[1].translation)
    sigma = covariance.stated.sigma["right.translation_x"]
    assert sigma == pytest.approx(5e-3 * baseline, rel=0.05)


def test_a_bent_board_is_found_to_be_bent() -> None:
    shape = np.array([0.0, 1.5e-3, -0.8e-3])
    problem, truth = waved(
        np.random.default_rng(2),
        15,
        0.1,
        board=flat_board((1e-3, 1e-2, 1e-2)),
        shape=shape.tolist(),
    )
    found = refine(problem, GraphOptions(), 1.0)
    assert found.estimate.board_shape is not None
    np.testing.assert_allclose(found.estimate.board_shape[1:], shape[1:], atol=1e-4)
    assert problem.board is not None
    flat = refine(
        replace(problem, board=replace(problem.board, board=flat_board())), GraphOptions(), 1.0
    )
    assert flat.sigma_px > 1.3 * found.sigma_px
    assert abs(truth.cameras[0].params[0] - found.estimate.cameras[0].params[0]) < 2


def test_boards_beside_a_scan_make_it_metric_and_surer() -> None:
    scan, truth = small_problem(
        "radtan", cameras=2, frames=5, points=60, sigma_px=SIGMA_PX, start_error=0.0
    )
    alone = refine(scan, GraphOptions(), 1.0)
    before = calibration_covariance(alone.graph, alone.estimate, alone.values, 1.0)
    boards, _ = waved(
        np.random.default_rng(4), 3, SIGMA_PX, truth.cameras, truth.cam_from_rig,
        board=replace(flat_board(), corners=4 * flat_board().corners),
    )  # fmt: skip
    joint = refine(beside(scan, boards), GraphOptions(), 1.0)
    after = calibration_covariance(joint.graph, joint.estimate, joint.values, 1.0)
    assert not scan.metric and joint.problem.metric
    assert after.basis.unit_camera is None
    for name in before.stated.sigma:
        if name.split(".")[1] in ("fx", "fy", "cx", "cy"):
            assert after.stated.sigma[name] < before.stated.sigma[name]
    error = change(truth, joint.estimate, after.basis.names)
    sigma = np.array([after.stated.sigma[name] for name in after.basis.names])
    assert np.abs(error / sigma).max() < 4.5
    kinds = {(one.camera, one.of_board) for one in joint.noise}
    assert kinds == {(0, False), (0, True), (1, False), (1, True)}


def test_a_board_that_stands_in_the_scene_makes_it_metric() -> None:
    problem, truth = still_board()
    assert problem.metric and not problem.board_frames.any()
    smaller = replace(problem, initial=problem.initial.scaled(1.02))
    found = refine(smaller, GraphOptions(), 1.0)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, 1.0)
    error = change(truth, found.estimate, covariance.basis.names)
    sigma = np.array([covariance.stated.sigma[name] for name in covariance.basis.names])
    assert np.abs(error / sigma).max() < 4.5

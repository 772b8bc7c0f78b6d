"""The reference graph against three independent judges: a dense inverse, gtsam.Marginals, COLMAP.

All on problems small enough to invert whole. Priors are as good as absent wherever the judge has
none, so that nothing but the observations and the loss is compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pycolmap
import pytest
from scipy.linalg import block_diag

from graphs.build import NO_KNOWLEDGE, CalibrationGraph, GraphOptions, LossName, build
from graphs.covariance import CalibrationCovariance, calibration_covariance
from graphs.frames import FloatArray, Transform, angle_between, log_rotation
from graphs.keys import lens_key, rig_key
from graphs.lenses import LENS_NAMES, LensName
from graphs.priors import LensPrior
from graphs.problem import Estimate, IntArray, Problem, residuals_px
from graphs.reference import native_slots
from graphs.solve import SolveSummary, solve
from sfm_calib.colmap import EXACT_MODEL, colmap_camera, parameter_names
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
SMALL = TrackOptions(
    rig="triple", frames=8, points=150, max_points_per_image=60, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
    baseline_sigma_m=0, outlier_share=0.02, outlier_kind="heavy",
)  # fmt: skip
LOSSES: tuple[LossName, ...] = ("none", "cauchy")
JUDGED_LENSES: tuple[LensName, ...] = ("pinhole", "radtan", "kannala_brandt")


@dataclass(frozen=True)
class Solved:
    graph: CalibrationGraph
    estimate: Estimate
    values: gtsam.Values
    summary: SolveSummary
    covariance: CalibrationCovariance


def no_knowledge(problem: Problem) -> tuple[LensPrior, ...]:
    """Priors so weak that they move nothing by 1e-6 of its sigma."""
    return tuple(
        LensPrior(c.params.copy(), np.full(c.params.size, NO_KNOWLEDGE))
        for c in problem.initial.cameras
    )


@cache
def solved(lens: LensName, loss: LossName, weak: bool = False) -> Solved:
    """The optimum of a small scan; `weak` keeps the priors that a calibration has."""
    problem, _ = simulate_tracks(SMALL.model_copy(update={"lens": lens}), np.random.default_rng(20))
    priors = () if weak else no_knowledge(problem)
    graph = build(problem, GraphOptions(SIGMA_PX, loss, lens_priors=priors))
    estimate, values, summary = solve(graph, relative_tolerance=1e-14)
    assert summary.converged
    return Solved(graph, estimate, values, summary, calibration_covariance(graph, estimate, values))


# ---- the optimum, judged by COLMAP ---------------------------------------------------------

COLMAP_LOSS = {"none": "TRIVIAL", "cauchy": "CAUCHY"}


def rigid(b_from_a: Transform) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(b_from_a.rotation), b_from_a.translation)


def reconstruction_of(problem: Problem, start: Estimate) -> pycolmap.Reconstruction:
    """The same rig, frames, points and observations for COLMAP; its ids count from one."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    sensors = []
    for index, camera in enumerate(start.cameras):
        colmap = colmap_camera(camera, EXACT_MODEL[camera.lens], index + 1)
        model.add_camera(colmap)
        sensors.append(colmap.sensor_id)
        if index == problem.reference:
            rig.add_ref_sensor(colmap.sensor_id)
        else:
            rig.add_sensor(colmap.sensor_id, rigid(start.cam_from_rig[index]))
    model.add_rig(rig)
    seen, n_cameras = problem.observations, len(start.cameras)
    rows = {
        (f, c): np.flatnonzero((seen.frame == f) & (seen.camera == c))
        for f in range(len(start.rig_from_world))
        for c in range(n_cameras)
    }
    for f, rig_from_world in enumerate(start.rig_from_world):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        for c in range(n_cameras):
            frame.add_data_id(pycolmap.data_t(sensors[c], f * n_cameras + c + 1))
        frame.rig_from_world = rigid(rig_from_world)
        model.add_frame(frame)
    for (f, c), own in rows.items():
        image = pycolmap.Image(
            name=f"{c}/{f}",
            keypoints=seen.pixels[own] + 0.5,
            camera_id=c + 1,
            image_id=f * n_cameras + c + 1,
        )
        image.frame_id = f + 1
        model.add_image(image)
    for f in range(len(start.rig_from_world)):
        model.register_frame(f + 1)
    keypoint = {int(row): place for own in rows.values() for place, row in enumerate(own)}
    for point, xyz in enumerate(start.points):
        track = pycolmap.Track()
        for row in np.flatnonzero(seen.point == point).tolist():
            track.add_element(
                int(seen.frame[row]) * n_cameras + int(seen.camera[row]) + 1, keypoint[row]
            )
        model.add_point3D(xyz, track)
    return model


def bundle_adjust(
    problem: Problem, start: Estimate, options: GraphOptions
) -> tuple[Estimate, float]:
    """COLMAP's optimum from `start`, and Ceres's cost in px squared."""
    model = reconstruction_of(problem, start)
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = False
    settings.refine_principal_point = True
    settings.ceres.loss_function_type = pycolmap.LossFunctionType(COLMAP_LOSS[options.loss])
    settings.ceres.loss_function_scale = options.loss_scale * options.sigma_px
    settings.ceres.solver_options.max_num_iterations = 500
    settings.ceres.solver_options.function_tolerance = 0.0
    settings.ceres.solver_options.gradient_tolerance = 1e-10
    settings.ceres.solver_options.parameter_tolerance = 1e-12
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_ceres_bundle_adjuster(settings, config, model).solve()
    assert summary.num_residuals == 2 * len(problem.observations)
    return estimate_of(model, problem), summary.ceres_summary.final_cost


def transform_of(b_from_a: pycolmap.Rigid3d) -> Transform:
    return Transform(b_from_a.rotation.matrix(), np.ravel(b_from_a.translation))


def estimate_of(model: pycolmap.Reconstruction, problem: Problem) -> Estimate:
    cameras, cam_from_rig = [], []
    for index, camera in enumerate(problem.initial.cameras):
        colmap = model.cameras[index + 1]
        named = dict(zip(parameter_names(colmap), colmap.params.tolist(), strict=True))
        named |= {"cx": named["cx"] - 0.5, "cy": named["cy"] - 0.5}
        cameras.append(replace(camera, params=np.array([named[name] for name in camera.names])))
        is_reference = index == problem.reference
        cam_from_rig.append(
            Transform.identity()
            if is_reference
            else transform_of(model.rigs[1].sensor_from_rig(colmap.sensor_id))
        )
    frames = [model.frames[f + 1].rig_from_world for f in range(len(problem.frame_names))]
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    return Estimate(tuple(cameras), tuple(cam_from_rig), tuple(map(transform_of, frames)), points)


def in_baselines(estimate: Estimate) -> Estimate:
    return estimate.scaled(1 / float(np.linalg.norm(estimate.cam_from_rig[1].translation)))


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("lens", JUDGED_LENSES)
def test_the_optimum_is_that_of_colmap(lens: LensName, loss: LossName) -> None:
    """Both from the same start, 1 % off in focal length; every number to 1e-4 of itself."""
    case = solved(lens, loss)
    problem = case.graph.problem
    judge, cost_px2 = bundle_adjust(problem, problem.initial, case.graph.options)
    assert case.summary.cost * SIGMA_PX**2 == pytest.approx(cost_px2, rel=1e-8)
    for ours, theirs in zip(case.estimate.cameras, judge.cameras, strict=True):
        np.testing.assert_allclose(ours.params, theirs.params, rtol=1e-4)
    ours_in_baselines, theirs_in_baselines = in_baselines(case.estimate), in_baselines(judge)
    placed = zip(ours_in_baselines.cam_from_rig, theirs_in_baselines.cam_from_rig, strict=True)
    for index, (ours, theirs) in enumerate(placed):
        if index != problem.reference:
            turn = angle_between(ours.rotation, theirs.rotation)
            assert turn < 1e-4 * np.linalg.norm(log_rotation(theirs.rotation))
            np.testing.assert_allclose(ours.translation, theirs.translation, rtol=1e-4)


# ---- the marginals, judged by a dense inverse and by gtsam.Marginals -----------------------

WIDTHS = {ord("k"): 9, ord("l"): 3, ord("t"): 6, ord("x"): 6}


def calibration_keys(graph: CalibrationGraph) -> list[int]:
    n = len(graph.problem.initial.cameras)
    return [*map(lens_key, range(n)), *(rig_key(i) for i in range(1, n))]


def columns_of(every: list[int], keys: list[int]) -> IntArray:
    starts = np.cumsum([0, *(WIDTHS[gtsam.Symbol(key).chr()] for key in every)])
    return np.concatenate([np.arange(*starts[[i, i + 1]]) for i in map(every.index, keys)])


def to_reported(estimate: Estimate) -> FloatArray:
    """Jacobian from GTSAM's variables at `calibration_keys` to what is reported of them."""
    lenses = [np.eye(9)[native_slots(camera)] for camera in estimate.cameras]
    return block_diag(*lenses, *(numeric_reported(t) for t in estimate.cam_from_rig[1:]))


def numeric_reported(cam_from_rig: Transform) -> FloatArray:
    """d (turn about the camera's axes, translation of cam_from_rig) / d GTSAM's tangent."""
    rotation = cam_from_rig.rotation
    rig_pose_cam = gtsam.Pose3(gtsam.Rot3(rotation.T), -rotation.T @ cam_from_rig.translation)
    jacobian = np.zeros((6, 6))
    step = 1e-6
    for i, direction in enumerate(step * np.eye(6)):
        ends = []
        for move in (direction, -direction):
            moved = rig_pose_cam.retract(move).inverse()
            turn = gtsam.Rot3.Logmap(gtsam.Rot3(moved.rotation().matrix() @ rotation.T))
            ends.append(np.concatenate([turn, moved.translation()]))
        jacobian[:, i] = (ends[0] - ends[1]) / (2 * step)
    return jacobian


def dense_hessian(case: Solved, part: slice, every: list[int]) -> FloatArray:
    """GTSAM's whole Hessian of some of the factors, at the optimum."""
    some = gtsam.NonlinearFactorGraph()
    for i in range(*part.indices(case.graph.factors.size())):
        some.push_back(case.graph.factors.at(i))
    linear = some.linearize(case.values)
    inside = [key for key in every if some.keys().count(key)]
    ordering = gtsam.Ordering()
    for key in inside:
        ordering.push_back(key)
    columns = columns_of(every, inside)
    whole = np.zeros((sum(WIDTHS[gtsam.Symbol(key).chr()] for key in every),) * 2)
    whole[np.ix_(columns, columns)] = linear.hessian(ordering)[0]
    return whole


def hand_made_moments(case: Solved) -> tuple[float, float]:
    """Mean true curvature and mean squared score, over the mean weight of the residuals.

    The loss is differentiated numerically, along the residual and across it.
    """
    problem, k = case.graph.problem, case.graph.options.loss_scale
    n_cameras, n_frames = len(case.estimate.cameras), len(problem.frame_names)
    unknowns = sum(c.params.size for c in case.estimate.cameras) + 6 * (n_cameras - 1 + n_frames)
    unknowns += 3 * len(case.estimate.points) - 7
    share_left = 1 - unknowns / (2 * len(problem.observations))
    r = residuals_px(case.estimate, problem.observations) / SIGMA_PX

    def rho(r: FloatArray) -> FloatArray:
        squared = (r**2).sum(1)
        if case.graph.options.loss == "none":
            return squared / 2
        return k**2 / 2 * np.log1p(squared / k**2)

    h = 1e-4
    x, y = h * np.eye(2)
    gradient = np.stack([(rho(r + d) - rho(r - d)) / (2 * h) for d in (x, y)], 1)
    xx, yy = ((rho(r + d) - 2 * rho(r) + rho(r - d)) / h**2 for d in (x, y))
    xy = (rho(r + x + y) + rho(r - x - y) - rho(r + x - y) - rho(r - x + y)) / (4 * h**2)
    # scatter of one diagonal entry of the curvature, whichever way the axes are turned
    scatter = np.mean((xx + yy) ** 2 / 4 + ((xx - yy) ** 2 / 4 + xy**2) / 2)
    curvature = np.mean(xx + yy) / 2
    huber_k = 1 + (1 - share_left) * (scatter / curvature**2 - 1)
    weight = np.mean((gradient * r).sum(1) / (r**2).sum(1))
    score_variance = huber_k**2 * np.mean(gradient**2) / share_left
    return float(curvature / weight), float(score_variance / weight)


def worst_difference(a: FloatArray, b: FloatArray) -> float:
    """Largest difference of two covariances, in units of the sigmas it belongs to."""
    sigma = np.sqrt(np.diag(b))
    return float(np.abs((a - b) / np.outer(sigma, sigma)).max())


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("lens", LENS_NAMES)
def test_the_model_covariance_is_the_dense_inverse(lens: LensName, loss: LossName) -> None:
    """(c H + P)^-1 (s H + P) (c H + P)^-1, everything inverted whole: all cross-covariances."""
    case = solved(lens, loss, weak=True)
    every = sorted(case.values.keys())
    n = len(case.graph.problem.observations)
    of_data = dense_hessian(case, slice(n), every)
    of_priors = dense_hessian(case, slice(n, None), every)
    curvature, score_variance = hand_made_moments(case)
    bread = curvature * of_data + of_priors
    scale = 1 / np.sqrt(np.diag(bread))
    bread = np.linalg.inv(bread * np.outer(scale, scale)) * np.outer(scale, scale)
    whole = bread @ (score_variance * of_data + of_priors) @ bread
    columns = columns_of(every, calibration_keys(case.graph))
    jacobian = to_reported(case.estimate)
    expected = jacobian @ whole[np.ix_(columns, columns)] @ jacobian.T
    assert worst_difference(case.covariance.model.matrix, expected) < 1e-5


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("lens", LENS_NAMES)
def test_the_model_covariance_is_that_of_gtsam_marginals(lens: LensName, loss: LossName) -> None:
    case = solved(lens, loss)
    keys = calibration_keys(case.graph)
    joint = gtsam.Marginals(case.graph.factors, case.values).jointMarginalCovariance(keys)
    native = np.block([[joint.at(a, b) for b in keys] for a in keys])
    curvature, score_variance = hand_made_moments(case)
    jacobian = to_reported(case.estimate)
    expected = score_variance / curvature**2 * jacobian @ native @ jacobian.T
    assert worst_difference(case.covariance.model.matrix, expected) < 1e-4

"""Our graph, the reference graph of GTSAM's own factors, and judges of both.

The reference is judged by COLMAP and by a dense inverse; it then judges ours: the optimum, every
sigma and every cross-covariance. All on problems small enough to invert whole. Priors are as good
as absent wherever the judge has none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import gtsam
import numpy as np
import pytest
from scipy.linalg import block_diag
from synthetic.bundle_adjustment import bundle_adjust
from synthetic.problems import calibration_of, with_noise

from graphs.build import NO_KNOWLEDGE, CalibrationGraph, GraphOptions, build
from graphs.clusters import homogeneous
from graphs.frames import FloatArray, Transform, angle_between, log_rotation
from graphs.influence import responses
from graphs.keys import lens_key, rig_key
from graphs.lenses import LensName
from graphs.losses import LOSS_NAMES, SCALE_95, LossName
from graphs.model_covariance import calibration_columns
from graphs.priors import LensPrior
from graphs.problem import Estimate, IntArray, Problem, residuals_px
from graphs.reference import (
    NATIVE_LENSES,
    NATIVE_SIZE,
    ReferenceGraph,
    build_reference,
    native_slots,
    native_values,
    reference_estimate,
    solve_reference,
)
from graphs.solve import SolveSummary, evaluate, linearised, solve
from graphs.stated_covariance import CalibrationCovariance, calibration_covariance
from graphs.threads import threads
from graphs.unit import unit_jacobian
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
SMALL = TrackOptions(
    rig="triple", frames=8, points=150, max_points_per_image=60, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
    baseline_sigma_m=0, outlier_share=0.02, outlier_kind="heavy",
)  # fmt: skip
LOSSES: tuple[LossName, ...] = ("none", "cauchy")
JUDGED_LENSES: tuple[LensName, ...] = ("radtan", "kannala_brandt")


@dataclass(frozen=True)
class Solved:
    """Our optimum of a small scan, and the reference's, which starts there."""

    graph: CalibrationGraph
    estimate: Estimate
    values: gtsam.Values
    summary: SolveSummary
    covariance: CalibrationCovariance
    reference: ReferenceGraph
    native: gtsam.Values


def no_knowledge(problem: Problem) -> tuple[LensPrior, ...]:
    """Priors so weak that they move nothing by 1e-6 of its sigma."""
    return tuple(
        LensPrior(c.params.copy(), np.full(c.params.size, NO_KNOWLEDGE))
        for c in problem.initial.cameras
    )


def options_of(loss: LossName, priors: tuple[LensPrior, ...] = ()) -> GraphOptions:
    return GraphOptions(SIGMA_PX, loss, min(SCALE_95[loss], 1e6), lens_priors=priors)


@cache
def solved(
    lens: LensName,
    loss: LossName,
    weak: bool = False,
    baseline: bool = False,
    near: bool = False,
    differing: bool = False,
) -> Solved:
    """weak: with the priors that a calibration has; baseline: with a measured one; near: starts
    at the truth, with noise that puts nothing out of sight of a loss that has several optima;
    differing: observations state noise of all sizes and shapes."""
    changes = {"lens": lens, "baseline_sigma_m": 5e-4 * baseline}
    if near:
        changes |= {"outlier_share": 0.0, "sigma_px": SIGMA_PX / 2, "min_track_length": 4}
    problem, true = simulate_tracks(SMALL.model_copy(update=changes), np.random.default_rng(20))
    if near:
        problem = replace(problem, initial=true)
    if differing:
        problem = replace(problem, observations=with_noise(problem.observations))
    options = options_of(loss, () if weak else no_knowledge(problem))
    graph = build(problem, options)
    estimate, values, summary = solve(graph, relative_tolerance=1e-14)
    assert summary.converged
    covariance = calibration_covariance(graph, estimate, values)
    reference = build_reference(problem, options)
    native = polished(reference, native_values(replace(problem, initial=estimate)))
    return Solved(graph, estimate, values, summary, covariance, reference, native)


def polished(reference: ReferenceGraph, values: gtsam.Values) -> gtsam.Values:
    """After GTSAM's Gauss-Newton steps, weighted anew each time, until they are rounding."""
    for _ in range(8):
        values = values.retract(reference.factors.linearize(values).optimize())
    return values


# ---- the optimum, judged by COLMAP ---------------------------------------------------------


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


# ---- the optimum, judged by the reference ------------------------------------------------


def sigmas_of(case: Solved) -> FloatArray:
    """Model sigmas (n,) in the order of `calibration_of`, zero where there is none."""
    sigma = case.covariance.model.sigma
    lenses = [sigma[f"{c.name}.{name}"] for c in case.estimate.cameras for name in c.names]
    return np.append(lenses, np.zeros(12 * len(case.estimate.cameras)))


def assert_same_optimum(ours: Estimate, theirs: Estimate, sigma: FloatArray) -> None:
    """To 1e-6 of each number, or to 1e-5 of its sigma: a coefficient may be next to zero."""
    a, b = calibration_of(ours), calibration_of(theirs)
    assert (np.abs(a - b) <= 1e-6 * np.abs(b) + 1e-5 * sigma + 1e-9).all()


# every lens with every loss, each of them once with a measured baseline, and losses once with
# observations whose noise differs in size and shape
ALL = [(lens, loss, False, False) for lens in NATIVE_LENSES for loss in LOSS_NAMES]
ALL += [(lens, loss, True, False) for lens, loss in zip(NATIVE_LENSES, LOSS_NAMES, strict=True)]
ALL += [("radtan", loss, False, True) for loss in LOSS_NAMES]


@pytest.mark.parametrize(("lens", "loss", "baseline", "differing"), ALL)
def test_our_optimum_is_one_of_the_reference(
    lens: LensName, loss: LossName, baseline: bool, differing: bool
) -> None:
    """GTSAM's Gauss-Newton on its own factors, started there, stays there."""
    case = solved(lens, loss, weak=True, baseline=baseline, near=True, differing=differing)
    theirs = reference_estimate(case.native, case.graph.problem)
    assert_same_optimum(case.estimate, theirs, sigmas_of(case))
    assert case.reference.factors.error(case.native) == pytest.approx(case.summary.cost, rel=1e-9)
    np.testing.assert_allclose(case.estimate.points, theirs.points, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("lens", JUDGED_LENSES)
def test_the_reference_finds_our_optimum_by_itself(lens: LensName, loss: LossName) -> None:
    """GTSAM's Levenberg-Marquardt from the same start, 1 % off in focal length."""
    case = solved(lens, loss, weak=True)
    theirs, values, _ = solve_reference(case.reference)
    assert case.reference.factors.error(values) == pytest.approx(case.summary.cost, rel=1e-8)
    theirs = reference_estimate(polished(case.reference, values), case.graph.problem)
    assert_same_optimum(case.estimate, theirs, sigmas_of(case))


# ---- the marginals, judged by a dense inverse and by gtsam.Marginals -----------------------


WIDTHS = {ord("k"): NATIVE_SIZE, ord("l"): 3, ord("t"): 6, ord("x"): 6}


def calibration_keys(graph: CalibrationGraph) -> list[int]:
    n = len(graph.problem.initial.cameras)
    return [*map(lens_key, range(n)), *(rig_key(i) for i in range(1, n))]


def columns_of(every: list[int], keys: list[int]) -> IntArray:
    starts = np.cumsum([0, *(WIDTHS[gtsam.Symbol(key).chr()] for key in every)])
    return np.concatenate([np.arange(*starts[[i, i + 1]]) for i in map(every.index, keys)])


def to_reported(estimate: Estimate) -> FloatArray:
    """Jacobian from GTSAM's variables at `calibration_keys` to what is reported of them."""
    lenses = [np.eye(NATIVE_SIZE)[native_slots(camera)] for camera in estimate.cameras]
    return block_diag(*lenses, *(numeric_reported(t) for t in estimate.cam_from_rig[1:]))


def in_its_unit(case: Solved) -> FloatArray:
    """Jacobian to units of the longest baseline, where nothing measured gives a scale."""
    names, far = case.covariance.model.names, case.covariance.basis.unit_camera
    return np.eye(len(names)) if far is None else unit_jacobian(names, case.estimate, far)


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
    for i in range(*part.indices(case.reference.factors.size())):
        some.push_back(case.reference.factors.at(i))
    linear = some.linearize(case.native)
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
@pytest.mark.parametrize("lens", JUDGED_LENSES)
def test_the_model_covariance_is_the_dense_inverse(lens: LensName, loss: LossName) -> None:
    """(c H + P)^-1 (s H + P) (c H + P)^-1, everything inverted whole: all cross-covariances."""
    case = solved(lens, loss, weak=True)
    every = sorted(case.native.keys())
    n = len(case.graph.problem.observations)
    of_data = dense_hessian(case, slice(n), every)
    of_priors = dense_hessian(case, slice(n, None), every)
    curvature, score_variance = hand_made_moments(case)
    bread = curvature * of_data + of_priors
    scale = 1 / np.sqrt(np.diag(bread))
    bread = np.linalg.inv(bread * np.outer(scale, scale)) * np.outer(scale, scale)
    whole = bread @ (score_variance * of_data + of_priors) @ bread
    columns = columns_of(every, calibration_keys(case.graph))
    jacobian = in_its_unit(case) @ to_reported(case.estimate)
    expected = jacobian @ whole[np.ix_(columns, columns)] @ jacobian.T
    assert worst_difference(case.covariance.model.matrix, expected) < 1e-5


@pytest.mark.parametrize(("lens", "loss", "baseline", "differing"), ALL)
def test_our_marginals_are_those_of_the_reference(
    lens: LensName, loss: LossName, baseline: bool, differing: bool
) -> None:
    """All sigmas and cross-covariances of lenses and rig, before the loss's moments are in."""
    case = solved(lens, loss, weak=True, baseline=baseline, near=True, differing=differing)
    keys = calibration_keys(case.graph)
    joint = gtsam.Marginals(case.reference.factors, case.native).jointMarginalCovariance(keys)
    native = np.block([[joint.at(a, b) for b in keys] for a in keys])
    jacobian = to_reported(case.estimate)
    expected = jacobian @ native @ jacobian.T
    with threads() as pool:
        start = homogeneous(case.graph.tracks, case.estimate.points)
        state = evaluate(case.graph, case.values, start, pool)
        system = linearised(case.graph, state, pool)
    columns, names, to_ours = calibration_columns(case.graph, case.estimate)
    assert names == case.covariance.model.names
    ours = to_ours @ responses(case.graph, system, columns)[columns] @ to_ours.T
    assert worst_difference(ours, expected) < 1e-5


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("lens", JUDGED_LENSES)
def test_the_model_covariance_is_that_of_gtsam_marginals(lens: LensName, loss: LossName) -> None:
    case = solved(lens, loss)
    keys = calibration_keys(case.graph)
    joint = gtsam.Marginals(case.reference.factors, case.native).jointMarginalCovariance(keys)
    native = np.block([[joint.at(a, b) for b in keys] for a in keys])
    curvature, score_variance = hand_made_moments(case)
    jacobian = in_its_unit(case) @ to_reported(case.estimate)
    expected = score_variance / curvature**2 * jacobian @ native @ jacobian.T
    assert worst_difference(case.covariance.model.matrix, expected) < 1e-4

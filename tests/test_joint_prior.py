"""An earlier calibration in the graph: exact, invariant, and no more than it says."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from synthetic.earlier import (
    MEASURED,
    NAMES,
    TRACKS,
    drawn,
    earlier,
    old,
    options,
    recalibrated,
    scan,
    sigmas,
    solved,
    with_rows,
)

from graphs.build import CalibrationGraph, build, initial_values
from graphs.compare import Stated
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.jackknife import change, delete_group_jackknife
from graphs.joint_prior import (
    believed,
    centred_covariance,
    displaced,
    joint_prior_factor,
    offset,
    parameters,
    shares_of_prior,
    whitening,
    with_prior,
)
from graphs.keys import lens_key, rig_key
from graphs.model_covariance import calibration_columns, response_at
from graphs.observability import prior_information, prior_shares
from graphs.prior_rig import prior_rig
from graphs.priors import PINNED_SIGMA, weak_lens_prior
from graphs.problem import Estimate, PriorRig
from graphs.propagation import cross_covariance
from graphs.refine import refine
from graphs.solve import solve
from graphs.split_check import split_check
from graphs.stated_covariance import calibration_covariance, factors
from graphs.twin import certify, twin_problem
from sfm_calib.prior import started

ONE = (0, 1, 2)  # each camera its own lens


def moved(values: gtsam.Values, size: float, seed: int = 1) -> gtsam.Values:
    rng, step = np.random.default_rng(seed), gtsam.VectorValues()
    for key in list(values.keys()):
        step.insert(key, size * rng.standard_normal(values.zeroVectors().at(key).size))
    return values.retract(step)


@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize("free", ["all", "intrinsics cam1.rotation cam2.translation"])
def test_jacobians_agree_with_differences_far_from_the_prior_too(metric: bool, free: str) -> None:
    problem = replace(scan()[0], prior=earlier(metric, free=free))
    factor = joint_prior_factor(problem, ONE)
    assert factor is not None
    values = moved(initial_values(problem, ONE), 0.03)  # 3 deg
    jacobian, rhs = factor.linearize(values).jacobian()
    np.testing.assert_allclose(-rhs, factor.unwhitenedError(values))
    column, h = 0, 1e-5
    for key in list(factor.keys()):
        for axis in np.eye(values.zeroVectors().at(key).size):
            ends = []
            for sign in (h, -h):
                ends.append(
                    factor.unwhitenedError(values.retract(_along(values, key, sign * axis)))
                )
            numeric = (ends[0] - ends[1]) / (2 * h)
            own = jacobian[:, column]
            np.testing.assert_allclose(numeric, own, atol=1e-5 * np.abs(own).max())
            column += 1
    assert column == jacobian.shape[1]


def _along(values: gtsam.Values, key: int, step: FloatArray) -> gtsam.VectorValues:
    steps, zero = gtsam.VectorValues(), values.zeroVectors()
    for other in list(values.keys()):
        steps.insert(other, step if other == key else zero.at(other))
    return steps


def test_without_metres_the_size_of_the_rig_is_nothing_to_it() -> None:
    problem = replace(scan()[0], prior=earlier(metric=False))
    assert not problem.metric
    factor = joint_prior_factor(problem, ONE)
    assert factor is not None
    values = moved(initial_values(problem, ONE), 0.03)
    larger = gtsam.Values()
    for camera in ONE:
        larger.insert(lens_key(camera), values.atVector(lens_key(camera)))
        place = values.atPose3(rig_key(camera))
        larger.insert(rig_key(camera), gtsam.Pose3(place.rotation(), 7.3 * place.translation()))
    error = factor.unwhitenedError(values)
    np.testing.assert_allclose(
        factor.unwhitenedError(larger), error, rtol=1e-9, atol=1e-9 * np.abs(error).max()
    )


@pytest.mark.parametrize("metric", [True, False])
def test_its_rows_state_its_covariance(metric: bool) -> None:
    prior = earlier(metric)
    covariance, rows = centred_covariance(prior), whitening(prior)
    assert len(rows) == len(parameters(prior)) - (not metric)
    white = rows @ covariance @ rows.T
    np.testing.assert_allclose(white, np.eye(len(rows)), atol=1e-6)


def test_with_the_data_it_is_gaussian_fusion() -> None:
    """Errors so small that all is linear: to 1e-6 in mean and covariance."""
    small = 1e-5
    tracks = MEASURED.model_copy(update={"sigma_px": 0.4 * small, "baseline_sigma_m": 5e-4 * small})
    problem, true = scan(0, tracks)
    covariance = Covariance(old().covariance.names, small**2 * old().covariance.matrix)
    prior = drawn(earlier(stated=Stated(true, covariance)), true, np.random.default_rng(2))
    problem = replace(problem, initial=true)
    fused = recalibrated(problem, prior, 0.4 * small)
    alone = build(problem, options(replace(problem, prior=prior), 0.4 * small))
    estimate, values, _ = solve(alone, 100, 1e-14)
    names = fused.model.names
    of_data = inverse_information(alone, estimate, values)
    before = cross_covariance(prior.covariance, names, names)
    expected = np.linalg.inv(np.linalg.inv(of_data) + np.linalg.inv(before))
    ours = inverse_information(fused.graph, fused.estimate, fused.values)
    sigma = sigmas(expected)
    assert np.abs((ours - expected) / np.outer(sigma, sigma)).max() < 1e-6
    was = replace(true, cameras=prior.cameras, cam_from_rig=prior.cam_from_rig)
    mean = before @ np.linalg.solve(of_data + before, change(was, estimate, names))
    assert np.abs((change(was, fused.estimate, names) - mean) / sigma).max() < 1e-4


def inverse_information(
    graph: CalibrationGraph, estimate: Estimate, values: gtsam.Values
) -> FloatArray:
    columns, _, to_reported = calibration_columns(graph, estimate)
    others = graph.others.linearize(values)
    inverse = response_at(graph, estimate, values, others, columns, 1.0)[columns]
    result: FloatArray = to_reported @ inverse @ to_reported.T
    return result


# ---- what it may be -------------------------------------------------------------------------


def test_what_is_exactly_known_stays_known() -> None:
    """Two focal lengths that are one, a coefficient without any error: a singular covariance."""
    names = list(old().covariance.names)
    mixed = np.eye(len(names))
    mixed[names.index("cam0.fy")] = mixed[names.index("cam0.fx")]
    mixed[names.index("cam1.k2")] = 0.0
    covariance = Covariance(tuple(names), mixed @ old().covariance.matrix @ mixed.T)
    prior = earlier(stated=Stated(old().estimate, covariance))
    assert np.isfinite(whitening(prior)).all()
    problem, _ = scan()
    found = recalibrated(problem, prior)
    assert found.summary.converged and found.summary.iterations < 20
    was = {camera.name: camera.named() for camera in prior.cameras}
    now = {camera.name: camera.named() for camera in found.estimate.cameras}
    moved_px = [now["cam0"][p] - was["cam0"][p] for p in ("fx", "fy")]
    sigma = found.model.covariance.sigma
    assert abs(moved_px[0]) > 0.005 and moved_px[1] == pytest.approx(moved_px[0], abs=1e-3)
    assert now["cam1"]["k2"] == pytest.approx(was["cam1"]["k2"], abs=1e-6)
    assert sigma["cam1.k2"] < 1e-6 < 1e-4 < sigma["cam0.k2"]


def test_metres_are_the_scans_where_it_had_none() -> None:
    problem, true = scan()
    assert not problem.metric
    prior = earlier()
    found = recalibrated(replace(problem, initial=problem.initial.scaled(3.0)), prior)
    assert found.graph.problem.metric and found.model.unit_camera is None
    length, known, real = (
        float(np.linalg.norm(placed[1].translation))
        for placed in (found.estimate.cam_from_rig, prior.cam_from_rig, true.cam_from_rig)
    )
    assert length == pytest.approx(known, abs=3e-3) and length == pytest.approx(real, abs=3e-3)
    both = recalibrated(scan(0, MEASURED)[0], prior)
    alone = solved(scan(0, MEASURED)[0])
    for axis in "xyz":
        name = f"cam1.translation_{axis}"
        sigma = both.model.covariance.sigma[name]
        assert sigma < 0.999 * alone.model.covariance.sigma[name]
        assert sigma < 0.999 * found.model.covariance.sigma[name]


def test_metres_do_not_come_from_what_is_not_believed() -> None:
    for prior in (earlier(mode="start"), earlier(mode="weak"), earlier(metric=False)):
        assert not prior.gives_scale
    assert earlier(mode="start", free="rotation").gives_scale
    assert not earlier(mode="start", free="extrinsics").gives_scale


def test_a_rig_in_its_own_unit_keeps_it() -> None:
    prior = earlier(metric=False)
    assert prior.unit == "cam1"
    assert np.linalg.norm(prior.cam_from_rig[1].translation) == pytest.approx(1)
    found = recalibrated(scan()[0], prior)
    assert found.summary.iterations < 20
    assert found.model.unit_camera == 1 and not found.graph.problem.metric
    assert np.linalg.norm(found.in_unit.cam_from_rig[1].translation) == pytest.approx(1)


def test_what_it_does_not_state_keeps_its_weak_belief() -> None:
    names = [n for n in old().covariance.names if not n.startswith(("cam1.k", "cam2.trans"))]
    covariance = Covariance(tuple(names), cross_covariance(old().covariance, names, names))
    prior = prior_rig(Stated(old().estimate, covariance), NAMES, "cam0", True)
    told = believed(prior)
    assert "cam1.k1" not in told and "cam2.translation_x" not in told
    assert {"cam1.fx", "cam2.rotation_x", "cam1.translation_z"} <= set(told)
    camera = prior.cameras[1]
    weak = weak_lens_prior(camera)
    belief = with_prior(camera, weak, prior)
    np.testing.assert_array_equal(belief.sigma[4:], weak.sigma[4:])
    assert (belief.sigma[:4] > 1e5 * weak.sigma[:4]).all() and np.isinf(belief.aspect_sigma)
    assert recalibrated(scan()[0], prior).summary.converged


def test_another_lens_or_a_strange_camera_is_refused() -> None:
    problem, _ = scan()
    prior = earlier()
    strange = replace(prior.cameras[1], name="cam9")
    other = replace(prior.cameras[1], lens="pinhole", params=prior.cameras[1].params[:4])
    for camera, words in ((strange, "cam9"), (other, "pinhole")):
        cameras = (prior.cameras[0], camera, prior.cameras[2])
        with pytest.raises(ValueError, match=words):
            build(replace(problem, prior=replace(prior, cameras=cameras)), options(problem))


# ---- weak beliefs about it --------------------------------------------------------------------


def test_weak_beliefs_are_centred_on_it() -> None:
    prior = earlier(mode="weak")
    camera = prior.cameras[0]
    weak = weak_lens_prior(camera)
    belief = with_prior(camera, weak, prior)
    np.testing.assert_array_equal(belief.mean, camera.params)
    np.testing.assert_array_equal(belief.sigma, weak.sigma)
    assert with_prior(camera, weak, None) is weak
    started_only = with_prior(camera, weak, earlier(mode="start"))
    np.testing.assert_array_equal(started_only.mean, weak.mean)


def test_the_belief_in_the_aspect_is_one_in_its_own() -> None:
    """Stretched by 1.3, it is 1.3; at 1 it is the belief in square pixels, bit for bit."""
    camera = earlier().cameras[0]
    weak = weak_lens_prior(camera)
    mean = weak.mean.copy()
    mean[1] *= 1.3
    held = replace(weak, mean=mean).information() - np.diag(weak.sigma**-2.0)
    np.testing.assert_allclose(held[:2, :2] @ mean[:2], 0, atol=1e-9)
    assert np.abs(held[:2, :2] @ [1.0, 1.0]).max() > 1e-3
    square = weak.information() - np.diag(weak.sigma**-2.0)
    s = (weak.aspect_sigma * weak.mean[0]) ** -2
    np.testing.assert_allclose(square[:2, :2], [[s, -s], [-s, s]], rtol=1e-12)


def test_what_is_held_is_pinned() -> None:
    prior = earlier(mode="start", free="rotation cam1.focal")
    belief = with_prior(prior.cameras[1], weak_lens_prior(prior.cameras[1]), prior)
    assert belief.free.tolist() == [True, True] + [False] * (len(belief.mean) - 2)
    np.testing.assert_array_equal(belief.mean[2:], prior.cameras[1].params[2:])
    assert (belief.sigma[2:] == PINNED_SIGMA).all()


# ---- what judges it ---------------------------------------------------------------------------


def test_its_share_is_one_where_the_data_say_nothing() -> None:
    names = {"cam0.fx": 1e-3, "cam2.k1": 1e4, "cam1.rotation_y": 1e2}
    stated = Stated(old().estimate, with_rows(old().covariance, names))
    prior = earlier(stated=stated)
    found = recalibrated(scan()[0], prior)
    shares = shares_of_prior(prior, found.model.covariance, True)
    assert set(shares) == set(old().covariance.names)
    assert shares["cam0.fx"] > 0.99 and shares["cam2.k1"] < 1e-3
    assert shares["cam1.rotation_y"] < 1e-3 and 0.05 < shares["cam1.cx"] < 0.9
    information = prior_information(found.graph, found.estimate, found.model.names)
    before = prior.covariance.sigma
    after = sigmas(np.linalg.inv(information))
    for name, sigma in zip(found.model.names, after, strict=True):
        assert sigma == pytest.approx(before[name], rel=0.1), name
    by_variance = prior_shares(found.model.covariance, information)
    assert by_variance["cam0.fx"] > 0.99
    in_unit = shares_of_prior(earlier(metric=False), found.model.covariance, True)
    assert not any(".translation_" in name for name in in_unit)


def test_a_twin_errs_anew_from_its_own_truth() -> None:
    problem = started(scan(0, TRACKS)[0], earlier())
    refinement = refine(problem, options(problem), 1.0)
    prior = problem.prior
    assert prior is not None
    root, rng = factors(centred_covariance(prior))[1], np.random.default_rng(0)
    z = []
    for _ in range(60):
        twin = twin_problem(refinement, rng).prior
        assert twin is not None
        truth = refinement.estimate
        off = -offset(twin, [c.params for c in truth.cameras], truth.cam_from_rig)[0]
        z.append(root @ off)
    assert np.mean(np.square(z)) == pytest.approx(1, abs=0.1)
    certificate = certify(refinement, 3, 0, 1.0)
    assert certificate.failed == 0 and 0.3 < certificate.mean_nees[0] < 2.5


def test_a_twin_of_what_is_held_errs_by_what_it_does_not_share_with_it() -> None:
    problem = started(scan(0, TRACKS)[0], earlier(metric=False, free="extrinsics"))
    refinement = refine(problem, options(problem), 1.0)
    twin = twin_problem(refinement, np.random.default_rng(0)).prior
    assert twin is not None
    for camera, true in zip(twin.cameras, refinement.estimate.cameras, strict=True):
        np.testing.assert_array_equal(camera.params, true.params)
    off = offset(twin, [c.params for c in twin.cameras], refinement.estimate.cam_from_rig)[0]
    assert 1e-5 < np.abs(off).max() < 0.1


@pytest.mark.parametrize("metric", [True, False])
def test_halves_and_blocks_lean_on_it_together(metric: bool) -> None:
    prior = drawn(earlier(metric), scan()[1], np.random.default_rng(3))
    problem = started(scan()[0], prior)
    refinement = refine(problem, options(problem), 1.0)
    covariance = calibration_covariance(
        refinement.graph, refinement.estimate, refinement.values, 1.0
    )
    jackknife = delete_group_jackknife(refinement.graph, refinement.estimate, covariance.basis, 1.0)
    assert jackknife is not None and not jackknife.failed
    assert 0.8 < covariance.inflation < 2
    check = split_check(refinement.graph, refinement.estimate, covariance, 1.0)
    assert check is not None and check.agrees
    # what both halves take from it cancels: less is expected than were it counted for each
    assert check.expected_px < 5


def test_a_prior_that_moves_takes_the_rig_along() -> None:
    """All of it surer than the scan, and elsewhere: the result is there."""
    sure = dict.fromkeys(old().covariance.names, 0.001)
    prior = earlier(stated=Stated(old().estimate, with_rows(old().covariance, sure)))
    off = np.zeros(len(parameters(prior)))
    off[parameters(prior).index("cam1.rotation_y")] = 1e-3
    there = displaced(prior, _as_truth(prior), off)
    found = recalibrated(scan()[0], there)
    left = offset(there, [c.params for c in found.estimate.cameras], found.estimate.cam_from_rig)[0]
    assert abs(left[parameters(prior).index("cam1.rotation_y")]) < 1e-4


def _as_truth(prior: PriorRig) -> Estimate:
    return Estimate(prior.cameras, prior.cam_from_rig, (), np.zeros((0, 3)))

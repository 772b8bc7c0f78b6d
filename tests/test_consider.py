"""What was held errs as it did, and what was freed follows it: by differences, by simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.earlier import TRACKS, Solved, drawn, earlier, options, recalibrated, scan, sigmas

from graphs.consider import change_from, considered, cov_difference, sensitivity
from graphs.consider import completed as completed_all
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.jackknife import change, tangent
from graphs.joint_prior import displaced, offset, parameters
from graphs.problem import Estimate, PriorMode, PriorRig
from graphs.propagation import marginal
from graphs.refine import refine
from graphs.stated_covariance import calibration_covariance, factors
from sfm_calib.prior import started

FREE = ["cam1", "extrinsics", "rotation", "focal cam2.translation"]


def completed(found: Solved) -> tuple[Covariance, Covariance]:
    how = sensitivity(found.graph, found.estimate, found.values, found.model)
    stated = found.model.covariance
    return considered(stated, how), cov_difference(stated, how)


def prior_of(found: Solved) -> PriorRig:
    prior = found.graph.problem.prior
    assert prior is not None
    return prior


@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize(("free", "mode"), [*((f, "start") for f in FREE), ("rotation", "full")])
def test_sensitivities_are_those_of_solving_again(metric: bool, free: str, mode: PriorMode) -> None:
    """A held parameter is moved and the rest follows, as predicted; noise so small that the
    Gauss-Newton matrix is the curvature: with 0.4 px, they differ by 1 %."""
    small = 0.05
    problem, true = scan(0, TRACKS.model_copy(update={"sigma_px": 0.4 * small}))
    prior = earlier(metric, mode, free)
    prior = displaced(prior, true, np.zeros(len(parameters(prior))))
    prior = replace(prior, covariance=_scaled(prior.covariance, small))
    problem = replace(problem, initial=true)
    found = recalibrated(problem, prior, 0.4 * small)
    how = sensitivity(found.graph, found.estimate, found.values, found.model)
    whole = considered(found.model.covariance, how)
    held = [i for i, name in enumerate(how.old) if name in prior.held]
    for index in np.random.default_rng(1).choice(held, 2, replace=False):
        name = how.old[index]
        step = prior.covariance.sigma[name] or small * 1e-3
        ends = []
        for sign in (1, -1):
            moved = _moved(prior, index, sign * step)
            ends.append(recalibrated(replace(problem, initial=found.estimate), moved, 0.4 * small))
        numeric = change(ends[1].in_unit, ends[0].in_unit, how.names) / (2 * step)
        apart = np.abs(numeric - how.by_old[:, index]) / np.maximum(sigmas(whole.matrix), 1e-12)
        size = np.abs(how.by_old[:, index]) / np.maximum(sigmas(whole.matrix), 1e-12)
        assert apart.max() < 2e-3 * size.max(), name


def _moved(prior: PriorRig, index: int, step: float) -> PriorRig:
    """One reported parameter of it changed."""
    here = Estimate(prior.cameras, prior.cam_from_rig, (), np.zeros((0, 3)))
    by_reported = offset(prior, [c.params for c in prior.cameras], prior.cam_from_rig)[1]
    return displaced(prior, here, step * by_reported[:, index])


def _scaled(covariance: Covariance, factor: float) -> Covariance:
    return Covariance(covariance.names, factor**2 * covariance.matrix)


@pytest.mark.parametrize("metric", [True, False])
def test_where_nothing_is_held_nothing_is_added(metric: bool) -> None:
    found = recalibrated(scan()[0], earlier(metric))
    whole, difference = completed(found)
    own = found.model.covariance
    sigma = np.maximum(sigmas(own.matrix), 1e-9)
    assert whole.names == own.names
    assert np.abs((whole.matrix - own.matrix) / np.outer(sigma, sigma)).max() < 1e-9
    # Hausman: what an efficient estimate takes from the earlier one it no longer differs by.
    before = marginal(prior_of(found).covariance, difference.names).matrix
    scale = np.maximum(sigmas(before), 1e-9)
    apart = difference.matrix - (before - marginal(own, difference.names).matrix)
    assert np.abs(apart / np.outer(scale, scale)).max() < 0.03


def test_an_earlier_calibration_that_is_only_a_start_is_independent() -> None:
    found = recalibrated(scan()[0], earlier(metric=False, mode="start"))
    how = sensitivity(found.graph, found.estimate, found.values, found.model)
    assert not how.by_old.any() and not how.counted.any()


def test_what_was_held_keeps_its_covariance_and_does_not_differ() -> None:
    prior = earlier(mode="start", free="rotation")
    found = recalibrated(scan()[0], prior)
    whole, difference = completed(found)
    lenses = [name for name in prior.covariance.names if "tion_" not in name]
    now, was = (marginal(one, lenses).matrix for one in (whole, prior.covariance))
    np.testing.assert_allclose(now, was, rtol=1e-6)
    assert max(difference.sigma[name] / whole.sigma[name] for name in lenses) < 1e-5
    assert difference.sigma["cam1.rotation_x"] > 0
    for place, known in zip(found.in_unit.cam_from_rig, prior.cam_from_rig, strict=True):
        np.testing.assert_allclose(place.inverse.translation, known.inverse.translation, atol=1e-7)
    for camera, held in zip(found.in_unit.cameras, prior.cameras, strict=True):
        np.testing.assert_allclose(camera.params, held.params, rtol=1e-9)


def test_what_is_held_stays_where_data_pull_hard() -> None:
    """1 deg off in one camera, whose rotation and place are held."""
    problem, true = scan()
    prior = earlier(mode="start", free="cam2")
    off = np.zeros(len(parameters(prior)))
    off[parameters(prior).index("cam1.rotation_y")] = np.radians(1)
    found = recalibrated(problem, displaced(prior, true, off))
    held = [name in prior.held for name in parameters(prior)]
    there = prior_of(found)
    left = offset(there, [c.params for c in found.estimate.cameras], found.estimate.cam_from_rig)
    assert np.abs(left[0][held]).max() < 1e-8


@pytest.mark.parametrize("free", ["all", "cam1"])
def test_all_covariances_of_a_solve_are_completed(free: str) -> None:
    problem = started(scan()[0], earlier(metric=False, free=free))
    refinement = refine(problem, options(problem), 1.0)
    graph, estimate, values = refinement.graph, refinement.estimate, refinement.values
    covariance = calibration_covariance(graph, estimate, values, 1.0)
    how = sensitivity(graph, estimate, values, covariance.basis)
    whole = completed_all(covariance, how)
    assert whole.jackknife is not None and whole.jackknife.names == whole.stated.names
    for now, was in (
        (whole.model, considered(covariance.model, how)),
        (whole.stated, considered(covariance.stated, how)),
        (whole.robust, considered(covariance.robust, how)),
    ):
        sigma = np.maximum(sigmas(was.matrix), 1e-9)
        assert now.names == was.names
        assert np.abs((now.matrix - was.matrix) / np.outer(sigma, sigma)).max() < 1e-8
    if free == "all":
        assert whole.inflation == pytest.approx(covariance.inflation, rel=1e-6)


def nees(covariance: Covariance, error: FloatArray) -> float:
    return float(((factors(covariance.matrix)[1] @ error) ** 2).mean())


@pytest.mark.slow
@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize(
    ("free", "mode"), [("all", "full"), ("extrinsics", "start"), ("cam1", "full")]
)
def test_stated_covariances_hold_with_an_earlier_calibration_drawn_anew(
    metric: bool, free: str, mode: PriorMode
) -> None:
    """Mean NEES of 40 trials is 1: of the result, and of its change. Alone, the solve's own
    covariance is far too small where something wrong by its sigma was held."""
    told = []
    for seed in range(40):
        problem, true = scan(5000 + seed)
        base = earlier(metric, mode, free)
        prior = drawn(base, true, np.random.default_rng(seed))
        found = recalibrated(problem, prior)
        whole, difference = completed(found)
        far = found.model.unit_camera
        unit = 1.0 if far is None else float(np.linalg.norm(true.cam_from_rig[far].translation))
        known = true.scaled(1 / unit)
        own = tuple(name for name in found.model.names if name not in prior.held)
        error = change(known, found.in_unit, whole.names)
        if found.model.unit_camera is not None:
            plane = tangent(known, replace(found.model, names=whole.names))
            error = plane @ error
        freed = error[[whole.names.index(name) for name in own]]
        one = [nees(whole, error), nees(marginal(found.model.covariance, own), freed)]
        if metric == found.graph.problem.metric and (metric or prior.unit is not None):
            free_of = marginal(difference, [n for n in difference.names if n in own])
            moved = change_from(prior, found.in_unit, free_of.names)
            one.append(nees(free_of, moved))
        told.append(one)
    mean = np.mean(told, axis=0)
    assert 0.85 < mean[0] < 1.2
    if free == "all":
        assert mean[1] == pytest.approx(mean[0], rel=1e-6)
    else:
        assert mean[1] > 10
    assert len(mean) < 3 or 0.75 < mean[2] < 1.25

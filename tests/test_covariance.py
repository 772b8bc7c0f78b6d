"""Sigmas: free of the gauge, true to the unit of length, as wide as the frames disagree.

Agreement with a dense inverse and with gtsam.Marginals: test_reference_graph.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.shared_errors import drifting, misfit, sheared

from graphs import gauge
from graphs.build import GraphOptions, build
from graphs.covariance import Covariance
from graphs.gauge import Gauge
from graphs.losses import LossName
from graphs.noise import loss_moments
from graphs.priors import LensPrior, weak_lens_prior
from graphs.problem import Estimate, KnownBaseline, Observations, Problem, residuals_px
from graphs.solve import solve
from graphs.stated_covariance import CalibrationCovariance, calibration_covariance
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
TRACKS = TrackOptions(
    rig="stereo", frames=12, points=900, max_points_per_image=60, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
)  # fmt: skip
LOSSES: tuple[LossName, ...] = ("none", "huber", "cauchy")


def problem_of(seed: int = 0, **changes: object) -> Problem:
    return simulate_tracks(TRACKS.model_copy(update=changes), np.random.default_rng(seed))[0]


def solved(
    problem: Problem, options: GraphOptions | None = None
) -> tuple[Estimate, CalibrationCovariance]:
    graph = build(problem, options or GraphOptions(SIGMA_PX))
    estimate, values, summary = solve(graph, max_iterations=500, relative_tolerance=1e-10)
    assert summary.converged
    return estimate, calibration_covariance(graph, estimate, values)


# ---- names ---------------------------------------------------------------------------------


def test_every_free_parameter_has_its_name_and_the_reference_camera_none() -> None:
    problem = problem_of(rig="triple")
    _, covariance = solved(replace(problem, reference=0))
    lens = ("fx", "fy", "cx", "cy", "k1", "k2")
    pose = (*(f"rotation_{a}" for a in "xyz"), *(f"translation_{a}" for a in "xyz"))
    expected = [f"cam{i}.{name}" for i in range(3) for name in lens]
    expected += [f"cam{i}.{name}" for i in (1, 2) for name in pose]
    assert covariance.stated.names == covariance.model.names == tuple(expected)
    assert covariance.stated.matrix.shape == (len(expected),) * 2


def test_held_parameters_are_left_out() -> None:
    problem = problem_of()
    free = weak_lens_prior(problem.initial.cameras[0])
    sigma = free.sigma.copy()
    sigma[[0, 5]] = 1e-9
    priors = (LensPrior(free.mean, sigma), weak_lens_prior(problem.initial.cameras[1]))
    _, covariance = solved(problem, GraphOptions(SIGMA_PX, lens_priors=priors))
    of_first = [name for name in covariance.stated.names if name.startswith("cam0.")]
    assert of_first == ["cam0.fy", "cam0.cx", "cam0.cy", "cam0.k1"]


def test_a_covariance_knows_the_sigma_of_a_difference() -> None:
    covariance = Covariance(("a", "b"), np.array([[4.0, 1.0], [1.0, 9.0]]))
    assert covariance.sigma == {"a": 2.0, "b": 3.0}
    assert covariance.of_difference("a", "b") == pytest.approx(11**0.5)
    assert covariance.of_difference("a", "held") == 2.0


# ---- gauge and unit ------------------------------------------------------------------------


def test_sigmas_do_not_depend_on_what_is_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another frame, another distance: the same lenses, rotations, and shape of the rig."""
    problem = problem_of(baseline_sigma_m=0.0)
    estimate, covariance = solved(problem)
    other = (gauge.choose_gauge(problem).frame + 5) % len(problem.frame_names)
    held = float(np.linalg.norm(estimate.cam_from_rig[1].translation))
    monkeypatch.setattr(gauge, "choose_gauge", lambda _: Gauge(other, held, cameras=(0, 1)))
    estimate_again, again = solved(problem)
    assert covariance.basis.unit == pytest.approx(held)
    assert again.basis.unit == pytest.approx(
        np.linalg.norm(estimate_again.cam_from_rig[1].translation)
    )
    for ours, theirs in ((covariance.model, again.model), (covariance.stated, again.stated)):
        sigma = np.sqrt(np.diag(ours.matrix))
        assert np.abs((theirs.matrix - ours.matrix) / np.outer(sigma, sigma)).max() < 2e-3


def test_the_sigma_of_the_baseline_is_that_of_its_measurement() -> None:
    """Nothing else knows lengths; sideways the baseline is as good as the images make it."""
    problem = problem_of(baseline_sigma_m=0.0)
    at = {}
    for sigma_m in (1e-4, 0.01):
        known = replace(problem, scales=(KnownBaseline((0, 1), 0.2, sigma_m),))
        estimate, covariance = solved(known)
        places = [covariance.model.names.index(f"cam1.translation_{axis}") for axis in "xyz"]
        of_translation = covariance.model.matrix[np.ix_(places, places)]
        t = estimate.cam_from_rig[1].translation
        assert np.linalg.norm(t) == pytest.approx(0.2, rel=1e-4)
        along = t / np.linalg.norm(t)
        assert np.sqrt(along @ of_translation @ along) == pytest.approx(sigma_m, rel=1e-3)
        at[sigma_m] = covariance.model.sigma
    for name in ("cam0.fx", "cam1.k1", "cam1.rotation_y"):
        assert at[0.01][name] == pytest.approx(at[1e-4][name], rel=1e-3)


@pytest.mark.parametrize("metric", [False, True])
def test_the_covariance_scales_with_the_unit(metric: bool) -> None:
    """In millimetres translations have a thousand times the sigma, all else the same; in units of
    the baseline nothing changes."""
    problem = problem_of(baseline_sigma_m=0.0)
    mm = replace(problem, initial=problem.initial.scaled(1000.0))
    if metric:
        problem = replace(problem, scales=(KnownBaseline((0, 1), 0.2, 0.001),))
        mm = replace(mm, scales=(KnownBaseline((0, 1), 200.0, 1.0),))
    ours, theirs = solved(problem)[1].stated, solved(mm)[1].stated
    for name, sigma in ours.sigma.items():
        factor = 1000.0 if metric and ".translation_" in name else 1.0
        assert theirs.sigma[name] == pytest.approx(factor * sigma, rel=1e-3), name


def test_along_the_baseline_that_is_the_unit_nothing_is_uncertain() -> None:
    estimate, covariance = solved(problem_of(baseline_sigma_m=0.0))
    along = estimate.cam_from_rig[1].translation / covariance.basis.unit
    places = [covariance.stated.names.index(f"cam1.translation_{axis}") for axis in "xyz"]
    of_translation = covariance.stated.matrix[np.ix_(places, places)]
    assert along @ of_translation @ along < 1e-12 * np.trace(of_translation)


# ---- the assumed noise, and priors ---------------------------------------------------------


@pytest.mark.parametrize("loss", LOSSES)
def test_the_assumed_noise_does_not_matter(loss: LossName) -> None:
    """Half the sigma at twice the scale of the loss: the same optimum, the same sigmas."""
    problem = problem_of(outlier_share=0.02, outlier_kind="heavy")
    mean = [weak_lens_prior(c) for c in problem.initial.cameras]
    none = tuple(LensPrior(p.mean, np.full(p.mean.size, 1e6)) for p in mean)
    _, ours = solved(problem, GraphOptions(SIGMA_PX, loss, 2.0, lens_priors=none))
    _, theirs = solved(problem, GraphOptions(SIGMA_PX / 2, loss, 4.0, lens_priors=none))
    for name, sigma in ours.stated.sigma.items():
        assert theirs.stated.sigma[name] == pytest.approx(sigma, rel=2e-3), name


@pytest.mark.parametrize("loss", LOSSES)
def test_relative_sigmas_are_only_relative(loss: LossName) -> None:
    """Twice the relative sigma of half the sigma_px: the same covariance, model's and stated."""
    problem = problem_of(outlier_share=0.02, outlier_kind="heavy")
    seen = problem.observations
    doubled = replace(seen, relative_sigma=np.full(len(seen), 2.0))
    _, plain = solved(problem, GraphOptions(SIGMA_PX, loss, 2.0))
    _, other = solved(replace(problem, observations=doubled), GraphOptions(SIGMA_PX / 2, loss, 2.0))
    np.testing.assert_allclose(other.model.matrix, plain.model.matrix, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(other.stated.matrix, plain.stated.matrix, rtol=1e-6, atol=1e-12)


def test_noisier_observations_are_known_to_be_noisier() -> None:
    """Half of them four times as noisy: said so, sigmas are of the noise that there is."""
    problem = problem_of(sigma_px=0.0)
    seen, rng = problem.observations, np.random.default_rng(3)
    relative = np.where(rng.random(len(seen)) < 0.5, 1.0, 4.0)
    noise = SIGMA_PX * relative[:, None] * rng.standard_normal(seen.pixels.shape)
    noisy = replace(seen, pixels=seen.pixels + noise, relative_sigma=relative)
    options = GraphOptions(SIGMA_PX, "none")
    graph = build(replace(problem, observations=noisy), options)
    estimate, values, _ = solve(graph)
    moments = loss_moments(graph.problem, options, residuals_px(estimate, noisy))
    assert moments.score_variance == pytest.approx(1, rel=0.1)
    whole = calibration_covariance(graph, estimate, values).model.sigma["cam0.fx"]
    _, quiet = solved(problem_of(), GraphOptions(SIGMA_PX, "none"))
    assert 1.3 < whole / quiet.model.sigma["cam0.fx"] < 1.8


def test_a_prior_that_knows_everything_leaves_its_own_sigma() -> None:
    """However wrong the assumed noise: (H + P)^-1 (s H + P) (H + P)^-1 is P^-1 then."""
    problem, true = simulate_tracks(TRACKS, np.random.default_rng(0))
    camera = true.cameras[0]
    tight = LensPrior(camera.params, np.array([1e-4, 1e-4, 1e-4, 1e-4, 1e-7, 1e-7]))
    priors = (tight, weak_lens_prior(problem.initial.cameras[1]))
    _, covariance = solved(sheared(problem, 0.006, 0), GraphOptions(SIGMA_PX, lens_priors=priors))
    assert covariance.inflations["cam1.fx"] > 1.05
    for name, sigma in zip(camera.names, tight.sigma, strict=True):
        assert covariance.model.sigma[f"cam0.{name}"] == pytest.approx(sigma, rel=1e-3)
        assert covariance.stated.sigma[f"cam0.{name}"] == pytest.approx(sigma, rel=1e-3)


def test_overrated_data_pull_against_the_prior_at_their_own_noise() -> None:
    """Ten times too small a sigma_px: the estimate leans on the data, and carries their noise."""
    problem = problem_of()
    prior = tuple(
        LensPrior(c.params, np.array([2.0, 2.0, 2.0, 2.0, 0.01, 0.01]))
        for c in problem.initial.cameras
    )
    right, overrated = (
        solved(problem, GraphOptions(sigma, "none", lens_priors=prior))[1].model
        for sigma in (SIGMA_PX, SIGMA_PX / 10)
    )
    alone = solved(problem, GraphOptions(SIGMA_PX, "none"))[1].model
    assert overrated.sigma["cam0.fx"] > 1.02 * right.sigma["cam0.fx"]
    assert overrated.sigma["cam0.fx"] < 1.1 * alone.sigma["cam0.fx"]


# ---- what errs together --------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_errors_that_frames_tracks_or_cells_share_widen_the_sigmas(seed: int) -> None:
    problem = problem_of(seed)
    _, plain = solved(problem)
    assert 1 <= plain.inflation < 1.25
    shared = (sheared(problem, 0.006, 0), drifting(problem, 2.0, 0), misfit(problem, 0.7, 0))
    for wrong, least in zip(shared, (1.5, 1.2, 1.3), strict=True):
        _, covariance = solved(wrong)
        focals = [covariance.inflations[f"cam{i}.{name}"] for i in (0, 1) for name in ("fx", "fy")]
        assert np.mean(focals) > least * plain.inflation, (least, focals)


def test_stated_is_never_less_than_the_model_in_any_direction() -> None:
    for problem in (problem_of(1), sheared(problem_of(), 0.002, 1)):
        _, covariance = solved(problem)
        sigma = np.sqrt(np.diag(covariance.model.matrix))
        more = (covariance.stated.matrix - covariance.model.matrix) / np.outer(sigma, sigma)
        assert np.linalg.eigvalsh(more).min() > -1e-9
        ratio = np.sqrt(np.diag(covariance.stated.matrix)) / sigma
        assert covariance.inflation == pytest.approx(np.median(ratio))


def test_a_jackknife_takes_the_place_of_frames_alone() -> None:
    """Shear that whole blocks of frames share is beyond what single frames can show."""
    problem = problem_of(frames=24, points=1500)
    seen, rng = problem.observations, np.random.default_rng(5)
    shear = 0.004 * rng.standard_normal((8, 2, 2))[np.arange(24) // 3]
    centres = np.array([camera.centre for camera in problem.initial.cameras])[seen.camera]
    moved = np.einsum("nij,nj->ni", shear[seen.frame], seen.pixels - centres)
    wrong = replace(problem, observations=replace(seen, pixels=seen.pixels + moved))
    graph = build(wrong, GraphOptions(SIGMA_PX))
    estimate, values, _ = solve(graph)
    covariance = calibration_covariance(graph, estimate, values, min_parallax_deg=1.0)
    assert covariance.jackknife is not None
    names = covariance.stated.names
    ratio = [covariance.stated.sigma[n] / covariance.robust.sigma[n] for n in names]
    assert np.median(ratio) > 1.3


# ---- numerics ------------------------------------------------------------------------------


def test_a_track_that_ends_in_a_camera_does_not_spoil_the_rest() -> None:
    """A mismatched track may converge to a micrometre before a camera, where its Jacobian is 1e8
    px per unit; one at the horizon has none in depth. Neither tells anything of the lens."""
    problem = problem_of()
    _, plain = solved(problem)
    start, seen = problem.initial, problem.observations
    graph = build(problem, GraphOptions(SIGMA_PX))
    estimate, _, _ = solve(graph)
    rig_at = estimate.rig_from_world[1].inverse
    ahead = np.array([2e-7, -3e-7, 1e-6])
    far = np.array([0.0, 0.0, 1e9])
    points = rig_at @ np.array([ahead * (1 + 0.1 * i) for i in range(20)] + [far])
    count, copies = len(start.points), len(points)
    odd = Observations(
        np.tile([300.0, 200.0], (3 * copies, 1)),
        np.tile([1, 2, 3], copies),
        np.zeros(3 * copies, int),
        np.repeat(np.arange(count, count + copies), 3),
    )
    together = Observations(*(
        np.concatenate([getattr(seen, name), getattr(odd, name)])
        for name in ("pixels", "frame", "camera", "point")
    ))  # fmt: skip
    whole = replace(estimate, points=np.concatenate([estimate.points, points]))
    spoilt = replace(problem, initial=whole, observations=together)
    graph = build(spoilt, GraphOptions(SIGMA_PX))
    covariance = calibration_covariance(graph, whole, graph.initial)
    for name, sigma in plain.model.sigma.items():
        assert covariance.model.sigma[name] == pytest.approx(sigma, rel=0.1), name


def test_a_direction_that_a_prior_alone_decides_is_not_widened() -> None:
    """The size of the rig is its measured baseline's, to the data rounding: however the frames
    disagree, its sigma stays, and it does not make others wide."""
    problem = problem_of(baseline_sigma_m=0.0)
    wrong = sheared(problem, 0.006, 0)
    known = replace(wrong, scales=(KnownBaseline((0, 1), 0.2, 0.0005),))
    _, without = solved(wrong)
    estimate, metric = solved(known)
    assert metric.inflation == pytest.approx(without.inflation, rel=0.05)
    along = estimate.cam_from_rig[1].translation / 0.2
    places = [metric.stated.names.index(f"cam1.translation_{axis}") for axis in "xyz"]
    of_translation = metric.stated.matrix[np.ix_(places, places)]
    assert np.sqrt(along @ of_translation @ along) == pytest.approx(0.0005, rel=0.01)

"""Sigmas: free of the gauge, true to the unit of length, as wide as the frames disagree.

Agreement with a dense inverse and with gtsam.Marginals: test_reference_graph.py.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphs import covariance as covariance_module
from graphs import gauge
from graphs.build import GraphOptions, LossName, build
from graphs.covariance import (
    MIN_CLUSTERS,
    CalibrationCovariance,
    Covariance,
    calibration_covariance,
    clustered_variance,
)
from graphs.frames import FloatArray, Transform
from graphs.gauge import Gauge
from graphs.priors import LensPrior, weak_lens_prior
from graphs.problem import Estimate, KnownBaseline, Observations, Problem
from graphs.scale import baseline_unit, in_unit_baseline
from graphs.solve import solve
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
    assert again.model.sigma["cam1.translation_x"] < covariance.model.sigma["cam1.translation_x"]
    for name, sigma in covariance.stated.sigma.items():
        if ".translation_" not in name:
            assert again.stated.sigma[name] == pytest.approx(sigma, rel=1e-3), name
    ours = in_unit_baseline(covariance.model, estimate, 1).matrix
    theirs = in_unit_baseline(again.model, estimate_again, 1).matrix
    sigma_of = np.sqrt(np.diag(ours))
    assert np.abs((theirs - ours) / np.outer(sigma_of, sigma_of)).max() < 2e-3


def test_the_sigma_of_the_baseline_is_that_of_its_measurement() -> None:
    """Nothing else knows lengths; sideways the baseline is as good as the images make it."""
    problem = problem_of(baseline_sigma_m=0.0)
    at = {}
    for sigma_m in (1e-4, 0.01):
        known = replace(problem, scale=KnownBaseline((0, 1), 0.2, sigma_m))
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


def test_the_covariance_scales_with_the_unit() -> None:
    """In millimetres translations have a thousand times the sigma, all else the same."""
    problem = problem_of(baseline_sigma_m=0.0)
    mm = replace(problem, initial=problem.initial.scaled(1000.0))
    ours, theirs = solved(problem)[1].stated, solved(mm)[1].stated
    for name, sigma in ours.sigma.items():
        factor = 1000.0 if ".translation_" in name else 1.0
        assert theirs.sigma[name] == pytest.approx(factor * sigma, rel=1e-3), name


def unit_rig() -> tuple[Estimate, Covariance]:
    problem = problem_of(rig="triple", frames=6)
    estimate = problem.initial
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


def test_a_prior_that_knows_everything_leaves_its_own_sigma(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """However wrong the assumed noise: (H + P)^-1 (s H + P) (H + P)^-1 is P^-1 then."""
    problem, true = simulate_tracks(TRACKS, np.random.default_rng(0))
    camera = true.cameras[0]
    tight = LensPrior(camera.params, np.array([1e-4, 1e-4, 1e-4, 1e-4, 1e-7, 1e-7]))
    priors = (tight, weak_lens_prior(problem.initial.cameras[1]))
    clustered: list[FloatArray] = []
    monkeypatch.setattr(covariance_module, "_widen", lambda m, v: [clustered.append(v), m][1])
    _, covariance = solved(problem, GraphOptions(SIGMA_PX, lens_priors=priors))
    for place, (name, sigma) in enumerate(zip(camera.names, tight.sigma, strict=True)):
        assert covariance.model.sigma[f"cam0.{name}"] == pytest.approx(sigma, rel=1e-3)
        assert clustered[0][place] ** 0.5 == pytest.approx(sigma, rel=1e-3)


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


# ---- frames that err together --------------------------------------------------------------


def test_clustered_variance_by_hand() -> None:
    """Two frames, two tracks, one of them seen by both cameras of the first frame: 4 pairs."""
    scores = np.repeat([[1.0], [10], [2], [3], [5]], 2, axis=0)
    errors = np.tile([1.0, 0.0], 5)
    seen = Observations(
        np.zeros((5, 2)),
        np.array([0, 0, 0, 7, 7]),
        np.array([0, 1, 0, 0, 0]),
        np.array([4, 4, 9, 4, 9]),
    )
    by_frame = 2 / 1 * ((1 + 10 + 2) ** 2 + (3 + 5) ** 2)
    by_track = 2 / 1 * ((1 + 10 + 3) ** 2 + (2 + 5) ** 2)
    by_both = 4 / 3 * ((1 + 10) ** 2 + 2**2 + 3**2 + 5**2)
    expected = by_frame + by_track - by_both
    np.testing.assert_allclose(clustered_variance(scores, errors, seen), [expected])


def sheared(problem: Problem, sigma: float, seed: int) -> Problem:
    """Both images of a frame sheared and stretched by a little of its own: a shared error."""
    rng = np.random.default_rng(seed)
    shear = sigma * rng.standard_normal((len(problem.frame_names), 2, 2))
    seen = problem.observations
    centres = np.array([camera.centre for camera in problem.initial.cameras])[seen.camera]
    moved = np.einsum("nij,nj->ni", shear[seen.frame], seen.pixels - centres)
    return replace(
        problem, observations=Observations(seen.pixels + moved, seen.frame, seen.camera, seen.point)
    )


def drifting(problem: Problem, sigma_px: float, seed: int) -> Problem:
    """Every track pulled off its corner bit by bit, each its own way: a shared error."""
    seen = problem.observations
    pull = sigma_px * np.random.default_rng(seed).standard_normal((len(problem.initial.points), 2))
    middle = (len(problem.frame_names) - 1) / 2
    moved = pull[seen.point] * (seen.frame / middle - 1)[:, None]
    return replace(
        problem, observations=Observations(seen.pixels + moved, seen.frame, seen.camera, seen.point)
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_errors_that_a_frame_or_a_track_shares_widen_the_sigmas(seed: int) -> None:
    problem = problem_of(seed)
    _, plain = solved(problem)
    _, of_frames = solved(sheared(problem, 0.006, 0))
    _, of_tracks = solved(drifting(problem, 1.0, 0))
    focals = [f"cam{i}.{name}" for i in range(2) for name in ("fx", "fy")]

    def widened(covariance: CalibrationCovariance) -> float:
        sigmas = covariance.stated.sigma, covariance.model.sigma
        return float(np.mean([sigmas[0][name] / sigmas[1][name] for name in focals]))

    assert plain.inflation < 1.25
    assert of_frames.inflation > 1.4 and widened(of_frames) > 1.8
    assert of_tracks.inflation > 1.2 and widened(of_tracks) > 1.1 * widened(plain)
    assert widened(of_tracks) > 1.35


def test_widening_never_narrows_and_keeps_the_correlations() -> None:
    _, covariance = solved(sheared(problem_of(), 0.002, 1))
    model, stated = covariance.model.matrix, covariance.stated.matrix
    ratio = np.sqrt(np.diag(stated) / np.diag(model))
    assert ratio.min() >= 1 and ratio.max() > 1
    np.testing.assert_allclose(stated, model * np.outer(ratio, ratio))
    assert np.linalg.eigvalsh(stated / np.outer(*[np.sqrt(np.diag(stated))] * 2)).min() > 0
    assert covariance.inflation == pytest.approx(np.median(ratio))


def test_what_agrees_by_chance_is_not_narrowed() -> None:
    """At least one of 18 variances comes out below the model's on independent noise."""
    _, covariance = solved(problem_of(1))
    ratio = np.diag(covariance.stated.matrix) / np.diag(covariance.model.matrix)
    assert ratio.min() == pytest.approx(1, abs=1e-12)


def test_few_frames_cannot_disagree() -> None:
    problem = problem_of(frames=MIN_CLUSTERS - 1, points=2500, max_points_per_image=200)
    _, covariance = solved(sheared(problem, 0.003, 0))
    assert covariance.stated is covariance.model and covariance.inflation == 1


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

"""The ladder finds the lens that made the tracks, and does not climb for noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import t as student

import graphs.held_out
from graphs.build import GraphOptions
from graphs.camera import Camera, nominal_params
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.held_out import held_out_costs, resected, well_seen
from graphs.ladder import (
    BY_BOARD,
    LEAST_GAIN_PX,
    NARROW,
    SIGNIFICANCE,
    TAKEN,
    UNJUDGED,
    WIDE,
    Ladder,
    Rung,
    _judged,
    _Trial,
    _verdict,
    _weak,
    climb,
    on_rung_of,
    paired_gain,
    rungs_for,
    thinned,
)
from graphs.lenses import PARAMETER_NAMES, LensName
from graphs.priors import stated_lens_prior, weak_lens_prior
from graphs.problem import Estimate, Observations, Problem, residuals_px
from graphs.selection import MIN_TRACK_LENGTH, compact
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.4
TRACKS = TrackOptions(rig="stereo", frames=16, points=900, sigma_px=SIGMA_PX)
K1, K2 = -0.16, 0.04


def scanned(
    lens: LensName, coefficients: dict[str, float], sigma_px: float = SIGMA_PX, **changes: object
) -> tuple[Problem, Estimate]:
    """A simulated scan through lenses with these coefficients, from a start without any."""
    options = TRACKS.model_copy(update={"lens": "radial", **changes})
    rng = np.random.default_rng(0)
    problem, true = simulate_tracks(options, rng)
    true = replace(true, cameras=tuple(_with(c, lens, coefficients) for c in true.cameras))
    blank = replace(problem.observations, pixels=np.zeros((len(problem.observations), 2)))
    exact = residuals_px(true, blank)
    seen = replace(blank, pixels=exact + sigma_px * rng.standard_normal(exact.shape))
    start = tuple(
        Camera(c.name, lens, c.size, nominal_params(lens, c.size, 1.02 * c.params[0]))
        for c in true.cameras
    )
    return replace(problem, initial=replace(true, cameras=start), observations=seen), true


def _with(camera: Camera, lens: LensName, coefficients: dict[str, float]) -> Camera:
    values = dict(zip(("fx", "fy", "cx", "cy"), camera.params[:4], strict=True)) | coefficients
    params = np.array([values.get(name, 0.0) for name in PARAMETER_NAMES[lens]])
    return Camera(camera.name, lens, camera.size, params)


def climbed(problem: Problem, autos: Sequence[int] | None = None) -> Ladder:
    every = range(len(problem.initial.cameras))
    return climb(problem, lambda _: GraphOptions(), autos or every, 1.0)


# ---- which rung ----------------------------------------------------------------------------


@pytest.mark.parametrize("rig", ["mono", "stereo"])
def test_a_radial_lens_is_not_given_tangential_terms(rig: str) -> None:
    problem, true = scanned("radial", {"k1": K1, "k2": K2}, rig=rig, frames=24)
    ladder = climbed(problem)
    assert not {"p1", "p2"} & set(ladder.best.rung.coefficients), ladder.reason
    assert [r.rung for r in ladder.rungs] == list(NARROW)
    for found, camera in zip(ladder.best.estimate.cameras, true.cameras, strict=True):
        np.testing.assert_allclose(found.params[:4], camera.params[:4], atol=3)


def test_one_coefficient_is_enough_for_a_lens_of_one() -> None:
    ladder = climbed(scanned("simple_radial", {"k1": K1})[0])
    assert ladder.best.rung == NARROW[0]
    assert "no longer lens" in ladder.reason


@pytest.mark.slow
def test_tangential_terms_are_found_on_a_rig_that_turns() -> None:
    truth = {"k1": K1, "k2": K2, "p1": 2e-3, "p2": -3e-3}
    problem, true = scanned("radtan", truth)
    ladder = climbed(problem)
    assert ladder.best.rung == Rung("radtan")
    assert ladder.best.gain_px > LEAST_GAIN_PX and "standard errors" in ladder.reason
    assert ladder.best.shift_centre_px > 2  # what the shorter lens had made of them
    for found, camera in zip(ladder.best.estimate.cameras, true.cameras, strict=True):
        np.testing.assert_allclose(found.params[:4], camera.params[:4], atol=4)


@pytest.mark.slow
def test_a_gain_beyond_chance_but_within_what_features_err_in_common_is_refused() -> None:
    truth = {"k1": K1, "k2": K2, "p1": 3e-4, "p2": -3e-4}
    ladder = climbed(scanned("radtan", truth, sigma_px=0.02)[0])
    tangential = ladder.rungs[NARROW.index(Rung("radtan"))]
    assert tangential.gain_sigmas > 3
    assert 0 < tangential.gain_px < LEAST_GAIN_PX * 2**0.5
    assert "less than the" in tangential.verdict
    assert ladder.best.rung == Rung("radial")


@pytest.mark.slow
def test_k3_is_found_without_tangential_terms() -> None:
    ladder = climbed(scanned("brown", {"k1": K1, "k2": 0.12, "k3": -0.3}, frames=24)[0])
    assert ladder.best.rung == Rung("brown", ("p1", "p2"))
    for camera in ladder.best.estimate.cameras:
        assert camera.named()["p1"] == pytest.approx(0, abs=1e-9)
    assert "cam0.p1" not in ladder.best.covariance.stated.names


def test_a_lens_that_is_given_stays() -> None:
    problem, _ = scanned("radial", {"k1": K1, "k2": K2})
    cameras = problem.initial.cameras
    ladder = climbed(problem, autos=[1])
    assert {r.estimate.cameras[0].lens for r in ladder.rungs} == {"radial"}
    assert [r.estimate.cameras[1].lens for r in ladder.rungs] == [r.lens for r in NARROW]
    assert problem.initial.cameras == cameras


def test_the_same_ladder_every_time_and_every_rung_is_told() -> None:
    problem, _ = scanned("radial", {"k1": K1, "k2": K2}, rig="mono")
    told: list[tuple[int, int]] = []
    first, second = (
        climb(problem, lambda _: GraphOptions(), [0], 1.0, 1500, lambda *at: told.append(at))
        for _ in range(2)
    )
    assert [r.held_out_px for r in first.rungs] == [r.held_out_px for r in second.rungs]
    assert told[: len(NARROW)] == [(i + 1, len(NARROW) + 1) for i in range(len(NARROW))]
    for result in first.rungs:
        assert result.verdict and 0.8 * SIGMA_PX < result.held_out_px < 2 * SIGMA_PX


def test_too_few_frames_to_hold_any_out_leave_an_ordinary_lens() -> None:
    problem, _ = scanned("radtan", {"k1": K1, "p2": 3e-3}, rig="mono", frames=3)
    ladder = climbed(problem)
    assert (ladder.chosen, ladder.n_frames) == (UNJUDGED, 0)
    assert "no frame could be held out" in ladder.reason
    assert all(r.verdict != TAKEN for r in ladder.rungs)


def test_wide_lenses_have_a_ladder_of_their_own() -> None:
    camera = Camera("", "kannala_brandt", (640, 480), np.array([300.0, 300, 320, 240, 0, 0, 0, 0]))
    assert rungs_for([camera]) == WIDE


# ---- its parts -----------------------------------------------------------------------------


def test_a_rung_holds_what_it_holds_in_start_and_prior() -> None:
    problem, _ = scanned("radtan", {"k1": K1, "k2": K2, "p1": 1e-3})
    changed, options = on_rung_of(problem, NARROW[3], lambda _: GraphOptions(), [0])
    names = list(changed.initial.cameras[0].names)
    held = [names.index(name) for name in ("p1", "p2")]
    assert not options.lens_priors[0].free[held].any()
    assert options.lens_priors[0].free.sum() == len(names) - 2
    assert options.lens_priors[1].free.all()
    assert (changed.initial.cameras[0].params[held] == 0).all()
    assert changed.initial.cameras[1] is problem.initial.cameras[1]


def test_thinning_keeps_whole_tracks_and_every_frame() -> None:
    problem, _ = scanned("radial", {"k1": K1})
    thin = thinned(problem, 1000)
    assert len(thin.observations) < 0.7 * len(problem.observations)
    assert thin.frame_names == problem.frame_names
    assert np.bincount(thin.observations.frame).min() > 40
    length = np.bincount(thin.observations.point)
    assert length.min() >= MIN_TRACK_LENGTH
    assert thinned(problem, 10**9).observations is problem.observations


def test_the_gain_is_the_paired_mean_and_its_error_that_of_frames() -> None:
    before, after = np.array([1.0, 3, 5, np.nan, 2]), np.array([0.0, 1, 5, 1, np.nan])
    mean, error, n_frames = paired_gain(before, after, np.array([0, 0, 1, 1, 2]))
    assert (mean, n_frames) == (1.0, 2)
    # frame 0 gains 1 and 2, 1 more than the mean in all; frame 1 gains 0, 1 less
    assert error == pytest.approx((2 / 1 * (1 + 1)) ** 0.5 / 3)
    assert paired_gain(before, np.full(5, np.nan), np.zeros(5, np.int64)) == (0.0, 0.0, 0)


def tiny() -> tuple[Problem, GraphOptions]:
    problem, true = scanned("simple_radial", {"k1": K1}, rig="mono", frames=6, points=400)
    problem = replace(problem, initial=true)
    keep = well_seen(problem.observations, np.ones(len(problem.observations), dtype=bool))
    length = np.bincount(problem.observations.point[keep], minlength=len(true.points))
    chosen = np.flatnonzero(length >= 5)[:20]
    keep &= np.isin(problem.observations.point, chosen)
    problem = compact(problem, problem.observations.subset(keep))
    camera = true.cameras[0]
    known = {"fx": 3.0, "fy": 3.0, "cx": 3.0, "cy": 3.0, "k1": 0.01}
    prior = stated_lens_prior(camera, weak_lens_prior(camera), camera.named(), known, [])
    return problem, GraphOptions(SIGMA_PX, "none", np.inf, (prior,))


def test_predictions_cost_what_a_dense_computation_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs.held_out, "RELATIVE_TOLERANCE", 1e-12)
    monkeypatch.setattr(graphs.held_out, "RESECTION_TOLERANCE", 1e-12)
    problem, options = tiny()
    costs = held_out_costs(problem, options, 3)
    dense = dense_costs(problem, options, 3)
    assert np.isfinite(costs).sum() > 80
    np.testing.assert_array_equal(np.isfinite(costs), np.isfinite(dense))
    known = np.isfinite(costs)
    np.testing.assert_allclose(costs[known], dense[known], rtol=1e-3, atol=1e-4)


def dense_costs(problem: Problem, options: GraphOptions, n_folds: int) -> FloatArray:
    """The same with scipy, everything in one vector, the gauge left to the minimum-norm step."""
    seen, costs = problem.observations, np.full(len(problem.observations), np.nan)
    for fold in range(n_folds):
        train = seen.frame % n_folds != fold
        enough = np.bincount(seen.point[train], minlength=seen.point.max() + 1) >= MIN_TRACK_LENGTH
        fitted = dense_fit(problem.initial, seen.subset(train & enough[seen.point]), options)
        for frame in range(fold, len(problem.frame_names), n_folds):
            rows = (seen.frame == frame) & enough[seen.point]
            if rows.sum() >= graphs.held_out.MIN_IN_FRAME:
                costs[rows] = dense_resection(fitted, seen.subset(rows), frame)
    return costs


def dense_fit(start: Estimate, seen: Observations, options: GraphOptions) -> Estimate:
    (prior,), (camera,) = options.lens_priors, start.cameras
    root = np.linalg.cholesky(prior.information()).T
    n, n_frames = camera.params.size, len(start.rig_from_world)

    def at(x: FloatArray) -> Estimate:
        turns, points = x[n : n + 6 * n_frames].reshape(-1, 6), x[n + 6 * n_frames :]
        return replace(
            start,
            cameras=(replace(camera, params=camera.params + x[:n]),),
            rig_from_world=tuple(
                Transform.exp(turn[:3], turn[3:]) @ t
                for turn, t in zip(turns, start.rig_from_world, strict=True)
            ),
            points=start.points + points.reshape(-1, 3),
        )

    def residuals(x: FloatArray) -> FloatArray:
        here = at(x)
        pixels = residuals_px(here, seen).ravel() / SIGMA_PX
        return np.concatenate([pixels, root @ (here.cameras[0].params - prior.mean)])

    zero = np.zeros(n + 6 * n_frames + start.points.size)
    return at(least_squares(residuals, zero, x_scale="jac").x)


def dense_resection(fitted: Estimate, seen: Observations, frame: int) -> FloatArray:
    """Costs (n,) of one frame's observations where it fits best."""

    def residuals(x: FloatArray) -> FloatArray:
        moved = list(fitted.rig_from_world)
        moved[frame] = Transform.exp(x[:3], x[3:]) @ moved[frame]
        return residuals_px(replace(fitted, rig_from_world=tuple(moved)), seen).ravel() / SIGMA_PX

    left: FloatArray = least_squares(residuals, np.zeros(6)).fun.reshape(-1, 2)
    return np.asarray((left**2).sum(axis=1) / 2)


def test_frames_find_their_place_from_a_wrong_one_despite_mismatches() -> None:
    problem, true = scanned("radial", {"k1": K1, "k2": K2})
    rng = np.random.default_rng(1)
    seen = problem.observations
    wrong = rng.random(len(seen)) < 0.05
    seen = replace(seen, pixels=np.where(wrong[:, None], 100.0, seen.pixels))
    moved = replace(
        true,
        rig_from_world=tuple(
            Transform.exp(0.02 * rng.standard_normal(3), 0.02 * rng.standard_normal(3)) @ t
            for t in true.rig_from_world
        ),
    )
    options = GraphOptions(sigma_px=SIGMA_PX)
    found, costs = resected(moved, seen, options)
    _, best = resected(true, seen, options)
    np.testing.assert_allclose(costs, best, rtol=1e-2, atol=1e-2)
    assert np.median(costs[~wrong]) < 1 < np.median(costs[wrong])
    for a, b in zip(found.rig_from_world, true.rig_from_world, strict=True):
        np.testing.assert_allclose(a.translation, b.translation, atol=0.01)


def test_what_is_seen_well_is_a_fixed_point() -> None:
    problem, _ = scanned("radial", {"k1": K1}, rig="mono", frames=5, points=300)
    seen = problem.observations
    keep = well_seen(seen, seen.frame != 2)
    assert not keep[seen.frame == 2].any()
    length = np.bincount(seen.point[keep])
    in_frame = np.bincount(seen.frame[keep])
    assert length[length > 0].min() >= MIN_TRACK_LENGTH
    assert in_frame[in_frame > 0].min() >= graphs.held_out.MIN_IN_FRAME


def test_a_frame_that_sees_little_is_not_predicted() -> None:
    problem, true = scanned("simple_radial", {"k1": K1}, rig="mono", frames=8, points=300)
    seen = problem.observations
    options, well = GraphOptions(SIGMA_PX), well_seen(seen, seen.frame % 4 != 2)
    known = np.isin(seen.point, seen.point[well])  # without the fold of frame 2
    for count, told in ((graphs.held_out.MIN_IN_FRAME, True), (8, False)):
        few = np.flatnonzero((seen.frame == 2) & known)[:count]
        keep = np.isin(np.arange(len(seen)), few) | (seen.frame != 2)
        thin = replace(problem, initial=true, observations=seen.subset(keep))
        costs = held_out_costs(thin, options, 4)
        assert np.isfinite(costs[thin.observations.frame == 2]).all() == told
        assert np.isfinite(costs[thin.observations.frame == 1]).mean() > 0.5


# ---- what refuses a rung -------------------------------------------------------------------


def test_every_condition_refuses_by_itself() -> None:
    good = {"gain_px": 0.03, "least_px": 0.01, "gain_sigmas": 4.0, "n_frames": 20, "weak": ()}
    needed = student.ppf(1 - SIGNIFICANCE, 19)  # one-sided, the frames are the sample
    assert _verdict(**good) == _verdict(**good | {"gain_sigmas": needed + 0.01}) == TAKEN
    for changed, words in (
        ({"n_frames": 1}, "not judged"),
        ({"gain_px": -0.03}, "no better"),
        ({"gain_px": 0.009}, "removes 0.009 px, less than the 0.010 px"),
        ({"gain_sigmas": needed - 0.01}, f"better by {needed - 0.01:.1f} standard errors, less"),
        ({"weak": ("cam0.k3", "cam1.k3")}, "leaves cam0.k3, cam1.k3 undetermined"),
    ):
        assert _verdict(**good | changed).startswith(words)


def trial(
    rung: Rung, cost: float, model: float = 1e-4, stated: float = 1e-4, of_board: bool = False
) -> _Trial:
    """Of one camera: the same cost in 30 frames, but for a little; sigmas of its last term."""
    camera = Camera("cam0", rung.lens, (640, 480), nominal_params(rung.lens, (640, 480), 500.0))
    name = (f"cam0.{rung.coefficients[-1]}",)
    sigmas = (Covariance(name, np.array([[sigma**2]])) for sigma in (model, stated))
    covariance = SimpleNamespace(**dict(zip(("model", "stated"), sigmas, strict=True)))
    seen = SimpleNamespace(frame=np.arange(300) % 30)
    graph = SimpleNamespace(problem=SimpleNamespace(observations=seen, of_board_alone=of_board))
    costs = cost * (1 + 1e-6 * np.random.default_rng(len(rung.coefficients)).random(300))
    return _Trial(rung, graph, SimpleNamespace(cameras=(camera,)), covariance, costs)


def test_more_coefficients_have_to_gain_more() -> None:
    """As the root of their number: 0.012 px is enough for one, not for two."""
    one, two, four = Rung("simple_radial"), Rung("radial"), Rung("radtan")
    gain = 0.012**2
    taken = _judged([trial(one, 1.0), trial(two, 1.0 - gain)], 0, [0], 1.0)
    assert taken.gain_px == pytest.approx(0.012, rel=0.02) and taken.verdict == TAKEN
    refused = _judged([trial(two, 1.0), trial(four, 1.0 - gain)], 0, [0], 1.0)
    assert refused.verdict.endswith("less than the 0.014 px that it has to")
    enough = _judged([trial(two, 1.0), trial(four, 1.0 - 0.015**2)], 0, [0], 1.0)
    assert enough.verdict == TAKEN


def test_a_term_is_weak_by_the_models_sigma_not_the_stated() -> None:
    rung = Rung("brown", ("p1", "p2"))  # of k3 a sigma of 1 is believed
    assert _weak(trial(rung, 1.0, model=0.1, stated=5.0), [0]) == ()
    assert _weak(trial(rung, 1.0, model=0.71, stated=0.1), [0]) == ("cam0.k3",)
    weak = _judged([trial(Rung("radial"), 1.0), trial(rung, 0.9, model=0.8)], 0, [0], 1.0)
    assert weak.verdict == "leaves cam0.k3 undetermined"


def test_a_stated_prior_is_kept_on_every_rung() -> None:
    problem, _ = scanned("radial", {"k1": K1, "k2": K2}, rig="mono")

    def options_for(at: Problem) -> GraphOptions:
        camera = at.initial.cameras[0]
        prior = stated_lens_prior(camera, weak_lens_prior(camera), {"fx": 600.0}, {}, ["fx"])
        params = prior.held(camera.params)
        assert params[0] == 600.0
        return GraphOptions(lens_priors=(prior,))

    for rung in NARROW:
        _, options = on_rung_of(problem, rung, options_for, [0])
        assert not options.lens_priors[0].free[0]
        assert options.lens_priors[0].mean[0] == 600.0


def test_a_board_settles_the_tangential_terms_unless_they_are_worse() -> None:
    def verdict(of_board: bool, cost: float, sigma: float = 1e-4, lens: LensName = "radtan") -> str:
        longer = trial(Rung(lens), cost, sigma, sigma, of_board)
        return _judged([trial(Rung("radial"), 1.0), longer], 0, [0], 0.05).verdict

    assert verdict(True, 1 - 1e-5) == BY_BOARD
    assert BY_BOARD not in (verdict(False, 1 - 1e-5), verdict(True, 1.1))  # of a scan; worse
    assert BY_BOARD not in (verdict(True, 1 - 1e-5, 1.0), verdict(True, 1 - 1e-5, lens="brown"))

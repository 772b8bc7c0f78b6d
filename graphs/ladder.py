"""Which lens a scan asks for: a ladder of lenses, judged on frames that they were not fitted to.

Every rung adds coefficients. It is taken where frames that were held out say that it is better, by
more than chance and by more than features err in common, and where the data determine what it adds.
The residuals of the fit itself are no judge: they always prefer the longest lens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.camera import Camera, fit_lens
from graphs.frames import FloatArray
from graphs.held_out import held_out_costs
from graphs.lenses import LENSES, LensName
from graphs.priors import DISTORTION_SIGMA, stated_lens_prior, weak_lens_prior
from graphs.problem import Estimate, IntArray, KnownBaseline, Problem
from graphs.refine import refine
from graphs.selection import compact, select_tracks
from graphs.solve import solve
from graphs.stated_covariance import CalibrationCovariance, calibration_covariance

# A gain is to be beyond chance: one-sided, with the frames as the sample. Of 231 simulated scans of
# 25 frames (one or two cameras, six lenses) 4 were given more than they had at 5 %, 3 at 1 %, 7 at
# 16 %; 47, 62 and 31 less, most of them of one camera, where p1, p2 = 6e-4 stay in the noise. With
# 5 % the principal point of two cameras is then 0.84 px off, 0.92 px with radtan throughout and 5.4
# px with radial; of one camera 1.5, 1.3 and 3.1 px. Real frames err together: of six neighbouring
# views of the fountain p1 and p2 remove 0.015 px, by chance at 1.3 %, and move the principal point
# by 8 px; on the corridor they are beyond 0.1 %.
SIGNIFICANCE = 0.01
# And beyond what features err in common, in held-out frames as in all others, which no number of
# frames exposes: so much for each coefficient, as root of the sum of squares. The fountain's
# photographs are free of distortion; k2, p1 and p2 still remove up to 0.013 px there, with k3 0.015
# px, 2.3 standard errors, and move the principal point by 3 to 5 px. On the corridor, whose boards
# say p2 = 0.003, p1 and p2 remove 0.019 to 0.025 px, on the street 0.08 px. In units of the noise
# the fountain's gain is as large as the corridor's, and its p1 is 6 stated sigmas from zero.
LEAST_GAIN_PX = 0.01
# Of the noise of a board's corners, 0.02 to 0.1 px, which do not drift as features do: a board seen
# in seven views showed a missing p1, p2 by 0.006 px, which were 7 sigmas of cx.
LEAST_GAIN_SHARE = 0.05
# Of the sigma believed of a coefficient before any image, what the data may leave by the model.
# Rational's six coefficients keep 0.7 of it on the fountain; of the rungs below, none on the three
# real scans keeps so much. By the stated sigma the corridor's p1 keeps 0.8: the model is meant.
MOST_SIGMA_LEFT = 0.7
# Tracks are drawn by lot, not by their leverage: those lie where common errors bend a lens most,
# and raised the fountain's false gain from p1, p2 to 0.02 px, 4 standard errors.
LADDER_OBSERVATIONS = 20_000  # with 40,000 the same lenses but for k3, at twice the cost
LEAST_IN_FRAME = 50  # observations that the lot leaves a frame
N_FOLDS = 4  # with 5, 8 and 11 gains differ by up to 0.006 px, for up to three times the cost
RELATIVE_TOLERANCE, MOST_STEPS = 1e-6, 60


@dataclass(frozen=True)
class Rung:
    """A lens, and those of its coefficients that are held at their nominal values."""

    lens: LensName
    held: tuple[str, ...] = ()

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Those that are estimated."""
        return tuple(name for name in LENSES[self.lens].coefficients if name not in self.held)

    @property
    def label(self) -> str:
        return self.lens + (f" without {', '.join(self.held)}" if self.held else "")


# p1 and p2 before k3: where either would do, they bring the focal length nearer on both rigs.
NARROW = (
    Rung("simple_radial"),
    Rung("radial"),
    Rung("radtan"),
    Rung("brown", ("p1", "p2")),
    Rung("brown"),
)
# eucm and double_sphere do not compete: on simulated fisheyes of any of the three they differ from
# kannala_brandt by 0.03 px of held-out error, and by 0.1 px of the principal point.
WIDE = (Rung("kannala_brandt", ("k3", "k4")), Rung("kannala_brandt"))
UNJUDGED = 1  # the rung where no frame can be held out: what most lenses need
FIRST, TAKEN = "the first rung", "taken"
# What a principal point makes up for in every single frame, no frame held out misses: with p1, p2
# left out, cx of simulated boards erred by 5 to 10 sigmas, and the error held out by 3 % of the
# noise. A board tells them apart, whatever frames say, unless they say that it is worse.
BY_BOARD = "taken: a board tells p1, p2 from the principal point"
CLEARLY_WORSE = -2.0  # standard errors
TANGENTIAL = Rung("radtan")


@dataclass(frozen=True)
class RungResult:
    """How one rung did, against the one that stood when it was tried."""

    rung: Rung
    graph: CalibrationGraph  # of the ladder's share of the tracks
    estimate: Estimate  # its optimum
    covariance: CalibrationCovariance
    held_out_px: float  # robust rms of a coordinate in frames that nothing was fitted to
    against: int  # the rung that it is compared with; of the first itself
    gain_px: float  # error of a coordinate that it removes in held-out frames; negative: adds
    gain_sigmas: float  # the decrease of its square over the standard error of that
    shift_focal_px: float  # largest change of any fx, fy
    shift_centre_px: float  # and of any principal point
    weak: tuple[str, ...]  # `camera.k3`, ...: coefficients that are left to belief
    verdict: str  # "taken", or why not


@dataclass(frozen=True)
class Ladder:
    """Every rung in order, the one that is chosen, and why in words."""

    rungs: tuple[RungResult, ...]
    chosen: int
    reason: str
    n_frames: int  # that were held out in turn
    n_observations: int
    sigma_px: float  # of one coordinate, with the longest lens: in terms of it frames are compared

    @property
    def best(self) -> RungResult:
        return self.rungs[self.chosen]


@dataclass(frozen=True)
class _Trial:
    """A rung at its optimum, and what its predictions cost."""

    rung: Rung
    graph: CalibrationGraph
    estimate: Estimate
    covariance: CalibrationCovariance
    costs: FloatArray  # (n_obs,) NaN where nothing was predicted

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self.estimate.cameras


def climb(
    problem: Problem,
    options_for: Callable[[Problem], GraphOptions],
    autos: Sequence[int],
    min_parallax_deg: float,
    max_observations: int = LADDER_OBSERVATIONS,
    on_rung: Callable[[int, int], None] | None = None,
) -> Ladder:
    """Try every rung on the cameras `autos`, which climb together, and choose one.

    problem: where to start, as for `refine`. options_for: options with priors, for a problem whose
    `autos` have a rung's lens; what a rung holds is held here. on_rung(done, total) is called along
    the way. Raises ValueError as `refine` and `calibration_covariance`.
    """
    rungs = rungs_for([problem.initial.cameras[index] for index in autos])
    # What the longest lens cannot explain is a mismatch; a shorter one would set corners aside.
    start, options = on_rung_of(problem, rungs[-1], options_for, autos)
    thin = thinned(select_tracks(start, min_parallax_deg), max_observations)
    cleaned = refine(thin, options, min_parallax_deg, len(thin.observations))
    place, sigma_px = cleaned.problem, cleaned.sigma_px
    trials: list[_Trial] = []
    results: list[RungResult] = []
    chosen = 0
    for index, rung in enumerate(rungs):
        if on_rung is not None:
            on_rung(index + 1, len(rungs) + 1)
        trials.append(_tried(place, rung, options_for, autos, sigma_px))
        place = replace(place, initial=trials[-1].estimate)
        results.append(_judged(trials, chosen, autos, sigma_px))
        if results[-1].verdict.startswith(TAKEN):
            chosen = index
    frames = np.unique(place.observations.frame[np.isfinite(trials[0].costs)])
    if len(frames) < 2:
        chosen = UNJUDGED
    reason = _reason(results, chosen, len(frames))
    return Ladder(tuple(results), chosen, reason, len(frames), len(place.observations), sigma_px)


def rungs_for(cameras: Sequence[Camera]) -> tuple[Rung, ...]:
    """The ladder of cameras that start with these lenses."""
    return WIDE if any(LENSES[camera.lens].wide for camera in cameras) else NARROW


def on_rung_of(
    problem: Problem,
    rung: Rung,
    options_for: Callable[[Problem], GraphOptions],
    autos: Sequence[int],
) -> tuple[Problem, GraphOptions]:
    """The problem with a rung's lens on the cameras `autos`, and its options: both hold what the
    rung holds."""
    cameras = list(problem.initial.cameras)
    for index in autos:
        cameras[index] = fit_lens(cameras[index], rung.lens, free=rung.coefficients)[0]
    problem = replace(problem, initial=replace(problem.initial, cameras=tuple(cameras)))
    options = options_for(problem)
    priors = list(options.lens_priors or (weak_lens_prior(camera) for camera in cameras))
    for index in autos:
        priors[index] = stated_lens_prior(cameras[index], priors[index], {}, {}, rung.held)
    return problem, replace(options, lens_priors=tuple(priors))


def thinned(problem: Problem, max_observations: int) -> Problem:
    """The problem with about so many observations, of tracks by lot, the same ones every time.

    No frame is left with fewer than LEAST_IN_FRAME that had them. Of the measured scale only
    baselines are kept: no lens depends on them.
    """
    seen = problem.observations
    baselines = tuple(one for one in problem.scales if isinstance(one, KnownBaseline))
    problem = replace(problem, scales=baselines)
    if len(seen) <= max_observations:
        return problem
    length = np.bincount(seen.point, minlength=len(problem.initial.points))
    lot = np.random.default_rng(0).permutation(len(length))
    kept = np.zeros(len(length), dtype=bool)
    kept[lot[np.cumsum(length[lot]) <= max_observations]] = True
    in_frame = np.bincount(seen.frame[kept[seen.point]], minlength=len(problem.frame_names))
    kept[seen.point[(in_frame < LEAST_IN_FRAME)[seen.frame]]] = True
    kept |= problem.known  # what says most of a lens
    return compact(problem, seen.subset(kept[seen.point]))


def _tried(
    problem: Problem,
    rung: Rung,
    options_for: Callable[[Problem], GraphOptions],
    autos: Sequence[int],
    sigma_px: float,
) -> _Trial:
    """Solve from a neighbouring rung's optimum, and predict each frame from the others."""
    problem, options = on_rung_of(problem, rung, options_for, autos)
    options = replace(options, sigma_px=sigma_px)
    graph = build(problem, options)
    estimate, values, _ = solve(graph, MOST_STEPS, RELATIVE_TOLERANCE)
    covariance = calibration_covariance(graph, estimate, values)
    try:
        costs = held_out_costs(replace(problem, initial=estimate), options, N_FOLDS)
    except ValueError:  # too few frames see too little together
        costs = np.full(len(problem.observations), np.nan)
    return _Trial(rung, graph, estimate, covariance, costs)


def _judged(
    trials: Sequence[_Trial], standing: int, autos: Sequence[int], sigma_px: float
) -> RungResult:
    """The last trial against the one that stands."""
    trial, against = trials[-1], trials[standing]
    gain, error, n_frames = paired_gain(
        against.costs, trial.costs, trial.graph.problem.observations.frame
    )
    gain_px = sigma_px * float(np.sign(gain) * abs(gain) ** 0.5)
    gain_sigmas = gain / error if error > 0 else 0.0
    weak = _weak(trial, autos)
    added = len(trial.rung.coefficients) - len(against.rung.coefficients)
    least_px = LEAST_GAIN_PX
    if trial.graph.problem.of_board_alone:
        least_px = min(least_px, LEAST_GAIN_SHARE * sigma_px)
    least_px *= max(added, 1) ** 0.5
    moved = np.array([trial.cameras[i].params[:4] - against.cameras[i].params[:4] for i in autos])
    costs = trial.costs[np.isfinite(trial.costs)]
    verdict = FIRST
    if len(trials) > 1:
        verdict = _verdict(gain_px, least_px, gain_sigmas, n_frames, weak)
        told = not weak and n_frames > 1 and gain_sigmas > CLEARLY_WORSE
        of_board = trial.graph.problem.of_board_alone
        if verdict != TAKEN and trial.rung == TANGENTIAL and told and of_board:
            verdict = BY_BOARD
    return RungResult(
        trial.rung,
        trial.graph,
        trial.estimate,
        trial.covariance,
        sigma_px * float(costs.mean()) ** 0.5 if costs.size else float("nan"),
        standing,
        gain_px,
        gain_sigmas,
        float(np.abs(moved[:, :2]).max()),
        float(np.linalg.norm(moved[:, 2:], axis=1).max()),
        weak,
        verdict,
    )


def paired_gain(before: FloatArray, after: FloatArray, frame: IntArray) -> tuple[float, float, int]:
    """Mean decrease from costs `before` to `after` (n_obs,), its standard error, and how many
    frames it comes from.

    In squared sigmas of one coordinate. Where either is NaN, an observation does not count. What
    shares a frame (n_obs,) may err together.
    """
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return 0.0, 0.0, 0
    gains = (before - after)[both]
    mean = float(gains.mean())
    frames, of_frame = np.unique(frame[both], return_inverse=True)
    spread = np.bincount(of_frame, gains - mean)
    finite = len(frames) / max(len(frames) - 1, 1)
    return mean, float((finite * (spread**2).sum()) ** 0.5 / len(gains)), len(frames)


def _weak(trial: _Trial, autos: Sequence[int]) -> tuple[str, ...]:
    """Free coefficients of which the data say little."""
    sigma = trial.covariance.model.sigma
    return tuple(
        f"{camera.name}.{name}"
        for camera in (trial.cameras[index] for index in autos)
        for name in trial.rung.coefficients
        if sigma.get(f"{camera.name}.{name}", 0.0) > MOST_SIGMA_LEFT * DISTORTION_SIGMA[name]
    )


def _verdict(
    gain_px: float, least_px: float, gain_sigmas: float, n_frames: int, weak: Sequence[str]
) -> str:
    if n_frames < 2:
        return "not judged: no frame sees enough that the others see"
    needed = float(student.ppf(1 - SIGNIFICANCE, n_frames - 1))
    if gain_px < 0:
        return "no better"
    if gain_px < least_px:
        return f"removes {gain_px:.3f} px, less than the {least_px:.3f} px that it has to"
    if gain_sigmas < needed:
        return f"better by {gain_sigmas:.1f} standard errors, less than {needed:.1f}: chance"
    if weak:
        return f"leaves {', '.join(weak)} undetermined"
    return TAKEN


def _reason(results: Sequence[RungResult], chosen: int, n_frames: int) -> str:
    best = results[chosen]
    if n_frames < 2:
        return f"{best.rung.label}: no frame could be held out to judge a lens by"
    if chosen == 0:
        return f"{best.rung.label}: no longer lens predicts frames so much better"
    if best.verdict == BY_BOARD:
        return f"{best.rung.label}: {BY_BOARD.removeprefix('taken: ')}"
    return (
        f"{best.rung.label}: removes {best.gain_px:.3f} px of error that "
        f"{results[best.against].rung.label} leaves in frames held out "
        f"({best.gain_sigmas:.1f} standard errors)"
    )

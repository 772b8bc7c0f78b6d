"""The scan's twin: the same geometry and noise simulated anew, and calibrated again.

Its truth is known, so it shows whether the stated sigmas cover for this very scan: where the
geometry is too weak for sigmas to mean anything, or the loss does not suit the noise, they do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from graphs.build import GraphOptions
from graphs.frames import FloatArray
from graphs.jackknife import change, tangent
from graphs.joint_prior import believed, centred_covariance, displaced, parameters
from graphs.model_covariance import calibration_columns
from graphs.noise import redundancies, residual_lengths
from graphs.problem import BoardPoints, Estimate, PriorRig, Problem, residuals_px
from graphs.refine import Refinement, refine
from graphs.scale import length_of
from graphs.stated_covariance import calibration_covariance, factors

INTERVAL = 1.959964  # sigmas to both sides that hold 95 %


@dataclass(frozen=True)
class Certificate:
    """How the stated sigmas did on twins of a scan."""

    names: tuple[str, ...]
    z: FloatArray  # (n_trials, n) error over stated sigma
    nees: FloatArray  # (n_trials,) squared error over the stated covariance, a degree of freedom
    model_nees: FloatArray  # (n_trials,) the same over the model's
    failed: int  # trials that could not be solved

    @property
    def coverage(self) -> FloatArray:
        """Share (n,) of the trials whose 95 % interval holds the truth, of each parameter."""
        result: FloatArray = (np.abs(self.z) < INTERVAL).mean(0)
        return result

    @property
    def mean_nees(self) -> tuple[float, float]:
        """Mean of `nees` over the trials, 1 where sigmas are true, and its standard error."""
        return float(self.nees.mean()), float(self.nees.std(ddof=1) / len(self.nees) ** 0.5)


def certify(
    refinement: Refinement,
    trials: int,
    seed: int,
    min_parallax_deg: float,
    adaptive: bool = False,
    on_trial: Callable[[int, int], None] | None = None,
) -> Certificate:
    """Simulate, solve and judge a scan's twin so many times, two at least.

    adaptive: as it was in `refine`. on_trial(done, total) is called after each. Raises ValueError
    when fewer than two succeed, and when every parameter is held.
    """
    rng, options = np.random.default_rng(seed), refinement.graph.options
    names: tuple[str, ...] = ()
    judged: list[tuple[FloatArray, float, float]] = []
    if not calibration_columns(refinement.graph, refinement.estimate)[0].size:
        raise ValueError("every parameter is held: there is no sigma to certify; leave certify out")
    for number in range(trials):
        twin = twin_problem(refinement, rng)
        with suppress(ValueError):  # counted as failed
            names, found = _judge(twin, refinement.estimate, options, min_parallax_deg, adaptive)
            judged.append(found)
        if on_trial is not None:
            on_trial(number + 1, trials)
    if len(judged) < 2:
        raise ValueError(
            f"only {len(judged)} of {trials} simulated twins of this scan could be solved, and two "
            "are needed: the scan hardly determines its cameras; give --certify more, or scan again"
        )
    z, nees, model_nees = (np.array(column) for column in zip(*judged, strict=True))
    return Certificate(names, z, nees, model_nees, trials - len(judged))


def twin_problem(refinement: Refinement, rng: np.random.Generator) -> Problem:
    """The optimum seen anew: exact projections, and lengths of noise drawn from the residuals'.

    Directions are drawn evenly, each error is scaled and shaped as the noise of its observation,
    and each measured distance errs by its sigma, as does an earlier calibration that is believed.
    """
    problem, estimate = refinement.problem, refinement.estimate
    seen = problem.observations
    left = residuals_px(estimate, seen)
    good = np.isfinite(left[:, 0])
    before_fit = np.sqrt(redundancies(problem, refinement.graph.options))
    drawn = rng.choice((residual_lengths(problem, left) / before_fit)[good], len(seen))
    angle = rng.uniform(0, 2 * np.pi, len(seen))
    a, b, c = seen.whitening.T
    y = drawn * np.sin(angle) / c
    noise = np.column_stack([(drawn * np.cos(angle) - b * y) / a, y])
    exact = np.where(good[:, None], seen.pixels + left, seen.pixels)
    scales = tuple(
        replace(one, length_m=length_of(one, estimate) + one.sigma_m * rng.standard_normal())
        for one in problem.scales
    )
    return replace(
        problem,
        initial=estimate,
        observations=replace(seen, pixels=exact + noise),
        scales=scales,
        board=_stated_anew(problem.board, estimate, rng),
        prior=None if problem.prior is None else _drawn_anew(problem.prior, estimate, rng),
    )


def _stated_anew(
    board: BoardPoints | None, truth: Estimate, rng: np.random.Generator
) -> BoardPoints | None:
    """The board with a size and bends stated of it that err by their sigmas from the truth."""
    if board is None or truth.board_shape is None:
        return board
    sigma = board.board.shape_sigma
    mean = truth.board_shape + sigma * rng.standard_normal(len(sigma))
    return replace(board, board=replace(board.board, shape_mean=mean))


def _drawn_anew(prior: PriorRig, truth: Estimate, rng: np.random.Generator) -> PriorRig:
    """An earlier calibration that errs from the truth by its own covariance.

    What is held of it does not err: the sigmas that twins judge are those of the rest given it.
    """
    names, known = parameters(prior), believed(prior)
    held = np.array([name in prior.held for name in names])
    free = np.array([name in known for name in names]) & ~held
    error = np.zeros(len(names))
    if free.any():
        whole = centred_covariance(prior)
        of_held = factors(whole[np.ix_(held, held)])[1] @ whole[np.ix_(held, free)]
        root = factors(whole[np.ix_(free, free)] - of_held.T @ of_held)[0]
        error[free] = root @ rng.standard_normal(root.shape[1])
    return displaced(prior, truth, error)


def _judge(
    twin: Problem,
    truth: Estimate,
    options: GraphOptions,
    min_parallax_deg: float,
    adaptive: bool,
) -> tuple[tuple[str, ...], tuple[FloatArray, float, float]]:
    """Names, z (n,) and NEES of the stated and the model covariance of one twin."""
    found = refine(twin, options, min_parallax_deg, len(twin.observations), adaptive=adaptive)
    covariance = calibration_covariance(found.graph, found.estimate, found.values, min_parallax_deg)
    basis, unit = covariance.basis, 1.0
    if basis.unit_camera is not None:
        unit = float(np.linalg.norm(truth.cam_from_rig[basis.unit_camera].translation))
    in_unit, after = truth.scaled(1 / unit), found.estimate.scaled(1 / basis.unit)
    error = tangent(in_unit, basis) @ change(in_unit, after, basis.names)
    squared = [
        float(((factors(matrix)[1] @ error) ** 2).mean())
        for matrix in (covariance.stated.matrix, basis.matrix)
    ]
    sigma = np.sqrt(np.maximum(np.diag(covariance.stated.matrix), 1e-300))
    return basis.names, (error / sigma, squared[0], squared[1])


def worst(certificate: Certificate) -> Iterator[tuple[str, float]]:
    """Parameters and their coverage, the least covered first."""
    order = np.argsort(certificate.coverage, kind="stable")
    yield from ((certificate.names[i], float(certificate.coverage[i])) for i in order)

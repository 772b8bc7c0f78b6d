"""Where do Cholesky, QR and our elimination break down as the motion degenerates? Is it reported?

Method: small scans by one camera whose motion goes continuously from good to only turning, only
driving forward, or facing a plane squarely. The same linear least squares about the truth (frames,
points, lens; gauge held as a calibration holds it) are solved in double precision by Cholesky of
the normal equations and by QR of the Jacobian, both dense with columns scaled to length 1, by
GTSAM's multifrontal Cholesky (gtsam.Marginals) and QR, and by our elimination, with and without its
look at the pivots. The judge is a QR in 64 bits of mantissa, good to a condition of 1e17. A sigma
of a lens parameter off by more than 10 % is wrong; it is stated silently where the solver raises
nothing, and of ours where the covariance that it states does not make the verdict "unusable"
either. With no belief in the lens, and with the weak one that every calibration has; with that, the
scan is also calibrated from its start as `sfm-calib calibrate` does it, and its verdict noted.
Expectation: Cholesky loses all digits at cond(J) = eps^-1/2 = 7e7, QR at eps^-1 = 5e15: found
within a decade and a half, as the median of motions and lenses (where most never fail as far as the
judge sees it stays open), and errors that grow as cond^2 and as cond. Ours states nothing wrong
silently, whatever the motion, and no calibration whose focal length is off by more than four sigmas
or 2 % goes without a word.
Source: Bjorck, Numerical Methods for Least Squares Problems, 1996, 2.4; Demmel, Applied Numerical
Linear Algebra, 1997, 3.4.
Run: sfm-calib run configs/studies/weak_geometry.yaml -o out/weak_geometry
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from experiments.degenerate_motion import MotionName, degenerate_scan
from experiments.dense_squares import OfLens, condition, dense_squares, householder, of_lens
from experiments.linear_solvers import REFUSALS, SOLVERS, Squares
from experiments.runner.protocol import Cell, Row, Study, TrialOptions
from experiments.weak_geometry_answer import answer
from graphs.build import GraphOptions, build
from graphs.covariance import Covariance
from graphs.image_grid import typical_distances
from graphs.observability import observe
from graphs.priors import LensPrior, weak_lens_prior
from graphs.problem import Problem
from graphs.propagation import lens_names
from graphs.reference import build_reference
from graphs.refine import refine
from graphs.stated_covariance import calibration_covariance
from graphs.usable import unusable
from sfm_calib.simulate.rigs import make_rig

NO_BELIEF = 1e15  # sigma of every lens parameter: less than rounding of what any scan says
MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it


class WeakGeometryOptions(TrialOptions):
    """One scan."""

    motion: MotionName = "forward"
    """What the motion goes to: a camera that only turns (panorama), only drives along its axis
    (forward), or sees a plane squarely (facing)."""
    scale: Annotated[float, Field(gt=0, le=1)] = 1.0
    """What is left of what that lacks: 1 is a good scan."""
    belief: Literal["none", "weak"] = "none"
    """In the lens: none, or what a calibration believes of any."""
    lens: Literal["pinhole", "radial"] = "pinhole"
    """Distortion tells a little of the lens even where motion does not."""
    frames: Annotated[int, Field(ge=3, le=50)] = 9
    points: Annotated[int, Field(ge=10, le=200)] = 32
    noise_px: Annotated[float, Field(gt=0, le=10)] = 0.3


def trial(options: WeakGeometryOptions, seed: int) -> Row:
    """Solve one system by all solvers, and calibrate the scan."""
    rng = np.random.default_rng([seed, 0])
    camera = make_rig("mono", options.lens).cameras[0]
    problem = degenerate_scan(
        options.motion, options.scale, camera, options.frames, options.points,
        options.noise_px, rng,
    )  # fmt: skip
    if options.belief == "weak":
        prior = weak_lens_prior(camera)
    else:
        prior = LensPrior(camera.params, np.full(camera.params.size, NO_BELIEF))
    graph_options = GraphOptions(options.noise_px, "none", lens_priors=(prior,))
    graph = build(problem, graph_options)
    exact = dense_squares(graph, graph.initial, problem.initial.points, np.longdouble)
    R, y = householder(exact)
    judge = of_lens(R, y, exact)
    squares = Squares(
        graph,
        build_reference(problem, graph_options),
        dense_squares(graph, graph.initial, problem.initial.points, np.float64),
    )
    row: dict[str, Cell] = {
        "observations": len(problem.observations),
        "condition": condition(R, rng),
        "focal_sigma": float(judge.sigma[0] / camera.params[0]),
        "usable": not doubts(problem, judge),
    }
    for name in SOLVERS:
        row |= compared(name, squares, judge)
    return row | (calibrated(problem, prior) if options.belief == "weak" else {})


def compared(name: str, squares: Squares, judge: OfLens) -> dict[str, Cell]:
    """What a solver makes of a system beside the judge; None of what it refuses.

    sigma_error: the greatest relative error of a sigma; step_error: of the step, measured in
    sigmas; doubted: whether the covariance that it states makes the lens unusable by the verdict.
    """
    try:
        with np.errstate(all="ignore"):
            found = SOLVERS[name](squares)
    except REFUSALS as refused:
        said = " ".join(str(refused).split())
        return {
            f"{name}_sigma_error": None, f"{name}_step_error": None,
            f"{name}_doubted": None, f"{name}_refused": said[:200],
        }  # fmt: skip
    off = (found.step - judge.step) / judge.sigma
    sigma_error = float(np.max(np.abs(found.sigma / judge.sigma - 1)))
    finite = bool(np.isfinite(sigma_error))
    return {
        f"{name}_sigma_error": sigma_error if finite else None,
        f"{name}_step_error": float(np.linalg.norm(off) / np.linalg.norm(judge.step / judge.sigma)),
        f"{name}_doubted": bool(doubts(squares.graph.problem, found)) if finite else None,
        f"{name}_refused": None if finite else "a sigma is no number",
    }


def doubts(problem: Problem, lens: OfLens) -> tuple[str, ...]:
    """What the verdict says of a lens with this covariance."""
    start, seen = problem.initial, problem.observations
    covariance = Covariance(lens_names(start.cameras[0]), lens.covariance)
    distances = typical_distances(start, seen).tolist()
    with np.errstate(all="ignore"):
        return unusable(start, covariance, distances, seen)


def calibrated(problem: Problem, prior: LensPrior) -> dict[str, Cell]:
    """How a calibration of the scan ends, with its noise unknown, and how far off its focal is."""
    try:
        refinement = refine(problem, GraphOptions(lens_priors=(prior,)), MIN_PARALLAX_DEG)
        graph, estimate = refinement.graph, refinement.estimate
        covariance = calibration_covariance(graph, estimate, refinement.values, MIN_PARALLAX_DEG)
    except ValueError as refused:
        return {"verdict": "refused", "said": str(refused)[:200], "off": None, "z": None}
    seen = observe(graph, estimate, covariance.stated, covariance.model, covariance.basis.unit)
    said = [*seen.unusable, *(one.what for one in seen.weak), *seen.lacks]
    if seen.unusable or not refinement.summary.converged:
        verdict = "unusable"
    else:
        verdict = "weak" if said else "nothing"
    true = problem.initial.cameras[0]
    error = estimate.cameras[0].params[0] - true.params[0]
    sigma = covariance.stated.sigma[f"{true.name}.fx"]
    return {
        "verdict": verdict,
        "said": said[0][:200] if said else refinement.summary.reason,
        "off": float(error / true.params[0]),
        "z": float(error / sigma),
    }


STUDY = Study(WeakGeometryOptions, trial, answer)

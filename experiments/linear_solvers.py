"""The same linear least squares by different solvers in double precision: sigmas and a step.

A solver says what it makes of the lens, or raises: LinAlgError, RuntimeError (GTSAM's
IndeterminantLinearSystemException) or ValueError with the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy.linalg

from experiments.dense_squares import DenseSquares, OfLens, of_lens
from graphs.build import CalibrationGraph
from graphs.clusters import homogeneous
from graphs.elimination import NotPositiveDefiniteError
from graphs.frames import FloatArray
from graphs.influence import responses
from graphs.keys import lens_key
from graphs.reference import ReferenceGraph, native_slots
from graphs.system import System, assemble
from graphs.threads import threads


@dataclass(frozen=True)
class Squares:
    """One system in the forms that solvers take."""

    graph: CalibrationGraph  # at its start
    native: ReferenceGraph  # the same from GTSAM's own factors
    dense: DenseSquares  # in double precision


def by_cholesky(squares: Squares) -> OfLens:
    """Normal equations of everything, columns scaled to length 1."""
    A, b = squares.dense.A, squares.dense.b
    R = scipy.linalg.cholesky(A.T @ A)
    return of_lens(R, scipy.linalg.solve_triangular(R, A.T @ b, trans="T"), squares.dense)


def by_qr(squares: Squares) -> OfLens:
    """QR of the Jacobian, columns scaled to length 1."""
    Q, R = scipy.linalg.qr(squares.dense.A, mode="economic")
    return of_lens(R, Q.T @ squares.dense.b, squares.dense)


def by_gtsam_cholesky(squares: Squares) -> OfLens:
    """GTSAM's default: gtsam.Marginals, and multifrontal Cholesky for the step."""
    native = squares.native
    slots = native_slots(native.problem.initial.cameras[0])
    marginals = gtsam.Marginals(native.factors, native.initial)
    covariance = marginals.marginalCovariance(lens_key(0))
    step = native.factors.linearize(native.initial).optimize().at(lens_key(0))
    return OfLens(covariance[np.ix_(slots, slots)], step[slots])


def by_gtsam_qr(squares: Squares) -> OfLens:
    """GTSAM's multifrontal QR; sigmas from R itself, without squaring it again."""
    native = squares.native
    slots = native_slots(native.problem.initial.cameras[0])
    tree = native.factors.linearize(native.initial).eliminateMultifrontal(
        gtsam.Ordering.OrderingType.COLAMD, gtsam.EliminateQR
    )
    conditional = tree.marginalFactor(lens_key(0), gtsam.EliminateQR)  # R() is a view into it
    root = scipy.linalg.solve_triangular(conditional.R(), np.eye(conditional.rows()))[slots]
    return OfLens(root @ root.T, tree.optimize().at(lens_key(0))[slots])


def by_elimination(squares: Squares) -> OfLens:
    """Ours: points eliminated one by one, then Cholesky; refuses what nothing determines."""
    graph, system = squares.graph, system_of(squares.graph)
    columns = graph.layout.columns(lens_key(0))
    covariance = responses(graph, system, columns)[columns]
    return OfLens(covariance, _step(graph, system))


def by_elimination_unchecked(squares: Squares) -> OfLens:
    """The same without looking at the pivots."""
    graph, system = squares.graph, system_of(squares.graph)
    columns = graph.layout.columns(lens_key(0))
    unit = np.zeros((system.elimination.n_columns, len(columns)))
    unit[columns, np.arange(len(columns))] = 1.0
    covariance = system.factorise().solve(unit)[columns]
    return OfLens(covariance, _step(graph, system))


def system_of(graph: CalibrationGraph) -> System:
    """Our normal equations at the graph's start."""
    others, variables = graph.others.linearize(graph.initial), graph.variables(graph.initial)
    points = homogeneous(graph.tracks, graph.problem.initial.points)
    with threads() as pool:
        return assemble(graph.tracks, others, graph.layout, variables, points, pool)


def _step(graph: CalibrationGraph, system: System) -> FloatArray:
    change = system.factorise().solve(-system.gradient)
    return change[graph.layout.columns(lens_key(0))]


SOLVERS: dict[str, Callable[[Squares], OfLens]] = {
    "cholesky": by_cholesky,
    "qr": by_qr,
    "gtsam_cholesky": by_gtsam_cholesky,
    "gtsam_qr": by_gtsam_qr,
    "unchecked": by_elimination_unchecked,
    "ours": by_elimination,
}
REFUSALS = (np.linalg.LinAlgError, RuntimeError, ValueError, NotPositiveDefiniteError)

"""A graph's linear least squares as one dense matrix, points and all, in any precision.

Nothing in common with the kernels or with GTSAM but the values: derivatives by complex steps
(Squire and Trapp, SIAM Review 1998), exact to rounding; the decomposition by Householder's
reflections (Golub and Van Loan, Matrix Computations, 2013, 5.2). In numpy's longdouble, 64 bits of
mantissa on x86, it is the judge of what 53 bits make of the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphs.build import CalibrationGraph
from graphs.frames import FloatArray
from graphs.keys import frame_key, lens_key
from graphs.lenses import LensName
from graphs.problem import IntArray
from graphs.system import jacobian_of

Real = type[np.float64] | type[np.longdouble]
RealArray = NDArray[Any]  # of either
COMPLEX: dict[Real, Any] = {np.float64: np.complex128, np.longdouble: np.clongdouble}
STEP = 1e-100  # its square is nothing beside anything, in either precision
LENSES: tuple[LensName, ...] = ("pinhole", "simple_radial", "radial")


@dataclass(frozen=True)
class DenseSquares:
    """Minimise |A x - b|: columns of the points, then of all other variables, the lens last."""

    A: RealArray  # (m, n), each column of length 1
    b: RealArray  # (m,)
    scale: RealArray  # (n,) lengths that the columns had
    n_lens: int


@dataclass(frozen=True)
class OfLens:
    """What is wanted of a system of equations."""

    covariance: FloatArray  # (n_lens, n_lens)
    step: FloatArray  # (n_lens,) of Gauss and Newton

    @property
    def sigma(self) -> FloatArray:
        """(n_lens,), NaN of what came out negative."""
        with np.errstate(invalid="ignore"):
            result: FloatArray = np.sqrt(np.diag(self.covariance))
        return result


def dense_squares(
    graph: CalibrationGraph, values: gtsam.Values, points: FloatArray, real: Real
) -> DenseSquares:
    """The linearised graph of one camera about GTSAM's values and points (n_points, 3).

    Raises ValueError for lenses other than LENSES, and for a rig.
    """
    A, b = _of_tracks(graph, values, points, real)
    of_others, rhs = jacobian_of(graph.others.linearize(values), graph.layout)
    below = np.zeros((len(rhs), A.shape[1]), real)
    below[:, points.size :] = of_others.toarray()
    A, b = np.concatenate([A, below]), np.concatenate([b, rhs.astype(real)])
    lens = points.size + graph.layout.columns(lens_key(0))
    A = A[:, np.append(np.setdiff1d(np.arange(A.shape[1]), lens), lens)]
    scale = np.sqrt((A * A).sum(0))
    return DenseSquares(A / scale, b, scale, len(lens))


def _of_tracks(
    graph: CalibrationGraph, values: gtsam.Values, points: FloatArray, real: Real
) -> tuple[RealArray, RealArray]:
    """Rows (2 n_obs, n) by points and the layout's columns, and residuals the other way round."""
    camera, seen = graph.problem.initial.cameras[0], graph.problem.observations
    if len(graph.problem.initial.cameras) > 1 or camera.lens not in LENSES:
        raise ValueError(f"dense equations are for one camera with a lens of {', '.join(LENSES)}")
    placed = [values.atPose3(frame_key(i)).matrix() for i in range(len(graph.problem.frame_names))]
    R, c = (np.array(placed)[seen.frame][:, :3, part] for part in (slice(3), 3))
    at = (R, c, points[seen.point], values.atVector(lens_key(0)))
    sigma = graph.options.sigma_px
    A = np.zeros((2 * len(seen), points.size + graph.layout.elimination.n_columns), real)
    columns = _columns(graph, points.size)
    rows = 2 * np.arange(len(seen))
    for column, moved in zip(columns, _moved(at, COMPLEX[real]), strict=True):
        by = _pixels(*moved).imag / real(STEP) / real(sigma)
        A[rows, column], A[rows + 1, column] = by.T
    left = seen.pixels - _pixels(*(part.astype(COMPLEX[real]) for part in at)).real
    return A, (left / real(sigma)).ravel()


def _columns(graph: CalibrationGraph, offset: int) -> Iterator[IntArray]:
    """The column (n_obs,) that each of `_moved` is of."""
    layout, seen = graph.layout, graph.problem.observations
    first = np.array(
        [layout.first_column[frame_key(i)] for i in range(len(graph.problem.frame_names))]
    )
    for part in range(6):
        yield offset + first[seen.frame] + part
    for part in range(3):
        yield 3 * seen.point + part
    for column in layout.columns(lens_key(0)):
        yield np.full(len(seen), offset + column)


def _moved(at: tuple[FloatArray, ...], kind: Any) -> Iterator[tuple[RealArray, ...]]:
    """Rotations, centres, points and lens, each moved by a step along one of its directions.

    A frame moves as GTSAM has it: on the right, rotation first.
    """
    R, c, X, lens = (part.astype(kind) for part in at)
    step = kind(1j * STEP)
    for axis in range(3):
        turned = R.copy()  # R (I + step [axis]x)
        turned[:, :, (axis + 1) % 3] += step * R[:, :, (axis + 2) % 3]
        turned[:, :, (axis + 2) % 3] -= step * R[:, :, (axis + 1) % 3]
        yield turned, c, X, lens
    for axis in range(3):
        yield R, c + step * R[:, :, axis], X, lens
    for axis in range(3):
        yield R, c, X + step * (np.arange(3) == axis), lens
    for index in range(len(lens)):
        yield R, c, X, lens + step * (np.arange(len(lens)) == index)


def _pixels(R: RealArray, c: RealArray, X: RealArray, lens: RealArray) -> RealArray:
    """Pixels (n, 2) of points (n, 3) from rotations (n, 3, 3) world_from_rig and centres (n, 3)."""
    away = X - c
    x, y, z = (sum(R[:, i, k] * away[:, i] for i in range(3)) for k in range(3))
    a, b = x / z, y / z
    square, stretch, power = a * a + b * b, 1.0, 1.0
    for k in lens[4:]:
        power = power * square
        stretch = stretch + k * power
    return np.stack([lens[0] * a * stretch + lens[2], lens[1] * b * stretch + lens[3]], -1)


# ---- decompositions ------------------------------------------------------------------------


def householder(squares: DenseSquares) -> tuple[RealArray, RealArray]:
    """R (n, n), upper triangular, and Q' b (n,), in the precision of the system."""
    whole = np.column_stack([squares.A, squares.b])
    n = squares.A.shape[1]
    for k in range(n):
        v = whole[k:, k].copy()
        length = np.sqrt(v @ v)
        v[0] += length if v[0] >= 0 else -length
        half = v @ v / 2
        if half > 0:
            whole[k:, k:] -= np.outer(v, (v @ whole[k:, k:]) / half)
    return np.triu(whole[:n, :n]), whole[:n, n]


def of_lens(R: RealArray, y: RealArray, squares: DenseSquares) -> OfLens:
    """The lens from R x = y: it stands last, so it needs the last rows alone."""
    k = squares.n_lens
    root = back_substituted(R[-k:, -k:], np.eye(k, dtype=R.dtype)) / squares.scale[-k:, None]
    covariance, step = root @ root.T, root @ y[-k:]
    return OfLens(covariance.astype(np.float64), step.astype(np.float64))


def back_substituted(R: RealArray, rhs: RealArray) -> RealArray:
    """R^-1 rhs of an upper triangular R (n, n), in its precision."""
    x = rhs.copy()
    for k in reversed(range(len(R))):
        x[k] = (x[k] - R[k, k + 1 :] @ x[k + 1 :]) / R[k, k]
    return x


POWER_STEPS = 12  # each brings the weakest direction out by its lead, squared


def condition(R: RealArray, rng: np.random.Generator) -> float:
    """Largest over smallest singular value of R (n, n), by inverse iteration, to a per cent."""
    largest = float(np.linalg.norm(R.astype(np.float64), 2))
    x, longest = rng.standard_normal(len(R)).astype(R.dtype), 0.0
    for _ in range(POWER_STEPS):
        x = x / np.sqrt(x @ x)
        y = back_substituted(R, back_substituted(R.T[::-1, ::-1], x[::-1])[::-1])
        longest, x = float(np.sqrt(np.sqrt(y @ y))), y
    return largest * longest

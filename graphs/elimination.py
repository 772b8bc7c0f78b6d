"""In which order frames are eliminated, and the multifrontal Cholesky factor that does it.

Two frames are linked when a point or another factor sees both. A minimum-degree order keeps the
fill small; frames with nearly the same links form a front, a dense matrix in which LAPACK does the
work (Duff and Reid, ACM TOMS 1983; Liu, SIAM Review 1992). Everything that is not a frame, the
lenses and the rig above all, is the border of every front and is eliminated last, so that what
remains there is the information of the calibration itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk, dtrsm
from threadpoolctl import ThreadpoolController

from graphs.frames import FloatArray
from graphs.problem import IntArray

BLAS = ThreadpoolController()  # of the libraries that numpy and scipy have loaded
# Columns of the largest front up to which BLAS works on one thread: on 15 fronts of 600 columns two
# threads took 380 ms on a busy machine, one 80 ms, and kept the cores from the tracks' kernels.
ONE_THREAD_COLUMNS = 1500
FRAME_SIZE = 6  # a rigid transform
# What handling one more front costs besides its arithmetic: about 0.2 ms at 15 GFLOP a second.
FRONT_OVERHEAD_FLOP = 3e6
# A pivot of the matrix scaled to a unit diagonal: below it, the variable is determined by nothing
# but rounding. Real scans stay above 1e-9, gauge freedom ends at 1e-15.
SINGULAR_PIVOT = 1e-13


@dataclass(frozen=True)
class Front:
    """Frames that are eliminated together, and those eliminated later that they are linked to."""

    frames: IntArray  # (n,) positions in the order of elimination, ascending; its own first
    n_own: int
    parent: int  # the front that takes what remains; -1: only the border does


@dataclass(frozen=True)
class Elimination:
    """An order of all frames, cut into fronts; children come before their parents."""

    order: IntArray  # (n_frames,) frame at each position
    fronts: tuple[Front, ...]
    border: int  # columns after the frames'

    @property
    def front_of(self) -> IntArray:
        """The front that eliminates each position (n_frames,)."""
        sizes = [front.n_own for front in self.fronts]
        return np.repeat(np.arange(len(sizes)), sizes)

    @property
    def n_columns(self) -> int:
        return FRAME_SIZE * len(self.order) + self.border

    def columns(self, front: Front) -> IntArray:
        """Columns of a front's matrix in the whole system: its frames', then the border's."""
        of_frames = FRAME_SIZE * front.frames[:, None] + np.arange(FRAME_SIZE)
        first = FRAME_SIZE * len(self.order)
        return np.concatenate([of_frames.ravel(), np.arange(first, first + self.border)])


def plan_elimination(linked: NDArray[np.bool_], border: int) -> Elimination:
    """Order and fronts for frames with the links `linked` (n_frames, n_frames), symmetric."""
    filled = linked.copy()
    order = _minimum_degree(filled)
    position = np.empty_like(order)
    position[order] = np.arange(len(order))
    later = np.tril(filled[np.ix_(order, order)], -1).T  # [i, j]: j is linked to i and goes later
    own: list[list[int]] = [[i] for i in range(len(order))]
    rows = [np.flatnonzero(row) for row in later]
    parent = np.array([row[0] if row.size else -1 for row in rows])
    merged_into = np.arange(len(order))
    for child in range(len(order)):  # children before parents
        above = int(parent[child])
        if above < 0 or not _worth_merging(
            own[child], rows[child], own[above], rows[above], border
        ):
            continue
        own[above] = own[child] + own[above]
        merged_into[child] = above
    return _numbered(order, own, rows, parent, merged_into, border)


def _worth_merging(
    own: list[int], rows: IntArray, own_above: list[int], rows_above: IntArray, border: int
) -> bool:
    apart = _flop(len(own), len(rows), border) + _flop(len(own_above), len(rows_above), border)
    together = _flop(len(own) + len(own_above), len(rows_above), border)
    return together <= apart + FRONT_OVERHEAD_FLOP


def _flop(n_own: int, n_rows: int, border: int) -> float:
    whole = FRAME_SIZE * (n_own + n_rows) + border
    return (whole**3 - (whole - FRAME_SIZE * n_own) ** 3) / 3


def _numbered(
    order: IntArray,
    own: list[list[int]],
    rows: list[IntArray],
    parent: IntArray,
    merged_into: IntArray,
    border: int,
) -> Elimination:
    """Fronts in an order that lets children come first, frames numbered as they fall."""
    leaders = np.flatnonzero(merged_into == np.arange(len(order)))
    leader = np.arange(len(order))
    for i in reversed(range(len(order))):
        leader[i] = i if merged_into[i] == i else leader[merged_into[i]]
    sequence = np.concatenate([own[i] for i in leaders]) if len(leaders) else np.array([], int)
    position = np.empty(len(order), dtype=np.int64)
    position[sequence] = np.arange(len(order))
    number = {int(i): k for k, i in enumerate(leaders)}
    fronts = []
    for i in leaders.tolist():
        frames = np.concatenate([position[own[i]], np.sort(position[rows[i]])])
        above = -1 if parent[i] < 0 else number[int(leader[parent[i]])]
        fronts.append(Front(frames.astype(np.int64), len(own[i]), above))
    return Elimination(order[sequence], tuple(fronts), border)


@njit(cache=True)
def _minimum_degree(linked: NDArray[np.bool_]) -> IntArray:
    """Eliminate the frame with the fewest links, again and again; `linked` gains the fill."""
    n = len(linked)
    order = np.empty(n, np.int64)
    gone = np.zeros(n, np.bool_)
    degree = np.empty(n, np.int64)
    for i in range(n):
        linked[i, i] = False
        degree[i] = np.sum(linked[i])
    neighbours = np.empty(n, np.int64)
    for step in range(n):
        best = -1
        for i in range(n):
            if not gone[i] and (best < 0 or degree[i] < degree[best]):
                best = i
        order[step] = best
        gone[best] = True
        count = 0
        for i in range(n):
            if linked[best, i] and not gone[i]:
                neighbours[count] = i
                count += 1
        for a in range(count):
            i = neighbours[a]
            degree[i] -= 1
            for b in range(count):
                k = neighbours[b]
                if k != i and not linked[i, k]:
                    linked[i, k] = True
                    degree[i] += 1
    return order


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix cannot be factorised; `column` is the first that nothing determines."""

    def __init__(self, column: int) -> None:
        super().__init__(f"column {column} of the system is not determined")
        self.column = column


@dataclass(frozen=True)
class Cholesky:
    """H = S^-1 L L^T S^-1 with the scaling S that gives H a unit diagonal."""

    elimination: Elimination
    scale: FloatArray  # (n_columns,)
    pivots: tuple[FloatArray, ...]  # lower triangular (own, own), one a front, the border last
    below: tuple[FloatArray, ...]  # (rest, own), one a front

    def solve(self, rhs: FloatArray) -> FloatArray:
        """H^-1 rhs for rhs (n_columns,) or (n_columns, n_rhs)."""
        with _blas_threads([len(pivot) + len(below) for pivot, below in self._steps]):
            return self._solve(rhs)

    @property
    def _steps(self) -> list[tuple[FloatArray, FloatArray]]:
        return list(zip(self.pivots, self.below, strict=False))

    def _solve(self, rhs: FloatArray) -> FloatArray:
        x = np.array(rhs.reshape(len(rhs), -1) * self.scale[:, None], order="F")
        plan = self.elimination
        steps = list(zip(plan.fronts, self.pivots, self.below, strict=False))
        last = slice(plan.n_columns - plan.border, plan.n_columns)
        for front, pivot, below in steps:
            columns = plan.columns(front)
            own, rest = columns[: len(pivot)], columns[len(pivot) :]
            y = dtrsm(1.0, pivot, x[own], lower=1)
            x[own] = y
            x[rest] -= below @ y
        if plan.border:
            y = dtrsm(1.0, self.pivots[-1], x[last], lower=1)
            x[last] = dtrsm(1.0, self.pivots[-1], y, lower=1, trans_a=1)
        for front, pivot, below in reversed(steps):
            columns = plan.columns(front)
            own, rest = columns[: len(pivot)], columns[len(pivot) :]
            x[own] = dtrsm(1.0, pivot, x[own] - below.T @ x[rest], lower=1, trans_a=1)
        return (x * self.scale[:, None]).reshape(rhs.shape)

    def smallest_pivot(self) -> tuple[float, int]:
        """The smallest squared pivot of the scaled matrix, and its column."""
        plan = self.elimination
        of_fronts = [plan.columns(front)[: FRAME_SIZE * front.n_own] for front in plan.fronts]
        border = np.arange(plan.n_columns - plan.border, plan.n_columns)
        columns = np.concatenate([*of_fronts, border])
        squares = np.concatenate([np.diag(pivot) ** 2 for pivot in self.pivots])
        at = int(squares.argmin())
        return float(squares[at]), int(columns[at])


def factorise(
    elimination: Elimination,
    matrices: Sequence[FloatArray],
    border: FloatArray,
    damping: float = 0.0,
) -> Cholesky:
    """Cholesky factor of the sum of the fronts' matrices and the border's own.

    matrices: (n, n), one a front, over `elimination.columns(front)`; upper triangles are read.
    damping: added to the diagonal after scaling it to one (Levenberg-Marquardt as Marquardt has
    it). Raises NotPositiveDefiniteError.
    """
    scale = _unit_scale(elimination, matrices, border)
    with _blas_threads([len(matrix) for matrix in matrices]):
        pivots, belows, root = _eliminate_frames(elimination, matrices, border, scale, damping)
    if elimination.border:
        first = elimination.n_columns - elimination.border
        pivots.append(_pivot(root, damping, np.arange(first, elimination.n_columns)))
    return Cholesky(elimination, scale, tuple(pivots), tuple(belows))


def _blas_threads(sizes: Sequence[int]) -> AbstractContextManager[Any]:
    """One thread for small fronts; all of them where there is a large one."""
    one = max(sizes, default=0) <= ONE_THREAD_COLUMNS
    return BLAS.limit(limits=1 if one else None, user_api="blas")


def null_directions(
    elimination: Elimination, matrices: Sequence[FloatArray], border: FloatArray
) -> FloatArray:
    """What the border's variables can do at no cost (n_border, n), scaled to a unit diagonal.

    As `factorise`, and raises NotPositiveDefiniteError when already a frame is not determined.
    """
    scale = _unit_scale(elimination, matrices, border)
    root = _eliminate_frames(elimination, matrices, border, scale, 0.0)[2]
    lower = np.tril(root)
    values, vectors = np.linalg.eigh(lower + np.tril(lower, -1).T)
    return vectors[:, values < SINGULAR_PIVOT * len(values)]


def _eliminate_frames(
    elimination: Elimination,
    matrices: Sequence[FloatArray],
    border: FloatArray,
    scale: FloatArray,
    damping: float,
) -> tuple[list[FloatArray], list[FloatArray], FloatArray]:
    """Pivots and blocks below them, one a front, and what remains of the border (its lower
    triangle, undamped)."""
    n_columns, n_border = elimination.n_columns, elimination.border
    root = _scaled(border, scale[n_columns - n_border :])
    waiting: list[list[tuple[IntArray, FloatArray]]] = [[] for _ in elimination.fronts]
    pivots: list[FloatArray] = []
    belows: list[FloatArray] = []
    for front, matrix in zip(elimination.fronts, matrices, strict=True):
        columns = elimination.columns(front)
        whole = _scaled(matrix, scale[columns])
        for at, update in waiting[len(belows)]:
            place = np.searchsorted(columns, at)
            whole[np.ix_(place, place)] += update
        waiting[len(belows)] = []
        n = FRAME_SIZE * front.n_own
        pivot = _pivot(whole[:n, :n], damping, columns)
        pivots.append(pivot)
        if n == len(whole):  # nothing is linked to it; BLAS takes no empty matrices
            belows.append(np.zeros((0, n)))
            continue
        below = dtrsm(1.0, pivot, np.asfortranarray(whole[n:, :n]), side=1, lower=1, trans_a=1)
        rest = dsyrk(-1.0, below, 1.0, np.asfortranarray(whole[n:, n:]), lower=1, overwrite_c=1)
        if front.parent >= 0:
            waiting[front.parent].append((columns[n:], rest))
        elif n_border:
            root += rest
        belows.append(below)
    return pivots, belows, root


def _unit_scale(
    elimination: Elimination, matrices: Sequence[FloatArray], border: FloatArray
) -> FloatArray:
    diagonal = np.zeros(elimination.n_columns)
    for front, matrix in zip(elimination.fronts, matrices, strict=True):
        diagonal[elimination.columns(front)] += np.diag(matrix)
    if elimination.border:
        diagonal[-elimination.border :] += np.diag(border)
    if not (diagonal >= 0).all():
        raise NotPositiveDefiniteError(int(np.flatnonzero(~(diagonal >= 0))[0]))
    # What nothing determines stands still when damped, so that the rest can move.
    return np.where(diagonal > 0, diagonal, 1.0) ** -0.5


def _scaled(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    """Column-major copy whose lower triangle is the scaled upper triangle of `matrix`."""
    scaled = matrix * scale[:, None]
    scaled *= scale[None, :]
    return scaled.T


def _pivot(block: FloatArray, damping: float, columns: IntArray) -> FloatArray:
    damped = np.array(block, order="F")
    damped.flat[:: len(damped) + 1] += damping
    factor, info = scipy.linalg.lapack.dpotrf(damped, lower=1, clean=1, overwrite_a=1)
    if info != 0 or not np.isfinite(factor[-1, -1]):
        raise NotPositiveDefiniteError(int(columns[max(info - 1, 0)]))
    return factor

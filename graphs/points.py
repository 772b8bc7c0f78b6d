"""What is done point by point with linearised rows: triangulate, eliminate, propagate.

Chunks hold consecutive rows of consecutive points; everything runs without the GIL. See
`graphs.rows` for the parametrisation of a point and for why kernels exchange arrays only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from graphs.frames import FloatArray
from graphs.problem import IntArray

FAST = {"contract", "arcp", "reassoc", "nsz"}
DROPPED = 1e-12  # of a direction's own information: below, it is rounding
FARTHEST = 1e6  # a point's distance at most, in median distances of the scene
# Angle in radians under which the median distance sees a point's cameras: below, what the rows say
# of its distance is rounding.
NO_PARALLAX = 1e-8

# Damping of a point's own Levenberg-Marquardt, of the diagonal.
FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e6
DAMPING_UP, DAMPING_DOWN = 10.0, 0.1

# Unsigned indices spare numba the test for negative ones, which keeps loops from being vectorised.
_U = np.uintp
_TWO, _THREE, _SIX = _U(2), _U(3), _U(6)


@njit(nogil=True, forceinline=True)
def _clear(matrix: Any) -> None:
    """Zeros; assigning to a slice instead takes numba seconds to compile."""
    for i in range(matrix.shape[0]):
        for k in range(matrix.shape[1]):
            matrix[i, k] = 0.0


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _factorise(V: Any, with_distance: Any, damping: Any, L: Any) -> None:
    """Cholesky factor L (3, 3) of V (3, 3), lower triangles, scaled to a unit diagonal meanwhile.

    A direction that carries nothing, or the distance of a point at infinity, gets a zero pivot.
    """
    s0 = np.sqrt(V[0, 0] * (1.0 + damping))
    s1 = np.sqrt(V[1, 1] * (1.0 + damping))
    s2 = np.sqrt(V[2, 2] * (1.0 + damping)) if with_distance else 0.0
    i0 = 1.0 / s0 if s0 > 0 else 0.0
    i1 = 1.0 / s1 if s1 > 0 else 0.0
    i2 = 1.0 / s2 if s2 > 0 else 0.0
    c10, c20 = V[1, 0] * i0 * i1, V[2, 0] * i0 * i2
    left = 1.0 - c10 * c10
    p1 = np.sqrt(left) if i1 > 0 and left > DROPPED else 0.0
    c21 = (V[2, 1] * i1 * i2 - c20 * c10) / p1 if p1 > 0 else 0.0
    left = 1.0 - c20 * c20 - c21 * c21
    p2 = np.sqrt(left) if i2 > 0 and left > DROPPED else 0.0
    L[0, 0], L[1, 0], L[1, 1] = s0, c10 * s1, p1 * s1
    L[2, 0], L[2, 1], L[2, 2] = c20 * s2, c21 * s2, p2 * s2


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _forward(L: Any, y: Any) -> None:
    """Solve L u = y in place; directions with a zero pivot get zero."""
    y[0] = y[0] / L[0, 0] if L[0, 0] > 0 else 0.0
    y[1] = (y[1] - L[1, 0] * y[0]) / L[1, 1] if L[1, 1] > 0 else 0.0
    y[2] = (y[2] - L[2, 0] * y[0] - L[2, 1] * y[1]) / L[2, 2] if L[2, 2] > 0 else 0.0


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _backward(L: Any, u: Any) -> None:
    """Solve L^T x = u in place; directions with a zero pivot get zero."""
    u[2] = u[2] / L[2, 2] if L[2, 2] > 0 else 0.0
    u[1] = (u[1] - L[2, 1] * u[2]) / L[1, 1] if L[1, 1] > 0 else 0.0
    u[0] = (u[0] - L[1, 0] * u[1] - L[2, 0] * u[2]) / L[0, 0] if L[0, 0] > 0 else 0.0


# Points nearer than this, in farthest distances, are not asked whether their step leads beyond.
NEAR_LIMIT = 1e3


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _factorise_bounded(
    V: Any, gradient: Any, w: Any, smallest_w: Any, damping: Any, L: Any, u: Any
) -> None:
    """As `_factorise`; a point without parallax keeps its distance, and so does one whose step
    -V^-1 gradient leads beyond the farthest. u (3,) is scratch."""
    width = FARTHEST * smallest_w / NO_PARALLAX
    seen_apart = V[2, 2] * width * width > max(V[0, 0], V[1, 1])
    _factorise(V, seen_apart, damping, L)
    if w <= NEAR_LIMIT * smallest_w:
        u[0], u[1], u[2] = gradient[0], gradient[1], gradient[2]
        _forward(L, u)
        _backward(L, u)
        if w - u[2] <= smallest_w:
            _factorise(V, False, damping, L)


@njit(cache=True, nogil=True, fastmath=FAST)
def advance_points(
    active: IntArray,  # (n_active,) points whose trial was evaluated
    begins: IntArray,  # (n_points + 1,)
    of_point: FloatArray,  # (n, 2, 3) rows of the active points, whitened
    residuals: FloatArray,  # (n, 2) whitened
    weights: FloatArray,  # (n,)
    bends: FloatArray,  # (n,)
    costs: FloatArray,  # (n,)
    smallest_w: float,
    tolerance: float,  # a smaller predicted decrease of the cost ends a point
    trial: FloatArray,  # (n_points, 4)
    points: FloatArray,  # in and out (n_points, 4): the best so far
    cost: FloatArray,  # in and out (n_points,): of the best so far, infinite at first
    normal: FloatArray,  # in and out (n_points, 10): its V without bends, gradient and damping
    going_on: IntArray,  # out (n_active,) points that need another evaluation
    steps: FloatArray,  # out (n_active, 3) their steps from the best
) -> int:
    """One step of every active point's own Levenberg-Marquardt; returns how many go on."""
    V, bent, L = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    g, along = np.empty(3), np.empty(3)
    n, row = 0, 0
    for j in active:
        first_row, total = row, 0.0
        row += begins[j + 1] - begins[j]
        for i in range(first_row, row):
            total += costs[i]
        if total <= cost[j]:
            _clear(V)
            _clear(bent)
            g[0], g[1], g[2] = 0.0, 0.0, 0.0
            for i in range(first_row, row):
                B, weight = of_point[i], weights[i]
                for k in range(3):
                    along[k] = B[0, k] * residuals[i, 0] + B[1, k] * residuals[i, 1]
                for k in range(3):
                    g[k] += weight * along[k]
                    for m in range(k + 1):
                        V[k, m] += weight * (B[0, k] * B[0, m] + B[1, k] * B[1, m])
                        bent[k, m] += weight * bends[i] * along[k] * along[m]
            damping = normal[j, 9] * DAMPING_DOWN if cost[j] < np.inf else FIRST_DAMPING
            cost[j] = total
            for k in range(4):
                points[j, k] = trial[j, k]
            normal[j, 0], normal[j, 1], normal[j, 2] = V[0, 0], V[1, 0], V[1, 1]
            normal[j, 3], normal[j, 4], normal[j, 5] = V[2, 0], V[2, 1], V[2, 2]
            normal[j, 6], normal[j, 7], normal[j, 8] = g[0], g[1], g[2]
            for k in range(3):
                for m in range(k + 1):
                    V[k, m] += bent[k, m]
        else:  # the true curvature promised too much: go on without
            V[0, 0], V[1, 0], V[1, 1] = normal[j, 0], normal[j, 1], normal[j, 2]
            V[2, 0], V[2, 1], V[2, 2] = normal[j, 3], normal[j, 4], normal[j, 5]
            g[0], g[1], g[2] = normal[j, 6], normal[j, 7], normal[j, 8]
            damping = max(normal[j, 9], FIRST_DAMPING) * DAMPING_UP
        normal[j, 9] = damping
        _factorise_bounded(V, g, points[j, 3], smallest_w, damping, L, along)
        _forward(L, g)
        predicted = 0.5 * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
        if predicted <= tolerance or damping > MOST_DAMPING:
            continue
        _backward(L, g)
        steps[n, 0], steps[n, 1], steps[n, 2] = -g[0], -g[1], -g[2]
        going_on[n] = j
        n += 1
    return n


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _add_square(H: Any, at: Any, J: Any, n: Any) -> None:
    """Upper triangle of H[at:, at:] += J^T J for J (2, n)."""
    for k in range(n):
        x0, x1 = J[0, k], J[1, k]
        for m in range(k, n):
            H[at + k, at + m] += x0 * J[0, m] + x1 * J[1, m]


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _add_product(H: Any, at: Any, J: Any, n: Any, to: Any, K: Any, n_to: Any) -> None:
    """H[at:, to:] += J^T K for J (2, n) and K (2, n_to)."""
    for k in range(n):
        x0, x1 = J[0, k], J[1, k]
        for m in range(n_to):
            H[at + k, to + m] += x0 * K[0, m] + x1 * K[1, m]


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _add_gradient(g: Any, at: Any, J: Any, n: Any, r: Any) -> None:
    """g[at:] += J^T r for J (2, n)."""
    for k in range(n):
        g[at + k] += J[0, k] * r[0] + J[1, k] * r[1]


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _add_point(V: Any, b: Any, B: Any, r: Any) -> None:
    """V += B^T B, its lower triangle, and b += B^T r."""
    for k in range(_THREE):
        b[k] += B[0, k] * r[0] + B[1, k] * r[1]
        for m in range(k + _U(1)):
            V[k, m] += B[0, k] * B[0, m] + B[1, k] * B[1, m]


@njit(cache=True, nogil=True, fastmath=FAST)
def eliminate_points(
    active: IntArray,  # (n_active,) points
    begins: IntArray,
    rows: IntArray,  # (n, 4) observation, point, frame, camera
    points: FloatArray,  # (n_points, 4)
    smallest_w: float,
    residuals: FloatArray,  # (n, 2) and all further rows weighted
    of_point: FloatArray,  # (n, 2, 3)
    of_frame: FloatArray,  # (n, 2, 6)
    of_rig: FloatArray,  # (n, 2, 6)
    of_lens: FloatArray,  # (n, 2, n_params)
    n_frames: int,
    rig_column: IntArray,  # (n_cameras,) first column after the frames', or -1: held
    lens_column: IntArray,  # (n_cameras,)
    n_params: IntArray,  # (n_cameras,)
    width: int,  # columns of all rigs and lenses
    H: FloatArray,  # in and out (n, n), its upper triangle; the frames' columns first
    g: FloatArray,  # in and out (n,)
) -> None:
    """Add the reduced normal equations of the active points to H and g."""
    start, columns = _U(6 * n_frames), _U(width)
    longest = 0
    for j in active:
        longest = max(longest, begins[j + 1] - begins[j])
    V, L, b, u = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    seen, W, Wb = np.empty(longest, np.uintp), np.empty((longest, 3, 6)), np.empty((3, width))
    i = _U(0)
    for j in active:
        _clear(V)
        _clear(Wb)
        b[0], b[1], b[2] = 0.0, 0.0, 0.0
        n_seen = _U(0)
        for _ in range(begins[j], begins[j + 1]):
            B, F, K, r = of_point[i], of_frame[i], of_lens[i], residuals[i]
            c, f = rows[i, 3], _U(rows[i, 2])
            lens, n_lens, at = _U(lens_column[c]), _U(n_params[c]), _SIX * f
            if n_seen == 0 or seen[n_seen - _U(1)] != f:
                seen[n_seen] = f
                _clear(W[n_seen])
                n_seen += _U(1)
            _add_point(V, b, B, r)
            _add_product(W[n_seen - _U(1)], _U(0), B, _THREE, _U(0), F, _SIX)
            _add_product(Wb, _U(0), B, _THREE, lens, K, n_lens)
            _add_gradient(g, at, F, _SIX, r)
            _add_square(H, at, F, _SIX)
            _add_product(H, at, F, _SIX, start + lens, K, n_lens)
            _add_gradient(g, start + lens, K, n_lens, r)
            _add_square(H, start + lens, K, n_lens)
            if rig_column[c] >= 0:
                rig, T = _U(rig_column[c]), of_rig[i]
                _add_product(Wb, _U(0), B, _THREE, rig, T, _SIX)
                _add_gradient(g, start + rig, T, _SIX, r)
                _add_product(H, at, F, _SIX, start + rig, T, _SIX)
                _add_square(H, start + rig, T, _SIX)
                _add_product(H, start + rig, T, _SIX, start + lens, K, n_lens)
            i += _U(1)
        _factorise_bounded(V, b, points[j, 3], smallest_w, 0.0, L, u)
        _forward(L, b)
        for s in range(n_seen):
            _eliminate(W[s], L, _SIX, b, g, _SIX * seen[s])
        _eliminate(Wb, L, columns, b, g, start)
        _subtract(H, seen, n_seen, W, Wb, start, columns)


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _eliminate(W: Any, L: Any, n: Any, u: Any, g: Any, at: Any) -> None:
    """W (3, n) becomes Y = L^-1 W, and g[at:] -= Y^T u."""
    i0 = 1.0 / L[0, 0] if L[0, 0] > 0 else 0.0
    i1 = 1.0 / L[1, 1] if L[1, 1] > 0 else 0.0
    i2 = 1.0 / L[2, 2] if L[2, 2] > 0 else 0.0
    for m in range(n):
        y0 = W[0, m] * i0
        y1 = (W[1, m] - L[1, 0] * y0) * i1
        y2 = (W[2, m] - L[2, 0] * y0 - L[2, 1] * y1) * i2
        W[0, m], W[1, m], W[2, m] = y0, y1, y2
        g[at + m] -= y0 * u[0] + y1 * u[1] + y2 * u[2]


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _subtract(H: Any, seen: Any, n_seen: Any, Y: Any, Yb: Any, start: Any, columns: Any) -> None:
    """H -= Y^T Y: what one point takes with it."""
    for s in range(n_seen):
        for k in range(_SIX):
            row = _SIX * seen[s] + k
            y0, y1, y2 = Y[s, 0, k], Y[s, 1, k], Y[s, 2, k]
            for other in range(s, n_seen):
                at, X = _SIX * seen[other], Y[other]
                for m in range(_SIX):
                    H[row, at + m] -= y0 * X[0, m] + y1 * X[1, m] + y2 * X[2, m]
            for m in range(columns):
                H[row, start + m] -= y0 * Yb[0, m] + y1 * Yb[1, m] + y2 * Yb[2, m]
    for k in range(columns):
        y0, y1, y2 = Yb[0, k], Yb[1, k], Yb[2, k]
        for m in range(k, columns):
            H[start + k, start + m] -= y0 * Yb[0, m] + y1 * Yb[1, m] + y2 * Yb[2, m]


@njit(cache=True, nogil=True, fastmath=FAST)
def respond(
    rows: IntArray,  # (n_rows, 4)
    of_frame: FloatArray,
    of_rig: FloatArray,
    of_lens: FloatArray,
    n_frames: int,
    rig_column: IntArray,
    lens_column: IntArray,
    n_params: IntArray,
    G: FloatArray,  # (n_columns, n) what a unit of each column's gradient does to n unknowns
    response: FloatArray,  # out (n_rows, 2, n): rows times G
) -> None:
    """What a unit of each row's error does to n unknowns, while points stay where they are."""
    start = 6 * n_frames
    for i in range(len(rows)):
        _clear(response[i])
        c = rows[i, 3]
        for a in range(2):
            t = response[i, a]
            _add_times(t, of_frame[i, a], 6, G, 6 * rows[i, 2])
            _add_times(t, of_lens[i, a], n_params[c], G, start + lens_column[c])
            if rig_column[c] >= 0:
                _add_times(t, of_rig[i, a], 6, G, start + rig_column[c])


@njit(nogil=True, forceinline=True, fastmath=FAST, error_model="numpy")
def _add_times(t: Any, row: Any, n: Any, G: Any, at: Any) -> None:
    """t += row (n,) G[at : at + n]."""
    for k in range(n):
        x = row[k]
        for m in range(len(t)):
            t[m] += x * G[at + k, m]


@njit(cache=True, nogil=True, fastmath=FAST)
def follow_points(
    active: IntArray,
    begins: IntArray,
    points: FloatArray,
    smallest_w: float,
    residuals: FloatArray,  # (n_rows, 2) weighted
    of_point: FloatArray,  # (n_rows, 2, 3) weighted
    response: FloatArray,  # (n_rows, 2, n) of `respond`
    moved: FloatArray,  # out (n_rows, n) how far each observation's residual moves the unknowns
    leverage: FloatArray,  # out (n_active,) squared response of each point's rows together
) -> None:
    """Let points follow: responses T become T - B V^-1 B^T T with the rows B by the point."""
    n = response.shape[2]
    V, L, b = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    Z, z = np.empty((3, n)), np.empty(3)
    row = 0
    for at in range(len(active)):
        j, first_row = active[at], row
        row += begins[j + 1] - begins[j]
        _clear(V)
        _clear(Z)
        b[0], b[1], b[2] = 0.0, 0.0, 0.0
        for i in range(first_row, row):
            B, T = of_point[i], response[i]
            _add_point(V, b, B, residuals[i])
            for k in range(3):
                for m in range(n):
                    Z[k, m] += B[0, k] * T[0, m] + B[1, k] * T[1, m]
        _factorise_bounded(V, b, points[j, 3], smallest_w, 0.0, L, z)
        for m in range(n):
            z[0], z[1], z[2] = Z[0, m], Z[1, m], Z[2, m]
            _forward(L, z)
            _backward(L, z)
            Z[0, m], Z[1, m], Z[2, m] = z[0], z[1], z[2]
        leverage[at] = 0.0
        for i in range(first_row, row):
            B, T = of_point[i], response[i]
            for m in range(n):
                t0 = T[0, m] - B[0, 0] * Z[0, m] - B[0, 1] * Z[1, m] - B[0, 2] * Z[2, m]
                t1 = T[1, m] - B[1, 0] * Z[0, m] - B[1, 1] * Z[1, m] - B[1, 2] * Z[2, m]
                moved[i, m] = residuals[i, 0] * t0 + residuals[i, 1] * t1
                leverage[at] += t0 * t0 + t1 * t1

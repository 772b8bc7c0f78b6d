"""The order of elimination and the multifrontal factor against dense linear algebra."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from graphs import elimination
from graphs.elimination import (
    FRAME_SIZE,
    Cholesky,
    Elimination,
    NotPositiveDefiniteError,
    factorise,
    plan_elimination,
)
from graphs.frames import FloatArray

Links = NDArray[np.bool_]


@dataclass(frozen=True)
class Scene:
    """Frames in cliques, and a border that every clique sees."""

    n_frames: int
    cliques: tuple[tuple[int, ...], ...]
    border: int
    seed: int
    overhead: float  # of a front: without it, fronts stay apart

    @property
    def links(self) -> Links:
        linked = np.eye(self.n_frames, dtype=bool)
        for clique in self.cliques:
            linked[np.ix_(clique, clique)] = True
        return linked


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    n = draw(st.integers(1, 14))
    frame = st.integers(0, n - 1)
    cliques = draw(st.lists(st.lists(frame, min_size=1, max_size=5, unique=True), max_size=2 * n))
    return Scene(
        n, tuple(map(tuple, cliques)), draw(st.integers(1, 7)), draw(st.integers(0, 2**32 - 1)),
        draw(st.sampled_from([0.0, 1e4, elimination.FRONT_OVERHEAD_FLOP])),
    )  # fmt: skip


def planned(scene: Scene) -> Elimination:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(elimination, "FRONT_OVERHEAD_FLOP", scene.overhead)
        return plan_elimination(scene.links, scene.border)


@dataclass(frozen=True)
class Filled:
    """Random matrices on the fronts, and their sum."""

    plan: Elimination
    matrices: list[FloatArray]
    border: FloatArray
    whole: FloatArray

    def factorise(self, damping: float = 0.0) -> Cholesky:
        return factorise(self.plan, self.matrices, self.border, damping)


def filled(scene: Scene, plan: Elimination, spread: float = 3.0) -> Filled:
    """Each clique's normal equations in the front that eliminates its first frame.

    What is below the diagonal is garbage. Columns differ in size by 10^spread and more.
    """
    rng = np.random.default_rng(scene.seed)
    position = np.empty(scene.n_frames, int)
    position[plan.order] = np.arange(scene.n_frames)
    unit = 10 ** rng.uniform(-spread, spread, plan.n_columns)
    matrices = [np.zeros((len(plan.columns(f)),) * 2) for f in plan.fronts]
    whole = np.zeros((plan.n_columns,) * 2)
    alone = [(frame,) for frame in range(scene.n_frames)]
    first_of_border = FRAME_SIZE * scene.n_frames
    of_border = np.arange(first_of_border, plan.n_columns)
    for clique in (*scene.cliques, *alone):
        at = np.sort(position[list(clique)])
        front = plan.front_of[at[0]]
        own = (FRAME_SIZE * at[:, None] + np.arange(FRAME_SIZE)).ravel()
        columns = np.concatenate([own, of_border])
        J = rng.standard_normal((len(columns) + 2, len(columns))) * unit[columns]
        place = np.searchsorted(plan.columns(plan.fronts[front]), columns)
        matrices[front][np.ix_(place, place)] += np.triu(J.T @ J)
        whole[np.ix_(columns, columns)] += J.T @ J
    for matrix in matrices:
        matrix[np.tril_indices(len(matrix), -1)] = np.nan
    border = np.zeros((scene.border,) * 2)
    if scene.border:
        J = rng.standard_normal((scene.border + 2, scene.border)) * unit[first_of_border:]
        border += np.triu(J.T @ J)
        whole[first_of_border:, first_of_border:] += J.T @ J
        border[np.tril_indices(len(border), -1)] = np.nan
    return Filled(plan, matrices, border, whole)


def assert_solves(matrix: FloatArray, x: FloatArray, rhs: FloatArray) -> None:
    """To the rounding of a matrix scaled to a unit diagonal."""
    scale = 1 / np.sqrt(np.diag(matrix))
    scaled = matrix * np.outer(scale, scale)
    expected = np.linalg.solve(scaled, (rhs.T * scale).T)
    ours = (x.T / scale).T
    limit = 1e-12 * np.linalg.cond(scaled) * np.abs(expected).max()
    np.testing.assert_allclose(ours, expected, rtol=0, atol=limit)


# ---- the plan ------------------------------------------------------------------------------


@settings(deadline=None, max_examples=80)
@given(scenes())
def test_every_frame_is_eliminated_once_children_first_and_no_link_is_lost(scene: Scene) -> None:
    plan = planned(scene)
    assert sorted(plan.order) == list(range(scene.n_frames))
    assert plan.n_columns == FRAME_SIZE * scene.n_frames + scene.border
    own = [front.frames[: front.n_own] for front in plan.fronts]
    np.testing.assert_array_equal(np.concatenate(own), np.arange(scene.n_frames))
    np.testing.assert_array_equal(
        plan.front_of, np.repeat(np.arange(len(own)), [len(frames) for frames in own])
    )
    for index, front in enumerate(plan.fronts):
        assert (np.diff(front.frames) > 0).all() and front.n_own > 0
        rest = set(front.frames[front.n_own :].tolist())
        if front.parent < 0:
            assert not rest
            continue
        parent = plan.fronts[front.parent]
        assert front.parent > index
        assert rest <= set(parent.frames.tolist())
        assert min(rest) in parent.frames[: parent.n_own]
    position = np.empty(scene.n_frames, int)
    position[plan.order] = np.arange(scene.n_frames)
    for clique in scene.cliques:
        at = position[list(clique)]
        assert set(at.tolist()) <= set(plan.fronts[plan.front_of[at.min()]].frames.tolist())


def test_the_links_are_left_as_they_are() -> None:
    links = Scene(5, ((0, 3), (1, 4), (4, 3)), 2, 0, 0.0).links
    before = links.copy()
    plan_elimination(links, 2)
    np.testing.assert_array_equal(links, before)


def chain(n: int, reach: int, closed: bool, overhead: float) -> Scene:
    """Each frame sees what the next `reach` see; `closed`: the last frames what the first do."""
    starts = range(n if closed else n - reach)
    return Scene(
        n, tuple(tuple((i + k) % n for k in range(reach + 1)) for i in starts), 12, 0, overhead
    )


@pytest.mark.parametrize("closed", [False, True])
def test_a_long_scan_keeps_small_fronts(closed: bool) -> None:
    """Each frame shares points with the next five; a loop that closes is a band twice as wide.

    Fronts are merged as long as that is cheaper than to handle them apart, and no further.
    """
    bare, most = chain(300, 5, closed, overhead=0.0), elimination.FRONT_OVERHEAD_FLOP
    assert largest_front(bare) <= (11 if closed else 6)
    merged = largest_front(chain(300, 5, closed, most))
    assert merged < 150
    assert largest_front(chain(900, 5, closed, most)) < 1.1 * merged


def largest_front(scene: Scene) -> int:
    return max(len(front.frames) for front in planned(scene).fronts)


def test_frames_that_all_see_each_other_are_one_front() -> None:
    plan = planned(Scene(30, (tuple(range(30)),), 12, 0, 0.0))
    assert len(plan.fronts) == 1 and plan.fronts[0].n_own == 30


def test_parts_that_share_nothing_are_apart() -> None:
    """But for the border: three islands of frames, three fronts without parents."""
    cliques = tuple(tuple(range(10 * i, 10 * i + 10)) for i in range(3))
    plan = planned(Scene(30, cliques, 12, 0, 0.0))
    assert [(len(f.frames), f.n_own, f.parent) for f in plan.fronts] == [(10, 10, -1)] * 3
    for front in plan.fronts:
        assert len(set(plan.order[front.frames] // 10)) == 1


# ---- the factor ----------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(scenes())
def test_solving_is_as_with_the_dense_matrix(scene: Scene) -> None:
    """One right-hand side, several, and none; the arrays given stay as they are."""
    some = filled(scene, planned(scene))
    kept = [matrix.copy() for matrix in some.matrices]
    factor = some.factorise()
    rng = np.random.default_rng(scene.seed)
    for shape in ((), (1,), (5,), (0,)):
        rhs = rng.standard_normal((some.plan.n_columns, *shape))
        before = rhs.copy()
        x = factor.solve(rhs)
        assert x.shape == rhs.shape
        np.testing.assert_array_equal(rhs, before)
        if rhs.size:
            assert_solves(some.whole, x, rhs)
    for matrix, before in zip(some.matrices, kept, strict=True):
        np.testing.assert_array_equal(matrix, before)


@settings(deadline=None, max_examples=25)
@given(scenes(), st.sampled_from([1e-6, 1e-3, 1.0, 1e4]))
def test_damping_is_marquardts(scene: Scene, damping: float) -> None:
    """So much of its own diagonal is added to the matrix."""
    some = filled(scene, planned(scene))
    damped = some.whole + damping * np.diag(np.diag(some.whole))
    rhs = np.random.default_rng(scene.seed).standard_normal(some.plan.n_columns)
    assert_solves(damped, some.factorise(damping).solve(rhs), rhs)


def test_columns_of_any_size_are_solved_alike() -> None:
    """A distortion coefficient beside a focal length: diagonals 1e16 and more apart."""
    scene = Scene(6, ((0, 1, 2), (2, 3), (4, 5)), 5, 1, 0.0)
    some = filled(scene, planned(scene), spread=6.0)
    diagonal = np.diag(some.whole)
    assert diagonal.max() > 1e16 * diagonal.min()
    rhs = np.sqrt(diagonal)
    assert_solves(some.whole, some.factorise().solve(rhs), rhs)


def test_a_long_chain_is_solved_as_with_the_dense_matrix() -> None:
    scene = chain(40, 3, closed=True, overhead=1e4)
    some = filled(scene, planned(scene), spread=1.0)
    assert len(some.plan.fronts) > 3
    rhs = np.random.default_rng(0).standard_normal((some.plan.n_columns, 3))
    assert_solves(some.whole, some.factorise().solve(rhs), rhs)


@pytest.mark.parametrize("scene", [
    Scene(1, (), 0, 0, 0.0),
    Scene(1, (), 3, 0, 0.0),
    Scene(9, ((0, 3, 4), (1, 4), (2, 5), (6, 7)), 0, 0, 0.0),
])  # fmt: skip
def test_one_frame_alone_and_scenes_without_a_border(scene: Scene) -> None:
    some = filled(scene, planned(scene))
    rhs = np.arange(1.0, some.plan.n_columns + 1)
    assert_solves(some.whole, some.factorise().solve(rhs), rhs)


# ---- what cannot be factorised -------------------------------------------------------------

TREE = Scene(6, ((0, 1, 2), (2, 3), (3, 4, 5)), 5, 1, 0.0)


def without_information(column: int, how: str) -> Filled:
    """A matrix of full rank but for one column: zero, a copy of another, or negative."""
    some = filled(TREE, planned(TREE), spread=0.0)
    plan = some.plan
    whole = some.whole
    other = plan.n_columns - 1 if column != plan.n_columns - 1 else plan.n_columns - 2
    if how == "copy":
        turn = np.eye(plan.n_columns)
        turn[:, column] = turn[:, other]
        whole = turn.T @ whole @ turn
    else:
        whole[column] = whole[:, column] = 0.0
        whole[column, column] = {"zero": 0.0, "negative": -1.0, "nan": np.nan}[how]
    return cut(plan, whole)


def cut(plan: Elimination, whole: FloatArray) -> Filled:
    """A dense matrix cut along the fronts; links between fronts that have none are left out."""
    left, matrices = np.triu(whole), []
    for front in plan.fronts:
        columns = plan.columns(front)
        matrices.append(np.triu(left[np.ix_(columns, columns)]))
        left[np.ix_(columns, columns)] = 0.0
    border = np.zeros((plan.border,) * 2)
    return Filled(plan, matrices, border, whole)


@pytest.mark.parametrize("how", ["zero", "negative", "nan"])
@pytest.mark.parametrize("column", [0, 7, 20, 35, 36, 38, 40])
def test_a_column_without_information_is_named(column: int, how: str) -> None:
    with pytest.raises(NotPositiveDefiniteError) as caught:
        without_information(column, how).factorise()
    assert caught.value.column == column


@pytest.mark.parametrize("seed", range(12))
def test_the_first_column_that_makes_it_indefinite_is_named(seed: int) -> None:
    """As a dense factor would: two columns of one front correlated by more than one."""
    some, rng = filled(TREE, planned(TREE), spread=0.0), np.random.default_rng(seed)
    columns = some.plan.columns(some.plan.fronts[rng.integers(len(some.plan.fronts))])
    a, b = np.sort(rng.choice(columns, 2, replace=False))
    whole = some.whole.copy()
    whole[a, b] = whole[b, a] = 1.5 * np.sqrt(whole[a, a] * whole[b, b])
    with pytest.raises(NotPositiveDefiniteError) as caught:
        cut(some.plan, whole).factorise()
    assert caught.value.column == first_not_positive(whole) >= b


def first_not_positive(matrix: FloatArray) -> int:
    for n in range(1, len(matrix) + 1):
        if np.linalg.eigvalsh(matrix[:n, :n])[0] <= 0:
            return n - 1
    raise AssertionError("it is positive definite")


@pytest.mark.parametrize("column", [36, 38, 40])
def test_the_last_of_two_columns_that_do_the_same_is_named(column: int) -> None:
    """Two lens parameters that cannot be told apart: no pivot, or one of rounding."""
    some = without_information(column, "copy")
    named, smallest = pivot_of(some)
    assert named == max(column, 39 if column == 40 else 40)
    assert smallest < elimination.SINGULAR_PIVOT


def pivot_of(some: Filled) -> tuple[int, float]:
    try:
        smallest, column = some.factorise().smallest_pivot()
    except NotPositiveDefiniteError as error:
        return error.column, 0.0
    return column, smallest


@pytest.mark.parametrize("border", [1, 3])
def test_the_smallest_pivot_is_found_among_the_frames(border: int) -> None:
    """Two columns that nearly do the same."""
    scene = Scene(4, ((0, 1), (1, 2, 3)), border, 3, 0.0)
    some = filled(scene, planned(scene), spread=0.0)
    plan = some.plan
    near = FRAME_SIZE * (scene.n_frames - 1) + 2
    turn = np.eye(plan.n_columns)
    turn[:, near + 1] = turn[:, near]
    turn[near + 1, near + 1] = 1e-4
    nearly = cut(plan, turn.T @ some.whole @ turn)
    smallest, column = nearly.factorise().smallest_pivot()
    assert column == near + 1
    root = np.linalg.cholesky(nearly.whole)
    assert smallest == pytest.approx(root[column, column] ** 2 / nearly.whole[column, column])
    assert (np.diag(root) ** 2 / np.diag(nearly.whole)).min() == pytest.approx(smallest)

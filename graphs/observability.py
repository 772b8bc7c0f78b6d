"""Which changes of lenses and rig a scan hardly notices, by name, in pixels, and with a remedy.

Parameters are measured in the pixels by which each moves the picture alone. In these units the
stated covariance's large eigenvectors span the weak directions; Kaiser's varimax rotation
(Psychometrika 1958) turns them among themselves until each moves as few parameters as it can,
which is what makes them readable: together they still state the same covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.build import CalibrationGraph
from graphs.covariance import Covariance
from graphs.frames import FloatArray, reported_from_tangent
from graphs.image_grid import ImageGrid, centre, corners, image_grid, typical_distances
from graphs.joint_prior import parameters, prior_rows
from graphs.motion import Views, of_board_in_words, shared_lacks, views_of
from graphs.motion import in_words as motion_in_words
from graphs.problem import Estimate, IntArray
from graphs.propagation import lens_names, pose_names
from graphs.remedies import NO_MOTION, Kind, Move, board_remedy, classify, in_words, remedy
from graphs.usable import unseen_in_words, unusable

# One stated sigma along a weak direction: about what a single feature is uncertain by. Simulated
# rigs in hand stay at 0.2 px (three cameras, 40 frames) to 0.49 px (one camera); real scans from
# vehicles and tripods reach 3 to 5 px.
WEAK_PX = 0.5
# Of a direction's greatest part, from which a parameter is named in it. Parts of it by which a
# parameter moves less are named where the direction explains most of that parameter's variance:
# p2 of a corridor moves by 0.2 px with a cx of 2.6 px, and not at all otherwise.
NAMED_SHARE, NAMED_PX, EXPLAINED = 0.3, 0.1, 0.5
MOST_LINES = 10  # a rig of many cameras: directions of one kind are told as one
BELIEF_ALONE = 1.0 - 1e-6  # share of priors from which data alone say nothing


@dataclass(frozen=True)
class WeakDirection:
    """A change of the calibration that the scan hardly notices: one stated sigma of it."""

    kind: Kind
    what: str  # in words
    parameters: tuple[str, ...]  # that it moves, the most moved first; `cam0.fx`, ...
    moves: tuple[float, ...]  # how far it moves them, in their own units
    moves_px: tuple[float, ...]  # the same as what each would move the picture by alone, rms
    slide_px: float  # root of the sum of their squares, priors included
    data_slide_px: float  # without priors; inf where the data say nothing
    effect_centre_px: float  # what is left of all that in the picture, the rig turned as suits
    effect_corner_px: float  # best: at its centre, at its corners; of the camera that moves most
    prior_share: float  # of the information on it that priors bring: 1 is belief alone
    remedy: str


@dataclass(frozen=True)
class Observability:
    """What a scan determines, and what it does not."""

    weak: tuple[WeakDirection, ...]
    unusable: tuple[str, ...]  # why the result is not to be used; empty: it may be
    lacks: tuple[str, ...]  # what is degenerate about the scan as a whole, in words
    prior_shares: dict[str, float]  # of each parameter's variance: 1 is belief alone


def observe(
    graph: CalibrationGraph,
    estimate: Estimate,
    stated: Covariance,
    model: Covariance,
    unit: float = 1.0,
) -> Observability:
    """All there is to say of an optimum; unit: of the covariances' lengths, in the estimate's."""
    views = views_of(replace(graph.problem, initial=estimate))
    by_board = graph.problem.of_board_alone
    reported = estimate.scaled(1 / unit)
    seen = graph.problem.observations
    distances = typical_distances(reported, seen).tolist()
    priors = prior_information(graph, estimate, stated.names, unit)
    weak = weak_directions(reported, stated, model, priors, distances, views, by_board)
    # A rig that only drives straight may have learned all there is; one that stands still has not.
    lacks = [lack for lack in shared_lacks(views) if weak or lack in NO_MOTION]
    told = of_board_in_words if by_board else motion_in_words
    return Observability(
        weak=weak,
        unusable=unusable(reported, stated, distances, seen),
        lacks=(
            *dict.fromkeys(told(lack, views) for lack in lacks),
            *unseen_in_words(reported, stated, distances, seen),
        ),
        prior_shares=prior_shares(model, priors),
    )


def weak_directions(
    estimate: Estimate,
    stated: Covariance,
    model: Covariance,
    prior_information: FloatArray,
    distances: Sequence[float],
    views: Sequence[Views] = (),
    by_board: bool = False,
) -> tuple[WeakDirection, ...]:
    """What the scan leaves open by more than WEAK_PX, the most open first; empty for a good scan.

    stated, model: covariances of the same parameters in the estimate's unit, singular where
    cameras share a lens or a length is held. prior_information (n, n): what priors add on these
    very parameters, as `prior_information` has it. distances (n_cameras,): of what each camera
    sees. views: for remedies that fit the scan; by_board: it is one of a board alone.
    Every parameter whose own sigma moves the picture by WEAK_PX is named in one of them.
    """
    if not stated.names:
        return ()
    grid = image_grid(estimate, stated.names, distances)
    twins = _twins(stated)
    own = own_px(grid)
    first = np.flatnonzero(twins == np.arange(len(twins)))
    scaled = own[:, None] * stated.matrix * own
    loadings, functionals = _weak_part(scaled[np.ix_(first, first)])
    if not loadings.shape[1]:
        return ()
    named = _named(loadings, np.sqrt(np.diag(scaled)[first]))
    shares = _prior_shares(model.matrix, prior_information, first, functionals * own[first, None])
    names = tuple(stated.names[i] for i in first)
    settled, found = grid.settled, []
    for column, share, involved in zip(loadings.T, shares, named.T, strict=True):
        step = np.zeros(len(own))
        step[first] = column / own[first]
        effect = np.linalg.norm(settled @ step[twins], axis=1)
        move = Move(names, column, step[first], *_ends(estimate, grid, effect))
        found.append(_direction(move, classify(estimate, move, views), involved, float(share)))
    every = (_with_twins(one, stated.names, twins) for one in _merged(found))
    return tuple(_told(one, estimate, views, by_board) for one in every)


def prior_information(
    graph: CalibrationGraph, estimate: Estimate, names: Sequence[str], unit: float = 1.0
) -> FloatArray:
    """What priors and an earlier calibration say of the reported parameters `names` (n, n).

    estimate: the graph's optimum. unit: of the reported lengths, in the estimate's. A lens that
    cameras share counts once, with the first of them. Measured lengths are data.
    """
    place = {name: index for index, name in enumerate(names)}
    information = np.zeros((len(names), len(names)))

    def add(labels: Sequence[str], block: FloatArray) -> None:
        known = [i for i, label in enumerate(labels) if label in place]
        rows = [place[labels[i]] for i in known]
        information[np.ix_(rows, rows)] += block[np.ix_(known, known)]

    for index, camera in enumerate(estimate.cameras):
        if graph.layout.lens_of[index] == index:
            add(lens_names(camera), graph.lens_priors[index].information())
    for index, prior in graph.options.rig_priors.items():
        sigmas = np.array([prior.sigma_rotation] * 3 + [prior.sigma_translation] * 3)
        from_reported = np.linalg.inv(reported_from_tangent(estimate.cam_from_rig[index]))
        from_reported[:, 3:] *= unit
        of_tangent = np.diag(sigmas**-2.0)
        add(pose_names(estimate.cameras[index].name), from_reported.T @ of_tangent @ from_reported)
    earlier = graph.problem.prior
    if earlier is not None:
        of = parameters(earlier)
        by_reported = prior_rows(earlier, estimate)
        by_reported = by_reported * [unit if ".translation_" in name else 1.0 for name in of]
        add(of, by_reported.T @ by_reported)
    return information


def prior_shares(model: Covariance, prior_information: FloatArray) -> dict[str, float]:
    """Share of each parameter's variance that comes from the priors: 1 is belief alone.

    Of C = C (data + prior) C, the part C prior C.
    """
    whole = np.diag(model.matrix)
    of_prior = np.diag(model.matrix @ prior_information @ model.matrix)
    share = np.clip(of_prior / np.maximum(whole, 1e-300), 0, 1)
    return dict(zip(model.names, share.tolist(), strict=True))


def own_px(grid: ImageGrid) -> FloatArray:
    """Pixels (n,) by which a unit of each parameter alone moves the picture, rms over the image."""
    squared = (grid.by_calibration**2).sum(1)
    cameras = np.unique(grid.camera)
    rms = [np.sqrt(squared[grid.camera == index].mean(0)) for index in cameras]
    return np.maximum(np.max(rms, axis=0), SMALLEST_PX)


SMALLEST_PX = 1e-12  # a parameter that moves nothing: not to divide by


# ---- the weak part -------------------------------------------------------------------------


def _twins(covariance: Covariance) -> IntArray:
    """Index (n,) of the first parameter that is the same variable: of a lens that is shared."""
    C = covariance.matrix
    kind = np.array([name.rsplit(".", 1)[1] for name in covariance.names])
    variance = np.diag(C)
    apart = variance[:, None] + variance - 2 * C
    same = (apart <= SAME * (variance[:, None] + variance)) & (kind[:, None] == kind)
    return same.argmax(axis=1)


SAME = 1e-8  # variance of a difference, of both variances: zero but for rounding


def _weak_part(scaled: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weak moves (n, k) of one sigma each in px, and the functionals (n, k) that measure them."""
    values, vectors = np.linalg.eigh(scaled)
    weak = values > WEAK_PX**2
    root, V = np.sqrt(values[weak]), vectors[:, weak]
    R = _varimax(V * root)
    return V * root @ R, V / root @ R


def _varimax(loadings: FloatArray) -> FloatArray:
    """Rotation (k, k) that makes each column of loadings (n, k) either large or nothing."""
    k = loadings.shape[1]
    R, before = np.eye(k), 0.0
    for _ in range(VARIMAX_STEPS if k > 1 else 0):
        L = loadings @ R
        U, s, Vt = np.linalg.svd(loadings.T @ (L**3 - L * (L**2).mean(0)))
        R = U @ Vt
        if s.sum() <= before * (1 + 1e-8):
            break
        before = float(s.sum())
    return R


VARIMAX_STEPS = 200


def _named(loadings: FloatArray, sigma_px: FloatArray) -> FloatArray:
    """Which parameters (n, k) belong to each direction: none that is itself weak is left out."""
    size = np.abs(loadings)
    large = size >= NAMED_SHARE * size.max(0)
    follows = (size >= NAMED_PX) & (size**2 >= EXPLAINED * sigma_px[:, None] ** 2)
    named = large | follows
    for row in np.flatnonzero((sigma_px > WEAK_PX) & ~named.any(1)):
        named[row, size[row].argmax()] = True
    return named


def _prior_shares(
    model: FloatArray, prior: FloatArray, first: IntArray, functionals: FloatArray
) -> FloatArray:
    """Share (k,) of the priors in the variance of functionals (n_first, k) of the model."""
    response = model[:, first] @ functionals
    whole = np.einsum("ik,ij,jk->k", functionals, model[np.ix_(first, first)], functionals)
    of_prior = np.einsum("ik,ij,jk->k", response, prior, response)
    return np.clip(of_prior / np.maximum(whole, 1e-300), 0, 1)


def _ends(estimate: Estimate, grid: ImageGrid, effect: FloatArray) -> tuple[float, float]:
    """The greatest effect (n,) at any camera's centre, and at any corner that its lens reaches."""
    sizes = [(index, camera.size) for index, camera in enumerate(estimate.cameras)]
    middle = max(float(effect[centre(grid, index, size)]) for index, size in sizes)
    edge = max(float(effect[corners(grid, index, size)].max()) for index, size in sizes)
    return middle, edge


# ---- in words ------------------------------------------------------------------------------


def _direction(move: Move, kind: Kind, involved: NDArray[np.bool_], share: float) -> WeakDirection:
    """The parameters (n,) that are involved in a move; words are still to come."""
    rows = np.flatnonzero(involved)[np.argsort(-np.abs(move.px[involved]), kind="stable")]
    slide = float(np.linalg.norm(move.px))
    return WeakDirection(
        kind=kind,
        what="",
        parameters=tuple(move.names[i] for i in rows),
        moves=tuple(move.own[rows].tolist()),
        moves_px=tuple(move.px[rows].tolist()),
        slide_px=slide,
        data_slide_px=slide / (1 - share) ** 0.5 if share < BELIEF_ALONE else float("inf"),
        effect_centre_px=move.centre_px,
        effect_corner_px=move.corner_px,
        prior_share=share,
        remedy="",
    )


def _told(
    one: WeakDirection, estimate: Estimate, views: Sequence[Views], by_board: bool
) -> WeakDirection:
    """With what it is and its remedy in words."""
    px, own = np.array(one.moves_px), np.array(one.moves)
    move = Move(one.parameters, px, own, one.effect_centre_px, one.effect_corner_px)
    return replace(
        one,
        what=in_words(one.kind, move, estimate, views),
        remedy=board_remedy(one.kind, move)
        if by_board
        else remedy(one.kind, move, estimate, views),
    )


def _merged(found: Sequence[WeakDirection]) -> list[WeakDirection]:
    """One for each kind and its cameras or its parameters, the weakest first.

    Of more than MOST_LINES, one for each kind.
    """
    some = list(found)
    for part in (0, 1):  # cameras, parameters
        groups: dict[object, list[WeakDirection]] = {}
        for one in sorted(some, key=lambda one: -one.slide_px):
            key = frozenset(name.rsplit(".", 1)[part] for name in one.parameters)
            groups.setdefault((one.kind, key), []).append(one)
        some = [_as_one(group) for group in groups.values()]
    if len(some) <= MOST_LINES:
        return some
    kinds = dict.fromkeys(one.kind for one in some)
    return [_as_one([one for one in some if one.kind == kind]) for kind in kinds]


def _as_one(group: Sequence[WeakDirection]) -> WeakDirection:
    """Directions of one kind: the first's words, every parameter, the greatest of each number."""
    moved: dict[str, tuple[float, float]] = {}
    for one in group:
        for name, own, px in zip(one.parameters, one.moves, one.moves_px, strict=True):
            if name not in moved or abs(px) > abs(moved[name][1]):
                moved[name] = own, px
    names = sorted(moved, key=lambda name: -abs(moved[name][1]))
    return replace(
        group[0],
        parameters=tuple(names),
        moves=tuple(moved[name][0] for name in names),
        moves_px=tuple(moved[name][1] for name in names),
        data_slide_px=max(one.data_slide_px for one in group),
        effect_centre_px=max(one.effect_centre_px for one in group),
        effect_corner_px=max(one.effect_corner_px for one in group),
        prior_share=max(one.prior_share for one in group),
    )


def _with_twins(one: WeakDirection, names: tuple[str, ...], twins: IntArray) -> WeakDirection:
    """With the same variable's other names, of the cameras that share a lens."""
    first = {name: names[twin] for name, twin in zip(names, twins, strict=True)}
    moves = dict(zip(one.parameters, zip(one.moves, one.moves_px, strict=True), strict=True))
    every = [name for known in one.parameters for name in names if first[name] == known]
    return replace(
        one,
        parameters=tuple(every),
        moves=tuple(moves[first[name]][0] for name in every),
        moves_px=tuple(moves[first[name]][1] for name in every),
    )

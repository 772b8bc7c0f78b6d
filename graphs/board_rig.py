"""Where a rig's cameras stand, from the boards that two of them saw at once.

What one view leaves open (which of two tilts, from which end a symmetric board was numbered) the
frames decide by vote: every combination proposes where one camera stands beside another, and only
the true ones agree from frame to frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray, Transform
from graphs.lenses import IntArray
from graphs.planar import BothSolutions, Transforms, angles_between
from graphs.rig_start import median_transform

# A second solution so much worse in rms is no solution. Generous: a candidate too many costs time,
# the right one missing costs its frame.
PLAUSIBLE_RATIO = 3.0
# Distances between transforms are radians plus shifts relative to the board's distance.
FARTHEST = 0.5  # beyond it wrong is wrong
AGREEING = 0.15  # small far boards are off by so much; wrong combinations mostly by more than 0.5
TIMES_MEDIAN = 4.0
MOST_PROPOSING = 60  # frames; all of them vote
# By how much the second choice's distances may exceed the first's and its images be asked. Near
# boards have 0.01 against 0.4 a frame, small far ones 0.1 against 0.15.
RIVAL_RATIO = 2.0
SUPPORT_FLOOR = 0.02  # distance a frame, of noise alone
WEAK_FRAMES, WEAK_SHARE = 3, 0.5  # a link on which fewer frames agree is weak
REFUSED_SHARE = 0.25  # of ten frames of two boards, 1 to 4 agree by chance
SETTLING_ROUNDS = 2


@dataclass(frozen=True)
class Candidates:
    """All that a view's corners may mean: cam_from_board (n_views, k), the likeliest first."""

    transforms: Transforms  # rotation (n_views, k, 3, 3), translation (n_views, k, 3)
    valid: NDArray[np.bool_]  # (n_views, k)
    cost: FloatArray  # (k,) of preference: zero for the first solution as numbered
    renumbering: IntArray  # (k,) index into the symmetries; 0 is the identity

    def __getitem__(self, views: IntArray) -> Candidates:
        return Candidates(self.transforms[views], self.valid[views], self.cost, self.renumbering)

    @staticmethod
    def of(both: BothSolutions, board_turns: Transforms) -> Candidates:
        """board_turns: the board's symmetries, the identity first, as `renumbered_from_board`."""
        n, turns = len(both.first), len(board_turns)
        valid = np.ones((n, 2, turns), dtype=bool)
        valid[:, 1] = (both.second_rms_px < PLAUSIBLE_RATIO * both.first_rms_px)[:, None]
        back = board_turns.inverse
        found = [
            each[:, None] @ Transforms(back.rotation[None], back.translation[None])
            for each in (both.first, both.second)
        ]
        transforms = Transforms(
            np.concatenate([each.rotation for each in found], axis=1),
            np.concatenate([each.translation for each in found], axis=1),
        )
        renumbering = np.tile(np.arange(turns), 2)
        cost = np.repeat([0.0, 1.0], turns) + 2.0 * (renumbering > 0)
        return Candidates(transforms, valid.reshape(n, -1), cost, renumbering)


def turns_of(corners_m: FloatArray, symmetries: Sequence[IntArray]) -> Transforms:
    """The board's turns that take each corner i to corner renumbering[i]; the identity first."""
    turns = [Transform.identity()]
    middle = corners_m.mean(0)
    for renumbering in symmetries:
        off, to = corners_m - middle, corners_m[renumbering] - middle
        left, _, right = np.linalg.svd(to.T @ off)
        sign = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
        rotation = left @ sign @ right
        turns.append(Transform(rotation, middle - rotation @ middle))
    return Transforms.of(turns)


@dataclass(frozen=True)
class Link:
    """Where one camera stands beside another, and how sure that is."""

    cameras: tuple[int, int]  # a, b
    b_from_a: Transform
    frames: int  # that both saw the board in
    agreeing: int  # of those
    ambiguous: bool = False  # another place of b fits the images as well

    @property
    def weak(self) -> bool:
        few = max(WEAK_FRAMES, WEAK_SHARE * self.frames)
        return self.ambiguous or self.agreeing < few

    @property
    def refused(self) -> bool:
        """Whether so few frames agree that chance does as well."""
        return self.agreeing < REFUSED_SHARE * self.frames


def distances(a: Transforms, b: Transforms, depth: FloatArray) -> FloatArray:
    """Radians plus shift relative to the depth of the board, for transforms that broadcast."""
    turn = angles_between(a.rotation, b.rotation)
    shift = np.linalg.norm(a.translation - b.translation, axis=-1)
    result: FloatArray = turn + shift / depth
    return result


def proposed_links(
    cameras: tuple[int, int], a: Candidates, b: Candidates
) -> tuple[Link, Link | None]:
    """The place of b beside a on which most of their shared frames agree, and its rival, if any.

    a, b: the views of the shared frames, in the same order. Only b is renumbered: what matters is
    one numbering relative to the other.
    """
    proposals, depth = _proposals(a, b)  # (f, k)
    n, k = depth.shape
    voting = np.unique(np.linspace(0, n - 1, min(n, MOST_PROPOSING)).round().astype(int))
    tried = np.flatnonzero(np.repeat(np.isin(np.arange(n), voting), k) & np.isfinite(depth.ravel()))
    flat = Transforms(
        proposals.rotation.reshape(-1, 3, 3), proposals.translation.reshape(-1, 3)
    )  # (f k)
    scores = np.empty(len(tried))
    for place, index in enumerate(tried):
        apart = distances(proposals, flat[index : index + 1], depth)
        nearest = np.nanmin(np.where(np.isfinite(apart), apart, np.inf), axis=1)
        scores[place] = np.minimum(nearest, FARTHEST).sum()
    preference = np.add.outer(a.cost[_unturned(a)], b.cost).ravel()[tried % k]
    best = tried[np.lexsort([preference, scores.round(6)])[0]]
    winner = _settled(proposals, depth, flat[best : best + 1])
    typical = np.array(float(np.nanmedian(depth)))
    away = distances(flat[tried], winner.b_from_a, typical) > FARTHEST
    link = Link(cameras, winner.b_from_a.one(0), n, winner.agreeing)
    if not away.any():
        return link, None
    second = tried[away][np.lexsort([preference[away], scores[away].round(6)])[0]]
    rival = _settled(proposals, depth, flat[second : second + 1])
    if rival.score > RIVAL_RATIO * max(winner.score, SUPPORT_FLOOR * n):
        return link, None
    return link, Link(cameras, rival.b_from_a.one(0), n, rival.agreeing)


def _unturned(candidates: Candidates) -> IntArray:
    return np.flatnonzero(candidates.renumbering == 0)


def _proposals(a: Candidates, b: Candidates) -> tuple[Transforms, FloatArray]:
    """b_from_a of every combination (f, ka kb), and the board's depth there, NaN where invalid."""
    as_numbered = _unturned(a)
    a_from_board = Transforms(
        a.transforms.rotation[:, as_numbered, None], a.transforms.translation[:, as_numbered, None]
    )
    b_from_board = Transforms(
        b.transforms.rotation[:, None], b.transforms.translation[:, None]
    )  # (f, 1, kb)
    found = b_from_board @ a_from_board.inverse
    valid = (a.valid[:, as_numbered, None] & b.valid[:, None]).reshape(len(a.valid), -1)
    far = [np.linalg.norm(each.translation, axis=-1) for each in (a_from_board, b_from_board)]
    depth = (0.5 * (far[0] + far[1])).reshape(len(valid), -1)
    shape = (len(valid), valid.shape[1])
    proposals = Transforms(
        found.rotation.reshape(*shape, 3, 3), found.translation.reshape(*shape, 3)
    )
    return proposals, np.where(valid, depth, np.nan)


@dataclass(frozen=True)
class _Consensus:
    b_from_a: Transforms  # (1,)
    agreeing: int  # frames
    score: float  # distances of the frames' nearest proposals, bounded, summed


def _settled(proposals: Transforms, depth: FloatArray, start: Transforms) -> _Consensus:
    """The median of the proposals that agree with a first one (1,), and who agrees with that."""
    frames = np.arange(len(depth))
    consensus = start
    for _ in range(SETTLING_ROUNDS):
        nearest, closest = _nearest(proposals, depth, consensus)
        agrees = _agree(closest)
        chosen = proposals[frames[agrees], nearest[agrees]]
        if not len(chosen):
            break
        consensus = Transforms.of([median_transform([chosen.one(i) for i in range(len(chosen))])])
    _, closest = _nearest(proposals, depth, consensus)
    return _Consensus(
        consensus, int(_agree(closest).sum()), float(np.minimum(closest, FARTHEST).sum())
    )


def _nearest(
    proposals: Transforms, depth: FloatArray, to: Transforms
) -> tuple[IntArray, FloatArray]:
    """Which proposal of each frame is nearest, and how near (n_frames,)."""
    apart = distances(proposals, to, depth)
    apart = np.where(np.isfinite(apart), apart, np.inf)
    nearest = apart.argmin(1)
    return nearest, apart[np.arange(len(apart)), nearest]


def _agree(closest: FloatArray) -> NDArray[np.bool_]:
    most = max(AGREEING, TIMES_MEDIAN * float(np.median(closest)))
    return closest < min(most, FARTHEST)


def chained(
    links: Sequence[Link], n_cameras: int, reference: int
) -> tuple[dict[int, Transform], list[Link]]:
    """cam_from_rig of every camera that links reach from the reference, and the links used.

    A tree that prefers clear links, then those on which most frames agree.
    """
    found = {reference: Transform.identity()}
    used: list[Link] = []
    while True:
        open_links = [
            each
            for each in links
            if not each.refused and (each.cameras[0] in found) != (each.cameras[1] in found)
        ]
        if not open_links or len(found) == n_cameras:
            return found, used
        taken = max(open_links, key=lambda each: (not each.ambiguous, each.agreeing))
        a, b = taken.cameras
        if a in found:
            found[b] = taken.b_from_a @ found[a]
        else:
            found[a] = taken.b_from_a.inverse @ found[b]
        used.append(taken)

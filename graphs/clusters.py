"""Feature tracks in clusters: which are eliminated together, and by which front.

A cluster's tracks are seen by frames of one front of the elimination alone, so what is left of
them fits into that front's matrix, and long scans stay sparse.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graphs.elimination import Elimination
from graphs.frames import FloatArray
from graphs.losses import LossName
from graphs.points import FARTHEST
from graphs.problem import BoolArray, IntArray, Problem

CHUNK = 2048  # observations a chunk: its scratch stays in the second-level cache
# A large front's tracks are cut, so that threads share them, into at most so many matrices.
MOST_PARTS = 8
MOST_PARTS_BYTES = 2**30
PART_OBSERVATIONS = 10_000


@dataclass(frozen=True)
class Cluster:
    """Tracks that are eliminated together: each is seen by frames of one front only."""

    front: int
    frames: IntArray  # positions of the front's frames; `frame` counts within them
    first_point: int  # in the order of tracks
    begins: IntArray  # (n_points + 1,) first observation of each point
    frame: IntArray  # (n_obs,)
    camera: IntArray  # (n_obs,)
    pixels: FloatArray  # (n_obs, 2)
    root_information: FloatArray  # (n_obs, 3) of the pixels, upper triangles by rows
    anchors: FloatArray  # (n_points, 3)
    corner: IntArray | None = None  # (n_points,) of the board; None: points to be triangulated
    still: IntArray | None = None  # (n_points,) 1: of the board in the scene's world

    @property
    def n_points(self) -> int:
        return len(self.begins) - 1

    @property
    def points(self) -> slice:
        return slice(self.first_point, self.first_point + self.n_points)

    @property
    def most_rows(self) -> int:
        """Observations of a chunk at most."""
        return CHUNK + int(np.diff(self.begins).max())

    def chunks(self, points: IntArray) -> Iterator[IntArray]:
        """These points in turn, as many at a time as have about CHUNK observations."""
        lengths = self.begins[points + 1] - self.begins[points]
        part = (np.cumsum(lengths) - lengths) // CHUNK
        edges = np.flatnonzero(np.diff(part, prepend=-1, append=-1))
        yield from (points[a:b] for a, b in itertools.pairwise(edges))

    def parts(self, n_points: int) -> Iterator[Cluster]:
        """The cluster cut into pieces of so many points, over the frames that see them alone."""
        for first in range(0, self.n_points, n_points):
            last = min(first + n_points, self.n_points)
            rows = slice(int(self.begins[first]), int(self.begins[last]))
            used, frame = np.unique(self.frame[rows], return_inverse=True)
            yield Cluster(
                self.front, self.frames[used], self.first_point + first,
                self.begins[first : last + 1] - self.begins[first], frame.astype(np.int32),
                self.camera[rows], self.pixels[rows], self.root_information[rows],
                self.anchors[first:last],
                None if self.corner is None else self.corner[first:last],
                None if self.still is None else self.still[first:last],
            )  # fmt: skip


@dataclass(frozen=True)
class TrackColumns:
    """Where the variables that all frames share stand after the frames' columns."""

    rig: IntArray  # (n_cameras,) -1: the reference, held at the identity
    lens: IntArray  # (n_cameras,) cameras may share one; all after the rigs'
    n_params: IntArray  # (n_cameras,)
    width: int  # of all rigs and lenses, the border's first
    board: int = 0  # columns of the board, which come next

    @property
    def places(self) -> tuple[IntArray, IntArray, IntArray]:
        """As the kernels take them."""
        return self.rig, self.lens, self.n_params


@dataclass(frozen=True)
class Tracks:
    """All feature tracks of a problem, in clusters, and how their residuals are weighed."""

    clusters: tuple[Cluster, ...]
    order: IntArray  # (n_points,) the problem's point at each place
    columns: TrackColumns
    smallest_w: float
    loss: LossName
    loss_scale: float


def make_tracks(
    problem: Problem,
    root_information: FloatArray,
    elimination: Elimination,
    columns: TrackColumns,
    loss: LossName,
    loss_scale: float,
) -> Tracks:
    """Cut a problem's tracks into clusters along the fronts of an elimination.

    root_information (n_obs, 3): of the pixels, upper triangles by rows.
    """
    seen, start = problem.observations, problem.initial
    at = np.argsort(elimination.order)[seen.frame]  # position of each frame in the order
    earliest = np.full(len(start.points), len(elimination.order))
    np.minimum.at(earliest, seen.point, at)
    known, first_seen = problem.known, earliest[seen.point]
    # By front, then by kind: else a front whose frames see a board falls to pieces.
    front_of, kind = elimination.front_of[first_seen], known[seen.point]
    rows = np.lexsort((seen.camera, at, seen.point, first_seen, kind, front_of))
    point = seen.point[rows]
    first_row = np.flatnonzero(np.diff(point, prepend=-1))
    order = point[first_row]
    begins = np.append(first_row, len(rows))
    anchors = _anchors(problem, rows, begins)
    distance = np.linalg.norm(start.points[order] - anchors, axis=1)
    front = elimination.front_of[earliest[order]]
    clusters = []
    for first, last in _cuts(front, known[order], begins, elimination):
        frames = elimination.fronts[front[first]].frames
        mine = rows[begins[first] : begins[last]]
        corner, still = _of_board(problem, order[first:last])
        clusters.append(
            Cluster(
                front=int(front[first]),
                frames=frames,
                first_point=first,
                begins=begins[first : last + 1] - begins[first],
                frame=np.searchsorted(frames, at[mine]).astype(np.int32),
                camera=seen.camera[mine].astype(np.int32),
                pixels=seen.pixels[mine],
                root_information=root_information[mine],
                anchors=anchors[first:last],
                corner=corner,
                still=still,
            )
        )
    return Tracks(
        tuple(clusters), order, columns,
        1 / (FARTHEST * float(np.median(distance))), loss, loss_scale,
    )  # fmt: skip


def _of_board(problem: Problem, points: IntArray) -> tuple[IntArray | None, IntArray | None]:
    """Which corners points of one kind are, and whether the board stands; None: of the scene."""
    if problem.board is None or problem.board.corner[points[0]] < 0:
        return None, None
    return problem.board.corner[points], problem.board.still[points].astype(np.int64)


def _anchors(problem: Problem, rows: IntArray, begins: IntArray) -> FloatArray:
    """For each point the place at the start of the camera farthest from it (n_points, 3).

    Not the mean of all: who walks around a thing has it there. Not any one: a mismatched track may
    end in a camera.
    """
    start, seen = problem.initial, problem.observations
    world_from_rig = [t.inverse for t in start.rig_from_world]
    in_rig = np.array([t.inverse.translation for t in start.cam_from_rig])
    places = np.array([t @ in_rig for t in world_from_rig])  # (n_frames, n_cameras, 3)
    centres = places[seen.frame[rows], seen.camera[rows]]
    lengths = np.diff(begins)
    points = np.repeat(start.points[seen.point[rows[begins[:-1]]]], lengths, axis=0)
    distance = ((centres - points) ** 2).sum(1)
    farthest = np.repeat(np.maximum.reduceat(distance, begins[:-1]), lengths)
    is_farthest = np.flatnonzero(distance == farthest)
    first = np.searchsorted(is_farthest, begins[:-1])  # of each point's, in their order
    return centres[is_farthest[first]]


def _cuts(
    front: IntArray, known: BoolArray, begins: IntArray, elimination: Elimination
) -> Iterator[tuple[int, int]]:
    """Ranges of points of one front and one kind each, large ones in parts that threads share."""
    edges = [*np.flatnonzero(np.diff(2 * front + known, prepend=-1)).tolist(), len(front)]
    for first, last in itertools.pairwise(edges):
        size = len(elimination.columns(elimination.fronts[front[first]]))
        room = max(MOST_PARTS_BYTES // (8 * size * size), 1)
        observations = int(begins[last] - begins[first])
        parts = int(np.clip(observations // PART_OBSERVATIONS, 1, min(room, MOST_PARTS)))
        goal = begins[first] + np.arange(1, parts) * (observations / parts)
        cuts = [first, *np.searchsorted(begins, goal).tolist(), last]
        yield from ((a, b) for a, b in itertools.pairwise(cuts) if b > a)


def homogeneous(tracks: Tracks, points: FloatArray) -> FloatArray:
    """Scene points (n_points, 3) as the kernels hold them (n_seen, 4), in the tracks' order."""
    anchors = np.concatenate([cluster.anchors for cluster in tracks.clusters])
    away = points[tracks.order] - anchors
    nearest, farthest = 1e-12 / (tracks.smallest_w * FARTHEST), 1 / tracks.smallest_w
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    away = np.where(distance < nearest, [0.0, 0.0, 1.0], away)  # a point in its own camera
    bearing = away / np.linalg.norm(away, axis=1, keepdims=True)
    return np.hstack([bearing, 1 / np.clip(distance, nearest, farthest)])


def euclidean(tracks: Tracks, points: FloatArray, unseen: FloatArray) -> FloatArray:
    """Scene points (n_points, 3) in the problem's order from the kernels' (n_seen, 4).

    unseen (n_points, 3): where points stay that no observation sees.
    """
    anchors = np.concatenate([cluster.anchors for cluster in tracks.clusters])
    result = unseen.copy()
    result[tracks.order] = anchors + points[:, :3] / points[:, 3:]
    return result

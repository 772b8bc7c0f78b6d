"""How well a calibration predicts frames that it was not fitted to.

The frames are dealt out into folds. Without one fold's frames lenses, rig and points are solved
for; then these are held, and each frame of the fold may only find its own place. What is left of
its residuals is the error of a prediction (Stone, J. R. Stat. Soc. B, 1974).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from graphs.boards import corners_of, shape_of
from graphs.build import GraphOptions, build, root_information
from graphs.camera import lens_arrays
from graphs.frames import FloatArray, Transform
from graphs.lenses import project_many
from graphs.losses import LOSS_INDEX, weigh_many
from graphs.problem import Estimate, IntArray, Observations, Problem, whitened
from graphs.selection import MIN_TRACK_LENGTH, compact
from graphs.solve import solve

MIN_IN_FRAME = 10  # observations: 20 coordinates for the six of its pose
RELATIVE_TOLERANCE, MOST_STEPS = 1e-4, 40  # of a fold's solve: it starts at the whole's optimum
RESECTION_STEPS = 30
RESECTION_TOLERANCE = 1e-5  # of a frame's cost
FIRST_DAMPING, DAMPING_FACTOR, STUCK_DAMPING = 1e-4, 10.0, 1e6


def held_out_costs(problem: Problem, options: GraphOptions, n_folds: int) -> FloatArray:
    """Robust cost (n_obs,) of each observation in a frame that nothing was fitted to.

    In halves of squared sigmas, as the options' loss has it; NaN where the frame or the point is
    seen too little without the fold. Frame i belongs to fold i mod n_folds: a block of neighbours
    loses most of its points, and its error is the map's, which then has to be extended, not the
    lens's. The problem starts at its optimum.
    Raises ValueError when what is left of a fold determines too little.
    """
    costs = np.full(len(problem.observations), np.nan)
    fold = np.arange(len(problem.frame_names)) % n_folds
    for index in range(n_folds):
        held = fold[problem.observations.frame] == index
        train = well_seen(problem.observations, ~held, problem.known)
        if not train.any():
            raise ValueError("too few points are seen often enough without a part of the frames")
        fitted = _fit(problem, options, train)
        seen_too = np.isin(problem.observations.point, problem.observations.point[train])
        rows = held & (seen_too | problem.known[problem.observations.point])
        in_frame = np.bincount(problem.observations.frame[rows], minlength=len(fold))
        rows &= in_frame[problem.observations.frame] >= MIN_IN_FRAME
        if rows.any():
            costs[rows] = resected(fitted, problem.observations.subset(rows), options)[1]
    return costs


def well_seen(
    seen: Observations, keep: NDArray[np.bool_], known: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Of the observations to keep (n_obs,), those of long tracks and of frames that see enough.

    known (n_points,): corners of a board, which need no track.
    """
    while True:
        length = np.bincount(seen.point[keep], minlength=int(seen.point.max()) + 1)
        in_frame = np.bincount(seen.frame[keep], minlength=int(seen.frame.max()) + 1)
        long = length >= MIN_TRACK_LENGTH
        if known is not None:
            long |= known[: len(length)]
        enough = long[seen.point] & (in_frame >= MIN_IN_FRAME)[seen.frame]
        if (enough | ~keep).all():
            return keep
        keep = keep & enough


def _fit(problem: Problem, options: GraphOptions, train: NDArray[np.bool_]) -> Estimate:
    """The problem's estimate with lenses, rig and points as some observations have them."""
    part = compact(problem, problem.observations.subset(train))
    found = solve(build(part, options), MOST_STEPS, RELATIVE_TOLERANCE)[0]
    points = problem.initial.points.copy()
    points[np.unique(problem.observations.point[train])] = found.points
    if part.board is not None and problem.board is not None:
        # Of frames held out too: where the others have the board.
        known, still = problem.board.known, problem.board.still
        corners = corners_of(part.board.board, shape_of(found, part.board.board))[0]
        points[known] = corners[problem.board.corner[known]]
        if found.world_from_board is not None:
            points[still] = found.world_from_board @ points[still]
        else:
            points[still] = problem.initial.points[still]
    return replace(
        problem.initial, cameras=found.cameras, cam_from_rig=found.cam_from_rig, points=points
    )


@dataclass(frozen=True)
class _Seen:
    """What is held while frames move, one row an observation."""

    frame: IntArray  # (n,)
    points: FloatArray  # (n, 3) in the world
    rig_rotation: FloatArray  # (n, 3, 3) of cam_from_rig
    rig_translation: FloatArray  # (n, 3)
    observations: Observations
    estimate: Estimate
    root_information: FloatArray  # (n, 3) upper triangles by rows
    options: GraphOptions


@dataclass(frozen=True)
class _Placed:
    """Frames at some poses: residuals of their observations, and how the poses move them."""

    rotation: FloatArray  # (n_frames, 3, 3) of rig_from_world
    translation: FloatArray  # (n_frames, 3)
    residuals: FloatArray  # (n, 2) whitened
    weights: FloatArray  # (n,)
    costs: FloatArray  # (n,)
    by_pose: FloatArray  # (n, 2, 6) by a turn and a shift of the rig in its own axes

    def transforms(self) -> tuple[Transform, ...]:
        return tuple(Transform(r, t) for r, t in zip(self.rotation, self.translation, strict=True))


def resected(
    estimate: Estimate, observations: Observations, options: GraphOptions
) -> tuple[Estimate, FloatArray]:
    """The estimate with each observed frame where it fits best, and the observations' costs (n,).

    Lenses, rig and points are held. Levenberg-Marquardt on all frames at once, each with its own
    damping; iteratively reweighted as the options' loss has it.
    """
    frames, frame = np.unique(observations.frame, return_inverse=True)
    seen = _held(estimate, observations, frame, options)
    start = [estimate.rig_from_world[f] for f in frames]
    now = _place(
        seen, np.array([t.rotation for t in start]), np.array([t.translation for t in start])
    )
    damping = np.full(len(frames), FIRST_DAMPING)
    moving = np.ones(len(frames), dtype=bool)
    for _ in range(RESECTION_STEPS):
        trial = _step(seen, now, damping)
        before, after = (np.bincount(frame, placed.costs) for placed in (now, trial))
        better = moving & (after < before)
        now = _mixed(now, trial, better, frame)
        damping = np.where(better, damping / DAMPING_FACTOR, damping * DAMPING_FACTOR)
        moving &= ~better | (before - after > RESECTION_TOLERANCE * before)
        moving &= damping < STUCK_DAMPING
        if not moving.any():
            break
    placed = list(estimate.rig_from_world)
    for index, transform in zip(frames, now.transforms(), strict=True):
        placed[index] = transform
    return replace(estimate, rig_from_world=tuple(placed)), now.costs


def _held(
    estimate: Estimate, observations: Observations, frame: IntArray, options: GraphOptions
) -> _Seen:
    rig = [estimate.cam_from_rig[camera] for camera in range(len(estimate.cameras))]
    rotations, translations = (
        np.array([t.rotation for t in rig]),
        np.array([t.translation for t in rig]),
    )
    camera = observations.camera
    root = root_information(Problem(estimate, observations, ()), options)
    return _Seen(
        frame,
        estimate.points[observations.point],
        rotations[camera],
        translations[camera],
        observations,
        estimate,
        root,
        options,
    )


def _place(seen: _Seen, rotation: FloatArray, translation: FloatArray) -> _Placed:
    in_rig = np.einsum("nij,nj->ni", rotation[seen.frame], seen.points) + translation[seen.frame]
    in_camera = np.einsum("nij,nj->ni", seen.rig_rotation, in_rig) + seen.rig_translation
    models, params, limits = lens_arrays(seen.estimate.cameras)
    n = len(in_rig)
    pixels, by_point = np.empty((n, 2)), np.empty((n, 2, 3))
    project_many(
        models, params, limits, seen.observations.camera, in_camera, pixels, by_point,
        np.empty((n, 2, params.shape[1])),
    )  # fmt: skip
    residuals, (weights, bends, costs) = np.empty((n, 2)), np.empty((3, n))
    loss, scale = LOSS_INDEX[seen.options.loss], seen.options.loss_scale
    weigh_many(
        loss, scale, pixels, seen.observations.pixels, seen.root_information, residuals, weights,
        bends, costs,
    )  # fmt: skip
    by_shift = np.einsum("nij,njk->nik", by_point, seen.rig_rotation)
    by_shift = whitened(by_shift, seen.root_information)
    by_turn = np.cross(in_rig[:, None, :], by_shift)  # a turn w moves the point by w x point
    by_pose = np.concatenate([by_turn, by_shift], axis=2)
    return _Placed(rotation, translation, residuals, weights, costs, by_pose)


def _mixed(now: _Placed, trial: _Placed, better: NDArray[np.bool_], frame: IntArray) -> _Placed:
    """The trial for frames that it is better for (n_frames,), as they are for the others."""
    rows = better[frame]
    return _Placed(
        np.where(better[:, None, None], trial.rotation, now.rotation),
        np.where(better[:, None], trial.translation, now.translation),
        np.where(rows[:, None], trial.residuals, now.residuals),
        np.where(rows, trial.weights, now.weights),
        np.where(rows, trial.costs, now.costs),
        np.where(rows[:, None, None], trial.by_pose, now.by_pose),
    )


def _step(seen: _Seen, now: _Placed, damping: FloatArray) -> _Placed:
    n_frames = len(damping)
    normal, gradient = np.zeros((n_frames, 6, 6)), np.zeros((n_frames, 6))
    weighted = now.by_pose * now.weights[:, None, None]
    np.add.at(normal, seen.frame, np.einsum("nij,nik->njk", weighted, now.by_pose))
    np.add.at(gradient, seen.frame, np.einsum("nij,ni->nj", weighted, now.residuals))
    diagonal = np.einsum("fii->fi", normal)
    damped = normal + np.eye(6) * (damping[:, None] * diagonal + 1e-300)[:, None, :]
    change = -np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
    steps = [Transform.exp(c[:3], c[3:]) for c in change]
    moved = [step @ placed for step, placed in zip(steps, now.transforms(), strict=True)]
    return _place(
        seen, np.array([t.rotation for t in moved]), np.array([t.translation for t in moved])
    )

"""Two reconstructions of one rig whose cameras share no view: joined by how they move.

Hand-eye calibration with unknown scale: both cameras sit on one rig, so their motions between
frames are the same motion seen from two places (Daniilidis, IJRR 1999; here rotation by Kabsch,
then translation and scale by linear least squares).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphs.frames import FloatArray, Transform, log_rotation
from graphs.problem import joined
from graphs.rig_start import FreeModel, median_transform

MIN_FRAMES = 4  # three motions: two to solve, one to notice
MIN_TURN_DEG = 5.0  # about a second axis; below, translation along the first is not determined
# Turning about one point of the rig (a pan-tilt head; an orbit, nearly: 0.028) any scale fits.
# Below, errors of the motions are magnified a hundredfold; handheld scans have 0.3 to 0.7.
MIN_INDEPENDENCE = 0.01


def join_models(main: FreeModel, other: FreeModel) -> FreeModel:
    """`main` with the cameras that only `other` has, moved into main's world.

    Returns `main` unchanged when nothing is gained, too few frames are shared, or the rig
    turned about one axis only, so that the motion does not tell how the cameras sit.
    """
    have = {camera for camera, _ in main.cam_from_world}
    news = sorted({camera for camera, _ in other.cam_from_world} - have)
    if not news:
        return main
    frames_of = {c: set(main.images_of(c)) for c in have}
    new = max(news, key=lambda c: len(other.images_of(c)))
    known = max(have, key=lambda c: (len(frames_of[c] & set(other.images_of(new))), -c))
    frames = sorted(frames_of[known] & set(other.images_of(new)))
    solved = hand_eye(
        [main.cam_from_world[known, frame] for frame in frames],
        [other.cam_from_world[new, frame] for frame in frames],
    )
    if solved is None:
        return main
    new_from_known, scale = solved
    world_other_from_main = median_transform(
        [
            other.cam_from_world[new, frame].scaled(scale).inverse
            @ new_from_known
            @ main.cam_from_world[known, frame]
            for frame in frames
        ]
    )
    return _merged(main, other, news, world_other_from_main, scale)


def hand_eye(
    a_from_world: list[Transform], b_from_world: list[Transform]
) -> tuple[Transform, float] | None:
    """b_from_a and the factor that brings b's lengths into a's, from poses of the same frames.

    None when the frames are fewer than MIN_FRAMES, or turn about a single axis or a single point.
    """
    if len(a_from_world) < MIN_FRAMES:
        return None
    motions = [
        (a_from_world[j] @ a_from_world[i].inverse, b_from_world[j] @ b_from_world[i].inverse)
        for i in range(len(a_from_world))
        for j in range(i + 1, len(a_from_world))
    ]
    turns_a = np.array([log_rotation(a.rotation) for a, _ in motions])
    turns_b = np.array([log_rotation(b.rotation) for _, b in motions])
    small = np.linalg.norm(turns_a, axis=1) < np.radians(170)  # the axis flips at half a turn
    u, spread, vt = np.linalg.svd(turns_b[small].T @ turns_a[small])
    if spread[1] < len(motions) * np.radians(MIN_TURN_DEG) ** 2:
        return None
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    rows, values = [], []
    for a, b in motions:  # (R_b - I) t + scale t_b = R t_a
        rows.append(np.column_stack([b.rotation - np.eye(3), b.translation]))
        values.append(rotation @ a.translation)
    system = np.vstack(rows)
    lengths = np.maximum(np.linalg.norm(system, axis=0), 1e-300)
    if np.linalg.svd(system / lengths, compute_uv=False)[-1] < MIN_INDEPENDENCE:
        return None
    solution: FloatArray = np.linalg.lstsq(system, np.concatenate(values))[0]
    if solution[3] <= 0:
        return None
    return Transform(rotation, solution[:3]), float(solution[3])


def _merged(
    main: FreeModel,
    other: FreeModel,
    news: list[int],
    world_other_from_main: Transform,
    scale: float,
) -> FreeModel:
    poses = dict(main.cam_from_world)
    for (camera, frame), cam_from_world in other.cam_from_world.items():
        if camera in news:
            poses[camera, frame] = cam_from_world.scaled(scale) @ world_other_from_main
    points = world_other_from_main.inverse @ (other.points * scale)
    a, b = main.observations, other.observations.subset(np.isin(other.observations.camera, news))
    together = joined([a, replace(b, point=b.point + len(main.points))])
    cameras = tuple(
        other.cameras[i] if i in news else camera for i, camera in enumerate(main.cameras)
    )
    return replace(
        main,
        cameras=cameras,
        cam_from_world=poses,
        points=np.concatenate([main.points, points]),
        observations=together,
    )

"""Tracks out of matches between images at known places: joined, placed, and rid of contradictions.

One wrong match in a hundred makes one track of two scene points in most of the long ones. So a
track is taken apart: the point that most of its rays meet in, then what is left of them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit

from graphs.camera import focal_on_axis, unproject
from graphs.frames import FloatArray
from graphs.problem import (
    BoolArray,
    Estimate,
    IntArray,
    Observations,
    Problem,
    residuals_px,
)

GATE_PX = 4.0  # COLMAP's; what is beyond the noise but within, the graph's own rounds reject
MOST_POINTS = 4  # that a track is taken apart into
TRIALS = 60  # pairs of rays tried for each point
POLISHINGS = 3
PARALLEL = 1e-12  # information that keeps a point finite where all rays are parallel


def join_matches(image: IntArray, links: IntArray, likeness: FloatArray) -> IntArray:
    """The track of each feature (n_features,) of an image, from matches (n, 2); -1: alone.

    The likest come first, and what would give a track two features of one image is left out: of
    3,000 tracks that all matches joined, one was a third of a scan.
    """
    order = np.argsort(-likeness, kind="stable")
    root = _joined(image, links[order].astype(np.int64), int(image.max(initial=-1)) + 1)
    alone = np.bincount(root, minlength=len(root))[root] < 2
    track = np.full(len(image), -1)
    track[~alone] = np.unique(root[~alone], return_inverse=True)[1]
    return track


def joined_at_spots(problem: Problem) -> Problem:
    """The problem with tracks that meet at one pixel of an image as one track.

    A blob with two orientations is two features of SIFT's, a fifth of all are such, and their
    tracks say the same twice. Where joining would give a track two pixels of one image it stays
    apart; the longer track's point is taken. Points are numbered anew: a problem whose boards or
    measured spans name points is not for this.
    """
    seen, points = problem.observations, problem.initial.points
    image = seen.camera * len(problem.frame_names) + seen.frame
    places = np.column_stack([image, seen.pixels])
    _, first, spot = np.unique(places, axis=0, return_index=True, return_inverse=True)
    spot = spot.ravel()
    order = np.lexsort((image, seen.point))
    linked = np.flatnonzero(np.diff(seen.point[order]) == 0)
    links = np.stack([spot[order[linked]], spot[order[linked + 1]]], axis=1)
    length = np.bincount(seen.point)
    track = join_matches(image[first], links, length[seen.point[order[linked]]].astype(np.float64))
    rows, track = first[track >= 0], track[track >= 0]
    shortest_first = np.argsort(length[seen.point[rows]], kind="stable")
    placed = np.empty((int(track.max(initial=-1)) + 1, 3))
    placed[track[shortest_first]] = points[seen.point[rows[shortest_first]]]
    return replace(
        problem,
        initial=replace(problem.initial, points=placed),
        observations=replace(seen.subset(rows), point=track),
    )


@njit(cache=True)
def _joined(image: Any, links: Any, n_images: Any) -> Any:
    """The track (n_features,) of each feature, by the number of one of its own."""
    n = len(image)
    root, following = np.arange(n), np.full(n, -1)  # members of a track in a list from its root
    last, size = np.arange(n), np.ones(n, np.int64)
    marked = np.full(n_images, -1)
    for number in range(len(links)):
        a, b = root[links[number, 0]], root[links[number, 1]]
        if a == b:
            continue
        if size[a] < size[b]:
            a, b = b, a
        member, clash = a, False
        while member >= 0:
            marked[image[member]] = number
            member = following[member]
        member = b
        while member >= 0 and not clash:
            clash = marked[image[member]] == number
            member = following[member]
        if clash:
            continue
        member = b
        while member >= 0:
            root[member] = a
            member = following[member]
        following[last[a]], last[a] = b, last[b]
        size[a] += size[b]
    return root


def consistent_tracks(
    estimate: Estimate, seen: Observations
) -> tuple[FloatArray, Observations, IntArray]:
    """Points (n, 3) of tracks, the observations that agree with them, and which those are (n_obs,).

    `seen.point` are tracks, which may show several points and one image several times; the
    estimate's own points are not looked at. Of a point, an image keeps the best observation.
    """
    centres, rays = rays_of(estimate, seen)
    order = np.lexsort((np.arange(len(seen)), seen.point))
    order = order[np.isfinite(rays[order, 0])]
    begins = np.searchsorted(seen.point[order], np.arange(seen.point.max(initial=-1) + 2))
    px = np.array([1 / focal_on_axis(camera).mean() for camera in estimate.cameras])
    gates = GATE_PX * px[seen.camera[order]]
    part = _take_apart(centres[order], rays[order], gates, begins)
    which: IntArray = order[part >= 0]
    owner = seen.point[which] * MOST_POINTS + part[part >= 0]
    points, agreeing, best = _placed(estimate, centres, rays, seen, which, owner)
    return points, agreeing, which[best]


def _placed(
    estimate: Estimate,
    centres: FloatArray,
    rays: FloatArray,
    seen: Observations,
    which: IntArray,
    owner: IntArray,
) -> tuple[FloatArray, Observations, IntArray]:
    """Points, and of the rows `which` those that agree with the point of their owner."""
    point = np.unique(owner, return_inverse=True)[1]
    points = nearest_points(centres[which], rays[which], point)
    trial = replace(seen.subset(which), point=point)
    errors = np.linalg.norm(residuals_px(replace(estimate, points=points), trial), axis=1)
    good = _best_of_each_image(trial, errors)
    good &= np.bincount(point[good], minlength=len(points))[point] >= 2
    kept: IntArray = np.flatnonzero(good)
    found, point = np.unique(point[kept], return_inverse=True)
    return points[found], replace(seen.subset(which[kept]), point=point), kept


def _best_of_each_image(seen: Observations, errors: FloatArray) -> BoolArray:
    """Which observations are within the gate, and the nearest that their image has of the point."""
    order = np.argsort(np.nan_to_num(errors, nan=np.inf), kind="stable")
    most = seen.frame.max(initial=0) + 1, seen.camera.max(initial=0) + 1
    image = (seen.point * most[0] + seen.frame) * most[1] + seen.camera
    best = np.zeros(len(seen), dtype=bool)
    best[order[np.unique(image[order], return_index=True)[1]]] = True
    with np.errstate(invalid="ignore"):
        return best & (errors < GATE_PX)


def rays_of(estimate: Estimate, seen: Observations) -> tuple[FloatArray, FloatArray]:
    """Centres and unit directions (n_obs, 3) in the world; NaN where the lens sees nothing."""
    centres, rays = np.empty((len(seen), 3)), np.empty((len(seen), 3))
    for index, camera in enumerate(estimate.cameras):
        rows = np.flatnonzero(seen.camera == index)
        poses = [estimate.cam_from_rig[index] @ one for one in estimate.rig_from_world]
        world_from_cam = np.array([pose.rotation.T for pose in poses])[seen.frame[rows]]
        centres[rows] = np.array([pose.inverse.translation for pose in poses])[seen.frame[rows]]
        rays[rows] = np.einsum("nij,nj->ni", world_from_cam, unproject(camera, seen.pixels[rows]))
    return centres, rays


def nearest_points(centres: FloatArray, rays: FloatArray, track: IntArray) -> FloatArray:
    """The points (n_tracks, 3) nearest to rays (n, 3) from centres (n, 3), by angle.

    Least squares of the distance across each ray over its depth.
    """
    n = int(track.max(initial=-1)) + 1
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    offset = np.einsum("nij,nj->ni", across, centres)
    weight, points = np.ones(len(rays)), np.zeros((n, 3))
    for _ in range(POLISHINGS):
        weight /= np.bincount(track, weights=weight, minlength=n)[track]
        normal = _summed(weight[:, None] * across.reshape(-1, 9), track, n).reshape(-1, 3, 3)
        right = _summed(weight[:, None] * offset, track, n)
        solved = np.linalg.solve(normal + PARALLEL * np.eye(3), right[..., None])
        points = solved[..., 0].astype(np.float64)
        weight = 1 / np.maximum(((points[track] - centres) ** 2).sum(1), 1e-24)
    return points


def _summed(values: FloatArray, track: IntArray, n: int) -> FloatArray:
    return np.stack([np.bincount(track, weights=column, minlength=n) for column in values.T], 1)


@njit(cache=True)
def _take_apart(centres: Any, rays: Any, gates: Any, begins: Any) -> Any:
    """Which of its track's points (n,) each ray sees, from 0; -1: none that another ray sees.

    Of the points of TRIALS pairs of rays, all where there are fewer, the one to which the rays
    come nearest, none counted for more than its gate (rad).
    """
    part = np.full(len(rays), -1)
    for track in range(len(begins) - 1):
        for number in range(MOST_POINTS):
            left = np.flatnonzero(part[begins[track] : begins[track + 1]] < 0) + begins[track]
            n = len(left)
            if n < 2:
                break
            most = n * (n - 1) // 2
            # Pairs in steps that are prime to their number visit it evenly, the same every time.
            step = max(1, int(0.618 * most)) if most > TRIALS else 1
            best, where = float(n - 1), np.zeros(3)
            for trial in range(min(most, TRIALS)):
                i, j = _pair((trial * step) % most, n)
                a, b = left[i], left[j]
                met, point = _meeting(centres[a], rays[a], centres[b], rays[b])
                if not met:
                    continue
                cost = 0.0
                for row in left:
                    cost += min(_error(point, centres[row], rays[row]) / gates[row], 1.0) ** 2
                    if cost >= best:
                        break
                if cost < best:
                    best, where = cost, point
            if best >= n - 1:
                break
            for row in left:
                if _error(where, centres[row], rays[row]) < gates[row]:
                    part[row] = number
    return part


@njit(cache=True)
def _pair(number: Any, n: Any) -> Any:
    """The pair i < j < n with this number."""
    i = 0
    while number >= n - 1 - i:
        number -= n - 1 - i
        i += 1
    return i, i + 1 + number


@njit(cache=True)
def _error(point: Any, centre: Any, ray: Any) -> Any:
    """Angle between a ray and the direction in which its centre sees a point, about."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    depth = x * ray[0] + y * ray[1] + z * ray[2]
    if depth <= 0:
        return np.inf
    x, y, z = x - depth * ray[0], y - depth * ray[1], z - depth * ray[2]
    return np.sqrt(x * x + y * y + z * z) / depth


@njit(cache=True)
def _meeting(centre_a: Any, ray_a: Any, centre_b: Any, ray_b: Any) -> Any:
    """Whether two rays come near each other ahead of both, and the point halfway between."""
    along = centre_b - centre_a
    both = ray_a[0] * ray_b[0] + ray_a[1] * ray_b[1] + ray_a[2] * ray_b[2]
    on_a = along[0] * ray_a[0] + along[1] * ray_a[1] + along[2] * ray_a[2]
    on_b = along[0] * ray_b[0] + along[1] * ray_b[1] + along[2] * ray_b[2]
    sine2 = 1 - both * both
    if sine2 < PARALLEL:
        return False, centre_a
    depth_a, depth_b = (on_a - both * on_b) / sine2, (both * on_a - on_b) / sine2
    if depth_a <= 0 or depth_b <= 0:
        return False, centre_a
    return True, (centre_a + depth_a * ray_a + centre_b + depth_b * ray_b) / 2

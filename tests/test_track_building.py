"""Tracks of matches: joined without contradictions, taken apart where they show two points."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic.problems import small_problem

from graphs.problem import Observations, joined
from graphs.track_building import (
    GATE_PX,
    consistent_tracks,
    join_matches,
    joined_at_spots,
    nearest_points,
)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_no_image_is_in_a_track_twice(seed):
    rng = np.random.default_rng(seed)
    image = np.sort(rng.integers(0, 8, 60))
    links = rng.integers(0, 60, (80, 2))
    track = join_matches(image, links, rng.random(80))
    pairs = np.stack([track, image], axis=1)[track >= 0]
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert (np.bincount(pairs[:, 0]) >= 2).all() if len(pairs) else (track == -1).all()


def test_matches_that_agree_are_joined_whatever_their_order():
    image = np.tile(np.arange(5), 3)  # three points, seen by five images
    links = np.array([[3 * 0 + i + 5 * p, i + 1 + 5 * p] for p in range(3) for i in range(4)])
    for seed in range(3):
        rng = np.random.default_rng(seed)
        track = join_matches(image, links[rng.permutation(len(links))], rng.random(len(links)))
        assert [len(set(track[5 * p : 5 * p + 5])) for p in range(3)] == [1, 1, 1]
        assert len(set(track)) == 3


def test_the_likest_match_wins_a_contradiction():
    image = np.array([0, 1, 1])
    track = join_matches(image, np.array([[0, 1], [0, 2]]), np.array([0.8, 0.9]))
    assert track[0] == track[2] >= 0 and track[1] == -1


def test_without_matches_there_are_no_tracks():
    track = join_matches(np.arange(4), np.zeros((0, 2), dtype=np.int64), np.zeros(0))
    assert (track == -1).all()


def exact(lens="radial", **how):
    """A problem at its truth, and without noise."""
    problem, true = small_problem(lens, sigma_px=0.0, start_error=0.0, **how)
    return true, problem.observations


def test_points_are_found_from_the_rays_alone():
    for lens in ("radial", "kannala_brandt"):
        true, seen = exact(lens, points=40)
        points, kept, which = consistent_tracks(replace(true, points=np.zeros((0, 3))), seen)
        assert len(kept) == len(seen) and sorted(which) == list(range(len(seen)))
        np.testing.assert_allclose(points[kept.point], true.points[seen.point[which]], atol=1e-6)


def test_a_track_of_two_points_is_taken_apart():
    true, seen = exact(points=40, frames=6)
    merged = replace(seen, point=seen.point // 2)
    points, kept, which = consistent_tracks(true, merged)
    # An image that sees both points keeps each: a point has the best of an image, not the track.
    assert len(kept) > 0.98 * len(seen)
    # Where the other's rays pass by within the gate, a few of them pull.
    off = np.linalg.norm(points[kept.point] - true.points[seen.point[which]], axis=1)
    assert (off < 1e-6).mean() > 0.95 and (off < 0.05).mean() > 0.99


def test_wrong_observations_are_left_out_and_take_nothing_with_them():
    true, seen = exact(points=40, frames=8)
    wrong = np.zeros(len(seen), dtype=bool)
    wrong[::9] = True
    pixels = seen.pixels + np.where(wrong, 15 * GATE_PX, 0.0)[:, None]
    points, kept, which = consistent_tracks(true, replace(seen, pixels=pixels))
    good = ~wrong[which]
    assert good.sum() > 0.95 * (~wrong).sum()
    right = np.linalg.norm(points[kept.point] - true.points[seen.point[which]], axis=1) < 1e-6
    assert right[good].mean() > 0.99


def test_of_two_observations_in_an_image_the_better_stays():
    true, seen = exact(points=20)
    double = seen.subset(np.arange(len(seen)) == 0)
    double = replace(double, pixels=double.pixels + GATE_PX / 2)
    _, kept, which = consistent_tracks(true, joined([seen, double]))
    assert 0 in which and len(seen) not in which and len(kept) == len(seen)


def test_every_point_is_seen_by_two_images():
    """Where noise is as large as the gate, many an observation is left out."""
    for seed in range(3):
        problem, true = small_problem(sigma_px=GATE_PX, start_error=0.0, seed=seed, points=60)
        seen = problem.observations
        points, kept, _ = consistent_tracks(true, seen)
        assert 0 < len(kept) < 0.9 * len(seen)
        image = np.stack([kept.point, kept.frame, kept.camera], axis=1)
        assert len(np.unique(image, axis=0)) == len(kept)
        assert (np.bincount(kept.point, minlength=len(points)) >= 2).all()


def test_nothing_comes_of_nothing():
    true, _ = exact()
    none = np.zeros(0, dtype=np.int64)
    points, kept, which = consistent_tracks(true, Observations(np.zeros((0, 2)), none, none, none))
    assert points.shape == (0, 3) and len(kept) == len(which) == 0


def test_the_nearest_point_of_rays_that_meet():
    rng = np.random.default_rng(0)
    point = np.array([[0.5, -0.2, 4.0], [1.0, 2.0, 9.0]])
    centres = rng.normal(size=(10, 3))
    track = np.arange(10) % 2
    rays = point[track] - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(nearest_points(centres, rays, track), point, atol=1e-8)


def test_near_and_far_rays_count_by_their_angle():
    """Of a point 1 and 30 m away: the near ray, right to a millimetre, is not outvoted."""
    point, off = np.array([0.0, 0.0, 1.0]), 2e-3
    centres = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, 0.0, -29.0], [1.0, 0.0, -29.0]])
    rays = point - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays[2:] += [0.0, off, 0.0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = nearest_points(centres, rays, np.zeros(4, dtype=np.int64))[0]
    # Along y: two rays through 0 and two through 30 off, by angle 900 times less.
    assert found[1] == pytest.approx(30 * off / 901, rel=0.2)


# ---- blobs of two orientations --------------------------------------------------------------


def as_rows(problem, names):
    """Tracks as sets of (frame, pixel name), by the names that stand for pixels."""
    seen = problem.observations
    tracks = {}
    for frame, pixel, point in zip(seen.frame, seen.pixels, seen.point, strict=True):
        tracks.setdefault(int(point), set()).add((int(frame), names[tuple(pixel)]))
    return sorted(map(sorted, tracks.values()))


def problem_of_tracks(tracks):
    """One camera; each track a dictionary from frame to a number that makes its pixel."""
    problem, _ = small_problem(cameras=1, frames=6, points=30)
    rows = [(f, k, i) for i, track in enumerate(tracks) for f, k in track.items()]
    frame, name, point = np.array(rows).T
    pixels = np.column_stack([10.0 * name, 7.0 * frame + 0.25])
    names = {tuple(p): int(k) for p, k in zip(pixels, name, strict=True)}
    seen = Observations(pixels, frame, np.zeros_like(frame), point)
    points = np.arange(3.0 * len(tracks)).reshape(-1, 3)
    initial = replace(problem.initial, points=points)
    return replace(problem, initial=initial, observations=seen), names


def test_tracks_that_meet_are_one_and_keep_the_longer_ones_point():
    problem, names = problem_of_tracks([{0: 1, 1: 2}, {1: 2, 2: 3, 3: 4}, {4: 5, 5: 6}])
    joined_problem = joined_at_spots(problem)
    assert as_rows(joined_problem, names) == [
        [(0, 1), (1, 2), (2, 3), (3, 4)],
        [(4, 5), (5, 6)],
    ]
    of_longest = joined_problem.initial.points[joined_problem.observations.point[0]]
    np.testing.assert_array_equal(of_longest, problem.initial.points[1])


def test_tracks_that_contradict_each_other_stay_apart():
    """They meet in frame 1, and show different pixels of frame 2: the longer has the spot."""
    problem, names = problem_of_tracks([{1: 2, 2: 9, 3: 8}, {0: 1, 1: 2, 2: 3, 4: 4}])
    found = as_rows(joined_at_spots(problem), names)
    assert [(0, 1), (1, 2), (2, 3), (4, 4)] in found
    for track in found:
        assert len({frame for frame, _ in track}) == len(track)


def test_where_nothing_meets_nothing_changes():
    problem, _ = small_problem(points=40)
    same = joined_at_spots(problem).observations
    before = {tuple(p): q for p, q in zip(problem.observations.pixels, problem.observations.point,
                                          strict=True)}  # fmt: skip
    pairs = {(before[tuple(p)], int(q)) for p, q in zip(same.pixels, same.point, strict=True)}
    assert len(same) == len(problem.observations)
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs}) == 40

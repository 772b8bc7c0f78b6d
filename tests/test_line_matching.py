"""Matches along epipolar lines, on features whose partners are known."""

import numpy as np
import pytest
from synthetic.cameras import camera_of

from graphs.camera import project
from graphs.frames import Transform
from sfm_calib.features import Features
from sfm_calib.line_matching import match_along_lines, match_pairs, sight_of

MOVED = Transform.exp(np.array([0.02, -0.05, 0.01]), np.array([-0.4, 0.05, 0.1]))


def scene(lens, n=300, seed=0, alike=0):
    """Two views of points, their features in one order; the first `alike` have one descriptor."""
    rng = np.random.default_rng(seed)
    camera = camera_of(lens)
    points = rng.uniform([-1.5, -1.0, 3.0], [1.5, 1.0, 8.0], (n, 3))
    seen = [project(camera, points), project(camera, MOVED @ points)]
    good = np.isfinite(seen[0]).all(1) & np.isfinite(seen[1]).all(1)
    descriptors = rng.integers(0, 120, (n, 128)).astype(np.uint8)
    descriptors[:alike] = descriptors[0]
    return camera, [Features(p[good], np.ones(good.sum()), descriptors[good]) for p in seen]


@pytest.mark.parametrize("lens", ["radtan", "kannala_brandt"])
def test_every_feature_finds_its_partner(lens):
    camera, (a, b) = scene(lens)
    matches, likeness = match_along_lines(sight_of(camera, a), sight_of(camera, b), MOVED)
    assert len(matches) > 0.95 * len(a) and (matches[:, 0] == matches[:, 1]).all()
    np.testing.assert_allclose(likeness, 1.0, atol=1e-5)


def test_the_line_tells_apart_what_looks_the_same():
    camera, (a, b) = scene("radtan", alike=20)
    matches, _ = match_along_lines(sight_of(camera, a), sight_of(camera, b), MOVED)
    assert (matches[:, 0] == matches[:, 1]).all()
    assert (matches[:, 0] < 20).sum() >= 8  # no two of these lie on one line


def test_features_off_the_line_do_not_match():
    camera, (a, b) = scene("radtan")
    turned = Transform.exp(np.array([0.1, 0.0, 0.0]), np.zeros(3)) @ MOVED
    matches, _ = match_along_lines(sight_of(camera, a), sight_of(camera, b), turned)
    assert len(matches) < 0.02 * len(a)


def test_points_behind_a_camera_do_not_match():
    """The line goes on beyond infinity, and nothing is there."""
    camera, (a, b) = scene("radtan")
    backwards = Transform(MOVED.rotation, -MOVED.translation)
    matches, _ = match_along_lines(sight_of(camera, a), sight_of(camera, b), backwards)
    assert len(matches) < 0.3 * len(a)  # those far away, which lie near infinity either way


def test_beyond_the_other_camera_nothing_matches():
    """The line goes on beyond the epipole too, to what lies behind the first camera."""
    camera = camera_of("radtan")
    descriptors = np.random.default_rng(0).integers(0, 120, (8, 128)).astype(np.uint8)
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.full(8, 4.0)], axis=1)
    ahead = Transform(np.eye(3), np.array([0.0, 0.0, 1.0]))  # b stands a unit behind a
    a = Features(project(camera, ring), np.ones(8), descriptors)
    for across, n in ((1.0, 8), (-1.0, 0)):
        seen = project(camera, (ahead @ ring) * [across, across, 1.0])
        b = Features(seen, np.ones(8), descriptors)
        matches, _ = match_along_lines(sight_of(camera, a), sight_of(camera, b), ahead)
        assert (matches[:, 0] == matches[:, 1]).sum() == n


def test_a_camera_that_only_turned_matches_too():
    camera, (a, _) = scene("radtan")
    still = Transform.identity()
    matches, _ = match_along_lines(sight_of(camera, a), sight_of(camera, a), still)
    assert len(matches) == len(a) and (matches[:, 0] == matches[:, 1]).all()


def test_two_orientations_of_one_blob_are_no_second_best():
    camera, (a, b) = scene("radtan")
    twice = Features(
        np.concatenate([b.pixels, b.pixels[:50]]),
        np.concatenate([b.scales, b.scales[:50]]),
        np.concatenate([b.descriptors, b.descriptors[:50]]),
    )
    assert (twice.spots()[-50:] == np.arange(50)).all()
    matches, _ = match_along_lines(sight_of(camera, a), sight_of(camera, twice), MOVED)
    spots = twice.spots()[matches[:, 1]]
    assert len(matches) > 0.95 * len(a) and (matches[:, 0] == spots).all()


def test_pairs_come_in_their_order():
    camera, (a, b) = scene("radtan")
    sights = [sight_of(camera, a), sight_of(camera, b), None]
    places = [Transform.identity(), MOVED, None]
    (ab, _), (ba, _) = match_pairs(sights, places, [(0, 1), (1, 0)])
    assert {tuple(m) for m in ab.tolist()} == {tuple(m[::-1]) for m in ba.tolist()}

"""Which views overlap according to a rig, and which pairs of images are matched for it."""

from pathlib import Path

import numpy as np
import pytest
from synthetic.cameras import camera_of
from synthetic.problems import small_problem

from graphs.frames import Transform
from sfm_calib.guided import in_sequence
from sfm_calib.images import Scan, ScanImage
from sfm_calib.overlap import LEAST_SHARED_VIEW, first_pairs, pairs_that_share, shared_view

BESIDE = np.array([-0.2, 0.0, 0.0])


def scan_of(n_cameras, n_frames):
    images = tuple(ScanImage(c, f, f"{c}/{f}") for c in range(n_cameras) for f in range(n_frames))
    names = tuple(f"cam{c}" for c in range(n_cameras))
    return Scan(Path(), names, ((64, 48),) * n_cameras, tuple(map(str, range(n_frames))), images)


def turned(angle_deg):
    return Transform.exp(np.array([0.0, np.radians(angle_deg), 0.0]), BESIDE)


@pytest.mark.parametrize("lens", ["radtan", "kannala_brandt"])
def test_views_side_by_side_overlap_and_back_to_back_do_not(lens):
    cameras = [camera_of(lens)] * 2
    ahead = shared_view(cameras, [Transform.identity(), turned(0)])
    behind = shared_view(cameras, [Transform.identity(), turned(180)])
    assert ahead[0, 1] > 0.9 and ahead[0, 0] == 1
    assert behind.max(initial=0, where=~np.eye(2, dtype=bool)) < LEAST_SHARED_VIEW


def test_overlap_shrinks_as_a_camera_turns_away():
    cameras = [camera_of("radtan")] * 2
    shares = [shared_view(cameras, [Transform.identity(), turned(a)])[0, 1] for a in (0, 20, 40)]
    assert shares[0] > shares[1] > shares[2]


def test_cameras_that_face_each_other_overlap():
    facing = Transform.exp(np.array([0.0, np.pi, 0.0]), np.array([0.0, 0.0, 3.0]))
    away = Transform.exp(np.array([0.0, np.pi, 0.0]), np.array([0.0, 0.0, -3.0]))
    cameras = [camera_of("radtan")] * 2
    assert shared_view(cameras, [Transform.identity(), facing])[0, 1] > 0
    assert shared_view(cameras, [Transform.identity(), away])[0, 1] == 0


def test_first_pairs_are_near_in_time_and_of_cameras_that_overlap():
    overlapping = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]], dtype=bool)
    scan = scan_of(3, 12)
    pairs = first_pairs(scan, overlapping)
    assert pairs == sorted(set(pairs))
    cameras = {(scan.images[a].camera, scan.images[b].camera) for a, b in pairs}
    assert cameras == {(0, 0), (1, 1), (2, 2), (0, 1)}
    assert (0, 12) in pairs and (0, 13) in pairs and (0, 8) in pairs and (0, 11) not in pairs


def test_pairs_that_share_points_of_whatever_time():
    problem, _ = small_problem(cameras=2, frames=12, points=60)
    number = np.arange(24).reshape(2, 12)
    number[1, 3] = -1  # an image without a place
    pairs = pairs_that_share(problem, number)
    assert pairs == sorted(set(pairs)) and all(a < b for a, b in pairs)
    assert {i for pair in pairs for i in pair} == set(range(24)) - {15}
    # A track is seen from six frames in a row.
    assert all(abs(a % 12 - b % 12) < 6 for a, b in pairs)


def test_photographs_in_no_order_are_noticed():
    scan = scan_of(2, 5)
    following = {(c * 5 + f, c * 5 + f + 1): 40 for c in range(2) for f in range(4)}
    assert in_sequence(scan, following)
    assert in_sequence(scan, dict.fromkeys(list(following)[:4], 40))
    assert not in_sequence(scan, dict.fromkeys(list(following)[:3], 40))
    assert not in_sequence(scan, dict.fromkeys(following, 5)) and not in_sequence(scan, {})

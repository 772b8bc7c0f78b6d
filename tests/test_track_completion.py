"""Points looked for where they project: found again, but not as another blob or another side."""

import numpy as np
import pytest
from synthetic.cameras import camera_of

from graphs.camera import project
from graphs.frames import Transform
from graphs.problem import Estimate
from sfm_calib.features import Features
from sfm_calib.track_completion import links_to_points

AHEAD = np.random.default_rng(2).uniform([-0.8, -0.6, 7.0], [0.8, 0.6, 9.0], (40, 3))
MIDDLE = np.array([0.0, 0.0, 8.0])
SIZE = 0.02  # of every blob, in the world's unit


def at(centre, turn_y_deg=0.0):
    """cam_from_world of a camera with its centre there."""
    turn = Transform.exp(np.array([0.0, np.radians(turn_y_deg), 0.0]), np.zeros(3))
    return Transform(turn.rotation, -turn.rotation @ np.array(centre))


def found_in_third(third, scaled=1.0, off_px=0.0, other=False):
    """Pairs of points that a third image takes for each other; two images have all as tracks."""
    camera, rng = camera_of("radtan"), np.random.default_rng(0)
    places = (at([0, 0, 0]), at([0.4, 0, 0]), third)
    descriptors = rng.integers(0, 200, (len(AHEAD), 128)).astype(np.uint8)
    descriptors[rng.random(descriptors.shape) < 0.7] = 0  # no two alike
    found = []
    for number, place in enumerate(places):
        last = number == 2
        pixels = project(camera, place @ AHEAD) + (off_px if last else 0.0)
        scales = SIZE * camera.params[0] / np.linalg.norm(place @ AHEAD, axis=1)
        looks = rng.permuted(descriptors, axis=1) if last and other else descriptors
        found.append(Features(pixels, scales * (scaled if last else 1.0), looks))
    n = len(AHEAD)
    start = Estimate((camera,), (Transform.identity(),), places, AHEAD)
    point = np.repeat(np.arange(n), 2)
    feature = np.stack([np.arange(n), np.arange(n) + n], axis=1).ravel()
    begins = n * np.arange(4)
    images = [(0, frame, frame) for frame in range(3)]
    links = list(links_to_points(start, images, found, begins, feature, point))[2]
    assert (links[0][:, 0] < 2 * n).all() and (links[0][:, 1] >= 2 * n).all()
    return links[0] % n, links[1]


@pytest.mark.parametrize("z", [-7.0, 0.5, 5.0])
def test_points_are_found_again_from_near_and_far(z):
    """A blob that is five times as near is five times as large, and the same."""
    links, likeness = found_in_third(at([0.2, 0.1, z]))
    seen = np.isfinite(project(camera_of("radtan"), at([0.2, 0.1, z]) @ AHEAD)).all(1)
    assert len(links) == seen.sum() > 20 and (links[:, 0] == links[:, 1]).all()
    np.testing.assert_allclose(likeness, 1.0, atol=1e-6)


def test_a_blob_of_another_size_is_another():
    for scaled in (0.4, 2.5):
        assert len(found_in_third(at([0.2, 0.1, 0.5]), scaled=scaled)[0]) == 0
    for scaled in (0.7, 1.4):
        assert len(found_in_third(at([0.2, 0.1, 0.5]), scaled=scaled)[0]) == len(AHEAD)


def test_a_feature_elsewhere_or_of_other_looks_is_none():
    assert len(found_in_third(at([0.2, 0.1, 0.5]), off_px=4.0)[0]) == 0
    assert len(found_in_third(at([0.2, 0.1, 0.5]), other=True)[0]) == 0


def test_from_another_side_a_point_looks_different():
    for degrees, some in ((30.0, True), (60.0, False)):
        angle = np.radians(degrees)
        centre = MIDDLE - 8.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        links, _ = found_in_third(at(centre, -degrees))
        assert (len(links) > 30) == some and some == (len(links) > 0)

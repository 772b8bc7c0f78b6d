"""Virtual pinholes: where their pixels come from, what they show, and pairs that share rows."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphs.camera import Camera, focal_on_axis, image_pixels, project, unproject
from graphs.frames import Transform, exp_rotation
from graphs.rectification import projection_matrices, rectification
from graphs.virtual import (
    NO_PIXEL,
    Turned,
    field_of_view,
    inside_zoom,
    pinhole,
    pixel_maps,
    resized,
    share_shown,
    source_pixels,
    whole_zoom,
    widest_seen,
    within,
    zoomed,
)

CAMERAS = {
    "brown": Camera("brown", "brown", (160, 120), np.array(
        [140.0, 141, 84, 57, -0.3, 0.12, 1e-3, -5e-4, -0.02])),
    "pincushion": Camera("pincushion", "radtan", (160, 120), np.array(
        [150.0, 150, 78, 61, 0.15, 0.02, -1e-3, 5e-4])),
    "rational": Camera("rational", "rational", (160, 120), np.array(
        [120.0, 121, 79, 60, 0.2, -0.1, 1e-3, 4e-4, 0.01, 0.5, -0.05, 0.002])),
    "kannala_brandt": Camera("kannala_brandt", "kannala_brandt", (160, 120), np.array(
        [90.0, 91, 82, 58, -0.037, -0.009, 0.009, -0.004])),
}  # fmt: skip
LENSES = sorted(CAMERAS)
small = st.floats(-0.15, 0.15)
turns = st.builds(lambda x, y, z: exp_rotation(np.array([x, y, z])), small, small, small)


def matrix(camera):
    fx, fy, cx, cy = camera.params[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def upright(camera):
    return Turned(camera, np.eye(3))


def base(camera, size=None):
    return resized(camera, focal_on_axis(camera), size or camera.size)


@pytest.mark.parametrize("name", LENSES)
def test_maps_are_those_of_opencv(name):
    camera, turn = CAMERAS[name], exp_rotation(np.array([0.05, -0.08, 0.03]))
    new = pinhole("new", (200, 90), np.array([110.0, 112]), np.array([104.0, 40]))
    fisheye = camera.lens == "kannala_brandt"
    opencv = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    theirs = opencv(matrix(camera), camera.params[4:], turn, matrix(new), new.size, cv2.CV_32FC1)
    assert np.abs(pixel_maps(new, Turned(camera, turn)) - theirs).max() < 1e-4


def test_what_the_lens_cannot_see_comes_from_no_pixel():
    camera = Camera("c", "radtan", (160, 120), np.array([80.0, 80, 80, 60, -0.4, 0.0, 0, 0]))
    maps = pixel_maps(zoomed(base(camera), 0.5), upright(camera))
    assert (maps[:, 0, 0] == NO_PIXEL).all()  # beyond where the lens folds back
    assert within(maps[:, 60, 80], camera.size)


@settings(deadline=None, max_examples=25)
@given(name=st.sampled_from(LENSES), turn=turns, scale=st.sampled_from([0.5, 1.0, 1.7]))
def test_inside_is_the_most_without_black(name, turn, scale):
    camera = CAMERAS[name]
    view = Turned(camera, turn)
    like = base(camera, (round(160 * scale), round(120 * scale)))
    virtual = zoomed(like, inside_zoom(like, [view]))
    pixels = image_pixels(virtual.size, virtual.size)[2]
    assert within(source_pixels(virtual, view, pixels), camera.size).all()
    wider = zoomed(virtual, 0.98)
    outline = image_pixels(wider.size, wider.size)[2]
    assert not within(source_pixels(wider, view, outline), camera.size).all()


@settings(deadline=None, max_examples=25)
@given(name=st.sampled_from(LENSES), turn=turns)
def test_whole_shows_everything_and_no_more(name, turn):
    camera = CAMERAS[name]
    view = Turned(camera, turn)
    virtual = zoomed(base(camera), whole_zoom(base(camera), [view]))
    rays = unproject(camera, image_pixels(camera.size, (97, 73))[2]) @ turn.T
    seen = project(virtual, rays)
    assert within(seen, virtual.size).all() and share_shown(virtual, view) == 1.0
    assert min(seen.min(), (np.array(virtual.size) - 1 - seen).min()) < 0.1  # one edge is reached
    assert share_shown(zoomed(virtual, 1.05), view) < 1.0


def test_a_pinhole_needs_no_change():
    camera = pinhole("p", (160, 120), np.array([140.0, 141]), np.array([71.0, 66]))
    zoom = inside_zoom(base(camera), [upright(camera)])
    assert zoom == pytest.approx(1.0, abs=1e-9)
    down, across = np.mgrid[:120, :160]
    assert np.abs(pixel_maps(base(camera), upright(camera)) - [across, down]).max() < 1e-4


def test_half_size_shows_the_same():
    camera = CAMERAS["brown"]
    whole, half = base(camera), base(camera, (80, 60))
    assert field_of_view(half) == pytest.approx(field_of_view(whole), rel=1e-12)
    assert base(camera, (160, 60)).params[0] == whole.params[0]  # fills: the larger factor


def test_a_lens_that_sees_backwards_has_no_whole_view():
    camera = Camera("c", "kannala_brandt", (160, 120), np.array([40.0, 40, 79.5, 59.5, 0, 0, 0, 0]))
    assert np.degrees(widest_seen([upright(camera)])) == pytest.approx(2 * np.degrees(99.4 / 40), 1)
    assert whole_zoom(base(camera), [upright(camera)]) == 0.0


def test_no_view_without_black_where_the_axis_is_not_seen():
    camera = CAMERAS["brown"]
    sideways = Turned(camera, exp_rotation(np.array([0.0, 1.2, 0.0])))
    assert np.isnan(inside_zoom(base(camera), [sideways]))


# ---- pairs ---------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(a=turns, b=turns, along=st.sampled_from([0, 1]), back=st.booleans(), tilt=small, far=small)
def test_rectified_points_share_a_row_or_a_column(a, b, along, back, tilt, far):
    step = np.array([tilt, far, tilt])
    step[along] = -1.0 if back else 1.0
    rig = (Transform(a, np.zeros(3)), Transform(b, np.zeros(3)) @ Transform(np.eye(3), -step))
    found = rectification(rig)
    assert found is not None and found.is_vertical == bool(along)
    assert found.first == int(back)
    assert found.baseline == pytest.approx(np.linalg.norm(step))
    points = np.random.default_rng(0).uniform([-1, -1, 5], [1, 1, 20], (40, 3))
    order = [found.first, 1 - found.first]
    one, other = ((rig[i] @ points) @ found.turns[i].T for i in order)
    virtual = pinhole("v", (640, 480), np.array([500.0, 500]), np.array([310.0, 250]))
    pixels = [project(virtual, p) for p in (one, other)]
    disparity = (pixels[0] - pixels[1])[:, along]
    assert np.abs((pixels[0] - pixels[1])[:, 1 - along]).max() < 1e-9
    assert (disparity > 0).all()
    P1, P2, Q = projection_matrices(virtual, found.baseline, found.is_vertical)
    for P, seen in ((P1, pixels[0]), (P2, pixels[1])):  # both take points of the first camera
        projected = np.column_stack([one, np.ones(len(one))]) @ P.T
        assert np.allclose(projected[:, :2] / projected[:, 2:], seen)
    back_again = np.column_stack([pixels[0], disparity, np.ones(len(one))]) @ Q.T
    assert np.allclose(back_again[:, :3] / back_again[:, 3:], one)


def test_turns_of_a_pair_are_small_and_alike():
    toed_in = exp_rotation(np.array([0.0, 0.1, 0.0]))
    rig = (Transform.identity(), Transform(toed_in, np.zeros(3)) @ Transform(np.eye(3), [-1, 0, 0]))
    found = rectification(rig)
    assert found.angle_apart == pytest.approx(0.1)
    assert found.angle_off_axis == pytest.approx(np.pi / 2 - 0.05)
    for turn in found.turns:
        assert np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) > 0


def test_measures_of_what_is_no_pair():
    def pair(turn, centre):
        return Transform.identity(), Transform(turn, np.zeros(3)) @ Transform(np.eye(3), -centre)

    ahead = rectification(pair(np.eye(3), np.array([0.0, 0, 1])))
    assert ahead.angle_off_axis == pytest.approx(0.0, abs=1e-6)
    back = rectification(pair(np.diag([-1.0, 1, -1]), np.array([1.0, 0, 0])))
    assert back.angle_apart == pytest.approx(np.pi)
    assert rectification(pair(np.eye(3), np.zeros(3))) is None

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.directions import DISTANCE, GOOD, found, names_of, of_directions, rig

from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.image_grid import image_grid
from graphs.observability import own_px
from graphs.remedies import Kind, Move, classify


@pytest.mark.parametrize(
    ("move", "kind"),
    [
        ({"cam0.fx": 2.0, "cam0.fy": 1.6}, "focal length against depth"),
        ({"cam0.fx": 2.0, "cam0.fy": -1.0}, "focal length across"),
        ({"cam0.fy": 2.0, "cam0.fx": 0.1}, "focal length down"),
        ({"cam0.cy": 2.0, "cam0.p1": 0.5}, "principal point"),
        ({"cam0.p1": 1.0, "cam1.p1": 0.9}, "principal point"),
        ({"cam0.k1": 2.0, "cam0.k2": -1.0}, "distortion"),
        ({"cam1.rotation_y": 2.0, "cam1.cx": 1.9}, "rotation in the rig"),
        ({"cam1.translation_z": 2.0}, "translation in the rig"),
    ],
)
def test_kinds(move: dict[str, float], kind: Kind) -> None:
    estimate = rig(2)
    (weak,) = found(estimate, of_directions(estimate, move), GOOD)
    assert weak.kind == kind
    assert weak.remedy and weak.what


def test_the_rigs_own_size_is_its_scale() -> None:
    estimate = rig(3)
    estimate = replace(
        estimate, cam_from_rig=tuple(t.scaled(0.2) for t in estimate.cam_from_rig)
    )  # in a unit of 5 m, points at 25 m
    names = names_of(estimate)
    own = own_px(image_grid(estimate, names, (DISTANCE,) * 3))
    grows = np.zeros(len(names))
    for camera, placed in zip(estimate.cameras[1:], estimate.cam_from_rig[1:], strict=True):
        for axis, value in zip("xyz", placed.translation, strict=True):
            grows[names.index(f"{camera.name}.translation_{axis}")] = value
    floor = np.diag((0.01 / own) ** 2)
    (weak,) = found(estimate, Covariance(names, np.outer(grows, grows) + floor))
    assert weak.kind == "scale"
    assert "measure" in weak.remedy
    one = np.where([name.startswith("cam1") for name in names], grows, 0.0)
    (weak,) = found(estimate, Covariance(names, np.outer(one, one) + floor))
    assert weak.kind == "translation in the rig"  # cam2 stays where it is


def test_what_is_not_the_size_alone_is_no_scale() -> None:
    """A camera that moves away, with its principal point; and one that goes askew."""
    estimate = rig(2)
    t = estimate.cam_from_rig[1].translation
    across = np.cross(t, [1.0, 2.0, 3.0])
    askew = t + across * np.linalg.norm(t) / np.linalg.norm(across)
    names = ("cam1.translation_x", "cam1.translation_y", "cam1.translation_z", "cam0.cx")

    def kind_of(moved: FloatArray, cx_px: float) -> Kind:
        px = np.append(9 * moved / np.linalg.norm(moved), cx_px)
        move = Move(names, px, np.append(0.1 * moved, cx_px), 1.0, 1.0)
        return classify(estimate, move, (GOOD, GOOD))

    assert kind_of(t, 0.0) == kind_of(t, 2.0) == "scale"
    assert kind_of(t, 5.0) == "translation in the rig"
    assert kind_of(askew, 0.0) == "translation in the rig"


def test_focal_lengths_are_compared_as_shares_of_themselves() -> None:
    """Pixels that are five times as high as wide: 1 % is 10 px of fx and 2 px of fy."""
    estimate = rig(1)
    camera = estimate.cameras[0]
    params = np.append([1000.0, 200.0], camera.params[2:])
    estimate = replace(estimate, cameras=(replace(camera, params=params),))
    px = np.array([3.0, 2.0])
    for own, kind in (
        ([10.0, 2.0], "focal length against depth"),
        ([10.0, -1.0], "focal length across"),
        ([10.0, 10.0], "focal length down"),
        ([50.0, 2.0], "focal length across"),
    ):
        move = Move(("cam0.fx", "cam0.fy"), px, np.array(own), 0.1, 3.0)
        assert classify(estimate, move, ()) == kind


def test_a_translation_along_the_motion_and_along_the_axis_of_turning() -> None:
    estimate = rig(2)
    stated = of_directions(estimate, {"cam1.translation_x": 2.0})
    drive = replace(GOOD, motion_share=0.99)
    (weak,) = found(estimate, stated, drive)
    assert weak.what.endswith("where cam1 sits in the rig, along the motion")
    stated = of_directions(estimate, {"cam1.translation_y": 2.0})
    (weak,) = found(estimate, stated, replace(drive, turn_share=0.99))
    assert weak.what.endswith("along the axis it turns about")
    assert "turn the rig about other axes too" in weak.remedy
    (weak,) = found(estimate, stated, GOOD)
    assert weak.what == "translation_y of cam1: where cam1 sits in the rig"


def test_remedies_follow_what_the_views_lack() -> None:
    estimate = rig(1)
    fy = of_directions(estimate, {"cam0.fy": 2.0})
    (weak,) = found(estimate, fy, replace(GOOD, spread=(0.5, 0.006, 0.1), roll_deg=2.0))
    assert weak.remedy.startswith("all views stand at one height")
    focal = of_directions(estimate, {"cam0.fx": 2.0, "cam0.fy": 1.6})
    flat = replace(GOOD, relief=0.001, tilt_deg=3.0)
    for views, words in (
        (replace(GOOD, forward=0.99, axes_deg=1.0), "move sideways"),
        (flat, "look at the plane from the side"),
        (replace(GOOD, axes_deg=1.0), "oblique"),
        (replace(GOOD, parallax_deg=0.1, turn_deg=1.0), "move the rig between frames"),
        (replace(GOOD, parallax_deg=0.1), "step sideways"),
    ):
        assert words in found(estimate, focal, views)[0].remedy
    centre = of_directions(estimate, {"cam0.cx": 2.0})
    assert "about its optical axis" in found(estimate, centre, replace(GOOD, roll_deg=2))[0].remedy
    bulge = of_directions(estimate, {"cam0.k1": 2.0})
    assert found(estimate, bulge, flat)[0].kind == "doming"
    assert found(estimate, bulge, GOOD)[0].kind == "distortion"


def test_views_on_their_side_need_no_other_height() -> None:
    """Turned about the optical axis, across the image is down it."""
    estimate = rig(1)
    for parameter, spread, words in (
        ("fy", (0.5, 0.006, 0.1), "all views stand at one height"),
        ("fx", (0.006, 0.5, 0.1), "no view stands to the side"),
    ):
        stated = of_directions(estimate, {f"cam0.{parameter}": 2.0})
        for roll_deg, level in ((2.0, True), (20.0, False)):
            views = replace(GOOD, spread=spread, roll_deg=roll_deg)
            (weak,) = found(estimate, stated, views)
            assert weak.remedy.startswith(words) == level
            assert weak.remedy.startswith("bring near and far things") != level


def test_a_principal_point_wants_the_turns_that_are_not_there() -> None:
    estimate = rig(1)
    centre = of_directions(estimate, {"cam0.cx": 2.0})
    for views, words in (
        (replace(GOOD, roll_deg=2.0), "turn the rig about its optical axis"),
        (replace(GOOD, roll_deg=20.0), "take more views, turned differently"),
        (None, "take more views, turned differently"),
    ):
        assert found(estimate, centre, views)[0].remedy.startswith(words)


def test_distortion_terms_that_cancel_need_no_remedy() -> None:
    estimate = rig(1, "kannala_brandt")
    names = tuple(f"cam0.k{i}" for i in range(1, 5))
    grid = image_grid(estimate, names, (DISTANCE,))
    moves = grid.settled.reshape(-1, 4) / own_px(grid)
    least = np.linalg.eigh(moves.T @ moves)[1][:, 0]
    stated = of_directions(estimate, dict(zip(names, 3 * least, strict=True)))
    (weak,) = found(estimate, stated)
    assert weak.kind == "distortion"
    assert weak.effect_corner_px < 0.2 * weak.slide_px
    assert weak.remedy.startswith("none is needed")


def test_cameras_alike_are_told_in_one_line() -> None:
    estimate = rig(3)
    moves = [{f"cam{i}.k1": 2.0, f"cam{i}.k2": -1.9} for i in range(3)]
    (weak,) = found(estimate, of_directions(estimate, *moves))
    assert weak.what.startswith("k1, k2 of every camera: ")
    (weak,) = found(estimate, of_directions(estimate, *moves[:2]))
    assert weak.what.startswith("k1, k2 of cam0 and cam1: ")


def test_a_rig_of_one_place_has_no_transform_to_speak_of() -> None:
    estimate = rig(2)
    together = replace(estimate, cam_from_rig=(Transform.identity(), Transform.identity()))
    stated = of_directions(together, {"cam1.translation_x": 2.0})
    (weak,) = found(together, stated)
    assert weak.kind == "translation in the rig"

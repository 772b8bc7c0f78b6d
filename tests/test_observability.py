from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from synthetic.dense import of_others
from synthetic.directions import DISTANCE, found, names_of, of_directions, rig
from synthetic.problems import small_problem

from graphs.build import GraphOptions, build, lens_prior_factor, rig_prior_factor
from graphs.covariance import Covariance
from graphs.frames import FloatArray, reported_from_tangent
from graphs.image_grid import image_grid, typical_distances
from graphs.keys import lens_key, rig_key
from graphs.model_covariance import model_covariance
from graphs.motion import too_little_motion
from graphs.observability import (
    MOST_LINES,
    WEAK_PX,
    Observability,
    observe,
    own_px,
    prior_information,
    prior_shares,
    weak_directions,
)
from graphs.priors import RigPrior, stated_lens_prior, weak_lens_prior
from graphs.problem import Problem
from graphs.propagation import lens_names, pose_names
from graphs.refine import refine
from graphs.remedies import Kind
from graphs.usable import ray_sigmas_deg, unusable
from sfm_calib.simulate.rigs import RigName, TrajectoryName
from sfm_calib.simulate.scenes import SceneName
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

# ---- what is weak --------------------------------------------------------------------------


def test_nothing_is_weak_where_every_sigma_is_small() -> None:
    estimate = rig()
    assert found(estimate, of_directions(estimate, floor_px=0.9 * WEAK_PX)) == ()
    nothing = Covariance((), np.zeros((0, 0)))
    assert weak_directions(estimate, nothing, nothing, nothing.matrix, (5.0, 5.0)) == ()
    assert ray_sigmas_deg(estimate, nothing, (5.0, 5.0)) == (0.0, 0.0)


def test_parameters_are_measured_in_the_pixels_that_they_move() -> None:
    estimate = rig(1)
    names = ("cam0.cx", "cam0.cy", "cam0.fx", "cam0.k1")
    cx, cy, fx, k1 = own_px(image_grid(estimate, names, (DISTANCE,)))
    assert (cx, cy) == pytest.approx((1, 1))
    assert 0.2 < fx < 0.5  # x / z, rms over an image that is 1.2 focal lengths wide
    assert 50 < k1 < 300


def test_a_trade_off_is_one_direction_with_all_its_parameters() -> None:
    estimate = rig(1)
    (weak,) = found(estimate, of_directions(estimate, {"cam0.cx": 3.0, "cam0.p2": -2.0}))
    assert weak.kind == "principal point"
    assert weak.parameters == ("cam0.cx", "cam0.p2")
    assert weak.slide_px == pytest.approx(13**0.5, rel=1e-4)
    assert np.abs(weak.moves_px) == pytest.approx([3, 2], rel=1e-4)
    assert abs(weak.moves[0]) == pytest.approx(3, rel=1e-4)  # px
    assert weak.what == "cx, p2: the principal point against tilt and p1, p2"
    assert weak.data_slide_px == pytest.approx(weak.slide_px)
    assert weak.prior_share == pytest.approx(0)


def test_what_a_turn_makes_up_for_has_little_effect_in_the_picture() -> None:
    estimate = rig(1)
    (centre,) = found(estimate, of_directions(estimate, {"cam0.cx": 3.0}))
    assert centre.effect_centre_px < 0.5 < centre.slide_px
    (focal,) = found(estimate, of_directions(estimate, {"cam0.fx": 3.0, "cam0.fy": 2.3}))
    assert focal.effect_corner_px > 5 > 1 > focal.effect_centre_px


def test_independent_directions_of_one_size_are_told_apart() -> None:
    estimate = rig(1)
    weak = found(
        estimate,
        of_directions(estimate, {"cam0.cx": 1.0}, {"cam0.k1": 1.0, "cam0.k2": -0.99}),
    )
    assert {one.parameters for one in weak} == {("cam0.cx",), ("cam0.k1", "cam0.k2")}


@pytest.mark.parametrize(("cx_px", "shared_px"), [(2.0, 0.2), (3.0, 0.5)])
def test_directions_that_are_mixed_are_taken_apart(cx_px: float, shared_px: float) -> None:
    """Eigenvectors of nearly equal size mix whatever has the least in common."""
    estimate = rig(1)
    distortion = {"cam0.k1": 0.72 * cx_px, "cam0.k2": -0.7 * cx_px, "cam0.cx": shared_px}
    weak = found(estimate, of_directions(estimate, {"cam0.cx": cx_px}, distortion))
    assert {one.parameters for one in weak} == {("cam0.cx",), ("cam0.k1", "cam0.k2")}


def test_a_parameter_that_only_follows_another_is_named_with_it() -> None:
    estimate = rig(1)
    follows = {"cam0.cx": 2.6, "cam0.p2": 0.2}
    (weak,) = found(estimate, of_directions(estimate, follows))
    assert weak.parameters == ("cam0.cx", "cam0.p2")
    assert np.abs(weak.moves_px) == pytest.approx([2.6, 0.2], rel=1e-2)
    (weak,) = found(estimate, of_directions(estimate, follows, {"cam0.p2": 0.4}))  # mostly not
    assert weak.parameters == ("cam0.cx",)


@pytest.mark.parametrize("seed", range(12))
def test_every_doubtful_parameter_is_named(seed: int) -> None:
    estimate, rng = rig(3), np.random.default_rng(seed)
    names = names_of(estimate)
    own = own_px(image_grid(estimate, names, (DISTANCE,) * 3))
    root = rng.standard_normal((len(names), len(names))) * 10 ** rng.uniform(-3, 1, len(names))
    matrix = root @ root.T * 10 ** rng.uniform(-2, 0)
    weak = found(estimate, Covariance(names, matrix / np.outer(own, own)))
    doubtful = {n for n, v in zip(names, np.diag(matrix), strict=True) if v > WEAK_PX**2}
    assert doubtful <= {name for one in weak for name in one.parameters}
    assert len(weak) <= MOST_LINES
    assert [one.slide_px for one in weak] == sorted((w.slide_px for w in weak), reverse=True)
    for one in weak:
        assert one.slide_px > WEAK_PX
        assert len(one.parameters) == len(one.moves) == len(one.moves_px) > 0


# ---- data and priors apart -----------------------------------------------------------------


def test_shares_of_data_and_priors() -> None:
    """cx: 1 / 3^2 from data and as much from a prior; cy: a prior alone; fx: data alone."""
    estimate = rig(1, "pinhole")
    names = names_of(estimate)
    data = np.diag([0.01, 100.0, 1 / 9, 0.0])
    prior = np.diag([0.0, 0.0, 1 / 9, 1 / 16])
    model = Covariance(names, np.linalg.inv(data + prior))
    weak = {one.kind + one.parameters[0]: one for one in found(estimate, model, prior=prior)}
    assert weak["focal length acrosscam0.fx"].prior_share == pytest.approx(0)
    centre = weak["principal pointcam0.cy"]  # told as one with cx
    assert centre.parameters == ("cam0.cy", "cam0.cx")
    assert centre.slide_px == pytest.approx(4)
    assert centre.prior_share == pytest.approx(1)
    assert centre.data_slide_px == np.inf
    shares = prior_shares(model, prior)
    assert [shares[name] for name in names] == pytest.approx([0, 0, 0.5, 1])


def test_without_priors_a_direction_is_weaker_by_their_share() -> None:
    estimate = rig(1, "pinhole")
    names = names_of(estimate)
    prior = np.diag([0.0, 0.0, 1 / 12, 0.0])
    model = Covariance(names, np.linalg.inv(np.diag([99.0, 99.0, 1 / 36, 99.0]) + prior))
    for factor in (1.0, 2.0):  # stated over model sigma
        stated = Covariance(names, factor**2 * model.matrix)
        (weak,) = found(estimate, stated, prior=prior, model=model)
        assert weak.prior_share == pytest.approx(0.75)
        assert weak.slide_px == pytest.approx(3 * factor)
        assert weak.data_slide_px == pytest.approx(6 * factor)


def test_priors_say_what_their_factors_say() -> None:
    problem, true = small_problem("radtan", cameras=3, start_error=0)
    priors = [weak_lens_prior(camera) for camera in true.cameras]
    priors[0] = stated_lens_prior(true.cameras[0], priors[0], {}, {}, ["p1", "k2"])
    placed = RigPrior(true.cam_from_rig[2], 0.02, 0.3)
    options = GraphOptions(lens_priors=tuple(priors), rig_priors={2: placed})
    graph = build(problem, options)
    names = model_covariance(graph, true, graph.initial).names
    assert "cam0.p1" not in names
    ours = prior_information(graph, true, names)
    expected = np.zeros_like(ours)
    for index, camera in enumerate(true.cameras):
        factor = lens_prior_factor(index, priors[index])
        root, _ = factor.linearize(graph.initial).jacobian()
        labels = lens_names(camera)
        assert list(factor.keys()) == [lens_key(index)]
        _add(expected, names, labels, root.T @ root)
    factor = rig_prior_factor(2, placed)
    assert list(factor.keys()) == [rig_key(2)]
    root, _ = factor.linearize(graph.initial).jacobian()
    root = root @ np.linalg.inv(reported_from_tangent(true.cam_from_rig[2]))
    _add(expected, names, pose_names("cam2"), root.T @ root)
    np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    in_unit = prior_information(graph, true, names, unit=2.0)
    along = names.index("cam2.translation_x")
    assert in_unit[along, along] == pytest.approx(4 * ours[along, along])


def test_the_prior_of_a_lens_that_cameras_share_counts_once() -> None:
    problem, true = small_problem("radial", cameras=3, start_error=0)
    graph = build(replace(problem, initial=true), GraphOptions(shared_lenses=((0, 2),)))
    n = true.cameras[0].params.size
    names = tuple(name for camera in true.cameras for name in lens_names(camera))
    ours = prior_information(graph, true, names)
    columns = np.concatenate([graph.layout.columns(lens_key(index)) for index in (0, 1)])
    theirs = of_others(graph, graph.initial)[np.ix_(columns, columns)]
    variable = np.vstack([np.eye(2 * n), np.eye(n, 2 * n)])  # that each name is, cam2's: cam0's
    np.testing.assert_allclose(variable.T @ ours @ variable, theirs, rtol=1e-6)


def _add(
    information: FloatArray, names: tuple[str, ...], labels: tuple[str, ...], block: FloatArray
) -> None:
    known = [i for i, label in enumerate(labels) if label in names]
    rows = [names.index(labels[i]) for i in known]
    information[np.ix_(rows, rows)] += block[np.ix_(known, known)]


# ---- singular covariances ------------------------------------------------------------------


def test_a_lens_that_cameras_share_is_one_and_has_all_their_names() -> None:
    problem, true = small_problem("radial", cameras=3, frames=6, points=80, start_error=0)
    problem = replace(problem, initial=true)
    graph = build(problem, GraphOptions(sigma_px=3.0, shared_lenses=((0, 2),)))
    model = model_covariance(graph, true, graph.initial).covariance
    weak = observe(graph, true, model, model).weak
    assert any("cam0.cx" in one.parameters for one in weak)
    for one in weak:
        for name, move in zip(one.parameters, one.moves, strict=True):
            if ".rotation" in name or ".translation" in name or name.startswith("cam1"):
                continue
            twin = name.replace("cam0", "cam2") if "cam0" in name else name.replace("cam2", "cam0")
            assert one.moves[one.parameters.index(twin)] == move


def test_a_shared_parameter_does_not_count_for_each_camera() -> None:
    estimate = rig(2, "pinhole")
    names = ("cam0.cx", "cam1.fx", "cam1.cx")
    matrix = np.array([[9.0, 0.0, 9.0], [0.0, 0.01, 0.0], [9.0, 0.0, 9.0]])
    (weak,) = found(estimate, Covariance(names, matrix))
    assert weak.slide_px == pytest.approx(3)
    assert weak.parameters == ("cam0.cx", "cam1.cx")
    assert np.abs(weak.moves) == pytest.approx([3, 3])


def test_a_length_that_is_held_is_not_weak() -> None:
    estimate = rig(2)
    stated = of_directions(estimate, {"cam1.translation_y": 3.0, "cam1.cy": 2.9})
    t = estimate.cam_from_rig[1].translation
    across = np.eye(len(stated.names))
    rows = [stated.names.index(f"cam1.translation_{axis}") for axis in "xyz"]
    across[np.ix_(rows, rows)] -= np.outer(t, t) / (t @ t)
    held = Covariance(stated.names, across @ stated.matrix @ across.T)
    assert np.linalg.matrix_rank(held.matrix) == len(held.names) - 1
    (weak,) = found(estimate, held)
    moved = [weak.moves[weak.parameters.index(stated.names[r])] for r in rows
             if stated.names[r] in weak.parameters]  # fmt: skip
    assert moved and weak.kind == "translation in the rig"


# ---- usable --------------------------------------------------------------------------------


def test_a_focal_length_is_needed_and_a_principal_point_may_be_believed() -> None:
    estimate = rig(1)
    f = estimate.cameras[0].params[0]
    assert unusable(estimate, of_directions(estimate), (DISTANCE,)) == ()
    centre = of_directions(estimate, {"cam0.cx": 19.0})  # 3 % of the width
    assert unusable(estimate, centre, (DISTANCE,)) == ()
    names = names_of(estimate)
    for relative, count in ((0.01, 0), (0.05, 1)):
        variance = np.zeros(len(names))
        variance[0] = (relative * f) ** 2
        reasons = unusable(estimate, Covariance(names, np.diag(variance)), (DISTANCE,))
        assert len([reason for reason in reasons if "cam0.fx" in reason]) == count
    undefined = Covariance(names, np.full((len(names),) * 2, np.nan))
    assert len(unusable(estimate, undefined, (DISTANCE,))) == 3


def test_rays_that_point_anywhere_are_not_usable() -> None:
    estimate = rig(2)
    for px, count in ((1.0, 0), (20.0, 2)):
        stated = of_directions(estimate, {"cam1.rotation_y": px})
        reasons = unusable(estimate, stated, (DISTANCE,) * 2)
        assert len(reasons) == count  # half of it each, once the rig turned as suits both
        assert all("rays of" in reason for reason in reasons)


def test_rays_of_each_camera_are_its_own() -> None:
    """One lens bends the edges of its image by 20 px, which no turn of the rig undoes."""
    estimate = rig(2)
    stated = of_directions(estimate, {"cam1.k1": 20.0})
    good, bad = ray_sigmas_deg(estimate, stated, (DISTANCE,) * 2)
    expected = np.degrees(20.0 / np.mean(estimate.cameras[1].params[:2]))
    assert bad == pytest.approx(expected, rel=0.05)
    assert good < 0.05 * bad
    (reason,) = unusable(estimate, stated, (DISTANCE,) * 2)
    assert reason.startswith("rays of cam1 ")


# ---- scans ---------------------------------------------------------------------------------


def simulated(trajectory: TrajectoryName, scene: SceneName, rig_name: RigName) -> Problem:
    options = TrackOptions(
        rig=rig_name, trajectory=trajectory, scene=scene, frames=24, points=2500,
        max_points_per_image=200,
    )  # fmt: skip
    return simulate_tracks(options, np.random.default_rng(3))[0]


@cache
def observed(
    trajectory: TrajectoryName, scene: SceneName = "room", rig_name: RigName = "mono"
) -> Observability:
    refined = refine(simulated(trajectory, scene, rig_name), GraphOptions(), 1.0)
    graph, estimate = refined.graph, refined.estimate
    model = model_covariance(graph, estimate, refined.values)
    return observe(graph, estimate, model.covariance, model.covariance, model.unit)


def test_of_a_good_scan_nothing_is_weak() -> None:
    seen = observed("handheld", rig_name="triple")
    assert seen.weak == () and seen.unusable == () and seen.lacks == ()
    assert max(seen.prior_shares.values()) < 0.1


@pytest.mark.parametrize(
    ("trajectory", "scene", "rig_name", "lack", "kinds"),
    [
        ("forward", "room", "mono", "pure forward motion", {"focal length against depth"}),
        ("forward", "room", "stereo", "pure forward motion", {"focal length against depth"}),
        ("facing", "plane", "mono", "single plane seen head-on", {"focal length against depth"}),
        ("facing", "wall", "mono", "single plane seen head-on", {"doming"}),
        ("nadir", "ground", "mono", "parallel views", {"focal length against depth", "doming"}),
        ("static", "room", "stereo", "static rig", {"focal length against depth"}),
        ("static", "room", "triple", "static rig", {"principal point"}),
    ],
)
def test_degenerate_scans_are_refused_by_name(
    trajectory: TrajectoryName,
    scene: SceneName,
    rig_name: RigName,
    lack: str,
    kinds: set[Kind],
) -> None:
    seen = observed(trajectory, scene, rig_name)
    assert any("fx" in reason for reason in seen.unusable)
    assert any(words.startswith(lack) for words in seen.lacks)
    assert kinds <= {one.kind for one in seen.weak}
    assert len(seen.weak) <= MOST_LINES


@pytest.mark.parametrize(
    ("trajectory", "name"), [("panorama", "pure rotation"), ("static", "static rig")]
)
def test_scans_from_one_place_are_refused_before_they_are_solved(
    trajectory: TrajectoryName, name: str
) -> None:
    problem = simulated(trajectory, "room", "mono")
    with pytest.raises(ValueError, match="parallax"):
        refine(problem, GraphOptions(), 1.0)
    why = too_little_motion(problem, parallax_found=False)
    assert why is not None
    assert why.startswith(name)


def test_data_say_nothing_of_the_aspect_ratio_of_a_plane_seen_head_on() -> None:
    seen = observed("facing", "plane")
    (aspect,) = (one for one in seen.weak if one.kind == "focal length down")
    assert aspect.prior_share > 0.99
    assert aspect.data_slide_px > 10 * aspect.slide_px
    assert seen.prior_shares["cam0.fx"] > 0.5


def test_typical_distances() -> None:
    problem, true = small_problem("radial", cameras=2)
    near = typical_distances(true, problem.observations)
    far = typical_distances(true.scaled(3.0), problem.observations)
    np.testing.assert_allclose(far, 3 * near)
    assert ((near > 3) & (near < 8)).all()


def test_the_unit_of_length_changes_nothing() -> None:
    problem, true = small_problem("radtan", cameras=2, frames=10, points=200, start_error=0)
    graph = build(replace(problem, initial=true), GraphOptions(sigma_px=1.0))
    model = model_covariance(graph, true, graph.initial)
    assert model.unit != 1
    once = observe(graph, true, model.covariance, model.covariance, model.unit)
    assert once.weak
    grown = replace(problem, initial=true.scaled(7.0))
    graph = build(grown, GraphOptions(sigma_px=1.0))
    model = model_covariance(graph, grown.initial, graph.initial)
    again = observe(graph, grown.initial, model.covariance, model.covariance, model.unit)
    assert [one.what for one in once.weak] == [one.what for one in again.weak]
    assert [one.slide_px for one in once.weak] == pytest.approx(
        [one.slide_px for one in again.weak], rel=1e-3
    )

"""Differences that are known beforehand: changes of frames, lenses, baselines, and chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from synthetic.cameras import camera_of

from graphs.camera import Camera, project, unproject
from graphs.compare import Difference, Frames, Stated, difference, sights
from graphs.compare_chance import ChiSquare, changed, chi_square
from graphs.compare_rig import as_lens, depth_errors, holds, pair_place
from graphs.covariance import NOTHING, Covariance
from graphs.frames import FloatArray, Transform
from graphs.image_grid import image_grid
from graphs.pose_covariance import rereferenced
from graphs.problem import Estimate
from graphs.propagation import lens_names, pose_names

RANGES = (1.0, 2.0, 5.0, 10.0, np.inf)
PINHOLE = Camera("a", "pinhole", (640, 480), np.array([500.0, 500.0, 319.5, 239.5]))


def rig_of(*transforms: Transform, lens: Camera = PINHOLE) -> Estimate:
    cameras = tuple(replace(lens, name=f"c{i}") for i in range(len(transforms)))
    return Estimate(cameras, transforms, (), np.zeros((0, 3)))


def stereo(baseline: float = 0.3, lens: Camera = PINHOLE) -> Estimate:
    right = Transform.exp(np.array([0.01, 0.05, -0.02]), np.array([-baseline, 0.0, 0.0]))
    return rig_of(Transform.identity(), right, lens=lens)


def three() -> Estimate:
    return rig_of(
        Transform.identity(),
        Transform.exp(np.array([0.05, -0.2, 0.1]), np.array([-0.6, 0.05, 0.1])),
        Transform.exp(np.array([-0.1, 0.3, 0.2]), np.array([0.5, -0.2, 0.05])),
        lens=camera_of("radtan"),
    )


def whole(estimate: Estimate, scale: bool = False) -> Frames:
    return Frames((tuple(range(len(estimate.cameras))),), RANGES, translation=True, scale=scale)


ALONE = Frames(((0,),), (np.inf,), translation=False, scale=False)


def rms_px(found: Difference) -> float:
    looked = sights(found.a, found.frames.ranges, [i for g in found.frames.groups for i in g])
    left = found.at(looked)
    return float(np.sqrt(np.nanmean((left**2).sum(-1))))


def with_params(estimate: Estimate, camera: int, **moves: float) -> Estimate:
    names = [f"{estimate.cameras[camera].name}.{name}" for name in moves]
    return changed(estimate, names, np.array(list(moves.values())))


# ---- changes of frames ---------------------------------------------------------------------


def test_a_turned_camera_is_no_difference() -> None:
    one = rig_of(Transform.identity(), lens=camera_of("brown"))
    turned = Transform.exp(np.array([0.4, -0.9, 2.0]), np.zeros(3))
    other = replace(one, cam_from_rig=(turned,))
    found = difference(one, other, ALONE)
    assert rms_px(found) < 1e-6
    assert np.allclose(found.changes[0].b_from_a.rotation, turned.rotation.T, atol=1e-9)


@pytest.mark.parametrize("lens", ["radtan", "kannala_brandt", "double_sphere"])
def test_a_rotation_hides_what_it_can_of_a_principal_point(lens: str) -> None:
    """As much as the derivatives say, of which `image_grid` takes the rotation out."""
    camera = camera_of(lens)  # type: ignore[arg-type]
    one = rig_of(Transform.identity(), lens=camera)
    shift_px = 0.5
    found = difference(one, with_params(one, 0, cx=shift_px), ALONE)
    settled = image_grid(one, ["c0.cx"], [np.inf], shape=(17, 13)).settled[..., 0] * shift_px
    expected = float(np.sqrt((settled**2).sum(-1).mean()))
    assert rms_px(found) == pytest.approx(expected, rel=0.02)
    assert expected < 0.4 * shift_px


def test_a_rig_seen_from_another_of_its_cameras_is_no_difference() -> None:
    one = three()
    other, _ = rereferenced(one, Covariance((), np.zeros((0, 0))), 2)
    moved = Transform.exp(np.array([0.2, 1.0, 0.3]), np.array([3.0, -1.0, 0.5]))
    other = replace(other, cam_from_rig=tuple(t @ moved for t in other.cam_from_rig))
    assert rms_px(difference(one, other, whole(one))) < 1e-5
    place = pair_place(Stated(one, NOTHING), Stated(other, NOTHING), (0, 1))
    assert np.abs(place.change).max() < 1e-9


def test_a_larger_rig_is_no_difference_where_the_scale_is_free() -> None:
    one = three()
    other = one.scaled(1.7)
    found = difference(one, other, whole(one, scale=True))
    assert rms_px(found) < 1e-5
    assert found.changes[0].scale == pytest.approx(1 / 1.7, rel=1e-9)
    assert rms_px(difference(one, other, whole(one))) > 1.0


def test_one_change_of_frames_serves_all_cameras() -> None:
    """What would be undone camera by camera stays, where they turn against each other."""
    one = stereo()
    turn = np.array([0.0, 2e-3, 0.0])
    other = changed(one, ["c1.rotation_y"], turn[1:2])
    together = rms_px(difference(one, other, whole(one)))
    alone = difference(one, other, Frames(((0,), (1,)), (np.inf,), False, False))
    assert rms_px(alone) < 1e-6
    assert together == pytest.approx(0.5 * 500 * 2e-3, rel=0.2)  # half of it each


def test_pixels_that_one_lens_does_not_know_are_left_out() -> None:
    # A lens that folds inside of the image: its corners see nothing.
    folded = replace(PINHOLE, lens="radial", params=np.array([*PINHOLE.params, -0.9, 0.0]))
    one = rig_of(Transform.identity(), lens=folded)
    found = difference(one, with_params(one, 0, k1=0.001), ALONE)
    moved = found.over_image(0, np.inf)[2]
    assert np.isnan(moved[0, 0]).all() and np.isfinite(moved[12, 16]).all()
    assert 0 < rms_px(found) < 1.0


def test_a_map_shows_where_b_sees_what_a_sees() -> None:
    """Pixel by pixel, written once more."""
    one = stereo()
    other = with_params(one, 1, fx=5.0, cy=1.0)
    found = difference(one, other, whole(one))
    across, down, moved = found.over_image(1, 2.0)
    pixel = np.array([across[4], down[7]])
    point = one.cam_from_rig[1].inverse @ (2.0 * unproject(one.cameras[1], pixel))
    there = other.cam_from_rig[1] @ (found.changes[0].b_from_a @ point)
    assert moved[7, 4] == pytest.approx(project(other.cameras[1], there) - pixel, abs=1e-9)


# ---- lenses --------------------------------------------------------------------------------


def test_a_lens_that_holds_another_is_it() -> None:
    assert holds("brown", "radtan") and not holds("radtan", "brown")
    assert not holds("kannala_brandt", "radial")
    camera = camera_of("radtan")
    cov = Covariance(lens_names(replace(camera, name="c0")), np.diag(np.arange(1.0, 9.0)))
    side = Stated(rig_of(Transform.identity(), lens=camera), cov)
    new, error_px = as_lens(side, 0, "brown")
    assert error_px == 0.0
    assert new.estimate.cameras[0].named()["k3"] == 0.0
    assert new.covariance.sigma["c0.p2"] == pytest.approx(8.0**0.5)
    assert new.covariance.sigma["c0.k3"] == 0.0


def test_sigmas_follow_into_the_nearest_lens() -> None:
    """The new lens of a moved camera, fitted anew, sees as the covariance's one direction says."""
    camera = replace(PINHOLE, lens="radial", params=np.array([*PINHOLE.params, -0.1, 0.02]))
    one = rig_of(Transform.identity(), lens=camera)
    sigma = 1e-2
    side = Stated(one, Covariance(("c0.k1",), np.array([[sigma**2]])))
    new, error_px = as_lens(side, 0, "kannala_brandt")
    before = new.estimate.cameras[0]
    assert 0 < error_px < 0.1 and before.lens == "kannala_brandt"
    names = lens_names(before)
    direction = new.covariance.matrix[:, names.index("c0.k1")] / new.covariance.sigma["c0.k1"]
    stated = replace(before, params=before.params + direction)
    again, _ = as_lens(Stated(with_params(one, 0, k1=sigma), NOTHING), 0, "kannala_brandt")
    rays = unproject(before, np.random.default_rng(0).uniform([0, 0], [639, 479], (50, 2)))
    moved, expected = (
        project(c, rays) - project(before, rays) for c in (again.estimate.cameras[0], stated)
    )
    assert np.abs(moved - expected).max() < 0.01 * np.abs(moved).max()


# ---- depths --------------------------------------------------------------------------------


def depth_percent(a: Estimate, b: Estimate) -> list[tuple[float, float]]:
    found = depth_errors(Stated(a, NOTHING), Stated(b, NOTHING), (0, 1), RANGES[:4])
    return [(100 * one.median, 100 * one.worst) for one in found]


def test_a_baseline_one_per_cent_longer_is_depths_one_per_cent_longer() -> None:
    for median, worst in depth_percent(stereo(0.303), stereo(0.3)):
        assert median == pytest.approx(1.0, abs=1e-6)
        assert worst == pytest.approx(1.0, abs=1e-6)


def test_focal_lengths_one_per_cent_longer_are_depths_one_per_cent_longer() -> None:
    side = Transform(np.eye(3), np.array([-0.3, 0.0, 0.0]))
    true = rig_of(Transform.identity(), side)
    longer = true
    for camera in (0, 1):
        longer = with_params(longer, camera, fx=5.0, fy=5.0)
    found = depth_errors(Stated(longer, NOTHING), Stated(true, NOTHING), (0, 1), RANGES[:4])
    # Parallel cameras: 1 % of the depth, and of distances less to the side, where x does not grow.
    assert [100 * one.middle for one in found] == pytest.approx([1.0] * 4, abs=0.1)
    assert all(0.6 < 100 * one.median <= 1.0 for one in found)


def test_depths_that_a_wrong_turn_makes_endless_are_counted() -> None:
    true = stereo()
    converging = changed(true, ["c1.rotation_y"], np.array([-0.05]))
    diverging = changed(true, ["c1.rotation_y"], np.array([0.05]))
    shares = [
        depth_errors(Stated(a, NOTHING), Stated(true, NOTHING), (0, 1), (20.0,))[0].no_depth
        for a in (true, converging, diverging)
    ]
    assert shares[0] == 0.0 and max(shares[1:]) > 0.9 and min(shares[1:]) == 0.0


def test_cameras_back_to_back_have_no_depth() -> None:
    back = Transform.exp(np.array([0.0, np.pi, 0.0]), np.array([0.1, 0.0, 0.0]))
    side = Stated(rig_of(Transform.identity(), back), NOTHING)
    assert all(one.n_common == 0 for one in depth_errors(side, side, (0, 1), RANGES[:4]))


def test_sigmas_of_places_are_those_of_both_sides() -> None:
    one = stereo()
    names = pose_names("c1")
    a = Stated(one, Covariance(names, np.diag([1e-6, 4e-6, 1e-6, 9e-6, 1e-6, 1e-6])))
    b = Stated(changed(one, names, np.array([0, 1e-3, 0, 0, 0, 0])), a.covariance)
    place = pair_place(a, b, (0, 1))
    assert place.turn_deg == pytest.approx(np.degrees(1e-3))
    assert place.sigma_turn_deg == pytest.approx(np.degrees(8e-6**0.5), rel=1e-6)
    assert place.sigma_baselines == pytest.approx((3e-3, 3e-3), rel=1e-6)


# ---- chance --------------------------------------------------------------------------------


def covariance_of(estimate: Estimate, size: float = 1.0) -> Covariance:
    """Correlated, as large as a good calibration's."""
    names: list[str] = []
    scale: list[float] = []
    for camera in estimate.cameras:
        names += lens_names(camera)
        scale += [1.0, 1.0, 1.0, 1.0, *[2e-3] * (len(camera.names) - 4)]
    for camera in estimate.cameras[1:]:
        names += pose_names(camera.name)
        scale += [1e-3] * 3 + [2e-3] * 3
    root = np.random.default_rng(3).standard_normal((len(names), 2 * len(names)))
    root[:, 0] += 3.0
    root *= size * np.array(scale)[:, None] / np.linalg.norm(root, axis=1, keepdims=True)
    return Covariance(tuple(names), root @ root.T)


SMALL = Frames(((0, 1),), (2.0, np.inf), translation=True, scale=False)


def drawn(side: Stated, rng: np.random.Generator, times: float = 1.0) -> Stated:
    error = times * side.root @ rng.standard_normal(len(side.root))
    return Stated(changed(side.estimate, side.covariance.names, error), side.covariance)


def p_values(side: Stated, frames: Frames, count: int, times: float = 1.0) -> FloatArray:
    rng = np.random.default_rng(8)
    found = []
    for _ in range(count):
        judged = chi_square(drawn(side, rng, times), drawn(side, rng, times), frames)
        assert judged is not None and judged.rank > 0
        found.append(judged.p_value)
    return np.array(found)


@pytest.mark.slow
def test_p_values_of_a_camera_drawn_twice_are_uniform() -> None:
    one = rig_of(Transform.identity(), lens=camera_of("radtan"))
    p = p_values(Stated(one, covariance_of(one)), ALONE, 40)
    assert stats.kstest(p, "uniform").pvalue > 0.01


@pytest.mark.slow
def test_p_values_of_a_rig_drawn_twice_are_uniform() -> None:
    one = stereo(lens=camera_of("radial"))
    p = p_values(Stated(one, covariance_of(one)), SMALL, 10)
    assert stats.kstest(p, "uniform").pvalue > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("scale", [False, True])
def test_p_values_of_many_rigs_drawn_twice_are_uniform(scale: bool) -> None:
    one = stereo(lens=camera_of("radial"))
    p = p_values(Stated(one, covariance_of(one)), replace(SMALL, scale=scale), 200)
    assert stats.kstest(p, "uniform").pvalue > 0.01


def test_sigmas_that_claim_too_much_are_found_out() -> None:
    one = rig_of(Transform.identity(), lens=camera_of("radtan"))
    p = p_values(Stated(one, covariance_of(one)), ALONE, 8, times=3.0)
    assert (p < 0.01).mean() > 0.9


def judged(a: Stated, b: Stated, frames: Frames) -> ChiSquare:
    found = chi_square(a, b, frames)
    assert found is not None
    return found


def test_frames_and_units_do_not_change_the_judgement() -> None:
    """The same pair, B seen from elsewhere and counted otherwise."""
    one = stereo(lens=camera_of("radial"))
    a = Stated(one, covariance_of(one))
    b = drawn(a, np.random.default_rng(1))
    free = replace(SMALL, scale=True)
    elsewhere = Stated(*rereferenced(b.estimate, b.covariance, 1))
    for before, after in (
        (judged(a, b, free), judged(a, b.scaled(3.0), free)),
        (judged(a, b, SMALL), judged(a, elsewhere, SMALL)),
    ):
        assert after.difference_px == pytest.approx(before.difference_px, rel=1e-6)
        assert after.expected_px == pytest.approx(before.expected_px, rel=1e-2)
        # Which directions count is told from draws, and by one or two of them.
        assert after.chi2 / after.rank == pytest.approx(before.chi2 / before.rank, abs=0.3)


def test_without_sigmas_there_is_no_chi_square() -> None:
    one = Stated(stereo(), NOTHING)
    assert chi_square(one, one, SMALL) is None


def test_sigmas_beyond_linear_propagation_judge_nothing() -> None:
    one = rig_of(Transform.identity(), lens=camera_of("radtan"))
    side = Stated(one, covariance_of(one, 400.0))
    found = chi_square(side, Stated(with_params(one, 0, cx=1.0), NOTHING), ALONE)
    assert found is not None and found.rank == 0 and found.p_value == 1.0


def test_what_no_sigma_reaches_is_told_apart() -> None:
    one = rig_of(Transform.identity(), lens=camera_of("radtan"))
    names = ("c0.fx", "c0.fy", "c0.cx", "c0.cy")
    side = Stated(one, Covariance(names, np.eye(4)))
    bent = with_params(one, 0, k2=0.05)
    found = judged(side, Stated(bent, NOTHING), ALONE)
    assert found.outside_px > 0.3 * found.difference_px
    inside = judged(side, Stated(with_params(one, 0, fx=1.0), NOTHING), ALONE)
    assert inside.outside_px < 0.01 * inside.difference_px
    assert inside.chi2 == pytest.approx(1.0, rel=0.05)  # one sigma of one parameter

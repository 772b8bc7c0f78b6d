"""Drift that is known beforehand: none, of a lens, of a place, of the reference, of the size."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from graphs.compare import Stated
from graphs.compare_chance import changed
from graphs.covariance import Covariance
from graphs.drift import Drift, drift
from graphs.drift_picture import GROUPS, Group, assumed_covariance, picture, share
from graphs.drift_tests import OF_PLACE, Criteria, GroupDrift
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.pose_covariance import poses_as, rereferenced
from graphs.problem import Estimate
from graphs.propagation import marginal
from graphs.significance import Guess, degrees, detectable, holm, noncentrality, significance
from sfm_calib.simulate.rigs import RigName, make_rig

EXACT = Criteria(systematic_px=0.0, depth_ranges=())
USUAL = Criteria(depth_ranges=())


@cache
def rig(name: RigName, sigma_px: float = 0.1) -> Stated:
    """A rig that is right to so much in the picture."""
    made = make_rig(name, "radtan")
    estimate = Estimate(made.cameras, made.cam_from_rig, (), np.zeros((0, 3)))
    return Stated(estimate, assumed_covariance(estimate, sigma_px, 2.0))


def drawn(side: Stated, rng: np.random.Generator) -> Stated:
    """The same, its parameters off by what its covariance says."""
    error = side.root @ rng.standard_normal(len(side.root))
    return replace(side, estimate=changed(side.estimate, side.covariance.names, error))


def with_moves(side: Stated, **moves: float) -> Stated:
    """Names with two underscores for the dot: cam1__fx."""
    names = [name.replace("__", ".") for name in moves]
    return replace(side, estimate=changed(side.estimate, names, np.array(list(moves.values()))))


def turned(side: Stated, camera: int, turn_deg: float, axis: int = 1) -> Stated:
    """One camera turned about its own centre, the first camera's frame the rig's."""
    placed = list(side.estimate.cam_from_rig)
    turn = np.zeros(3)
    turn[axis] = np.radians(turn_deg)
    placed[camera] = Transform.exp(turn, np.zeros(3)) @ placed[camera]
    first = placed[0].inverse
    estimate = replace(side.estimate, cam_from_rig=tuple(t @ first for t in placed))
    return replace(side, estimate=estimate)


def test_of(result: Drift, cameras: tuple[int, ...], group: str) -> GroupDrift:
    return next(t for t in result.tests if t.cameras == cameras and t.group == group)


test_of.__test__ = False  # type: ignore[attr-defined]


def cameras_found(result: Drift, *groups: str) -> set[tuple[int, ...]]:
    return {t.cameras for t in result.found if t.group in groups}


# ---- the statistics ------------------------------------------------------------------------


def test_holm_by_hand() -> None:
    # 4 x 0.005, 3 x 0.01 -> 0.03, 2 x 0.03 -> 0.06, then 0.04, no less than the one before
    assert np.allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])
    assert np.allclose(holm([0.9, 0.8]), [1.0, 1.0])
    assert holm([]).shape == (0,)


def test_a_direction_without_a_sigma_says_nothing_unless_it_changed() -> None:
    cov = np.diag([4.0, 0.0])
    assert significance(np.array([2.0, 0.0]), cov).dof == 1
    assert significance(np.array([2.0, 0.0]), cov).chi2 == pytest.approx(1.0)
    assert significance(np.array([0.0, 0.5]), cov).p_value == 0.0
    assert significance(np.zeros(2), np.zeros((2, 2))).p_value == 1.0
    assert detectable(np.zeros((2, 2)), 0.05, 0.95) == 0.0


def test_what_is_called_detectable_is_found_as_often_as_promised() -> None:
    """In the worst direction just so, in another more often."""
    rng = np.random.default_rng(0)
    cov = np.array([[1.0, 0.3, 0.0], [0.3, 0.5, 0.1], [0.0, 0.1, 0.2]])
    alpha, power, n = 0.01, 0.95, 2000
    vectors = np.linalg.eigh(cov)[1]
    errors = rng.standard_normal((n, 3)) @ np.linalg.cholesky(cov).T
    size = detectable(cov, alpha, power)
    found = [
        np.mean([significance(size * u + e, cov).p_value < alpha for e in errors])
        for u in (vectors[:, -1], vectors[:, 0])
    ]
    assert found[0] == pytest.approx(power, abs=4 * (power * (1 - power) / n) ** 0.5)
    assert found[1] > found[0]


@pytest.mark.parametrize("nu", [4, 7, 39])
def test_a_covariance_guessed_of_few_frames_is_allowed_for(nu: int) -> None:
    """Its size scatters as that of nu + 1 frames: p-values stay uniform, power as promised."""
    rng, n, alpha, power = np.random.default_rng(nu), 1000, 0.01, 0.9
    size = noncentrality(alpha, 3, power, nu) ** 0.5
    guesses = rng.chisquare(nu, n) / nu
    errors = rng.standard_normal((n, 3))
    apart = [errors, errors + np.array([size, 0.0, 0.0])]
    p, q = (
        [significance(e, g * np.eye(3), nu).p_value for e, g in zip(one, guesses, strict=True)]
        for one in apart
    )
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    found = np.mean(np.array(q) < alpha)
    assert found == pytest.approx(power, abs=4 * (power * (1 - power) / n) ** 0.5)
    assert detectable(4 * np.eye(3), alpha, power, nu) == pytest.approx(2 * size)


def test_many_frames_are_as_good_as_a_known_covariance() -> None:
    for dof in (1, 3, 18):
        known = noncentrality(0.003, dof, 0.95)
        sizes = [noncentrality(0.003, dof, 0.95, nu) for nu in (1, 1.5, 3, 7, 39, 200, 2e4)]
        assert sizes == sorted(sizes, reverse=True)
        assert known < sizes[-2] < 1.12 * known
        assert sizes[-1] == pytest.approx(known, rel=1e-3)
    # Where the series of the noncentral F is not summed any more, it goes on as it was.
    near, far = (noncentrality(alpha, 3, 0.95, 2) for alpha in (0.0031, 0.0029))
    assert near < 3e3 < far or far < 1.1 * near


def test_what_is_known_beside_a_guess_makes_it_matter_less() -> None:
    half, whole = Guess(0.5 * np.eye(3), 10), Guess(np.eye(3), 10)
    assert degrees(np.eye(3), [half]) == pytest.approx(40)
    assert degrees(np.eye(3), [Guess(np.diag([0.5, 1.0, 0.0]), 10)]) == pytest.approx(10)
    assert degrees(np.eye(3), [Guess(np.zeros((3, 3)), 10)]) == np.inf
    assert degrees(np.eye(3), [replace(whole, nu=np.inf)]) == np.inf
    # Two halves of many and of few: the few count.
    assert degrees(np.eye(3), [half, replace(half, nu=90)]) == pytest.approx(36)
    assert degrees(np.eye(3), []) == np.inf


def test_an_assumed_covariance_errs_by_what_is_assumed() -> None:
    """A camera's own part, all groups together, in the picture."""
    side = rig("stereo", 0.3)
    names, matrix = side.covariance.names, side.covariance.matrix
    seen = picture(side.estimate.cameras[1], 2.0)
    total = 0.0
    for first, last in ((0, 2), (2, 4), (4, 8)):
        columns = list(range(first, last))
        rows = [names.index(f"cam1.{side.estimate.cameras[1].names[c]}") for c in columns]
        R = seen.of_lens(columns)
        total += float(np.trace(R @ matrix[np.ix_(rows, rows)] @ R.T))
    assert total == pytest.approx(3 / 5 * 0.3**2, rel=0.05)  # weak priors take a little
    assert share(0.3, 3, 5) * 3 == pytest.approx(0.3**2)
    assert not any(name.startswith("cam0.rotation") for name in names)


# ---- nothing changed -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stereo", "triple"])
def test_p_values_are_uniform_where_nothing_changed(name: RigName) -> None:
    side, rng, n = rig(name), np.random.default_rng(1), 150
    found = [drift(drawn(side, rng), drawn(side, rng), EXACT) for _ in range(n)]
    # Groups are tested on the same draws: each is held to the 1e-3 of its own.
    for index, test in enumerate(found[0].tests):
        p = [one.tests[index].p_value for one in found]
        assert stats.kstest(p, "uniform").pvalue > 1e-3, (test.cameras, test.group)
    assert (
        np.mean([one.verdict == "replace" for one in found]) <= stats.binom.isf(1e-3, n, 0.05) / n
    )


@pytest.mark.parametrize(("seed", "reference", "yaw"), [(0, 0, 1.5), (1, 1, -0.3), (2, 2, 0.0)])
def test_the_frames_of_the_two_do_not_matter(seed: int, reference: int, yaw: float) -> None:
    """Another camera for reference, or the whole rig turned, of one or the other."""
    rng = np.random.default_rng(seed)
    a, b = drawn(rig("triple"), rng), drawn(rig("triple"), rng)
    other = Stated(*rereferenced(b.estimate, b.covariance, reference))
    frame = Transform(exp_rotation(np.array([0.1, yaw, 0.2])), np.array([0.5, 0.1, -1.0]))
    placed = tuple(t @ frame for t in other.estimate.cam_from_rig)
    there = replace(other.estimate, cam_from_rig=placed)
    as_twists = poses_as(other.covariance, other.estimate, "left_twist")
    moved = Stated(there, poses_as(as_twists, there, "reported", given="left_twist"))
    one, two = drift(a, b, EXACT), drift(a, moved, EXACT)
    # To second order in the drift, which is as small as sigmas are.
    for x, y in zip(one.tests, two.tests, strict=True):
        assert y.chi2 == pytest.approx(x.chi2, rel=2e-2, abs=2e-2)
        assert y.effect_px == pytest.approx(x.effect_px, rel=1e-2, abs=1e-3)


def test_a_rig_that_kept_still_is_kept_and_a_weak_scan_says_nothing() -> None:
    rng = np.random.default_rng(3)
    side = rig("triple")
    same = drift(side, drawn(side, rng), USUAL)
    assert (same.verdict, same.found, same.moved, same.drifted) == ("keep", (), (), ())
    weak = drift(side, drawn(rig("triple", 2.0), rng), USUAL)
    assert weak.verdict == "inconclusive"
    assert weak.detectable_px == weak.unresolved[0].detectable_px > 2.0
    assert drift(side, weak.new, replace(USUAL, matters_px=100.0)).verdict == "keep"


def test_what_is_allowed_beside_the_sigmas_is_not_drift() -> None:
    """Sigmas that are far too small, and a difference of 0.1 px."""
    side, rng = rig("triple"), np.random.default_rng(4)
    sure = Stated(side.estimate, Covariance(side.covariance.names, side.covariance.matrix * 1e-6))
    off = Stated(drawn(side, rng).estimate, sure.covariance)
    assert drift(sure, off, EXACT).verdict == "replace"
    assert drift(sure, off, replace(USUAL, systematic_px=0.2)).verdict == "keep"


def test_few_frames_make_a_new_calibration_doubtful_and_an_old_one_not() -> None:
    side, rng = rig("triple"), np.random.default_rng(5)
    exact = Stated(side.estimate, Covariance((), np.zeros((0, 0))))
    new = drawn(side, rng)
    many, few = (drift(exact, new, EXACT, n_frames=n) for n in (None, 8))
    for one, other in zip(many.tests, few.tests, strict=True):
        # What linear propagation misses, of the new one's errors too, is a guess as they are.
        assert other.nu == pytest.approx(7)
        assert other.p_value == pytest.approx(stats.f.sf(one.chi2 / one.dof, one.dof, 7), rel=1e-6)
        assert other.detectable_px > 1.5 * one.detectable_px
    known = drift(new, exact, EXACT, n_frames=8)
    assert {test.nu for test in known.tests} == {np.inf}
    assert {drift(exact, new, EXACT, n_frames=1).tests[0].nu} == {1.0}


def test_a_camera_is_not_cleared_by_few_frames_as_by_many() -> None:
    """Which moved is told by the same tests: of few frames, more cameras stay in question."""
    side = rig("triple", 0.3)
    new = turned(side, 1, 0.3)
    many, few = (drift(side, new, EXACT, n_frames=n) for n in (None, 4))
    assert many.moved == ((1,),)
    assert len(few.tests) == len(many.tests)
    assert few.tests[-1].p_value > many.tests[-1].p_value


# ---- one camera changed --------------------------------------------------------------------


@pytest.mark.parametrize("camera", [0, 1, 2])
def test_a_turned_camera_is_named_even_if_it_is_the_reference(camera: int) -> None:
    rng = np.random.default_rng(camera)
    side = rig("triple")
    result = drift(drawn(side, rng), turned(drawn(side, rng), camera, 0.2), USUAL)
    assert result.verdict == "replace"
    assert result.moved == ((camera,),)
    assert result.drifted == (camera,)
    # In the frame of the others, only this one turned.
    assert cameras_found(result, *GROUPS) == {(camera,)}
    row = test_of(result, (camera,), "rotation")
    assert np.degrees(row.change[1]) == pytest.approx(0.2, abs=4 * np.degrees(row.sigma[1]))


def test_of_two_cameras_it_cannot_be_told_which_turned() -> None:
    side = rig("stereo")
    result = drift(side, turned(side, 1, 0.3), USUAL)
    assert result.verdict == "replace"
    assert set(result.moved) == {(0,), (1,)}
    assert result.drifted == ()
    assert cameras_found(result, "rotation") == {(0, 1)}


@pytest.mark.parametrize("camera", [0, 1])
def test_a_changed_lens_tells_which_of_two_turned(camera: int) -> None:
    side = rig("stereo")
    moved = turned(side, camera, 0.3)
    f = moved.estimate.cameras[camera].params[0]
    moved = with_moves(moved, **{f"cam{camera}__fx": 0.02 * f, f"cam{camera}__fy": 0.02 * f})
    result = drift(side, moved, USUAL)
    assert (result.moved, result.by_lens, result.drifted) == (((camera,),), True, (camera,))
    assert cameras_found(result, "rotation") == {(camera,)}


def test_only_what_was_freed_can_have_moved() -> None:
    side = rig("stereo")
    freed: set[tuple[str, Group]] = {("cam1", "rotation"), ("cam1", "translation")}
    result = drift(side, turned(side, 1, 0.3), USUAL, tested=freed)
    assert result.moved == ((1,),)
    assert {(t.cameras, t.group) for t in result.tests} == {
        ((1,), "rotation"), ((1,), "translation"), ((0, 1), "places"),
    }  # fmt: skip


def test_a_principal_point_that_a_turn_undoes_is_no_drift_but_alone_it_is_a_turn() -> None:
    side = rig("triple", 0.05)
    f, shift = side.estimate.cameras[1].params[0], 1.0
    seen = picture(side.estimate.cameras[1], 2.0)
    turn = seen.pointing[:, 2] * shift  # by cx
    assert abs(turn[1]) == pytest.approx(shift / f, rel=0.2)
    alone = with_moves(side, cam1__cx=shift)
    undone = turned(turned(alone, 1, np.degrees(-turn[1])), 1, np.degrees(-turn[0]), axis=0)
    undone = turned(undone, 1, np.degrees(-turn[2]), axis=2)
    both, one = drift(side, undone, USUAL), drift(side, alone, USUAL)
    pointing = [test_of(result, (1,), "rotation") for result in (both, one)]
    assert pointing[0].effect_px < 0.01 * shift
    assert pointing[1].effect_px == pytest.approx(shift, rel=0.1)
    assert test_of(one, (1,), "principal point").effect_px < 0.3 * shift
    assert both.verdict == "keep"
    assert cameras_found(one, "rotation") == {(1,)}
    assert one.moved == ((1,),)


def test_a_centre_moves_the_way_that_is_said() -> None:
    side = rig("triple", 0.05)
    here = side.estimate.cam_from_rig[1]
    step = np.array([0.002, -0.0008, 0.0012])  # along the camera's own axes
    centre = here.inverse.translation + here.rotation.T @ step
    placed = list(side.estimate.cam_from_rig)
    placed[1] = Transform(here.rotation, -here.rotation @ centre)
    new = replace(side, estimate=replace(side.estimate, cam_from_rig=tuple(placed)))
    result = drift(side, new, USUAL)
    assert result.moved == ((1,),)
    assert np.allclose(test_of(result, (1,), "translation").change, step, atol=5e-5)
    assert np.allclose(test_of(result, (1,), "rotation").change, 0.0, atol=1e-5)


# ---- the size ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["stereo", "triple"])
def test_a_free_scale_hides_the_size_and_nothing_else(name: RigName) -> None:
    side = rig(name)
    larger = side.scaled(1.05)
    assert drift(side, larger, USUAL).verdict == "replace"
    hidden = drift(side, larger, USUAL, scale_free=True)
    assert not hidden.found
    assert max(test.effect_px for test in hidden.tests) < 1e-6
    known, free = drift(side, side, USUAL), hidden
    assert known.tests[-1].dof == 6 * (len(side.estimate.cameras) - 1)
    assert free.tests[-1].dof == known.tests[-1].dof - 1
    across = turned(larger, 1, 0.3)
    assert drift(side, across, USUAL, scale_free=True).verdict == "replace"


# ---- edges ---------------------------------------------------------------------------------


def test_one_camera_alone_has_no_place() -> None:
    camera = rig("stereo").estimate.cameras[0]
    alone = Estimate((camera,), (Transform.identity(),), (), np.zeros((0, 3)))
    side = Stated(alone, assumed_covariance(alone, 0.1, 2.0))
    result = drift(side, with_moves(side, cam0__fx=3.0, cam0__fy=3.0), USUAL)
    assert result.verdict == "replace"
    assert result.drifted == (0,)
    assert {test.group for test in result.tests} == {
        "focal", "principal point", "distortion", "lens",
    }  # fmt: skip
    assert not result.pairs


def test_exactly_known_sides_differ_or_do_not() -> None:
    side = rig("stereo")
    exact = Stated(side.estimate, Covariance((), np.zeros((0, 0))))
    assert drift(exact, exact, EXACT).verdict == "keep"
    result = drift(exact, with_moves(exact, cam1__fx=3.0), EXACT)
    assert result.verdict == "replace"
    assert test_of(result, (1,), "focal").p_value == 0.0


def test_errors_that_both_share_are_no_drift_and_hide_none() -> None:
    """Where the old one is in the new one, their difference is surer than each."""
    side = rig("triple", 0.5)
    new = with_moves(side, cam1__fx=0.7, cam1__fy=0.7)
    apart = Covariance(side.covariance.names, side.covariance.matrix * 1e-2)
    assert drift(side, new, EXACT).verdict != "replace"
    assert drift(side, new, EXACT, cov_difference=apart).drifted == (1,)


def test_depths_and_places_of_pairs_go_along() -> None:
    side = rig("stereo")
    result = drift(side, turned(side, 1, 0.3), Criteria(depth_ranges=(1.0, 5.0)))
    (pair,) = result.pairs
    assert pair.place.turn_deg == pytest.approx(0.3, rel=1e-3)
    near, far = pair.depth
    assert abs(far.median) > 3 * abs(near.median) > 0
    assert far.sigma_middle > 0


def test_other_cameras_and_lenses_are_refused() -> None:
    a, b = rig("stereo"), rig("triple")
    with pytest.raises(ValueError, match="zip"):
        drift(a, b)
    other = replace(a.estimate.cameras[1], name="right")
    swapped = replace(a.estimate, cameras=(a.estimate.cameras[0], other))
    with pytest.raises(ValueError, match=r"cam1 .* is no right"):
        drift(a, Stated(swapped, marginal(a.covariance, ["cam0.fx"])))


def test_the_covariance_that_is_allowed_makes_all_tests_weaker() -> None:
    side, rng = rig("triple"), np.random.default_rng(7)
    new = drawn(side, rng)

    def sizes(systematic_px: float) -> FloatArray:
        tests = drift(side, new, replace(EXACT, systematic_px=systematic_px)).tests
        return np.array([(test.detectable_px, test.expected_px) for test in tests])

    assert (sizes(0.3) > sizes(0.0)).all()


def test_so_much_is_allowed_as_is_said() -> None:
    """Of sides that are exact: a fifth of the variance to each group, to a place less."""
    side = rig("stereo")
    exact = Stated(side.estimate, Covariance((), np.zeros((0, 0))))
    result = drift(exact, with_moves(exact, cam1__fx=1e-3), replace(EXACT, systematic_px=0.2))
    variance = 0.2**2 / 5
    for group, share_of in (("focal", 1), ("distortion", 1), ("lens", 3)):
        expected = (share_of * variance) ** 0.5
        assert test_of(result, (1,), group).expected_px == pytest.approx(expected, rel=1e-6)
    # In the frame of the first camera, which errs as much.
    turned_px = test_of(result, (0, 1), "rotation").expected_px
    assert turned_px > (2 * variance) ** 0.5
    places = test_of(result, (0, 1), "places").expected_px
    assert places < (2 * variance) ** 0.5 * (1 + OF_PLACE**2) ** 0.5 / 2**0.5


def test_a_direction_that_is_hardly_known_takes_no_length_along() -> None:
    """A measured baseline: to first order alone, a turn of it by three sigmas would shorten it."""
    side = rig("stereo", 0.02)
    t = side.estimate.cam_from_rig[1].translation
    u = t / np.linalg.norm(t)
    across = np.eye(3) - np.outer(u, u)
    names = [f"cam1.translation_{axis}" for axis in "xyz"]
    cov = 1e-10 * np.outer(u, u) + 0.007**2 * across
    unsure = Stated(side.estimate, Covariance(tuple(names), cov))
    rotated = exp_rotation(0.1 * np.linalg.svd(across)[0][:, 0])
    here = side.estimate.cam_from_rig[1]
    new = replace(
        side.estimate, cam_from_rig=(Transform.identity(), replace(here, translation=rotated @ t))
    )
    of_new = Stated(new, Covariance(tuple(names), rotated @ cov @ rotated.T))
    row = test_of(drift(unsure, of_new, USUAL), (0, 1), "translation")
    assert (
        row.chi2 < 8.1 + 0.1
    )  # (0.1 x 0.2 m / 0.007 m)^2 at most, what is not known on both sides
    longer = Stated(unsure.scaled(1.05).estimate, unsure.covariance)
    assert drift(unsure, longer, USUAL).verdict == "replace"

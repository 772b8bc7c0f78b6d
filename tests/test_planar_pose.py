"""Two solutions of a flat board: what is predicted, what is chosen, and the answer's counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.planar_pose import PlanarOptions, answer, predicted_distance, simulated, trial
from experiments.planar_pose_answer import cases_of
from experiments.runner.protocol import Finished, Row
from graphs.planar import gather, solve_views

FEW = {"views": 40}


def row_of(seed: int = 0, **options: object) -> Row:
    return trial(PlanarOptions(**(FEW | options)), seed)


def share(row: Row, name: str = "n_wrong") -> float:
    count, used = row[name], row["n_used"]
    assert isinstance(count, int)
    assert isinstance(used, int)
    return count / used


@pytest.mark.parametrize("changes", [{}, {"tilt_deg": 50.0}, {"corners": 4, "distance": 30.0}])
def test_the_predicted_distance_is_that_of_the_second_minimum(changes: dict[str, float]) -> None:
    options = PlanarOptions(**({"views": 10, "distance": 60.0, "focal_px": 4000.0} | changes))
    seen = simulated(options.model_copy(update={"noise_px": 1e-4}), np.random.default_rng(1))
    both = solve_views(seen.rig.cameras, gather(seen.views, seen.board.corners_m))
    corners = np.array([len(view.corner) for view in seen.views])
    found = both.second_rms_px * np.sqrt(corners) / options.noise_px
    predicted = [
        predicted_distance(seen.board.corners_m[v.corner, :2], seen.cam_from_board.one(i), options)
        for i, v in enumerate(seen.views)
    ]
    assert np.allclose(found, predicted, rtol=0.05)


def test_near_boards_are_right_and_far_ones_a_toss() -> None:
    assert share(row_of(distance=8.0)) == 0
    far = row_of(distance=200.0, views=200)
    assert 0.35 < share(far) < 0.6
    assert far["predicted_wrong"] == pytest.approx(0.49, abs=0.01)


def test_a_second_camera_or_more_frames_resolve_it() -> None:
    alone = share(row_of(distance=30.0, views=200))
    assert alone > 0.05
    assert share(row_of(distance=30.0, how="known_rig")) < 0.03
    assert share(row_of(distance=30.0, how="votes")) < 0.03
    assert share(row_of(distance=30.0, how="sequence", views=200)) < alone


def test_a_small_board_in_one_place_does_not_mirror_the_rig() -> None:
    wrong = [share(row_of(seed, how="votes", roam_deg=0.0)) for seed in range(5)]
    assert max(wrong) < 0.05


def test_upside_down_boards_are_numbered_alike_in_a_frame() -> None:
    row = row_of(how="half_turns", distance=15.0)
    assert share(row) == 0
    assert row["n_misnumbered"] == 0
    assert isinstance(row["error_deg"], float)
    assert row["error_deg"] < 5


def test_a_trial_is_the_same_again() -> None:
    assert row_of(how="votes") == row_of(how="votes")
    assert row_of(seed=0) != row_of(seed=1)


# ---- the answer ----------------------------------------------------------------------------


def finished(n_wrong: int, predicted: float, **options: object) -> Finished[PlanarOptions]:
    row: Row = {
        "n_views": 200, "n_used": 200, "n_wrong": n_wrong, "n_left_out": 0, "n_misnumbered": 0,
        "predicted_wrong": predicted, "error_deg": 1.0, "guessed": False,
    }  # fmt: skip
    return Finished(PlanarOptions(**options), 0, row, 0.1)


RESOLVED = finished(0, 0.2, how="known_rig")


def test_it_holds_where_shares_are_as_predicted_and_a_pair_is_right() -> None:
    found = answer([finished(20, 0.11), finished(60, 0.28, distance=40.0), RESOLVED])
    assert found.holds is True
    assert "2 of 2 cases of lone views as predicted" in found.verdict
    assert answer([finished(60, 0.1), RESOLVED]).holds is False
    assert answer([finished(20, 0.1), finished(40, 0.1, how="known_rig")]).holds is False
    near = finished(20, 0.1, how="votes", apart_deg=3.0)  # too near to count
    assert answer([finished(20, 0.1), near, RESOLVED]).holds is True


def rigs(*n_wrong: int, how: str = "votes") -> list[Finished[PlanarOptions]]:
    return [replace(finished(n, 0.2, how=how), seed=seed) for seed, n in enumerate(n_wrong)]


@pytest.mark.parametrize("how", ["votes", "half_turns"])
def test_a_rig_that_is_mirrored_is_one_of_so_many_rigs(how: str) -> None:
    """One of ten: its 200 views are no 200 of 2000. The share scatters by as much as it is."""
    (case,) = cases_of(rigs(200, *[0] * 9, how=how))
    assert case.wrong == (pytest.approx(0.1), pytest.approx(0.1))
    (none,) = cases_of(rigs(*[0] * 10, how=how))
    assert none.wrong == (0, pytest.approx((1 / 12 * 11 / 12 / 10) ** 0.5))
    (one,) = cases_of(rigs(3, how=how))
    assert one.wrong == (pytest.approx(0.015), float("inf"))


def test_votes_are_held_against_the_limit_with_their_scatter() -> None:
    lone = finished(20, 0.1)
    assert answer([lone, *rigs(*[0] * 10)]).holds is True
    mirrored = answer([lone, *rigs(200, *[0] * 9)])
    assert mirrored.holds is None and mirrored.verdict.startswith("too few trials to say: ")
    assert answer([lone, *rigs(*[20, 24] * 5)]).holds is False
    assert answer([lone, *rigs(20)]).holds is None  # one rig
    assert "votes: 10.0 % (as usual)" in answer([lone, *rigs(20)]).verdict
    assert answer([finished(90, 0.1), *rigs(200, *[0] * 9)]).holds is False
    # a second camera by a known rig decides view by view: of 100 pairs 1.5 % may be chance
    assert answer([lone, finished(3, 0.2, how="known_rig")]).holds is None


def test_few_failed_and_missing_trials_are_no_answer() -> None:
    assert answer([]).holds is None
    broken = Finished(PlanarOptions(), 0, {}, 0.1, "no")
    assert answer([broken]).holds is None
    assert answer([finished(20, 0.1)]).holds is None
    assert answer([RESOLVED]).holds is None
    none_used = Finished(
        PlanarOptions(how="target"), 0,
        dict(finished(0, 0.1).row) | {"n_used": 0, "error_deg": None}, 0.1,
    )  # fmt: skip
    assert "none used" in answer([finished(20, 0.1), none_used, RESOLVED, broken]).verdict


def test_figures_show_what_was_swept() -> None:
    found = answer([finished(20, 0.1), finished(0, 0.0, distance=10.0), RESOLVED])
    assert [figure.name for figure in found.figures] == ["distance", "apart"]

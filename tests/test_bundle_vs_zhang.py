"""Zhang's closed form, and what joint refinement gains over it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.bundle_vs_zhang import BOARD, ZhangStudyOptions, answer, simulated, trial
from experiments.bundle_vs_zhang_answer import MEASURES, METHODS
from experiments.peers import zhang
from experiments.runner.protocol import Finished
from graphs.frames import FloatArray, Transform

CORNERS = BOARD.corners_m


def homographies(K: FloatArray, rng: np.random.Generator, count: int = 5) -> list[FloatArray]:
    """Of boards tilted at random before a camera."""
    found = []
    for _ in range(count):
        board = Transform.exp(rng.uniform(-0.6, 0.6, 3), np.array([0.0, 0.0, 0.6]))
        H = K @ np.column_stack([board.rotation[:, :2], board.translation])
        found.append(H / np.linalg.norm(H))
    return found


@settings(max_examples=20, deadline=None)
@given(
    focal=st.floats(0.5, 4), aspect=st.floats(0.9, 1.1), x=st.floats(-0.2, 0.2),
    seed=st.integers(0, 99),
)  # fmt: skip
def test_exact_homographies_give_the_camera(
    focal: float, aspect: float, x: float, seed: int
) -> None:
    K = np.array([[focal, 0, x], [0, focal * aspect, -x / 2], [0, 0, 1]])
    found = homographies(K, np.random.default_rng(seed))
    for unknowns in (5, 4):
        assert np.allclose(zhang.camera_matrix(found, unknowns), K, rtol=1e-6, atol=1e-6)
    K[1, 1] = focal
    found = homographies(K, np.random.default_rng(seed))
    assert np.allclose(zhang.camera_matrix(found, 3), K, rtol=1e-6, atol=1e-6)


def test_homographies_of_no_camera_are_refused() -> None:
    with pytest.raises(ValueError, match="not definite"):
        zhang.camera_matrix(list(np.random.default_rng(0).standard_normal((4, 3, 3))), 4)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999))
def test_a_refined_homography_fits_pixels_better(seed: int) -> None:
    rng = np.random.default_rng(seed)
    H = homographies(np.diag([800.0, 800.0, 1.0]), rng, 1)[0]
    flat = CORNERS[:, :2]
    at = np.column_stack([flat, np.ones(len(flat))]) @ H.T
    exact = at[:, :2] / at[:, 2:]
    assert np.allclose(np.abs(zhang.homography(flat, exact)), np.abs(H), atol=1e-9)
    pixels = exact + rng.standard_normal(exact.shape)

    def cost(found: FloatArray) -> float:
        seen = np.column_stack([flat, np.ones(len(flat))]) @ found.T
        return float(((seen[:, :2] / seen[:, 2:] - pixels) ** 2).sum())

    linear, refined = (zhang.homography(flat, pixels, each) for each in (False, True))
    assert cost(refined) < cost(linear)
    for index in range(9):  # it is a minimum
        step = np.zeros(9)
        step[index] = 1e-6
        assert cost(refined + step.reshape(3, 3)) > cost(refined) - 1e-6


def test_distortion_is_exact_where_the_rest_is() -> None:
    made = simulated(ZhangStudyOptions(views=5), 5, 0.0, np.random.default_rng(0))
    true, boards = made.truth.cameras[0], made.truth.rig_from_world
    start = replace(true, params=np.array([*true.params[:4], 0.0, 0.0]))
    found = zhang.with_distortion(start, boards, made.views.views, CORNERS)
    assert np.allclose(found.params, true.params, atol=1e-9)


def test_the_closed_form_is_exact_without_distortion_and_noise() -> None:
    options = ZhangStudyOptions(views=6, distortion=0)
    made = simulated(options, 6, 0.0, np.random.default_rng(1))
    for closed in (zhang.ZhangOptions(5), zhang.ZhangOptions(4), zhang.ZhangOptions(4, False, 2)):
        found = zhang.calibrate(made.views, CORNERS, closed)
        assert np.allclose(found.cameras[0].params, made.truth.cameras[0].params, atol=1e-5)
        assert found.rms_px < 1e-6
    few = replace(made.views, views=made.views.views[:2])
    with pytest.raises(ValueError, match="2 views do not determine 5"):
        zhang.calibrate(few, CORNERS, zhang.ZhangOptions(5))


def test_a_trial_is_the_same_again_and_ours_is_opencvs() -> None:
    row = trial(ZhangStudyOptions(views=4), 3)
    assert row == trial(ZhangStudyOptions(views=4), 3)
    assert isinstance(row["joint_less_opencv_px"], float)
    assert row["joint_less_opencv_px"] < 0.01
    assert all(f"{measure}_{method}" in row for measure in MEASURES for method in METHODS)
    assert isinstance(row["rms_joint"], float)
    assert isinstance(row["rms_zhang4"], float)
    assert row["rms_joint"] < row["rms_zhang4"] / 2  # an ordinary lens is distorted


def finished(
    seed: int, after: float = 0.4, distortion: float = 1.0, **changed: float | None
) -> Finished[ZhangStudyOptions]:
    scale = 1 + 0.1 * (seed % 3)
    row = {f"{measure}_{method}": scale for measure in MEASURES for method in METHODS}
    row |= {f"{measure}_joint": after * scale for measure in MEASURES}
    more = {"corner_px": 31 * distortion, "n_views": 20, "joint_less_opencv_px": 1e-4}
    options = ZhangStudyOptions(distortion=distortion)
    return Finished(options, seed, row | more | changed, 1.0)


def test_the_claim_holds_where_every_error_falls_by_as_much() -> None:
    assert answer([finished(seed) for seed in range(6)]).holds is True
    found = answer([finished(seed, after=0.9) for seed in range(6)])
    assert found.holds is False
    assert "8 of 8 falls lie outside" in found.verdict
    one = [finished(seed, focal_joint=0.05) for seed in range(6)]
    assert answer(one).holds is False


def test_few_failed_and_missing_trials_are_no_answer() -> None:
    assert answer([]).holds is None
    assert answer([finished(0)]).holds is None
    broken = Finished(ZhangStudyOptions(), 9, {}, 0.1, "no")
    assert answer([broken]).holds is None
    missing = [finished(seed, rms_zhang4=None) for seed in range(6)]
    found = answer([*missing, broken])
    assert found.holds is True
    assert "reprojection" not in found.verdict.split(";")[-1]
    assert "rms unknown" in found.verdict


def test_figures_vary_one_option() -> None:
    trials = [finished(seed, distortion=each) for each in (0.0, 0.5, 1.0) for seed in range(6)]
    found = answer(trials)
    assert [figure.name for figure in found.figures] == ["falls_distortion"]
    assert len(found.tables[0].rows) == 3

"""The study of averaging: its split, its trials, and answers that flip when the data are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.aleatory_epistemic import (
    COUNTS,
    PAIR,
    RANGES_M,
    REPEATS,
    AveragingOptions,
    answer,
    split,
    squares_of_means,
    trial,
)
from experiments.averaging import MEASURES, broken, curve_of, kind_of, near, wrong_of
from experiments.runner.protocol import Answer, Finished, Row
from experiments.stereo import as_estimate, parallel_pair, points_at, seen_by_both
from graphs.compare import Stated
from graphs.compare_chance import changed
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.triangulation import triangulate, triangulated_covariance

SIGMA_PX = 0.3


def test_the_split_of_a_length_by_finite_differences() -> None:
    """A length's ends share the calibration, and not the noise."""
    true, rng = as_estimate(parallel_pair(600, 0.2, "barrel")), np.random.default_rng(2)
    names = ("cam0.fx", "cam1.k1", "cam1.rotation_y", "cam1.translation_x")
    covariance = Covariance(names, np.diag([1.0, 1e-3, 1e-4, 1e-4]) ** 2)
    near, far = (points_at(true, z, 3, rng) for z in (1.0, 1.5))
    ends = np.stack([near, far], axis=1)
    exact = seen_by_both(true, ends)
    told = triangulated_covariance(true, covariance, PAIR, exact, SIGMA_PX)

    def lengths(pixels: FloatArray, error: FloatArray) -> FloatArray:
        points = triangulate(changed(true, names, error), PAIR, pixels, SIGMA_PX)
        length: FloatArray = np.linalg.norm(points[:, 1] - points[:, 0], axis=-1)
        return length

    from_calibration = sum(
        ((lengths(exact, h) - lengths(exact, -h)) / 2) ** 2
        for h in np.diag(np.sqrt(np.diag(covariance.matrix)))
    )
    from_noise, still = np.zeros(3), np.zeros(4)
    for place in np.ndindex(2, 2, 2):
        h = np.zeros((2, 2, 2))
        h[place] = SIGMA_PX
        from_noise += ((lengths(exact + h, still) - lengths(exact - h, still)) / 2) ** 2
    found = split(told, Stated(true, covariance))
    np.testing.assert_allclose(found["length"].calibration, from_calibration, rtol=2e-3)
    np.testing.assert_allclose(found["length"].noise, from_noise, rtol=2e-3)
    np.testing.assert_allclose(found["depth"].noise, told.sigma_depth_noise[:, 0] ** 2)
    np.testing.assert_allclose(
        found["point"].calibration, np.trace(told.cov_calibration[:, 0], axis1=1, axis2=2)
    )


def test_squares_of_means_by_hand() -> None:
    biased = np.full((REPEATS, 2, 3, 1), 0.5)
    np.testing.assert_allclose(squares_of_means(biased), 0.25)
    noise = np.random.default_rng(0).standard_normal((REPEATS, 2, 40, 1))
    np.testing.assert_allclose(squares_of_means(noise) * COUNTS, 1.0, rtol=0.6)
    turns = np.tile([[1.0], [-1.0]], (REPEATS // 2, 1))[:, None, None, :]
    np.testing.assert_allclose(squares_of_means(turns)[0], [1, 1 / 9, 0, 0, 0, 0, 0], atol=1e-15)


def test_trials_are_functions_of_their_seed() -> None:
    options = AveragingOptions(frames=10)
    row = trial(options, 1)
    assert row == trial(options, 1)
    for measure in MEASURES:
        square = np.reshape(row[f"{measure}_square"], (len(RANGES_M), len(COUNTS)))  # type: ignore[arg-type]
        noise, floor = (np.array(row[f"{measure}_{key}"]) for key in ("noise", "floor"))
        # what was drawn is what was said, but for the estimate of the noise
        np.testing.assert_allclose(square[:, 0] - floor, noise, rtol=0.5)
        np.testing.assert_allclose(square[:, -1], floor + noise / REPEATS, rtol=1.0)
        assert (np.array(row[f"{measure}_nees"]) < 20).all()


# ---- answers -------------------------------------------------------------------------------


def made_row(
    rng: np.random.Generator, noise: float = 1.0, calibration: float = 1.0, sigma: float = 1.0
) -> Row:
    """A trial of known sigmas, of which noise and calibration are stated as so much of them, and
    the pixels' noise estimated."""
    row: dict[str, list[float] | float] = {
        "range_m": list(RANGES_M),
        "n": [float(n) for n in COUNTS],
        "sigma_px": SIGMA_PX * sigma * rng.normal(1, 0.01),
    }
    counts = np.array(COUNTS)
    for measure in MEASURES:
        of_noise, of_calibration = 0.01 * np.array(RANGES_M) ** 2, 0.002 * np.array(RANGES_M)
        floor = of_calibration**2 * rng.chisquare(5) / 5
        drawn = of_noise[:, None] ** 2 / counts * rng.normal(1, 0.02, (len(RANGES_M), len(counts)))
        row[f"{measure}_square"] = (drawn + floor[:, None]).ravel().tolist()
        row[f"{measure}_noise"] = ((noise * of_noise) ** 2).tolist()
        row[f"{measure}_calibration"] = ((calibration * of_calibration) ** 2).tolist()
        row[f"{measure}_floor"] = floor.tolist()
        row[f"{measure}_nees"] = (floor / (calibration * of_calibration) ** 2).tolist()
    return row


def answered(
    noise: float = 1.0,
    calibration: float = 1.0,
    frames: tuple[int, ...] = (40,),
    sigma: float = 1.0,
) -> Answer:
    rng = np.random.default_rng(0)
    return answer(
        [
            Finished(
                AveragingOptions(frames=f), seed, made_row(rng, noise, calibration, sigma), 1.0
            )
            for f in frames
            for seed in range(50)
        ]
    )


def test_a_split_that_holds() -> None:
    found = answered(frames=(10, 40))
    assert found.holds is True and found.verdict.startswith("yes: frames 10: 1000 measurements")
    # at 2 m, noise 40 mm and calibration 4 mm: N* = 100
    assert "frames 40: 1000 measurements of a depth of 2 m leave 4" in found.verdict
    assert "(predicted 100)" in found.verdict
    assert [table.name for table in found.tables] == ["ends", "means", "noise"]
    assert [f.name for f in found.figures] == [*MEASURES, "ratio"]


def test_the_curve_by_hand() -> None:
    rng = np.random.default_rng(1)
    curve = curve_of("", "depth", [made_row(rng) for _ in range(400)])
    np.testing.assert_allclose(curve.nstar_predicted, [25, 100, 400])
    for value, error in curve.nstar:
        assert error is not None and error < 0.1 * value
    np.testing.assert_allclose([v for v, _ in curve.nstar], curve.nstar_predicted, rtol=0.15)
    np.testing.assert_allclose(curve.predicted_m[1, 0], np.hypot(0.04, 0.004))
    assert curve.nees[0] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("noise", "calibration", "wrong"),
    [(0.8, 1.0, "RMSE of 1"), (1.2, 1.0, "RMSE of 1"), (1.0, 0.6, "NEES"), (1.0, 1.6, "NEES")],
)
def test_answers_flip_when_the_data_are_wrong(noise: float, calibration: float, wrong: str) -> None:
    found = answered(noise, calibration)
    assert found.holds is False and found.verdict.startswith("no: ")
    assert "not as predicted: " in found.verdict
    assert wrong in found.verdict.split("depth (frames 40): ")[1]


@pytest.mark.parametrize(("sigma", "side"), [(0.92, "8 % low"), (1.03, "3 % high")])
def test_noise_that_is_estimated_wrong_is_said_though_the_sums_hold(
    sigma: float, side: str
) -> None:
    assert answered(sigma=0.99).holds is True  # within the room
    found = answered(sigma=sigma)
    assert found.holds is False
    assert f"sigma_px {SIGMA_PX * sigma:.3f} ± 0.000 of 0.300 at frames 40: {side}" in found.verdict


def test_nstar_pooled_tells_what_no_range_tells_alone() -> None:
    """Twice as much as predicted at a scatter that leaves each range open."""
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(30):
        row = dict(made_row(rng))
        for measure in MEASURES:
            luck = rng.chisquare(1.5, len(RANGES_M)) / 1.5
            for key in ("floor", "nees"):
                row[f"{measure}_{key}"] = (0.6 * luck * np.ones(3)).tolist()
            floor = np.array(row[f"{measure}_floor"]) * 1e-4
            noise = 1e-2 * np.ones((3, 1)) / np.array(COUNTS)
            row[f"{measure}_floor"] = floor.tolist()
            row[f"{measure}_square"] = (noise + floor[:, None]).ravel().tolist()
            row[f"{measure}_noise"] = [1e-2] * 3
            row[f"{measure}_calibration"] = [1.1e-4] * 3
        rows.append(row)
    found = kind_of("", SIGMA_PX, rows)
    ratio, error = found.nstar
    assert 1.5 < ratio < 2.5 and error is not None and 0.05 < error < 0.25
    assert not any("N* at" in one for c in found.curves for one in broken(c))
    assert any("times the predicted" in one for one in wrong_of(found))


def test_room_and_chance_are_not_added() -> None:
    """Either is enough; both together are not: 1.2 misses by the room and two errors."""
    assert near((1.09, 0.0), 1.0, 0.9, 1.1) and near((1.2, 0.07), 1.0, 0.9, 1.1)
    assert not near((1.2, 0.05), 1.0, 0.9, 1.1) and not near((float("nan"), 0.1), 1.0, 0.9, 1.1)


def test_few_and_failed_trials() -> None:
    rng = np.random.default_rng(0)
    one = Finished(AveragingOptions(), 0, made_row(rng), 1.0)
    lost = Finished(AveragingOptions(frames=10), 0, {}, 1.0, "ValueError: no")
    assert answer([lost]).holds is None and answer([]).verdict == "no trial was finished"
    found = answer([one, lost])
    assert found.holds is None and found.verdict.startswith("too few trials to say: frames 30: ")
    assert found.verdict.endswith("1 of 2 trials failed")

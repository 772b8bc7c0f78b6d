"""The study of depth errors: its laws and trials, and answers that flip when data are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.depth_error import STUDY, DepthOptions, answer, trial
from experiments.depth_laws import DEPTHS_M, EFFECTS, LAWS, RADII, Effect, Pair, errors, exponent
from experiments.runner.protocol import Answer, Finished, Row
from experiments.runner.sweep import load_study, trials_of
from experiments.scatter import in_digits, mean_of, ratio_of, root_of, within
from experiments.stereo import as_estimate, parallel_pair, points_at, seen_by_both

CONFIG = Path(__file__).parents[1] / "configs/studies/depth_error.yaml"


# ---- laws ----------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", EFFECTS)
@settings(max_examples=5, deadline=None)
@given(st.floats(300, 2000), st.floats(0.05, 0.3))
def test_our_propagation_is_the_textbook(
    effect: Effect, focal_px: float, baseline_m: float
) -> None:
    """To the parallax that textbooks leave out: its square is 0.02 at 1 m."""
    found = errors(effect, Pair(focal_px, baseline_m, "straight", 0.1), 2, np.random.default_rng(0))
    np.testing.assert_allclose(found.propagated_m, found.closed_m, rtol=0.03)
    far = found.at >= 5 if LAWS[effect].over == "depth" else found.at >= 0
    np.testing.assert_allclose(found.propagated_m[far], found.closed_m[far], rtol=0.002)
    assert exponent(found.at, found.propagated_m) == pytest.approx(LAWS[effect].exponent, abs=0.05)


@pytest.mark.parametrize("effect", ["distortion", "distortion apart", "distortion shared"])
def test_a_barrel_lens_bends_the_law_as_its_closed_form(effect: Effect) -> None:
    found = errors(effect, Pair(600, 0.1, "barrel", 0.1), 2, np.random.default_rng(0))
    np.testing.assert_allclose(found.propagated_m, found.closed_m, rtol=2e-3)
    assert exponent(found.at, found.propagated_m) > LAWS[effect].exponent + 0.1


@pytest.mark.parametrize("effect", ["pixels", "focal apart", "distortion"])
def test_monte_carlo_has_the_propagated_sigma(effect: Effect) -> None:
    draws = 150
    found = errors(effect, Pair(800, 0.2, "straight", 0.1), draws, np.random.default_rng(3))
    ratio = found.rms_m / found.propagated_m
    np.testing.assert_allclose(ratio, 1.0, atol=4 / (2 * draws) ** 0.5)


def test_exponent_by_hand() -> None:
    assert exponent(DEPTHS_M, 0.3 * DEPTHS_M**2.5) == pytest.approx(2.5)


def test_points_lie_at_their_depth_in_both_images() -> None:
    rig = as_estimate(parallel_pair(500, 0.3, "barrel"))
    points = points_at(rig, 1.0, 20, np.random.default_rng(0))
    np.testing.assert_allclose(points[:, 2], 1.0)
    assert points.shape == (20, 3)
    size = np.array(rig.cameras[0].size)
    assert ((seen_by_both(rig, points) >= 0) & (seen_by_both(rig, points) < size)).all()
    with pytest.raises(ValueError, match=r"at 0\.1 m hardly a point is in both images"):
        points_at(rig, 0.1, 20, np.random.default_rng(0))


# ---- means ---------------------------------------------------------------------------------


def test_means_by_hand() -> None:
    assert mean_of(np.array([1.0, 3.0])) == (2.0, 1.0)
    assert mean_of(np.array([5.0])) == (5.0, None)
    assert root_of(np.array([3.0, 5.0])) == pytest.approx((2.0, 1 / 4))
    # all pairs have one ratio: nothing scatters
    assert ratio_of(np.array([[2.0, 1.0], [6.0, 3.0]])) == pytest.approx((2.0, 0.0))
    assert ratio_of(np.array([[2.0, 1.0], [6.0, 1.0]]))[1] == pytest.approx(2.0)
    assert in_digits((1.004, None)) == "1.00" and in_digits((1.0, 0.126), 1) == "1.0 ± 0.1"


def test_within_allows_for_chance() -> None:
    assert within((1.2, 0.1), 0.9, 1.0) and not within((1.2, 0.05), 0.9, 1.0)
    assert not within((1.2, None), 0.9, 1.0)


# ---- trials --------------------------------------------------------------------------------


@pytest.mark.parametrize("effect", ["pixels", "distortion shared"])
def test_trials_are_functions_of_their_seed(effect: Effect) -> None:
    options = DepthOptions(effect=effect, draws=3)
    row = trial(options, 4)
    assert row == trial(options, 4)
    assert row["rms_m"] != trial(options, 5)["rms_m"]


def test_a_scan_is_a_function_of_its_seed() -> None:
    options = DepthOptions(effect="scan", frames=10)
    row = trial(options, 1)
    assert row == trial(options, 1)
    z = np.array(row["z_square"])
    assert z.shape == DEPTHS_M.shape and (z > 0).all() and z.mean() < 10
    stated, actual = np.array(row["propagated_m"]), np.array(row["rms_m"])
    assert (np.diff(stated) > 0).all() and (actual < 5 * stated).all()
    assert 0.2 < float(np.mean(row["sigma_px"])) < 0.4  # type: ignore[arg-type]


def test_the_config_asks_for_every_law() -> None:
    trials = trials_of(load_study(CONFIG))
    assert {t.options.effect for t in trials} == {*EFFECTS, "scan"}  # type: ignore[attr-defined]
    assert STUDY.trial is trial


# ---- answers -------------------------------------------------------------------------------


def law_row(effect: Effect, rng: np.random.Generator, power: float = 0, size: float = 1.0) -> Row:
    """A trial that keeps to its law, or errs by another power or size than propagated."""
    law = LAWS[effect]
    at = DEPTHS_M if law.over == "depth" else RADII
    propagated = 0.01 * at**law.exponent
    rms = size * (1 + 0.02 * rng.standard_normal()) * propagated * (at / at.mean()) ** power
    return {
        "at": at.tolist(),
        "rms_m": rms.tolist(),
        "bias_m": (0 * rms).tolist(),
        "propagated_m": propagated.tolist(),
        "closed_m": propagated.tolist(),
        "exponent": exponent(at, rms),
        "exponent_propagated": exponent(at, propagated),
    }


def scan_row(rng: np.random.Generator, size: float = 1.0, noisy: float = 1.0) -> Row:
    sigma = 0.01 * DEPTHS_M**1.5
    z = size**2 * rng.chisquare(4, len(DEPTHS_M)) / 4
    return {
        "at": DEPTHS_M.tolist(),
        "rms_m": (np.sqrt(z) * sigma).tolist(),
        "bias_m": (0 * sigma).tolist(),
        "propagated_m": sigma.tolist(),
        "noise_m": sigma.tolist(),
        "z_square": z.tolist(),
        "z_square_total": (noisy**2 * rng.chisquare(30, len(DEPTHS_M)) / 30).tolist(),
        "exponent_propagated": 1.5,
        "sigma_px": 0.3,
    }


def answered(law: dict[str, float] | None = None, scan: dict[str, float] | None = None) -> Answer:
    """Of 20 trials each of a law over depth, one over radius, and scans."""
    rng = np.random.default_rng(0)
    rows: list[tuple[DepthOptions, Row]] = []
    for _ in range(20):
        rows += [(DepthOptions(effect=e), law_row(e, rng, **(law or {}))) for e in ("pixels",)]
        rows.append((DepthOptions(effect="distortion"), law_row("distortion", rng)))
        rows.append((DepthOptions(effect="scan"), scan_row(rng, **(scan or {}))))
    return answer([Finished(o, i, row, 1.0) for i, (o, row) in enumerate(rows)])


def test_a_law_that_holds() -> None:
    found = answered()
    assert found.holds is True
    assert found.verdict.startswith("yes: pixels Z^2.00") and "r^3.00" in found.verdict
    assert "20 calibrated scans: depth errors 0.95 ± 0.03 of their stated" in found.verdict
    assert [table.name for table in found.tables] == ["effects", "rigs"]
    assert [f.name for f in found.figures] == ["depth", "radius", "scan_depth", "scan_z"]
    row = found.tables[0].rows[0]
    assert row[0] == "pixels" and row[4] == 2 and row[5] == pytest.approx(2.0)
    assert row[-1] == 0


def test_a_bias_is_told() -> None:
    """Half of the RMS at the one point where it is most."""
    rng = np.random.default_rng(0)
    row = dict(law_row("pixels", rng))
    bias = 0.1 * np.array(row["rms_m"])
    bias[3] *= -5
    trials = [Finished(DepthOptions(effect="pixels"), 0, row | {"bias_m": bias.tolist()}, 1.0)]
    assert answer(trials).tables[0].rows[0][-1] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("law", "scan", "wrong"),
    [
        ({"power": -0.5}, None, "pixels"),
        ({"size": 1.2}, None, "pixels"),
        ({"size": 0.8}, None, "pixels"),
        (None, {"size": 1.5}, "scan"),
        (None, {"size": 0.6}, "scan"),
        (None, {"noisy": 1.3}, "scan"),
    ],
)
def test_answers_flip_when_the_data_are_wrong(
    law: dict[str, float] | None, scan: dict[str, float] | None, wrong: str
) -> None:
    found = answered(law, scan)
    assert found.holds is False and found.verdict.startswith("no: ")
    assert found.verdict.endswith(f"not as expected: {wrong}")


def test_few_and_failed_trials() -> None:
    rng = np.random.default_rng(0)
    one = Finished(DepthOptions(effect="pixels"), 0, law_row("pixels", rng), 1.0)
    lost = Finished(DepthOptions(effect="scan"), 0, {}, 1.0, "ValueError: no")
    assert answer([lost]).holds is None and answer([]).verdict == "no trial was finished"
    found = answer([one, lost])
    assert found.holds is None and found.verdict.startswith("too few trials to say: pixels Z^2.00")
    assert found.verdict.endswith("1 of 2 trials failed")
    scan = Finished(DepthOptions(effect="scan"), 0, scan_row(rng), 1.0)
    assert answer([scan]).holds is None

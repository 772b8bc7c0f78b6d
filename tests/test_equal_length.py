"""Curves whose crossing is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.equal_length import Curve, Equal, equal, first_below

IMAGES = (10, 20, 40, 80)


def curve(px_at_one: float, scatter: float = 0.0, seeds: int = 40, seed: int = 0) -> Curve:
    """Errors that fall with the root of the number of images, with some scatter between seeds."""
    rng = np.random.default_rng(seed)
    return Curve(
        {
            n: {s: px_at_one / n**0.5 * (1 + scatter * rng.standard_normal()) for s in range(seeds)}
            for n in IMAGES
        }
    )


@given(st.floats(11, 79))
def test_a_power_law_is_met_exactly(images: float) -> None:
    assert first_below(IMAGES, [n**-0.5 for n in IMAGES], images**-0.5) == pytest.approx(images)


def test_beyond_what_was_tried() -> None:
    assert first_below(IMAGES, [4, 3, 2, 1], 0.5) == float("inf")
    assert first_below(IMAGES, [4, 3, 2, 1], 4) == 0


def test_what_rises_again_has_not_come_down() -> None:
    assert first_below(IMAGES, [4, 1, 2, 1], 1.5) > 40
    assert first_below(IMAGES, [1, 1, 1, 2], 1.5) == float("inf")


def test_the_rms_and_its_chance_by_hand() -> None:
    two = Curve({5: {0: 3.0, 1: 4.0}})
    assert two.rms(5) == pytest.approx(12.5**0.5)
    # squares 9 and 16: their mean is known to 3.5, its root to 3.5 / (2 rms)
    assert two.rms_error(5) == pytest.approx(3.5 / (2 * 12.5**0.5))
    assert two.drawn([1, 1]).rms(5) == 4.0 and two.drawn([7]).images == ()
    assert Curve({5: {0: 3.0}}).rms_error(5) == float("inf")


def test_the_interval_holds_the_length_and_narrows_with_seeds() -> None:
    other = Curve({25: dict.fromkeys(range(200), 1.0)})
    few, many = (equal(curve(6.0, 0.3, n), other, 25) for n in (10, 200))
    for found in (few, many):
        assert found.interval[0] <= found.images <= found.interval[1]
    # 9 % are added to the squares by the scatter
    assert many.images == pytest.approx(36 * 1.09, rel=0.1)
    spread = [np.log(one.interval[1] / one.interval[0]) for one in (few, many)]
    assert spread[1] < spread[0] / 2
    assert many.interval[0] < 36 * 1.09 < many.interval[1] * 1.1


def test_in_words() -> None:
    assert str(Equal(47.3, (40.0, float("inf")), 10, 80)) == "47 (40 to more than 80)"
    assert str(Equal(0.0, (0.0, 11.8), 10, 80)) == "10 or fewer (10 or fewer to 12)"
    assert str(Equal(1e9, (float("inf"),) * 2, 10, 80)).startswith("1000000000 (more than 80 to")
    assert str(Equal(float("inf"), (float("inf"),) * 2, 10, 80)) == "more than 80"
    assert Equal(float("inf"), (20.0, float("inf")), 10, 80).short == "more than 80"

"""Times: the unit they are written in, and which images were taken together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_calib.errors import CalibrationError
from sfm_calib.timestamps import group_by_time, number_of, read_times

KALIBR = 1403636579763555584  # ns, as in EuRoC


def name(camera, place):
    return f"{camera}{place}"


def groups(tolerance_s=None, **times):
    return group_by_time({c: np.array(own, float) for c, own in times.items()}, tolerance_s, name)


@pytest.mark.parametrize(
    ("texts", "unit", "spacing_s"),
    [
        ([str(KALIBR + i * 50_000_000) for i in range(4)], "ns", 0.05),
        ([str(1403636579763555 + i * 33_333) for i in range(4)], "us", 0.033333),
        ([str(1403636579763 + i * 33) for i in range(4)], "ms", 0.033),
        ([str(1403636579 + i * 5) for i in range(4)], "s", 5),
        ([f"{1403636579 + i}.250000" for i in range(4)], "s", 1),
        (["1.40363657976355558e+18", "1.40363657981355558e+18"], "ns", 0.05),
        # since boot: after 1000 s, in units that would be since 1970 in another
        ([str(1_000_000_000_000 + i * 33_000_000) for i in range(4)], "ns", 0.033),
        ([str(1_000_000_000 + i * 33_000) for i in range(4)], "us", 0.033),
        ([str(i * 40) for i in range(4)], "ms", 0.04),
        ([str(i) for i in range(4)], "s", 1),
        (["0.0", "5.0", "10.0"], "s", 5),
        (["1700000000000000000"], "ns", None),
    ],
)
def test_the_unit_is_told_from_size_and_spacing(texts, unit, spacing_s):
    times = read_times({"left": texts, "right": texts[:1]})
    assert times.unit == unit and times.of["right"].tolist() == [0.0]
    if spacing_s is not None:
        assert np.diff(times.of["left"]) == pytest.approx(spacing_s, rel=1e-6)


def test_nanoseconds_are_kept_to_the_last_digit():
    times = read_times({"a": [str(KALIBR), str(KALIBR + 50_000_001)]})
    assert times.of["a"][1] == pytest.approx(0.050000001, abs=1e-12)


@pytest.mark.parametrize("text", ["", "a1", "1_000", "nan", "inf", "0x1", "1.2.3", "1e999"])
def test_what_is_no_number(text):
    assert number_of(text) is None
    with pytest.raises(ValueError, match="is no number"):
        read_times({"a": ["1", text]})


def test_the_nearest_are_matched_and_the_others_stand_alone():
    found = groups(left=[0.0, 1.0, 2.0, 3.0], right=[0.2, 1.9, 2.5])
    assert found.tolerance_s == pytest.approx(1 / 3)
    # 2.5 and 3.0 are half a second apart, and nothing is near 1.0
    assert found.images.tolist() == [[0, 0], [1, -1], [2, 1], [-1, 2], [3, -1]]
    assert found.n_alone == 3 and found.widest_s == pytest.approx(0.2)


def test_a_chain_of_cameras_is_no_moment_wider_than_the_tolerance():
    found = groups(0.1, a=[0.0], b=[0.08], c=[0.16])
    assert sorted(map(sorted, (found.images >= 0).tolist())) == sorted(
        [[False, True, True], [False, False, True]]
    )
    assert found.widest_s == pytest.approx(0.08)


def test_a_gap_of_just_the_tolerance_is_accepted():
    assert groups(0.1, a=[0.0, 0.7], b=[0.1, 0.8]).n_alone == 0


@given(
    st.lists(st.integers(0, 10_000), min_size=1, max_size=12, unique=True),
    st.lists(st.integers(0, 10_000), min_size=1, max_size=12, unique=True),
    st.lists(st.integers(0, 10_000), min_size=1, max_size=12, unique=True),
    st.integers(0, 60),
)
def test_groups_hold_every_image_once_and_lie_within_the_tolerance(a, b, c, tolerance):
    times = {n: np.array(own, float) for n, own in zip("abc", (a, b, c), strict=True)}
    try:
        found = group_by_time(times, tolerance, name)
    except CalibrationError:
        crowded = [np.diff(sorted(own)).min(initial=10**6) <= 2 * tolerance for own in (a, b, c)]
        assert any(crowded)
        return
    for column, own in enumerate(times.values()):
        places = found.images[:, column]
        assert sorted(places[places >= 0]) == list(range(len(own)))
    rows = [
        [own[p] for own, p in zip(times.values(), row, strict=True) if p >= 0]
        for row in found.images
    ]
    assert max(max(row) - min(row) for row in rows) == found.widest_s <= tolerance
    assert [min(row) for row in rows] == sorted(min(row) for row in rows)


def test_two_images_within_the_tolerance_of_a_third():
    with pytest.raises(CalibrationError, match=r"right: right1 and right0 both lie within 300 ms"):
        groups(0.3, left=[0.0, 1.0], right=[1.2, 0.9])
    with pytest.raises(CalibrationError, match=r"left0 and left2 were taken at the same time"):
        groups(0.0, left=[0.5, 1.0, 0.5])


def test_one_image_a_camera_needs_a_tolerance():
    with pytest.raises(CalibrationError, match="give tolerance_s"):
        groups(left=[0.0], right=[0.1])
    assert groups(0.2, left=[0.0], right=[0.1]).n_alone == 0

"""What an old calibration without sigmas is taken to be right to, and what a belief in it hides."""

from __future__ import annotations

import numpy as np
import pytest
from test_drift import rig

from graphs.drift import drift
from graphs.drift_picture import picture, share
from graphs.drift_tests import Criteria


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


def test_what_a_belief_in_the_old_lens_hides_is_not_called_found() -> None:
    old = rig("triple")
    usual = Criteria(depth_ranges=())
    plain = drift(old, old, usual)
    hidden = drift(old, old, usual, leaning={("cam1", "distortion"): 0.75})
    for before, after in zip(plain.tests, hidden.tests, strict=True):
        of_cam1 = before.cameras == (1,) and before.group in ("distortion", "lens")
        assert after.detectable_px == pytest.approx((4 if of_cam1 else 1) * before.detectable_px)
    nothing = drift(old, old, usual, leaning={("cam1", "distortion"): 1.0})
    assert (plain.verdict, nothing.verdict) == ("keep", "inconclusive")

"""What an old calibration without sigmas is taken to be right to."""

from __future__ import annotations

import numpy as np
import pytest
from test_drift import rig

from graphs.drift_picture import picture, share


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

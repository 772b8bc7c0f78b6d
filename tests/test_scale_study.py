"""The study of scale sources on a drive: what it says of them, and what comes out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic.scans import DATA

from experiments.scale_ledger import CASES, PAIRS, Options, main, positions, scale_of
from sfm_calib.config import FramesConfig


def test_distances_are_those_of_the_path(tmp_path: Path) -> None:
    places = np.column_stack([np.zeros(26), np.zeros(26), np.arange(26.0) ** 1.1])
    rows = [np.column_stack([np.eye(3), place]).ravel() for place in places]
    np.savetxt(tmp_path / "poses.txt", rows)
    np.testing.assert_allclose(positions(tmp_path / "poses.txt"), places)
    names = [f"{number:06d}" for number in range(26)]
    scale = scale_of(CASES[2], places, names)
    assert len(scale.frames) == len(PAIRS) and len(scale.baseline) == 1
    ends = [end for one in scale.frames for end in one.between]
    assert len(set(ends)) == 2 * len(PAIRS)
    first = scale.frames[0]
    assert isinstance(first, FramesConfig) and first.between == ("000000", "000025")
    assert first.length_m == pytest.approx(25.0**1.1)
    assert scale_of(CASES[0], places, names).frames == ()


@pytest.mark.slow
def test_a_baseline_three_per_cent_too_long_is_found_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = DATA / "street_stereo"
    if not folder.exists():
        pytest.skip("../shared/data/street_stereo is not on this machine")
    found = main(Options(folder, tmp_path))
    flagged = [calibration.rig.scale.contradicted for calibration in found]
    assert flagged == [False, False, False, True, True]
    assert [entry.suspect for entry in found[4].rig.scale.ledger] == [True] + [False] * 5
    assert "compromise" in capsys.readouterr().out

"""Drift as it is written and printed: records, words, the terminal, the page."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from test_drift import drawn, rig, turned

from graphs.compare import Stated
from graphs.covariance import NOTHING
from graphs.problem import Estimate
from sfm_calib.drift import EXIT_STATUS, DriftOptions, judge
from sfm_calib.drift_record import DriftRecord
from sfm_calib.drift_terminal import print_drift
from sfm_calib.errors import CalibrationError
from sfm_calib.report.drift import drift_section

NASTY = "<b>[red]&amp;"


def renamed(side: Stated, name: str) -> Stated:
    """A side without a covariance, its second camera called otherwise."""
    cameras = list(side.estimate.cameras)
    cameras[1] = replace(cameras[1], name=name)
    return Stated(replace(side.estimate, cameras=tuple(cameras)), NOTHING)


def printed(record: DriftRecord) -> str:
    console = Console(file=io.StringIO(), width=160, markup=False, highlight=False)
    print_drift(record, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert isinstance(text, str)
    return text


def test_a_turned_camera_in_words() -> None:
    side = rig("triple")
    record = judge(side, turned(side, 0, 0.2), "m").record
    assert record.verdict == "replace"
    assert record.drifted == ("cam0",)
    assert record.lines[0].startswith("Replace: cam0 points 0.20 deg elsewhere")
    assert record.lines[1] == "It is cam0 that moved: the others sit to each other as they sat"
    assert DriftRecord.model_validate_json(record.model_dump_json()) == record
    text = printed(record)
    assert "verdict: Replace" in text
    assert "cam0 and cam1" in text
    (row,) = (t for t in record.tests if t.cameras == ("cam0",) and t.group == "rotation")
    assert [one.name for one in row.changes] == ["rotation_x", "rotation_y", "rotation_z"]
    assert row.changes[1].change == pytest.approx(0.2, abs=1e-6)
    assert row.found


def test_two_cameras_in_words() -> None:
    side = rig("stereo")
    record = judge(side, turned(side, 1, 0.2), "baseline", scale_free=True).record
    assert record.lines[0].startswith("Replace: cam1 against cam0 points 0.20 deg elsewhere")
    assert "the picture cannot tell which moved" in record.lines[1]
    assert record.drifted == ()
    (note,) = record.notes
    assert note == "the two have no metric scale in common: the baseline's length is not judged"
    assert record.pairs[0].baseline_percent is None


def test_an_old_file_without_sigmas_is_given_some_and_that_is_said() -> None:
    side = rig("triple")
    exact = Stated(side.estimate, NOTHING)
    record = judge(exact, side, "m", DriftOptions(old_sigma_px=0.1)).record
    assert record.verdict == "keep"
    assert record.old_sigma_px == 0.1
    assert "states no covariance" in record.notes[0]
    vague = judge(exact, side, "m", DriftOptions(old_sigma_px=1.0)).record
    assert vague.verdict == "inconclusive"
    assert "another scan would not help" in vague.lines[-1]


def test_a_weak_scan_says_what_it_could_not_see_and_what_would() -> None:
    rng = np.random.default_rng(2)
    record = judge(rig("triple"), drawn(rig("triple", 1.5), rng), "m").record
    assert record.verdict == "inconclusive"
    assert "may have drifted by" in record.lines[0]
    assert any(line.startswith("to see more") for line in record.lines)
    assert record.detectable_px > record.matters_px


def test_names_from_outside_are_text_wherever_they_are_shown() -> None:
    side = renamed(rig("triple"), NASTY)
    new = renamed(turned(rig("triple"), 1, 0.5), NASTY)
    record = judge(side, new, "m").record
    page = str(drift_section(record))
    assert NASTY not in page
    assert "&lt;b&gt;[red]&amp;amp;" in page
    assert NASTY in printed(record)


def test_one_camera_has_neither_places_nor_depths() -> None:
    whole = rig("stereo").estimate
    alone = Estimate(whole.cameras[:1], whole.cam_from_rig[:1], (), np.zeros((0, 3)))
    record = judge(Stated(alone, NOTHING), Stated(alone, NOTHING), "baseline").record
    assert not record.pairs
    assert "drift-depth" not in str(drift_section(record))


def test_verdicts_have_exit_statuses_of_their_own() -> None:
    assert EXIT_STATUS["keep"] == 0
    assert len(set(EXIT_STATUS.values()) | {1, 2}) == 5


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"matters_px": 0.0}, r"--matters-px 0: it must be positive"),
        ({"systematic_px": -1.0}, r"--systematic-px -1: it must be 0 or more"),
        ({"alpha": 0.7}, r"--alpha 0\.7: it must be between"),
        ({"old_sigma_px": np.inf}, r"--old-sigma-px inf"),
        ({"depth_ranges": (1.0, -2.0)}, r"--depth-ranges -2: it must be positive"),
    ],
)
def test_impossible_options_are_refused(given: dict[str, float], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        DriftOptions(**given)  # type: ignore[arg-type]


def test_few_frames_are_told_in_the_record() -> None:
    side = rig("triple")
    new = drawn(side, np.random.default_rng(6))
    many, few = (judge(side, new, "m", n_frames=n).record for n in (None, 6))
    assert {test.nu for test in many.tests} == {None}
    for one, other in zip(many.tests, few.tests, strict=True):
        assert other.nu is not None
        assert other.nu >= 5
        assert other.p_value != one.p_value
        assert other.detectable_px > one.detectable_px
    assert DriftRecord.model_validate_json(few.model_dump_json()) == few

"""What is said of measured lengths: in the verdict, in the file, in the terminal, on the page."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from test_report import scene
from test_result import rig

from graphs.scale_ledger import LedgerEntry, ScaleLedger
from sfm_calib.report.page import write_report
from sfm_calib.report.scale_ledger import ledger_section
from sfm_calib.result import Calibration, Scale, load_calibration, save_calibration
from sfm_calib.scale_ledger import COMPROMISE, contradiction, entries_of
from sfm_calib.terminal import print_result

BASELINE = LedgerEntry("baseline left to right", 0.554, 0.001, 0.5412, 0.53834, 0.0012)
PATH = LedgerEntry("distance from frame 0 to frame 50", 44.72, 0.07, 45.0, 46.02, 0.12)
MARKS = LedgerEntry("distance between two clicked marks", 2.5, 0.01, 2.504, 2.506, 0.02)
FINE = replace(PATH, predicted_m=44.8)
ALONE = LedgerEntry("baseline left to right", 0.537, 0.001, 0.537)
AGREEING = ScaleLedger((replace(BASELINE, predicted_m=0.553), FINE, MARKS))
TWO = ScaleLedger((BASELINE, PATH), (0, 1))
ONE_OF_THREE = ScaleLedger((BASELINE, FINE, MARKS), (0,))


@pytest.mark.parametrize("ledger", [ScaleLedger(()), ScaleLedger((ALONE,)), AGREEING])
def test_where_lengths_agree_nothing_is_said(ledger: ScaleLedger) -> None:
    assert contradiction(ledger) == [] and not ledger.contradicted
    assert not any(entry.contradicts or entry.suspect for entry in entries_of(ledger))


SAID = {
    "of two, either": (
        TWO,
        "the baseline left to right of 0.5540 m contradicts the distance from frame 0 to frame 50 "
        "of 44.720 m (z 10.0): by the second the first is 0.5383 +- 0.0012 m, by the first the "
        "second is 46.02 +- 0.12 m; either may be wrong: measure both again; ",
    ),
    "of three, the one": (
        ONE_OF_THREE,
        "the baseline left to right of 0.5540 m contradicts the distance from frame 0 to frame 50 "
        "and the distance between two clicked marks: by them it is 0.5383 +- 0.0012 m (z 10.0), "
        "and without it they agree; measure it again or take it out of rig.yaml; ",
    ),
    "of many, the one": (
        ScaleLedger((BASELINE, FINE, MARKS, MARKS), (0,)),
        "the distance from frame 0 to frame 50 and 2 more: by them it is",
    ),
    "of three, one of two": (
        ScaleLedger((BASELINE, PATH, MARKS), (0, 1)),
        "measured lengths contradict each other: the baseline left to right (0.5540 m; by the "
        "others 0.5383 +- 0.0012 m, z +10.0), the distance from frame 0 to frame 50 (44.720 m; by "
        "the others 46.02 +- 0.12 m, z -9.4); without any single one of the baseline left to right "
        "and the distance from frame 0 to frame 50 the others agree: measure these again; ",
    ),
    "no single one": (
        ScaleLedger((BASELINE, PATH, MARKS), ()),
        "; leaving out any single one does not reconcile them: measure all again; ",
    ),
    "very many": (ScaleLedger((BASELINE, *[PATH] * 5), ()), "z -9.4) and 2 more; leaving out"),
    "alone, against the nominal rig": (
        ScaleLedger((BASELINE,), (0,)),
        "contradicts cam_from_rig as rig.yaml states it: by them it is 0.5383 +- 0.0012 m (z 10.0);"
        " measure it again",
    ),
}


@pytest.mark.parametrize(("ledger", "said"), SAID.values(), ids=SAID)
def test_a_contradiction_is_one_line_with_numbers_and_a_remedy(
    ledger: ScaleLedger, said: str
) -> None:
    (message,) = contradiction(ledger)
    assert said in message and message.endswith(COMPROMISE) and "\n" not in message


def test_an_entry_says_what_the_others_predict() -> None:
    wrong, path = entries_of(TWO)
    assert (wrong.what, wrong.measured_m, wrong.sigma_m) == (BASELINE.name, 0.554, 0.001)
    assert wrong.residual_m == pytest.approx(-0.0128)
    assert wrong.residual_percent == pytest.approx(-2.3105, abs=1e-4)
    assert wrong.z == pytest.approx((0.554 - 0.53834) / (0.001**2 + 0.0012**2) ** 0.5)
    assert wrong.p_value is not None and wrong.p_value < 1e-20
    assert wrong.contradicts and path.contradicts and wrong.suspect and path.suspect
    (alone,) = entries_of(ScaleLedger((ALONE,)))
    assert (alone.predicted_by_others_m, alone.z, alone.p_value) == (None, None, None)


def test_p_is_of_a_normal_z() -> None:
    entry = LedgerEntry("", 1.0, 0.01, 1.0, 1.0 - 0.0196, 0.0)
    assert entry.p_value == pytest.approx(0.05, abs=1e-4)
    assert replace(entry, predicted_m=1.0 + 0.0196).p_value == pytest.approx(0.05, abs=1e-4)


# ---- in the file ----------------------------------------------------------------------------


def result_of(ledger: ScaleLedger) -> Calibration:
    scale = Scale(
        source="baseline left to right: 0.554 m",
        sigma_relative=0.002,
        contradicted=ledger.contradicted,
        ledger=entries_of(ledger),
    )
    return rig().model_copy(update={"rig": rig().rig.model_copy(update={"scale": scale})})


def test_the_ledger_is_read_again(tmp_path: Path) -> None:
    for ledger in (TWO, AGREEING, ScaleLedger((ALONE,))):
        save_calibration(result_of(ledger), tmp_path / "calibration.json")
        assert load_calibration(tmp_path / "calibration.json") == result_of(ledger)


def test_files_from_before_there_was_one_are_read(tmp_path: Path) -> None:
    content = json.loads(rig().model_dump_json())
    content["rig"]["scale"] = {"source": "baseline a to b: 0.2 m", "sigma_relative": 0.005}
    (tmp_path / "old.json").write_text(json.dumps(content))
    scale = load_calibration(tmp_path / "old.json").rig.scale
    assert scale.ledger == () and not scale.contradicted


# ---- shown ----------------------------------------------------------------------------------


def printed(calibration: Calibration) -> list[str]:
    file = io.StringIO()
    console = Console(
        file=file, width=80, markup=False, emoji=False, highlight=False, color_system=None
    )
    print_result(calibration, console)
    return file.getvalue().splitlines()


def test_the_terminal_shows_lengths_that_test_each_other() -> None:
    lines = printed(result_of(ONE_OF_THREE))
    start = lines.index("3 measured lengths CONTRADICT each other")
    table = lines[start + 1 : start + 12]
    assert max(map(len, table)) <= 80
    whole = " ".join(" ".join(table).split())
    for part in ("0.5540", "0.0010", "0.5412", "0.5383", "0.0012", "+10.0", "44.720", "2.500"):
        assert part in whole
    assert "3 measured lengths agree" in printed(result_of(AGREEING))
    assert not any("measured" in line for line in printed(result_of(ScaleLedger((ALONE,)))))


def test_the_page_lists_every_source() -> None:
    section = ledger_section(result_of(ONE_OF_THREE))
    assert section is not None and "compromise" in section.summary
    first, second, _ = section.rows
    assert (first.measured, first.sigma, first.estimated) == ("0.5540", "0.0010", "0.5412")
    assert (first.residual_mm, first.residual_percent) == ("-12.8", "-2.3")
    assert (first.predicted, first.sigma_predicted, first.z) == ("0.5383", "0.0012", "+10.0")
    assert first.contradicts and first.flag == "may be wrong" and second.flag == ""
    agreeing = ledger_section(result_of(AGREEING))
    assert agreeing is not None and "agree" in agreeing.summary
    alone = ledger_section(result_of(ScaleLedger((ALONE,))))
    assert alone is not None and "nothing tests it" in alone.summary
    assert (alone.rows[0].predicted, alone.rows[0].z, alone.rows[0].p_value) == ("–",) * 3
    assert ledger_section(rig()) is None


def test_the_page_has_a_section_of_measured_lengths(tmp_path: Path) -> None:
    problem, estimate = scene(("left", "right"), np.random.default_rng(0))
    for ledger in (ONE_OF_THREE, ScaleLedger(())):
        write_report(result_of(ledger), problem, estimate, tmp_path / "report.html")
        text = (tmp_path / "report.html").read_text()
        for part in ('<section id="scale">', ">may be wrong<", ">+10.0<", ">0.5383<", "compromise"):
            assert (part in text) == bool(ledger.entries)

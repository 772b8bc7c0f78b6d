"""What the trials of `depth_camera_cabin` say: three questions, and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from experiments.cabin_cases import (
    ADDED,
    BOARDS,
    FACTORY,
    FEWEST,
    LOOSE,
    NOTHING,
    SCAN,
    TRUTH,
    Cases,
    Trials,
    by_case,
    cell,
    common,
    is_lost,
    is_refused,
    is_swept,
    mean,
    number,
    paired,
    share,
)
from experiments.cabin_figures import PUBLISHED_FUSED, figures
from experiments.cabin_model import FAILED_MM
from experiments.runner.protocol import Answer, AnswerTable

# The published study, as the project's plan quotes it, in mm.
PUBLISHED_FACTORY, PUBLISHED_CALIBRATED = (3.02, 3.84), (2.18, 2.95)  # mean, RMS
AS_GOOD = 1.1  # RMS with a scan and a board over that with boards, at most
OFTEN = 0.5  # share of cabins whose places by hand do not register
STANDARD_ERRORS = 3.0
# Of a share's interval: of eight cabins three standard errors would leave even all of them open.
CONFIDENCE = 0.95


def answer(trials: Trials) -> Answer:
    """Every case beside the others, and the three questions."""
    cases = by_case([one for one in trials if one.error is None])
    if not cases:
        return Answer("no trial was finished", None)
    said, verdicts = [], []
    for question in (improved, fails_by_hand, scan_for_boards):
        words, holds = question(cases)
        said.append(words)
        verdicts.append(holds)
    known = [one for one in verdicts if one is not None]
    holds = None if len(known) < len(verdicts) else all(known)
    lead = "unsaid" if holds is None else "yes" if holds else "in part" if any(known) else "no"
    refused = sum(one.error is not None for one in trials)
    less = f"; {refused} of {len(trials)} trials failed" if refused else ""
    return Answer(f"{lead}: {'; '.join(said)}{less}", holds, tables(cases), figures(cases))


# ---- the questions -------------------------------------------------------------------------


def improved(cases: Cases) -> tuple[str, bool | None]:
    """Whether calibrated lenses, and lenses and places, make the model better."""
    if BOARDS not in cases or NOTHING not in cases or FACTORY not in cases:
        return "what calibration improves is unsaid", None
    whole, of_lenses = (paired(cases[name], cases[BOARDS], "rms_mm") for name in (NOTHING, FACTORY))
    before, lenses, after = (mean(cases[name], "rms_mm")[0] for name in (NOTHING, FACTORY, BOARDS))
    words = (
        f"the head's RMS falls from {before:.1f} mm uncalibrated to {after:.2f} mm by boards "
        f"(by lenses alone from {lenses:.1f})"
    )
    if TRUTH in cases:
        words += f", and is {mean(cases[TRUTH], 'rms_mm')[0]:.2f} mm by noise alone"
    return words, beyond_chance([whole, of_lenses])


def beyond_chance(differences: Sequence[tuple[float, float]]) -> bool | None:
    """Whether all (mean, standard error) are above zero by more than chance."""
    if not all(np.isfinite(error) for _, error in differences):
        return None
    return all(mean > STANDARD_ERRORS * error for mean, error in differences)


def fails_by_hand(cases: Cases) -> tuple[str, bool | None]:
    """Whether places by hand often fail to register."""
    if NOTHING not in cases:
        return "whether places by hand register is unsaid", None
    trials = cases[NOTHING]
    failed = sum(is_lost(one) for one in trials)
    words = f"from places by hand {failed} of {len(trials)} heads fail to register"
    interval = stats.binomtest(failed, len(trials)).proportion_ci(CONFIDENCE)  # Clopper-Pearson
    if len(trials) < FEWEST or interval.low < OFTEN < interval.high:
        return f"{words} (too few cabins to say whether often)", None
    return words, bool(interval.low >= OFTEN)


def scan_for_boards(cases: Cases) -> tuple[str, bool | None]:
    """Whether a scan with one board does what boards do."""
    if BOARDS not in cases or ADDED not in cases:
        return "what a scan is worth is unsaid", None
    of_boards, of_added = common(cases[BOARDS], cases[ADDED], "rms_mm")
    boards, added = (mean(some, "rms_mm")[0] for some in (of_boards, of_added))
    more, error = paired(of_added, of_boards, "rms_mm")
    words = f"a scan with one board reaches {added:.2f} mm"
    for name, what in ((SCAN, "with a tape"), (LOOSE, "without any length")):
        if name in cases:
            words += f", {what} {mean(cases[name], 'rms_mm')[0]:.2f}"
    room, chance = (AS_GOOD - 1) * boards, STANDARD_ERRORS * error
    if more + chance <= room:
        return words, True
    if more - chance > room:
        return words, False
    return f"{words} (too few cabins to say whether as good)", None


# ---- tables --------------------------------------------------------------------------------


def tables(cases: Cases) -> tuple[AnswerTable, ...]:
    """A row a case in all of them."""
    return (model_table(cases), registration_table(cases), device_table(cases), sigma_table(cases))


def model_table(cases: Cases) -> AnswerTable:
    """The fused model by each case, as its places have it."""
    rows = [
        (
            name,
            len(trials),
            cell(mean(trials, "mean_mm")[0]),
            cell(mean(trials, "rms_mm")[0]),
            cell(mean(trials, "rms_mm")[1]),
            cell(mean(trials, "p95_mm")[0]),
            cell(mean(trials, "max_mm")[0]),
            cell(mean(trials, "hausdorff_mm")[0]),
            cell(mean(trials, "misplaced_mm")[0]),
        )
        for name, trials in cases.items()
    ]
    published = (
        "published",
        None,
        *PUBLISHED_FUSED[:2],
        None,
        None,
        PUBLISHED_FUSED[2],
        None,
        None,
    )
    return AnswerTable(
        "model",
        "Distance of the fused model to the head, mm: means over cabins",
        ("case", "cabins", "mean", "RMS", "±", "95 %", "largest", "Hausdorff", "part misplaced"),
        (*rows, published),
    )


def registration_table(cases: Cases) -> AnswerTable:
    """What ICP of the parts with each other makes of the same models."""
    rows = [
        (
            name,
            cell(mean(trials, "rms_mm")[0]),
            cell(mean(trials, "registered_rms_mm")[0]),
            cell(mean(trials, "registered_rms_mm")[1]),
            cell(mean(trials, "misplaced_mm")[0]),
            cell(mean(trials, "registered_misplaced_mm")[0]),
            cell(100 * share(trials, is_lost)),
            cell(100 * share(trials, is_refused)),
        )
        for name, trials in cases.items()
    ]
    columns = (
        "case", "RMS as placed, mm", "RMS by ICP", "±", "misplaced as placed", "misplaced by ICP",
        "failed, %", "a part refused, %",
    )  # fmt: skip
    title = f"The same after ICP between the parts; failed: a part over {FAILED_MM:g} mm misplaced"
    return AnswerTable("registration", title, columns, tuple(rows))


def device_table(cases: Cases) -> AnswerTable:
    """Single devices: what lenses alone do."""
    columns = ("infrared_mean_mm", "infrared_rms_mm", "colour_mean_mm", "colour_rms_mm")
    rows = [
        (name, *(cell(mean(trials, column)[0]) for column in columns))
        for name, trials in cases.items()
        if not is_swept(trials)
    ]
    return AnswerTable(
        "devices",
        "Clouds of single devices, each laid on the head by itself, mm",
        ("case", "infrared mean", "infrared RMS", "depth in colour: mean", "RMS"),
        (
            *rows,
            ("published, factory", *PUBLISHED_FACTORY, None, None),
            ("published, calibrated", *PUBLISHED_CALIBRATED, None, None),
        ),
    )


def sigma_table(cases: Cases) -> AnswerTable:
    """Errors of the calibration itself, and whether its sigmas say so."""
    rows = []
    for name, trials in cases.items():
        if not any(np.isfinite(number(one, "nees")) for one in trials):
            continue
        nees, error = mean(trials, "nees")
        rows.append((
            name,
            cell(mean(trials, "infrared_focal_px")[0]),
            cell(mean(trials, "infrared_centre_px")[0]),
            cell(mean(trials, "colour_focal_px")[0]),
            cell(mean(trials, "colour_centre_px")[0]),
            cell(mean(trials, "turn_deg")[0]),
            cell(mean(trials, "shift_mm")[0]),
            cell(nees),
            cell(error),
            cell(100 * mean(trials, "covered")[0]),
            cell(mean(trials, "seconds_calibration")[0]),
        ))  # fmt: skip
    columns = (
        "case", "infrared fx, px", "centre", "colour fx, px", "centre", "side devices turned, deg",
        "shifted, mm", "NEES", "±", "95 % intervals that hold, %", "seconds",
    )  # fmt: skip
    title = "Errors of the calibration (rms), and whether its sigmas hold (NEES 1)"
    return AnswerTable("calibration", title, columns, tuple(rows))

"""Checks of the sigmas themselves, a sentence each: halves of the scan, and its simulated twins."""

from __future__ import annotations

from dataclasses import dataclass

from sfm_calib.result import Certificate, Split, Verdict


@dataclass(frozen=True)
class Check:
    """What was compared, with its numbers, and whether the sigmas stood it."""

    title: str
    holds: bool
    text: str  # plain ASCII but for names: terminals print it too


def checks_of(verdict: Verdict | None) -> tuple[Check, ...]:
    """The checks that were made; none for a truth or a result from before there were any."""
    if verdict is None:
        return ()
    made = []
    if verdict.split is not None:
        made.append(_of_split(verdict.split))
    if verdict.certificate is not None:
        made.append(_of_twins(verdict.certificate))
    return tuple(made)


def _of_split(split: Split) -> Check:
    return Check(
        "Two halves of the frames",
        split.agrees,
        f"calibrated alone, they project {split.difference_px:.2f} px apart (rms), and their "
        f"sigmas predict {split.expected_px:.2f} px (p = {split.p_value:.2g}): they "
        f"{'agree' if split.agrees else 'DISAGREE'}",
    )


def _of_twins(twins: Certificate) -> Check:
    within = round(twins.least_coverage * twins.trials)
    lost = f"; {twins.failed} more could not be solved" if twins.failed else ""
    return Check(
        f"{twins.trials} simulated twins of the scan",
        twins.holds,
        f"squared errors are {twins.nees:.2f} times what the sigmas say (standard error "
        f"{twins.nees_standard_error:.2f}), and 95 % intervals hold "
        f"{100 * twins.coverage:.0f} % of the truths ({twins.least_covered}: {within} of "
        f"{twins.trials}){lost}: the sigmas {'hold' if twins.holds else 'DO NOT HOLD'} "
        "for this geometry and noise",
    )

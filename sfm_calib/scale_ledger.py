"""The ledger of measured lengths in words: for the result file, and for the verdict."""

from __future__ import annotations

import numpy as np

from graphs.boards import LEAST_SIGMA, shape_of
from graphs.keys import shape_key
from graphs.scale_ledger import LedgerEntry, ScaleLedger, SourceRow, scale_ledger
from sfm_calib.report.digits import decimals_for, number
from sfm_calib.result import ScaleEntry
from sfm_calib.run import Run
from sfm_calib.scale import name_of

SHOWN = 4  # contradicting lengths that one message can hold
COMPROMISE = "until then all lengths are a compromise, and their sigmas do not allow for it"


def ledger_of(run: Run) -> ScaleLedger:
    """Every measured length of a run; what the data add is widened as the sigmas stated are.

    Raises ValueError as `model_covariance`.
    """
    refinement, covariance = run.refinement, run.covariance
    problem = refinement.problem
    names = [name_of(source, problem) for source in problem.scales]
    return scale_ledger(
        refinement.graph, refinement.estimate, refinement.values, names, covariance.inflation,
        _of_board(run),
    )  # fmt: skip


def _of_board(run: Run) -> tuple[SourceRow, ...]:
    """The stated size of the board's squares, where it gives the rig its lengths."""
    problem, estimate = run.refinement.problem, run.refinement.estimate
    if problem.board is None or run.board is None or not problem.board_gives_scale:
        return ()
    unit_m = run.board.board.unit_m
    relative = max(float(problem.board.board.shape_sigma[0]), LEAST_SIGMA)  # as in the graph
    grown = float(shape_of(estimate, problem.board.board)[0] - problem.board.board.shape_mean[0])
    layout = run.refinement.graph.layout
    row = np.zeros(layout.elimination.n_columns)
    row[layout.columns(shape_key())[0]] = 1 / relative
    return (
        SourceRow(
            f"square of the board ({1e3 * unit_m:g} mm)", unit_m, relative * unit_m,
            unit_m * float(np.exp(grown)), 0.0, row, grown / relative,
        ),
    )  # fmt: skip


def entries_of(ledger: ScaleLedger) -> tuple[ScaleEntry, ...]:
    """The ledger as the result file holds it."""
    return tuple(
        ScaleEntry(
            what=one.name,
            measured_m=one.measured_m,
            sigma_m=one.sigma_m,
            estimated_m=one.estimated_m,
            residual_percent=100 * (one.estimated_m / one.measured_m - 1),
            predicted_by_others_m=one.predicted_m,
            sigma_predicted_m=one.sigma_predicted_m,
            z=one.z,
            p_value=one.p_value,
            contradicts=one.contradicts,
            suspect=index in ledger.suspects,
        )
        for index, one in enumerate(ledger.entries)
    )


def contradiction(ledger: ScaleLedger) -> list[str]:
    """What to say of lengths that contradict each other: one message, or none where they agree."""
    if not ledger.contradicted:
        return []
    if len(ledger.suspects) == 1:
        return [_of_one(ledger)]
    if len(ledger.entries) == 2:
        return [_of_two(*ledger.entries)]
    flagged = sorted(
        (one for one in ledger.entries if one.contradicts), key=lambda one: -abs(one.z or 0.0)
    )
    listed = ", ".join(f"the {one.name} ({_beside(one)})" for one in flagged[:SHOWN])
    more = f" and {len(flagged) - SHOWN} more" if len(flagged) > SHOWN else ""
    named = " and ".join(f"the {ledger.entries[i].name}" for i in ledger.suspects)
    told = (
        f"without any single one of {named} the others agree: measure these again"
        if ledger.suspects
        else "leaving out any single one does not reconcile them: measure all again"
    )
    return [f"measured lengths contradict each other: {listed}{more}; {told}; {COMPROMISE}"]


def _of_two(first: LedgerEntry, second: LedgerEntry) -> str:
    a, b = (f"the {one.name} of {_metres(one.measured_m, one.sigma_m)}" for one in (first, second))
    return (
        f"{a} contradicts {b} (z {abs(first.z or 0.0):.1f}): by the second the first is "
        f"{_predicted(first)}, by the first the second is {_predicted(second)}; either may be "
        f"wrong: measure both again; {COMPROMISE}"
    )


def _of_one(ledger: ScaleLedger) -> str:
    wrong = ledger.entries[ledger.suspects[0]]
    others = [one for one in ledger.entries if one is not wrong]
    whom = f"the {others[0].name}" if others else "cam_from_rig as rig.yaml states it"
    if len(others) > 1:
        rest = len(others) - 1
        whom += f" and the {others[1].name}" if rest == 1 else f" and {rest} more"
    agree = ", and without it they agree" if len(others) > 1 else ""
    return (
        f"the {wrong.name} of {_metres(wrong.measured_m, wrong.sigma_m)} contradicts {whom}: by "
        f"them it is {_predicted(wrong)} (z {abs(wrong.z or 0.0):.1f}){agree}; measure it again or "
        f"take it out of rig.yaml; {COMPROMISE}"
    )


def _beside(one: LedgerEntry) -> str:
    return (
        f"{_metres(one.measured_m, one.sigma_m)}; by the others {_predicted(one)}, "
        f"z {one.z or 0.0:+.1f}"
    )


def _predicted(one: LedgerEntry) -> str:
    sigma_m = one.sigma_predicted_m or 0.0
    decimals = decimals_for(sigma_m)
    return f"{number(one.predicted_m or 0.0, decimals)} +- {number(sigma_m, decimals)} m"


def _metres(length_m: float, sigma_m: float) -> str:
    return f"{number(length_m, decimals_for(sigma_m))} m"

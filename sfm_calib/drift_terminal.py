"""What a person sees of a drift test: each group of each camera, depths, the verdict."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from sfm_calib.compare_record import PairDifference
from sfm_calib.drift_record import DriftRecord
from sfm_calib.drift_verdict import p_text, size_text, who
from sfm_calib.report.digits import at_range, short, signed_percent
from sfm_calib.terminal import print_line, table_of

NONE = "-"


def print_drift(record: DriftRecord, console: Console) -> None:
    """Tables, notes, and the verdict last."""
    console.print(_tests(record))
    if any(pair.depth for pair in record.pairs):
        console.print(_depths(record.pairs, record.unit))
    print_line(
        console,
        f"drift in px rms over the image, of moves at {at_range(record.range, record.unit)}; p "
        f"corrected for {len(record.tests)} tests; found from: so much is found in any direction "
        f"by {100 * record.power:g} % of scans like this one, far less in well-known directions; "
        f"{record.systematic_px:g} px are allowed beside the sigmas",
    )
    for note in record.notes:
        print_line(console, f"note: {note}")
    for number, line in enumerate(record.lines):
        print_line(console, f"verdict: {line}" if number == 0 else f"  {line}")


def _tests(record: DriftRecord) -> Table:
    table = table_of("new less old", "drift", "by chance", "found from", "p", "changed by")
    current = ""
    for test in record.tests:
        if who(test) != current:
            current = who(test)
            table.add_section()
            table.add_row(current, style="bold")
        table.add_row(
            f"  {test.group}",
            short(test.effect_px),
            short(test.expected_px),
            short(test.detectable_px),
            p_text(test.p_corrected).removeprefix("p = ").removeprefix("p "),
            size_text(test),
            style="bold red" if test.found else "",
        )
    return table


def _depths(pairs: Sequence[PairDifference], unit: str) -> Table:
    table = table_of("depths by old, new true", "range", "median", "worst", "middle", "sigma")
    for pair in pairs:
        for index, one in enumerate(pair.depth):
            numbers = (one.median_percent, one.worst_percent, one.middle_percent)
            cells = (
                (one.missing, "", "", "")
                if one.missing
                else (
                    *(NONE if v is None else signed_percent(v) for v in numbers),
                    NONE if one.sigma_percent is None else f"{short(one.sigma_percent)} %",
                )
            )
            table.add_row(
                " and ".join(pair.cameras) if index == 0 else "",
                at_range(one.range, unit),
                *cells,
                end_section=index == len(pair.depth) - 1,
            )
    return table

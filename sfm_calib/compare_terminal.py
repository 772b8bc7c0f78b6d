"""What a person sees of a comparison: parameters, the picture, pairs and depths, the verdict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.table import Table

from sfm_calib.compare_record import Comparison, PairDifference, ParameterDifference
from sfm_calib.compare_verdict import p_text, px_text
from sfm_calib.report.digits import at_range, short, sigma_text, signed_percent, with_digits
from sfm_calib.terminal import SUSPICIOUS_Z, print_line, table_of

NONE = "-"


def print_compared(record: Comparison, console: Console) -> None:
    """Tables, notes, and the verdict last."""
    for letter, side in (("A", record.a), ("B", record.b)):
        print_line(console, f"{letter}: {side.path} ({side.format}: {', '.join(side.cameras)})")
    console.print(_parameters(record))
    console.print(_projections(record))
    if record.pairs:
        console.print(_places(record))
        if any(pair.depth for pair in record.pairs):
            console.print(_depths(record))
    if (chance := record.chance) is not None:
        print_line(
            console,
            f"chi-square {chance.chi2:.1f} in {chance.rank} directions of the picture that can be "
            f"judged, of {chance.n_parameters} parameters with sigmas; {p_text(chance)}; "
            f"{px_text(chance.outside_px)} rms lie where no sigma reaches",
        )
    print_line(console, f"taken out: {taken_out(record)}")
    for note in record.notes:
        print_line(console, f"note: {note}")
    for number, line in enumerate(record.verdict.lines):
        print_line(console, f"verdict: {line}" if number == 0 else f"  {line}")


def taken_out(record: Comparison) -> str:
    """The change of frames in words."""
    if record.unit is None:
        turns = [
            f"{change.cameras[0]} {short(_length(change.rotation_deg))} deg"
            for change in record.taken_out
        ]
        return f"a rotation of each camera ({', '.join(turns)})"
    change = record.taken_out[0]
    scale = "" if change.scale is None else f"; A's unit of length is {change.scale:.5g} of B's"
    return (
        f"one change of frames for all cameras: {short(_length(change.rotation_deg))} deg, "
        f"{short(_length(change.translation))} {record.unit}{scale}"
    )


def _length(vector: Sequence[float]) -> float:
    return float(sum(x * x for x in vector) ** 0.5)


def _parameters(record: Comparison) -> Table:
    table = table_of("", "A", "B", "B - A", "sigma", "z", "")
    current = ""
    for row in record.parameters:
        camera, _, parameter = row.name.rpartition(".")
        if camera != current and f"{camera}.fx" == row.name:
            current = camera
            table.add_section()
            table.add_row(camera, style="bold")
        sigma = float((row.sigma_a**2 + row.sigma_b**2) ** 0.5)
        table.add_row(
            f"  {parameter}" if current == camera else row.name,
            with_digits(row.a, sigma),
            with_digits(row.b, sigma),
            with_digits(row.difference, sigma, "+"),
            sigma_text(sigma) if sigma > 0 else NONE,
            NONE if row.z is None else f"{row.z:+.1f}",
            row.unit,
            style="bold red" if _stands_out(row) else "",
        )
    return table


def _stands_out(row: ParameterDifference) -> bool:
    return row.z is not None and abs(row.z) > SUSPICIOUS_Z


def _projections(record: Comparison) -> Table:
    table = table_of("in the picture, px", "range", "mean", "rms", "most", "centre", "corner")
    for name, told in record.projection.items():
        for index, one in enumerate(told):
            table.add_row(
                name if index == 0 else "",
                at_range(one.range, record.unit),
                *(short(value) for value in (one.mean_px, one.rms_px, one.max_px)),
                *(NONE if v is None else short(v) for v in (one.centre_px, one.corner_px)),
                end_section=index == len(told) - 1,
            )
    return table


def _places(record: Comparison) -> Table:
    table = table_of("", "turned by deg", "sigma", "baseline A", "B", "B / A", "sigma")
    for pair in record.pairs:
        longer, spread = pair.baseline_percent, pair.sigma_baseline_percent
        table.add_row(
            " and ".join(pair.cameras),
            with_digits(pair.turn_deg, pair.sigma_turn_deg or 0.0),
            NONE if not pair.sigma_turn_deg else sigma_text(pair.sigma_turn_deg),
            f"{pair.baseline_a:.5g}",
            f"{pair.baseline_b:.5g}",
            "scale fitted" if longer is None else f"{with_digits(longer, spread or 0.0, '+')} %",
            NONE if not spread else f"{sigma_text(spread)} %",
        )
    return table


def _depths(record: Comparison) -> Table:
    table = table_of("depths by A, B true", "range", "median", "worst", "middle", "sigma")
    for pair in record.pairs:
        for index, cells in enumerate(_depth_cells(pair, record.unit)):
            table.add_row(
                " and ".join(pair.cameras) if index == 0 else "",
                *cells,
                end_section=index == len(pair.depth) - 1,
            )
    return table


def _depth_cells(pair: PairDifference, unit: str | None) -> Iterator[tuple[str, ...]]:
    for one in pair.depth:
        where = at_range(one.range, unit)
        if one.missing:
            yield where, one.missing, "", "", ""
            continue
        numbers = (one.median_percent, one.worst_percent, one.middle_percent)
        yield (
            where,
            *(NONE if v is None else signed_percent(v) for v in numbers),
            NONE if one.sigma_percent is None else f"{short(one.sigma_percent)} %",
        )

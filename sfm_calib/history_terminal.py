"""What a person sees of a history: the calibrations, then camera by camera their numbers."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from sfm_calib.history_record import GROUPS, History, HistoryEntry, Quantity
from sfm_calib.report.digits import sigma_text, with_digits
from sfm_calib.terminal import SUSPICIOUS_Z, print_line, table_of

NONE = "-"
FILE_TIME = "*"  # beside a date that is the file's, not the calibration's
FILE_WIDTH = 16  # characters, at least
PIPED_WIDTH = 120  # value and sigma of five numbers
COLUMNS = {
    "focal": "f px", "cx": "cx px", "cy": "cy px", "corner": "corner px",
    "rotation_x": "rot x deg", "rotation_y": "rot y deg", "rotation_z": "rot z deg",
    "translation_x": "x", "translation_y": "y", "translation_z": "z",
}  # fmt: skip
TABLES = (("focal", "principal_point", "distortion"), ("pointing",), ("translation",))


def print_history(record: History, console: Console) -> None:
    """Calibrations, notes, and a table of each camera's numbers."""
    console.print(_listed(record))
    if any(entry.when_from == "file" for entry in record.entries):
        print_line(console, f"{FILE_TIME} no date inside: when the file was last changed")
    for entry in record.entries:
        for text in (*entry.notes, *(f"the same as {path}" for path in entry.also)):
            print_line(console, f"note: #{entry.number} {text}")
    for camera in record.cameras:
        for groups in TABLES:
            if (table := _numbers(record, camera, groups)) is not None:
                console.print(table)
    for name in baseline_names(record):
        console.print(_baselines(record, name))
    print_line(
        console,
        "change: since the one before, the largest in combined sigmas, as if the two were "
        "independent (by chance one number in twenty changes by more than 2); corner: how far "
        "distortion moves the image's corners outwards",
    )
    print_line(console, f"{len(record.entries)} calibrations in {record.folder}{left_out(record)}")


def left_out(record: History) -> str:
    """What else was found, in words."""
    older = f"; {record.n_older} before --since" if record.n_older else ""
    files = "1 file" if record.n_skipped == 1 else f"{record.n_skipped} files"
    return f"{older}; {files} skipped: no calibration" if record.n_skipped else older


def _listed(record: History) -> Table:
    table = table_of("", "file", "date", "verdict", "drift", "replaces", "largest change")
    table.columns[0].no_wrap = True
    file = table.columns[1]
    file.justify, file.no_wrap, file.overflow, file.min_width = "left", False, "fold", FILE_WIDTH
    for entry in record.entries:
        table.add_row(
            f"#{entry.number}",
            entry.path,
            f"{entry.when:%Y-%m-%d %H:%M}" + FILE_TIME * (entry.when_from == "file"),
            usable_text(entry),
            entry.drift or NONE,
            f"#{entry.replaces}" if entry.replaces else NONE,
            largest_change(entry.quantities),
            style="" if entry.usable is not False else "bold red",
        )
    return table


def usable_text(entry: HistoryEntry) -> str:
    """The verdict of the calibration itself."""
    return NONE if entry.usable is None else "usable" if entry.usable else "NOT USABLE"


def largest_change(quantities: Sequence[Quantity], with_camera: bool = True) -> str:
    """The quantity that changed most since the one before, in sigmas."""
    told = [one for one in quantities if one.z is not None]
    if not told:
        return NONE
    most = max(told, key=lambda one: abs(one.z or 0.0))
    name = most.name if with_camera else most.name.rpartition(".")[2]
    return f"{name} {most.z:+.1f}"


def cell(quantity: Quantity | None) -> str:
    """Value and sigma."""
    if quantity is None:
        return NONE
    value = with_digits(quantity.value, quantity.sigma or 0.0)
    return f"{value} ± {sigma_text(quantity.sigma)}" if quantity.sigma else value


def _numbers(record: History, camera: str, groups: Sequence[str]) -> Table | None:
    """A camera's numbers of some groups, a calibration a row; None where there are none."""
    rows: list[tuple[HistoryEntry, dict[str, Quantity]]] = []
    for entry in record.entries:
        own = {q.name.rpartition(".")[2]: q for q in entry.quantities if _is_of(q, camera, groups)}
        if own:
            rows.append((entry, own))
    if not rows:
        return None
    known = [name for name in COLUMNS if any(name in own for _, own in rows)]
    units = {q.unit for _, own in rows for q in own.values()}
    unit = f" {units.pop()}" if groups == ("translation",) and len(units) == 1 else ""
    table = table_of(camera, *(f"{COLUMNS[name]}{unit}" for name in known), "change")
    for column in table.columns[1:]:  # narrow terminals break a cell rather than cut its digits
        column.no_wrap = False
    table.columns[0].no_wrap = True
    for entry, own in rows:
        moved = max((abs(q.z) for q in own.values() if q.z is not None), default=0.0)
        table.add_row(
            f"#{entry.number}{' kept' if camera in entry.kept else ''}",
            *(cell(own.get(name)) for name in known),
            largest_change(tuple(own.values()), with_camera=False),
            style="bold red" if moved > SUSPICIOUS_Z else "",
        )
    return table


def _is_of(quantity: Quantity, camera: str, groups: Sequence[str]) -> bool:
    return quantity.name.rpartition(".")[0] == camera and quantity.group in groups


def baseline_names(record: History) -> tuple[str, ...]:
    """Every baseline that some calibration has."""
    return tuple(
        dict.fromkeys(
            q.name for entry in record.entries for q in entry.quantities if q.group == GROUPS[-1]
        )
    )


def _baselines(record: History, name: str) -> Table:
    table = table_of(name.rpartition(".")[0], "baseline", "unit", "since the one before", "z")
    for entry in record.entries:
        for one in entry.quantities:
            if one.name == name:
                table.add_row(
                    f"#{entry.number}",
                    cell(one),
                    one.unit,
                    NONE if one.change is None else with_digits(one.change, one.sigma or 0.0, "+"),
                    NONE if one.z is None else f"{one.z:+.1f}",
                )
    return table

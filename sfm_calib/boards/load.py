"""Boards from files: our own YAML, and Kalibr's target YAML."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from sfm_calib.boards.spec import BOARD_TYPES, Board
from sfm_calib.config import read_yaml
from sfm_calib.errors import CalibrationError

SQUARE_TOLERANCE = 1e-6  # relative; both are typed, not measured
# Kalibr's keys of each target type, as its documentation lists them.
KALIBR_KEYS = {
    "aprilgrid": ("tagCols", "tagRows", "tagSize", "tagSpacing"),
    "checkerboard": ("targetCols", "targetRows", "rowSpacingMeters", "colSpacingMeters"),
    "circlegrid": ("targetCols", "targetRows", "spacingMeters", "asymmetricGrid"),
}
OUR_TYPES = {"aprilgrid": "aprilgrid", "checkerboard": "checkerboard", "circlegrid": "circles"}
KALIBR_DEFAULTS = {"asymmetricGrid": False}


def load_board(path: Path) -> Board:
    """Read a board from our YAML or from Kalibr's target YAML.

    Raises CalibrationError naming the key that is wrong and the nearest valid one.
    """
    content = _read(path)
    if not isinstance(content, dict) or not content:
        raise CalibrationError(
            f"{path} describes no board: write 'type: checkerboard', 'inner_corners: [8, 6]' and "
            "'square_m: 0.025', or the like of another type"
        )
    try:
        if "target_type" in content:
            return _from_kalibr(content)
        return board_from(content)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error


def board_from(content: dict[str, Any], spell: Callable[[str], str] = str) -> Board:
    """A board from the keys of our YAML. Raises CalibrationError as load_board does.

    `spell` turns a key into what the user wrote.
    """
    names = ", ".join(BOARD_TYPES)
    if "type" not in content:
        raise CalibrationError(f"no type: write 'type: checkerboard' or another of {names}")
    kind = BOARD_TYPES.get(str(content["type"]))
    if kind is None:
        close = difflib.get_close_matches(str(content["type"]), BOARD_TYPES, n=1)
        hint = f"did you mean {close[0]!r}? " if close else ""
        raise CalibrationError(f"unknown type {content['type']!r}: {hint}Valid are {names}")
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(_first_problem(error, kind, spell)) from error


def board_yaml(board: Board) -> str:
    """The text of a YAML file that load_board reads back as the same board."""
    lines = []
    for name, value in board.model_dump().items():
        field = type(board).model_fields[name]
        if name == "type" or field.is_required() or value != field.default:
            text = f"[{value[0]}, {value[1]}]" if isinstance(value, tuple) else _scalar(value)
            lines.append(f"{name}: {text}")
    return "\n".join(lines) + "\n"


def _scalar(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _read(path: Path) -> object:
    try:
        return read_yaml(path)
    except CalibrationError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            raise CalibrationError(f"no such board: {path}; give a YAML file") from error
        raise


def _first_problem(error: ValidationError, kind: type[Board], spell: Callable[[str], str]) -> str:
    """The first validation error as one line, with the nearest valid name for an unknown key."""
    problems = error.errors()
    # A misspelt key is often also a missing one; the misspelling is what to tell.
    unknown = (problem for problem in problems if problem["type"] == "extra_forbidden")
    problem = next(unknown, problems[0])
    where = spell(".".join(str(part) for part in problem["loc"]))
    if problem["type"] == "extra_forbidden":
        return _unknown_key(where, sorted(kind.model_fields))
    if problem["type"] == "missing":
        name = kind.model_fields["type"].default
        return f"{where}: is missing, and a board of type {name} needs it"
    value = problem["input"]
    if problem["type"] == "tuple_type":
        return f"{where}: takes a list, like [8, 6] (got {value!r})"
    message = problem["msg"].removeprefix("Value error, ")
    shown = f" (got {value!r})" if isinstance(value, str | int | float | bool) else ""
    return f"{where}: {message}{shown}"


def _unknown_key(name: str, valid: list[str]) -> str:
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.0)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"unknown key {name!r}: {hint}Valid here: {', '.join(valid)}"


def _from_kalibr(target: dict[str, Any]) -> Board:
    """A board from the keys of Kalibr's target YAML."""
    kind = str(target["target_type"])
    if kind not in KALIBR_KEYS:
        raise CalibrationError(f"unknown target_type {kind!r}: Kalibr has {', '.join(KALIBR_KEYS)}")
    keys = KALIBR_KEYS[kind]
    given = {**KALIBR_DEFAULTS, **target}
    for name in target:
        if name != "target_type" and name not in keys:
            raise CalibrationError(_unknown_key(str(name), list(keys)))
    missing = [name for name in keys if name not in given]
    if missing:
        raise CalibrationError(f"{missing[0]}: is missing, and Kalibr's {kind} needs it")
    columns, rows, length, last = (given[name] for name in keys)
    ours = {"aprilgrid": "tags", "checkerboard": "inner_corners", "circlegrid": "circles"}[kind]
    content: dict[str, Any] = {"type": OUR_TYPES[kind], ours: [columns, rows]}
    if kind == "aprilgrid":
        content |= {"tag_m": length, "spacing": last}
    elif kind == "circlegrid":
        content |= {"spacing_m": length, "asymmetric": last}
    else:
        content |= {"square_m": _square_side(length, last)}
    theirs = [f"{ours}.0", f"{ours}.1", *list(content)[2:]]
    names = dict(zip(theirs, keys, strict=False))
    return board_from(content, lambda name: names.get(name, name))


def _square_side(row_m: object, column_m: object) -> object:
    """The one side of a square, where Kalibr allows two."""
    numbers = isinstance(row_m, int | float) and isinstance(column_m, int | float)
    if not numbers:
        return row_m  # its validation says what is wrong with it
    assert isinstance(row_m, int | float) and isinstance(column_m, int | float)
    if abs(row_m - column_m) > SQUARE_TOLERANCE * abs(row_m):
        raise CalibrationError(
            f"rowSpacingMeters is {row_m:g} and colSpacingMeters {column_m:g}: only checkerboards "
            "of squares are read; print one with equal spacings"
        )
    return row_m

"""YAML, JSON and XML of others as trees of texts: within bounds, and never more than data.

Numbers stay texts until a reader asks for them: no format means "1:30" as 90, or "no" as false.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from sfm_calib.errors import CalibrationError

# Of our own JSON: the covariance of 50 cameras has 25 MB.
MOST_BYTES = 50_000_000
# Of all others; OpenCV's longest, with every corner of 500 boards, has 2 MB.
MOST_BYTES_OF_OTHERS = 5_000_000
MOST_NODES = 500_000  # of a tree; those 500 boards have 100,000
MOST_DEPTH = 40  # lists in lists; calibrations have 6
MOST_DOTS = 1000  # in a line of TOML: its parser takes the square of a key's parts
_LOADER: Any = getattr(yaml, "CBaseLoader", yaml.BaseLoader)  # texts, lists and mappings alone
# OpenCV escapes an apostrophe, which neither YAML nor JSON knows.
_ESCAPED_APOSTROPHE = re.compile(r"(?<!\\)((?:\\\\)*)\\'")


def text_of(path: Path, most_bytes: int = MOST_BYTES_OF_OTHERS) -> str:
    """A file's text. Raises CalibrationError where it is too long; OSError, UnicodeDecodeError."""
    check_length(path, most_bytes)
    return path.read_bytes().decode("utf-8-sig")


def check_length(path: Path, most_bytes: int = MOST_BYTES_OF_OTHERS) -> None:
    """Raises CalibrationError for a file that is too long, or none: a pipe has no end."""
    size = path.stat().st_size
    if not path.is_file():
        raise CalibrationError(f"{path} is no file")
    if size > most_bytes:
        raise CalibrationError(
            f"{path} has {size / 1e6:.0f} MB, and a calibration at most {most_bytes / 1e6:.0f}: "
            "give the calibration's own file"
        )


def yaml_tree(path: Path, text: str) -> object:
    """Mappings, lists and texts of YAML, OpenCV's too; None where it is none.

    Raises CalibrationError beyond the bounds; a node counts as often as aliases repeat it.
    """
    if text.startswith("%YAML"):  # OpenCV's "%YAML:1.0" is no directive
        text = text.partition("\n")[2]
    text = _ESCAPED_APOSTROPHE.sub(r"\1'", text)
    try:
        _check_bounds(path, text)
        return yaml.load(text, _LOADER)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None


def _check_bounds(path: Path, text: str) -> None:
    """Events one after the other, before anything is built of them."""
    nodes, depth = 0, 0
    open_anchors: list[tuple[str | None, int]] = []
    size_of: dict[str, int] = {}  # of what an anchor stands for
    for event in yaml.parse(text, _LOADER):
        if isinstance(event, yaml.AliasEvent):
            nodes += size_of.get(event.anchor or "", MOST_NODES)  # inside of itself: endless
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor:
                size_of[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            open_anchors.append((event.anchor, nodes))
            nodes, depth = nodes + 1, depth + 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_anchors.pop()
            depth -= 1
            if anchor:
                size_of[anchor] = nodes - before
        if nodes > MOST_NODES or depth > MOST_DEPTH:
            raise _beyond(path)


def _beyond(path: Path) -> CalibrationError:
    return CalibrationError(
        f"{path} holds more than {MOST_NODES} entries, or more than {MOST_DEPTH} in each other: "
        "it is no calibration"
    )


def json_tree(path: Path, text: str) -> object:
    """What JSON holds. Raises CalibrationError where it is none, or beyond the bounds."""
    if text.count("[") + text.count("{") > MOST_NODES:
        raise _beyond(path)
    try:
        return json.loads(_ESCAPED_APOSTROPHE.sub(r"\1'", text))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is no whole JSON: {error}") from error


def xml_root(path: Path, text: str) -> ElementTree.Element:
    """Raises CalibrationError where it is no XML, defines entities, or is beyond the bounds."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise CalibrationError(f"{path} defines XML of its own (DOCTYPE), which is not read")
    if text.count("<") > MOST_NODES:
        raise _beyond(path)
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise CalibrationError(f"{path} is no whole XML: {error}") from error
    level, depth = [root], 0
    while level:
        level, depth = [child for element in level for child in element], depth + 1
        if depth > MOST_DEPTH:
            raise _beyond(path)
    return root

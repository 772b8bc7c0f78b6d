"""`history.json`: the calibrations of one rig over time."""

from __future__ import annotations

from typing import Final, Literal, get_args

from pydantic import AwareDatetime

from graphs.drift import Verdict as DriftVerdict
from sfm_calib.record import Record

FORMAT: Final = "sfm_calib/history/1"
Group = Literal[
    "focal", "principal_point", "distortion", "pointing", "translation", "baseline"
]  # fmt: skip
GROUPS: tuple[Group, ...] = get_args(Group)


class Quantity(Record):
    """One number of one calibration, beside the calibrations before it.

    Compared are those of the same image size and the same unit of length alone. Rotations are
    vectors in degrees, and their changes turns about the camera's axes.
    """

    name: str  # `left.focal_x`, `left.rotation_x`, `left to right.baseline`
    group: Group
    value: float
    sigma: float | None  # None: the file states none; 0: held, or the unit itself
    unit: str
    compared: bool  # with the newest calibration's: one size, one unit
    since_first: float  # less that of the first with which it is compared; 0: it is the first
    change: float | None = None  # less that of the one before; None: there is none
    z: float | None = None  # that in combined sigmas; None: one of the two states none


class HistoryEntry(Record):
    """One calibration."""

    number: int  # from 1, the oldest first
    path: str  # within the folder
    also: tuple[str, ...] = ()  # files of the same content
    format: str
    sha256: str
    when: AwareDatetime
    when_from: Literal["created", "file"]  # file: it was changed last then
    usable: bool | None  # None: not recorded
    drift: DriftVerdict | None
    replaces: int | None  # number of the calibration that it takes the place of, where it is here
    cameras: tuple[str, ...]
    kept: tuple[str, ...]  # cameras copied from an older calibration
    quantities: tuple[Quantity, ...]
    notes: tuple[str, ...]


class History(Record):
    """All calibrations in a folder, the oldest first."""

    format: Literal["sfm_calib/history/1"] = FORMAT
    folder: str
    reference: str | None  # the camera beside which others are placed; None: there is no rig
    cameras: tuple[str, ...]
    entries: tuple[HistoryEntry, ...]
    n_skipped: int  # files that look like calibrations by their names, and are none
    n_older: int = 0  # calibrations before --since

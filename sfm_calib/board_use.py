"""What a calibration knows of the board it used, for what is said of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from graphs.problem import Estimate
from graphs.stated_covariance import CalibrationCovariance
from sfm_calib.boards.spec import Board
from sfm_calib.mapping import some


@dataclass(frozen=True)
class Without:
    """The same calibration without the board."""

    estimate: Estimate
    covariance: CalibrationCovariance


@dataclass(frozen=True)
class BoardUse:
    """The board, what was left out of its views, and what the scan says without it."""

    board: Board
    left_out: tuple[str, ...] = ()  # `camera/frame: reason`
    repeated: tuple[str, ...] = ()  # groups of frames
    in_scan: Literal["", "still", "waved"] = ""
    without: Without | None = None  # None: there is no scan beside the board

    @property
    def messages(self) -> tuple[str, ...]:
        """Lines for the verdict."""
        found = []
        if self.left_out:
            listed = some(list(self.left_out))
            what = "view of the board was" if len(self.left_out) == 1 else "views of the board were"
            found.append(f"{len(self.left_out)} {what} left out: {listed}")
        if self.repeated:
            few = len(self.repeated) == 1
            found.append(
                f"{len(self.repeated)} group{'s' * (not few)} of frames show{'s' * few} the board "
                f"in one place, and tell{'s' * few} little more than one of each: "
                f"{'; '.join(self.repeated[:3])}"
            )
        return tuple(found)

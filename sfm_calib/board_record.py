"""What calibration.json says of the board that took part."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sfm_calib.record import Record


class Without(Record):
    """A parameter as the scan alone has it, without the board."""

    sigma: float | None  # stated, in the covariance's unit; None: without a metre, no length is
    moved: float | None  # by the board, in that unit


class BoardResult(Record):
    """The calibration board that took part, and what became of it."""

    description: str
    n_images: dict[str, int]  # of each camera, in which it was seen and used
    n_corners: dict[str, int]
    sigma_px: dict[str, float]  # robust, of one coordinate of its corners
    in_scan: Literal["", "still", "waved"] = ""  # where it was seen in the scan itself
    size: float = 1.0  # estimated over stated lengths
    sigma_size: float = 0.0
    bend_mm: tuple[float, float] = (0.0, 0.0)  # of its middle, against left and right, top and foot
    sigma_bend_mm: tuple[float, float] = (0.0, 0.0)  # 0: held flat
    corners_off_mm: float = 0.0  # rms, from where they are stated to be; 0: held
    left_out: tuple[str, ...] = ()  # `camera/frame: reason`
    repeated: tuple[str, ...] = ()  # groups of frames that show it in one place
    without: dict[str, Without] = Field(
        default_factory=dict
    )  # of each parameter: what the scan alone says of it

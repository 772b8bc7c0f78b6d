"""How depth images become clouds: the options of `fuse`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from sfm_calib.depth.cloud import DepthKind, DepthLimits
from sfm_calib.depth.registration import MAX_CORRESPONDENCE_M, Method
from sfm_calib.errors import CalibrationError

EDGE = 0.02  # of the depth: 14 mm at 0.7 m, where time-of-flight cameras err by 2 to 3 mm


@dataclass(frozen=True)
class FuseOptions:
    """How depth images become clouds."""

    depth_unit: Annotated[float, tyro.conf.arg(metavar="M")] = 0.001
    """Metres that a count of a whole-number image is. Floating point is taken as metres."""
    depth_is: DepthKind = "z"
    """What a pixel tells: z, the depth along the optical axis, or range, the distance along its
    ray."""
    near_m: float = 0.0
    """Nearer is no measurement."""
    far_m: float = np.inf
    """Farther is no measurement."""
    edge: float = EDGE
    """Drop a pixel where fewer than four of the eight around it have its depth to this share:
    flying pixels between two surfaces. 0: keep all."""
    voxel_m: float = 0.0
    """Keep one point of each camera in each cube of this edge; 0: all."""
    registration: Method = "none"
    """icp: move each camera's part onto the others', starting from the calibration."""
    max_correspondence_m: float = MAX_CORRESPONDENCE_M
    """Parts farther apart than this are not one surface, for overlaps and for ICP."""
    colours: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Pictures of the same layout, names and size as DEPTHS: colours of the points."""
    metres: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """How many metres the calibration's unit of length is: 0.001 of a file in mm, 1 of one in m."""
    parts: bool = False
    """Write each camera's part too, into OUT/parts."""

    def checked(self) -> FuseOptions:
        """Itself. Raises CalibrationError for numbers that make no sense."""
        for flag, value in (
            ("--max-correspondence-m", self.max_correspondence_m),
            ("--far-m", self.far_m),
            ("--metres", 1.0 if self.metres is None else self.metres),
        ):
            if not value > 0 or (np.isinf(value) and flag != "--far-m"):
                raise CalibrationError(f"{flag} {value:g} must be a length above 0")
        for flag, value in (
            ("--near-m", self.near_m), ("--voxel-m", self.voxel_m), ("--edge", self.edge),
        ):  # fmt: skip
            if not 0 <= value < np.inf:
                raise CalibrationError(f"{flag} {value:g} must be 0 or more")
        if self.near_m >= self.far_m:
            raise CalibrationError(
                f"--near-m {self.near_m:g} is not nearer than --far-m {self.far_m:g}"
            )
        return self

    @property
    def limits(self) -> DepthLimits:
        return DepthLimits(self.near_m, self.far_m, self.edge)

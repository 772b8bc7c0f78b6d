"""`fuse.json`: what became of depth images, and how well the cameras' parts agree."""

from __future__ import annotations

from typing import Final, Literal

from sfm_calib.depth.cloud import DepthKind
from sfm_calib.depth.registration import Method
from sfm_calib.provenance import Provenance
from sfm_calib.record import Record

FORMAT: Final = "sfm_calib/fuse/1"


class PartRecord(Record):
    """One camera's part of a cloud."""

    camera: str
    n_measured: int  # pixels with a depth at all
    n_points: int  # that remained: within the limits, not flying, after thinning
    median_depth_m: float | None  # None: no points
    # Rms over the points, all directions together, by the calibration alone; None: not stated.
    sigma_m: float | None


class OverlapRecord(Record):
    """How far two cameras' points of one surface are apart, across it: each over the other's."""

    cameras: tuple[str, str]
    n_points: int
    share: float  # of the points of that of both which shares more of its own
    median_m: float | None  # of the size; None: too few points
    rms_m: float | None
    offset_m: float | None  # median, signed: positive where the first camera's lies nearer to it
    # Rms that the calibration's sigmas let expect, depth taken as exact; None: not stated.
    sigma_m: float | None


class RegistrationRecord(Record):
    """What ICP found of a camera's part: how it moves that in the rig's frame."""

    camera: str
    failed: str  # why; empty: it did not
    rotation_wxyz: tuple[float, float, float, float]
    translation_m: tuple[float, float, float]
    fitness: float  # share of its points on the surface that it was moved onto
    rms_m: float  # of these, across the surface


class FrameRecord(Record):
    """Depth images taken together, and their cloud."""

    name: str
    file: str  # in OUT
    n_points: int
    parts: tuple[PartRecord, ...]
    overlaps: tuple[OverlapRecord, ...]  # as the calibration has them
    registration: tuple[RegistrationRecord, ...] = ()  # empty: not asked for
    overlaps_registered: tuple[OverlapRecord, ...] = ()


class FuseRecord(Record):
    """Everything that is said of fused depth images."""

    format: Literal["sfm_calib/fuse/1"] = FORMAT
    calibration: str
    reference: str | None  # camera whose frame the clouds are in; None: the rig's own
    depth_is: DepthKind
    registration: Method
    within_m: float  # of overlaps, and of ICP
    frames: tuple[FrameRecord, ...]
    notes: tuple[str, ...] = ()
    provenance: Provenance

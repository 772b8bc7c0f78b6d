"""`compare.json`: two calibrations beside each other. Differences are B less A."""

from __future__ import annotations

from typing import Final, Literal

from sfm_calib.record import Record

FORMAT: Final = "sfm_calib/compare/1"
Kind = Literal["same", "agree", "differ", "cannot tell", "no sigmas"]


class Side(Record):
    """One of the two."""

    path: str
    format: str
    cameras: tuple[str, ...]
    states_sigmas: bool


class CameraMatch(Record):
    """Which cameras are held against each other, and in which lens their parameters are."""

    name: str  # A's, and in all that follows
    name_b: str
    lens: str
    lens_b: str
    fit_error_px: float  # rms, of B's lens brought into A's for its parameters; 0: exact


class ParameterDifference(Record):
    """One parameter; angles in degrees, lengths in Comparison.unit. No sigma: none is stated."""

    name: str
    unit: str
    a: float
    b: float
    difference: float
    sigma_a: float
    sigma_b: float
    z: float | None  # difference over the combined sigma; None: neither states one


class ProjectionDifference(Record):
    """Where B sees what A sees at a range, less A's pixel, the change of frames taken out."""

    range: float | None  # from the camera; None: infinity
    mean_px: float
    rms_px: float
    max_px: float
    centre_px: float | None  # None: there one of them sees nothing
    corner_px: float | None  # the largest of the four
    seen_share: float  # of A's image that both see


class DepthDifference(Record):
    """Depths that A finds where B is true, relative to them, in the pair's common view."""

    range: float  # from the pair's first camera
    median_percent: float | None = None
    worst_percent: float | None = None  # the largest in size
    middle_percent: float | None = None  # in the middle of the common view
    sigma_percent: float | None = None  # there, of both together; None: not stated
    no_depth_share: float = 0.0  # of the common view, where A's rays do not meet
    missing: Literal["", "not in both images", "rays do not meet"] = ""


class PairDifference(Record):
    """How two cameras sit to each other."""

    cameras: tuple[str, str]
    turn_deg: float  # between the rotations of A and of B
    sigma_turn_deg: float | None
    baseline_a: float
    baseline_b: float
    baseline_percent: float | None  # B's over A's; None: their units cannot be compared
    sigma_baseline_percent: float | None
    depth: tuple[DepthDifference, ...] = ()


class ChangeOfFrames(Record):
    """What was taken out: B's rig from A's, as it leaves least in the picture."""

    cameras: tuple[str, ...]
    rotation_deg: tuple[float, float, float]  # rotation vector
    translation: tuple[float, float, float]
    scale: float | None = None  # A's unit of length in B's, fitted; None: both are known


class Chance(Record):
    """The difference in the picture against both covariances."""

    chi2: float
    rank: int  # directions that count
    n_parameters: int  # with sigmas
    p_value: float
    difference_px: float  # rms over all images and ranges
    expected_px: float  # rms that the sigmas let expect
    outside_px: float  # rms of the part that no sigma reaches


class ComparisonVerdict(Record):
    """The conclusion, the main line first."""

    kind: Kind
    lines: tuple[str, ...]


class Comparison(Record):
    """Everything that is said of two calibrations."""

    format: Literal["sfm_calib/compare/1"] = FORMAT
    a: Side
    b: Side
    cameras: tuple[CameraMatch, ...]
    unit: Literal["m", "baseline"] | None  # of lengths and ranges; None: only lenses are compared
    taken_out: tuple[ChangeOfFrames, ...]
    parameters: tuple[ParameterDifference, ...]
    projection: dict[str, tuple[ProjectionDifference, ...]]
    pairs: tuple[PairDifference, ...] = ()
    chance: Chance | None = None  # None: no sigmas, or none that can be trusted in the picture
    notes: tuple[str, ...] = ()
    verdict: ComparisonVerdict

"""`calibration.json`: the one result file that every command reads and writes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from graphs.camera import Camera
from graphs.frames import Transform
from graphs.lenses import PARAMETER_NAMES, LensName
from graphs.propagation import pose_names
from sfm_calib.board_record import BoardResult
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically
from sfm_calib.provenance import Provenance, Sha256
from sfm_calib.recalibration_record import Recalibration
from sfm_calib.record import Record

FORMAT: Final = "sfm_calib/1"
OF_LENS: Final = "choice of the lens"  # the kind of what is no direction: of another lens
PRIOR_DECIDES_SHARE = 0.5  # of what is known of a parameter: more is belief rather than data


class CameraResult(Record):
    """One camera. `sigma` and `prior_share` are empty where nothing was estimated (a truth)."""

    lens: LensName
    size: tuple[int, int]  # width, height in px
    params: dict[str, float]  # OpenCV's names; pixel centres at integers
    sigma: dict[str, float] = Field(default_factory=dict)
    # var_posterior / var_prior: 1 belief alone, 0 data alone
    prior_share: dict[str, float] = Field(default_factory=dict)
    n_images: int = 0
    n_observations: int = 0
    # Of the old calibration, where the scan had no such camera.
    kept_from: Sha256 | Literal[""] = ""

    @model_validator(mode="after")
    def _params_are_those_of_the_lens(self) -> CameraResult:
        wanted = PARAMETER_NAMES[self.lens]
        if set(self.params) != set(wanted):
            raise ValueError(f"a {self.lens} lens has the parameters {' '.join(wanted)}")
        return self


class CamFromRig(Record):
    """x_cam = rotation x_rig + translation."""

    rotation_wxyz: tuple[float, float, float, float]
    translation: tuple[float, float, float]  # m when rig.metric, else baselines (rig.scale.source)
    sigma_rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # about the camera's x, y, z
    sigma_translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, name: str, place: Transform, sigma: Mapping[str, float]) -> CamFromRig:
        """Of the camera of that name; `sigma` by parameter, 0 where it says none."""
        told = [sigma.get(parameter, 0.0) for parameter in pose_names(name)]
        return cls(
            rotation_wxyz=tuple(place.rotation_wxyz.tolist()),
            translation=tuple(place.translation.tolist()),
            sigma_rotation_deg=tuple(np.degrees(told[:3]).tolist()),
            sigma_translation=tuple(told[3:]),
        )


class ScaleEntry(Record):
    """A measured length, what the solve made of it, and what all others say of it."""

    what: str
    measured_m: float
    sigma_m: float  # as stated
    estimated_m: float
    residual_percent: float  # estimated less measured
    predicted_by_others_m: float | None = None  # None: nothing else tells
    sigma_predicted_m: float | None = None
    z: float | None = None  # measured less predicted, in sigmas of that difference
    p_value: float | None = None  # of a larger |z|, if the sigmas are true
    contradicts: bool = False
    suspect: bool = False  # without it the others agree with each other

    @property
    def residual_m(self) -> float:
        return self.estimated_m - self.measured_m


class Scale(Record):
    """What gives the rig's lengths their unit."""

    source: str  # what gave the unit of length
    sigma_relative: float | None = None  # None: no metric scale
    contradicted: bool = False  # the sources contradict each other: lengths are a compromise
    ledger: tuple[ScaleEntry, ...] = ()  # every source; none: no metric scale, or an older file


class RigResult(Record):
    """How the cameras sit on the rig; the reference's transform is the identity."""

    reference: str
    cam_from_rig: dict[str, CamFromRig]
    metric: bool
    scale: Scale


class Covariance(Record):
    """Joint covariance of everything estimated of the cameras and the rig.

    Names are `camera.parameter`, `camera.rotation_x` (radians about the camera's axes) and
    `camera.translation_x` (unit of the rig).
    """

    names: tuple[str, ...] = ()
    matrix: tuple[tuple[float, ...], ...] = ()

    @model_validator(mode="after")
    def _matrix_is_square(self) -> Covariance:
        n = len(self.names)
        if [len(row) for row in self.matrix] != [n] * n:
            raise ValueError(f"{n} names need a matrix of {n} rows and columns")
        return self


class Sigmas(Record):
    """One parameter's sigmas, by what they allow for; the units of its `sigma` in the covariance.

    Stated is none of them but what covers: the model's, and all that errs together beyond it.
    """

    model: float  # independent noise
    robust: float  # and what frames, tracks and cells of the image err together
    jackknife: float | None = None  # by leaving out blocks of frames; None: too few frames
    stated: float


class NoiseBySize(Record):
    """The noise of one camera's keypoints of about one size, or one sigma."""

    smallest_px: float | None  # their scale, or what matching states as sigma; None: unknown
    largest_px: float | None
    n_observations: int
    sigma_px: float  # robust, of one pixel coordinate
    of_board: bool = False  # corners of the board
    matched: bool = False  # by their patches (--refine)


class Noise(Record):
    """How well the features were located, and how far the stated sigmas exceed the model's."""

    sigma_px: float  # robust sigma of one pixel coordinate
    inflation: float = 1.0  # median of stated sigma / model sigma
    by_size: dict[str, tuple[NoiseBySize, ...]] = Field(default_factory=dict)  # of each camera
    sigmas: dict[str, Sigmas] = Field(default_factory=dict)  # of each parameter of the covariance


class ProjectionSigma(Record):
    """Sigma, in the worst direction, of where the calibration alone places a fixed point.

    relative_to "camera": from the lens; "rig": from all lenses and cam_from_rig. How the camera,
    or the rig, is turned is not part of it: `graphs.uncertainty.projection_maps`.
    """

    relative_to: Literal["camera", "rig"]
    range: float | None  # of the point from the camera, in Uncertainty.unit; None: infinity
    centre_px: float
    rms_px: float  # over the image
    corner_px: float  # the worst of the four


class DepthSigma(Record):
    """Sigma of a depth from one pixel in each of two cameras; None where there is no depth."""

    range: float
    sigma_noise: float | None = None  # averages out over measurements
    sigma_calibration: float | None = None  # does not
    missing: Literal["", "not in both images", "not determined"] = ""


class PairDepth(Record):
    """Two cameras' depths in the middle of what both see, counted from the first."""

    cameras: tuple[str, str]
    baseline: float
    common_view: bool
    determined_to: float | None = None  # 0: nowhere; None: as far as 200 baselines
    depth: tuple[DepthSigma, ...] = ()


class Uncertainty(Record):
    """What the stated covariance means for pixels and for depths."""

    unit: Literal["m", "baseline"] | None = None  # of ranges and depths; None: there is no unit
    sigma_px: float | None = None  # noise of one pixel coordinate in depths; None: no depths
    projection: dict[str, tuple[ProjectionSigma, ...]] = Field(default_factory=dict)
    depth: tuple[PairDepth, ...] = ()


class Split(Record):
    """Two halves of the frames, each calibrated alone, and how far they project apart.

    rms over all images, once a rotation of the rig has undone what it can.
    """

    difference_px: float
    expected_px: float  # by the stated covariances of the halves
    p_value: float  # of a larger difference, if those are true
    agrees: bool


class Certificate(Record):
    """How the stated sigmas did on simulated twins of this scan, whose truth is known."""

    trials: int
    failed: int
    nees: float  # mean squared error over the stated covariance, a degree of freedom; 1 is right
    nees_standard_error: float
    model_nees: float  # the same over the model covariance
    coverage: float  # of 95 % intervals, over all parameters
    least_covered: str  # parameter
    least_coverage: float
    holds: bool


class WeakDirection(Record):
    """A change of lenses and rig that the scan hardly notices, and what would determine it.

    Effects are those of one stated sigma along it.
    """

    what: str
    effect_px: float | None  # on the picture, the larger of centre and corner
    remedy: str
    kind: str = ""
    parameters: tuple[str, ...] = ()  # that it moves, the most moved first
    moves: tuple[float, ...] = ()  # how far, in their own units
    slide_px: float | None = None  # what the parameters move, each as the px it would move alone
    data_slide_px: float | None = None  # without priors; None: the data say nothing at all
    effect_centre_px: float | None = None  # of all together, once the rig turned as suits best
    effect_corner_px: float | None = None
    prior_share: float | None = None  # of the information: 0 data alone, 1 belief alone

    @property
    def sizes(self) -> str:
        """How far one sigma goes: of the parameters, and of what is left of it in the picture."""
        if self.slide_px is None or self.effect_centre_px is None or self.effect_corner_px is None:
            return "" if self.effect_px is None else f"up to {self.effect_px:.2g} px in the image"
        said = (
            f"free by {self.slide_px:.2g} px, which shows as {self.effect_centre_px:.2g} px at the "
            f"centre and {self.effect_corner_px:.2g} px in a corner"
        )
        if self.prior_share is not None and self.prior_share > PRIOR_DECIDES_SHARE:
            said += f"; {self.prior_share:.0%} of what is known comes from priors"
        return said


class Verdict(Record):
    """Whether to use the result, and what to know before."""

    usable: bool
    weak: tuple[WeakDirection, ...] = ()
    messages: tuple[str, ...] = ()
    split: Split | None = None  # None: half of the frames determine too little
    certificate: Certificate | None = None  # None: not asked for


class Rung(Record):
    """One lens of the ladder, on a share of the tracks, beside the rung that stood before it."""

    lens: LensName
    held: tuple[str, ...] = ()  # coefficients that it holds at their nominal values
    held_out_px: float | None  # robust rms error in frames that it was not fitted to
    against: int  # the rung that it is compared with, counted from 0
    gain_px: float  # held-out error that it removes; negative: adds
    gain_sigmas: float  # that in its own standard errors
    shift_focal_px: float
    shift_centre_px: float
    sigma: dict[str, float]  # robust, of every lens parameter, as `camera.fx`
    weak: tuple[str, ...]  # directions, and coefficients that are left to belief
    verdict: str


class LensChoice(Record):
    """How `lens: auto` was decided."""

    chosen: int  # rung, counted from 0
    reason: str
    n_frames: int  # held out in turn
    n_observations: int
    rungs: tuple[Rung, ...]


class Selection(Record):
    """Of more observations than `max_observations`: what was kept, and what leaving the rest costs.

    Sigmas with what was kept over those with all, before the solve, of lenses and rig.
    """

    available: int
    kept: int
    sigma_factor: float  # median
    worst_sigma_factor: float


class Solve(Record):
    """How the optimum was reached, and on what."""

    converged: bool
    reason: str
    iterations: int
    rms_px: float
    n_frames: int
    n_images: int
    n_points: int
    n_observations: int
    n_rejected: int = 0  # mismatches, beyond the loss
    selection: Selection | None = None  # None: all observations were used
    seconds: dict[str, float] = Field(default_factory=dict)


class Calibration(Record):
    """The result of a calibration, or the truth of a simulation."""

    format: Literal["sfm_calib/1"] = FORMAT
    cameras: dict[str, CameraResult]
    rig: RigResult
    covariance: Covariance = Covariance()
    noise: Noise | None = None
    uncertainty: Uncertainty | None = None
    board: BoardResult | None = None  # None: none was used
    lens_choice: LensChoice | None = None  # None: every camera's lens was given
    verdict: Verdict | None = None
    solve: Solve | None = None
    recalibration: Recalibration | None = None  # None: it started from no calibration
    provenance: Provenance = Field(default_factory=lambda: Provenance(version=""))

    @model_validator(mode="after")
    def _rig_holds_every_camera(self) -> Calibration:
        if set(self.rig.cam_from_rig) != set(self.cameras):
            raise ValueError("rig.cam_from_rig and cameras must name the same cameras")
        if self.rig.reference not in self.cameras:
            raise ValueError(f"the reference {self.rig.reference!r} is none of the cameras")
        return self

    @model_validator(mode="after")
    def _kept_cameras_are_marked(self) -> Calibration:
        marked = {name for name, camera in self.cameras.items() if camera.kept_from}
        kept = set(self.recalibration.kept) if self.recalibration else set()
        if marked != kept:
            raise ValueError("recalibration.kept must name the cameras that have a kept_from")
        return self

    def camera(self, name: str) -> Camera:
        """The camera as the maths sees it."""
        entry = self.cameras[name]
        params = np.array([entry.params[p] for p in PARAMETER_NAMES[entry.lens]])
        return Camera(name, entry.lens, entry.size, params)

    def cam_from_rig(self, name: str) -> Transform:
        """How a camera sits on the rig."""
        entry = self.rig.cam_from_rig[name]
        return Transform.from_wxyz(entry.rotation_wxyz, entry.translation)


def truth(cameras: list[Camera], cam_from_rig: list[Transform], version: str) -> Calibration:
    """A calibration known exactly, as a simulation writes it: metric, without sigmas."""
    placed = zip(cameras, cam_from_rig, strict=True)
    return Calibration(
        cameras={c.name: CameraResult(lens=c.lens, size=c.size, params=c.named()) for c in cameras},
        rig=RigResult(
            reference=cameras[0].name,
            cam_from_rig={c.name: CamFromRig.of(c.name, t, {}) for c, t in placed},
            metric=True,
            scale=Scale(source="simulation", sigma_relative=0.0),
        ),
        provenance=Provenance(version=version),
    )


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write atomically. Raises CalibrationError when the place cannot be written."""
    write_atomically(path, calibration.model_dump_json(indent=1) + "\n")


def load_calibration(path: Path) -> Calibration:
    """Read a calibration.json. Raises CalibrationError naming the first thing wrong with it."""
    try:
        return Calibration.model_validate(json.loads(path.read_text()))
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = "".join(f"{part}." for part in first["loc"]).rstrip(".")
        wrong = f"{where}: {first['msg']}" if where else first["msg"]
        raise CalibrationError(f"{path} is no {FORMAT} file: {wrong}") from error
    except ValueError as error:
        raise CalibrationError(f"{path} is not JSON: {error}") from error

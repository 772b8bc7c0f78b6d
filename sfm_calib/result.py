"""`calibration.json`: the one result file that every command reads and writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from graphs.camera import Camera
from graphs.frames import Transform
from graphs.lenses import PARAMETER_NAMES, LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically

FORMAT: Final = "sfm_calib/1"


class Record(BaseModel):
    """A part of the file: frozen, without unknown keys, without NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class CameraResult(Record):
    """One camera. `sigma` and `prior_share` are empty where nothing was estimated (a truth)."""

    lens: LensName
    size: tuple[int, int]  # width, height in px
    params: dict[str, float]  # OpenCV's names; pixel centres at integers
    sigma: dict[str, float] = {}
    prior_share: dict[str, float] = {}  # var_posterior / var_prior: 1 belief alone, 0 data alone
    n_images: int = 0
    n_observations: int = 0

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


class Scale(Record):
    """What gives the rig's lengths their unit."""

    source: str  # what gave the unit of length
    sigma_relative: float | None = None  # None: no metric scale


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


class Noise(Record):
    """How well the features were located, and how far the stated sigmas exceed the model's."""

    sigma_px: float  # robust sigma of one pixel coordinate
    inflation: float = 1.0  # median of stated sigma / model sigma


class WeakDirection(Record):
    """Something that the scan leaves to the priors, and what would determine it."""

    what: str
    effect_px: float | None
    remedy: str


class Verdict(Record):
    """Whether to use the result, and what to know before."""

    usable: bool
    weak: tuple[WeakDirection, ...] = ()
    messages: tuple[str, ...] = ()


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
    seconds: dict[str, float] = {}


class Provenance(Record):
    """What made the result: enough to make it again."""

    version: str
    versions: dict[str, str] = {}
    command: str = ""
    config: dict[str, object] = {}
    seed: int = 0
    input_hashes: dict[str, str] = {}
    pixel_convention: Literal["OpenCV: the centre of the top-left pixel is (0, 0)"] = (
        "OpenCV: the centre of the top-left pixel is (0, 0)"
    )


class Calibration(Record):
    """The result of a calibration, or the truth of a simulation."""

    format: Literal["sfm_calib/1"] = FORMAT
    cameras: dict[str, CameraResult]
    rig: RigResult
    covariance: Covariance = Covariance()
    noise: Noise | None = None
    verdict: Verdict | None = None
    solve: Solve | None = None
    provenance: Provenance = Field(default_factory=lambda: Provenance(version=""))

    @model_validator(mode="after")
    def _rig_holds_every_camera(self) -> Calibration:
        if set(self.rig.cam_from_rig) != set(self.cameras):
            raise ValueError("rig.cam_from_rig and cameras must name the same cameras")
        if self.rig.reference not in self.cameras:
            raise ValueError(f"the reference {self.rig.reference!r} is none of the cameras")
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
    return Calibration(
        cameras={c.name: CameraResult(lens=c.lens, size=c.size, params=c.named()) for c in cameras},
        rig=RigResult(
            reference=cameras[0].name,
            cam_from_rig={
                c.name: CamFromRig(
                    rotation_wxyz=tuple(t.rotation_wxyz.tolist()),
                    translation=tuple(t.translation.tolist()),
                )
                for c, t in zip(cameras, cam_from_rig, strict=True)
            },
            metric=True,
            scale=Scale(source="simulation", sigma_relative=0.0),
        ),
        provenance=Provenance(version=version),
    )


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write atomically. Raises CalibrationError when the place cannot be written."""
    content = calibration.model_dump_json(indent=1)
    write_atomically(path, content + "\n")


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

"""Options of a calibration: one frozen class is the YAML key, the flag and the Python argument."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from graphs.build import LossName
from graphs.lenses import LensName
from sfm_calib.errors import CalibrationError

RIG_FILE = "rig.yaml"


class Options(BaseModel):
    """How a scan is read, mapped and solved."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    lens: LensName | Literal["auto"] = "auto"
    """Lens of every camera that rig.yaml gives none; auto: radtan for a rig, radial for one."""
    reference: str | None = None
    """Camera whose frame is the rig's frame; default: the first by name."""
    frames: Literal["stem", "order"] = "stem"
    """Which images make one frame: the same file stem, or the same place in sorted order."""
    pairs: Literal["auto", "all", "selected"] = "auto"
    """Image pairs to match; auto: all of a small scan, likely neighbours of a large one."""
    max_features: Annotated[int, Field(ge=100, le=50000)] = 8192
    """SIFT features an image, at most."""
    video_frames: Annotated[int, Field(ge=3, le=2000)] = 80
    """Frames picked from a video, at most."""
    loss: LossName = "cauchy"
    """Robust loss on feature observations."""
    min_parallax_deg: Annotated[float, Field(ge=0, le=90)] = 1.0
    """Points seen under a smaller angle are left out: they say little and harm the solve."""
    principal_point_sigma: Annotated[float, Field(gt=0, le=10)] = 0.03
    """Belief that the principal point is near the image centre: sigma in image widths."""
    aspect_sigma: Annotated[float, Field(gt=0, le=10)] = 0.005
    """Belief that pixels are square: sigma of fy / fx."""
    seed: Annotated[int, Field(ge=0, lt=2**31 - 100)] = 0
    """Seed of everything random."""


class CameraConfig(BaseModel):
    """What rig.yaml may say of one camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    lens: LensName | None = None
    params: dict[str, float] = {}  # where to start, and the mean of the prior
    sigma: dict[str, Annotated[float, Field(gt=0)]] = {}  # sigma of the prior on params
    fixed: tuple[str, ...] = ()  # parameters held at their start
    cam_from_rig: CamFromRigConfig | None = None


class CamFromRigConfig(BaseModel):
    """A nominal cam_from_rig; with sigmas also a prior."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma_rotation_deg: Annotated[float, Field(gt=0)] | None = None
    sigma_translation: Annotated[float, Field(gt=0)] | None = None


class BaselineConfig(BaseModel):
    """A measured distance between the optical centres of two cameras."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cameras: tuple[str, str]
    length_m: Annotated[float, Field(gt=0)]
    sigma_m: Annotated[float, Field(gt=0)]


class ScaleConfig(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    baseline: BaselineConfig | None = None


class RigConfig(Options):
    """Everything rig.yaml may hold: the options, and what is known of the rig."""

    cameras: dict[str, CameraConfig] = {}
    scale: ScaleConfig = ScaleConfig()

    def options(self) -> Options:
        """The options alone, without what is known of the rig."""
        return Options(**{name: getattr(self, name) for name in Options.model_fields})

    def with_options(self, options: Options) -> RigConfig:
        return self.model_copy(update=dict(options))


def load_rig_config(path: Path) -> RigConfig:
    """Read rig.yaml; an absent file is an empty one.

    Raises CalibrationError naming the key that is wrong and the nearest valid one.
    """
    try:
        content = yaml.safe_load(path.read_text()) if path.exists() else {}
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"cannot read {path}: {error}") from error
    except yaml.YAMLError as error:
        where = getattr(error, "problem_mark", None)
        line = f" in line {where.line + 1}" if where else ""
        raise CalibrationError(f"{path} is not valid YAML{line}: {error_text(error)}") from error
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} must hold keys and values, not {type(content).__name__}")
    try:
        return RigConfig.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {first_problem(error)}") from error


def error_text(error: yaml.YAMLError) -> str:
    return str(getattr(error, "problem", None) or error).splitlines()[0]


def first_problem(error: ValidationError) -> str:
    """The first validation error as one line, with the nearest valid name for an unknown key."""
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        names = _valid_names(problem["loc"])
        close = difflib.get_close_matches(str(problem["loc"][-1]), names, n=1, cutoff=0.0)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        return f"unknown key {where!r}{hint} Valid here: {', '.join(names)}"
    value = problem["input"]
    shown = f" (got {value!r})" if isinstance(value, str | int | float | bool) else ""
    return f"{where}: {problem['msg']}{shown}"


def _valid_names(location: tuple[str | int, ...]) -> list[str]:
    model: type[BaseModel] = RigConfig
    if location[:1] == ("cameras",):
        model = CamFromRigConfig if "cam_from_rig" in location[:-1] else CameraConfig
    elif location[:1] == ("scale",):
        model = BaselineConfig if "baseline" in location[:-1] else ScaleConfig
    return sorted(model.model_fields)


CameraConfig.model_rebuild()

"""Options of a calibration: one frozen class is the YAML key, the flag and the Python argument."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
)

from graphs.lenses import LensName
from graphs.losses import LossChoice
from graphs.refine import MAX_OBSERVATIONS
from graphs.selection import MIN_TRACK_LENGTH
from sfm_calib.errors import CalibrationError
from sfm_calib.files import read_text

RIG_FILE = "rig.yaml"
FEWEST_TWINS = 10  # the mean of fewer is known to a third and less
OF_A_UNION = re.compile(r"^constrained-|[\[(].*[\])]$")
QUATERNION_TOLERANCE = 0.01  # typed by hand to two digits


class SolveOptions(BaseModel):
    """How any problem is solved, of a scan or of a board."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    lens: Literal[LensName, "auto"] = "auto"
    """Lens of every camera that rig.yaml gives none; auto: what predicts frames held out best."""
    reference: Annotated[str | None, tyro.conf.arg(metavar="CAMERA")] = None
    """Camera whose frame is the rig's frame; default: the first by name."""
    video_frames: Annotated[int, Field(ge=3, le=2000)] = 80
    """Frames picked from a video, at most: 3 to 2000."""
    loss: LossChoice = "cauchy"
    """Robust loss on observations; adaptive: its shape estimated from the residuals."""
    principal_point_sigma: Annotated[float, Field(gt=0, le=10)] = 0.03
    """Belief that the principal point is near the image centre: sigma in image widths."""
    aspect_sigma: Annotated[float, Field(gt=0, le=10)] = 0.005
    """Belief that pixels are square: sigma of fy / fx."""
    certify: Annotated[int, tyro.conf.arg(metavar="N"), Field(ge=0, le=1000)] = 0
    """Simulate the scan so many times with its own geometry and noise, calibrate each, and report
    whether the stated sigmas hold: 10 or more, 20 give a first answer; 0: do not."""
    seed: Annotated[int, Field(ge=0, lt=2**31 - 100)] = 0
    """Seed of everything random."""

    @field_validator("certify")
    @classmethod
    def _enough_twins(cls, trials: int) -> int:
        if 0 < trials < FEWEST_TWINS:
            raise ValueError(f"{trials} twins show too little: give {FEWEST_TWINS} or more, or 0")
        return trials


class Options(SolveOptions):
    """How a scan is read, mapped and solved."""

    frames: Literal["stem", "order"] = "stem"
    """Which images make one frame: the same file stem, or the same place in sorted order."""
    pairs: Literal["auto", "all", "selected"] = "auto"
    """Image pairs to match; selected: neighbours in time and on the rig, and images that look
    alike; auto: all while matching them takes about three minutes, else selected."""
    features: Literal["sift", "xfeat", "aliked", "disk"] = "sift"
    """What is tracked: SIFT, or features of a network (needs sfm_calib[learned], and weights)."""
    matcher: Literal["auto", "nearest", "lightglue"] = "auto"
    """How learned features are matched: each with the nearest of the other image, or by LightGlue,
    which takes ten times as long; auto: the nearest."""
    weights: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Weights of the networks, a file or a folder; default: of an installed package, or fetched."""
    max_features: Annotated[int, Field(ge=100, le=50000)] = 8192
    """Features an image, at most: 100 to 50000."""
    image_scale: Annotated[float, Field(ge=0.1, le=1)] = 1.0
    """Find features in images reduced to this share of their size: 0.1 to 1. It is faster, and with
    --refine, which measures in full size, no less sharp."""
    refine: bool = False
    """Measure every track anew, by matching its patches: to hundredths of a pixel (needs torch)."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where torch computes."""
    min_parallax_deg: Annotated[float, Field(ge=0, le=90)] = 1.0
    """Points seen under a smaller angle are left out: they say little and harm the solve."""
    max_observations: Annotated[int, Field(ge=1000)] = MAX_OBSERVATIONS
    """Observations in the graph, at most: the tracks that say most, spread over the images."""


class TargetOptions(SolveOptions):
    """How images of a board are read and solved."""

    frames: Literal["stem", "order", "time"] = "stem"
    """Which images make one frame: the same file stem, the same place in sorted order, or the
    nearest time, where stems are times."""
    tolerance_s: Annotated[float, tyro.conf.arg(metavar="S"), Field(gt=0)] | None = None
    """Times this far apart, in seconds, may be one frame; default: a third of their spacing."""


class CameraConfig(BaseModel):
    """What rig.yaml may say of one camera."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    lens: LensName | None = None
    params: dict[str, float] = {}  # where to start, and the mean of the prior
    sigma: dict[str, Annotated[float, Field(gt=0)]] = {}  # sigma of the prior on params
    fixed: tuple[str, ...] = ()  # held at params, else nominal: 0, the image centre
    cam_from_rig: CamFromRigConfig | None = None

    @field_validator("params")
    @classmethod
    def _focal_lengths_are_positive(cls, params: dict[str, float]) -> dict[str, float]:
        for name in ("fx", "fy"):
            if params.get(name, 1.0) <= 0:
                raise ValueError(f"{name} is {params[name]:g} and must be positive")
        return params


class CamFromRigConfig(BaseModel):
    """A nominal cam_from_rig: mapping is also tried with it imposed; with sigmas also a prior."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rotation_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma_rotation_deg: Annotated[float, Field(gt=0)] | None = None
    sigma_translation: Annotated[float, Field(gt=0)] | None = None

    @field_validator("rotation_wxyz")
    @classmethod
    def _quaternion_has_length_one(
        cls, rotation: tuple[float, float, float, float]
    ) -> tuple[float, float, float, float]:
        length = math.hypot(*rotation)
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            raise ValueError(f"a rotation has length 1 and this has {length:.3g}")
        return rotation


class BaselineConfig(BaseModel):
    """A measured distance between the optical centres of two cameras."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cameras: tuple[str, str]
    length_m: Annotated[float, Field(gt=0)]
    sigma_m: Annotated[float, Field(gt=0)]


class FramesConfig(BaseModel):
    """A measured distance between the reference camera's places at two frames."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    between: tuple[str, str]
    length_m: Annotated[float, Field(gt=0)]
    sigma_m: Annotated[float, Field(gt=0)]


class ClickConfig(BaseModel):
    """Where a mark was seen in one image."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    camera: str
    frame: str
    pixel: tuple[float, float]  # the centre of the top-left pixel is (0, 0)


class PointsConfig(BaseModel):
    """A measured distance between two marks in the scene, each clicked in several images."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    between: tuple[tuple[ClickConfig, ...], tuple[ClickConfig, ...]]
    length_m: Annotated[float, Field(gt=0)]
    sigma_m: Annotated[float, Field(gt=0)]
    click_sigma_px: Annotated[float, Field(gt=0, le=100)] = 1.0  # of each coordinate

    @field_validator("between")
    @classmethod
    def _marks_are_clicked_often_enough(
        cls, marks: tuple[tuple[ClickConfig, ...], tuple[ClickConfig, ...]]
    ) -> tuple[tuple[ClickConfig, ...], tuple[ClickConfig, ...]]:
        for which, clicks in zip(("first", "second"), marks, strict=True):
            if len(clicks) < MIN_TRACK_LENGTH:
                raise ValueError(
                    f"the {which} mark has {len(clicks)} clicks and needs {MIN_TRACK_LENGTH}: "
                    "click it in more images, taken from different places"
                )
        return marks


Measured = BaselineConfig | FramesConfig | PointsConfig


def _one_or_several(model: type[BaseModel]) -> WrapValidator:
    """One entry without a list around it is a list of one; errors name it without a number."""

    def validate(given: object, several: ValidatorFunctionWrapHandler) -> object:
        if given is None:
            return ()
        if isinstance(given, list | tuple):
            return several(given)
        return (model.model_validate(given),)

    return WrapValidator(validate)


class ScaleConfig(BaseModel):
    """What gives the rig's lengths in metres: measured distances, of each kind one or a list."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    baseline: Annotated[tuple[BaselineConfig, ...], _one_or_several(BaselineConfig)] = ()
    frames: Annotated[tuple[FramesConfig, ...], _one_or_several(FramesConfig)] = ()
    points: Annotated[tuple[PointsConfig, ...], _one_or_several(PointsConfig)] = ()

    @property
    def measured(self) -> tuple[tuple[str, Measured], ...]:
        """Every distance that is given, after its key: `scale.frames`, of several `.1`, `.2`."""
        return tuple(
            (f"scale.{kind}.{number}" if len(given) > 1 else f"scale.{kind}", one)
            for kind in ScaleConfig.model_fields
            for given in (getattr(self, kind),)
            for number, one in enumerate(given)
        )


class RigConfig(Options):
    """Everything rig.yaml may hold: the options, and what is known of the rig."""

    cameras: dict[str, CameraConfig] = {}
    shared_lenses: tuple[tuple[str, ...], ...] = ()  # groups of cameras with one and the same lens
    scale: ScaleConfig = ScaleConfig()

    def options(self) -> Options:
        """The options alone, without what is known of the rig."""
        return Options(**{name: getattr(self, name) for name in Options.model_fields})

    def with_options(self, options: SolveOptions) -> RigConfig:
        """With these options in place of its own, as far as it has them."""
        own = {name: value for name, value in options if name in RigConfig.model_fields}
        if own.get("frames") == "time":  # of a board's images alone
            del own["frames"]
        return self.model_copy(update=own)

    def target_options(self) -> TargetOptions:
        """What it says on how to solve, as options of a target-based calibration."""
        known = set(TargetOptions.model_fields) & set(RigConfig.model_fields)
        return TargetOptions(**{name: getattr(self, name) for name in known})


def load_rig_config(path: Path) -> RigConfig:
    """Read rig.yaml; an absent file is an empty one.

    Raises CalibrationError naming the key that is wrong and the nearest valid one.
    """
    misnamed = path.with_suffix(".yml")
    if misnamed.exists() and not path.exists():
        raise CalibrationError(f"{misnamed} is not read: call it {path.name}")
    content = read_yaml(path) if path.exists() else {}
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise CalibrationError(
            f"{path} holds one {type(content).__name__}, not keys and values like 'lens: radtan'"
        )
    try:
        return RigConfig.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {first_problem(error)}") from error


def read_yaml(path: Path) -> object:
    """What a YAML file holds. Raises CalibrationError naming the line that is wrong."""
    text = read_text(path, "write it as YAML")
    try:
        return yaml.load(text, _NoKeyTwice)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        where = getattr(error, "problem_mark", None)
        line = f" in line {where.line + 1}" if where else ""
        raise CalibrationError(f"{path} is not valid YAML{line}: {error_text(error)}") from error


class _NoKeyTwice(yaml.SafeLoader):
    """YAML in which a key that stands twice is an error: the last would win without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[object] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"the key {key.value!r} stands twice", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def error_text(error: Exception) -> str:
    """The first line of what a parser says."""
    return (str(getattr(error, "problem", None) or error).splitlines() or [""])[0]


def first_problem(
    error: ValidationError,
    spell: Callable[[str], str] = str,
    model: type[BaseModel] | None = None,
) -> str:
    """The first validation error as one line, with the nearest valid name for an unknown key.

    `spell` turns a key into what the user wrote, such as a flag; model: what was validated, where
    it is neither a RigConfig nor nested.
    """
    problems = error.errors()
    # A misspelt key is often also a missing one; the misspelling is what to tell.
    unknown = (problem for problem in problems if problem["type"] == "extra_forbidden")
    problem = next(unknown, problems[0])
    # Pydantic names which of several types it tried, such as constrained-int.
    parts = [str(part) for part in problem["loc"] if not OF_A_UNION.search(str(part))]
    where = spell(".".join(parts))
    if problem["type"] == "extra_forbidden":
        names = sorted(model.model_fields) if model else _valid_names(problem["loc"])
        close = difflib.get_close_matches(str(problem["loc"][-1]), names, n=1, cutoff=0.0)
        hint = f"did you mean {close[0]!r}? " if close else ""
        return f"unknown key {where!r}: {hint}Valid here: {', '.join(names)}"
    value = problem["input"]
    is_number = isinstance(value, int | float)
    if "[key]" in problem["loc"] or (problem["type"] == "string_type" and is_number):
        return f"{where}: the name {value!r} is a {type(value).__name__}; put it in quotes"
    if problem["type"] == "tuple_type":
        return f"{where}: takes a list, like [a, b] (got {value!r})"
    message = problem["msg"].removeprefix("Value error, ")
    shown = f" (got {value!r})" if isinstance(value, str | int | float | bool) else ""
    return f"{where}: {message}{shown}" if where else message


def _valid_names(location: tuple[str | int, ...]) -> list[str]:
    model: type[BaseModel] = RigConfig
    if location[:1] == ("cameras",):
        model = CamFromRigConfig if "cam_from_rig" in location[:-1] else CameraConfig
    elif location[:1] == ("scale",):
        sources: dict[int | str, type[BaseModel]] = {
            "baseline": BaselineConfig,
            "frames": FramesConfig,
            "points": ClickConfig if "between" in location[:-1] else PointsConfig,
        }
        model = sources[location[1]] if len(location) > 2 else ScaleConfig
    return sorted(model.model_fields)


CameraConfig.model_rebuild()

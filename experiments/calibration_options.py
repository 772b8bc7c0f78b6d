"""The options of one calibration of a study: where its images come from, what is done, and how.

Every option of a command is one here, by its own name and from its own class, and may be swept.
Left out, it is what the scan's rig.yaml says, or the default: as on the command line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
    create_model,
    model_validator,
)

from experiments.runner.protocol import TrialOptions
from sfm_calib.config import Options, TargetOptions, first_problem
from sfm_calib.drift import DriftOptions
from sfm_calib.errors import CalibrationError
from sfm_calib.images import MIN_IMAGES
from sfm_calib.recalibrate import RecalibrateOptions
from sfm_calib.simulate import scan as rendered
from sfm_calib.simulate import tracks
from sfm_calib.simulate.scan import SimulateOptions
from sfm_calib.simulate.tracks import TrackOptions

Command = Literal["calibrate", "recalibrate", "target"]
TAKEN: dict[Command, tuple[type, ...]] = {
    "calibrate": (Options,),
    "recalibrate": (Options, RecalibrateOptions, DriftOptions),
    "target": (TargetOptions,),
}
SIMULATED: dict[str, type[SimulateOptions] | type[TrackOptions]] = {
    "images": SimulateOptions,
    "tracks": TrackOptions,
}
# Absolute, for a cluster's workers run in folders of their own.
Place = Annotated[Path, AfterValidator(lambda path: path.expanduser().absolute())]
SIMULATE, CHANGED = "simulate.", "changed."
LIKE = SIMULATE + "like"
SEED = "seed"  # of everything random: the trial's, added to what rig.yaml and simulate.seed say


class Changed(BaseModel):
    """What happened to a simulated rig between its old calibration and the scan."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    camera: str
    """The camera that was touched."""
    turn_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """It was turned by so much about its own vertical axis."""
    focal_percent: Annotated[float, Field(gt=-90, le=1000)] = 0.0
    """Its focal lengths grew by so much."""


def names_of(model: type) -> tuple[str, ...]:
    """The names of a class's options."""
    if is_dataclass(model):
        return tuple(one.name for one in fields(model))
    assert issubclass(model, BaseModel)
    return tuple(model.model_fields)


class CalibrationOptions(TrialOptions):
    """One calibration. Paths are relative to the current directory, as on the command line."""

    name: str | None = None
    """How tables call it: the rig's name in a fleet. Default: the scan's folder."""
    command: Command = "calibrate"
    """What is done: that command of sfm-calib."""
    scan: Place | None = None
    """The scan; for `target` the images of the board."""
    stretch: Annotated[int, Field(ge=MIN_IMAGES)] | None = None
    """Only so many consecutive frames of the scan, from a place that the seed draws."""
    old: Place | None = None
    """The calibration to test, for `recalibrate`; of a simulated rig by default its truth."""
    board: Place | None = None
    """The board's YAML, for `target`, and for `calibrate` with a board."""
    board_images: Place | None = None
    """Images of the board by the scan's cameras."""
    truth: Place | None = None
    """A truth, or another calibration of the same rig in any format, to compare with."""
    simulate: Literal["images", "tracks"] | None = None
    """In place of a scan: rendered images, or feature tracks, which take no mapping; as the options
    simulate.* say."""
    report: bool = True
    """Leave report.html beside calibration.json: 5 MB."""

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        for misfit in misfits(self):
            raise ValueError(misfit)
        try:
            for model in TAKEN[self.command]:
                self.part(model)
            if any(name.startswith(CHANGED) for name in self.said):
                self.part(Changed, CHANGED)
            if self.simulate == "images":
                rendered.check_options(self.part(SimulateOptions, SIMULATE))
            elif self.simulate == "tracks":
                tracks.check_options(self.part(TrackOptions, SIMULATE))
        except CalibrationError as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def said(self) -> dict[str, Any]:
        """Every option of a command, a simulation or a change that is said, by its key here."""
        base = type(self).__base__  # holds what is of trials themselves
        assert base is not None and issubclass(base, CalibrationOptions)
        own = base.model_fields
        return {
            key: value
            for key in type(self).model_fields
            if key not in own and (value := getattr(self, key)) is not None
        }

    def given(self, model: type, prefix: str = "") -> dict[str, Any]:
        """What is said of a class's options, by the class's names."""
        said = self.said
        return {name: said[key] for name in names_of(model) if (key := prefix + name) in said}

    def part(self, model: type[Any], prefix: str = "") -> Any:
        """A class's options, defaults where nothing is said.

        Raises CalibrationError for what the class refuses.
        """
        try:
            return TypeAdapter(model).validate_python(self.given(model, prefix))
        except ValidationError as error:
            raise CalibrationError(first_problem(error, lambda key: prefix + key, model)) from error


def misfits(options: CalibrationOptions) -> Iterator[str]:
    """What of a trial's options does not go together, and the remedy."""
    command, simulated = options.command, options.simulate
    if (options.scan is None) == (simulated is None):
        yield "say what to calibrate from: scan, a folder or a video, or simulate: images or tracks"
    if command == "recalibrate" and options.old is None and simulated is None:
        yield "recalibrate needs old: the calibration to test"
    if command == "target" and options.board is None and simulated != "images":
        yield "target needs board: the YAML of the board that the images show"
    if options.board_images and not options.board:
        yield "board_images needs board: the YAML of the board that they show"
    for key, at, commands in (
        ("old", options.old, ("recalibrate",)),
        ("board", options.board, ("calibrate", "target")),
        ("board_images", options.board_images, ("calibrate",)),
    ):
        if at is not None and command not in commands:
            yield f"{key} is for {' and '.join(commands)}, and the command is {command}"
    if simulated:
        for key in ("stretch", "truth", "board_images"):
            if getattr(options, key) is not None:
                yield f"{key} is for a scan, and this trial simulates one"
    if simulated == "tracks" and (command == "target" or options.board):
        yield "simulated tracks have no board: simulate images, with simulate.board"
    yield from _strangers(options)


def _strangers(options: CalibrationOptions) -> Iterator[str]:
    """Options that are said and that nothing of the trial takes."""
    taken = {name for model in TAKEN[options.command] for name in names_of(model)}
    if options.simulate:
        taken |= {SIMULATE + name for name in (*names_of(SIMULATED[options.simulate]), SEED)}
        if options.command == "recalibrate":
            taken |= {CHANGED + name for name in names_of(Changed)}
    for key in options.said:
        if key in taken:
            continue
        if key.startswith(SIMULATE):
            says = f"simulates {options.simulate}" if options.simulate else "does not say simulate"
            yield f"{key} is not for this trial, which {says}"
        elif key.startswith(CHANGED):
            yield f"{key} is of a simulated rig that is recalibrated: say simulate, and command"
        else:
            owners = [c for c in TAKEN if any(key in names_of(m) for m in TAKEN[c])]
            yield f"{key} is for {' and '.join(owners)}, and the command is {options.command}"


def optional(model: type, prefix: str = "") -> dict[str, Any]:
    """A class's options as fields that may be left out; ranges stay where they are."""
    hints = get_type_hints(model, include_extras=True)
    return {f"{prefix}{name}": (hints[name] | None, None) for name in names_of(model)}


def of_commands() -> dict[str, Any]:
    """Every option of a command, a simulation or a change, as a field that may be left out."""
    # TargetOptions after Options: it takes every `frames` that they do, and one more.
    commands = (Options, TargetOptions, RecalibrateOptions, DriftOptions)
    found = {key: field for model in commands for key, field in optional(model).items()}
    del found[SEED]
    for model in SIMULATED.values():
        found |= optional(model, SIMULATE)
    found[LIKE] = (Place | None, None)
    return found | optional(Changed, CHANGED)


CalibrationTrial: type[CalibrationOptions] = create_model(
    "CalibrationTrial", __base__=CalibrationOptions, __module__=__name__, **of_commands()
)
CalibrationTrial.__doc__ = CalibrationOptions.__doc__

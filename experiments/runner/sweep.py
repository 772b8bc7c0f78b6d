"""A study's config file, and the trials that it asks for."""

from __future__ import annotations

import difflib
import hashlib
import itertools
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

import sfm_calib
from experiments.runner.protocol import Study, TrialOptions
from experiments.runner.registry import check_name, study_of
from sfm_calib.config import first_problem, read_yaml
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.files import sha256

MOST_TRIALS = 1_000_000
KEY_LENGTH = 16  # hex digits: a chance of 1e-8 that two of a million trials share one


class StudyConfig(BaseModel):
    """Everything a study's YAML may hold: grid x list x seeds are its trials."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    study: str  # a file under experiments/
    options: dict[str, Any] = {}  # the same in all trials
    grid: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = {}  # every combination
    list: tuple[dict[str, Any], ...] = ()  # combinations one by one
    seeds: (
        Annotated[int, Field(ge=1, le=MOST_TRIALS)]
        | Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    ) = 1
    threads: Annotated[int, Field(ge=1)] | Literal["all"] = 1  # of one trial
    seconds: Annotated[float, Field(gt=0)] | None = None  # that a trial takes, for --dry-run

    @field_validator("study")
    @classmethod
    def _is_a_study(cls, name: str) -> str:
        check_name(name)
        return name

    @property
    def all_seeds(self) -> tuple[int, ...]:
        return tuple(range(self.seeds)) if isinstance(self.seeds, int) else self.seeds


@dataclass(frozen=True)
class Trial:
    """One trial that is asked for."""

    study: str
    options: TrialOptions
    seed: int
    key: str  # of all that its row depends on


# ---- the file ------------------------------------------------------------------------------


def load_study(path: Path, settings: Sequence[str] = ()) -> StudyConfig:
    """Read a study's YAML, with `key=value` settings in place of what it says.

    Raises CalibrationError naming the key that is wrong and the nearest valid one.
    """
    if not path.exists():
        raise CalibrationError(f"{path} is not there: give a study's YAML, as in configs/studies")
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise CalibrationError(f"{path} holds no keys: begin with 'study: NAME'")
    for setting in settings:
        _override(content, setting)
    if "study" not in content:
        raise CalibrationError(f"{path} names no study: begin with 'study: NAME'")
    try:
        config = StudyConfig.model_validate(content)
    except ValidationError as error:
        raise CalibrationError(f"{path}: {first_problem(error, model=StudyConfig)}") from error
    _check_keys(config, path)
    return config


def _override(content: dict[str, Any], setting: str) -> None:
    """Put `key=value`, or `part.key=value`, in its place.

    An option set by hand is one for all trials: it takes the place of what was swept.
    """
    name, equals, text = setting.partition("=")
    part, dot, key = name.strip().partition(".")
    if not equals or not part or (dot and not key):
        raise CalibrationError(
            f"--set {setting}: write key=value, such as seeds=5 or options.points=300"
        )
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CalibrationError(f"--set {setting}: {text!r} is not valid YAML") from error
    if not dot:
        content[part] = value
        return
    parts = ("options", "grid")
    if part not in parts:
        close = difflib.get_close_matches(part, parts, n=1, cutoff=0.0)[0]
        raise CalibrationError(f"--set {setting}: unknown part {part!r}; did you mean {close!r}?")
    for other in (*parts, "list"):
        held = content.get(other) or {}
        for group in held if isinstance(held, list) else [held]:
            if isinstance(group, dict):
                group.pop(key, None)
    if isinstance(content.get("list"), list):  # entries that differed in it alone are one now
        listed = content["list"]
        content["list"] = [one for k, one in enumerate(listed) if one not in listed[:k]]
    content.setdefault(part, {})
    if content[part] is None:
        content[part] = {}
    content[part][key] = value


def _check_keys(config: StudyConfig, path: Path) -> None:
    """Raises CalibrationError for an option that the study does not have, or that is said twice."""
    known = sorted(study_of(config.study).options.model_fields)
    places: dict[str, str] = {}
    listed = dict.fromkeys(key for one in config.list for key in one)
    for part, keys in (("options", config.options), ("grid", config.grid), ("list", listed)):
        for key in keys:
            if key not in known:
                raise CalibrationError(
                    f"{path}: {part}: {config.study} has no option {key!r}: {nearest(key, known)}"
                )
            if key in places:
                raise CalibrationError(
                    f"{path}: {key!r} is in {places[key]} and in {part}: say it once"
                )
            places[key] = part


# ---- its trials ----------------------------------------------------------------------------


def trials_of(config: StudyConfig) -> list[Trial]:
    """Every trial, those of one seed together; options and inputs are checked here.

    Raises CalibrationError naming the trial whose options are wrong.
    """
    study = study_of(config.study)
    combinations = math.prod(map(len, config.grid.values())) * max(1, len(config.list))
    seeds = config.seeds if isinstance(config.seeds, int) else len(config.seeds)
    if combinations * seeds > MOST_TRIALS:
        raise CalibrationError(
            f"{combinations} combinations x {seeds} seeds are more than {MOST_TRIALS:,} trials: "
            "sweep less"
        )
    swept = list(_combinations(config))
    options = [_checked(study, config.options | one, one) for one in swept]
    digests: dict[Path, str] = {}
    hashed = [_inputs(study, one, digests) for one in options]
    trials = [
        Trial(config.study, one, seed, trial_key(config.study, one, seed, inputs))
        for seed in config.all_seeds
        for one, inputs in zip(options, hashed, strict=True)
    ]
    if len({trial.key for trial in trials}) < len(trials):
        seen: set[str] = set()
        twice = next(t for t in trials if t.key in seen or seen.add(t.key))  # type: ignore[func-returns-value]
        raise CalibrationError(
            f"two trials are the same: seed {twice.seed}, "
            f"{json.dumps(twice.options.model_dump(mode='json'))}; list each once"
        )
    return trials


def in_words(trial: Trial, config: StudyConfig) -> str:
    """What tells a trial from the others of its study."""
    options = trial.options.model_dump(mode="json")
    swept = dict.fromkeys([*config.grid, *(key for one in config.list for key in one)])
    return ", ".join([*(f"{key}={options[key]}" for key in swept), f"seed={trial.seed}"])


def _combinations(config: StudyConfig) -> Iterator[dict[str, Any]]:
    for one in config.list or ({},):
        for values in itertools.product(*config.grid.values()):
            yield one | dict(zip(config.grid, values, strict=True))


def _checked(study: Study[Any], given: dict[str, Any], swept: dict[str, Any]) -> TrialOptions:
    try:
        options: TrialOptions = study.options.model_validate(given)
    except ValidationError as error:
        trial = f" (trial {json.dumps(swept, default=str)})" if swept else ""
        raise CalibrationError(f"{first_problem(error, model=study.options)}{trial}") from error
    return options


def _inputs(
    study: Study[Any], options: TrialOptions, digests: dict[Path, str]
) -> tuple[tuple[str, str], ...]:
    """Name and digest of every file that a trial reads."""
    found = []
    for path in study.inputs(options):
        if path not in digests:  # without it the trial refuses, until it is there
            digests[path] = content_digest(path) if path.exists() else "missing"
        found.append((str(path), digests[path]))
    return tuple(found)


def content_digest(path: Path) -> str:
    """Digest of a file's bytes, or of the names and digests of all files in a folder."""
    if not path.is_dir():
        return sha256(path)
    digest = hashlib.sha256()
    for file in sorted(_files(path)):
        digest.update(sha256(file).encode() + os.fsencode(file.relative_to(path)))
    return digest.hexdigest()


def _files(folder: Path) -> Iterator[Path]:
    """All files in it, in folders that are links too, those that lead back once."""
    seen: set[str] = set()
    for at, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(at)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        yield from (file for name in names if (file := Path(at, name)).is_file())


def trial_key(
    study: str, options: TrialOptions, seed: int, inputs: Sequence[tuple[str, str]]
) -> str:
    """Digest of what a row depends on: the release too, though not every state of the code."""
    content = json.dumps(
        [
            sfm_calib.__version__,
            study,
            options.model_dump(mode="json"),
            seed,
            [d for _, d in inputs],
        ],
        sort_keys=True,
    )
    return hashlib.sha256(content.encode()).hexdigest()[:KEY_LENGTH]

"""What a study is: the options of one trial, what a trial measures, what all trials answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

import plotly.graph_objects as go
from pydantic import BaseModel, ConfigDict

# What a trial may measure. Lists of one column have one length; None: not measured.
Cell = bool | int | float | str | Sequence[float] | Sequence[str] | None
Row = Mapping[str, Cell]
TIMING = "seconds"  # columns that begin so are times: the only ones that two runs may differ in


class TrialOptions(BaseModel):
    """What one trial does: the keys that `options`, `grid` and `list` of a study's YAML may have.

    Ranges belong in the fields: they are checked for all trials before the first one runs.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


OptionsT = TypeVar("OptionsT", bound=TrialOptions)


@dataclass(frozen=True)
class Finished(Generic[OptionsT]):
    """One trial that was run. `row` is empty where it failed, and `error` then says why."""

    options: OptionsT
    seed: int
    row: Row
    seconds: float
    error: str | None = None


@dataclass(frozen=True)
class AnswerTable:
    """A table of the answer: a CSV file, and a part of the page."""

    name: str  # of the file
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | float | int | bool | None, ...], ...]


@dataclass(frozen=True)
class AnswerFigure:
    """A figure of the answer, with what to look for in it."""

    name: str
    title: str
    caption: str
    figure: go.Figure


@dataclass(frozen=True)
class Answer:
    """What a study found, beside what it expected."""

    verdict: str  # one line with the numbers, for the index
    holds: bool | None  # the expectation; None: nothing was expected, or too few trials to say
    tables: tuple[AnswerTable, ...] = ()
    figures: tuple[AnswerFigure, ...] = ()


def no_inputs(options: TrialOptions) -> Sequence[Path]:
    """Of a trial that simulates."""
    return ()


@dataclass(frozen=True)
class Study(Generic[OptionsT]):
    """One question. Its module's docstring says question, method, expectation and source.

    trial: measures one row, from the options and a seed alone: the same wherever and whenever it
        runs. What it cannot do it refuses by CalibrationError or ValueError: a row with the error.
    answer: from all finished trials of the config, in its order, those that failed among them.
    inputs: files and folders that a trial reads; when their content changes it is run again.
    folder: trials also get OUT/trials/KEY as a keyword `folder`, to leave files in.
    """

    options: type[OptionsT]
    trial: Callable[..., Row]
    answer: Callable[[Sequence[Finished[OptionsT]]], Answer]
    inputs: Callable[[OptionsT], Sequence[Path]] = field(default=no_inputs)
    folder: bool = False

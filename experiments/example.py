"""Does the mean of n draws err by sigma / sqrt(n)?

A study to copy: everything that a study has, around a trial that takes no time.
Method: draw, average, compare with the true mean, 0; repeat with other seeds.
Expectation: the error's RMS over sigma / sqrt(n) is 1, within three standard errors.
Source: any textbook.
Run: sfm-calib run configs/studies/example.yaml -o out/example
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from experiments.runner.figures import Series, lines
from experiments.runner.protocol import (
    Answer,
    AnswerFigure,
    AnswerTable,
    Finished,
    Row,
    Study,
    TrialOptions,
)

STANDARD_ERRORS = 3.0


class ExampleOptions(TrialOptions):
    """One average."""

    draws: Annotated[int, Field(ge=1, le=1_000_000)] = 10
    """How many numbers are averaged."""
    sigma: Annotated[float, Field(gt=0)] = 1.0
    """Of each number."""
    pause_s: Annotated[float, Field(ge=0, le=60)] = 0.0
    """How long to wait first: a trial that takes time, to try the runner with."""


def trial(options: ExampleOptions, seed: int) -> Row:
    """Average some numbers."""
    time.sleep(options.pause_s)
    rng = np.random.default_rng(seed)
    draws = options.sigma * rng.standard_normal(options.draws)
    if options.draws < 2:
        raise ValueError("one number has no scatter: give 2 draws or more")
    return {"error": float(draws.mean()), "scatter": float(draws.std(ddof=1))}


def answer(trials: Sequence[Finished[ExampleOptions]]) -> Answer:
    """RMS of the errors over what is expected, for each number of draws."""
    rows = []
    for draws in sorted({t.options.draws for t in trials}):
        some = [t for t in trials if t.options.draws == draws and t.error is None]
        if some:
            expected = np.array([t.options.sigma / draws**0.5 for t in some])
            error = np.array([t.row["error"] for t in some])
            ratio = float(np.sqrt(np.mean((error / expected) ** 2)))
            rows.append((draws, len(some), ratio, 1 / (2 * len(some)) ** 0.5))
    if not rows:
        return Answer("no trial was finished", None)
    holds = all(abs(ratio - 1) <= STANDARD_ERRORS * bar for _, _, ratio, bar in rows)
    worst = max(rows, key=lambda row: abs(row[2] - 1))
    table = AnswerTable(
        "ratios", "RMS error", ("draws", "trials", "RMS / expected", "±"), tuple(rows)
    )
    x, _, ratios, bars = zip(*rows, strict=True)
    figure = lines([Series("RMS", x, ratios, bars)], "draws", "RMS / expected", log_x=True, level=1)
    said = f"RMS over sigma / sqrt(n) {worst[2]:.2f} at worst (n = {worst[0]})"
    return Answer(
        f"{'yes' if holds else 'no'}: {said}",
        holds,
        (table,),
        (AnswerFigure("ratios", "Error", "It should stay at 1.", figure),),
    )


STUDY = Study(ExampleOptions, trial, answer)

"""Does the solver find the optimum from a badly wrong lens?

Question: with the focal length off by 30 %, no distortion and the principal point off by 5 % of
the width, does one solve end where a start at the truth ends?
Method: simulated scans, 20 a kind of rig, focal lengths too short and too long in turn, frames off
by 1 degree and 3 cm, points by 5 cm; whether the cost is that from the truth to 1e-6.
Expectation: it always is, on well-conditioned scenes.
Source: our own requirement; a focal length guessed from nothing is off by as much.
Run: sfm-calib run configs/studies/wrong_starts.yaml -o out/wrong_starts
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

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
from graphs.build import GraphOptions, build
from graphs.camera import Camera
from graphs.lenses import LensName
from graphs.losses import SCALE_95, LossName
from graphs.priors import weak_lens_prior
from graphs.problem import Problem
from graphs.solve import SolveSummary, solve
from sfm_calib.simulate.rigs import RigName
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
SCAN = TrackOptions(points=3000, max_points_per_image=150, sigma_px=SIGMA_PX, baseline_sigma_m=0.0)
SAME_COST = 1e-6  # relative


class WrongStartOptions(TrialOptions):
    """One wrong start."""

    rig: RigName = "triple"
    """Cameras and how they sit on the rig."""
    lens: LensName = "radtan"
    """Of every camera."""
    frames: Annotated[int, Field(ge=6, le=500)] = 20
    """How many images each camera takes."""
    loss: LossName = "cauchy"
    """Of the feature observations."""
    focal_error: Annotated[float, Field(ge=0, le=0.8)] = 0.3
    """Relative; too short where the seed is even, too long where it is odd."""
    principal_point_error: Annotated[float, Field(ge=0, le=0.3)] = 0.05
    """Of the width."""

    @property
    def kind(self) -> str:
        """In few words, with what is not as usual."""
        usual = WrongStartOptions()
        words: list[str] = [self.rig, self.lens, self.loss]
        if self.focal_error != usual.focal_error:
            words.append(f"f {100 * self.focal_error:g} % off")
        if self.principal_point_error != usual.principal_point_error:
            words.append(f"centre {100 * self.principal_point_error:g} % off")
        return " ".join([*words, f"{self.frames} frames"])


def trial(options: WrongStartOptions, seed: int) -> Row:
    """Solve one scan from the truth and from the wrong start."""
    tracks = SCAN.model_copy(
        update={
            "rig": options.rig,
            "lens": options.lens,
            "frames": options.frames,
            "focal_error": options.focal_error if seed % 2 else -options.focal_error,
            "principal_point_error_px": options.principal_point_error * SCAN.size[0],
        }
    )
    problem, truth = simulate_tracks(tracks, np.random.default_rng(seed))
    priors = tuple(weak_lens_prior(camera) for camera in truth.cameras)
    graph_options = GraphOptions(
        SIGMA_PX, loss=options.loss, loss_scale=SCALE_95[options.loss], lens_priors=priors
    )
    best = _solved(replace(problem, initial=truth), graph_options)
    start = replace(problem.initial, cameras=_undistorted(problem.initial.cameras))
    found = _solved(replace(problem, initial=start), graph_options)
    return {
        "cost_above": found.cost / best.cost - 1,
        "iterations": found.iterations,
        "iterations_from_truth": best.iterations,
        "reason": found.reason,
    }


def _undistorted(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras with all coefficients zero."""
    return tuple(
        replace(camera, params=np.append(camera.params[:4], np.zeros(camera.params.size - 4)))
        for camera in cameras
    )


def _solved(problem: Problem, options: GraphOptions) -> SolveSummary:
    return solve(build(problem, options))[2]


def answer(trials: Sequence[Finished[WrongStartOptions]]) -> Answer:
    """How many of each kind end at the optimum, or below it."""
    rows, missed = [], []
    for options in dict.fromkeys(one.options for one in trials):
        some = [one for one in trials if one.options == options]
        rows.append((options.kind, *_told(some)))
        missed += [(options.kind, one.seed, _why(one)) for one in some if not _found(one)]
    if not rows:
        return Answer("no trial was finished", None)
    columns = ("kind", "at the optimum", "of", "iterations, mean", "most", "from the truth, mean")
    tables = [AnswerTable("kinds", "Wrong starts that ended at the optimum", columns, tuple(rows))]
    if missed:
        table = AnswerTable("missed", "Elsewhere", ("kind", "seed", "how"), tuple(missed))
        tables.append(table)
    shares = [100 * row[1] / row[2] for row in rows]
    figure = lines([Series("", [row[0] for row in rows], shares)], "", "at the optimum, %")
    holds = not missed
    most = max((row[4] for row in rows if row[4] is not None), default=0)
    share = f"{len(trials) - len(missed)} of {len(trials)} wrong starts"
    return Answer(
        f"{'yes' if holds else 'no'}: {share} end at the optimum, in at most {most} iterations",
        holds,
        tuple(tables),
        (AnswerFigure("kinds", "Found", "All of them should be.", figure),),
    )


def _found(one: Finished[WrongStartOptions]) -> bool:
    above: Any = one.row.get("cost_above")
    return above is not None and above <= SAME_COST


def _why(one: Finished[WrongStartOptions]) -> str:
    if one.error is not None:
        return one.error
    return f"cost above the optimum's by {one.row['cost_above']:.1e}, {one.row['reason']}"


def _told(
    some: Sequence[Finished[WrongStartOptions]],
) -> tuple[int, int, float | None, int | None, float | None]:
    """How many were found, of how many, and the iterations of those that were solved."""
    solved: list[Any] = [one.row for one in some if one.error is None]
    found = sum(_found(one) for one in some)
    if not solved:
        return found, len(some), None, None, None
    steps, near = ([row[n] for row in solved] for n in ("iterations", "iterations_from_truth"))
    return found, len(some), float(np.mean(steps)), max(steps), float(np.mean(near))


STUDY = Study(WrongStartOptions, trial, answer)

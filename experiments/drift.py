"""Is drift found where there is some, none where there is none, and doubt said where it is?

Question: a rig was calibrated; later it may have been touched. Does the drift test, from the old
calibration and one ordinary scan, say keep, replace and inconclusive rightly, and name the camera?
Method: simulated rigs; the old calibration errs as its sigmas say; one camera, any of them, is
changed; a scan of the changed rig is solved as `sfm-calib calibrate` solves it, weak priors
centred where it centres them, and tested with the stated covariances. Expectation: no drift, not
more than 5 % replaced; drift, 95 %, and of three or more cameras the right one named; a scan too
weak to tell, inconclusive.
Run: python -m experiments.drift [--trials N] [--only none turned ...] [--out FILE]
"""

from __future__ import annotations

import json
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from graphs.build import GraphOptions
from graphs.compare import Stated
from graphs.compare_chance import changed
from graphs.drift import Drift, Verdict, drift
from graphs.drift_picture import assumed_covariance
from graphs.drift_tests import Criteria
from graphs.frames import Transform
from graphs.losses import SCALE_95
from graphs.priors import weak_lens_prior
from graphs.problem import Estimate
from graphs.refine import refine
from graphs.significance import rejecting
from graphs.stated_covariance import calibration_covariance
from sfm_calib.files import write_atomically
from sfm_calib.simulate.rigs import RigName, SimulatedRig, make_rig
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

Change = Literal["none", "turned", "focal", "baseline", "weak", "weak turned", "panorama"]
CHANGES: tuple[Change, ...] = get_args(Change)
UNTOUCHED: tuple[Change, ...] = ("none", "weak", "panorama")
RIGS: tuple[RigName, ...] = ("stereo", "triple", "quad")

TRIALS = 100
TURN_DEG, FOCAL, BASELINE = 0.1, 0.003, 0.005
OLD_PX = 0.05  # what the old calibration is right to in the picture: boards reach it
MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it
# The baseline is measured to 0.05 %: a change by 0.5 % is then ten sigmas of the scale.
SCAN = TrackOptions(
    points=1500, max_points_per_image=120, frames=40, lens="radial", baseline_sigma_m=0.0001
)
WEAK = {"frames": 8, "points": 600, "max_points_per_image": 50, "sigma_px": 1.0}
TRAJECTORY = {"stereo": "orbit", "triple": "handheld", "quad": "handheld"}


@dataclass(frozen=True)
class Case:
    """A rig, and what happened to it."""

    rig: RigName
    change: Change

    @property
    def options(self) -> TrackOptions:
        weak = WEAK if self.change.startswith("weak") else {}
        walk = "panorama" if self.change == "panorama" else TRAJECTORY[self.rig]
        return SCAN.model_copy(update={"rig": self.rig, "trajectory": walk, **weak})


@dataclass(frozen=True)
class Trial:
    """What was said of one scan."""

    changed: int | None  # the camera
    verdict: Verdict
    drifted: tuple[int, ...]
    moved: tuple[tuple[int, ...], ...]
    least_p: float  # corrected
    found: str  # the surest test
    detectable_px: float
    worst: str  # where that is
    power: float  # with which the sigmas let expect the change to be found by one test
    nameable: bool  # the sigmas tell the camera from the others, by what is expected

    @property
    def named(self) -> bool:
        """The right camera and no other."""
        return self.changed is not None and self.drifted == (self.changed,)

    @property
    def among(self) -> bool:
        """The right camera, or one of several of which it is one, said to be so."""
        return self.named or (self.changed,) in self.moved


# ---- one scan ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scanned:
    """A rig calibrated, changed and scanned: what the test is asked, and what is true."""

    true: Estimate  # when it was calibrated
    now: Estimate
    camera: int | None  # that was changed
    old: Stated
    new: Stated
    n_frames: int


def scanned(case: Case, seed: int) -> Scanned:
    """Calibrate a rig, change it and scan it."""
    rng = np.random.default_rng([seed, RIGS.index(case.rig), CHANGES.index(case.change)])
    rig = make_rig(case.rig, SCAN.lens)
    true = Estimate(rig.cameras, rig.cam_from_rig, (), np.zeros((0, 3)))
    cov = assumed_covariance(true, OLD_PX, Criteria().range)
    error = Stated(true, cov).root @ rng.standard_normal(len(cov.names))
    old = Stated(changed(true, cov.names, error), cov)
    camera = int(rng.integers(len(rig.cameras)))
    now = after(rig, case.change, camera, rng)
    problem, _ = simulate_tracks(case.options, rng, now)
    priors = tuple(weak_lens_prior(one) for one in problem.initial.cameras)
    options = GraphOptions(loss="cauchy", loss_scale=SCALE_95["cauchy"], lens_priors=priors)
    found = refine(problem, options, MIN_PARALLAX_DEG)
    covariance = calibration_covariance(
        found.graph, found.estimate, found.values, MIN_PARALLAX_DEG
    ).stated
    return Scanned(
        true,
        replace(true, cameras=now.cameras, cam_from_rig=now.cam_from_rig),
        None if case.change in UNTOUCHED else camera,
        old,
        Stated(found.estimate, covariance),
        len(found.problem.frame_names),
    )


def trial(case: Case, seed: int, criteria: Criteria) -> Trial:
    """Ask it of one scan of a case."""
    return tested(scanned(case, seed), criteria)


def tested(scan: Scanned, criteria: Criteria) -> Trial:
    """Ask whether the old calibration holds."""
    result = drift(scan.old, scan.new, criteria, n_frames=scan.n_frames)
    power, nameable = (0.0, False) if scan.camera is None else expected(scan, criteria)
    return told(result, scan.camera, power, nameable)


def expected(scan: Scanned, criteria: Criteria) -> tuple[float, bool]:
    """Power, and whether the camera is named by the test of what is true, nothing drawn.

    Power: of the best single test, Holm's first, by the noncentrality that the true change has; by
    sigmas alone and how well few frames tell them, whatever is allowed beside them."""
    by_sigma = replace(criteria, systematic_px=0.0)
    old, new = Stated(scan.true, scan.old.covariance), Stated(scan.now, scan.new.covariance)
    result = drift(old, new, by_sigma, n_frames=scan.n_frames)
    alpha = criteria.alpha / len(result.tests)
    power = max(float(rejecting(alpha, t.dof, t.nu)(t.chi2)) for t in result.tests)
    return power, result.drifted == (scan.camera,)


def told(result: Drift, camera: int | None, power: float, nameable: bool) -> Trial:
    """The drift in the words that are counted; camera: that which changed, if any."""
    surest = min(result.tests, key=lambda test: test.p_value)
    worst = max(result.decisive, key=lambda test: test.detectable_px)
    return Trial(
        camera, result.verdict, result.drifted, result.moved, surest.p_corrected,
        f"{surest.group} {surest.cameras}", result.detectable_px, f"{worst.group} {worst.cameras}",
        power, nameable,
    )  # fmt: skip


def after(rig: SimulatedRig, change: Change, camera: int, rng: np.random.Generator) -> SimulatedRig:
    """The rig with one camera changed, in the frame of the first camera."""
    cameras, placed = list(rig.cameras), list(rig.cam_from_rig)
    here = placed[camera]
    if change.endswith("turned"):
        axis = rng.standard_normal(3)
        turn = np.radians(TURN_DEG) * axis / np.linalg.norm(axis)
        placed[camera] = Transform.exp(turn, np.zeros(3)) @ here  # about its own centre
    elif change == "focal":
        params = cameras[camera].params.copy()
        params[:2] *= 1 + FOCAL
        cameras[camera] = replace(cameras[camera], params=params)
    elif change == "baseline":
        # Away from its nearest neighbour.
        others = [t.inverse.translation for i, t in enumerate(placed) if i != camera]
        centre = here.inverse.translation
        nearest = min(others, key=lambda other: float(np.linalg.norm(other - centre)))
        moved = centre + BASELINE * (centre - nearest)
        placed[camera] = Transform(here.rotation, -here.rotation @ moved)
    first = placed[0].inverse
    return SimulatedRig(tuple(cameras), tuple(transform @ first for transform in placed))


# ---- many ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Summary:
    """What all trials of a case said, as shares."""

    rig: RigName
    change: Change
    trials: int
    replace: float
    keep: float
    inconclusive: float
    named: float
    among: float
    nameable: int  # trials whose sigmas let expect the camera to be named
    named_nameable: float  # of these
    detectable_px: float  # median
    worst: str  # where it most often is
    found: str  # the test that most often is the surest
    allowed: int  # trials whose sigmas let expect the change to be found
    replace_allowed: float  # of these


def summarise(case: Case, trials: Sequence[Trial]) -> Summary:
    """Shares over all trials of a case."""
    allowed = [one for one in trials if one.power >= Criteria().power]
    nameable = [one for one in allowed if one.nameable]

    def share(verdict: Verdict, of: Sequence[Trial] = trials) -> float:
        return float(np.mean([one.verdict == verdict for one in of])) if of else 0.0

    return Summary(
        rig=case.rig,
        change=case.change,
        trials=len(trials),
        replace=share("replace"),
        keep=share("keep"),
        inconclusive=share("inconclusive"),
        named=float(np.mean([one.named for one in trials])),
        among=float(np.mean([one.among for one in trials])),
        nameable=len(nameable),
        named_nameable=float(np.mean([one.named for one in nameable])) if nameable else 0.0,
        detectable_px=float(np.median([one.detectable_px for one in trials])),
        worst=_commonest([one.worst for one in trials]),
        found=_commonest([one.found for one in trials]),
        allowed=len(allowed),
        replace_allowed=share("replace", allowed),
    )


def _commonest(words: Sequence[str]) -> str:
    return max(sorted(set(words)), key=words.count)


def study(cases: Sequence[Case], trials: int, criteria: Criteria, jobs: int = 1) -> list[Summary]:
    """Summaries of the cases, each over as many trials; `jobs` processes share them."""
    summaries = []
    for case in cases:
        one = partial(trial, case, criteria=criteria)
        if jobs == 1:
            results = [one(seed) for seed in range(trials)]
        else:
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(jobs, context) as pool:
                results = list(pool.map(one, range(trials)))
        summaries.append(summarise(case, results))
        print(summaries[-1], file=sys.stderr)
    return summaries


def overview(summaries: Sequence[Summary]) -> Table:
    """A row a case."""
    table = Table(title=f"old calibrations right to {OLD_PX:g} px")
    for column in (
        "rig", "change", "trials", "replace", "keep", "inconclusive", "right camera\nnamed",
        "or among\nthose named", "replace where\nsigmas allow it",
        "named where\nthey do", "detectable\npx", "where", "surest test",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for s in summaries:
        shares = (s.replace, s.keep, s.inconclusive, s.named, s.among)
        table.add_row(
            s.rig, s.change, f"{s.trials}", *(f"{100 * share:.0f} %" for share in shares),
            f"{100 * s.replace_allowed:.0f} % of {s.allowed}" if s.allowed else "–",
            f"{100 * s.named_nameable:.0f} % of {s.nameable}" if s.nameable else "–",
            f"{s.detectable_px:.2f}", s.worst, s.found,
        )  # fmt: skip
    return table


@dataclass(frozen=True)
class Options:
    """Is drift found where there is some?"""

    trials: int = TRIALS
    """Trials of each case."""
    only: tuple[Change, ...] = ()
    """Changes; by default all."""
    rigs: tuple[RigName, ...] = RIGS
    """Rigs."""
    systematic_px: float = Criteria().systematic_px
    """Allowed beside the sigmas."""
    jobs: int = 1
    """Processes that share the trials."""
    out: Path | None = None
    """A JSON file for all numbers."""


def main(options: Options) -> list[Summary]:
    """Run the cases, print the table, write the file."""
    cases = [Case(rig, change) for rig in options.rigs for change in options.only or CHANGES]
    criteria = Criteria(systematic_px=options.systematic_px, depth_ranges=())
    summaries = study(cases, options.trials, criteria, options.jobs)
    Console(width=None if sys.stdout.isatty() else 160).print(overview(summaries))
    if options.out:
        content = json.dumps([asdict(summary) for summary in summaries], indent=1)
        write_atomically(options.out, content.encode() + b"\n")
    return summaries


if __name__ == "__main__":
    main(tyro.cli(Options))

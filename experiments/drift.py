"""Is drift found where there is some, none where there is none, and doubt said where it is?

Question: a rig was calibrated; later it may have been touched. Does the drift test, from the old
calibration and one ordinary scan, say keep, replace and inconclusive rightly, and name the camera?
Method: simulated rigs; the old calibration errs as its sigmas say; one camera, any of them, is
changed; a scan of the changed rig is solved as `sfm-calib calibrate` solves it, weak priors
centred where it centres them, and tested with the stated covariances. Too weak to tell are scans
of few frames and much noise (weak, and one camera turned: weak turned), and of a walk that only
turns (panorama).
Expectation: no drift, not more than 5 % replaced, of each rig and of all; drift, 95 % where the
sigmas allow it, whatever is allowed beside them, and of three or more cameras the right one named
in 95 % where they do; a scan too weak to tell, inconclusive in 95 %; more or less than that by
chance alone. Sigmas that allow less than half of the turns and focal lengths of three or more
cameras leave it open.
Source: the requirement on `sfm-calib drift`; 5 % is the level of its tests, 95 % their power.
Run: sfm-calib run configs/studies/drift.yaml -o out/drift
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import Field

from experiments.drift_summary import (
    FEWEST_TRIALS,
    UNTOUCHED,
    Change,
    broken,
    broken_together,
    figure,
    in_words,
    overview,
    summarise,
    too_little_allowed,
)
from experiments.runner.protocol import Answer, AnswerTable, Finished, Row, Study, TrialOptions
from graphs.build import GraphOptions
from graphs.compare import Stated
from graphs.compare_chance import changed
from graphs.drift import drift
from graphs.drift_picture import assumed_covariance
from graphs.drift_tests import Criteria
from graphs.frames import Transform
from graphs.losses import SCALE_95
from graphs.priors import weak_lens_prior
from graphs.problem import Estimate
from graphs.refine import refine
from graphs.significance import rejecting
from graphs.stated_covariance import calibration_covariance
from sfm_calib.simulate.rigs import CAMERA_COUNT, SimulatedRig, TrajectoryName, make_rig
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

CHANGES: tuple[Change, ...] = get_args(Change)
DriftRig = Literal["stereo", "triple", "quad"]
RIGS: tuple[DriftRig, ...] = get_args(DriftRig)

OLD_PX = 0.05  # what the old calibration is right to in the picture: boards reach it
MIN_PARALLAX_DEG = 1.0  # as rig.yaml has it
# The baseline is measured to 0.05 %: a change by 0.5 % is then ten sigmas of the scale.
SCAN = TrackOptions(
    points=1500, max_points_per_image=120, frames=40, lens="radial", baseline_sigma_m=0.0001
)
WEAK = {"frames": 8, "points": 600, "max_points_per_image": 50, "sigma_px": 1.0}
TRAJECTORY: dict[DriftRig, TrajectoryName] = {
    "stereo": "orbit",
    "triple": "handheld",
    "quad": "handheld",
}


class DriftOptions(TrialOptions):
    """A rig, and what happened to it."""

    rig: DriftRig = "stereo"
    """Cameras and how they sit on the rig."""
    change: Change = "none"
    """What was done to one camera, or what is wrong with the scan."""
    turn_deg: Annotated[float, Field(gt=0, le=10)] = 0.1
    """About any axis through the camera's centre, of turned and weak turned."""
    focal: Annotated[float, Field(gt=-0.5, le=0.5)] = 0.003
    """Relative, of focal."""
    baseline: Annotated[float, Field(gt=-0.5, le=0.5)] = 0.005
    """Relative, away from the nearest camera, of baseline."""
    systematic_px: Annotated[float, Field(ge=0, le=10)] = Criteria().systematic_px
    """Allowed beside the sigmas."""

    @property
    def case(self) -> str:
        """In few words, with what is not as usual."""
        usual = DriftOptions()
        other = [
            f"{name} {value:g}"
            for name in ("turn_deg", "focal", "baseline", "systematic_px")
            if (value := getattr(self, name)) != getattr(usual, name)
        ]
        return " ".join([self.rig, self.change, *other])

    @property
    def scan(self) -> TrackOptions:
        weak = WEAK if self.change.startswith("weak") else {}
        walk = "panorama" if self.change == "panorama" else TRAJECTORY[self.rig]
        return SCAN.model_copy(update={"rig": self.rig, "trajectory": walk, **weak})

    @property
    def criteria(self) -> Criteria:
        return Criteria(systematic_px=self.systematic_px, depth_ranges=())


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


def scanned(options: DriftOptions, seed: int) -> Scanned:
    """Calibrate a rig, change it and scan it."""
    rng = np.random.default_rng([seed, RIGS.index(options.rig), CHANGES.index(options.change)])
    rig = make_rig(options.rig, SCAN.lens)
    true = Estimate(rig.cameras, rig.cam_from_rig, (), np.zeros((0, 3)))
    cov = assumed_covariance(true, OLD_PX, Criteria().range)
    error = Stated(true, cov).root @ rng.standard_normal(len(cov.names))
    old = Stated(changed(true, cov.names, error), cov)
    camera = int(rng.integers(len(rig.cameras)))
    now = after(rig, options, camera, rng)
    problem, _ = simulate_tracks(options.scan, rng, now)
    priors = tuple(weak_lens_prior(one) for one in problem.initial.cameras)
    weighed = GraphOptions(loss="cauchy", loss_scale=SCALE_95["cauchy"], lens_priors=priors)
    found = refine(problem, weighed, MIN_PARALLAX_DEG)
    covariance = calibration_covariance(
        found.graph, found.estimate, found.values, MIN_PARALLAX_DEG
    ).stated
    return Scanned(
        true,
        replace(true, cameras=now.cameras, cam_from_rig=now.cam_from_rig),
        None if options.change in UNTOUCHED else camera,
        old,
        Stated(found.estimate, covariance),
        len(found.problem.frame_names),
    )


def trial(options: DriftOptions, seed: int) -> Row:
    """Ask whether the old calibration holds, of one scan."""
    scan, criteria = scanned(options, seed), options.criteria
    result = drift(scan.old, scan.new, criteria, n_frames=scan.n_frames)
    power, nameable = (0.0, False) if scan.camera is None else expected(scan, criteria)
    surest = min(result.tests, key=lambda test: test.p_value)
    worst = max(result.decisive, key=lambda test: test.detectable_px)
    named = scan.camera is not None and result.drifted == (scan.camera,)
    return {
        "camera": scan.camera,
        "verdict": result.verdict,
        "drifted": list(result.drifted),
        "named": named,
        "among": named or (scan.camera,) in result.moved,
        "least_p": surest.p_corrected,
        "surest": f"{surest.group} {surest.cameras}",
        "detectable_px": result.detectable_px,
        "worst": f"{worst.group} {worst.cameras}",
        "power": power,
        "nameable": nameable,
    }


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


def after(
    rig: SimulatedRig, options: DriftOptions, camera: int, rng: np.random.Generator
) -> SimulatedRig:
    """The rig with one camera changed, in the frame of the first camera."""
    cameras, placed = list(rig.cameras), list(rig.cam_from_rig)
    here = placed[camera]
    if options.change.endswith("turned"):
        axis = rng.standard_normal(3)
        turn = np.radians(options.turn_deg) * axis / np.linalg.norm(axis)
        placed[camera] = Transform.exp(turn, np.zeros(3)) @ here  # about its own centre
    elif options.change == "focal":
        params = cameras[camera].params.copy()
        params[:2] *= 1 + options.focal
        cameras[camera] = replace(cameras[camera], params=params)
    elif options.change == "baseline":
        # Away from its nearest neighbour.
        others = [t.inverse.translation for i, t in enumerate(placed) if i != camera]
        centre = here.inverse.translation
        nearest = min(others, key=lambda other: float(np.linalg.norm(other - centre)))
        moved = centre + options.baseline * (centre - nearest)
        placed[camera] = Transform(here.rotation, -here.rotation @ moved)
    first = placed[0].inverse
    return SimulatedRig(tuple(cameras), tuple(transform @ first for transform in placed))


# ---- all of them ---------------------------------------------------------------------------


def answer(trials: Sequence[Finished[DriftOptions]]) -> Answer:
    """Shares of each verdict, case by case, against what is expected of them."""
    summaries, refused = [], []
    for options in dict.fromkeys(one.options for one in trials):
        some = [one for one in trials if one.options == options]
        refused += [(options.case, one.seed, one.error) for one in some if one.error is not None]
        rows = [one.row for one in some if one.error is None]
        if rows:
            n_cameras = CAMERA_COUNT[options.rig]
            of_case = options.case, options.change, n_cameras, options.criteria.power
            summaries.append(summarise(*of_case, rows, len(some) - len(rows)))
    why = AnswerTable("refused", "Scans that were refused", ("case", "seed", "why"), tuple(refused))
    tables = (why,) if refused else ()
    if not summaries:
        return Answer(f"none of {len(trials)} scans was calibrated", None, tables)
    faults = [f"{one.case}: {fault}" for one in summaries for fault in broken(one)]
    faults += [f"all rigs: {fault}" for fault in broken_together(summaries)]
    few = min(one.trials for one in summaries) < FEWEST_TRIALS
    blind = not faults and too_little_allowed(summaries)
    holds = None if few or blind else not faults
    begin = {True: "yes", False: "no", None: "sigmas allow too little to be found to say"}[holds]
    begin = "too few scans to say" if few else begin
    also = f"; expected otherwise: {'; '.join(faults)}" if faults and not few else ""
    tables = (overview(summaries), *tables)
    return Answer(f"{begin}: {in_words(summaries)}{also}", holds, tables, (figure(summaries),))


STUDY = Study(DriftOptions, trial, answer)

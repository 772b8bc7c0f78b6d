"""The story of a recalibration: an old calibration and today's scan in; keep or replace out.

The scan is solved with the old calibration as no more than a start, or the centre of wide beliefs:
so the test for drift holds two witnesses against each other. Where they agree and the whole of the
old one is to be believed (`prior: full`), the graph is solved once more with it in.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from pydantic import BaseModel, ConfigDict, Field

from graphs.compare import Stated
from graphs.consider import completed as with_old_errors
from graphs.consider import cov_difference, sensitivity
from graphs.covariance import Covariance
from graphs.drift_picture import Group, lens_columns
from graphs.problem import PriorMode, PriorRig
from graphs.propagation import lens_names, marginal, pose_names
from graphs.refine import Refinement
from graphs.split_check import SplitCheck
from graphs.stated_covariance import CalibrationCovariance
from sfm_calib.cache import Cache
from sfm_calib.calibrate import (
    Outcome,
    Stopwatch,
    checked_scan,
    enough_placed,
    own_covariance_of,
    refusals,
    solve_problem,
)
from sfm_calib.config import RigConfig
from sfm_calib.contributions import contributions_of
from sfm_calib.drift import DriftOptions, Judged, judge
from sfm_calib.drift_record import DriftRecord
from sfm_calib.errors import CalibrationError
from sfm_calib.files import calibration_sha256
from sfm_calib.formats import CameraRig
from sfm_calib.guided import map_with_prior
from sfm_calib.images import Progress
from sfm_calib.nominal import check_config, start_from_config
from sfm_calib.old_calibration import OldCalibration, old_calibration, with_scale_of
from sfm_calib.partial import completed
from sfm_calib.prior import prior_of, started, with_lenses
from sfm_calib.recalibration_record import OldFile, Recalibration
from sfm_calib.run import Given, Run
from sfm_calib.summary import summarise


class RecalibrateOptions(BaseModel):
    """What is made of the old calibration."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    prior: PriorMode = "weak"
    """start: OLD only says where to start; weak: the wide beliefs of every calibration are centred
    on it; full: it is believed as far as its covariance says, unless the scan contradicts it."""
    free: Annotated[tuple[str, ...], tyro.conf.arg(metavar="WHAT")] = ("all",)
    """What is estimated anew: all, intrinsics, extrinsics, focal, principal_point, distortion,
    rotation, translation, a camera, or one of these of a camera (right.rotation)."""
    cameras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="OLD=SCAN")] = ()
    """Which cameras are the same, as name in OLD=name in SCAN; default: by name, else by order."""
    metres: Annotated[float | None, tyro.conf.arg(metavar="M"), Field(gt=0)] = None
    """How many metres the unit of OLD's lengths is, where the file does not say (0.001: mm)."""


@dataclass(frozen=True)
class Recalibrated:
    """The result with all cameras of the rig, and how it differs from the old one."""

    outcome: Outcome
    drift: DriftRecord


@dataclass(frozen=True)
class Solved:
    """An optimum under one use of the old calibration, and how sure it is."""

    refinement: Refinement
    covariance: CalibrationCovariance
    split: SplitCheck | None
    prior: PriorRig
    cov_change: Covariance | None  # of it less the old calibration; None: they are independent

    @property
    def side(self) -> Stated:
        """In the result's unit, for the maths."""
        unit = 1 / self.covariance.basis.unit
        return Stated(self.refinement.estimate.scaled(unit), self.covariance.stated)


def recalibrate(
    read: CameraRig,
    scan_path: Path,
    config: RigConfig,
    options: RecalibrateOptions,
    drift: DriftOptions,
    cache: Cache,
    progress: Progress,
    command: str = "",
) -> Recalibrated:
    """Test an old calibration by a scan, and calibrate its rig anew.

    drift: by what the old one is judged. As `calibrate`. Raises CalibrationError also where the
    two have no camera in common.
    """
    watch = Stopwatch()
    if options.metres is not None:
        read = read.metric(options.metres)
    scan = checked_scan(scan_path, config, cache, progress, watch)
    old = old_calibration(read, scan, options.cameras, drift)
    has_scale = bool(config.scale.measured)
    config = _with_reference(with_lenses(config, old.rig, scan.cameras), old, scan.cameras)
    check_config(config, scan)
    with watch.stage("tracks and mapping"):
        mapped = map_with_prior(scan, old.rig, config, cache, progress)
    given = Given(scan, config, mapped, command)
    with enough_placed(mapped.problem, len(scan.images)):
        careful: PriorMode = "start" if options.prior == "start" else "weak"
        alone = _solve(given, old, careful, options.free, watch, progress)
        with watch.stage("drift"), refusals():
            found = _drift(old, alone, drift, scale_free=not has_scale)
        best = alone
        if options.prior == "full" and found.record.verdict != "replace":
            best = _solve(given, old, "full", options.free, watch, progress)
    run = Run(
        scan, config, mapped, best.refinement, best.covariance, watch.seconds, command,
        split=best.split,
    )  # fmt: skip
    calibration, unit = summarise(run)
    record = Recalibration(
        old=OldFile(path=str(read.path), sha256=calibration_sha256(read.path), format=read.format),
        prior=best.prior.mode,
        freed=options.free,
        contributions=contributions_of(
            best.prior, best.side, alone.side, best.covariance.model, calibration.rig.metric
        ),
        drift=found.record,
    )
    whole = completed(calibration, old.rig, record, _unmoved(found.record))
    return Recalibrated(Outcome(whole, best.refinement, unit), found.record)


def _with_reference(config: RigConfig, old: OldCalibration, names: Sequence[str]) -> RigConfig:
    """With the old calibration's reference, where the scan has it and nothing else is asked for."""
    if config.reference is not None and config.reference not in old.rig.names:
        raise CalibrationError(
            f"--reference {config.reference}: {old.rig.path} has no such camera, and places are "
            f"compared in a frame of both: name one of {', '.join(old.common(names))}"
        )
    return config.model_copy(update={"reference": config.reference or old.reference(names)})


def _solve(
    given: Given,
    old: OldCalibration,
    mode: PriorMode,
    free: Sequence[str],
    watch: Stopwatch,
    progress: Progress,
) -> Solved:
    """The optimum of a scan under one use of the old calibration, with its covariance."""
    scan, config = given.scan, given.config
    assert config.reference is not None
    prior = prior_of(old.rig, mode, free, scan.cameras, config.reference)
    if not prior.gives_scale:
        config = with_scale_of(config, old.baseline(scan.cameras))
    problem = started(start_from_config(given.mapped.problem, config), prior)
    with watch.stage(f"solving ({mode})"):
        refinement = solve_problem(problem, config, progress)
    with watch.stage(f"covariance ({mode})"):
        covariance, split = own_covariance_of(refinement, config, progress)
        if not prior.held and mode != "full":
            return Solved(refinement, covariance, split, prior, None)
        with refusals():
            how = sensitivity(
                refinement.graph, refinement.estimate, refinement.values, covariance.basis
            )
        cov_change = cov_difference(covariance.stated, how)
        return Solved(refinement, with_old_errors(covariance, how), split, prior, cov_change)


def _drift(old: OldCalibration, new: Solved, options: DriftOptions, scale_free: bool) -> Judged:
    """Of the cameras that both have."""
    names = old.common([camera.name for camera in new.refinement.estimate.cameras])
    before = _part(old.own if new.cov_change is None else old.stated, names)
    after = _part(new.side, names)
    return judge(
        before, after, old.unit or "m", options,
        scale_free=scale_free, tested=set(_tested(before, new.prior.held)), cov_difference=new.cov_change,
        notes=old.notes, n_frames=len(new.refinement.problem.frame_names),
    )  # fmt: skip


def _part(side: Stated, names: Sequence[str]) -> Stated:
    """These cameras of a calibration, in this order."""
    known = [camera.name for camera in side.estimate.cameras]
    places = [known.index(name) for name in names]
    of = [
        name
        for camera in (side.estimate.cameras[i] for i in places)
        for name in (*lens_names(camera), *pose_names(camera.name))
        if name in side.covariance.names
    ]
    estimate = replace(
        side.estimate,
        cameras=tuple(side.estimate.cameras[i] for i in places),
        cam_from_rig=tuple(side.estimate.cam_from_rig[i] for i in places),
    )
    return Stated(
        estimate, marginal(side.covariance, of) if of else Covariance((), np.zeros((0, 0)))
    )


def _tested(side: Stated, held: frozenset[str]) -> Iterator[tuple[str, Group]]:
    """The groups of each camera of which anything was freed."""
    for camera in side.estimate.cameras:
        names = lens_names(camera)
        for group, columns in lens_columns(camera):
            if any(names[column] not in held for column in columns):
                yield camera.name, group
        place = pose_names(camera.name)
        if any(name not in held for name in place[:3]):
            yield camera.name, "rotation"
        if any(name not in held for name in place[3:]):
            yield camera.name, "translation"


def _unmoved(found: DriftRecord) -> tuple[str, ...] | None:
    """Cameras that kept their places, where it can be told which moved."""
    if len(found.moved) != 1:
        return None
    return tuple(name for name in found.cameras if name not in found.moved[0]) or None

"""A deployed rig: its old calibration, and today's scan, mapped already."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphs.frames import Transform
from graphs.problem import Estimate, Problem
from sfm_calib import recalibrate as story
from sfm_calib.cache import Cache
from sfm_calib.config import RigConfig
from sfm_calib.drift import DriftOptions
from sfm_calib.formats import read_calibration
from sfm_calib.formats.reading import CameraRig
from sfm_calib.images import Scan, read_scan
from sfm_calib.mapping import Mapped
from sfm_calib.recalibrate import Recalibrated, RecalibrateOptions, recalibrate
from sfm_calib.result import save_calibration
from synthetic.earlier import NAMES, TRACKS, scan, solved
from synthetic.scans import blank, silent

SIGMA_PX = 0.04  # fine enough for `keep` from a dozen frames
SCAN = TRACKS.model_copy(update={"sigma_px": SIGMA_PX, "points": 500, "max_points_per_image": 45})
QUICKLY = DriftOptions(depth_ranges=())  # depths take a fifth of a run
MAPPED_UNIT = 1.3  # of the mapping's lengths in metres: nothing may hang on it


@functools.cache
def mapped() -> tuple[Problem, Estimate]:
    """Today's scan of three cameras, and the truth in metres."""
    problem, truth = scan(0, SCAN)
    return replace(problem, initial=problem.initial.scaled(MAPPED_UNIT)), truth


@functools.cache
def deployed() -> CameraRig:
    """The old calibration, in metres, with the covariance of a scan of its own."""
    found = solved(scan(5, SCAN.model_copy(update={"baseline_sigma_m": 2e-4}))[0], SIGMA_PX)
    cameras, placed = found.estimate.cameras, found.estimate.cam_from_rig
    return CameraRig(Path("old.json"), "made", cameras, placed, "m", found.model.covariance)


def measured_m() -> float:
    """The true distance of cam0 and cam1."""
    return float(np.linalg.norm(mapped()[1].cam_from_rig[1].translation))


@functools.cache
def pictures(folders: tuple[str, ...] = NAMES, size: tuple[int, int] = (640, 480)) -> Path:
    """A scan's folder, its pictures blank: what they show is mapped already. Read only."""
    place = Path(tempfile.mkdtemp(prefix="sfm_calib_test."))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    for folder in folders:
        for frame in mapped()[0].frame_names:
            blank(place / folder / f"{frame}.png", size)
    return place


def already_mapped(
    monkeypatch: pytest.MonkeyPatch,
    called: Mapping[str, str] | None = None,
    messages: tuple[str, ...] = (),
) -> None:
    """Mapping finds `mapped`, of the cameras that the scan has; called: what for, of others."""

    def map_with_prior(scan, old, config, cache, progress):  # type: ignore[no-untyped-def]
        names = [(called or {}).get(name, name) for name in scan.cameras]
        reference = scan.cameras.index(config.reference)
        problem = part_of(mapped()[0], [NAMES.index(name) for name in names], reference)
        cameras = tuple(
            replace(c, name=n) for c, n in zip(problem.initial.cameras, scan.cameras, strict=True)
        )
        problem = replace(problem, initial=replace(problem.initial, cameras=cameras))
        return Mapped(problem, messages, {})

    monkeypatch.setattr(story, "map_with_prior", map_with_prior)


def part_of(problem: Problem, cameras: Sequence[int], reference: int) -> Problem:
    """What some of the cameras saw, in the frame of one of them."""
    start, seen = problem.initial, problem.observations
    new = np.full(len(start.cameras), -1)
    new[list(cameras)] = np.arange(len(cameras))
    rows = new[seen.camera] >= 0
    counts = np.bincount(seen.point[rows], minlength=len(start.points))
    rows &= counts[seen.point] >= 3
    points, renumbered = np.unique(seen.point[rows], return_inverse=True)
    kept = replace(
        seen, pixels=seen.pixels[rows], frame=seen.frame[rows], camera=new[seen.camera[rows]],
        point=renumbered,
    )  # fmt: skip
    origin = start.cam_from_rig[cameras[reference]]
    placed = tuple(start.cam_from_rig[i] @ origin.inverse for i in cameras)
    placed = tuple(Transform.identity() if i == reference else t for i, t in enumerate(placed))
    frames = tuple(origin @ frame for frame in start.rig_from_world)
    estimate = Estimate(
        tuple(start.cameras[i] for i in cameras), placed, frames, start.points[points]
    )
    return replace(problem, initial=estimate, observations=kept, reference=reference)


def written(old: CameraRig, folder: Path) -> Path:
    """Its calibration.json, as a run would leave it in a folder of its own."""
    save_calibration(old.calibration(), folder / "calibration.json")
    return folder


def recalibrated(
    old: CameraRig,
    place: Path,
    scan_at: Path | None = None,
    drift: DriftOptions | None = None,
    config: Mapping[str, object] | None = None,
    **options: object,
) -> Recalibrated:
    """The story, from an old calibration in a file and a scan that is mapped already."""
    return recalibrate(
        read_calibration(written(old, place / "old")), scan_at or pictures(),
        RigConfig.model_validate(config or {}), RecalibrateOptions.model_validate(options),
        drift or QUICKLY, Cache(place / "cache"), silent,
    )  # fmt: skip


def moved(old: CameraRig, name: str, turn_deg: float = 0.0, focal: float = 1.0) -> CameraRig:
    """An old calibration in which one camera was turned about y, or its focal length changed."""
    assert old.cam_from_rig
    i = old.names.index(name)
    turned = Transform.exp(np.array([0.0, np.radians(turn_deg), 0.0]), np.zeros(3))
    placed = tuple(turned @ t if i == j else t for j, t in enumerate(old.cam_from_rig))
    by = np.ones(old.cameras[i].params.size)
    by[:2] = focal
    cameras = tuple(
        replace(c, params=c.params * by) if i == j else c for j, c in enumerate(old.cameras)
    )
    return replace(old, cameras=cameras, cam_from_rig=placed)


def larger(old: CameraRig, by: float) -> CameraRig:
    """With places that many times as far apart."""
    assert old.cam_from_rig
    return replace(old, cam_from_rig=tuple(t.scaled(by) for t in old.cam_from_rig))


def scan_of(names: tuple[str, ...]) -> Scan:
    """`pictures`, read."""
    place = pictures(names)
    return read_scan(place, Cache(place / "cache"), "stem", 80, silent)

"""What a trial calibrates from: a scan on disk, a part of one, or a simulated rig."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sfm_calib
from experiments.calibration_options import CHANGED, SEED, SIMULATE, CalibrationOptions, Changed
from graphs.frames import Transform
from graphs.problem import KnownBaseline, Problem, images_seen
from sfm_calib import result
from sfm_calib.boards.load import load_board
from sfm_calib.boards.spec import Board
from sfm_calib.cache import Cache
from sfm_calib.cli import rig_file
from sfm_calib.config import (
    RIG_FILE,
    BaselineConfig,
    RigConfig,
    ScaleConfig,
    load_rig_config,
)
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.formats import CameraRig, read_calibration
from sfm_calib.formats.ours import rig_of
from sfm_calib.images import Scan, ScanImage, check_exists, counting_order, find_images, name_frames
from sfm_calib.result import Calibration, save_calibration
from sfm_calib.simulate.rigs import SimulatedRig, make_rig
from sfm_calib.simulate.scan import SimulateOptions, preset_rig, rig_like, simulate_scan
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks


@dataclass(frozen=True)
class Tracks:
    """A scan without images."""

    scan: Scan
    problem: Problem


@dataclass(frozen=True)
class Source:
    """What is calibrated, what is known of it, and with what it is compared."""

    scan: Path | Tracks
    config: RigConfig  # as its rig.yaml has it
    old: CameraRig | None
    board: Path | None
    truth: CameraRig | None

    def load_board(self) -> Board | None:
        """Raises CalibrationError as `load_board`."""
        return load_board(self.board) if self.board else None


def source_of(options: CalibrationOptions, seed: int, folder: Path, cache: Cache) -> Source:
    """The scan of a trial. What has to be written for it goes to `folder`, or into the cache.

    Raises CalibrationError for what cannot be read, or cannot be simulated.
    """
    if options.simulate:
        return _simulated(options, seed, folder, cache)
    assert options.scan is not None
    check_exists(options.scan)
    config = load_rig_config(rig_file(options.scan))
    scan = options.scan
    if options.stretch:
        matching = options.said.get("frames", config.frames)
        scan = stretch_of(scan, options.stretch, matching, seed, folder / "scan")
    return Source(
        scan,
        config,
        read_calibration(options.old) if options.old else None,
        options.board,
        read_calibration(options.truth) if options.truth else None,
    )


# ---- a part of a scan ----------------------------------------------------------------------


def stretch_of(scan: Path, frames: int, matching: str, seed: int, place: Path) -> Path:
    """`place`, with links to consecutive frames of a scan of images, from one that `seed` draws.

    Raises CalibrationError where there are not so many.
    """
    found = find_images(scan)
    if not found or matching not in ("stem", "order"):
        raise CalibrationError(
            f"a stretch of {scan} cannot be taken: it needs images matched by stem or order (of a "
            "video, video_frames says how many frames are picked)"
        )
    named, _ = name_frames(found, found, "order" if matching == "order" else "stem")
    every = {frame for entries in named.values() for frame, _ in entries}
    names = sorted(every, key=counting_order)
    if len(names) < frames:
        raise CalibrationError(f"{scan} has {len(names)} frames: a stretch has no more")
    first = int(np.random.default_rng([seed, frames]).integers(len(names) - frames + 1))
    taken = set(names[first : first + frames])
    shutil.rmtree(place, ignore_errors=True)
    for frame, path in (one for entries in named.values() for one in entries):
        if frame in taken:
            link = place / path.relative_to(scan)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(path.absolute())
    if (scan / RIG_FILE).exists():
        shutil.copyfile(scan / RIG_FILE, place / RIG_FILE)
    return place


# ---- simulations ---------------------------------------------------------------------------


def _simulated(options: CalibrationOptions, seed: int, folder: Path, cache: Cache) -> Source:
    """A simulated rig, its old calibration before what changed, and its scan after it."""
    drawn = seed + (options.said.get(SIMULATE + SEED) or 0)
    before = _rig(options)
    after = before
    if options.command == "recalibrate" and CHANGED + "camera" in options.said:
        after = touched(before, options.part(Changed, CHANGED))
    truth = rig_of(_truth(after), folder / "truth.json")
    old = None
    if options.old:
        old = read_calibration(options.old)
    elif options.command == "recalibrate":
        save_calibration(_truth(before), folder / "old.json")
        old = read_calibration(folder / "old.json")
    if options.simulate == "tracks":
        asked = options.part(TrackOptions, SIMULATE)
        problem, _ = simulate_tracks(asked, np.random.default_rng(drawn), after)
        return Source(*_unmapped(problem, folder), old, None, truth)
    place = _rendered(options, drawn, _truth(after), cache)
    board = place / "board.yaml"
    scan = place / "scan"
    config = load_rig_config(scan / RIG_FILE)
    return Source(scan, config, old, board if board.exists() else options.board, truth)


def _rig(options: CalibrationOptions) -> SimulatedRig:
    if options.simulate == "tracks":
        tracks = options.part(TrackOptions, SIMULATE)
        return make_rig(tracks.rig, tracks.lens, tracks.size)
    images = options.part(SimulateOptions, SIMULATE)
    return rig_like(images.like) if images.like else preset_rig(images)


def _truth(rig: SimulatedRig) -> Calibration:
    return result.truth(list(rig.cameras), list(rig.cam_from_rig), sfm_calib.__version__)


def touched(rig: SimulatedRig, changed: Changed) -> SimulatedRig:
    """The rig with one camera turned or refocused, in the frame of its first camera.

    Raises CalibrationError where it has no such camera.
    """
    names = [camera.name for camera in rig.cameras]
    if changed.camera not in names:
        raise CalibrationError(
            f"changed.camera: the rig has no camera {changed.camera!r}; "
            f"{nearest(changed.camera, names)}"
        )
    index = names.index(changed.camera)
    cameras, placed = list(rig.cameras), list(rig.cam_from_rig)
    params = cameras[index].params.copy()
    params[:2] *= 1 + changed.focal_percent / 100
    cameras[index] = replace(cameras[index], params=params)
    turn = np.array([0.0, np.radians(changed.turn_deg), 0.0])
    placed[index] = Transform.exp(turn, np.zeros(3)) @ placed[index]  # about its own centre
    first = placed[0].inverse
    return SimulatedRig(tuple(cameras), tuple(transform @ first for transform in placed))


def _rendered(options: CalibrationOptions, seed: int, truth: Calibration, cache: Cache) -> Path:
    """A simulated scan on disk, rendered once for all trials that ask for it."""
    asked = options.part(SimulateOptions, SIMULATE).model_copy(update={"seed": seed, "like": None})

    def make(place: Path) -> None:
        save_calibration(truth, place / "rig.json")
        like = asked.model_copy(update={"like": place / "rig.json"})
        simulate_scan(like, place / "made", unwatched)

    inputs = [asked.model_dump(mode="json"), truth.model_dump(mode="json")]
    return cache.stage("simulation", inputs, make) / "made"


def unwatched(stage: str, done: int, total: int) -> None:
    """Progress of a trial: the runner tells of whole trials."""


def _unmapped(problem: Problem, folder: Path) -> tuple[Tracks, RigConfig]:
    """Simulated tracks as a scan that was read, and the rig.yaml that would come with it."""
    cameras = problem.initial.cameras
    names = tuple(camera.name for camera in cameras)
    images = tuple(
        ScanImage(camera, frame, f"{names[camera]}/{problem.frame_names[frame]}.png")
        for camera, frame in images_seen(problem.observations).tolist()
    )
    sizes = tuple(camera.size for camera in cameras)
    measured = tuple(
        BaselineConfig(
            cameras=(names[one.cameras[0]], names[one.cameras[1]]),
            length_m=one.length_m,
            sigma_m=one.sigma_m,
        )
        for one in problem.scales
        if isinstance(one, KnownBaseline)
    )
    scan = Scan(folder, names, sizes, problem.frame_names, images)
    return Tracks(scan, replace(problem, scales=())), RigConfig(
        scale=ScaleConfig(baseline=measured)
    )

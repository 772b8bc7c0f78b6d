"""A simulated scan on disk: images, rig file and the truth, all of it or nothing."""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import tyro
import yaml
from pydantic import BaseModel, ConfigDict

import sfm_calib
from graphs.frames import Transform
from graphs.lenses import LensName
from sfm_calib.boards.load import board_from, board_yaml
from sfm_calib.errors import CalibrationError
from sfm_calib.result import Calibration, load_calibration, save_calibration, truth
from sfm_calib.simulate.render import SUPERSAMPLING, RenderOptions, ray_table, render
from sfm_calib.simulate.rigs import (
    PRESET_WIDTH,
    RigName,
    SimulatedRig,
    TrajectoryName,
    make_rig,
    make_trajectory,
)
from sfm_calib.simulate.room import TEXELS_PER_M, BoardName, HungBoard, Room, build_room

Progress = Callable[[str, int, int], None]

BASELINE_SIGMA_M = 0.0005  # a tape measure; ten times the rounding of the length written
SHORTEST_BASELINE_M = 0.01  # a shorter one nobody measures
SMALLEST_SIDE, LARGEST_SIDE = 64, 4096
MOST_RAYS = 200_000_000  # an image: 2.4 GB of directions
MOST_FRAMES = 1_000_000  # stems have six digits
LARGEST_NOISE = 60.0
MOST_TEXELS_PER_M = 800.0  # 200 MB of textures


class SimulateOptions(BaseModel):
    """What to simulate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig: RigName = "triple"
    """Cameras and how they sit on the rig."""
    like: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A calibration.json whose cameras and rig take the preset's place."""
    trajectory: TrajectoryName = "handheld"
    """How the rig moves through the room."""
    frames: int = 40
    """How many images each camera takes."""
    size: tuple[int, int] = (640, 480)
    """Width and height of every image in px."""
    lens: LensName = "radial"
    """Lens model of every camera."""
    noise: float = 2.0
    """Sensor noise: sigma at middle grey, in grey levels."""
    supersampling: int = SUPERSAMPLING
    """Rays a pixel and axis."""
    board: BoardName = "none"
    """A calibration board on the wall."""
    seed: int = 0
    """Seed of the room, the trajectory and the noise."""


def simulate_scan(
    options: SimulateOptions, out: Path, progress: Progress, overwrite: bool = False
) -> Calibration:
    """Write OUT/scan (images, rig.yaml), OUT/truth.json and OUT/truth_frames.json; the truth.

    With a board also OUT/board.yaml and OUT/truth_board.json. `overwrite` replaces an earlier
    simulation in OUT and keeps whatever else lies there. `progress` gets (stage, done, total).

    Raises CalibrationError for impossible options, an occupied OUT, and when open3d is missing;
    OUT is then as it was before.
    """
    check_options(options)
    out = out.absolute()
    _refuse_occupied(out, overwrite)
    rig = rig_like(options.like) if options.like else preset_rig(options)
    rig_from_world = make_trajectory(options.trajectory, options.frames, _rng(options, 1))
    calibration = truth(list(rig.cameras), list(rig.cam_from_rig), sfm_calib.__version__)
    progress("room", 0, 1)
    texels_per_m = min(TEXELS_PER_M * options.size[0] / PRESET_WIDTH, MOST_TEXELS_PER_M)
    room = build_room(_rng(options, 0), options.board, texels_per_m)
    progress("room", 1, 1)
    with _staging(out) as staging:
        _write_images(options, rig, rig_from_world, room, staging / "scan", progress)
        _write_rig(rig, staging / "scan" / "rig.yaml")
        save_calibration(calibration, staging / "truth.json")
        _write_json(_frames_record(rig_from_world), staging / "truth_frames.json")
        if room.board:
            _write_board(room.board, staging)
        _install(staging, out)
    return calibration


def preset_rig(options: SimulateOptions) -> SimulatedRig:
    """The rig that the options name."""
    return make_rig(options.rig, options.lens, options.size)


def rig_like(path: Path) -> SimulatedRig:
    """The cameras and the rig of a calibration, its reference first.

    Raises CalibrationError when it cannot be read, or its lengths are not metres.
    """
    calibration = load_calibration(path)
    first = calibration.rig.reference
    names = [first, *(name for name in calibration.cameras if name != first)]
    if len(names) > 1 and not calibration.rig.metric:
        raise CalibrationError(
            f"{path} is not metric ({calibration.rig.scale.source}) and the room is: calibrate "
            "with scale.baseline in rig.yaml"
        )
    for name in names:
        if name != Path(name).name:
            raise CalibrationError(f"{path}: the camera {name!r} cannot be a folder: rename it")
    return SimulatedRig(
        tuple(calibration.camera(name) for name in names),
        tuple(calibration.cam_from_rig(name) for name in names),
    )


def check_options(options: SimulateOptions) -> None:
    """Raise CalibrationError with the first impossible option, its value and the remedy."""
    width, height = options.size
    if not 1 <= options.frames <= MOST_FRAMES:
        raise CalibrationError(
            f"frames is {options.frames}: give 1 to {MOST_FRAMES}, 40 make a good scan"
        )
    if min(width, height) < SMALLEST_SIDE or max(width, height) > LARGEST_SIDE:
        raise CalibrationError(
            f"size is {width} x {height} px: give sides of {SMALLEST_SIDE} to {LARGEST_SIDE} px"
        )
    if not (math.isfinite(options.noise) and 0 <= options.noise <= LARGEST_NOISE):
        raise CalibrationError(
            f"noise is {options.noise} grey levels: give 0 to {LARGEST_NOISE:g}, like a camera's 2"
        )
    if not 1 <= options.supersampling <= 8:
        raise CalibrationError(
            f"supersampling is {options.supersampling} rays a pixel and axis: give 1 to 8, like 3"
        )
    rays = width * height * options.supersampling**2
    if rays > MOST_RAYS:
        raise CalibrationError(
            f"{rays // 10**6} million rays an image, of {MOST_RAYS // 10**6} million possible: "
            "give a smaller size or less supersampling"
        )
    if options.seed < 0:
        raise CalibrationError(f"seed is {options.seed}: give 0 or more")


def _rng(options: SimulateOptions, *purpose: int) -> np.random.Generator:
    """A generator for one purpose, so that more frames do not change the room."""
    return np.random.default_rng([options.seed, *purpose])


def _write_images(
    options: SimulateOptions,
    rig: SimulatedRig,
    rig_from_world: list[Transform],
    room: Room,
    scan: Path,
    progress: Progress,
) -> None:
    render_options = RenderOptions(supersampling=options.supersampling, noise=options.noise)
    total, done = len(rig.cameras) * len(rig_from_world), 0
    for index, camera in enumerate(rig.cameras):
        folder = scan / camera.name if len(rig.cameras) > 1 else scan
        folder.mkdir(parents=True)
        table = ray_table(camera, options.supersampling)
        for frame, placed in enumerate(rig_from_world):
            cam_from_world = rig.cam_from_rig[index] @ placed
            rng = _rng(options, 2, index, frame)
            image = render(camera, cam_from_world, room, rng, render_options, table)
            path = folder / f"{_stem(frame)}.png"
            if not cv2.imwrite(str(path), image):
                raise CalibrationError(f"cannot write {path.name}: free some space and run again")
            done += 1
            progress("images", done, total)


def _write_rig(rig: SimulatedRig, path: Path) -> None:
    """The rig file of a scan: the one thing its user measured, the first baseline."""
    if len(rig.cameras) < 2:
        return
    first, second = (t.inverse.translation for t in rig.cam_from_rig[:2])
    if float(np.linalg.norm(second - first)) < SHORTEST_BASELINE_M:
        return
    baseline = {
        "cameras": [camera.name for camera in rig.cameras[:2]],
        "length_m": round(float(np.linalg.norm(second - first)), 4),
        "sigma_m": BASELINE_SIGMA_M,
    }
    path.write_text(yaml.safe_dump({"scale": {"baseline": baseline}}, sort_keys=False))


def _write_board(board: HungBoard, staging: Path) -> None:
    squares = board.columns, board.rows
    described: dict[str, object] = {"type": board.kind, "square_m": board.square_m}
    if board.kind == "charuco":
        described |= {
            "squares": squares,
            "marker_m": board.marker_m,
            "dictionary": board.dictionary,
        }
    else:
        described |= {"inner_corners": (squares[0] - 1, squares[1] - 1)}
    (staging / "board.yaml").write_text(board_yaml(board_from(described)))
    _write_json({"world_from_board": _record(board.world_from_board)}, staging / "truth_board.json")


def _frames_record(rig_from_world: list[Transform]) -> dict[str, object]:
    return {_stem(frame): _record(t) for frame, t in enumerate(rig_from_world)}


def _stem(frame: int) -> str:
    return f"{frame:06d}"


def _record(transform: Transform) -> dict[str, list[float]]:
    return {
        "rotation_wxyz": transform.rotation_wxyz.tolist(),
        "translation": transform.translation.tolist(),
    }


def _write_json(record: object, path: Path) -> None:
    path.write_text(json.dumps(record, indent=1) + "\n")


def _refuse_occupied(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise CalibrationError(f"{out} is a file: choose another output folder")
    if out.is_dir() and not overwrite and (names := sorted(os.listdir(out))):
        raise CalibrationError(
            f"{out} holds {len(names)} things, {names[0]} among them: "
            "choose another output folder, or allow overwriting"
        )


@contextmanager
def _staging(out: Path) -> Iterator[Path]:
    """A folder beside OUT that disappears, whatever happens, unless it was renamed into place."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        folder.chmod(0o755)  # mkdtemp's folders are private
        yield folder
    except OSError as error:
        raise _unwritable(out, error) from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _unwritable(out: Path, error: OSError) -> CalibrationError:
    return CalibrationError(
        f"cannot write {out}: {error.strerror or error}; "
        "free some space or choose another output folder"
    )


OWN_NAMES = ("scan", "truth.json", "truth_frames.json", "board.yaml", "truth_board.json")


def _install(staging: Path, out: Path) -> None:
    """Rename the finished folder to OUT; what others keep in OUT moves along."""
    if not out.exists():
        os.replace(staging, out)
        return
    old = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}.old."))
    os.replace(out, old)  # onto the empty folder just made
    try:
        os.replace(staging, out)
    except BaseException:
        os.replace(old, out)
        raise
    for path in old.iterdir():
        if path.name not in OWN_NAMES:
            os.replace(path, out / path.name)
    shutil.rmtree(old, ignore_errors=True)

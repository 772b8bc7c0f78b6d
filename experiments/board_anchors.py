"""What a few views of a board bring to a scan: `python -m experiments.board_anchors DATA -o OUT`.

DATA has `scan/` and `boards/` of one rig, as corridor_stereo. The scan alone, the boards alone, and
the scan with 1, 2, 5 frames of the board, all through one lens, in one table: sigma, and difference
from the full set of boards in combined sigmas.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from graphs.board_thin import thin
from graphs.frames import log_rotation
from sfm_calib.anchors import calibrate_with_board
from sfm_calib.boards.find import find_board
from sfm_calib.boards.load import load_board
from sfm_calib.boards.spec import Board
from sfm_calib.cache import Cache
from sfm_calib.calibrate import Outcome, calibrate
from sfm_calib.colmap import quiet
from sfm_calib.config import RIG_FILE, RigConfig, TargetOptions, load_rig_config
from sfm_calib.result import Calibration
from sfm_calib.target import calibrate_target
from sfm_calib.target_images import read_target

PAIRS = (1, 2, 5)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all of them and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--board", type=Path, required=True)
    parser.add_argument("--lens", default="brown")
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    quiet(False)
    board = load_board(given.board)
    config = load_rig_config(given.data / "scan" / RIG_FILE).model_copy(update={"lens": given.lens})
    results = dict(outcomes(given.data, board, config, given.out))
    full = results.pop("boards alone").calibration
    print(f"{'':24}" + "".join(f"{name:>34}" for name in ("boards alone", *results)))
    for row in table(full, {name: outcome.calibration for name, outcome in results.items()}):
        print(row)


def outcomes(
    data: Path, board: Board, config: RigConfig, out: Path
) -> Iterator[tuple[str, Outcome]]:
    """Each calibration by its name."""
    cache = Cache(out / "cache", False)
    options = TargetOptions(lens=config.lens)
    boards = data / "boards"
    yield "boards alone", calibrate_target(boards, board, options, config, cache, _unsaid)
    yield "scan alone", calibrate(data / "scan", config, cache, _unsaid)
    for count in PAIRS:
        with tempfile.TemporaryDirectory() as place:
            copy_frames(boards, chosen(boards, board, cache, count), Path(place))
            outcome = calibrate_with_board(
                data / "scan", board, Path(place), config, cache, _unsaid
            )
        yield f"scan + {count}", outcome


def chosen(boards: Path, board: Board, cache: Cache, count: int) -> set[str]:
    """Names of the frames, so many, in which the board lies most differently."""
    scan = read_target(boards, cache, "stem", count, None, _unsaid, least=1)
    views = find_board(scan, board, _unsaid).views
    kept = thin(views.views, count, board.corners_m, views.sizes)
    return {views.frames[views.views[index].frame] for index in kept}


def copy_frames(boards: Path, frames: set[str], place: Path) -> None:
    """The images of some frames, a folder a camera."""
    for folder in sorted(path for path in boards.iterdir() if path.is_dir()):
        (place / folder.name).mkdir()
        for image in folder.iterdir():
            if image.stem in frames:
                shutil.copy(image, place / folder.name)


def table(full: Calibration, others: dict[str, Calibration]) -> Iterator[str]:
    """Rows of values +- sigmas, and z against the full set of boards."""
    for name in quantities(full):
        value, sigma = quantities(full)[name]
        row = f"{name:24}{value:>22.5g} +- {sigma:<8.2g}"
        for one in others.values():
            there, spread = quantities(one)[name]
            z = (there - value) / np.hypot(sigma, spread) if np.isfinite(spread) else np.nan
            row += f"{there:>13.5g} +- {spread:<8.2g} z {z:+5.1f}"
        yield row


def quantities(calibration: Calibration) -> dict[str, tuple[float, float]]:
    """Focal length, principal point, rotation and baseline, each with its sigma."""
    found = {}
    for name, camera in calibration.cameras.items():
        for parameter in ("fx", "fy", "cx", "cy"):
            found[f"{name}.{parameter}"] = camera.params[parameter], camera.sigma[parameter]
    rig = calibration.rig
    for name, entry in rig.cam_from_rig.items():
        if name == rig.reference:
            continue
        turn = np.degrees(log_rotation(calibration.cam_from_rig(name).rotation))
        for axis, letter in enumerate("xyz"):
            found[f"{name}.rotation_{letter} deg"] = turn[axis], entry.sigma_rotation_deg[axis]
        length = float(np.linalg.norm(entry.translation))
        along = np.array(entry.translation) / length
        sigma = float(np.linalg.norm(along * entry.sigma_translation))
        found[f"{name} baseline mm"] = (
            (1e3 * length, 1e3 * sigma) if rig.metric else (np.nan, np.nan)
        )
    return found


def _unsaid(stage: str, done: int, total: int) -> None:
    pass


if __name__ == "__main__":
    main()

"""The board in all images of a scan."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_calib.boards.detect import detect
from sfm_calib.boards.diagnose import another_board, why_not
from sfm_calib.boards.spec import Board
from sfm_calib.boards.views import BoardView, BoardViews, Detection
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan, ScanImage

SAMPLE = 12  # images that are looked at again for what went wrong
# Images without the board, and their share, from which on another board among them is looked for.
FEWEST_FAILED, FAILED_SHARE = 4, 0.2
STAGE = "looking for the board"


@dataclass(frozen=True)
class FoundBoard:
    """Where a board was seen, and what is to be said about it."""

    views: BoardViews
    messages: tuple[str, ...] = ()


def find_board(
    scan: Scan,
    board: Board,
    progress: Progress,
    needed: Literal["every camera", "any", "none"] = "every camera",
) -> FoundBoard:
    """Look for the board in every image of a scan.

    needed: what has to see it. Raises CalibrationError, with what the images seem to show instead,
    where that never does.
    """
    found: list[Detection | None] = []
    with ThreadPoolExecutor(max_workers=2) as pool:
        for detection in pool.map(
            lambda image: detect(read_image(scan, image), board), scan.images
        ):
            found.append(detection)
            progress(STAGE, len(found), len(scan.images))
    seen = [
        BoardView(image.camera, image.frame, each.corner, each.pixels, each.sigma_px)
        for image, each in zip(scan.images, found, strict=True)
        if each is not None
    ]
    if needed == "every camera" or (needed == "any" and not seen):
        _check_every_camera(scan, board, seen)
    failed = [image for image, each in zip(scan.images, found, strict=True) if each is None]
    messages = _messages(scan, board, failed)
    views = tuple(sorted(seen, key=lambda view: (view.frame, view.camera)))
    return FoundBoard(BoardViews(scan.cameras, scan.sizes, scan.frames, views), messages)


def read_image(scan: Scan, image: ScanImage) -> NDArray[np.uint8]:
    """Grey levels (height, width) of one image, not turned by what its header says."""
    data = np.fromfile(scan.root / image.path, np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(pixels, dtype=np.uint8)


def _check_every_camera(scan: Scan, board: Board, seen: list[BoardView]) -> None:
    counts = np.bincount([view.camera for view in seen], minlength=len(scan.cameras))
    without = [camera for camera, count in enumerate(counts) if count == 0]
    if not without:
        return
    if len(without) == len(scan.cameras):
        images, whose = list(scan.images), f"{len(scan.images)} images"
    else:
        camera = without[0]
        images = [image for image in scan.images if image.camera == camera]
        best = int(np.argmax(counts))
        whose = (
            f"{len(images)} images of camera {scan.cameras[camera]} (found in {counts[best]} of "
            f"camera {scan.cameras[best]})"
        )
    reason = why_not(board, _sample(scan, images))
    if len(without) < len(scan.cameras):
        reason += "; or take its folder away, to calibrate the others"
    raise CalibrationError(f"looked for {board.described} in {whose} and found none: {reason}")


def _messages(scan: Scan, board: Board, failed: list[ScanImage]) -> tuple[str, ...]:
    if len(failed) < max(FEWEST_FAILED, FAILED_SHARE * len(scan.images)):
        return ()
    other = another_board(board, _sample(scan, failed))
    if other is None:
        return ()
    return (
        f"{len(failed)} of {len(scan.images)} images do not show the board; {other}: two boards in "
        "one scan are not told apart, leave out the images of one",
    )


def _sample(scan: Scan, images: list[ScanImage]) -> list[NDArray[np.uint8]]:
    """Some images, spread evenly over all."""
    places = np.linspace(0, len(images) - 1, min(SAMPLE, len(images))).round().astype(int)
    return [read_image(scan, images[place]) for place in places]

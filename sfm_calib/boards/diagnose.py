"""Why a board is not found: what a few of the images show instead."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_calib.boards.detect import detect
from sfm_calib.boards.local import reduced
from sfm_calib.boards.markers import READ_PX
from sfm_calib.boards.pattern import marker_squares
from sfm_calib.boards.spec import DICTIONARIES, Aprilgrid, Board, Charuco, Checkerboard, Circles

GrayImage = NDArray[np.uint8]
Images = Sequence[GrayImage]
Markers = tuple[str, int] | None  # their dictionary, and the largest id

LOOK_PX = 320_000  # sizes of checkerboards are read in images of about so many pixels
SHARE = 1 / 3  # of the images, that must show something else before it is said
FEWEST = 2  # images of them
SIZES_TRIED = 4  # of checkerboards, the most frequent ones
SMALLEST, LARGEST = 3, 14  # inner corners along a side of the checkerboards looked for
FEWEST_MARKERS = 3  # in an image: one or two are misread now and then
DICTIONARY_SAMPLE = 4  # images in which markers of every dictionary are looked for
# Of those of one name and several sizes, the smaller are the beginning of the larger; the largest
# take four times as long, and boards begin with marker 0.
DICTIONARIES_TRIED = (
    "DICT_4X4_250",
    "DICT_5X5_250",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12",
    "DICT_APRILTAG_36h11",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_16h5",
)


def why_not(board: Board, images: Images) -> str:
    """What the images show instead of the board, and what to do, for the end of a message."""
    said = _best_of(_variants(board), images)
    if said:
        return said
    markers = _markers_seen(images[:: -(-len(images) // DICTIONARY_SAMPLE)], board)
    if isinstance(board, Charuco):
        said = _best_of(_with_dictionary(board, markers), images)
        if said:
            return said
    other = _other_markers(board, markers) or another_board(board, images)
    if other:
        return other
    return (
        f"the {len(images)} images looked at again show no board of another kind or size either; "
        "show all of it, sharp, with its white margin, and not at a flat angle"
    )


def _best_of(variants: Iterable[tuple[str, Board]], images: Images) -> str | None:
    """What to write, where many of the images show one of the variants of a board."""
    best, most = "", 0
    for remedy, changed in variants:
        count = _times_found(changed, images)
        if count > most:
            best, most = remedy, count
    if not _is_many(most, images):
        return None
    return f"{most} of {len(images)} images looked at again show it so: {best}"


def another_board(board: Board, images: Images) -> str | None:
    """That many of the images show a checkerboard of another size, if they do."""
    sizes: Counter[tuple[int, int]] = Counter()
    for image in images:
        size = _checkerboard_size(image)
        if size is not None:
            sizes[size] += 1
    if isinstance(board, Checkerboard):
        sizes.pop((max(board.inner_corners), min(board.inner_corners)), None)
    best, most = None, 0
    for size, _ in sizes.most_common(SIZES_TRIED):
        count = _times_found(Checkerboard(inner_corners=size, square_m=1.0), images)
        if count > most:
            best, most = size, count
    if best is None or not _is_many(most, images):
        return None
    said = (
        f"a checkerboard of {best[0]} x {best[1]} inner corners fits {most} of {len(images)} "
        "images looked at again"
    )
    if isinstance(board, Checkerboard):
        return f"{said} (inner_corners: [{best[0]}, {best[1]}])"
    return said


def _is_many(count: int, images: Images) -> bool:
    return count >= max(min(FEWEST, len(images)), SHARE * len(images))


def _times_found(board: Board, images: Images) -> int:
    return sum(detect(image, board) is not None for image in images)


def _checkerboard_size(image: GrayImage) -> tuple[int, int] | None:
    """Inner corners of the largest checkerboard that OpenCV can grow, the longer side first."""
    small, _ = reduced(image, LOOK_PX)
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
    found, _, cells = cv2.findChessboardCornersSBWithMeta(small, (SMALLEST, SMALLEST), flags)
    if not found or min(cells.shape) < SMALLEST or max(cells.shape) > LARGEST:
        return None
    return max(cells.shape), min(cells.shape)


def _variants(board: Board) -> Iterator[tuple[str, Board]]:
    """Boards that the user may have meant, each with what to write instead."""
    yield from _turned(board)
    if isinstance(board, Charuco | Aprilgrid | Circles):
        inverted = not board.inverted
        swapped = board.model_copy(update={"inverted": inverted})
        yield f"write 'inverted: {str(inverted).lower()}'", swapped
    if isinstance(board, Charuco | Aprilgrid) and not board.two_sided:
        yield (
            "mirrored; un-mirror the images, or write 'two_sided: true' where the pattern shows "
            "through on the back of the board",
            board.model_copy(update={"two_sided": True}),
        )


def _turned(board: Board) -> Iterator[tuple[str, Board]]:
    """Columns and rows swapped, and the other layouts of a type."""
    if isinstance(board, Charuco):
        columns, rows = board.squares
        turned = board.model_copy(update={"squares": (rows, columns)})
        legacy = board.model_copy(update={"legacy": not board.legacy})
        yield f"write 'squares: [{rows}, {columns}]'", turned
        yield f"write 'legacy: {str(not board.legacy).lower()}'", legacy
        both = turned.model_copy(update={"legacy": not board.legacy})
        text = f"write 'squares: [{rows}, {columns}]' and 'legacy: {str(not board.legacy).lower()}'"
        yield text, both
    elif isinstance(board, Aprilgrid):
        columns, rows = board.tags
        turned_grid = board.model_copy(update={"tags": (rows, columns)})
        yield f"write 'tags: [{rows}, {columns}]'", turned_grid
        bits = 1 if board.border_bits == 2 else 2
        yield f"write 'border_bits: {bits}'", board.model_copy(update={"border_bits": bits})
    elif isinstance(board, Circles):
        columns, rows = board.circles
        turned_circles = board.model_copy(update={"circles": (rows, columns)})
        yield f"write 'circles: [{rows}, {columns}]'", turned_circles
        other = not board.asymmetric
        yield (
            f"write 'asymmetric: {str(other).lower()}'",
            board.model_copy(update={"asymmetric": other}),
        )


def _with_dictionary(board: Charuco, markers: Markers) -> Iterator[tuple[str, Board]]:
    """The board with the markers that the images show, in both layouts."""
    if markers is None or markers[0] == board.dictionary:
        return
    name = markers[0]
    for legacy in (board.legacy, not board.legacy):
        text = f"write 'dictionary: {name}'"
        if legacy != board.legacy:
            text += f" and 'legacy: {str(legacy).lower()}'"
        yield text, board.model_copy(update={"dictionary": name, "legacy": legacy})


def _other_markers(board: Board, markers: Markers) -> str | None:
    """That the images show markers, where those of the board do not fit."""
    if markers is None:
        return None
    seen = f"the images looked at again show markers of {markers[0]} with ids up to {markers[1]}"
    if isinstance(board, Charuco):
        n_markers = len(marker_squares(board))
        return f"{seen}, and the board has {n_markers}: count its squares again"
    if isinstance(board, Aprilgrid):
        return f"{seen}, and the board has {board.tags[0] * board.tags[1]}: count its tags again"
    return f"{seen}: is it a ChArUco board?"


def _markers_seen(images: Images, board: Board) -> Markers:
    """The smallest dictionary that has the markers of many of the images, and the largest id."""
    best, most = None, 0
    parameters = cv2.aruco.DetectorParameters()
    if isinstance(board, Aprilgrid):
        parameters.markerBorderBits = board.border_bits
    for name in DICTIONARIES_TRIED:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        detector = cv2.aruco.ArucoDetector(dictionary, parameters)
        count, largest = 0, 0
        for image in images:
            positive = 255 - image if getattr(board, "inverted", False) else image
            found, ids, _ = detector.detectMarkers(reduced(positive, READ_PX)[0])
            if len(found) >= FEWEST_MARKERS:
                count += 1
                largest = max(largest, int(np.max(ids)))
        if count > most:
            best, most = (_smallest(name, largest), largest), count
    return best if _is_many(most, images) else None


def _smallest(name: str, largest_id: int) -> str:
    """The smallest dictionary of the same markers with an id."""
    stem = name.rsplit("_", 1)[0]
    if not name.endswith("_250"):
        return name
    sizes = sorted(int(each.rsplit("_", 1)[1]) for each in DICTIONARIES if each.startswith(stem))
    return f"{stem}_{next(size for size in sizes if size > largest_id)}"

"""How the board lies in its images: frames that tell nothing new, and a diverse choice of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphs.frames import FloatArray
from graphs.lenses import IntArray
from graphs.planar import Corners, SeenBoard, gather, homographies

# Corners that moved by less between two frames, in image widths rms: a board that was held still.
REDUNDANT_WIDTHS = 0.01
NEVER_SEEN = 1.0  # what a view adds whose camera has no view yet; views differ by 0.1 to 1
PAIR_VALUE = 1.0  # what a frame adds for two cameras that it is the first to link


def redundant(
    views: Sequence[SeenBoard], n_corners: int, sizes: Sequence[tuple[int, int]]
) -> tuple[tuple[int, ...], ...]:
    """Groups of frames (indices, ascending) in which no camera saw the board move.

    The same cameras saw it in each, and from the group's first frame to the others the common
    corners differ by less than 1 % of the image width rms in each camera. Groups of one left out.
    """
    frames = np.array(sorted({view.frame for view in views}), dtype=np.int64)
    pixels = np.full((len(frames), len(sizes), n_corners, 2), np.nan)
    for view in views:
        pixels[np.searchsorted(frames, view.frame), view.camera, view.corner] = view.pixels
    pixels /= np.array([size[0] for size in sizes])[:, None, None]
    seen = np.isfinite(pixels[..., 0]).any(-1)  # (n_frames, n_cameras)
    groups: list[list[int]] = []
    left = np.ones(len(frames), dtype=bool)
    for first in range(len(frames)):
        if not left[first]:
            continue
        others = np.flatnonzero(left & (seen == seen[first]).all(1))
        others = others[others >= first]
        squares = ((pixels[others] - pixels[first]) ** 2).sum(-1)
        common = np.isfinite(squares)
        count = common.sum(-1)
        moved = np.where(common, squares, 0.0).sum(-1) / np.maximum(count, 1)
        still = (moved < REDUNDANT_WIDTHS**2) & (count > 0)
        members = others[(still | ~seen[first]).all(1)]
        left[members] = False
        groups.append(members.tolist())
    return tuple(tuple(frames[g].tolist()) for g in groups if len(g) > 1)


def layouts(
    corners: Corners, corners_m: FloatArray, sizes: Sequence[tuple[int, int]]
) -> FloatArray:
    """How the board lies in each view (n_views, 8): middle (2), half sides (4), tilts (2).

    Lengths are in image widths. Tilts are the relative change of depth along the board.
    """
    widths = np.array([max(size) for size in sizes], dtype=np.float64)[corners.camera]
    centres = np.array([[(n - 1) / 2 for n in size] for size in sizes])[corners.camera]
    at = (corners.pixels - centres[corners.view]) / widths[corners.view, None]
    rays = np.concatenate([at, np.ones((len(at), 1))], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = homographies(corners, rays)
    depth = found[:, 2, 2]
    tilts = found[:, 2, :2] / np.where(np.abs(depth) > 1e-9, depth, 1e-9)[:, None]
    return np.concatenate([_affine(corners, corners_m, at), np.clip(tilts, -0.5, 0.5)], axis=1)


def _affine(corners: Corners, corners_m: FloatArray, at: FloatArray) -> FloatArray:
    """Middle and half sides (n_views, 6) of the whole board, were its image affine."""
    low, high = corners_m[:, :2].min(0), corners_m[:, :2].max(0)
    flat = (corners.board[:, :2] - (low + high) / 2) / np.maximum((high - low) / 2, 1e-12)
    design = np.concatenate([np.ones((len(flat), 1)), flat], axis=1)
    square = corners.sums(design[:, :, None] * design[:, None, :])
    right = corners.sums(design[:, :, None] * at[:, None, :])
    # The ridge is a corner's thousandth: corners in one line leave one side undetermined.
    found = np.linalg.solve(square + 1e-3 * np.eye(3), right)
    return np.clip(found.reshape(-1, 6), -2.0, 2.0)


def thin(
    views: Sequence[SeenBoard],
    most: int,
    corners_m: FloatArray,
    sizes: Sequence[tuple[int, int]],
) -> tuple[int, ...]:
    """Indices of the views of `most` frames at most, which show the board as differently as can be.

    Greedy: next is the frame whose views are farthest from those taken in how the board lies in
    the image (place, size, tilt), summed over its cameras; pairs of cameras that few frames link
    count besides. Without views that make no sense: drop those first.
    """
    frames = sorted({view.frame for view in views})
    if len(frames) <= most:
        return tuple(range(len(views)))
    corners = gather(views, corners_m)
    layout = layouts(corners, corners_m, sizes)
    frame = np.searchsorted(frames, [view.frame for view in views])
    seen = np.zeros((len(frames), len(sizes)), dtype=bool)
    seen[frame, corners.camera] = True
    kept = np.zeros(len(frames), dtype=bool)
    nearest = np.full(len(views), NEVER_SEEN)
    links = np.zeros((len(sizes), len(sizes)))
    for _ in range(most):
        value = np.bincount(frame, weights=nearest, minlength=len(frames))
        value += 0.5 * np.einsum("fa,fb,ab->f", seen, seen, _link_value(links))
        taken = int(np.argmax(np.where(kept, -np.inf, value)))
        kept[taken] = True
        links += np.outer(seen[taken], seen[taken])
        _shorten(nearest, layout, corners.camera, np.flatnonzero(frame == taken))
    return tuple(np.flatnonzero(kept[frame]).tolist())


def _link_value(links: FloatArray) -> FloatArray:
    value = PAIR_VALUE / (1.0 + links)
    np.fill_diagonal(value, 0.0)
    return value


def _shorten(nearest: FloatArray, layout: FloatArray, camera: IntArray, taken: IntArray) -> None:
    """Let `nearest` (n_views,) know of the views taken: distances within the same camera."""
    for view in taken:
        same = np.flatnonzero(camera == camera[view])
        distance = np.linalg.norm(layout[same] - layout[view], axis=1)
        nearest[same] = np.minimum(nearest[same], distance)

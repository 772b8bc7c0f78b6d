"""What a change of the calibration does to the picture: projection derivatives over whole images.

A camera that turned a little sees the same scene shifted: what a common rotation of the rig undoes
is no error of the calibration (the "implied transformation" of mrcal's projection uncertainty), so
the best-fitting one is taken out. Points are as far as asked, straight ahead or to the side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graphs.camera import image_pixels, unproject
from graphs.frames import FloatArray
from graphs.problem import Estimate, IntArray, Observations, points_in_cameras
from graphs.propagation import projection

GRID = (16, 12)  # pixels across and down each image


@dataclass(frozen=True)
class ImageGrid:
    """Pixels over the images of some cameras, and how each moves with the calibration."""

    names: tuple[str, ...]  # of the parameters
    camera: IntArray  # (n,) of each pixel, an index into `Estimate.cameras`
    pixels: FloatArray  # (n, 2)
    by_calibration: FloatArray  # (n, 2, len(names)), the points fixed in the rig's frame
    by_rotation: FloatArray  # (n, 2, 3), of the whole rig about its own axes

    @property
    def settled(self) -> FloatArray:
        """`by_calibration` (n, 2, len(names)) once the rig turned to undo what it can."""
        return without_rotation(self.by_rotation, self.by_calibration)


def without_rotation(
    by_rotation: FloatArray, moved: FloatArray, fit: NDArray[np.bool_] | slice = slice(None)
) -> FloatArray:
    """What is left of moves (n, 2, k) of pixels once the rotation is undone that fits each best.

    by_rotation (n, 2, 3): derivatives by it. fit (n,): the pixels by which it is judged; all, where
    not given.
    """
    turn = by_rotation[fit].reshape(-1, 3)
    left: FloatArray = (
        moved - by_rotation @ np.linalg.lstsq(turn, moved[fit].reshape(len(turn), -1))[0]
    )
    return left


def image_grid(
    estimate: Estimate,
    names: Sequence[str],
    distances: Sequence[float],
    cameras: Sequence[int] | None = None,
    shape: tuple[int, int] = GRID,
) -> ImageGrid:
    """How projections move with the parameters `names`, of points at a distance from each camera.

    distances (n_cameras,): of every camera of the estimate, in its unit; inf: so far that
    translations do not matter. cameras: those to look through; all, where not given. Parameters
    that a name does not mention are held. Pixels whose ray the lens does not know are left out.
    """
    place = {name: index for index, name in enumerate(names)}
    owner, pixels, moved, turned = [], [], [], []
    for index in range(len(estimate.cameras)) if cameras is None else cameras:
        camera, cam_from_rig = estimate.cameras[index], estimate.cam_from_rig[index]
        grid = image_pixels(camera.size, shape)[2]
        rays = unproject(camera, grid)
        seen = np.isfinite(rays[:, 0])
        far = FAR * max(float(np.linalg.norm(cam_from_rig.translation)), 1.0)
        distance = min(distances[index], far)
        points = cam_from_rig.inverse @ (distance * rays[seen])
        view = projection(estimate, index, points)
        J = np.zeros((len(points), 2, len(names)))
        for column, name in enumerate(view.names):
            if name in place:
                J[:, :, place[name]] = view.by_calibration[:, :, column]
        owner.append(np.full(len(points), index))
        pixels.append(grid[seen])
        moved.append(J)
        # b . (w x x) = w . (x x b): how a turn w moves a point x of the rig
        turned.append(np.cross(points[:, None, :], view.by_point))
    return ImageGrid(
        tuple(names), np.concatenate(owner), np.concatenate(pixels), np.concatenate(moved),
        np.concatenate(turned),
    )  # fmt: skip


FAR = 1e6  # in place of infinity, of the camera's distance from the rig's origin


def corners(grid: ImageGrid, camera: int, size: tuple[int, int]) -> IntArray:
    """Rows of the grid's pixels that are nearest to the image's four corners."""
    rows = np.flatnonzero(grid.camera == camera)
    ends = np.array([(x, y) for x in (0, size[0] - 1) for y in (0, size[1] - 1)])
    distance = np.linalg.norm(grid.pixels[rows, None] - ends[None], axis=-1)
    return rows[np.unique(distance.argmin(0))]


def centre(grid: ImageGrid, camera: int, size: tuple[int, int]) -> int:
    """Row of the grid's pixel that is nearest to the image's centre."""
    rows = np.flatnonzero(grid.camera == camera)
    middle = (np.array(size) - 1) / 2
    return int(rows[np.linalg.norm(grid.pixels[rows] - middle, axis=1).argmin()])


def typical_distances(estimate: Estimate, observations: Observations) -> FloatArray:
    """Median distance (n_cameras,) of what each camera saw, in the estimate's unit."""
    away = np.linalg.norm(points_in_cameras(estimate, observations), axis=1)
    return np.array(
        [np.median(away[observations.camera == index]) for index in range(len(estimate.cameras))]
    )

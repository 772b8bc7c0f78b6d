"""A head that the cabin of `depth_camera_cabin` takes, and how far the model of it is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from experiments.runner.protocol import Row
from graphs.camera import Camera, unproject
from graphs.frames import FloatArray, Transform
from sfm_calib.depth.cloud import Cloud, depth_points
from sfm_calib.depth.fuse import fuse_clouds, register
from sfm_calib.depth.surface import Surface
from sfm_calib.depth.surface_distance import Distances, align_icp, summary
from sfm_calib.errors import CalibrationError
from sfm_calib.simulate.cabin import Cabin, head_place, resized
from sfm_calib.simulate.depth_image import depth_image, to_be_seen
from sfm_calib.simulate.head import make_head
from sfm_calib.simulate.rigs import SimulatedRig

# Depth that a driver registers to the colour camera, at about the infrared camera's resolution:
# finer it holds nothing more.
COLOUR_SIZE = 1 / 3
REGISTERED_BY = 2  # every other point tells ICP the same motion in half the time
# A model is laid on the true head by so many of its points, none farther off it than this.
MOST_LAID, LAID_ON_M = 2000, 0.05
DECIMALS = 4  # of mm: less is rounding
PAINTED = 4  # subdivisions of the head that distances are painted on: 2562 places
FAILED_MM = 10.0  # parts of a model farther off than this, rms, were not registered


@dataclass(frozen=True)
class Taken:
    """A head, and the depth images (height, width) in m that the devices took of it."""

    cabin: Cabin
    head: Surface
    seen: FloatArray  # (n, 3) its vertices that a device sees
    rig_from_head: Transform
    infrared: tuple[FloatArray, ...]
    colour: tuple[FloatArray, ...]  # the same head in the colour cameras, resized


def taken(cabin: Cabin, rng: np.random.Generator, noise: float) -> Taken:
    """One depth image a device, of a head that sits about where it should.

    Raises CalibrationError where Open3D is missing.
    """
    head, rig_from_head = Surface(*make_head()), head_place(rng)
    surface = to_be_seen(head.vertices, head.triangles)

    def images(cameras: Sequence[int], size: float) -> tuple[FloatArray, ...]:
        return tuple(
            depth_image(
                surface,
                resized(cabin.true.cameras[index], size),
                cabin.true.cam_from_rig[index] @ rig_from_head,
                rng,
                noise,
            )
            for index in cameras
        )

    infrared = images(cabin.infrared, 1)
    exact = fuse_clouds(*points_of(infrared, cabin.true, cabin.infrared, 1)).points
    seen = np.unique(KDTree(head.vertices).query(rig_from_head.inverse @ exact)[1])
    colour = images(cabin.colour, COLOUR_SIZE)
    return Taken(cabin, head, head.vertices[seen], rig_from_head, infrared, colour)


def model_row(scene: Taken, rig: SimulatedRig) -> Row:
    """What is measured of the models that a rig makes of a head, in mm."""
    infrared, places = points_of(scene.infrared, rig, scene.cabin.infrared, 1)
    colour, _ = points_of(scene.colour, rig, scene.cabin.colour, COLOUR_SIZE)
    true, true_places = points_of(scene.infrared, scene.cabin.true, scene.cabin.infrared, 1)
    exact = fuse_clouds(true, true_places)
    as_placed = fuse_clouds(infrared, places)
    some = [part[::REGISTERED_BY] for part in infrared]
    registration = register(fuse_clouds(some, places, with_normals=True))
    registered = fuse_clouds(infrared, registration.corrected(places))
    on_head = laid_on_head(scene, as_placed.points)
    return {
        "points": len(as_placed.points),
        **distances(scene, on_head),
        "painted_mm": painted_mm(scene, on_head),
        "misplaced_mm": misplaced_mm(as_placed, exact),
        **distances(scene, laid_on_head(scene, registered.points), "registered_"),
        "registered_misplaced_mm": misplaced_mm(registered, exact),
        "refused": sum(registration.failed),
        **of_devices(scene, infrared, places, "infrared_"),
        **of_devices(scene, colour, [rig.cam_from_rig[i] for i in scene.cabin.colour], "colour_"),
    }


def points_of(
    depth_m: Sequence[FloatArray], rig: SimulatedRig, cameras: Sequence[int], size: float
) -> tuple[list[FloatArray], list[Transform]]:
    """Points (n, 3) of each camera in its own frame, and its cam_from_rig."""
    parts = []
    for image, index in zip(depth_m, cameras, strict=True):
        camera = resized(rig.cameras[index], size)
        points, pixels = depth_points(image, camera, rays=rays_at(image > 0, camera))
        if len(pixels) < np.count_nonzero(image):
            raise CalibrationError(
                f"{camera.name}: its lens as calibrated folds back within the head's picture"
            )
        parts.append(points)
    return parts, [rig.cam_from_rig[index] for index in cameras]


def rays_at(where: NDArray[np.bool_], camera: Camera) -> FloatArray:
    """Unit rays (h, w, 3) of the pixels that are looked at; a whole image takes a second."""
    rays = np.full((*where.shape, 3), np.nan)
    row, column = np.nonzero(where)
    rays[row, column] = unproject(camera, np.stack([column, row], axis=-1).astype(np.float64))
    return rays


def misplaced_mm(cloud: Cloud, exact: Cloud) -> float:
    """How far (rms) the worst part lies from where it belongs beside the front one's part.

    exact: the same points by the true lenses and places.
    """
    front = cloud.camera == 0
    middle, there = cloud.points[front].mean(axis=0), exact.points[front].mean(axis=0)
    turn, _ = Rotation.align_vectors(exact.points[front] - there, cloud.points[front] - middle)
    off = turn.apply(cloud.points - middle) + there - exact.points
    square = (off**2).sum(axis=1)
    worst_m = max(
        float(np.sqrt(square[cloud.camera == camera].mean())) for camera in np.unique(cloud.camera)
    )
    return round(1e3 * worst_m, DECIMALS)


# ---- distances to the true head ------------------------------------------------------------


def laid_on_head(scene: Taken, points: FloatArray) -> FloatArray:
    """Points (n, 3) in the rig's frame moved as one to where they fit the head best."""
    some = points[:: max(len(points) // MOST_LAID, 1)]
    fit = align_icp(some, scene.head, scene.rig_from_head.inverse, LAID_ON_M)
    return fit.transform @ points


def off_head(scene: Taken, on_head: FloatArray) -> Distances:
    """Of points (n, 3) to the head; without a sign, which takes longer than all else."""
    return Distances(np.linalg.norm(on_head - scene.head.closest(on_head)[0], axis=1), None)


def distances(scene: Taken, on_head: FloatArray, prefix: str = "") -> dict[str, float]:
    """Of points (n, 3), laid on the head, to it, in mm.

    hausdorff: the larger of the farthest point from the head, and the farthest place of the head,
    of those that a device saw, from the points.
    """
    found = summary(off_head(scene, on_head))
    missed_m = float(KDTree(on_head).query(scene.seen)[0].max())
    lengths_m = {
        "mean": found.mean_m,
        "rms": found.rms_m,
        "p95": found.p95_m,
        "max": found.max_m,
        "hausdorff": max(found.max_m, missed_m),
    }
    return {f"{prefix}{name}_mm": 1e3 * length for name, length in lengths_m.items()}


def of_devices(
    scene: Taken, parts: Sequence[FloatArray], places: Sequence[Transform], prefix: str
) -> dict[str, float]:
    """Means over devices, the points (n, 3) of each laid on the head by themselves."""
    each = [
        summary(off_head(scene, laid_on_head(scene, at.inverse @ part)))
        for part, at in zip(parts, places, strict=True)
    ]
    return {
        f"{prefix}mean_mm": 1e3 * float(np.mean([one.mean_m for one in each])),
        f"{prefix}rms_mm": 1e3 * float(np.mean([one.rms_m for one in each])),
    }


def painted_mm(scene: Taken, on_head: FloatArray) -> list[float]:
    """Mean distance of the points nearest to each vertex of a coarser head; -1: there are none."""
    vertices, _ = make_head(PAINTED)
    off = 1e3 * off_head(scene, on_head).unsigned
    of = KDTree(vertices).query(on_head)[1]
    count = np.bincount(of, minlength=len(vertices))
    mean = np.bincount(of, off, len(vertices)) / np.maximum(count, 1)
    return [float(value) for value in np.where(count > 0, np.round(mean, DECIMALS), -1.0)]

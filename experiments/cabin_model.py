"""A head that the cabin of `depth_camera_cabin` takes, and how far the model of it is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from experiments.runner.protocol import Row
from graphs.camera import Camera, unproject
from graphs.frames import FloatArray, Transform
from sfm_calib.depth.cloud import Cloud, depth_points, moved
from sfm_calib.depth.fuse import fuse_clouds
from sfm_calib.depth.registration import register
from sfm_calib.errors import CalibrationError
from sfm_calib.simulate.cabin import Cabin, head_place, resized
from sfm_calib.simulate.depth_image import depth_image, to_be_seen
from sfm_calib.simulate.head import make_head
from sfm_calib.simulate.rigs import SimulatedRig

# Depth that a driver registers to the colour camera, at about the infrared camera's resolution:
# finer it holds nothing more.
COLOUR_SIZE = 1 / 3
LAID_ON_M = 0.05  # points this far from the surface still pull when the model is laid on it
PAINTED = 4  # subdivisions of the head that distances are painted on: 2562 places
FAILED_MM = 10.0  # parts of a model farther off than this, rms, were not registered


@dataclass(frozen=True)
class Taken:
    """A head, and the depth images (height, width) in m that the devices took of it."""

    cabin: Cabin
    rig_from_head: Transform
    infrared: tuple[FloatArray, ...]
    colour: tuple[FloatArray, ...]  # the same head in the colour cameras, resized


def taken(cabin: Cabin, rng: np.random.Generator, noise: float) -> Taken:
    """One depth image a device, of a head that sits about where it should.

    Raises CalibrationError where Open3D is missing.
    """
    surface, rig_from_head = to_be_seen(*make_head()), head_place(rng)

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

    return Taken(cabin, rig_from_head, images(cabin.infrared, 1), images(cabin.colour, COLOUR_SIZE))


def model_row(scene: Taken, rig: SimulatedRig) -> Row:
    """What is measured of the models that a rig makes of a head, in mm."""
    infrared, places = points_of(scene.infrared, rig, scene.cabin.infrared, 1)
    colour, _ = points_of(scene.colour, rig, scene.cabin.colour, COLOUR_SIZE)
    true, true_places = points_of(scene.infrared, scene.cabin.true, scene.cabin.infrared, 1)
    exact = fuse_clouds(true, true_places)
    as_placed = fuse_clouds(infrared, places, with_normals=True)
    registration = register(as_placed)
    registered = moved(as_placed, registration.transforms)
    return {
        "points": len(as_placed.points),
        **distances(scene, as_placed.points),
        "misplaced_mm": misplaced_mm(as_placed, exact),
        **distances(scene, registered.points, "registered_"),
        "registered_misplaced_mm": misplaced_mm(registered, exact),
        "refused": sum(registration.failed),
        **single(scene, infrared, places, "infrared_"),
        **single(scene, colour, [rig.cam_from_rig[i] for i in scene.cabin.colour], "colour_"),
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
    return 1e3 * max(
        float(np.sqrt(square[cloud.camera == camera].mean())) for camera in np.unique(cloud.camera)
    )

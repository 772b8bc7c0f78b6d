"""One frame of depth images: what its cameras saw, fused, registered, and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from graphs.frames import FloatArray
from graphs.problem import IntArray
from sfm_calib.depth.cloud import Cloud, DepthKind, depth_points, evenly, measured
from sfm_calib.depth.depth_images import Frame, Uint8, read_colours, read_depth
from sfm_calib.depth.fuse import fuse_clouds, moved, oriented, register, thinned
from sfm_calib.depth.fuse_options import FuseOptions
from sfm_calib.depth.fuse_record import FrameRecord, OverlapRecord, PartRecord, RegistrationRecord
from sfm_calib.depth.overlap import overlap
from sfm_calib.depth.ply import ply
from sfm_calib.depth.predicted import sigma_apart, sigma_of_points
from sfm_calib.depth.registration import LEAST_POINTS, Registration
from sfm_calib.files import write_atomically
from sfm_calib.formats import CameraRig

MOST_COMPARED = 50_000  # points of a part that are held against another: the same to three digits


@dataclass(frozen=True)
class Seen:
    """What the cameras of a rig saw at one time, in the rig's frame; cameras are its indices."""

    cloud: Cloud  # with normals
    depth_m: FloatArray  # (n,) of each point, as measured
    colours: Uint8 | None  # (n, 3)
    n_measured: Mapping[int, int]  # pixels with a depth, by camera


def see(
    frame: Frame,
    pictures: Mapping[str, Path],
    rig: CameraRig,
    rays: Mapping[str, FloatArray],
    options: FuseOptions,
) -> Seen:
    """Read a frame's images and make them a cloud."""
    assert rig.cam_from_rig is not None
    parts, depths, colours, counts = [], [], [], {}
    for index, camera in enumerate(rig.cameras):
        if camera.name not in frame.paths:
            parts.append(np.zeros((0, 3)))
            continue
        depth_m = read_depth(frame.paths[camera.name], options.depth_unit)
        points, pixels = depth_points(
            depth_m, camera, options.depth_is, options.limits, rays[camera.name]
        )
        parts.append(points)
        depths.append(depth_m[tuple(pixels.T)])
        counts[index] = int(measured(depth_m).sum())
        if camera.name in pictures:
            picture = read_colours(pictures[camera.name], camera.size)
            colours.append(picture[tuple(pixels.T)])
    cloud = fuse_clouds(parts, rig.cam_from_rig)
    rows: IntArray = np.arange(len(cloud.points))
    if options.voxel_m > 0:
        rows = thinned(cloud, options.voxel_m)
    return Seen(
        oriented(cloud.only(rows), rig.cam_from_rig),
        np.concatenate(depths)[rows],
        np.concatenate(colours)[rows] if colours else None,
        counts,
    )


def fuse_frame(
    name: str,
    seen: Seen,
    rig: CameraRig,
    options: FuseOptions,
    places: Mapping[str, Path],
    out: Path,
) -> FrameRecord:
    """Register where that is asked for, write the cloud and its parts, and say how they agree."""
    within_m, cloud, found = options.max_correspondence_m, seen.cloud, None
    if options.registration != "none":
        reference = reference_of(rig, cloud)
        found = register(cloud, options.registration, within_m, reference)
        cloud = moved(cloud, found.transforms)
    for camera, path in places.items():
        rows = np.ones(len(cloud.points), bool)
        rows = cloud.camera == rig.names.index(camera) if camera else rows
        some, colours = cloud.only(rows), seen.colours
        colours = None if colours is None else colours[rows]
        write_atomically(path, ply(some.points, some.normals, colours, comment="lengths in metres"))
    return FrameRecord(
        name=name,
        file=places[""].relative_to(out).as_posix(),
        n_points=len(cloud.points),
        parts=tuple(part_record(rig, index, seen, options.depth_is) for index in seen.n_measured),
        overlaps=overlaps(seen.cloud, rig, within_m, options.depth_is),
        registration=registration_records(rig, found, tuple(seen.n_measured)) if found else (),
        overlaps_registered=overlaps(cloud, rig, within_m, None) if found else (),
    )


def reference_of(rig: CameraRig, cloud: Cloud) -> int:
    """The camera whose part stays: the rig's reference, or where that saw nothing, the one that
    saw most."""
    count = np.bincount(cloud.camera, minlength=len(rig.cameras))
    index = rig.referenced()[1]
    return index if count[index] else int(count.argmax())


def part_record(rig: CameraRig, index: int, seen: Seen, kind: DepthKind) -> PartRecord:
    """What one camera gave."""
    rows = seen.cloud.camera == index
    return PartRecord(
        camera=rig.names[index],
        n_measured=seen.n_measured[index],
        n_points=int(rows.sum()),
        median_depth_m=float(np.median(seen.depth_m[rows])) if rows.any() else None,
        sigma_m=sigma_of_points(rig, index, seen.cloud.points[rows], kind),
    )


def registration_records(
    rig: CameraRig, found: Registration, cameras: tuple[int, ...]
) -> tuple[RegistrationRecord, ...]:
    """What ICP found, a camera a row."""
    return tuple(
        RegistrationRecord(
            camera=rig.names[index],
            failed=found.reasons[index] if index < len(found.reasons) else "it has no points",
            rotation_wxyz=tuple(found.transforms[index].rotation_wxyz.tolist()),
            translation_m=tuple(found.transforms[index].translation.tolist()),
            fitness=found.fitness[index],
            rms_m=found.rms_m[index],
        )
        for index in cameras
        if index < len(found.reasons)
    )


def overlaps(
    cloud: Cloud, rig: CameraRig, within_m: float, kind: DepthKind | None
) -> tuple[OverlapRecord, ...]:
    """Every two cameras that saw anything. kind: None where the calibration is not to predict."""
    parts = {int(index): cloud.of(int(index)) for index in np.unique(cloud.camera)}
    return tuple(
        _overlap_record(rig, (a, b), parts[a], parts[b], within_m, kind)
        for a, b in combinations(parts, 2)
    )


def _overlap_record(
    rig: CameraRig, cameras: tuple[int, int], a: Cloud, b: Cloud, within_m: float,
    kind: DepthKind | None,
) -> OverlapRecord:  # fmt: skip
    """Each over the other, so that neither's sampling is preferred."""
    some_a, some_b = (one.only(evenly(len(one.points), MOST_COMPARED)) for one in (a, b))
    ab, ba = overlap(some_a, b, within_m), overlap(some_b, a, within_m)
    apart_m = np.concatenate([ab.apart_m, -ba.apart_m])
    enough = len(apart_m) >= LEAST_POINTS
    return OverlapRecord(
        cameras=(rig.names[cameras[0]], rig.names[cameras[1]]),
        n_points=len(apart_m),
        share=max(ab.share, ba.share),
        median_m=float(np.median(np.abs(apart_m))) if enough else None,
        rms_m=float(np.sqrt((apart_m**2).mean())) if enough else None,
        offset_m=float(np.median(apart_m)) if enough else None,
        sigma_m=sigma_apart(rig, cameras, ab, kind) if enough and kind else None,
    )

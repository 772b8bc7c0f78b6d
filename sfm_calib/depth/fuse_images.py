"""The story of `fuse`: depth images and a calibration in, one cloud a frame out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sfm_calib
from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from sfm_calib.depth.cloud import image_rays, measured
from sfm_calib.depth.depth_images import Frame, find_frames, read_colours, read_depth
from sfm_calib.depth.frame import fuse_frame, see
from sfm_calib.depth.fuse_options import FuseOptions
from sfm_calib.depth.fuse_record import FrameRecord, FuseRecord
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256, write_atomically
from sfm_calib.formats import NO_SIZE, CameraRig
from sfm_calib.images import IMAGE_SUFFIXES, Progress
from sfm_calib.open3d_import import import_open3d
from sfm_calib.provenance import Provenance, now
from sfm_calib.undistort import plain

RESULT = "fuse.json"
MOST_NAMED = 5  # images in a message


@dataclass(frozen=True)
class Fused:
    """What was written."""

    record: FuseRecord
    written: tuple[Path, ...]


def fuse_images(
    rig: CameraRig, depths: Path, out: Path, options: FuseOptions, overwrite: bool,
    progress: Progress, command: str = "",
) -> Fused:  # fmt: skip
    """Write the cloud of each frame into OUT, and OUT/fuse.json, last.

    Everything is read and checked before anything is written. Raises CalibrationError with cause,
    number and remedy.
    """
    options = options.checked()
    import_open3d("fusing depth images")
    frames = find_frames(depths, rig.names)
    rig = in_metres(rig, frames, options.metres)
    frames, rig, told = check_images(frames, rig, options, progress)
    pictures = find_pictures(frames, rig, options.colours)
    places = targets(frames, out, options.parts, rig.path, overwrite)
    used = [camera for camera in rig.cameras if any(camera.name in f.paths for f in frames)]
    rays = {}
    for done, camera in enumerate(used):
        progress("inverting the lenses", done, len(used))
        rays[camera.name] = image_rays(camera)
    records = []
    for done, frame in enumerate(frames):
        progress("fusing", done, len(frames))
        seen = see(frame, pictures[frame.name], rig, rays, options)
        records.append(fuse_frame(frame.name, seen, rig, options, places[frame.name], out))
    progress("fusing", len(frames), len(frames))
    record = record_of(rig, options, records, (*rig.notes, *told), command)
    write_atomically(out / RESULT, record.model_dump_json(indent=1) + "\n")
    return Fused(record, (*(p for each in places.values() for p in each.values()), out / RESULT))


# ---- what is there -------------------------------------------------------------------------


def in_metres(rig: CameraRig, frames: Sequence[Frame], metres: float | None) -> CameraRig:
    """The rig with its places in metres, as depth is; a lone camera without one at the origin."""
    if rig.cam_from_rig is None:
        if any(len(frame.paths) > 1 for frame in frames):
            raise CalibrationError(
                f"{rig.path} does not say how its cameras sit: give a file that holds the rig too"
            )
        rig = replace(rig, cam_from_rig=(Transform.identity(),) * len(rig.cameras))
    assert rig.cam_from_rig is not None
    apart = any(place.translation.any() for place in rig.cam_from_rig)
    if metres is None and rig.unit != "m" and apart:
        unit = "has its longest baseline as unit of length" if rig.unit == "baseline" else (
            "does not state its unit of length"
        )  # fmt: skip
        raise CalibrationError(
            f"{rig.path} {unit}, and depth is in metres: say how many metres its unit is with "
            "--metres, as 1, or 0.001 of mm"
        )
    return rig if metres is None else rig.metric(metres).checked()


def check_images(
    frames: Sequence[Frame], rig: CameraRig, options: FuseOptions, progress: Progress
) -> tuple[tuple[Frame, ...], CameraRig, tuple[str, ...]]:
    """Frames with their images that measure anything, the rig with the sizes that a calibration
    may leave open, and what is to be told.

    Raises CalibrationError for what is no depth image of its camera, and where none is left.
    """
    cameras = {camera.name: camera for camera in rig.cameras}
    empty, kept, far_m = [], [], 0.0
    total = sum(len(frame.paths) for frame in frames)
    done = 0
    for frame in frames:
        paths = {}
        for name, path in frame.paths.items():
            progress("reading depth", done, total)
            done += 1
            depth_m = read_depth(path, options.depth_unit)
            cameras[name] = of_size(cameras[name], depth_m, path, rig)
            far_m = max(
                far_m, float(np.nanmax(np.where(np.isinf(depth_m), 0.0, depth_m), initial=0))
            )
            if measured(depth_m, options.limits).any():
                paths[name] = path
            else:
                empty.append(f"{name}/{frame.name}")
        kept += [replace(frame, paths=paths)] if paths else []
    if not kept:
        raise CalibrationError(
            f"no depth image has a depth between {options.near_m:g} and {options.far_m:g} m (the "
            f"farthest is {far_m:.3g} m, with {options.depth_unit:g} m a count): check --near-m, "
            "--far-m and --depth-unit"
        )
    told = []
    if empty:
        more = " ..." if len(empty) > MOST_NAMED else ""
        told.append(f"nothing measured in {', '.join(empty[:MOST_NAMED])}{more}: left out")
    absent = [name for name in rig.names if not any(name in frame.paths for frame in kept)]
    if absent:
        told.append(f"no depth images of {', '.join(absent)}")
    rig = replace(rig, cameras=tuple(cameras[name] for name in rig.names))
    return tuple(kept), rig, tuple(told)


def of_size(camera: Camera, depth_m: FloatArray, path: Path, rig: CameraRig) -> Camera:
    """The camera, its size that of its first image where the calibration states none."""
    size = (depth_m.shape[1], depth_m.shape[0])
    if camera.size == NO_SIZE:
        return replace(camera, size=size)
    if camera.size != size:
        raise CalibrationError(
            f"{path} is {size[0]} x {size[1]} px, and {rig.path} calibrates {camera.name} for "
            f"{camera.size[0]} x {camera.size[1]} px: give depth as that camera took it, or "
            "calibrate at this size"
        )
    return camera


def find_pictures(
    frames: Sequence[Frame], rig: CameraRig, given: Path | None
) -> dict[str, dict[str, Path]]:
    """Of each frame, the pictures by camera; none where they are not given.

    Raises CalibrationError where one of a depth image is missing, or cannot be its colours.
    """
    if given is None:
        return {frame.name: {} for frame in frames}
    cameras = {camera.name: camera for camera in rig.cameras}
    by_name = {frame.name: frame.paths for frame in find_frames(given, rig.names, IMAGE_SUFFIXES)}
    if len(frames) == len(by_name) == 1:  # of single images the frame is called as their folder
        by_name = {frames[0].name: next(iter(by_name.values()))}
    for frame in frames:
        for name in frame.paths:
            path = by_name.get(frame.name, {}).get(name)
            if path is None:
                raise CalibrationError(
                    f"{given} has no picture of {name}/{frame.name}: name pictures as the depth "
                    "images are called, or leave out --colours"
                )
            read_colours(path, cameras[name].size)
    return by_name


def targets(
    frames: Sequence[Frame], out: Path, parts: bool, calibration: Path, overwrite: bool
) -> dict[str, dict[str, Path]]:
    """Where each frame's cloud goes (the empty name), and each camera's part of it.

    Raises CalibrationError where a file is there already.
    """
    found: dict[str, dict[str, Path]] = {}
    for frame in frames:
        several = len(frames) > 1
        found[frame.name] = {"": out / f"fused/{frame.name}.ply" if several else out / "fused.ply"}
        for name in frame.paths if parts else ():
            part = f"{plain(name)}/{frame.name}.ply" if several else f"{plain(name)}.ply"
            found[frame.name][name] = out / "parts" / part
    for path in (*(p for each in found.values() for p in each.values()), out / RESULT):
        if path.resolve() == calibration.resolve():
            raise CalibrationError(f"{path} would be written over: choose another OUT with -o")
        if path.exists() and not overwrite:
            raise CalibrationError(
                f"{path} is there already: choose another OUT with -o, or --overwrite"
            )
    return found


# ---- what is told --------------------------------------------------------------------------


def record_of(
    rig: CameraRig, options: FuseOptions, frames: Sequence[FrameRecord], notes: Sequence[str],
    command: str,
) -> FuseRecord:  # fmt: skip
    """The whole record; notes say which registrations failed."""
    failed = [
        f"{frame.name}: {one.camera} stays where the calibration has it: {one.failed}"
        for frame in frames
        for one in frame.registration
        if one.failed
    ]
    referenced, index = rig.referenced()
    given = options.__dict__ | {"colours": str(options.colours) if options.colours else None}
    hashes = {rig.path.name: sha256(rig.path)} if rig.path.is_file() else {}
    return FuseRecord(
        calibration=str(rig.path),
        reference=rig.names[index] if referenced is rig else None,
        depth_is=options.depth_is,
        registration=options.registration,
        within_m=options.max_correspondence_m,
        frames=tuple(frames),
        notes=(*notes, *failed),
        provenance=Provenance(
            version=sfm_calib.__version__,
            command=command,
            config={name: None if value == np.inf else value for name, value in given.items()},
            input_hashes=hashes,
            created=now(),
        ),
    )

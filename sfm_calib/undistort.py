"""Images and videos without distortion, and the calibration that is theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import sfm_calib
from graphs.camera import Camera, focal_on_axis
from graphs.covariance import NOTHING
from graphs.frames import Transform
from graphs.virtual import Turned, share_shown
from sfm_calib import sources
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256, write_atomically
from sfm_calib.formats import NO_SIZE, CameraRig
from sfm_calib.images import Progress
from sfm_calib.provenance import Provenance
from sfm_calib.resample import maps_file, resample, resampling
from sfm_calib.result import Calibration, Verdict, save_calibration
from sfm_calib.sources import Source
from sfm_calib.views import ViewOptions, undistorted

RESULT = "calibration.json"
NOT_CARRIED = (
    "the numbers of a virtual camera are exact, but its rays are only as right as the calibration "
    "that they were made by, whose covariance is not carried over: {}"
)


@dataclass(frozen=True)
class Remade:
    """What became of the images or videos of one camera."""

    camera: Camera  # the real one
    virtual: Camera
    source: Source
    shown: float  # share of the original that is seen
    black: float  # share of the new that is not


@dataclass(frozen=True)
class Undistorted:
    """What was written, and what is to be said of it."""

    remade: tuple[Remade, ...]
    written: tuple[Path, ...]  # beside the images
    notes: tuple[str, ...]


def undistort(
    rig: CameraRig, given: Path, out: Path, options: ViewOptions, chosen: str | None,
    overwrite: bool, progress: Progress, command: str = "",
) -> Undistorted:  # fmt: skip
    """Write GIVEN's images or videos into OUT as pinholes would have taken them.

    Everything is checked before the first is written; OUT/calibration.json comes last.
    Raises CalibrationError with cause, number and remedy.
    """
    found = sources.find_sources(given)
    pairs = sources.match(found, rig.names, chosen)
    cameras = {name: rig.cameras[rig.names.index(name)] for name, _ in pairs}
    lone = rig.cam_from_rig is None and len(cameras) > 1
    new = [name for name in rig.names if name in cameras]
    groups = [[name] for name in new] if lone else [new]
    results = [out / f"calibration_{plain(name)}.json" for name in new] if lone else [out / RESULT]
    maps = [maps_path(out, name) for name in cameras] if options.maps else []
    places = sources.targets(found, out, [*results, *maps], [rig.path], overwrite)
    read, told = sources.measured([source for _, source in pairs], progress)
    for (name, _), source in zip(pairs, read, strict=True):
        cameras[name] = of_size(cameras[name], source, rig)
    virtual = {
        name: undistorted(camera, options, focal_on_axis(camera))
        for name, camera in cameras.items()
    }
    remade = tuple(
        remake(
            Turned(cameras[name], np.eye(3)), virtual[name], source, options, places, progress,
            maps_path(out, name) if options.maps else None,
        )
        for (name, _), source in zip(pairs, read, strict=True)
    )  # fmt: skip
    for path, names in zip(results, groups, strict=True):
        kept = virtual_rig(rig, [virtual[name] for name in names], "undistort")
        save_calibration(with_origin(kept, rig, command), path)
    return Undistorted(remade, (*results, *maps), (*rig.notes, *told))


def maps_path(out: Path, name: str) -> Path:
    """Where the maps of a camera go."""
    return out / f"maps_{plain(name)}.npz"


def plain(name: str) -> str:
    """A camera's name as part of a file's."""
    return name.replace("/", "_")


def of_size(camera: Camera, source: Source, rig: CameraRig) -> Camera:
    """The camera, its image size that of the source where the calibration does not state it.

    Raises CalibrationError where they differ: a scaled image cannot be told from a cropped one.
    """
    if camera.size == NO_SIZE:
        return replace(camera, size=source.size)
    if camera.size != source.size:
        raise CalibrationError(
            f"{source.paths[0]} is {source.size[0]} x {source.size[1]} px, and {rig.path} "
            f"calibrates {camera.name} for {camera.size[0]} x {camera.size[1]} px: give images of "
            "that size, or calibrate at this one"
        )
    return camera


def remake(
    view: Turned, virtual: Camera, source: Source, options: ViewOptions,
    places: dict[Path, Path], progress: Progress, maps: Path | None,
) -> Remade:  # fmt: skip
    """Write one source's images as its virtual camera takes them, and the maps where wanted."""
    by = resampling(virtual, view, options.interpolation)
    resample(source, by, places, f"writing {source.name}", progress)
    if maps:
        write_atomically(maps, maps_file(virtual, view))
    return Remade(view.camera, virtual, source, share_shown(virtual, view), by.black)


def virtual_rig(rig: CameraRig, cameras: Sequence[Camera], how: str) -> CameraRig:
    """The rig of the virtual cameras, each in its real one's place and turned as that is.

    A camera whose frame is the rig's comes first, so that it remains its reference.
    """
    if rig.cam_from_rig is None:
        placed = [(camera, Transform.identity()) for camera in cameras]
    else:
        placed = [(c, rig.cam_from_rig[rig.names.index(c.name)]) for c in cameras]
    placed.sort(key=lambda pair: np.trace(pair[1].rotation) < 3 or pair[1].translation.any())
    return replace(
        rig,
        format=f"{how}: {rig.format}",
        cameras=tuple(camera for camera, _ in placed),
        cam_from_rig=tuple(transform for _, transform in placed),
        covariance=NOTHING,
    )


def with_origin(virtual: CameraRig, rig: CameraRig, command: str) -> Calibration:
    """The calibration of new images, which says what they were made by."""
    note = NOT_CARRIED.format(rig.path.name)
    hashes = {rig.path.name: sha256(rig.path)} if rig.path.is_file() else {}
    return virtual.calibration().model_copy(
        update={
            "verdict": Verdict(usable=True, messages=(note,)),
            "provenance": Provenance(
                version=sfm_calib.__version__, command=command, input_hashes=hashes
            ),
        }
    )

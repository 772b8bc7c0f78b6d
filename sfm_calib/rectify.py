"""A stereo pair whose rows, or columns, are those of the scene: images, calibration, matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from graphs.camera import Camera, focal_on_axis, unproject
from graphs.covariance import NOTHING
from graphs.frames import FloatArray, Transform
from graphs.rectification import Rectification, projection_matrices, rectification
from graphs.virtual import Turned, pinhole
from sfm_calib import sources
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.files import write_atomically
from sfm_calib.formats import CameraRig
from sfm_calib.images import Progress
from sfm_calib.resample import resampling
from sfm_calib.result import save_calibration
from sfm_calib.row_check import RowCheck, check_rows
from sfm_calib.sources import Source
from sfm_calib.undistort import RESULT, Remade, maps_path, of_size, remake, with_origin
from sfm_calib.views import ViewOptions, chosen_view, size_of

MATRICES = "rectification.yml"
# Each camera is turned by half of it: of an image of 60 degrees little is left beyond.
MOST_APART_DEG = 60.0
# Nearer, cameras would be turned by more than half a right angle, away from what they look at.
LEAST_OFF_AXIS_DEG = 45.0


@dataclass(frozen=True)
class Rectified:
    """A rectified pair: the left or upper camera first."""

    pair: tuple[Remade, Remade]
    geometry: Rectification
    virtual: Camera  # of both
    unit: str
    written: tuple[Path, ...]  # beside the images
    rows: RowCheck | None  # None: not asked for
    notes: tuple[str, ...]


def rectify(
    rig: CameraRig, given: Path, out: Path, options: ViewOptions, wanted: Sequence[str],
    check: bool, overwrite: bool, progress: Progress, command: str = "",
) -> Rectified:  # fmt: skip
    """Write the images or videos of two cameras into OUT as a rectified pair would have taken them.

    Everything is checked before the first is written; OUT/calibration.json comes last.
    Raises CalibrationError with cause, number and remedy.
    """
    chosen, told = pair_of(rig, sources.find_sources(given), wanted)
    indices = [rig.names.index(name) for name, _ in chosen]
    geometry = geometry_of(rig, indices)
    order = [geometry.first, 1 - geometry.first]
    names = [chosen[i][1].name for i in order]
    found = [chosen[i][1] for i in order]
    maps = [maps_path(out, name) for name in names] if options.maps else []
    beside = [out / MATRICES, out / RESULT, *maps]
    places = sources.targets(found, out, beside, [rig.path], overwrite)
    read, unreadable = sources.measured(found, progress)
    views = tuple(
        Turned(of_size(rig.cameras[indices[i]], source, rig), geometry.turns[i])
        for i, source in zip(order, read, strict=True)
    )
    virtual = chosen_view(common_pinhole(views, options, " and ".join(names)), views, options)
    lenses = [replace(virtual, name=name) for name in names]
    one, other = (
        remake(view, lens, source, options, places, progress,
               maps_path(out, lens.name) if options.maps else None)
        for view, lens, source in zip(views, lenses, read, strict=True)
    )  # fmt: skip
    rows = None
    if check:
        both = [resampling(virtual, view, options.interpolation) for view in views]
        rows = check_rows(read, both, geometry.is_vertical, progress)
    write_atomically(out / MATRICES, matrices(virtual, geometry, order))
    pair = rectified_rig(rig, lenses, geometry)
    save_calibration(with_origin(pair, rig, command), out / RESULT)
    notes = (*rig.notes, *told, *unreadable)
    return Rectified((one, other), geometry, virtual, rig.unit, tuple(beside), rows, notes)


def pair_of(
    rig: CameraRig, found: Sequence[Source], wanted: Sequence[str]
) -> tuple[list[tuple[str, Source]], tuple[str, ...]]:
    """Two cameras of the rig with their sources, as wanted, by name, or else by order.

    wanted: none, or two of `camera` or `camera=folder`. Raises CalibrationError where neither
    tells which two.
    """
    by_name = {name: source for source in found for name in source.names}
    here = ", ".join(source.name for source in found)
    if wanted:
        pairs = []
        for entry in wanted:
            camera, _, folder = entry.partition("=")
            if camera not in rig.names:
                raise CalibrationError(
                    f"--cameras {entry}: {rig.path} has no camera {camera!r}: "
                    f"{nearest(camera, rig.names)}"
                )
            if (folder or camera) not in by_name:
                raise CalibrationError(
                    f"--cameras {entry}: the input has no {folder or camera!r}, but {here}: give "
                    f"{camera}=FOLDER"
                )
            pairs.append((camera, by_name[folder or camera]))
        if len(pairs) != 2 or pairs[0][0] == pairs[1][0] or pairs[0][1] == pairs[1][1]:
            raise CalibrationError(f"--cameras {' '.join(wanted)}: name two cameras, each once")
        return pairs, ()
    pairs = [(name, by_name[name]) for name in rig.names if name in by_name]
    if len(pairs) == 2:
        return pairs, ()
    if len(pairs) < 2 and len(rig.names) == len(found) == 2:
        pairs = list(zip(rig.names, found, strict=True))
        said = ", ".join(f"{name} = {source.name}" for name, source in pairs)
        return pairs, (f"cameras are called otherwise in the input: matched by order, {said}",)
    raise CalibrationError(
        f"a stereo pair has two cameras, and of {rig.path} ({', '.join(rig.names)}) and the input "
        f"({here}) {len(pairs)} have the same name: say which with --cameras LEFT RIGHT"
    )


def geometry_of(rig: CameraRig, indices: Sequence[int]) -> Rectification:
    """How two cameras of the rig have to be turned.

    Raises CalibrationError where they have no places, or where these are no stereo pair's.
    """
    a, b = (rig.names[i] for i in indices)
    if rig.cam_from_rig is None:
        raise CalibrationError(
            f"{rig.path} does not say how its cameras sit: give a file that holds the rig too"
        )
    found = rectification((rig.cam_from_rig[indices[0]], rig.cam_from_rig[indices[1]]))
    if found is None:
        raise CalibrationError(
            f"{a} and {b} are in one place by {rig.path}: nothing is seen in depth, and "
            "`sfm-calib undistort` is what they need"
        )
    if np.degrees(found.angle_apart) > MOST_APART_DEG:
        raise CalibrationError(
            f"{a} and {b} look {np.degrees(found.angle_apart):.0f} degrees apart, and a pair can "
            f"be rectified up to {MOST_APART_DEG:g}: choose others with --cameras"
        )
    if np.degrees(found.angle_off_axis) < LEAST_OFF_AXIS_DEG:
        raise CalibrationError(
            f"{a} and {b} sit one behind the other: their baseline is "
            f"{np.degrees(found.angle_off_axis):.0f} degrees off the way they look, and a pair can "
            f"be rectified from {LEAST_OFF_AXIS_DEG:g} on: choose others with --cameras"
        )
    return found


def common_pinhole(views: Sequence[Turned], options: ViewOptions, name: str) -> Camera:
    """One pinhole with square pixels for both cameras, of their mean focal length.

    Its principal point has both image centres near its own, evenly to either side.
    """
    old = views[0].camera.size
    size = size_of(options, old)
    factor = max(size[0] / old[0], size[1] / old[1])
    focal = factor * np.exp(np.mean([np.log(focal_on_axis(v.camera)) for v in views]))
    middles = [unproject(v.camera, v.camera.centre) @ v.virtual_from_cam.T for v in views]
    seen = [ray[:2] / ray[2] for ray in middles if ray[2] > 0]
    middle = np.mean(seen, axis=0) if seen else np.zeros(2)
    centre = (np.array(size) - 1.0) / 2.0 - focal * middle
    return pinhole(name, size, np.full(2, focal), centre)


def rectified_rig(rig: CameraRig, lenses: Sequence[Camera], geometry: Rectification) -> CameraRig:
    """The new pair: the second camera the baseline to the right, or below, and not turned."""
    step = np.zeros(3)
    step[1 if geometry.is_vertical else 0] = -geometry.baseline
    return replace(
        rig,
        format=f"rectify: {rig.format}",
        cameras=tuple(lenses),
        cam_from_rig=(Transform.identity(), Transform(np.eye(3), step)),
        covariance=NOTHING,
    )


def matrices(virtual: Camera, geometry: Rectification, order: Sequence[int]) -> bytes:
    """R1, R2, P1, P2, Q as OpenCV's stereo sample writes them, the left or upper camera first."""
    P1, P2, Q = projection_matrices(virtual, geometry.baseline, geometry.is_vertical)
    R1, R2 = (geometry.turns[i] for i in order)
    entries: dict[str, FloatArray] = {"R1": R1, "R2": R2, "P1": P1, "P2": P2, "Q": Q}
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", virtual.size[0])
    storage.write("image_height", virtual.size[1])
    for name, matrix in entries.items():
        storage.write(name, np.ascontiguousarray(matrix))
    return storage.releaseAndGetString().encode()

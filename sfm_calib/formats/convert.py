"""A calibration of any origin in another program's format: lenses that it holds, and its files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Literal

import numpy as np

from graphs.camera import Camera, carries_over, fit_lens, image_pixels, project, unproject
from graphs.covariance import NOTHING
from graphs.frames import Transform
from graphs.lenses import PARAMETER_NAMES, LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.formats.colmap_export import COLMAP
from sfm_calib.formats.file_storage_writing import OPENCV_FORMATS
from sfm_calib.formats.kalibr_writing import KALIBR_FORMAT
from sfm_calib.formats.mrcal import MRCAL
from sfm_calib.formats.nerf import NERF
from sfm_calib.formats.ours_writing import OURS_FORMAT
from sfm_calib.formats.reading import NO_SIZE, CameraRig
from sfm_calib.formats.ros_writing import ROS_FORMAT
from sfm_calib.formats.urdf import URDF
from sfm_calib.formats.writing import Export, Format

FormatName = Literal[
    "sfm_calib", "kalibr", "opencv", "opencv_xml", "opencv_json", "ros", "colmap",
    "mrcal", "nerf", "urdf"]  # fmt: skip
FORMATS: dict[FormatName, Format] = {
    "sfm_calib": OURS_FORMAT,
    "kalibr": KALIBR_FORMAT,
    "opencv": OPENCV_FORMATS["yaml"],
    "opencv_xml": OPENCV_FORMATS["xml"],
    "opencv_json": OPENCV_FORMATS["json"],
    "ros": ROS_FORMAT,
    "colmap": COLMAP,
    "mrcal": MRCAL,
    "nerf": NERF,
    "urdf": URDF,
}
# Names of files that say what they hold; a .yaml or .json alone does not.
GUESSES: tuple[tuple[str, FormatName], ...] = (
    ("calibration.json", "sfm_calib"),
    ("*camchain*.yaml", "kalibr"),
    ("*camchain*.yml", "kalibr"),
    ("*.xml", "opencv_xml"),
    ("*.cameramodel", "mrcal"),
    ("*transforms*.json", "nerf"),
)
BY_SUFFIX: dict[tuple[FormatName, str], FormatName] = {
    ("opencv", ".xml"): "opencv_xml",
    ("opencv", ".json"): "opencv_json",
}
# Anywhere in the image; boards locate corners to 0.1 to 0.3 px rms. Of real cameras, k3 fitted away
# is 0.4 to 5 px off in a corner, a fisheye as eucm or double_sphere 0.4 to 8 px: to be asked for.
MOST_ERROR_PX = 0.1
ERROR_GRID = (65, 49)  # pixels of the image, its corners among them; a fit looks at fewer


def format_of(out: Path, to: FormatName | None) -> FormatName:
    """As is asked for, or as OUT's name tells. Raises CalibrationError where neither does."""
    if to:
        return BY_SUFFIX.get((to, out.suffix.lower()), to)
    for pattern, name in GUESSES:
        if fnmatch(out.name.lower(), pattern):
            return name
    raise CalibrationError(f"{out} does not tell its format: say --to {', '.join(sorted(FORMATS))}")


def exported(rig: CameraRig, to: FormatName, max_error_px: float = MOST_ERROR_PX) -> Export:
    """The files of a calibration in a format, and what could not be held as it is.

    A lens that the format does not have is refitted, and refused where it is off by more than
    `max_error_px` anywhere in the image. Raises CalibrationError also where there are too many
    cameras, and where sizes, places or metres are missing.
    """
    form = FORMATS[to]
    placed = _placed(rig, form)
    held = [_held(rig, camera, form, max_error_px) for camera in rig.cameras]
    cameras = tuple(camera for camera, _ in held)
    if cameras != rig.cameras:
        placed = replace(placed, cameras=cameras, covariance=NOTHING)
    export = form.write(placed)
    of_sigmas = rig.states_sigmas and not placed.states_sigmas
    notes = [note for _, note in held if note]
    if of_sigmas:
        notes.append("sigmas and covariance are of another lens, and not held")
    return replace(export, notes=(*notes, *export.notes))


def _placed(rig: CameraRig, form: Format) -> CameraRig:
    """With places, where the format has them; one camera sits where it is."""
    count, most = len(rig.cameras), {"one": 1, "two": 2, "any": len(rig.cameras)}[form.cameras]
    for camera in rig.cameras:
        if camera.size == NO_SIZE:
            raise CalibrationError(
                f"{rig.path} does not state the image size of {camera.name}: add --size WIDTH "
                "HEIGHT"
            )
    if count == 1 and rig.cam_from_rig is None:
        return replace(rig, cam_from_rig=(Transform.identity(),))
    if count > most and not form.apart:
        raise CalibrationError(
            f"{form.title} holds {most} camera{'s'[: most - 1]}, and {rig.path} has {count}: "
            f"choose with --camera, of {', '.join(rig.names)}"
        )
    if rig.cam_from_rig is None and not form.apart:
        raise CalibrationError(
            f"{rig.path} does not say how its {count} cameras sit, and {form.title} must: convert "
            f"one at a time, --camera {rig.names[0]}"
        )
    if form.metres and rig.cam_from_rig and 1 < count <= most and rig.unit != "m":
        raise CalibrationError(
            f"{form.title} is in metres, and {rig.path} does not state its unit of length: say how "
            "many metres it is, as --metres 0.001 for mm"
        )
    return rig


def _held(rig: CameraRig, camera: Camera, form: Format, max_error_px: float) -> tuple[Camera, str]:
    """A camera in a lens of the format, and what is to be said of that."""
    if camera.lens in form.lenses:
        return camera, ""
    if exact := _same_by_name(camera, form.lenses):
        return exact, f"{camera.name}: {camera.lens} is written as {exact.lens}, which is the same"
    fits = [fit_lens(camera, lens)[0] for lens in form.lenses]
    errors = [lens_error(camera, fit) for fit in fits]
    best = int(np.argmin([largest for _, largest in errors]))
    (rms, largest), fit = errors[best], fits[best]
    if not largest <= max_error_px:
        nearest, remedy = "each of its own sees nothing in a part of the image", ""
        if largest < np.inf:
            nearest = (
                f"its {fit.lens} is nearest, {rms:.2g} px rms and {largest:.2g} px off at worst"
            )
            remedy = f"allow more than `convert --max-error-px {max_error_px:g}`, or "
        raise CalibrationError(
            f"{form.title} has no {camera.lens} lens, and for {camera.name} of {rig.path} "
            f"{nearest}: {remedy}choose another format"
        )
    return fit, (
        f"{camera.name}: {camera.lens} is refitted as {fit.lens}, off by {rms:.2g} px rms and "
        f"{largest:.2g} px at worst"
    )


def _same_by_name(camera: Camera, lenses: Sequence[LensName]) -> Camera | None:
    """In the shortest of the lenses that has every coefficient which is not zero."""
    known = camera.named()
    needed = {name for name, value in known.items() if value}
    for lens in sorted(lenses, key=lambda lens: len(PARAMETER_NAMES[lens])):
        if carries_over(camera.lens, lens) and needed <= set(PARAMETER_NAMES[lens]):
            params = np.array([known.get(name, 0.0) for name in PARAMETER_NAMES[lens]])
            return replace(camera, lens=lens, params=params)
    return None


def lens_error(a: Camera, b: Camera) -> tuple[float, float]:
    """rms and largest distance in px of where b sees what a sees, over a's image; inf: blind."""
    pixels = image_pixels(a.size, ERROR_GRID)[2]
    rays = unproject(a, pixels)
    seen = np.isfinite(rays[:, 0])
    if not seen.any():
        return np.inf, np.inf
    error = np.linalg.norm(project(b, rays[seen]) - pixels[seen], axis=1)
    if np.isnan(error).any():
        return np.inf, np.inf
    return float(np.sqrt((error**2).mean())), float(error.max())

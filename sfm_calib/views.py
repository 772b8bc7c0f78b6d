"""Which part of the world a virtual camera shows: the view that was asked for, or why it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import tyro

from graphs.camera import Camera
from graphs.frames import FloatArray
from graphs.virtual import (
    Turned,
    inside_zoom,
    pinhole,
    resized,
    whole_zoom,
    widest_of,
    widest_seen,
    zoomed,
)
from sfm_calib.errors import CalibrationError
from sfm_calib.resample import Interpolation

MOST_FLAT_DEG = 150.0  # from corner to corner: there a flat image shows things 15 x as large
MOST_FOV_DEG = 170.0  # that can be asked for: 130 x
LARGEST, SMALLEST = 32_000, 8  # px; cv2.remap counts pixels in 16 bits
FOV_REMEDY = "say how much to show with --fov, as --fov 110"


@dataclass(frozen=True)
class ViewOptions:
    """What the new images show, and how they are made."""

    view: Annotated[
        Literal["inside", "whole", "keep"] | None, tyro.conf.arg(metavar="{inside,whole,keep}")
    ] = None
    """inside: as much as fits without black pixels (default); whole: all that the camera sees;
    keep: the focal length and principal point as they are."""
    fov: Annotated[float | None, tyro.conf.arg(metavar="DEG")] = None
    """Field of view across the image, in degrees, in place of --view."""
    scale: Annotated[float | None, tyro.conf.arg(metavar="FACTOR")] = None
    """Size of the new images in sizes of the old."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="W H")] = None
    """Size of the new images in px, in place of --scale."""
    interpolation: Interpolation = "cubic"
    """How grey levels between pixels are found; lanczos: a little better, four times as slow."""
    maps: bool = False
    """Save maps_CAMERA.npz: map_x and map_y, float32, the input pixel of each new one (integers
    are pixel centres, -1 where the lens sees nothing), as cv2.remap takes them."""

    def __post_init__(self) -> None:
        if self.view and self.fov is not None:
            raise CalibrationError("--fov sets what is shown: leave out --view")
        if self.fov is not None and not 1 <= self.fov <= MOST_FOV_DEG:
            raise CalibrationError(
                f"--fov {self.fov:g}: a flat image shows 1 to {MOST_FOV_DEG:g} degrees"
            )
        if self.size and self.scale is not None:
            raise CalibrationError("--size sets the size: leave out --scale")
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise CalibrationError(f"--scale {self.scale:g}: a scale is positive")


def size_of(options: ViewOptions, size: tuple[int, int]) -> tuple[int, int]:
    """The size of new images, given that of the old. Raises CalibrationError for no such size."""
    factor = 1.0 if options.scale is None else options.scale
    new = options.size or (round(size[0] * factor), round(size[1] * factor))
    if not SMALLEST <= min(new) <= max(new) <= LARGEST:
        raise CalibrationError(
            f"images of {new[0]} x {new[1]} px: choose {SMALLEST} to {LARGEST} px a side, with "
            "--size or --scale"
        )
    return new


def undistorted(camera: Camera, options: ViewOptions, focal: FloatArray) -> Camera:
    """The pinhole that shows of a camera what was asked for; focal (2,): of the lens on its axis.

    Raises CalibrationError as `chosen_view`.
    """
    base = resized(camera, focal, size_of(options, camera.size))
    return chosen_view(base, (Turned(camera, np.eye(3)),), options)


def chosen_view(base: Camera, views: Sequence[Turned], options: ViewOptions) -> Camera:
    """The view of `base`'s size that was asked for; `base` is the one to keep.

    Raises CalibrationError where no flat image shows it.
    """
    name = base.name
    if options.fov is not None:
        width, height = base.size
        focal = width / 2 / np.tan(np.radians(options.fov) / 2)
        ratio = np.array([1.0, base.params[1] / base.params[0]])
        return pinhole(name, base.size, focal * ratio, np.array([width - 1.0, height - 1.0]) / 2)
    if options.view == "keep":
        return base
    zoom = whole_zoom(base, views) if options.view == "whole" else inside_zoom(base, views)
    widest = widest_seen(views) if options.view == "whole" else widest_of(zoomed(base, zoom))
    if np.degrees(widest) > MOST_FLAT_DEG:
        raise CalibrationError(
            f"{name} sees {np.degrees(widest):.0f} degrees from corner to corner, and a flat image "
            f"should show {MOST_FLAT_DEG:g} at most: {FOV_REMEDY}"
        )
    if not zoom > 0:
        raise CalibrationError(
            f"{name}: no view around ({base.params[2]:.0f}, {base.params[3]:.0f}) px of the new "
            "image is without black pixels, for the optical axis is outside what was seen: "
            f"{FOV_REMEDY}, or --view keep"
        )
    return zoomed(base, zoom)

"""Kalibr's camchain.yaml: see `kalibr` for what it says."""

from __future__ import annotations

import re

import numpy as np
import yaml

from graphs.camera import Camera, image_pixels, project, unproject
from graphs.frames import Transform
from graphs.lenses import LensName
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import Export, Format, of_camera, of_sigmas

HEAD = (
    "# Pixel centres are at integers, as in OpenCV. T_cn_cnm1 takes points of the camera before\n"
    "# to this one, in metres.\n"
)
# Ours by Kalibr's camera_model and distortion_model, and how many intrinsics go before fu.
MODELS: dict[LensName, tuple[str, str]] = {
    "radtan": ("pinhole", "radtan"),
    "kannala_brandt": ("pinhole", "equidistant"),
    "eucm": ("eucm", "none"),
    "double_sphere": ("ds", "none"),
}
OVERLAP_GRID = (12, 9)  # pixels across and down
OVERLAP_RANGES = (10.0, 100.0)  # baselines: where two cameras that look one way see the same
LEAST_OVERLAP = 0.1  # of an image: less shows no board


def write_kalibr(rig: CameraRig) -> Export:
    """cam0, cam1, ... in the rig's order; what they are called goes into camera_name."""
    places, notes = of_camera(rig)
    chain: dict[str, dict[str, object]] = {}
    for index, camera in enumerate(rig.cameras):
        entry = _entry(camera)
        entry["cam_overlaps"] = [
            other
            for other in range(len(places))
            if other != index and _overlap(rig.cameras, places, index, other)
        ]
        if index:
            step = places[index] @ places[index - 1].inverse
            matrix = np.vstack([np.column_stack([step.rotation, step.translation]), [0, 0, 0, 1]])
            entry["T_cn_cnm1"] = matrix.tolist()
        chain[f"cam{index}"] = entry
    if tuple(chain) != rig.names:
        called = ", ".join(f"{key} is {name}" for key, name in zip(chain, rig.names, strict=True))
        notes += (f"Kalibr numbers its cameras: {called} (camera_name)",)
    notes += ("rostopic is made up from the cameras' names", *of_sigmas(rig))
    text = yaml.safe_dump(chain, sort_keys=False, allow_unicode=True, default_flow_style=None)
    return Export({"": (HEAD + text).encode()}, notes)


def _entry(camera: Camera) -> dict[str, object]:
    model, distortion = MODELS[camera.lens]
    pixels, k = camera.params[:4].tolist(), camera.params[4:].tolist()
    in_front = model != "pinhole"  # Kalibr's intrinsics begin with what is the lens's own
    return {
        "camera_name": camera.name,
        "camera_model": model,
        "intrinsics": [*k, *pixels] if in_front else pixels,
        "distortion_model": distortion,
        "distortion_coeffs": [] if in_front else k,
        "resolution": list(camera.size),
        "rostopic": f"/{re.sub(r'[^A-Za-z0-9_]', '_', camera.name)}/image_raw",
    }


def _overlap(
    cameras: tuple[Camera, ...], places: tuple[Transform, ...], one: int, other: int
) -> bool:
    """Whether either of two cameras sees a part of the other's view."""
    return max(_seen(cameras, places, *pair) for pair in ((one, other), (other, one))) > (
        LEAST_OVERLAP
    )


def _seen(cameras: tuple[Camera, ...], places: tuple[Transform, ...], a: int, b: int) -> float:
    """The share of a's image that b sees, at the range where that is largest."""
    rays = unproject(cameras[a], image_pixels(cameras[a].size, OVERLAP_GRID)[2])
    b_from_a = places[b] @ places[a].inverse
    baseline = float(np.linalg.norm(b_from_a.translation)) or 1.0
    shares = []
    for distance in OVERLAP_RANGES:
        pixels = project(cameras[b], b_from_a @ (distance * baseline * rays))
        inside = (pixels > -0.5) & (pixels < np.array(cameras[b].size) - 0.5)
        shares.append(float(inside.all(-1).mean()))
    return max(shares)


KALIBR_FORMAT = Format(
    "Kalibr camchain", tuple(MODELS), "any", "camchain.yaml", write_kalibr, metres=True
)

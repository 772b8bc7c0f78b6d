"""A rig as a COLMAP model without images, and as the rig_config.json of `colmap rig_configurator`.

The rig's frame is that of its reference camera, which COLMAP wants: rigs.txt and the file of names
say how the others sit. Pixels are counted from the corner of the first.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from graphs.camera import Camera
from graphs.frames import Transform
from graphs.lenses import LensName
from sfm_calib.colmap_lenses import EXACT_MODEL
from sfm_calib.formats import rig_config
from sfm_calib.formats.colmap_model import FORMAT, MODELS, PIXEL_OFFSET
from sfm_calib.formats.contents import places, unheld
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import Export, Format

PARAMETERS = {model: names.split() for model, names in MODELS.values()}
# Models of one focal length keep the name of the lens where there is one.
ONE_FOCAL: dict[LensName, str] = {"simple_radial": "SIMPLE_RADIAL", "radial": "RADIAL"}
EMPTY = {
    "frames.txt": "# no frames: a calibration\n",
    "images.txt": "# no images: a calibration\n",
    "points3D.txt": "# no points: a calibration\n",
}


def write_colmap(rig: CameraRig) -> Export:
    """cameras.txt, rigs.txt, rig_config.json, and files of images and points with none in them."""
    own = replace(rig, cam_from_rig=places(rig))
    rig, reference = own.referenced()
    placed = places(rig)
    models = [_model(camera) for camera in rig.cameras]
    files = {
        "cameras.txt": _cameras_text(rig.cameras, models),
        "rigs.txt": _rig_text(placed, reference),
        **EMPTY,
        rig_config.NAME: _config_text(rig.cameras, models, placed, reference),
    }
    notes = unheld(rig, "COLMAP")
    if rig is not own and len(placed) > 1:
        notes += (f"the rig's frame is that of {rig.names[0]} now: COLMAP wants a camera's",)
    return Export({name: text.encode() for name, text in files.items()}, notes)


def _model(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's name of the lens, and its parameters."""
    named = camera.named()
    square = named["fx"] == named["fy"]
    model = ONE_FOCAL.get(camera.lens, "") if square else ""
    model = model or EXACT_MODEL[camera.lens]
    named |= {"f": named["fx"], "cx": named["cx"] + PIXEL_OFFSET, "cy": named["cy"] + PIXEL_OFFSET}
    return model, [named.get(name, 0.0) for name in PARAMETERS[model]]


def _cameras_text(cameras: tuple[Camera, ...], models: list[tuple[str, list[float]]]) -> str:
    rows = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for number, (camera, (model, values)) in enumerate(zip(cameras, models, strict=True), start=1):
        rows.append(_row(number, model, *camera.size, *values))
    return "\n".join(rows) + "\n"


def _rig_text(placed: tuple[Transform, ...], reference: int) -> str:
    words: list[object] = [1, len(placed), "CAMERA", reference + 1]
    for index, place in enumerate(placed):
        if index != reference:
            words += ["CAMERA", index + 1, 1]
            words += [*place.rotation_wxyz.tolist(), *place.translation.tolist()]
    return (
        "# RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID SENSORS[] (TYPE ID HAS_POSE "
        f"QW QX QY QZ TX TY TZ)\n{_row(*words)}\n"
    )


def _row(*words: object) -> str:
    return " ".join(word if isinstance(word, str) else repr(word) for word in words)


def _config_text(
    cameras: tuple[Camera, ...],
    models: list[tuple[str, list[float]]],
    placed: tuple[Transform, ...],
    reference: int,
) -> str:
    entries = []
    for index, (camera, (model, values), place) in enumerate(
        zip(cameras, models, placed, strict=True)
    ):
        entry: dict[str, Any] = {"image_prefix": f"{camera.name}/"}
        if index == reference:
            entry["ref_sensor"] = True
        else:
            entry["cam_from_rig_rotation"] = place.rotation_wxyz.tolist()
            entry["cam_from_rig_translation"] = place.translation.tolist()
        entries.append(entry | {"camera_model_name": model, "camera_params": values})
    return json.dumps([{"cameras": entries}], indent=2, allow_nan=False) + "\n"


COLMAP = Format(FORMAT, tuple(EXACT_MODEL), "any", "", write_colmap)

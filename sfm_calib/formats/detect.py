"""Which format a file has, told from what is in it, and its reading."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sfm_calib.errors import CalibrationError
from sfm_calib.formats.caliscope import cameras_in, read_caliscope
from sfm_calib.formats.file_storage import EXTRINSICS, INTRINSICS, read_file_storage
from sfm_calib.formats.kalibr import read_kalibr
from sfm_calib.formats.mrcal import SUFFIX, looks_like_mrcal, read_mrcal, read_mrcal_files
from sfm_calib.formats.nerf import NAME as TRANSFORMS
from sfm_calib.formats.nerf import looks_like_nerf, read_nerf
from sfm_calib.formats.ours import read_ours
from sfm_calib.formats.projection_matrices import looks_like_matrices, read_matrices
from sfm_calib.formats.qualisys import read_qualisys
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.rig_config import NAME as RIG_CONFIG
from sfm_calib.formats.rig_config import (
    looks_like_rig_config,
    read_colmap_folder,
    read_rig_config,
)
from sfm_calib.formats.ros import read_ros, read_ros_pair
from sfm_calib.formats.trees import (
    MOST_BYTES,
    MOST_BYTES_OF_OTHERS,
    MOST_DOTS,
    MOST_TOML,
    check_length,
    json_tree,
    text_of,
    xml_root,
    yaml_tree,
)

KNOWN = (
    "sfm_calib's calibration.json, OpenCV FileStorage (YAML, XML, JSON), ROS camera_info, "
    "a COLMAP model's folder or rig_config.json, Kalibr's camchain, mrcal's .cameramodel, NeRF's "
    "transforms.json, Caliscope's camera_array.toml, Qualisys' .qca.txt, KITTI's calib.txt"
)
COLMAP_FILES = ("cameras.txt", "cameras.bin")
JSON_FILES = (RIG_CONFIG, TRANSFORMS)
YAML_SUFFIXES = (".yaml", ".yml")


def read_calibration(path: Path) -> CameraRig:
    """Read a calibration of any known format, from a file or a folder.

    Raises CalibrationError in one line: what is wrong, or which formats are known.
    """
    try:
        return _read(path).checked()
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # What a reader looked for is there, and is something else.
        said = " ".join(str(error).split())[:200]
        raise CalibrationError(f"{path} is no whole calibration: {said}") from error
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror}") from error


def _read(path: Path) -> CameraRig:
    if path.is_dir():
        return _folder(path)
    if path.name in COLMAP_FILES:
        return _colmap(path.parent)
    try:
        text = text_of(path, MOST_BYTES)
    except UnicodeDecodeError as error:
        raise CalibrationError(_unknown(path)) from error
    start = text.lstrip()
    long = start.startswith("{") or looks_like_mrcal(start)
    if not long and len(text) > MOST_BYTES_OF_OTHERS:
        raise CalibrationError(_unknown(path))
    return _text(path, text, start)


def _unknown(path: Path) -> str:
    return f"{path} is no calibration that can be read: known are {KNOWN}"


def _colmap(folder: Path) -> CameraRig:
    for name in (*COLMAP_FILES, "rigs.txt", "rigs.bin"):
        if (folder / name).exists():
            check_length(folder / name)
    return read_colmap_folder(folder)


def _folder(folder: Path) -> CameraRig:
    if any((folder / name).is_file() for name in COLMAP_FILES):
        return _colmap(folder)
    if (folder / "calibration.json").is_file():
        return read_ours(folder / "calibration.json")
    for name in JSON_FILES:
        if (folder / name).is_file():
            return read_calibration(folder / name)
    if models := sorted(p for p in folder.iterdir() if p.suffix == SUFFIX):
        return read_mrcal_files({path: text_of(path, MOST_BYTES) for path in models})
    found = sorted(p for p in folder.iterdir() if p.suffix in YAML_SUFFIXES)
    for path in found:
        if path.stem in (INTRINSICS, EXTRINSICS):
            return read_calibration(path)
    contents = [_yaml(path, text_of(path)) for path in found]
    if found and all(_is_ros(content) for content in contents):
        return read_ros_pair(tuple(found), tuple(c for c in contents if c is not None))
    raise CalibrationError(
        f"{folder} holds no calibration: a folder is read as a COLMAP model (cameras.txt or .bin), "
        "or for its calibration.json, intrinsics.yml or ROS camera_info files"
    )


def _text(path: Path, text: str, start: str) -> CameraRig:
    if start.startswith("<"):
        return _xml(path, start)
    if looks_like_mrcal(start):
        return read_mrcal(path, start)
    if start.startswith("{") or _is_json_list(start):
        return _json(path, start)
    if start.startswith("%YAML") or "!!opencv-matrix" in text:
        return read_file_storage(path, text)
    if looks_like_matrices(text):
        return read_matrices(path, text)
    if cameras_in(content := _toml(text)):
        return read_caliscope(path, content)
    return _of_yaml(path, _yaml(path, text))


def _toml(text: str) -> Mapping[str, Any]:
    """Empty where it is none."""
    if len(text) > MOST_TOML or max(line.count(".") for line in text.split("\n")) > MOST_DOTS:
        return {}
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError):
        return {}


def _is_json_list(start: str) -> bool:
    """A list of objects; TOML's tables start with [ too."""
    return start.startswith("[") and start[1:].lstrip().startswith("{")


def _xml(path: Path, text: str) -> CameraRig:
    root = xml_root(path, text)
    if root.tag == "opencv_storage":
        return read_file_storage(path, text)
    if root.find("cameras/camera/intrinsic") is not None:
        return read_qualisys(path, root)
    raise CalibrationError(_unknown(path))


def _json(path: Path, text: str) -> CameraRig:
    content = json_tree(path, text)
    if looks_like_rig_config(content):
        return read_rig_config(path, content)
    if not isinstance(content, Mapping):
        raise CalibrationError(_unknown(path))
    if looks_like_nerf(content):
        return read_nerf(path, content)
    if "cameras" in content or str(content.get("format", "")).startswith("sfm_calib"):
        return read_ours(path)
    return read_file_storage(path, text)


def _yaml(path: Path, text: str) -> Mapping[str, Any] | None:
    """None where it is no YAML mapping."""
    content = yaml_tree(path, text)
    return content if isinstance(content, Mapping) else None


def _is_ros(content: Mapping[str, Any] | None) -> bool:
    return content is not None and {"camera_matrix", "image_width", "image_height"} <= set(content)


def _of_yaml(path: Path, content: Mapping[str, Any] | None) -> CameraRig:
    if content is None:
        raise CalibrationError(_unknown(path))
    if _is_ros(content):
        return read_ros(path, content)
    if any(isinstance(e, Mapping) and "camera_model" in e for e in content.values()):
        return read_kalibr(path, content)
    raise CalibrationError(_unknown(path))

"""URDF, and a launch file of ROS 2's static transforms: how the cameras sit, and no lenses.

A joint's origin is rig_from_camera in metres: child in parent, rpy turns about the fixed x, then y,
then z axis (wiki.ros.org/urdf/XML/joint). Frames are optical: x right, y down, z forward (REP 103).
"""

from __future__ import annotations

import re
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from graphs.frames import FloatArray, Transform
from graphs.lenses import LENS_NAMES
from sfm_calib.formats.contents import UNITS, places
from sfm_calib.formats.reading import CameraRig
from sfm_calib.formats.writing import Export, Format, of_sigmas

FORMAT = "URDF and static transforms"
RIG = "camera_rig"
URDF_FILE, LAUNCH_FILE = "rig.urdf", "static_transforms.launch.xml"


def write_urdf(rig: CameraRig) -> Export:
    """rig.urdf, a link a camera; and a launch file that publishes the same transforms."""
    frames = _frames(rig.names)
    placed = [place.inverse for place in places(rig)]
    robot, launch = Element("robot", name=RIG), Element("launch")
    SubElement(robot, "link", name=RIG)
    for frame, rig_from_camera in zip(frames, placed, strict=True):
        SubElement(robot, "link", name=frame)
        robot.append(_joint(frame, rig_from_camera))
        SubElement(
            launch, "node", pkg="tf2_ros", exec="static_transform_publisher",
            name=f"{frame}_publisher", args=_arguments(frame, rig_from_camera),
        )  # fmt: skip
    files = {URDF_FILE: _text(robot), LAUNCH_FILE: _text(launch)}
    return Export(files, (*_renamed(rig.names, frames), *_left_out(rig)))


def _frames(names: tuple[str, ...]) -> list[str]:
    """Names of ROS frames: ASCII letters, digits and underscores, no two the same."""
    frames: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name) or "camera"
        plain = plain if plain[0].isalpha() else f"camera_{plain}"
        taken, count = plain, 1
        while f"{taken}_optical_frame" in frames:
            count += 1
            taken = f"{plain}_{count}"
        frames.append(f"{taken}_optical_frame")
    return frames


def _renamed(names: tuple[str, ...], frames: list[str]) -> list[str]:
    return [
        f"{name!r} is {frame}: ROS takes letters, digits and underscores"
        for name, frame in zip(names, frames, strict=True)
        if frame != f"{name}_optical_frame"
    ]


def _left_out(rig: CameraRig) -> list[str]:
    notes = [f"{FORMAT} hold no lenses and image sizes: they are left out", *of_sigmas(rig)]
    if rig.unit != "m" and len(rig.cameras) > 1:
        notes.append(f"ROS takes lengths as metres, but those of {rig.path} are {UNITS[rig.unit]}")
    return notes


def _joint(frame: str, rig_from_camera: Transform) -> Element:
    joint = Element("joint", name=f"{frame}_joint", type="fixed")
    SubElement(
        joint, "origin", xyz=_words(rig_from_camera.translation),
        rpy=_words(roll_pitch_yaw(rig_from_camera.rotation)),
    )  # fmt: skip
    SubElement(joint, "parent", link=RIG)
    SubElement(joint, "child", link=frame)
    return joint


def roll_pitch_yaw(rotation: FloatArray) -> FloatArray:
    """Angles (3,) in radians about the fixed x, y, z axes: rotation = Rz(yaw) Ry(pitch) Rx(roll).

    Roll and pitch are what is left once yaw is undone: whole at a pitch of 90 degrees too, where
    yaw and roll cannot be told apart.
    """
    R = rotation
    yaw = np.arctan2(R[1, 0], R[0, 0])
    s, c = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def _arguments(frame: str, rig_from_camera: Transform) -> str:
    w, *xyz = rig_from_camera.rotation_wxyz.tolist()
    numbers = dict(zip("xyz", rig_from_camera.translation.tolist(), strict=True))
    numbers |= dict(zip(("qx", "qy", "qz", "qw"), (*xyz, w), strict=True))
    words = " ".join(f"--{key} {value!r}" for key, value in numbers.items())
    return f"{words} --frame-id {RIG} --child-frame-id {frame}"


def _words(values: FloatArray) -> str:
    return " ".join(repr(value) for value in values.tolist())


def _text(root: Element) -> bytes:
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


URDF = Format(FORMAT, LENS_NAMES, "any", "", write_urdf, metres=True)

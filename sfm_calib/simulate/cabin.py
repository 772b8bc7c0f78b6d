"""A scanning cabin: three depth cameras about a head, each an infrared and a colour camera.

After a published study of three Kinects v2. The rig's frame is the front device's infrared camera:
x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform, exp_rotation
from sfm_calib.simulate.rigs import SimulatedRig

DEVICES = ("front", "right", "left")
INFRARED, COLOUR = (512, 424), (1920, 1080)
N_CAMERAS = 2 * len(DEVICES)
# Where the side devices are, in the front one's frame, and where they look: by the study they are
# turned by about 80 to 90 degrees, and the head is 0.5 to 0.9 m away from all three.
PLACES_M = ((0.0, 0.0, 0.0), (0.56, -0.07, 0.55), (-0.74, -0.09, 0.62))
HEAD_M = (0.0, -0.02, 0.66)

# True lenses, and how much one device differs from the next (sigma). fx, cx of the colour cameras
# and fx, k1, k2, k3 of the infrared ones are the study's; the rest as devices have it: the files of
# iai_kinect2 and libfreenect2 have infrared centres of 253 to 260, 202 to 211.
TRUE_INFRARED = {
    "fx": (365.0, 1.5), "cx": (256.5, 3.0), "cy": (207.0, 3.0),
    "k1": (0.11, 0.01), "k2": (-0.33, 0.02), "k3": (0.15, 0.02),
}  # fmt: skip
TRUE_COLOUR = {
    "fx": (1060.0, 3.0), "cx": (926.0, 6.0), "cy": (536.0, 6.0),
    "k1": (0.04, 0.01), "k2": (-0.04, 0.01), "k3": (0.0, 0.005),
}  # fmt: skip
ASPECT_SIGMA, TANGENTIAL_SIGMA = 3e-4, 3e-4
# What is taken for a Kinect v2 where nobody has calibrated: the colour numbers are the study's
# factory values, the infrared ones a device's that programs copy (OpenKinect-for-Processing's
# CameraParams), without the distortion.
FACTORY_INFRARED = {"fx": 365.456, "fy": 365.456, "cx": 254.878, "cy": 205.395}
FACTORY_COLOUR = {"fx": 1081.37, "fy": 1081.37, "cx": 959.5, "cy": 539.5}
# iai_kinect2's default: the colour camera sits 52 mm beside the infrared one.
COLOUR_FROM_INFRARED = Transform(np.eye(3), np.array([-0.052, 0.0, 0.0]))
MOUNTING_DEG, MOUNTING_M = 0.3, 0.001  # sigma of each axis, of one sensor beside the other


@dataclass(frozen=True)
class Cabin:
    """One cabin as it is, and as its user knows it before calibrating.

    Cameras: infrared and colour of the front, right and left device, in this order.
    """

    true: SimulatedRig
    nominal: SimulatedRig  # factory lenses, places by hand

    @property
    def infrared(self) -> tuple[int, ...]:
        return tuple(range(0, N_CAMERAS, 2))

    @property
    def colour(self) -> tuple[int, ...]:
        return tuple(range(1, N_CAMERAS, 2))


def draw_cabin(rng: np.random.Generator, nominal_deg: float, nominal_m: float) -> Cabin:
    """A cabin whose devices differ as devices do.

    nominal_deg, nominal_m: rms of how far the side devices are off their places by hand.
    """
    true = [_device_from_rig(np.array(place)) for place in PLACES_M]
    by_hand = [
        placed if index == 0 else _moved(rng, nominal_deg / 3**0.5, nominal_m / 3**0.5) @ placed
        for index, placed in enumerate(true)
    ]
    mounted = [_moved(rng, MOUNTING_DEG, MOUNTING_M) @ COLOUR_FROM_INFRARED for _ in DEVICES]
    lenses, factory = [], []
    for name in DEVICES:
        lenses += [
            _true_camera(f"{name}_infrared", INFRARED, TRUE_INFRARED, rng),
            _true_camera(f"{name}_colour", COLOUR, TRUE_COLOUR, rng),
        ]
        factory += [
            _camera(f"{name}_infrared", INFRARED, FACTORY_INFRARED),
            _camera(f"{name}_colour", COLOUR, FACTORY_COLOUR),
        ]
    return Cabin(
        SimulatedRig(tuple(lenses), _both(true, mounted)),
        SimulatedRig(tuple(factory), _both(by_hand, [COLOUR_FROM_INFRARED] * len(DEVICES))),
    )


def head_place(rng: np.random.Generator) -> Transform:
    """rig_from_head of someone who sits about where the cameras look, and looks to the front."""
    return Transform(np.eye(3), np.array(HEAD_M)) @ _moved(rng, 5.0, 0.01)


def resized(camera: Camera, factor: float) -> Camera:
    """The same camera with images `factor` times as large; pixel centres are integers."""
    width, height = (round(n * factor) for n in camera.size)
    params = camera.params.copy()
    params[:2] *= factor
    params[2:4] = (params[2:4] + 0.5) * factor - 0.5
    return replace(camera, size=(width, height), params=params)


def _device_from_rig(place: FloatArray) -> Transform:
    """Of a device at a place in the rig's frame, level, that looks at the head."""
    ahead = np.array(HEAD_M) - place
    if not place.any():  # the rig's own frame
        return Transform.identity()
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return Transform(rotation, -rotation @ place)


def _both(devices: list[Transform], mounted: list[Transform]) -> tuple[Transform, ...]:
    """cam_from_rig of all cameras, from device_from_rig and colour_from_infrared."""
    return tuple(
        placed
        for device, colour in zip(devices, mounted, strict=True)
        for placed in (device, colour @ device)
    )


def _moved(rng: np.random.Generator, sigma_deg: float, sigma_m: float) -> Transform:
    """A small motion at random; sigmas of each axis."""
    turn = exp_rotation(np.radians(sigma_deg) * rng.standard_normal(3))
    return Transform(turn, sigma_m * rng.standard_normal(3))


def _true_camera(
    name: str,
    size: tuple[int, int],
    about: dict[str, tuple[float, float]],
    rng: np.random.Generator,
) -> Camera:
    drawn = {key: mean + sigma * rng.standard_normal() for key, (mean, sigma) in about.items()}
    drawn["fy"] = drawn["fx"] * (1 + ASPECT_SIGMA * rng.standard_normal())
    drawn["p1"], drawn["p2"] = TANGENTIAL_SIGMA * rng.standard_normal(2)
    return _camera(name, size, drawn)


def _camera(name: str, size: tuple[int, int], values: dict[str, float]) -> Camera:
    order = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    return Camera(name, "brown", size, np.array([values.get(key, 0.0) for key in order]))

"""What rig.yaml knows of the rig, in the words of the maths: starts, priors, scale."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphs.frames import Transform
from graphs.lenses import PARAMETER_NAMES, Camera, LensName, nominal_params
from graphs.priors import LensPrior, RigPrior, stated_lens_prior, weak_lens_prior
from graphs.problem import Estimate, KnownBaseline, Problem
from sfm_calib.config import CameraConfig, RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan


def camera_config(config: RigConfig, name: str) -> CameraConfig:
    """What is said of a camera; nothing, where rig.yaml does not name it."""
    return config.cameras.get(name, CameraConfig())


# Webcam boards show p2 = 0.003; without p1, p2 the corridor rig's focal lengths come out 3.4 %
# short instead of 2 %, the street rig's 3.6 % instead of 0.3 %. A lone camera cannot tell p1, p2
# from its principal point: on the fountain they move it by 4 px for nothing.
RIG_LENS: LensName = "radtan"
LONE_LENS: LensName = "radial"


def lens_of(config: RigConfig, name: str, n_cameras: int) -> LensName:
    """The camera's own lens, or the one of all, or what its rig can determine."""
    said = camera_config(config, name).lens
    if said is not None:
        return said
    if config.lens != "auto":
        return config.lens
    return RIG_LENS if n_cameras > 1 else LONE_LENS


def check_config(config: RigConfig, scan: Scan) -> None:
    """Raises CalibrationError where rig.yaml names a camera or a parameter that does not exist."""
    named = [("cameras", name) for name in config.cameras]
    named += [("reference", config.reference)] if config.reference else []
    baseline = config.scale.baseline
    named += [("scale.baseline.cameras", name) for name in baseline.cameras] if baseline else []
    for key, name in named:
        if name not in scan.cameras:
            raise CalibrationError(
                f"{key}: the scan has no camera {name!r}; {_nearest(name, scan.cameras)}"
            )
    for name, entry in config.cameras.items():
        lens = lens_of(config, name, len(scan.cameras))
        valid = PARAMETER_NAMES[lens]
        for parameter in [*entry.params, *entry.sigma, *entry.fixed]:
            if parameter not in valid:
                raise CalibrationError(
                    f"rig.yaml gives camera {name} a parameter {parameter!r} that its lens "
                    f"{lens} does not have; {_nearest(parameter, valid)}"
                )
        for parameter in entry.sigma:
            if parameter not in entry.params:
                raise CalibrationError(
                    f"rig.yaml gives camera {name} a sigma of {parameter} without its value: "
                    f"add cameras.{name}.params.{parameter}"
                )
        for parameter in {"fx", "fy"} & set(entry.fixed) - set(entry.params):
            raise CalibrationError(
                f"rig.yaml holds {parameter} of camera {name} without its value: add "
                f"cameras.{name}.params.{parameter}"
            )
    if baseline and baseline.cameras[0] == baseline.cameras[1]:
        raise CalibrationError(
            f"rig.yaml measures a baseline from {baseline.cameras[0]} to itself; name two cameras"
        )


def _nearest(name: str, valid: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(name, valid, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"{hint}it has {', '.join(valid)}"


def known_cameras(config: RigConfig, scan: Scan) -> dict[int, Camera]:
    """Cameras whose focal length rig.yaml gives, by index: mapping starts from them."""
    known = {}
    for index, name in enumerate(scan.cameras):
        given = camera_config(config, name).params
        focals = [given[p] for p in ("fx", "fy") if p in given]
        if not focals:
            continue
        lens, size = lens_of(config, name, len(scan.cameras)), scan.sizes[index]
        camera = Camera(name, lens, size, nominal_params(lens, size, float(np.mean(focals))))
        known[index] = with_params(camera, given)
    return known


def with_params(camera: Camera, given: dict[str, float]) -> Camera:
    """The camera with some of its parameters replaced."""
    params = [given.get(name, value) for name, value in camera.named().items()]
    return replace(camera, params=np.array(params))


def lens_priors(start: Estimate, config: RigConfig) -> tuple[LensPrior, ...]:
    """The weak prior of each lens, with what rig.yaml states in its place."""
    priors = []
    for camera in start.cameras:
        said = camera_config(config, camera.name)
        weak = weak_lens_prior(camera, config.principal_point_sigma, config.aspect_sigma)
        priors.append(stated_lens_prior(camera, weak, said.params, said.sigma, said.fixed))
    return tuple(priors)


def nominal_transforms(
    config: RigConfig, names: Sequence[str], reference: int
) -> list[Transform | None]:
    """cam_from_rig as rig.yaml gives it, the reference's frame as the rig's; None where it does
    not say."""
    given = [
        Transform.from_wxyz(said.rotation_wxyz, said.translation) if said is not None else None
        for said in (camera_config(config, name).cam_from_rig for name in names)
    ]
    at_reference = given[reference] or Transform.identity()
    given[reference] = at_reference
    return [None if one is None else one @ at_reference.inverse for one in given]


def nominal_rig(
    config: RigConfig, names: Sequence[str], reference: int
) -> tuple[Transform, ...] | None:
    """The nominal cam_from_rig of every camera; None unless all but the reference are given."""
    given = [one for one in nominal_transforms(config, names, reference) if one is not None]
    return tuple(given) if len(given) == len(names) else None


def rig_priors(start: Estimate, config: RigConfig, reference: int) -> dict[int, RigPrior]:
    """Priors on cam_from_rig, where rig.yaml gives one with a sigma.

    Without a metric scale only the rotation can be believed.
    """
    names = [camera.name for camera in start.cameras]
    metric = config.scale.baseline is not None
    priors = {}
    for index, transform in enumerate(nominal_transforms(config, names, reference)):
        said = camera_config(config, names[index]).cam_from_rig
        if said is None or transform is None or index == reference:
            continue
        turn, move = said.sigma_rotation_deg, said.sigma_translation if metric else None
        if turn is not None or move is not None:
            priors[index] = RigPrior(
                transform, np.radians(turn) if turn else np.inf, move or np.inf
            )
    return priors


def start_from_config(problem: Problem, config: RigConfig) -> Problem:
    """The problem with held parameters at their values, in the unit of its scale source.

    Raises CalibrationError when the measured baseline is between cameras at one place.
    """
    start = problem.initial
    cameras = tuple(
        replace(camera, params=prior.held(camera.params))
        for camera, prior in zip(start.cameras, lens_priors(start, config), strict=True)
    )
    problem = replace(problem, initial=replace(start, cameras=cameras))
    measured = config.scale.baseline
    if measured is None:
        return problem
    names = [camera.name for camera in cameras]
    pair = (names.index(measured.cameras[0]), names.index(measured.cameras[1]))
    centres = [start.cam_from_rig[index].inverse.translation for index in pair]
    length = float(np.linalg.norm(centres[1] - centres[0]))
    if length <= 0:
        raise CalibrationError(
            f"the scan puts {measured.cameras[0]} and {measured.cameras[1]} at one place, and "
            f"rig.yaml {measured.length_m:g} m apart: give the distance of another pair"
        )
    return replace(
        problem,
        initial=problem.initial.scaled(measured.length_m / length),
        scale=KnownBaseline(pair, measured.length_m, measured.sigma_m),
    )

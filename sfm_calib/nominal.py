"""What rig.yaml knows of the rig, in the words of the maths: starts and priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphs.camera import Camera, nominal_params
from graphs.frames import Transform
from graphs.joint_prior import with_prior
from graphs.lenses import FOCAL_AND_CENTRE, PARAMETER_NAMES, LensName
from graphs.priors import LensPrior, RigPrior, stated_lens_prior, weak_lens_prior
from graphs.problem import Estimate, PriorRig, Problem
from sfm_calib.config import CameraConfig, RigConfig
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.images import Scan
from sfm_calib.learned.choice import check_choice
from sfm_calib.scale import check_scale, with_scale


def camera_config(config: RigConfig, name: str) -> CameraConfig:
    """What is said of a camera; nothing, where rig.yaml does not name it."""
    return config.cameras.get(name, CameraConfig())


# Where mapping starts when nothing is said, before the ladder of `graphs.ladder` chooses. Without
# p1, p2 the focal lengths of the corridor rig come out 3.4 % short instead of 2 %, the street rig's
# 3.6 % instead of 0.3 %; on the fountain's lone camera they move the principal point for nothing.
RIG_LENS: LensName = "radtan"
LONE_LENS: LensName = "radial"


def lens_said(config: RigConfig, name: str) -> LensName | None:
    """The camera's own lens, or the one of all; None: it is to be found."""
    said = camera_config(config, name).lens
    return said if said is not None or config.lens == "auto" else config.lens


def lens_of(config: RigConfig, name: str, n_cameras: int) -> LensName:
    """As `lens_said`, or the one that mapping starts with."""
    return lens_said(config, name) or (RIG_LENS if n_cameras > 1 else LONE_LENS)


def on_ladder(config: RigConfig, names: Sequence[str]) -> tuple[int, ...]:
    """Indices of the cameras whose lens is to be found.

    One of whose distortion rig.yaml says something, or a camera that shares its lens with it, keeps
    the lens that has those parameters.
    """
    if config.lens != "auto":
        return ()
    given = {
        name
        for name in names
        if (said := camera_config(config, name)).lens is not None
        or not {*said.params, *said.sigma, *said.fixed} <= set(FOCAL_AND_CENTRE)
    }
    for group in config.shared_lenses:
        if given & set(group):
            given |= set(group)
    return tuple(index for index, name in enumerate(names) if name not in given)


def check_config(config: RigConfig, scan: Scan) -> None:
    """Raises CalibrationError where rig.yaml names what the scan or a lens does not have."""
    named = [("cameras", name) for name in config.cameras]
    named += [("reference", config.reference)] if config.reference else []
    for key, name in named:
        if name not in scan.cameras:
            raise CalibrationError(
                f"{key}: the scan has no camera {name!r}; {nearest(name, scan.cameras)}"
            )
    for name, entry in config.cameras.items():
        lens = lens_of(config, name, len(scan.cameras))
        valid = PARAMETER_NAMES[lens]
        for parameter in [*entry.params, *entry.sigma, *entry.fixed]:
            if parameter not in valid:
                unsaid = entry.lens is None and config.lens == "auto"
                advice = "say which lens it has (lens: brown, ...)" if unsaid else ""
                raise CalibrationError(
                    f"rig.yaml gives camera {name} a parameter {parameter!r} that its lens "
                    f"{lens} does not have; {advice or nearest(parameter, valid)}"
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
    check_choice(config)
    _check_shared_lenses(config, scan)
    check_scale(config.scale, scan)


def _check_shared_lenses(config: RigConfig, scan: Scan) -> None:
    """Who shares a lens must have the same model and image size, and share it once."""
    grouped: list[str] = []
    for group in config.shared_lenses:
        if len(group) < 2:
            raise CalibrationError(
                f"shared_lenses: a group of {len(group)} ({', '.join(group)}) shares nothing; name "
                "two cameras or more, as [[left, right]]"
            )
        for name in group:
            if name not in scan.cameras:
                raise CalibrationError(
                    f"shared_lenses: the scan has no camera {name!r}; {nearest(name, scan.cameras)}"
                )
            if name in grouped:
                raise CalibrationError(f"shared_lenses names {name} twice; put it into one group")
            grouped.append(name)
        kinds = {
            name: (lens_of(config, name, len(scan.cameras)), scan.sizes[scan.cameras.index(name)])
            for name in group
        }
        for name, (lens, size) in kinds.items():
            if (lens, size) != kinds[group[0]]:
                first = kinds[group[0]]
                raise CalibrationError(
                    f"shared_lenses: {group[0]} ({first[0]}, {first[1][0]} x {first[1][1]} px) and "
                    f"{name} ({lens}, {size[0]} x {size[1]} px) cannot share one lens; take {name} "
                    "out of the group"
                )
        for name in group[1:]:
            if _states_lens(camera_config(config, name)):
                raise CalibrationError(
                    f"shared_lenses: what is known of the lens of {name} belongs to {group[0]}, "
                    "the first of its group: move params, sigma and fixed there"
                )


def _states_lens(entry: CameraConfig) -> bool:
    return bool(entry.params or entry.sigma or entry.fixed)


def shared_lenses(problem: Problem, config: RigConfig) -> tuple[tuple[int, ...], ...]:
    """The groups of cameras with one lens, by index; cameras that the mapping lost are left out."""
    names = [camera.name for camera in problem.initial.cameras]
    groups = (
        tuple(names.index(name) for name in group if name in names)
        for group in config.shared_lenses
    )
    return tuple(group for group in groups if len(group) > 1)


def known_cameras(config: RigConfig, scan: Scan) -> dict[int, Camera]:
    """Cameras whose focal length rig.yaml gives, by index: mapping starts from them."""
    known = {}
    for index, name in enumerate(scan.cameras):
        given = camera_config(config, name).params
        focals = [given[p] for p in ("fx", "fy") if p in given]
        if not focals:
            continue
        lens, size = lens_of(config, name, len(scan.cameras)), scan.sizes[index]
        camera = Camera(name, lens, size, nominal_params(lens, size, 1.0))
        both = dict.fromkeys(("fx", "fy"), float(np.mean(focals)))
        known[index] = with_params(camera, both | given)
    return known


def with_params(camera: Camera, given: dict[str, float]) -> Camera:
    """The camera with some of its parameters replaced."""
    params = [given.get(name, value) for name, value in camera.named().items()]
    return replace(camera, params=np.array(params))


def lens_priors(
    start: Estimate, config: RigConfig, with_board: bool = False, earlier: PriorRig | None = None
) -> tuple[LensPrior, ...]:
    """The weak prior of each lens, with what an earlier calibration and rig.yaml state in its
    place."""
    priors = []
    for camera in start.cameras:
        said = camera_config(config, camera.name)
        weak = weak_lens_prior(
            camera, config.principal_point_sigma, config.aspect_sigma, with_board
        )
        weak = with_prior(camera, weak, earlier)
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


def rig_priors(
    start: Estimate, config: RigConfig, reference: int, metric: bool
) -> dict[int, RigPrior]:
    """Priors on cam_from_rig, where rig.yaml gives one with a sigma.

    Without a metric scale only the rotation can be believed.
    """
    names = [camera.name for camera in start.cameras]
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
    """The problem with held parameters at their values, in the unit of its scale sources.

    Raises CalibrationError as `with_scale`.
    """
    start = problem.initial
    cameras = tuple(
        replace(camera, params=prior.held(camera.params))
        for camera, prior in zip(start.cameras, lens_priors(start, config), strict=True)
    )
    problem = replace(problem, initial=replace(start, cameras=cameras))
    return with_scale(problem, config.scale, config.min_parallax_deg)

"""An earlier calibration as the prior of a scan: what of it is believed, and what is freed.

    problem = start_from_config(mapped.problem, config)
    rig = prior_of(old, mode, free, [camera.name for camera in problem.initial.cameras], reference)
    problem = started(problem, rig)     # everything downstream finds it in the problem

`options_of` asks the problem for what it then believes of lenses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from graphs.camera import Camera
from graphs.prior_rig import prior_rig
from graphs.problem import Estimate, PriorMode, PriorRig, Problem
from graphs.propagation import lens_names, pose_names
from sfm_calib.config import CameraConfig, RigConfig
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.formats.reading import NO_SIZE, CameraRig

ALL = "all"
# What a word frees of a camera's lens, by the names of its parameters; of its place, by theirs.
OF_LENS = ("intrinsics", "focal", "principal_point", "distortion")
OF_PLACE = ("extrinsics", "rotation", "translation")


def freed(words: Sequence[str], cameras: Sequence[Camera], reference: str) -> frozenset[str]:
    """The parameters, named as in a covariance, that words free: `all`, a kind of parameter of all
    cameras (`rotation`, `focal`, `k1`), a camera, or a kind of one (`cam1.rotation`).

    Raises CalibrationError for a word that is none of these, and for the reference camera's place,
    which is the rig's frame.
    """
    every: dict[str, frozenset[str]] = {ALL: frozenset()}
    for camera in cameras:
        own = _kinds(camera, camera.name != reference)
        for kind, names in own.items():
            every[kind] = every.get(kind, frozenset()) | names
            every[f"{camera.name}.{kind}"] = names
        every[camera.name] = frozenset().union(*own.values())
        every[ALL] |= every[camera.name]
    found: frozenset[str] = frozenset()
    for word in words:
        owner, _, kind = word.rpartition(".")
        alone = word == reference and len(cameras) > 1
        if alone or (owner == reference and kind in OF_PLACE):
            raise CalibrationError(
                f"--free {word}: the rig's frame is that of {reference}, which cannot move in it: "
                f"free its lens ({reference}.intrinsics), or name another camera as the --reference"
            )
        if word not in every:
            raise CalibrationError(f"--free {word}: nothing is called so; {_like(word, every)}")
        found |= every[word]
    return found


def _kinds(camera: Camera, placed: bool) -> dict[str, frozenset[str]]:
    """The parameters of a camera that each kind frees; single ones by their own names."""
    names, place = lens_names(camera), pose_names(camera.name)
    of_lens = dict(zip(OF_LENS, (names, names[:2], names[2:4], names[4:]), strict=True))
    of_place = dict(zip(OF_PLACE, (place, place[:3], place[3:]), strict=True)) if placed else {}
    single = {name.rpartition(".")[2]: (name,) for name in names}
    return {kind: frozenset(own) for kind, own in {**of_lens, **of_place, **single}.items()}


def _like(word: str, every: Mapping[str, object]) -> str:
    """The valid words most like a wrong one: those of its camera, where it names one."""
    camera = word.rpartition(".")[0]
    if camera in every:
        own = [name.rpartition(".")[2] for name in every if name.startswith(f"{camera}.")]
        return f"of {camera}: {nearest(word.rpartition('.')[2], own)}"
    return nearest(word, [name for name in every if "." not in name])


def checked(old: CameraRig, sizes: Mapping[str, tuple[int, int]]) -> CameraRig:
    """The calibration with the image sizes of the scan where it states none.

    sizes: of the scan's cameras, by name. Raises CalibrationError where a size differs, where no
    camera is in both, and where the file does not say how its cameras sit.
    """
    if not set(old.names) & set(sizes):
        raise CalibrationError(
            f"{old.path} has the cameras {', '.join(old.names)}, the scan {', '.join(sizes)}: none "
            f"is in both; say which are the same: --cameras {old.names[0]}={next(iter(sizes))}"
        )
    if old.cam_from_rig is None and len(old.cameras) > 1:
        raise CalibrationError(
            f"{old.path} does not say how its {len(old.cameras)} cameras sit: give a file that "
            "holds the rig too"
        )
    cameras = []
    for camera in old.cameras:
        size = sizes.get(camera.name, camera.size)
        if camera.size not in (NO_SIZE, size):
            raise CalibrationError(
                f"{camera.name} has images of {size[0]} x {size[1]} px, and {old.path} is of "
                f"{camera.size[0]} x {camera.size[1]} px: take them as they were, or calibrate anew"
            )
        cameras.append(replace(camera, size=size))
    return replace(old, cameras=tuple(cameras))


def with_lenses(config: RigConfig, old: CameraRig, cameras: Sequence[str]) -> RigConfig:
    """The configuration with the lens of each of `cameras` that the calibration knows.

    What is `fixed` without a value is held at the calibration's.

    Raises CalibrationError where rig.yaml, or --lens, says that it has another.
    """
    entries = dict(config.cameras)
    for camera in old.cameras:
        if camera.name not in cameras:
            continue
        entry = entries.get(camera.name)
        said = None if entry is None else entry.lens
        if said not in (None, camera.lens):
            raise CalibrationError(
                f"rig.yaml gives {camera.name} the lens {said}, and {old.path} has {camera.lens}: "
                "take it out of rig.yaml"
            )
        if said is None and config.lens not in ("auto", camera.lens):
            raise CalibrationError(
                f"--lens {config.lens}: {old.path} has {camera.name} in the lens {camera.lens}, "
                "and is held against the same alone: leave it out, or calibrate anew"
            )
        entry = CameraConfig() if entry is None else entry
        held = {p: v for p, v in camera.named().items() if p in entry.fixed}
        known = {"lens": camera.lens, "params": held | entry.params}
        entries[camera.name] = entry.model_copy(update=known)
    return config.model_copy(update={"cameras": entries})


def prior_of(
    old: CameraRig,
    mode: PriorMode,
    free: Sequence[str],
    cameras: Sequence[str],
    reference: str,
) -> PriorRig:
    """What a scan of these cameras has of an earlier calibration, in its reference's frame.

    Cameras that the scan lacks are left out; those that the calibration lacks are all free.
    free: words as `freed` takes them. Raises CalibrationError where the reference is not in it,
    where mode full has no covariance to go by, and as `freed`.
    """
    if reference not in old.names:
        raise CalibrationError(
            f"{old.path} does not have the reference camera {reference}; give --reference: "
            f"{nearest(reference, [name for name in old.names if name in cameras])}"
        )
    if mode == "full" and not old.states_sigmas:
        raise CalibrationError(
            f"{old.path} states no sigmas, so how far to believe it is not known: give --prior "
            "weak or start"
        )
    shared = [camera for camera in old.cameras if camera.name in cameras]
    loose = freed(free, shared, reference)
    every = freed([ALL], shared, reference)
    return prior_rig(old.stated, cameras, reference, old.unit == "m", mode, every - loose)


def started(problem: Problem, prior: PriorRig) -> Problem:
    """The problem with its earlier calibration, started from its lenses and held places.

    In metres where the calibration gives them and nothing else did.
    """
    was_metric = problem.metric
    start = problem.initial
    names = [camera.name for camera in start.cameras]
    indices = [names.index(camera.name) for camera in prior.cameras]
    cameras = list(start.cameras)
    for i, camera in zip(indices, prior.cameras, strict=True):
        cameras[i] = camera
    start = replace(start, cameras=tuple(cameras))
    size = _size(prior, start, indices)
    if prior.gives_scale and not was_metric:
        start, size = start.scaled(1 / size), 1.0
    places = list(start.cam_from_rig)
    for i, camera, known in zip(indices, prior.cameras, prior.cam_from_rig, strict=True):
        if prior.held & set(pose_names(camera.name)):
            places[i] = known.scaled(size)
    return replace(problem, initial=replace(start, cam_from_rig=tuple(places)), prior=prior)


def _size(prior: PriorRig, start: Estimate, indices: Sequence[int]) -> float:
    """How long the prior's unit of length is in the start's: by the median baseline."""
    ratios = [
        float(np.linalg.norm(start.cam_from_rig[i].translation) / np.linalg.norm(known.translation))
        for i, known in zip(indices, prior.cam_from_rig, strict=True)
        if known.translation.any() and start.cam_from_rig[i].translation.any()
    ]
    return float(np.median(ratios)) if ratios else 1.0

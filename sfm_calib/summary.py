"""What is said of an optimum: the numbers with their sigmas, and whether to use them."""

from __future__ import annotations

import platform
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version

import numpy as np

import sfm_calib
from graphs.budget import Budget
from graphs.build import root_information
from graphs.covariance import CalibrationCovariance, Covariance
from graphs.frames import Transform
from graphs.problem import KnownSpan, residuals_px
from graphs.refine import Refinement
from graphs.scale import total_sigma_m
from graphs.unit import baseline_unit, in_unit_baseline
from sfm_calib import nominal, result
from sfm_calib.config import RigConfig
from sfm_calib.images import Scan
from sfm_calib.mapping import Mapped
from sfm_calib.scale import in_words

PRIOR_DECIDES = 0.5  # of the prior's variance left: the data have said less than the belief
FEW_FRAMES = 10  # fewer, and the scatter between frames is itself a guess
# A focal length of 2 % makes depth 2 % wrong; the worst real scan measured states 0.5 %.
USABLE_FOCAL_SIGMA = 0.02
CONTRADICTION = 4.0  # stated sigmas between a parameter and what rig.yaml says of it
REMEDIES = {  # by the first letter of the parameter
    "f": "bring near and far things into view, and move the camera sideways",
    "c": "turn the camera about its optical axis between views",
    "k": "let things of the scene pass through the corners of the image",
    "p": "turn the camera about its optical axis, and fill the corners of the image",
}
LIBRARIES = ("gtsam", "pycolmap", "opencv-contrib-python-headless", "numpy", "scipy", "numba")


@dataclass(frozen=True)
class Run:
    """Everything a finished calibration knows of itself."""

    scan: Scan
    config: RigConfig
    mapped: Mapped
    refinement: Refinement
    covariance: CalibrationCovariance
    seconds: dict[str, float]
    command: str


def summarise(run: Run) -> tuple[result.Calibration, float]:
    """The result file of a run, and its lengths over the optimum's.

    Non-metric rigs are put into units of their longest baseline.
    """
    estimate, problem = run.refinement.estimate, run.refinement.problem
    covariance, cam_from_rig, unit = run.covariance.stated, estimate.cam_from_rig, 1.0
    far = None if problem.scale else baseline_unit(estimate, problem.reference, covariance)
    if far is not None:
        covariance = in_unit_baseline(covariance, estimate, far)
        unit = 1.0 / float(np.linalg.norm(cam_from_rig[far].translation))
        cam_from_rig = tuple(t.scaled(unit) for t in cam_from_rig)
    cameras = _cameras(run, covariance)
    calibration = result.Calibration(
        cameras=cameras,
        rig=_rig(run, cam_from_rig, covariance, far),
        covariance=result.Covariance(
            names=covariance.names, matrix=tuple(map(tuple, covariance.matrix.tolist()))
        ),
        noise=result.Noise(sigma_px=run.refinement.sigma_px, inflation=run.covariance.inflation),
        verdict=_verdict(run, cameras),
        solve=_solve(run),
        provenance=_provenance(run),
    )
    return calibration, unit


def _cameras(run: Run, covariance: Covariance) -> dict[str, result.CameraResult]:
    graph, seen = run.refinement.graph, run.refinement.problem.observations
    sigma = covariance.sigma
    entries = {}
    for index, camera in enumerate(run.refinement.estimate.cameras):
        own = {p: sigma.get(f"{camera.name}.{p}", 0.0) for p in camera.names}
        prior = graph.lens_priors[graph.layout.lens_of[index]]
        prior_sigma = np.sqrt(np.diag(np.linalg.inv(prior.information())))
        share = {
            p: min(own[p] ** 2 / float(s) ** 2, 1.0) if free else 1.0
            for p, s, free in zip(camera.names, prior_sigma, prior.free, strict=True)
        }
        if np.isfinite(prior.aspect_sigma):
            ratio = covariance.of_difference(f"{camera.name}.fy", f"{camera.name}.fx")
            share["fy/fx"] = min((ratio / camera.params[0] / prior.aspect_sigma) ** 2, 1.0)
        rows = seen.camera == index
        entries[camera.name] = result.CameraResult(
            lens=camera.lens,
            size=camera.size,
            params=replace(camera, params=prior.held(camera.params)).named(),
            sigma=own,
            prior_share=share,
            n_images=len(np.unique(seen.frame[rows])),
            n_observations=int(rows.sum()),
        )
    return entries


def _rig(
    run: Run, cam_from_rig: tuple[Transform, ...], covariance: Covariance, far: int | None
) -> result.RigResult:
    problem, names = run.refinement.problem, run.scan.cameras
    sigma = covariance.sigma
    transforms = {}
    for name, transform in zip(names, cam_from_rig, strict=True):
        turn = [np.degrees(sigma.get(f"{name}.rotation_{axis}", 0.0)) for axis in "xyz"]
        move = [sigma.get(f"{name}.translation_{axis}", 0.0) for axis in "xyz"]
        transforms[name] = result.CamFromRig(
            rotation_wxyz=tuple(transform.rotation_wxyz.tolist()),
            translation=tuple(transform.translation.tolist()),
            sigma_rotation_deg=tuple(turn),
            sigma_translation=tuple(move),
        )
    reference = names[problem.reference]
    scale = result.Scale(source="none: one camera has no length")
    if problem.scale is not None:
        scale = result.Scale(
            source=in_words(problem.scale, problem), sigma_relative=_scale_sigma(run)
        )
    elif far is not None:
        scale = result.Scale(source=f"none: unit is the baseline {reference} to {names[far]}")
    elif len(names) > 1:
        scale = result.Scale(source="none: the cameras sit too close together to give a unit")
    return result.RigResult(
        reference=reference,
        cam_from_rig=transforms,
        metric=problem.scale is not None,
        scale=scale,
    )


def _scale_sigma(run: Run) -> float:
    """Relative sigma of the measured distance at the optimum, its clicks' own included."""
    graph = run.refinement.graph
    scale, options = graph.problem.scale, graph.options
    assert scale is not None
    sigma_m = total_sigma_m(
        graph.problem,
        root_information(graph.problem, options),
        graph.layout.lens_of,
        options.loss,
        options.loss_scale,
        run.refinement.values,
    )
    return sigma_m / scale.length_m


def _verdict(run: Run, cameras: dict[str, result.CameraResult]) -> result.Verdict:
    refinement, problem = run.refinement, run.refinement.problem
    messages = [*run.scan.warnings, *run.mapped.messages]
    if len(problem.frame_names) < FEW_FRAMES:
        messages.append(
            f"only {len(problem.frame_names)} frames: sigmas rest on how much frames differ, and "
            f"fewer than {FEW_FRAMES} show that poorly; expect errors above the stated sigmas"
        )
    believed = [
        (name, parameter)
        for name, entry in cameras.items()
        for parameter in entry.params
        if entry.prior_share.get(parameter, 0.0) > PRIOR_DECIDES
        and parameter not in nominal.camera_config(run.config, name).fixed
    ]
    reasons = (
        []
        if refinement.summary.converged
        else [f"the solve did not converge: {refinement.summary.reason}"]
    )
    for name, entry in cameras.items():
        for parameter in ("fx", "fy"):
            relative = entry.sigma[parameter] / entry.params[parameter]
            if relative > USABLE_FOCAL_SIGMA:
                reasons.append(
                    f"the sigma of {name}.{parameter} is {relative:.0%} of it (usable up to "
                    f"{USABLE_FOCAL_SIGMA:.0%})"
                )
    messages += _contradictions(run) + _lost_clicks(run)
    messages = [f"not usable: {reason}" for reason in reasons] + messages
    weak = tuple(_weak_direction(cameras[name], name, parameter) for name, parameter in believed)
    return result.Verdict(usable=not reasons, weak=weak, messages=tuple(messages))


def _contradictions(run: Run) -> list[str]:
    """Parameters that came out far from what rig.yaml states of them."""
    found = []
    for camera, prior in zip(
        run.refinement.estimate.cameras, run.refinement.graph.lens_priors, strict=True
    ):
        stated = nominal.camera_config(run.config, camera.name).sigma
        for name, value, mean in zip(camera.names, camera.params, prior.mean, strict=True):
            if name in stated and abs(value - mean) > CONTRADICTION * stated[name]:
                found.append(
                    f"{camera.name}.{name} came out {abs(value - mean) / stated[name]:.0f} of its "
                    f"stated sigmas from {mean:g}: the scan contradicts rig.yaml"
                )
    return found


def _lost_clicks(run: Run) -> list[str]:
    """Clicks on marks that were set aside as mismatches."""
    said, problem = run.config.scale.points, run.refinement.problem
    if said is None or not isinstance(problem.scale, KnownSpan):
        return []
    given = sum(map(len, said.between))
    left = int(np.isin(problem.observations.point, problem.scale.points).sum())
    if left == given:
        return []
    return [
        f"{given - left} of {given} clicks on the marks of scale.points contradict the others and "
        "were set aside: look at them again"
    ]


def _weak_direction(entry: result.CameraResult, name: str, parameter: str) -> result.WeakDirection:
    in_px = entry.sigma[parameter] if parameter in ("fx", "fy", "cx", "cy") else None
    return result.WeakDirection(
        what=f"{name}.{parameter}", effect_px=in_px, remedy=REMEDIES[parameter[0]]
    )


def _solve(run: Run) -> result.Solve:
    refinement, seen = run.refinement, run.refinement.problem.observations
    residuals = residuals_px(refinement.estimate, seen)
    return result.Solve(
        converged=refinement.summary.converged,
        reason=refinement.summary.reason,
        iterations=refinement.iterations,
        rms_px=float(np.sqrt(np.nanmean((residuals**2).sum(1)))),
        n_frames=len(refinement.problem.frame_names),
        n_images=len(np.unique(seen.frame * len(run.scan.cameras) + seen.camera)),
        n_points=len(refinement.estimate.points),
        n_observations=len(seen),
        n_rejected=refinement.n_rejected,
        selection=_selection(refinement.budget),
        seconds=run.seconds,
    )


def _selection(budget: Budget | None) -> result.Selection | None:
    return None if budget is None else result.Selection(**asdict(budget))


def _provenance(run: Run) -> result.Provenance:
    return result.Provenance(
        version=sfm_calib.__version__,
        versions={"python": platform.python_version()}
        | {name: version(name) for name in LIBRARIES},
        command=run.command,
        config=run.config.model_dump(mode="json"),
        seed=run.config.seed,
        input_hashes=run.mapped.input_hashes,
    )

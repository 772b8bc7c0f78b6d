"""What is said of an optimum: the numbers with their sigmas, and whether to use them."""

from __future__ import annotations

import platform
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Literal

import numpy as np

import sfm_calib
from graphs.budget import Budget
from graphs.build import root_information
from graphs.covariance import Covariance
from graphs.frames import Transform
from graphs.joint_prior import baseline_sigma, shares_of_prior
from graphs.ladder import Ladder, RungResult
from graphs.observability import observe
from graphs.problem import Problem, images_seen, residuals_px
from graphs.propagation import cross_covariance
from graphs.refine import Refinement
from graphs.scale import total_sigma_m
from sfm_calib import result
from sfm_calib.board_summary import board_result
from sfm_calib.provenance import Provenance
from sfm_calib.run import Run
from sfm_calib.scale import in_words
from sfm_calib.scale_ledger import entries_of, ledger_of
from sfm_calib.torch_import import torch_versions
from sfm_calib.uncertainty import uncertainty_of
from sfm_calib.verdict import verdict_of

LIBRARIES = ("gtsam", "pycolmap", "opencv-contrib-python-headless", "numpy", "scipy", "numba")


def summarise(run: Run) -> tuple[result.Calibration, float]:
    """The result file of a run, and its lengths over the optimum's.

    Non-metric rigs are put into units of their longest baseline.
    """
    run = replace(run, ledger=ledger_of(run))
    estimate = run.refinement.estimate
    covariance, unit = run.covariance.stated, 1 / run.covariance.basis.unit
    in_unit = estimate.scaled(unit)
    calibration = result.Calibration(
        cameras=_cameras(run, covariance),
        rig=_rig(run, in_unit.cam_from_rig, covariance),
        covariance=result.Covariance(
            names=covariance.names, matrix=tuple(map(tuple, covariance.matrix.tolist()))
        ),
        noise=_noise(run),
        uncertainty=uncertainty_of(
            in_unit, covariance, _typical_sigma_px(run.refinement), _unit_name(run)
        ),
        board=board_result(run),
        lens_choice=None if run.ladder is None else _lens_choice(run.ladder),
        verdict=verdict_of(run),
        solve=_solve(run),
        provenance=_provenance(run),
    )
    return calibration, unit


def _noise(run: Run) -> result.Noise:
    covariance, names = run.covariance, run.scan.cameras
    by_size: dict[str, list[result.NoiseBySize]] = {name: [] for name in names}
    for one in run.refinement.noise:
        ends = one.smallest_px, one.largest_px
        known = bool(np.isfinite(ends).all())
        by_size[names[one.camera]].append(
            result.NoiseBySize(
                smallest_px=ends[0] if known else None,
                largest_px=ends[1] if known else None,
                n_observations=one.count,
                sigma_px=one.sigma_px,
                of_board=one.of_board,
                matched=one.kind == "matched",
            )
        )
    jackknife = covariance.jackknife
    moved = None if jackknife is None else Covariance(jackknife.names, jackknife.covariance).sigma
    sigmas = {
        name: result.Sigmas(
            model=covariance.model.sigma[name],
            robust=covariance.robust.sigma[name],
            jackknife=None if moved is None else moved[name],
            stated=stated,
        )
        for name, stated in covariance.stated.sigma.items()
    }
    return result.Noise(
        sigma_px=run.refinement.sigma_px,
        inflation=covariance.inflation,
        by_size={name: tuple(classes) for name, classes in by_size.items()},
        sigmas=sigmas,
    )


def _lens_choice(ladder: Ladder) -> result.LensChoice:
    return result.LensChoice(
        chosen=ladder.chosen,
        reason=ladder.reason,
        n_frames=ladder.n_frames,
        n_observations=ladder.n_observations,
        rungs=tuple(_rung(tried) for tried in ladder.rungs),
    )


def _rung(tried: RungResult) -> result.Rung:
    covariance = tried.covariance
    observed = observe(
        tried.graph, tried.estimate, covariance.stated, covariance.model, covariance.basis.unit
    )
    lenses = {f"{camera.name}.{p}" for camera in tried.estimate.cameras for p in camera.names}
    return result.Rung(
        lens=tried.rung.lens,
        held=tried.rung.held,
        held_out_px=tried.held_out_px if np.isfinite(tried.held_out_px) else None,
        against=tried.against,
        gain_px=tried.gain_px,
        gain_sigmas=tried.gain_sigmas,
        shift_focal_px=tried.shift_focal_px,
        shift_centre_px=tried.shift_centre_px,
        sigma={name: s for name, s in covariance.stated.sigma.items() if name in lenses},
        weak=(*(one.what for one in observed.weak), *tried.weak),
        verdict=tried.verdict,
    )


def _typical_sigma_px(refinement: Refinement) -> float:
    relative = refinement.problem.observations.relative_sigma
    return refinement.sigma_px * (1.0 if relative is None else float(np.median(relative)))


def _cameras(run: Run, covariance: Covariance) -> dict[str, result.CameraResult]:
    graph, seen = run.refinement.graph, run.refinement.problem.observations
    sigma, model = covariance.sigma, run.covariance.model
    earlier = shares_of_prior(graph.problem.prior, model, graph.problem.metric)
    entries = {}
    for index, camera in enumerate(run.refinement.estimate.cameras):
        own = {p: sigma.get(f"{camera.name}.{p}", 0.0) for p in camera.names}
        prior = graph.lens_priors[graph.layout.lens_of[index]]
        prior_sigma = np.sqrt(np.diag(np.linalg.inv(prior.information())))
        share = {
            p: min(model.sigma[f"{camera.name}.{p}"] ** 2 / float(s) ** 2, 1.0) if free else 1.0
            for p, s, free in zip(camera.names, prior_sigma, prior.free, strict=True)
        }
        if np.isfinite(prior.aspect_sigma):
            ratio = model.of_difference(f"{camera.name}.fy", f"{camera.name}.fx")
            share["fy/fx"] = min((ratio / camera.params[0] / prior.aspect_sigma) ** 2, 1.0)
        share |= {p: earlier[n] for p in camera.names if (n := f"{camera.name}.{p}") in earlier}
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


def _unit_name(run: Run) -> Literal["m", "baseline"] | None:
    if run.refinement.problem.metric:
        return "m" if len(run.scan.cameras) > 1 else None
    return None if run.covariance.basis.unit_camera is None else "baseline"


def _rig(run: Run, cam_from_rig: tuple[Transform, ...], covariance: Covariance) -> result.RigResult:
    problem, names = run.refinement.problem, run.scan.cameras
    sigma, far = covariance.sigma, run.covariance.basis.unit_camera
    transforms = {
        name: result.CamFromRig.of(name, transform, sigma)
        for name, transform in zip(names, cam_from_rig, strict=True)
    }
    reference = names[problem.reference]
    scale = result.Scale(source="none: one camera has no length")
    if problem.metric:
        scale = _scale(run)
    elif far is not None:
        scale = result.Scale(source=f"none: unit is the baseline {reference} to {names[far]}")
    elif len(names) > 1:
        scale = result.Scale(source="none: the cameras sit too close together to give a unit")
    return result.RigResult(
        reference=reference,
        cam_from_rig=transforms,
        metric=problem.metric,
        scale=scale,
    )


def _scale(run: Run) -> result.Scale:
    """The sources, and the relative sigma of what they measure together, clicks' own included."""
    graph = run.refinement.graph
    problem, options = graph.problem, graph.options
    sigmas = [
        total_sigma_m(
            problem,
            source,
            root_information(problem, options),
            graph.layout.lens_of,
            options.loss,
            options.loss_scale,
            run.refinement.values,
        )
        / source.length_m
        for source in problem.scales
    ]
    words = [in_words(source, problem) for source in problem.scales]
    if problem.board is not None and run.board is not None and problem.board_gives_scale:
        sigmas.append(float(problem.board.board.shape_sigma[0]))
        words.append(f"board: {run.board.board.described}")
    if problem.prior is not None and problem.prior.gives_scale:
        sigmas.append(baseline_sigma(problem.prior))
        words.append("the earlier calibration")
    best = words[int(np.argmin(sigmas))]
    others = len(sigmas) - 1
    together = float(np.sum(np.array(sigmas) ** -2.0)) ** -0.5
    return result.Scale(
        source=f"{best}, and {others} more" if others else best,
        sigma_relative=max(together, _baseline_sigma(run) if problem.board_gives_scale else 0.0),
        contradicted=run.ledger.contradicted,
        ledger=entries_of(run.ledger),
    )


def _baseline_sigma(run: Run) -> float:
    """Relative sigma of the longest baseline: how well a board was seen enters it too."""
    placed, names = run.refinement.estimate.cam_from_rig, run.scan.cameras
    far = int(np.argmax([np.linalg.norm(t.translation) for t in placed]))
    length = float(np.linalg.norm(placed[far].translation))
    if length <= 0:
        return 0.0
    of = [f"{names[far]}.translation_{axis}" for axis in "xyz"]
    covariance = cross_covariance(run.covariance.stated, of, of)
    along = placed[far].translation / length
    return float(np.sqrt(max(float(along @ covariance @ along), 0.0))) / length


def _solve(run: Run) -> result.Solve:
    refinement, seen = run.refinement, run.refinement.problem.observations
    residuals = residuals_px(refinement.estimate, seen)
    return result.Solve(
        converged=refinement.summary.converged,
        reason=refinement.summary.reason,
        iterations=refinement.iterations,
        rms_px=float(np.sqrt(np.nanmean((residuals**2).sum(1)))),
        n_frames=len(refinement.problem.frame_names),
        n_images=len(images_seen(seen)),
        n_points=_n_points(refinement.problem),
        n_observations=len(seen),
        n_rejected=refinement.n_rejected,
        selection=_selection(refinement.budget),
        seconds=run.seconds,
    )


def _n_points(problem: Problem) -> int:
    """Points of the scene, and corners of the board, each once."""
    board = problem.board
    if board is None:
        return len(problem.initial.points)
    return int((~board.known).sum()) + len(np.unique(board.corner[board.known]))


def _selection(budget: Budget | None) -> result.Selection | None:
    return None if budget is None else result.Selection(**asdict(budget))


def _provenance(run: Run) -> Provenance:
    return Provenance(
        version=sfm_calib.__version__,
        versions={"python": platform.python_version()}
        | {name: version(name) for name in LIBRARIES}
        | (torch_versions() if run.config.refine or run.config.features != "sift" else {}),
        command=run.command,
        config=run.config.model_dump(mode="json"),
        seed=run.config.seed,
        input_hashes=run.mapped.input_hashes,
    )

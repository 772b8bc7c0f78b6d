"""Whether to use a result, and what to know before."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from graphs.lens_doubt import lens_doubt
from graphs.observability import WeakDirection, observe
from graphs.problem import KnownSpan, Problem, images_seen
from graphs.remedies import listed_parameters
from graphs.twin import Certificate, worst
from sfm_calib import nominal, result
from sfm_calib.config import PointsConfig
from sfm_calib.mapping import some
from sfm_calib.run import Run
from sfm_calib.scale_ledger import contradiction

FEW_FRAMES = 10  # fewer, and the scatter between frames is itself a guess
CONTRADICTION = 4.0  # stated sigmas between a parameter and what rig.yaml says of it
LOOSE_SCALE = 0.1  # of the measured distance: of a tape measure it is a hundredth
# Of rendered scans 0.8 to 0.9, of photographs from a tripod 0.9, of webcams that are walked 1.5.
MORE_THAN_MATCHED = 1.25
MANY_REJECTED = 0.25  # of the observations: 6 to 10 % in real scans that went well
# Of sigma squared: a certificate holds where the mean NEES is between them, two of its standard
# errors allowed.
LEAST_NEES, MOST_NEES = 0.8, 1.3


def verdict_of(run: Run) -> result.Verdict:
    """The verdict on a finished calibration."""
    refinement, covariance = run.refinement, run.covariance
    observed = observe(
        refinement.graph,
        refinement.estimate,
        covariance.stated,
        covariance.model,
        covariance.basis.unit,
    )
    reasons = list(observed.unusable)
    if not refinement.summary.converged:
        reasons.insert(0, f"the solve did not converge: {refinement.summary.reason}")
    certificate = None if run.certificate is None else certificate_of(run.certificate)
    messages = [f"not usable: {reason}" for reason in reasons]
    messages += contradiction(run.ledger)
    messages += [*run.scan.warnings, *run.mapped.messages, *observed.lacks]
    messages += _doubts(run) + _contradictions(run) + _lost_clicks(run)
    if certificate is not None and not certificate.holds:
        messages.append(
            f"simulated twins of this scan err by {certificate.nees**0.5:.1f} of their stated "
            f"sigmas (rms), and 95 % intervals hold {certificate.coverage:.0%} of the truths: its "
            "sigmas cannot be relied on; take more frames, with more motion"
        )
    return result.Verdict(
        usable=not reasons,
        weak=(*(_weak(one) for one in observed.weak), *_of_lens(run)),
        messages=tuple(messages),
        split=None
        if run.split is None
        else result.Split(
            difference_px=run.split.difference_px,
            expected_px=run.split.expected_px,
            p_value=run.split.p_value,
            agrees=run.split.agrees,
        ),
        certificate=certificate,
    )


def certificate_of(certificate: Certificate) -> result.Certificate:
    """What the twins showed, and whether the sigmas hold."""
    mean, error = certificate.mean_nees
    name, coverage = next(worst(certificate))
    return result.Certificate(
        trials=len(certificate.nees),
        failed=certificate.failed,
        nees=mean,
        nees_standard_error=error,
        model_nees=float(certificate.model_nees.mean()),
        coverage=float(certificate.coverage.mean()),
        least_covered=name,
        least_coverage=coverage,
        holds=LEAST_NEES - 2 * error < mean < MOST_NEES + 2 * error,
    )


def _weak(one: WeakDirection) -> result.WeakDirection:
    return result.WeakDirection(
        what=one.what,
        effect_px=max(one.effect_centre_px, one.effect_corner_px),
        remedy=one.remedy,
        kind=one.kind,
        parameters=one.parameters,
        moves=one.moves,
        slide_px=one.slide_px,
        data_slide_px=one.data_slide_px if math.isfinite(one.data_slide_px) else None,
        effect_centre_px=one.effect_centre_px,
        effect_corner_px=one.effect_corner_px,
        prior_share=one.prior_share,
    )


def _of_lens(run: Run) -> Iterator[result.WeakDirection]:
    """What hangs on the lens, where frames held out cannot tell which it is."""
    covariance, ladder = run.covariance, run.ladder
    if ladder is None:
        return
    doubt = lens_doubt(ladder, covariance.stated)
    if doubt is None:
        return
    by_sigmas = max(map(abs, doubt.moves_sigmas))
    yield result.WeakDirection(
        what=f"{listed_parameters(doubt.parameters, run.scan.cameras)}: which lens it is: "
        f"{doubt.label} predicts frames held out no worse than {ladder.best.rung.label}, was not "
        f"taken ({doubt.verdict}), and would move these by up to {by_sigmas:.1f} stated sigmas",
        effect_px=doubt.corner_px,
        remedy=f"{_into_the_corners(run)} of the image, or say which lens it is (lens)",
        kind=result.OF_LENS,
        parameters=doubt.parameters,
        moves=doubt.moves,
    )


def _no_metres(run: Run) -> list[str]:
    """A board that gave a rig no metres."""
    if run.board is None or len(run.scan.cameras) == 1 or run.refinement.problem.metric:
        return []
    return [
        "the board gives no metres: no frame is left in which two cameras see it at once, as the "
        "scan has them; were its images taken together, and are cameras not swapped?"
    ]


def _into_the_corners(run: Run) -> str:
    if run.refinement.problem.of_board_alone:
        return "bring the board into the corners"
    return "let things of the scene pass through the corners"


def _times_matched(run: Run) -> float:
    """How many times as noisy as matching says its observations are; 0 where none was matched."""
    stated = run.refinement.problem.observations.matched_sigma_px
    if stated is None or not np.isfinite(stated).any():
        return 0.0
    return run.refinement.sigma_px / float(np.nanmedian(stated))


def _doubts(run: Run) -> list[str]:
    """What makes the sigmas themselves doubtful."""
    refinement, covariance, doubts = run.refinement, run.covariance, []
    frames = len(refinement.problem.frame_names)
    if frames < FEW_FRAMES:
        doubts.append(
            f"only {frames} frames: sigmas rest on how much frames differ, and fewer than "
            f"{FEW_FRAMES} show that poorly; expect errors above the stated sigmas"
        )
    for first, last in covariance.jackknife.failed if covariance.jackknife else ():
        doubts.append(
            f"without the frames {first} to {last} the scan determines nothing: all hangs on "
            "them; take more views like these"
        )
    if run.split is not None and not run.split.agrees:
        doubts.append(
            f"two halves of the frames, calibrated alone, project {run.split.difference_px:.2f} px "
            f"apart, and the sigmas let expect {run.split.expected_px:.2f} px (p = "
            f"{run.split.p_value:.2g}): something changed during the scan (zoom, focus, a mount), "
            "or the sigmas are too small; calibrate parts of it"
        )
    times = _times_matched(run)
    if times > MORE_THAN_MATCHED:
        doubts.append(
            f"matched patches scatter {times:.1f} times as much as matching says: images err in "
            "what no patch tells, as by a moving shutter, refocusing, reflections or a lens of "
            "another kind; sigmas hold what of it differs between frames, and no more: compare "
            "with a board, or without --refine"
        )
    if run.ladder is not None and run.ladder.n_frames < 2:
        doubts.append(
            f"the lens {run.ladder.best.rung.label} is a guess: no frame could be held out to "
            "judge it by; take more views, or say which lens it is (lens)"
        )
    before, after = _images_of(run.mapped.problem), _images_of(refinement.problem)
    if lost := sorted(before - after):
        doubts.append(
            f"{len(lost)} images see too few points that are consistent between views, and were "
            f"left out: {some(lost)}"
        )
    doubts += _no_metres(run)
    kept = len(refinement.problem.observations)
    rejected = refinement.n_rejected / max(kept + refinement.n_rejected, 1)
    if rejected > MANY_REJECTED:
        doubts.append(
            f"{rejected:.0%} of the observations were set aside as mismatches ({MANY_REJECTED:.0%} "
            "is much): look at the residuals; things that move, cameras out of step or a wrong "
            "lens make such"
        )
    return doubts


def _images_of(problem: Problem) -> set[str]:
    """The images that a problem has observations of, as `camera/frame`."""
    cameras = problem.initial.cameras
    return {
        f"{cameras[c].name}/{problem.frame_names[f]}" for c, f in images_seen(problem.observations)
    }


def _contradictions(run: Run) -> list[str]:
    """Parameters that came out far from what rig.yaml states of them, or from its beliefs."""
    found = []
    for camera, prior in zip(
        run.refinement.estimate.cameras, run.refinement.graph.lens_priors, strict=True
    ):
        stated = nominal.camera_config(run.config, camera.name).sigma
        for name, value, mean, sigma, free in zip(
            camera.names, camera.params, prior.mean, prior.sigma, prior.free, strict=True
        ):
            apart = abs(value - mean) / sigma if free else 0.0
            if apart <= CONTRADICTION:
                continue
            what = f"{camera.name}.{name} came out {apart:.0f} "
            if name in stated:
                what += f"of its stated sigmas from {mean:g}: the scan contradicts rig.yaml"
            elif name in ("cx", "cy"):
                what += f"sigmas of principal_point_sigma from {mean:g} px: give a larger one"
            else:
                continue
            found.append(what)
    loose = [one.sigma_m / one.length_m for one in run.refinement.problem.scales]
    if loose and min(loose) > LOOSE_SCALE:
        best = "the measured distance" if len(loose) == 1 else "the best measured distance"
        found.append(
            f"{best} is known to {min(loose):.0%} only, and with it every length: measure it better"
        )
    return found


def _lost_clicks(run: Run) -> list[str]:
    """Clicks on marks that were set aside as mismatches."""
    problem = run.refinement.problem
    spans = [source for source in problem.scales if isinstance(source, KnownSpan)]
    said = [pair for pair in run.config.scale.measured if isinstance(pair[1], PointsConfig)]
    found = []
    for (key, measured), span in zip(said, spans, strict=False):  # none, where a study gives them
        assert isinstance(measured, PointsConfig)
        given = sum(map(len, measured.between))
        left = int(np.isin(problem.observations.point, span.points).sum())
        if left < given:
            found.append(
                f"{given - left} of {given} clicks on the marks of {key} contradict the others "
                "and were set aside: look at them again"
            )
    return found

"""Partial rigs: cameras that a scan lacks keep what the old calibration says of them.

A kept camera has OLD's lens, and OLD's place beside one solved camera, the tie, both with OLD's
covariance. Seen from the tie, what OLD says and what the scan says count as independent, which
they are where OLD was no prior of the solve. Where it was, the solved cameras lean on the same
OLD, and errors that they share with the kept ones are not stated. What OLD knew of a kept camera
beside solved ones other than the tie is not used: the kept camera would have to move for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Final

import numpy as np
import scipy.linalg

from graphs.compare import Stated
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.pose_covariance import relative_jacobians, rereferenced
from graphs.propagation import pose_names
from graphs.unit import in_unit_baseline
from sfm_calib import result
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.formats.ours import rig_of
from sfm_calib.formats.reading import CameraRig, LengthUnit
from sfm_calib.recalibration_record import Recalibration
from sfm_calib.uncertainty import uncertainty_of, unit_of

NO_LENGTH: Final = 1e-9  # of a baseline in the unit of its rig: the cameras sit in one place


@dataclass(frozen=True)
class ScaleTie:
    """The baseline that gave the side without metres, or in another unit, its unit."""

    cameras: tuple[str, str]
    factor: float  # by which that side's lengths were multiplied


@dataclass(frozen=True)
class Completed:
    """A rig with all cameras: OLD's in OLD's order, then those that are new to it."""

    stated: Stated
    reference: str
    tie: str  # the solved camera beside which OLD's are placed
    unit: LengthUnit
    kept: tuple[str, ...]
    added: tuple[str, ...]
    scale: ScaleTie | None  # None: nothing had to be scaled


def with_missing(
    new: CameraRig,
    old: CameraRig,
    unmoved: Sequence[str] | None = None,
    reference: str | None = None,
) -> Completed:
    """The new calibration with the cameras of OLD that it lacks.

    reference: the solved camera whose frame is the rig's; else OLD's own, or the tie.

    unmoved: solved cameras whose place the drift test did not doubt, best first: the first is the
    tie, and lengths are compared among them. Else all common ones, OLD's reference first. Beside
    kept cameras, lengths are in metres where one of the two has them, else in OLD's unit; without
    any, as the scan has them.
    Raises CalibrationError where nothing ties the two, or gives them one unit of length.
    """
    kept = tuple(name for name in old.names if name not in new.names)
    added = tuple(name for name in new.names if name not in old.names)
    ties = _ties(new, old, unmoved)
    if kept and old.cam_from_rig is None:
        raise CalibrationError(
            f"{old.path} does not say how its cameras sit, so {', '.join(kept)} cannot keep a "
            "place: give a calibration that holds the rig, or scan with every camera"
        )
    of_old = reference_of(old)
    reference = reference or (of_old if of_old in new.names else ties[0])
    sides = tuple(seen_from(read.stated, ties[0]) for read in (old, new))
    pair = _scale_pair(new, old, sides[0], ties) if kept else None
    stated, scale = _joined(sides[0], sides[1], kept, pair, new.unit == "m")
    stated = _ordered(seen_from(stated, reference), (*old.names, *added))
    unit = new.unit if not kept else "m" if pair and new.unit == "m" else old.unit
    if unit == "baseline":
        stated = in_longest_baseline(stated)
    return Completed(stated, reference, ties[0], unit, kept, added, scale)


def reference_of(read: CameraRig) -> str:
    """The camera whose frame is the rig's; the first, where that is none's."""
    for name, placed in zip(read.names, read.cam_from_rig or (), strict=False):
        if _is_frame(placed) and set(pose_names(name)).isdisjoint(read.covariance.names):
            return name
    return read.names[0]


def _ties(new: CameraRig, old: CameraRig, unmoved: Sequence[str] | None) -> tuple[str, ...]:
    """Common cameras by which OLD's places are carried over, the tie first."""
    reference = reference_of(old)
    common = sorted((n for n in old.names if n in new.names), key=lambda name: name != reference)
    if not common:
        raise CalibrationError(
            f"{old.path} has {', '.join(old.names)} and the scan {', '.join(new.names)}: no camera "
            "is in both, so nothing ties them; rename the scan's folders as the old cameras"
        )
    for name in unmoved or ():
        if name not in common:
            raise CalibrationError(
                f"{name} cannot tie the old calibration to the new: {nearest(name, common)}"
            )
    return tuple(unmoved or common)


def _is_frame(placed: Transform) -> bool:
    return bool((placed.rotation == np.eye(3)).all() and not placed.translation.any())


def seen_from(side: Stated, name: str) -> Stated:
    """In the frame of a camera; as it is, to the bit, where it is in that frame already."""
    index = [camera.name for camera in side.estimate.cameras].index(name)
    held = set(pose_names(name)).isdisjoint(side.covariance.names)
    if held and _is_frame(side.estimate.cam_from_rig[index]):
        return side
    return Stated(*rereferenced(side.estimate, side.covariance, index))


# ---- lengths -------------------------------------------------------------------------------


def _scale_pair(
    new: CameraRig, old: CameraRig, old_side: Stated, ties: Sequence[str]
) -> tuple[str, str] | None:
    """The ties that are longest apart in OLD, where lengths of the two have to be compared."""
    if (old.unit == "m" and new.unit == "m") or len(new.names) == 1:
        return None
    lengths = {pair: _log_length(old_side, pair)[0] for pair in combinations(ties, 2)}
    longest = max(lengths, key=lambda pair: lengths[pair], default=None)
    if longest is None or lengths[longest] < NO_LENGTH:
        raise CalibrationError(
            f"{old.path} and the scan have no common unit of length, and no two cameras apart in "
            f"both ({', '.join(ties)} in common): measure a distance (scale in rig.yaml), or scan "
            "with another camera of the old calibration"
        )
    return longest


def _log_length(side: Stated, pair: tuple[str, str]) -> tuple[float, FloatArray]:
    """A baseline, and the derivative (n,) of its logarithm by the covariance's parameters."""
    names = [camera.name for camera in side.estimate.cameras]
    a, b = (side.estimate.cam_from_rig[names.index(name)] for name in pair)
    apart = (a @ b.inverse).translation
    length = float(np.linalg.norm(apart))
    gradient = np.zeros(len(side.covariance.names))
    if length < NO_LENGTH:
        return length, gradient
    place = {name: index for index, name in enumerate(side.covariance.names)}
    for name, jacobian in zip(pair, relative_jacobians(a, b), strict=True):
        for one, slope in zip(pose_names(name), apart @ jacobian[3:] / length**2, strict=True):
            if one in place:
                gradient[place[one]] = slope
    return length, gradient


def _joined(
    old: Stated,
    new: Stated,
    kept: Sequence[str],
    pair: tuple[str, str] | None,
    new_is_metric: bool,
) -> tuple[Stated, ScaleTie | None]:
    """Kept cameras of OLD and all of the new, both seen from the tie.

    A scaled translation s t, s = L / L' of a baseline in the other side and in its own, moves by
    s dt + s t (d log L - d log L').
    """
    sizes = len(old.covariance.names), len(new.covariance.names)
    jacobians = [np.eye(sum(sizes))[: sizes[0]], np.eye(sum(sizes))[sizes[0] :]]
    sides, scale = [old, new], None
    if pair is not None:
        (l_old, by_old), (l_new, by_new) = (_log_length(side, pair) for side in sides)
        scaled = 0 if new_is_metric else 1
        factor = l_new / l_old if new_is_metric else l_old / l_new
        by_log = np.concatenate([-by_old, by_new] if new_is_metric else [by_old, -by_new])
        moves = _translations(sides[scaled])
        by = np.where(np.isnan(moves), 1.0, factor)
        jacobians[scaled] = by[:, None] * jacobians[scaled]
        jacobians[scaled] += np.outer(factor * np.nan_to_num(moves), by_log)
        sides[scaled] = replace(sides[scaled], estimate=sides[scaled].estimate.scaled(factor))
        scale = ScaleTie(pair, factor)
    rows = [i for i, n in enumerate(old.covariance.names) if n.rpartition(".")[0] in kept]
    jacobian = np.vstack([jacobians[0][rows], jacobians[1]])
    both = scipy.linalg.block_diag(old.covariance.matrix, new.covariance.matrix)
    names = (*(old.covariance.names[i] for i in rows), *new.covariance.names)
    of_old, of_new = (side.estimate for side in sides)
    held = [i for i, camera in enumerate(of_old.cameras) if camera.name in kept]
    estimate = replace(
        of_new,
        cameras=(*(of_old.cameras[i] for i in held), *of_new.cameras),
        cam_from_rig=(*(of_old.cam_from_rig[i] for i in held), *of_new.cam_from_rig),
    )
    return Stated(estimate, Covariance(names, jacobian @ both @ jacobian.T)), scale


def _translations(side: Stated) -> FloatArray:
    """The value (n,) of every parameter that is a translation; NaN of the others."""
    of = {
        f"{camera.name}.translation_{axis}": value
        for camera, placed in zip(side.estimate.cameras, side.estimate.cam_from_rig, strict=True)
        for axis, value in zip("xyz", placed.translation.tolist(), strict=True)
    }
    return np.array([of.get(name, np.nan) for name in side.covariance.names])


def _ordered(side: Stated, names: Sequence[str]) -> Stated:
    """Cameras, and their parameters in the covariance, in this order."""
    index = {camera.name: i for i, camera in enumerate(side.estimate.cameras)}
    order = [index[name] for name in names]
    rank = {name: i for i, name in enumerate(names)}
    known = side.covariance.names
    rows = sorted(range(len(known)), key=lambda i: rank[known[i].rpartition(".")[0]])
    estimate = replace(
        side.estimate,
        cameras=tuple(side.estimate.cameras[i] for i in order),
        cam_from_rig=tuple(side.estimate.cam_from_rig[i] for i in order),
    )
    matrix = side.covariance.matrix[np.ix_(rows, rows)]
    return Stated(estimate, Covariance(tuple(known[i] for i in rows), matrix))


def in_longest_baseline(side: Stated) -> Stated:
    """With the longest baseline from the reference 1 long, as results without metres have it."""
    lengths = [float(np.linalg.norm(t.translation)) for t in side.estimate.cam_from_rig]
    far = int(np.argmax(lengths))
    if lengths[far] < NO_LENGTH:
        return side
    if f"{side.estimate.cameras[far].name}.translation_x" not in side.covariance.names:
        return side.scaled(1 / lengths[far])
    covariance = in_unit_baseline(side.covariance, side.estimate, far)
    return Stated(side.estimate.scaled(1 / lengths[far]), covariance)


# ---- the result ----------------------------------------------------------------------------


def completed(
    calibration: result.Calibration,
    old: CameraRig,
    recalibration: Recalibration,
    unmoved: Sequence[str] | None = None,
) -> result.Calibration:
    """A result with the cameras of OLD that its scan lacked, marked, and its `recalibration`.

    Of that, `kept` and `added` are filled in here. Raises CalibrationError as `with_missing`.
    """
    scan = rig_of(calibration, Path("the scan"))
    found = with_missing(scan, old, unmoved, calibration.rig.reference)
    estimate, covariance = found.stated.estimate, found.stated.covariance
    sigma, cameras = covariance.sigma, {}
    for camera in estimate.cameras:
        if camera.name in calibration.cameras:
            cameras[camera.name] = calibration.cameras[camera.name]
            continue
        own = {p: sigma[n] for p in camera.names if (n := f"{camera.name}.{p}") in sigma}
        cameras[camera.name] = result.CameraResult(
            lens=camera.lens,
            size=camera.size,
            params=camera.named(),
            sigma=own,
            prior_share=dict.fromkeys(own, 1.0),
            kept_from=recalibration.old.sha256,
        )
    changed = {
        "cameras": cameras,
        "rig": _rig(calibration, found),
        "covariance": result.Covariance(
            names=covariance.names, matrix=tuple(map(tuple, covariance.matrix.tolist()))
        ),
        "recalibration": recalibration.model_copy(
            update={"kept": found.kept, "added": found.added}
        ),
    }
    whole = result.Calibration(**dict(calibration) | changed)
    return whole.model_copy(update=_retold(whole, found))


def _rig(calibration: result.Calibration, found: Completed) -> result.RigResult:
    estimate, sigma = found.stated.estimate, found.stated.covariance.sigma
    placed = {
        camera.name: result.CamFromRig.of(camera.name, transform, sigma)
        for camera, transform in zip(estimate.cameras, estimate.cam_from_rig, strict=True)
    }
    return result.RigResult(
        reference=found.reference,
        cam_from_rig=placed,
        metric=found.unit == "m",
        scale=_scale(calibration.rig.scale, found),
    )


def _scale(of_scan: result.Scale, found: Completed) -> result.Scale:
    placed, names = found.stated.estimate.cam_from_rig, found.stated.estimate.cameras
    far = names[int(np.argmax([np.linalg.norm(t.translation) for t in placed]))].name
    if found.unit == "baseline":
        return result.Scale(source=f"none: unit is the baseline {found.reference} to {far}")
    if of_scan.sigma_relative is not None or far == found.reference:
        return of_scan
    if found.unit == "unknown":
        return result.Scale(source="none: the unit of the old calibration")
    slope = _log_length(found.stated, (found.reference, far))[1]
    return result.Scale(
        source="the old calibration",
        sigma_relative=max(float(slope @ found.stated.covariance.matrix @ slope), 0.0) ** 0.5,
    )


def _retold(whole: result.Calibration, found: Completed) -> dict[str, object]:
    """What is said of the covariance, anew where it changed."""
    estimate, covariance = found.stated.estimate, found.stated.covariance
    told: dict[str, object] = {}
    if whole.uncertainty is not None and found.kept:  # else it is the scan's
        told["uncertainty"] = uncertainty_of(
            estimate, covariance, whole.uncertainty.sigma_px, unit_of(whole)
        )
    if whole.noise is not None:  # in another frame or unit, the parts of a sigma are not known
        sigma = covariance.sigma
        same = {
            name: one
            for name, one in whole.noise.sigmas.items()
            if name in sigma and np.isclose(sigma[name], one.stated, rtol=1e-9, atol=0.0)
        }
        told["noise"] = whole.noise.model_copy(update={"sigmas": same})
    if whole.verdict is not None and found.kept:
        said = (
            f"{', '.join(found.kept)} not in the scan: lens, and place beside {found.tie}, are "
            "those of the old calibration"
        )
        messages = (*whole.verdict.messages, said)
        told["verdict"] = whole.verdict.model_copy(update={"messages": messages})
    return told

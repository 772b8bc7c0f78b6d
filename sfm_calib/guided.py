"""From a scan to a Problem with an old calibration for a guide, from coarse to fine.

The largest features alone are matched, where the old rig says that views overlap, and mapped
freely; the graph solves that rig with everything free. Then every feature is matched, along the
epipolar lines of the rig as it is now. So the old calibration says where to look, and nothing of
how the rig came out: one that is wrong costs matches at the first step and none in the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from graphs.build import GraphOptions
from graphs.camera import Camera
from graphs.frames import Transform
from graphs.lenses import LensName
from graphs.problem import Problem, images_seen
from graphs.refine import refine
from sfm_calib import colmap, colmap_matches, features
from sfm_calib.cache import Cache
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.fine_tracks import fine_problem
from sfm_calib.formats.reading import CameraRig
from sfm_calib.images import Progress, Scan
from sfm_calib.mapping import (
    DATABASE,
    ENOUGH_REGISTERED,
    MIN_MATCHES,
    Mapped,
    check_overlap,
    map_matched,
    map_scan,
    problem_of,
    reference_of,
)
from sfm_calib.nominal import lens_of
from sfm_calib.overlap import LEAST_SHARED_VIEW, first_pairs, shared_view
from sfm_calib.pairs import Pair, choose_pairs
from sfm_calib.worker import run_apart

# The demo rig is placed whole with 300; the corridor's specular floor wants more.
COARSE_FEATURES = 400
IN_SEQUENCE = 0.5  # of the images match the next of their camera; photographs in no order do not


def map_with_prior(
    scan: Scan, old: CameraRig, config: RigConfig, cache: Cache, progress: Progress
) -> Mapped:
    """Track features through the scan of a rig whose old calibration is known, at least roughly.

    `old`: of any of the scan's cameras; the others are found as `map_scan` finds them. Every lens
    and the rig come out near the optimum, in old's unit. Where too few images can be placed this
    way, the scan is mapped as without `old`, and a message says so.
    Raises CalibrationError as `map_scan`.
    """
    known = {scan.cameras.index(c.name): c for c in old.cameras if c.name in scan.cameras}
    lenses = [
        known[i].lens if i in known else lens_of(config, name, len(scan.cameras))
        for i, name in enumerate(scan.cameras)
    ]
    hashes = scan.hashes
    sought = config.max_features, config.image_scale
    inputs: list[object] = [hashes, scan.cameras, *sought, cv2.__version__]
    place = cache.stage(
        "guided_features",
        inputs,
        lambda place: run_apart(features.extract, (scan, *sought, place), progress),
    )
    nominal = _nominal(scan, old, reference_of(scan, config))
    inputs += [scan.frames, config.pairs, config.seed, lenses, colmap.VERSION]
    inputs += [{i: camera.params.tolist() for i, camera in known.items()}, _numbers(nominal)]
    models = cache.stage(
        "guided_models",
        inputs,
        lambda to: run_apart(
            _map_coarsely, (scan, config, lenses, known, nominal, place, to), progress
        ),
    )
    found = features.load(place)
    scales = {i.path: f.scales for i, f in zip(scan.images, found, strict=True)}
    try:
        with cache.held(models):
            coarse, messages = problem_of(
                scan, config, lenses, models, models / DATABASE, lambda: scales
            )
        _check_placed(coarse, scan)
        coarse = _in_unit_of(_solved(coarse, config, progress), nominal)
    except CalibrationError as error:
        return _without_old(scan, config, lenses, known, cache, progress, str(error))
    return Mapped(fine_problem(scan, coarse, found, progress), messages, hashes)


def _check_placed(coarse: Problem, scan: Scan) -> None:
    placed, n = len(images_seen(coarse.observations)), len(scan.images)
    if placed < ENOUGH_REGISTERED * n:
        raise CalibrationError(f"only {placed} of {n} images could be placed")


def _without_old(
    scan: Scan,
    config: RigConfig,
    lenses: Sequence[LensName],
    known: dict[int, Camera],
    cache: Cache,
    progress: Progress,
    why: str,
) -> Mapped:
    """The scan mapped in full, of old the lenses alone for a start; and why."""
    mapped = map_scan(scan, config, lenses, known, cache, progress)
    said = f"the scan was mapped without the old calibration's help: with it, {why}"
    return replace(mapped, messages=(said, *mapped.messages))


def _nominal(scan: Scan, old: CameraRig, reference: int) -> dict[int, Transform]:
    """Old's cam_from_rig by the scan's cameras, of the reference's frame where old has it."""
    if old.cam_from_rig is None:
        return {}
    placed = dict(zip(old.names, old.cam_from_rig, strict=True))
    origin = placed.get(scan.cameras[reference], next(iter(placed.values()))).inverse
    return {i: placed[name] @ origin for i, name in enumerate(scan.cameras) if name in placed}


def _numbers(nominal: dict[int, Transform]) -> dict[int, list[float]]:
    return {i: [*t.rotation.ravel(), *t.translation] for i, t in nominal.items()}


def _map_coarsely(
    scan: Scan,
    config: RigConfig,
    lenses: Sequence[LensName],
    known: dict[int, Camera],
    nominal: dict[int, Transform],
    features_at: Path,
    place: Path,
    progress: Progress,
) -> None:
    """Match and map the largest features of every image."""
    found = [one.largest(COARSE_FEATURES) for one in features.load(features_at)]
    database = place / DATABASE
    colmap.write_features(scan, lenses, known, found, database)
    pairs = first_pairs(scan, _overlapping(scan, known, nominal))
    colmap_matches.match_features(scan, pairs, database, config.seed, progress)
    counts = colmap_matches.match_counts(scan, database)
    if not in_sequence(scan, counts):
        database.unlink()
        colmap.write_features(scan, lenses, known, found, database)
        pairs = choose_pairs(
            scan, config.pairs, lambda i: found[i].descriptors, config.seed, progress
        )
        colmap_matches.match_features(scan, pairs, database, config.seed, progress)
        counts = colmap_matches.match_counts(scan, database)
    check_overlap(scan, counts)
    whole = len(nominal) == len(scan.cameras)
    rig = tuple(nominal[i] for i in range(len(nominal))) if whole else None
    map_matched(scan, config, rig, database, place, progress, rig_at_need=True)


def _overlapping(scan: Scan, known: dict[int, Camera], nominal: dict[int, Transform]) -> np.ndarray:
    """Whether cameras (n, n) see the same things at one time; those unknown to old may."""
    n = len(scan.cameras)
    overlapping = np.ones((n, n), dtype=bool)
    placed = [i for i in known if i in nominal]
    share = shared_view([known[i] for i in placed], [nominal[i] for i in placed])
    overlapping[np.ix_(placed, placed)] = np.maximum(share, share.T) >= LEAST_SHARED_VIEW
    return overlapping


def in_sequence(scan: Scan, counts: dict[Pair, int]) -> bool:
    """Whether most images match the next of their camera."""
    place = scan.numbers
    pairs = [
        (number, place[camera, frame + 1])
        for (camera, frame), number in place.items()
        if (camera, frame + 1) in place
    ]
    matched = [counts.get((min(pair), max(pair)), 0) >= MIN_MATCHES for pair in pairs]
    return bool(matched) and sum(matched) >= IN_SEQUENCE * len(matched)


def _solved(coarse: Problem, config: RigConfig, progress: Progress) -> Problem:
    """The problem at its optimum, with lenses and rig free."""
    try:
        return refine(
            coarse,
            GraphOptions(),
            config.min_parallax_deg,
            on_iteration=lambda iteration, cost: progress("solving the coarse rig", iteration, 0),
        ).problem
    except ValueError as error:
        raise CalibrationError(str(error)) from error


def _in_unit_of(problem: Problem, nominal: dict[int, Transform]) -> Problem:
    """The problem with baselines as long as the old ones, in their median."""
    placed = problem.initial.cam_from_rig
    ratios = []
    for a in nominal:
        for b in nominal:
            old, new = (
                np.linalg.norm(t[a].inverse.translation - t[b].inverse.translation)
                for t in (nominal, placed)
            )
            if a < b and old > 0 and new > 0:
                ratios.append(old / new)
    if not ratios:
        return problem
    return replace(problem, initial=problem.initial.scaled(float(np.median(ratios))))

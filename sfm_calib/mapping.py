"""From a scan to a Problem: features, matches, mapping, and one rig out of many poses."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from graphs.camera import Camera
from graphs.frames import FloatArray, Transform
from graphs.join import join_models
from graphs.lenses import LensName
from graphs.problem import Problem, images_seen
from graphs.rig_start import FreeModel, impose_rig, link_cameras
from sfm_calib import colmap, colmap_matches
from sfm_calib.cache import Cache
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Progress, Scan
from sfm_calib.learned import extract as learned_features
from sfm_calib.learned import matching as learned_matches
from sfm_calib.learned.choice import Learned, choose
from sfm_calib.mapping_attempts import attempts
from sfm_calib.nominal import nominal_rig
from sfm_calib.pairs import Pair, choose_pairs
from sfm_calib.worker import run_apart

DATABASE = "database.db"
LIKELY_PAIRS = "likely_pairs.txt"  # their number, beside the matches of a part of all pairs
ENOUGH_REGISTERED = 0.9  # of the images; fewer, and mapping starts again elsewhere
MIN_MATCHES = 15  # COLMAP's own minimum for a verified pair


@dataclass(frozen=True)
class Mapped:
    """A problem ready to be solved, and what was left out on the way."""

    problem: Problem
    messages: tuple[str, ...]
    input_hashes: dict[str, str]


def map_scan(
    scan: Scan,
    config: RigConfig,
    lenses: Sequence[LensName],
    known: dict[int, Camera],
    cache: Cache,
    progress: Progress,
) -> Mapped:
    """Track features through the scan and derive the rig from freely posed images.

    Raises CalibrationError when images do not overlap, or a camera cannot be placed.
    """
    learned = choose(config)
    hashes, who = scan.hashes, learned.network if learned else "COLMAP"
    inputs: list[object] = [
        hashes, scan.cameras, lenses, config.max_features, config.image_scale,
        {i: camera.params.tolist() for i, camera in known.items()}, colmap.VERSION,
        *(learned.features_from if learned else []),
    ]  # fmt: skip
    features = cache.stage(
        "features",
        inputs,
        lambda place: run_apart(
            _extract, (scan, config, lenses, known, learned, place), progress, who
        ),
    )
    inputs += [scan.frames, config.pairs, config.seed]
    inputs += learned.matches_from if learned else []
    matches = cache.stage(
        "matches",
        inputs,
        lambda place: run_apart(_match, (scan, config, features, learned, place), progress, who),
    )
    database, reference = matches / DATABASE, reference_of(scan, config)
    nominal = nominal_rig(config, scan.cameras, reference)
    inputs += [
        [[*t.rotation.ravel().tolist(), *t.translation.tolist()] for t in nominal or ()],
        reference if nominal else None,
    ]
    with cache.held(matches):
        place = cache.stage(
            "models",
            inputs,
            lambda to: run_apart(map_matched, (scan, config, nominal, database, to), progress),
        )
        problem, messages = problem_of(
            scan, config, lenses, place, database, lambda: colmap.keypoint_scales(database)
        )
    if len(images_seen(problem.observations)) < len(scan.images):
        messages += _unmatched(scan, matches)
    return Mapped(problem, messages, hashes | (learned.hashes if learned else {}))


def problem_of(
    scan: Scan,
    config: RigConfig,
    lenses: Sequence[LensName],
    place: Path,
    database: Path,
    read_scales: Callable[[], dict[str, FloatArray]],
) -> tuple[Problem, tuple[str, ...]]:
    """The rig out of the models in `place`, mapped from `database`, and what was left out.

    read_scales: gives them as `colmap.keypoint_scales`. Raises CalibrationError when a camera
    cannot be placed.
    """
    reference = reference_of(scan, config)
    try:
        found, scales = colmap.read_models(place), read_scales()
        models = [colmap.free_model(model, scan, lenses, scales) for model in found]
    except (OSError, ValueError) as error:
        raise CalibrationError(f"{place} is damaged: run again with --fresh") from error
    model, cam_from_rig = _one_model(scan, models, reference, database)
    problem, dropped = impose_rig(model, cam_from_rig, scan.frames, reference)
    return problem, _messages(scan, model, dropped)


def _extract(
    scan: Scan,
    config: RigConfig,
    lenses: Sequence[LensName],
    known: dict[int, Camera],
    learned: Learned | None,
    place: Path,
    progress: Progress,
) -> None:
    database, most = place / DATABASE, config.max_features
    if learned is None:
        colmap.extract_features(scan, lenses, known, database, most, config.image_scale, progress)
        return
    colmap.import_images(scan, lenses, known, database)
    with colmap.keypoint_writer(database) as write:
        learned_features.extract(scan, learned, most, config.image_scale, place, write, progress)


def _match(
    scan: Scan,
    config: RigConfig,
    features: Path,
    learned: Learned | None,
    place: Path,
    progress: Progress,
) -> None:
    database = place / DATABASE
    left = shutil.ignore_patterns(learned_features.FOLDER)  # large, and read where it is
    shutil.copytree(features, place, dirs_exist_ok=True, ignore=left)
    with _descriptors(scan, features, learned, database) as descriptors:
        pairs = choose_pairs(
            scan, config.pairs, descriptors, config.seed, progress,
            learned.times_sift if learned else 1.0,
        )  # fmt: skip
    if len(pairs) < len(scan.images) * (len(scan.images) - 1) // 2:
        (place / LIKELY_PAIRS).write_text(str(len(pairs)))
    if learned is None:
        colmap_matches.match_features(scan, pairs, database, config.seed, progress)
    else:
        with colmap_matches.match_writer(database) as write:
            learned_matches.match(scan, pairs, learned, features, write, progress)
        colmap_matches.verify_matches(scan, pairs, database, config.seed, progress)
    check_overlap(scan, colmap_matches.match_counts(scan, database))


@contextmanager
def _descriptors(
    scan: Scan, features: Path, learned: Learned | None, database: Path
) -> Iterator[Callable[[int], NDArray[Any]]]:
    """A reader of the descriptors (n, d) of one image, the largest or the surest first."""
    if learned is not None:
        yield lambda i: learned_features.load(features, i).descriptors
        return
    with colmap.open_descriptors(scan, database) as read:
        yield read


def check_overlap(scan: Scan, counts: dict[Pair, int]) -> None:
    """Raises CalibrationError where no pair of images has enough verified matches."""
    best = max(counts.values(), default=0)
    if best < MIN_MATCHES:
        raise CalibrationError(
            f"no two of the {len(scan.images)} images overlap: the best pair has {best} verified "
            f"matches (needs {MIN_MATCHES}); take the views closer together, of textured things"
        )


def map_matched(
    scan: Scan,
    config: RigConfig,
    nominal: tuple[Transform, ...] | None,
    database: Path,
    place: Path,
    progress: Progress,
    rig_at_need: bool = False,
) -> None:
    """Map freely, from several starts until most images are registered, and with the nominal rig
    imposed where one is given; keep what explains most.

    rig_at_need: impose the rig only where free mapping places too few.
    """
    best = (0, 0, 0)
    for number, attempt in enumerate(attempts(config.seed)):
        models = colmap.map_images(scan, database, place / f"free{number}", attempt, progress)
        best = _keep_better(models, scan, place, best)
        if best[1] >= ENOUGH_REGISTERED * len(scan.images):
            break
    needed = not rig_at_need or best[1] < ENOUGH_REGISTERED * len(scan.images)
    if needed and nominal is not None and colmap.can_constrain(scan):
        constrained = place / "rig.db"
        shutil.copyfile(database, constrained)
        colmap.constrain_rig(scan, nominal, reference_of(scan, config), constrained)
        attempt = attempts(config.seed)[0]
        models = colmap.map_images(scan, constrained, place / "rig", attempt, progress)
        best = _keep_better(models, scan, place, best)
    if best[1] == 0:
        raise CalibrationError(
            f"none of {len(scan.images)} images could be placed in {number + 1} attempts: "
            f"{_overlap_in_words(scan, database)}; move the camera sideways between views"
        )


def _keep_better(
    models: list[colmap.Model], scan: Scan, place: Path, best: tuple[int, int, int]
) -> tuple[int, int, int]:
    score = colmap.worth(models, scan)
    if score > best:
        colmap.write_models(models, place / "best")
    return max(score, best)


def reference_of(scan: Scan, config: RigConfig) -> int:
    """Index of the camera whose frame is the rig's."""
    return scan.cameras.index(config.reference) if config.reference else 0


def _overlap_in_words(scan: Scan, database: Path) -> str:
    counts = colmap_matches.match_counts(scan, database)
    matched = sum(count >= MIN_MATCHES for count in counts.values())
    return f"{matched} pairs match, at most {max(counts.values(), default=0)} features each"


def _one_model(
    scan: Scan, models: Sequence[FreeModel], reference: int, database: Path
) -> tuple[FreeModel, tuple[Transform, ...]]:
    """The largest model, joined by the others where they hold cameras that it does not."""
    model = models[0]
    for other in models[1:]:
        model = join_models(model, other)
    cam_from_rig, missing = link_cameras(model, reference)
    if missing:
        # Where the reference itself was not placed, it is what the others miss.
        lost = min([reference, *missing], key=lambda camera: len(model.images_of(camera)))
        raise CalibrationError(_lost_camera(scan, model, lost, database))
    return model, cam_from_rig


def _lost_camera(scan: Scan, model: FreeModel, camera: int, database: Path) -> str:
    counts = colmap_matches.match_counts(scan, database)
    own = {i for i, image in enumerate(scan.images) if image.camera == camera}
    within = [n for (a, b), n in counts.items() if a in own and b in own]
    across = [n for (a, b), n in counts.items() if (a in own) != (b in own)]
    placed = len(model.images_of(camera))
    return (
        f"camera {scan.cameras[camera]} could not be placed on the rig: {placed} of its {len(own)} "
        f"images registered, at most {max(within, default=0)} matches among its own images and "
        f"{max(across, default=0)} with other cameras (needs about 30); let it see textured things "
        "that the other cameras see too, at some time of the scan"
    )


def _messages(scan: Scan, model: FreeModel, dropped: list[tuple[int, int]]) -> tuple[str, ...]:
    messages = []
    lost = [scan.name(i) for i in scan.images if (i.camera, i.frame) not in model.cam_from_world]
    if lost:
        messages.append(
            f"{len(lost)} of {len(scan.images)} images could not be placed: {some(lost)}"
        )
    odd = [f"{scan.cameras[camera]}/{scan.frames[frame]}" for camera, frame in dropped]
    if odd:
        messages.append(
            f"{len(odd)} images contradict the rig and were dropped (a wrong place, or not taken "
            f"together with the rest of their frame): {some(odd)}"
        )
    return tuple(messages)


def _unmatched(scan: Scan, matches: Path) -> tuple[str, ...]:
    """What to try where images are missing, and likely pairs alone were matched."""
    likely = matches / LIKELY_PAIRS
    if not likely.exists():
        return ()
    n = len(scan.images)
    return (
        f"{likely.read_text()} of {n * (n - 1) // 2} pairs of images were matched, those that "
        "seemed likely: with --pairs all more images may be placed, in a longer time",
    )


def some(names: list[str]) -> str:
    """The first five names, and how many more there are."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")

"""What rig.yaml measures: checked against the scan, and as the problem's sources of scale."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphs.camera import focal_on_axis, unproject
from graphs.frames import FloatArray
from graphs.noise import with_click_sigma
from graphs.problem import (
    Estimate,
    KnownBaseline,
    KnownPath,
    KnownSpan,
    Observations,
    Problem,
    ScaleSource,
    joined,
    residuals_px,
)
from graphs.refine import noise_of
from graphs.scale import length_of
from sfm_calib.config import (
    BaselineConfig,
    ClickConfig,
    FramesConfig,
    Measured,
    PointsConfig,
    ScaleConfig,
)
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.images import Scan

# Before the solve, clicks may miss each other by what COLMAP's lens is wrong there: in corridor and
# street, one feature in a hundred by 5 to 8 sigmas of their noise. The solve is stricter.
MEETING_SIGMAS = 10.0
MEETING_STEPS = 10  # of weights that follow the distance; three are enough
MARKS = ("first", "second")

# ---- what the scan must have ----------------------------------------------------------------


def check_scale(scale: ScaleConfig, scan: Scan) -> None:
    """Raises CalibrationError where rig.yaml measures between things that the scan has not."""
    for key, measured in scale.measured:
        if isinstance(measured, BaselineConfig):
            for name in measured.cameras:
                _check_camera(f"{key}.cameras", name, scan)
            _check_apart("baseline", measured.cameras, "cameras")
        elif isinstance(measured, FramesConfig):
            for name in measured.between:
                _check_frame(f"{key}.between", name, scan.frames)
            _check_apart("distance", measured.between, "frames")
        else:
            _check_clicks(f"{key}.between", measured, scan)
    _check_marks_differ(scale.points)


def _check_camera(key: str, name: str, scan: Scan) -> None:
    if name not in scan.cameras:
        raise CalibrationError(
            f"{key}: the scan has no camera {name!r}; {nearest(name, scan.cameras)}"
        )


def _check_frame(key: str, name: str, frames: Sequence[str]) -> None:
    if name not in frames:
        raise CalibrationError(f"{key}: the scan has no frame {name!r}; {nearest(name, frames)}")


def _check_apart(what: str, ends: tuple[str, str], kind: str) -> None:
    if ends[0] == ends[1]:
        raise CalibrationError(
            f"rig.yaml measures a {what} from {ends[0]} to itself; name two {kind}"
        )


def _check_marks_differ(points: Sequence[PointsConfig]) -> None:
    """A click counts once: the same one for two distances would be taken for two sightings."""
    first: dict[ClickConfig, int] = {}
    for number, measured in enumerate(points):
        for click in (click for clicks in measured.between for click in clicks):
            if first.setdefault(click, number) != number:
                raise CalibrationError(
                    f"scale.points.{number}.between: the click ({click.pixel[0]:g}, "
                    f"{click.pixel[1]:g}) in {_image_of(click)} is one of "
                    f"scale.points.{first[click]} already, and counts once; click marks of its own"
                )


def _check_clicks(key: str, measured: PointsConfig, scan: Scan) -> None:
    taken = {(scan.cameras[image.camera], scan.frames[image.frame]) for image in scan.images}
    for which, clicks in zip(MARKS, measured.between, strict=True):
        seen = set()
        for click in clicks:
            _check_camera(key, click.camera, scan)
            _check_frame(key, click.frame, scan.frames)
            image = (click.camera, click.frame)
            if image not in taken:
                raise CalibrationError(
                    f"{key}: {click.camera} has no image in frame {click.frame}; click the {which} "
                    "mark in another image"
                )
            if image in seen:
                raise CalibrationError(
                    f"{key}: the {which} mark is clicked twice in {_image_of(click)}; a mark is "
                    "at one place in an image, and each click needs an image of its own"
                )
            seen.add(image)
            _check_inside(key, click, scan.sizes[scan.cameras.index(click.camera)])
    for a, b in itertools.product(*measured.between):
        if a == b:
            raise CalibrationError(
                f"{key}: both marks are clicked at ({a.pixel[0]:g}, {a.pixel[1]:g}) in "
                f"{_image_of(a)}; click the two ends of the {measured.length_m:g} m"
            )


def _check_inside(key: str, click: ClickConfig, size: tuple[int, int]) -> None:
    if not all(-0.5 <= value <= side - 0.5 for value, side in zip(click.pixel, size, strict=True)):
        raise CalibrationError(
            f"{key}: the click ({click.pixel[0]:g}, {click.pixel[1]:g}) lies outside "
            f"{_image_of(click)}, which has {size[0]} x {size[1]} px; count pixels from the top "
            "left, whose centre is (0, 0)"
        )


def _image_of(click: ClickConfig) -> str:
    return f"{click.camera}/{click.frame}"


# ---- the problem's sources ------------------------------------------------------------------


def with_scale(problem: Problem, scale: ScaleConfig, min_parallax_deg: float) -> Problem:
    """The problem with the measured distances as its sources of scale, in metres from the start.

    Raises CalibrationError when the mapping lost an end of one, when the clicks on a mark do not
    meet, and when the ends are at one place.
    """
    sources: list[ScaleSource] = []
    for key, measured in scale.measured:
        problem, source = _with_source(problem, f"{key}.", measured, min_parallax_deg)
        sources.append(source)
    if not sources:
        return problem
    problem = replace(problem, scales=tuple(sources))
    for source in sources:
        if length_of(source, problem.initial) <= 0:
            raise CalibrationError(
                f"the scan puts both ends of the {in_words(source, problem)}, at one place: "
                "measure between others"
            )
    best = min(sources, key=lambda source: source.sigma_m / source.length_m)
    if not problem.board_gives_scale:
        size = best.length_m / length_of(best, problem.initial)
        problem = replace(problem, initial=problem.initial.scaled(size))
    return with_click_sigma(problem, noise_of(problem))


def _with_source(
    problem: Problem, key: str, measured: Measured, min_parallax_deg: float
) -> tuple[Problem, ScaleSource]:
    """A measured distance in the words of the maths, and the problem with the marks it needs."""
    length, sigma = measured.length_m, measured.sigma_m
    if isinstance(measured, BaselineConfig):
        names = [camera.name for camera in problem.initial.cameras]
        a, b = (names.index(name) for name in measured.cameras)
        return problem, KnownBaseline((a, b), length, sigma)
    key += "between"
    if isinstance(measured, FramesConfig):
        a, b = (_placed(key, name, problem) for name in measured.between)
        return problem, KnownPath((a, b), length, sigma)
    a = len(problem.initial.points)
    for which, clicks in zip(MARKS, measured.between, strict=True):
        seen = _clicks_seen(key, problem, clicks)
        of_mark = f"{key}: the clicks on the {which} mark"
        problem = _with_mark(problem, seen, of_mark, measured.click_sigma_px, min_parallax_deg)
    return problem, KnownSpan((a, a + 1), length, sigma, measured.click_sigma_px)


def in_words(scale: ScaleSource, problem: Problem) -> str:
    """What a source of scale measures, and the measure, for the result and its readers."""
    return f"{name_of(scale, problem)}: {scale.length_m:g} m"


def name_of(scale: ScaleSource, problem: Problem) -> str:
    """What a source of scale measures."""
    if isinstance(scale, KnownBaseline):
        a, b = (problem.initial.cameras[i].name for i in scale.cameras)
        return f"baseline {a} to {b}"
    if isinstance(scale, KnownPath):
        a, b = (problem.frame_names[i] for i in scale.frames)
        return f"distance from frame {a} to frame {b}"
    spans = [one for one in problem.scales if isinstance(one, KnownSpan)]
    which = f" (scale.points.{spans.index(scale)})" if len(spans) > 1 else ""
    return f"distance between two clicked marks{which}"


def _placed(key: str, name: str, problem: Problem) -> int:
    """Index of a frame that the mapping placed."""
    if name not in problem.frame_names:
        raise CalibrationError(
            f"{key}: frame {name} could not be placed; choose one of those that were: "
            f"{nearest(name, problem.frame_names)}"
        )
    return problem.frame_names.index(name)


def _clicks_seen(key: str, problem: Problem, clicks: Sequence[ClickConfig]) -> Observations:
    """Clicks on one mark as observations of the point that comes after all others.

    Raises CalibrationError where the mapping lost an image, or its lens sees nothing there.
    """
    seen = problem.observations
    cameras = [camera.name for camera in problem.initial.cameras]
    frame = np.array([_placed(key, click.frame, problem) for click in clicks])
    camera = np.array([cameras.index(click.camera) for click in clicks])
    for click, f, c in zip(clicks, frame, camera, strict=True):
        if not ((seen.frame == f) & (seen.camera == c)).any():
            raise CalibrationError(
                f"{key}: the image {_image_of(click)} could not be placed on the rig; click the "
                "mark in another image"
            )
        if np.isnan(unproject(problem.initial.cameras[c], np.array(click.pixel))).any():
            raise CalibrationError(
                f"{key}: as mapping found its lens, {click.camera} sees nothing at the click "
                f"({click.pixel[0]:g}, {click.pixel[1]:g}) in {_image_of(click)}; click the mark "
                "where it is nearer to the middle of an image"
            )
    pixels = np.array([click.pixel for click in clicks])
    return Observations(pixels, frame, camera, np.full(len(clicks), len(problem.initial.points)))


def _with_mark(
    problem: Problem,
    clicks: Observations,
    key: str,
    click_sigma_px: float,
    min_parallax_deg: float,
) -> Problem:
    """The problem with one more point, where the rays of these clicks meet.

    Raises CalibrationError where they are nearly parallel, or do not meet.
    """
    start, seen = problem.initial, problem.observations
    place, parallax_deg = _meeting_point(start, clicks)
    if not parallax_deg >= min_parallax_deg:
        raise CalibrationError(
            f"{key} see it under {parallax_deg:.2g} deg of parallax (needs {min_parallax_deg:g}): "
            "click it in images that were taken farther apart, or choose a nearer mark"
        )
    together = replace(start, points=np.vstack([start.points, place]))
    missed_px = np.linalg.norm(residuals_px(together, clicks), axis=1)
    allowed_px = MEETING_SIGMAS * float(np.hypot(click_sigma_px, noise_of(problem)))
    if not missed_px.max() < allowed_px:
        worst = int(np.argmax(np.nan_to_num(missed_px, nan=np.inf)))
        image = (
            f"{start.cameras[clicks.camera[worst]].name}/{problem.frame_names[clicks.frame[worst]]}"
        )
        missed = "out of sight" if np.isnan(missed_px[worst]) else f"{missed_px[worst]:.0f} px off"
        raise CalibrationError(
            f"{key} do not meet: in {image}, the place where they come closest is {missed} (up to "
            f"{allowed_px:.0f} px pass with click_sigma_px = {click_sigma_px:g}); click one and "
            "the same spot in every image"
        )
    return replace(problem, initial=together, observations=joined([seen, clicks]))


def _meeting_point(start: Estimate, clicks: Observations) -> tuple[FloatArray, float]:
    """The place (3,) nearest to the rays of clicks in pixels, and the widest angle between them.

    Least squares of the distances from the rays, each over that to its camera and times its focal
    length, in turns with these weights. NaN where all rays are parallel.
    """
    rays, centres, focal = np.empty((len(clicks), 3)), np.empty((len(clicks), 3)), []
    for i, (pixel, f, c) in enumerate(zip(clicks.pixels, clicks.frame, clicks.camera, strict=True)):
        world_from_cam = (start.cam_from_rig[c] @ start.rig_from_world[f]).inverse
        rays[i] = world_from_cam.rotation @ unproject(start.cameras[c], pixel)
        centres[i] = world_from_cam.translation
        focal.append(float(focal_on_axis(start.cameras[c]).mean()))
    between = np.linalg.norm(rays[:, None] - rays[None], axis=-1)
    widest = float(np.degrees(2 * np.arcsin(np.clip(between.max() / 2, 0, 1))))
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    weight, place = np.ones(len(clicks)), np.full(3, np.nan)
    for _ in range(MEETING_STEPS if widest > 0 else 0):
        normal = (weight[:, None, None] * across).sum(0)
        place = np.linalg.pinv(normal) @ np.einsum("n,nij,nj->i", weight, across, centres)
        distance = np.linalg.norm(place - centres, axis=1)
        weight = (np.array(focal) / np.maximum(distance, 1e-12)) ** 2
        weight /= weight.max()
    return place, widest

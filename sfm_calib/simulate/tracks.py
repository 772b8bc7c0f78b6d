"""Feature tracks without images: the quick simulation for tests and studies.

Points fill a scene of `scenes.py`; a pixel is the projection plus Gaussian noise, or an outlier, as
`keypoints.py` has them. Occlusion is ignored. Nothing here needs open3d.
"""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

import sfm_calib
from graphs.camera import Camera, focal_on_axis, nominal_params, project
from graphs.frames import FloatArray, Transform
from graphs.lenses import LensName
from graphs.problem import Estimate, KnownBaseline, Observations, Problem, points_in_cameras
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically
from sfm_calib.result import save_calibration, truth
from sfm_calib.simulate.keypoints import (
    OutlierKind,
    draw_scales,
    relative_noise,
    with_outliers,
)
from sfm_calib.simulate.rigs import RigName, SimulatedRig, TrajectoryName, make_rig, make_trajectory
from sfm_calib.simulate.scenes import SceneName, scene_points

NEAREST_M = 0.3  # features closer than this are out of focus
MIN_OBSERVATIONS_A_FRAME = 6  # three points fix a frame; six leave something to check


class TrackOptions(BaseModel):
    """What to simulate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rig: RigName = "triple"
    """Cameras and how they sit on the rig."""
    trajectory: TrajectoryName = "handheld"
    """How the rig moves through the room."""
    scene: SceneName = "room"
    """Where the points are: in the whole room, on its wall at +y, on that wall without relief, or
    on its floor."""
    frames: int = 40
    """How many images each camera takes."""
    size: tuple[int, int] = (640, 480)
    """Width and height of every image in px."""
    lens: LensName = "radial"
    """Lens model of every camera."""
    points: int = 5000
    """Points in the scene; some are never seen."""
    max_points_per_image: int = 300
    """An image sees a random choice of its points, at most so many."""
    max_track_frames: int = 30
    """A point is lost after so many consecutive frames: appearance changes."""
    min_track_length: int = 3
    """Observations that a point needs to be kept."""
    sigma_px: float = 0.5
    """Gaussian noise of each pixel coordinate."""
    noise_by_scale: bool = False
    """Draw each keypoint a scale in px, known to the problem; coarse ones are noisier."""
    outlier_share: float = 0.0
    """Share of the observations that are wrong."""
    outlier_kind: OutlierKind = "uniform"
    """uniform: anywhere in the image; heavy: Student's t around the right place."""
    focal_error: float = 0.03
    """Relative error of the initial focal length, the same for all cameras."""
    principal_point_error_px: float = 6.0
    """Distance of the initial principal point from the true one."""
    rotation_error_deg: float = 1.0
    """Sigma about each axis of the initial frames and of the cameras in the rig."""
    translation_error_m: float = 0.03
    """Sigma along each axis of the initial frames; a third of it for the cameras in the rig."""
    point_error_m: float = 0.05
    """Sigma along each axis of the initial points."""
    baseline_sigma_m: float = 0.0005
    """Sigma of the measured first baseline, the problem's scale; 0: none measured."""


def simulate_tracks(
    options: TrackOptions, rng: np.random.Generator, rig: SimulatedRig | None = None
) -> tuple[Problem, Estimate]:
    """Tracks of a preset rig on a preset trajectory, and the truth of every variable.

    rig: in place of the preset; the first camera's frame is its own.

    Points with fewer than `min_track_length` observations and frames with fewer than
    MIN_OBSERVATIONS_A_FRAME are left out of both. Frame names are those of the whole trajectory.

    Raises CalibrationError for impossible options, and when nothing remains.
    """
    check_options(options)
    rig = rig or make_rig(options.rig, options.lens, options.size)
    rig_from_world = tuple(make_trajectory(options.trajectory, options.frames, rng))
    points = scene_points(options.scene, options.points, rng)
    whole = Estimate(rig.cameras, rig.cam_from_rig, rig_from_world, points)
    exact = _visible(whole, options, rng)
    kept = _well_observed(exact, options)
    if not len(kept):
        raise CalibrationError(
            f"no point of {options.points} is seen {options.min_track_length} times in "
            f"{options.frames} frames: give more points or frames, or a shorter min_track_length"
        )
    frames, seen = np.unique(kept.frame), np.unique(kept.point)
    true = replace(
        whole,
        rig_from_world=tuple(rig_from_world[f] for f in frames),
        points=whole.points[seen],
    )
    numbered = replace(
        kept,
        frame=np.searchsorted(frames, kept.frame),
        point=np.searchsorted(seen, kept.point),
    )
    observations = _with_errors(numbered, true, options, rng)
    names = tuple(f"{f:06d}" for f in frames)
    scales = _measured_baseline(rig, options, rng)
    return Problem(_perturbed(true, options, rng), observations, names, 0, scales), true


def check_options(options: TrackOptions) -> None:
    """Raise CalibrationError with the first impossible option, its value and the remedy."""
    at_least = {"frames": 1, "points": 1, "max_points_per_image": 1, "max_track_frames": 1}
    at_least["min_track_length"] = 2  # one view of a point tells nothing
    for name, least in at_least.items():
        if (value := getattr(options, name)) < least:
            raise CalibrationError(f"{name} is {value}: give {least} or more")
    if min(options.size) < 64:
        raise CalibrationError(
            f"size is {options.size[0]} x {options.size[1]} px: give sides of 64 px or more"
        )
    if not 0 <= options.outlier_share < 1:
        raise CalibrationError(
            f"outlier_share is {options.outlier_share}: give a share from 0 to less than 1"
        )
    sigmas = ("sigma_px", "rotation_error_deg", "translation_error_m", "point_error_m")
    for name in (*sigmas, "principal_point_error_px", "baseline_sigma_m"):
        value = getattr(options, name)
        if not (math.isfinite(value) and value >= 0):
            raise CalibrationError(f"{name} is {value}: give 0 or more")
    if not -0.9 < options.focal_error < 10:
        raise CalibrationError(
            f"focal_error is {options.focal_error}: give -0.9 to 10, like 0.03 for 3 %"
        )


def _visible(whole: Estimate, options: TrackOptions, rng: np.random.Generator) -> Observations:
    """Exact projections within the images, each point in one run of frames, each image capped."""
    width, height = options.size
    run = options.max_track_frames
    first_frame = rng.integers(1 - run, options.frames, len(whole.points))
    if run >= options.frames:
        first_frame[:] = 0
    parts = []
    for frame, placed in enumerate(whole.rig_from_world):
        running = np.flatnonzero((frame >= first_frame) & (frame < first_frame + run))
        in_rig = placed @ whole.points[running]
        for index, camera in enumerate(whole.cameras):
            in_camera = whole.cam_from_rig[index] @ in_rig
            pixels = project(camera, in_camera)
            with np.errstate(invalid="ignore"):
                seen = (pixels >= 0).all(1) & (pixels <= (width - 1, height - 1)).all(1)
            seen &= np.linalg.norm(in_camera, axis=1) > NEAREST_M
            kept = np.flatnonzero(seen)
            if len(kept) > options.max_points_per_image:
                kept = np.sort(rng.choice(kept, options.max_points_per_image, replace=False))
            same = np.ones(len(kept), np.int64)
            parts.append(Observations(pixels[kept], frame * same, index * same, running[kept]))
    return Observations(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.frame for part in parts]),
        np.concatenate([part.camera for part in parts]),
        np.concatenate([part.point for part in parts]),
    )


def _well_observed(observations: Observations, options: TrackOptions) -> Observations:
    """Without short tracks and without frames that see next to nothing, until none is left."""
    while len(observations):
        views = np.bincount(observations.point)[observations.point]
        in_frame = np.bincount(observations.frame)[observations.frame]
        keep = (views >= options.min_track_length) & (in_frame >= MIN_OBSERVATIONS_A_FRAME)
        if keep.all():
            break
        observations = observations.subset(keep)
    return observations


def _with_errors(
    exact: Observations, true: Estimate, options: TrackOptions, rng: np.random.Generator
) -> Observations:
    """The observations with noise, outliers and, where asked for, scales of the keypoints."""
    scale, sigma_px = None, np.full(len(exact), options.sigma_px)
    if options.noise_by_scale:
        distance_m = np.linalg.norm(points_in_cameras(true, exact), axis=1)
        scale = draw_scales(exact.point, distance_m, len(true.points), rng)
        sigma_px = sigma_px * relative_noise(scale)
    pixels = exact.pixels + sigma_px[:, None] * rng.standard_normal(exact.pixels.shape)
    pixels = with_outliers(pixels, options.outlier_share, options.outlier_kind, options.size, rng)
    return replace(exact, pixels=pixels, feature_scale=scale)


def _perturbed(true: Estimate, options: TrackOptions, rng: np.random.Generator) -> Estimate:
    """Where a solver starts: square pixels, no distortion, everything else off as stated."""
    turn = np.deg2rad(options.rotation_error_deg)
    shift, baseline_shift = options.translation_error_m, options.translation_error_m / 3

    def moved(b_from_a: Transform, shift_m: float) -> Transform:
        step = Transform.exp(turn * rng.standard_normal(3), shift_m * rng.standard_normal(3))
        return step @ b_from_a

    cameras = []
    for camera in true.cameras:
        angle = rng.uniform(0, 2 * np.pi)
        error = options.principal_point_error_px * np.array([np.cos(angle), np.sin(angle)])
        focal_px = float(focal_on_axis(camera)[0]) * (1 + options.focal_error)
        params = nominal_params(camera.lens, camera.size, focal_px)
        params[2:4] = camera.params[2:4] + error
        cameras.append(replace(camera, params=params))
    others = tuple(moved(t, baseline_shift) for t in true.cam_from_rig[1:])
    return Estimate(
        tuple(cameras),
        (true.cam_from_rig[0], *others),
        tuple(moved(t, shift) for t in true.rig_from_world),
        true.points + options.point_error_m * rng.standard_normal(true.points.shape),
    )


def _measured_baseline(
    rig: SimulatedRig, options: TrackOptions, rng: np.random.Generator
) -> tuple[KnownBaseline, ...]:
    """The first baseline as a tape would have it, if any: its error follows the sigma stated."""
    if len(rig.cameras) < 2 or options.baseline_sigma_m == 0:
        return ()
    first, second = (t.inverse.translation for t in rig.cam_from_rig[:2])
    length_m = float(np.linalg.norm(second - first)) + options.baseline_sigma_m * rng.normal()
    return (KnownBaseline((0, 1), length_m, options.baseline_sigma_m),)


# ---- storage -------------------------------------------------------------------------------

TRACKS_FILE, TRUTH_FILE = "tracks.npz", "truth.json"
Arrays = dict[str, NDArray[Any]]


def write_tracks(problem: Problem, true: Estimate, folder: Path) -> None:
    """Write FOLDER/tracks.npz (everything, exactly) and FOLDER/truth.json (the cameras and rig).

    Raises CalibrationError when the place cannot be written.
    """
    cameras = problem.initial.cameras
    arrays: Arrays = {
        "pixels": problem.observations.pixels,
        "frame": problem.observations.frame,
        "camera": problem.observations.camera,
        "point": problem.observations.point,
        "frame_names": np.array(problem.frame_names),
        "camera_names": np.array([camera.name for camera in cameras]),
        "lenses": np.array([camera.lens for camera in cameras]),
        "sizes": np.array([camera.size for camera in cameras]),
        "reference": np.array(problem.reference),
    }
    if problem.observations.feature_scale is not None:
        arrays["feature_scale"] = problem.observations.feature_scale
    baselines = [one for one in problem.scales if isinstance(one, KnownBaseline)]
    if baselines:
        arrays["scale_cameras"] = np.array([one.cameras for one in baselines])
        arrays["scale"] = np.array([(one.length_m, one.sigma_m) for one in baselines])
    arrays |= _estimate_arrays("initial", problem.initial) | _estimate_arrays("truth", true)
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    calibration = truth(list(true.cameras), list(true.cam_from_rig), sfm_calib.__version__)
    write_atomically(folder / TRACKS_FILE, content.getvalue())
    save_calibration(calibration, folder / TRUTH_FILE)


def read_tracks(folder: Path) -> tuple[Problem, Estimate]:
    """What `write_tracks` wrote. Raises CalibrationError when it is missing or something else."""
    path = folder / TRACKS_FILE
    try:
        # opened here: np.load leaves a file open that it cannot read
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        return _problem_from(arrays), _estimate_from("truth", arrays)
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from error
    except (KeyError, ValueError, IndexError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise CalibrationError(
            f"{path} is no file of simulated tracks ({error}): "
            "write it anew with sfm-calib simulate-tracks"
        ) from error


def _estimate_arrays(prefix: str, estimate: Estimate) -> Arrays:
    """One estimate; lens parameters are padded with NaN to the longest lens."""
    longest = max(camera.params.size for camera in estimate.cameras)
    params = np.full((len(estimate.cameras), longest), np.nan)
    for row, camera in zip(params, estimate.cameras, strict=True):
        row[: camera.params.size] = camera.params
    return {
        f"{prefix}_params": params,
        f"{prefix}_cam_from_rig": _stacked(estimate.cam_from_rig),
        f"{prefix}_rig_from_world": _stacked(estimate.rig_from_world),
        f"{prefix}_points": estimate.points,
    }


def _stacked(transforms: tuple[Transform, ...]) -> FloatArray:
    """Rotation and translation side by side (n, 3, 4)."""
    return np.array([np.column_stack([t.rotation, t.translation]) for t in transforms])


def _problem_from(arrays: Arrays) -> Problem:
    scales: tuple[KnownBaseline, ...] = ()
    if "scale" in arrays:  # files of old hold one, flat
        cameras = arrays["scale_cameras"].reshape(-1, 2).tolist()
        lengths = arrays["scale"].reshape(-1, 2).tolist()
        scales = tuple(
            KnownBaseline((a, b), *length) for (a, b), length in zip(cameras, lengths, strict=True)
        )
    return Problem(
        _estimate_from("initial", arrays),
        replace(
            Observations(*(arrays[name] for name in ("pixels", "frame", "camera", "point"))),
            feature_scale=arrays.get("feature_scale"),
        ),
        tuple(arrays["frame_names"].tolist()),
        int(arrays["reference"]),
        scales,
    )


def _estimate_from(prefix: str, arrays: Arrays) -> Estimate:
    columns = (
        arrays["camera_names"],
        arrays["lenses"],
        arrays["sizes"],
        arrays[f"{prefix}_params"],
    )
    cameras = tuple(
        Camera(str(name), lens.item(), tuple(size.tolist()), params[np.isfinite(params)])
        for name, lens, size, params in zip(*columns, strict=True)
    )
    rig, frames = (
        tuple(Transform(m[:, :3].copy(), m[:, 3].copy()) for m in arrays[f"{prefix}_{name}"])
        for name in ("cam_from_rig", "rig_from_world")
    )
    return Estimate(cameras, rig, frames, arrays[f"{prefix}_points"])

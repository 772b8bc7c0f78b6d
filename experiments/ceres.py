"""The judge of the benchmark: the same problem, solved by pycolmap's Ceres bundle adjustment.

Our arrays become a COLMAP model with one rig, so that Ceres adjusts what we adjust: a pose a
frame, one cam_from_rig a camera, a full OPENCV lens a camera, the points.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pycolmap
from pycolmap._core import pyceres

from graphs.build import GraphOptions
from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate, IntArray, Problem
from sfm_calib.colmap import PIXEL_OFFSET, camera_from_colmap, colmap_camera, quiet
from sfm_calib.colmap_lenses import EXACT_MODEL

# COLMAP turns to iterative solvers above 1,000 images: 4 to 5 times slower at the same cost.
MOST_IMAGES_DIRECT = 10**6
# COLMAP's own choice between a dense and a sparse direct solver stands: sparse above 50 images.
# Dense takes as long at 150 and 600 images (25k, 100k and 400k observations), and 3.5 times as
# long at 3,000 (400k).
# COLMAP's Levenberg-Marquardt takes 16, 24, 28 and 24 iterations at 25k, 100k, 400k (600 images)
# and 400k (3,000); dogleg steps take 17, 18, 17 and 18, each as long, to the same cost.
STRATEGY = pyceres.TrustRegionStrategyType.DOGLEG
TABLE_COLUMNS = 10  # of what Ceres prints: iter, cost, cost_change, ..., total_time
FIRST_ID = 1  # COLMAP counts from one
EXACT_LENSES = ("pinhole", "radtan", "kannala_brandt")  # COLMAP has these, no more and no less
LOSSES = {
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
    "huber": pycolmap.LossFunctionType.HUBER,
    "none": pycolmap.LossFunctionType.TRIVIAL,
}


@dataclass(frozen=True)
class CeresResult:
    """Where Ceres ended, and what it took: setting up its problem and solving it."""

    estimate: Estimate
    seconds: float
    iterations: int
    converged: bool
    trace: list[tuple[float, float]]  # after each iteration: seconds since the start, lowest cost


def ceres_bundle_adjust(
    problem: Problem, options: GraphOptions, relative_tolerance: float, max_iterations: int = 100
) -> CeresResult:
    """Bundle-adjust `problem` with everything free and no priors, as fast as COLMAP can.

    A direct solver, all cores, the gauge fixed; the model is loaded before the clock starts.
    Raises ValueError for a problem that COLMAP cannot state exactly.
    """
    _check_exact(problem, options)
    quiet(verbose=False)
    model = reconstruction_of(problem)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    settings = _settings(options, relative_tolerance, max_iterations)
    start = time.perf_counter()
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(settings, config, model)
    loaded = time.perf_counter() - start
    # The stub names the base class, without Ceres's own summary.
    summary, table = captured(lambda: cast(Any, adjuster.solve()))
    seconds = time.perf_counter() - start
    report = summary.ceres_summary
    return CeresResult(
        estimate_of(model, problem),
        seconds,
        report.num_successful_steps + report.num_unsuccessful_steps,
        bool(summary.is_solution_usable()),
        [(loaded + at, cost) for at, cost in trace_of(table, report.final_cost)],
    )


def captured(call: Callable[[], Any]) -> tuple[Any, str]:
    """The result of a call, and what compiled code printed on standard output meanwhile."""
    sys.stdout.flush()
    with tempfile.TemporaryFile("w+") as file:
        stdout = os.dup(1)
        os.dup2(file.fileno(), 1)
        try:
            result = call()
        finally:
            ctypes.CDLL(None).fflush(None)  # a file is written to in blocks
            os.dup2(stdout, 1)
            os.close(stdout)
        file.seek(0)
        return result, file.read()


def trace_of(table: str, final_cost: float) -> list[tuple[float, float]]:
    """Seconds and lowest cost after each iteration, from the table that Ceres prints.

    Costs are summed up from the decreases, backwards: those have three digits, whereas the
    costs' own seven could not show the last of them.
    """
    rows = [line.split() for line in table.splitlines()]
    rows = [row for row in rows if len(row) == TABLE_COLUMNS and row[0].isdigit()]
    trace = []
    cost = final_cost
    for row in reversed(rows):
        trace.append((float(row[-1]), cost))
        cost += max(float(row[2]), 0.0)  # a step that raises the cost is refused
    return trace[::-1]


def _check_exact(problem: Problem, options: GraphOptions) -> None:
    if problem.scales:
        raise ValueError("COLMAP has no measured baselines: give a problem without one")
    for camera in problem.initial.cameras:
        if camera.lens not in EXACT_LENSES:
            raise ValueError(f"COLMAP would free more than {camera.lens}: use {EXACT_LENSES}")
    if options.loss not in LOSSES:
        raise ValueError(f"COLMAP has no loss {options.loss}: use one of {tuple(LOSSES)}")
    if problem.observations.relative_sigma is not None:
        raise ValueError("COLMAP weighs all observations alike: give none a sigma of its own")


def _settings(
    options: GraphOptions, relative_tolerance: float, max_iterations: int
) -> pycolmap.BundleAdjustmentOptions:
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = False
    settings.refine_principal_point = True
    ceres = settings.ceres
    ceres.min_num_residuals_for_cpu_multi_threading = 0
    ceres.max_num_images_direct_sparse_cpu_solver = MOST_IMAGES_DIRECT
    # GTSAM: k^2/2 log(1 + r^2 / k^2) of r in sigmas; Ceres: a^2/2 log(1 + r^2 / a^2) of r in px.
    ceres.loss_function_type = LOSSES[options.loss]
    ceres.loss_function_scale = options.loss_scale * options.sigma_px
    ceres.solver_options.trust_region_strategy_type = STRATEGY
    ceres.solver_options.function_tolerance = relative_tolerance
    ceres.solver_options.gradient_tolerance = 0.0
    ceres.solver_options.max_num_iterations = max_iterations
    ceres.solver_options.minimizer_progress_to_stdout = True
    ceres.solver_options.logging_type = pyceres.LoggingType.PER_MINIMIZER_ITERATION
    return settings


def reconstruction_of(problem: Problem) -> pycolmap.Reconstruction:
    """The problem's start as a COLMAP model: one rig, a frame a frame, an image a view."""
    model = pycolmap.Reconstruction()
    start, seen = problem.initial, problem.observations
    _add_rig(model, problem)
    n_cameras = len(start.cameras)
    image = seen.frame * n_cameras + seen.camera
    rows_of_image = grouped(image, n_cameras * len(start.rig_from_world))
    keypoint = np.zeros(len(seen), dtype=np.int64)
    for rows in rows_of_image:
        keypoint[rows] = np.arange(len(rows))
    for frame, rig_from_world in enumerate(start.rig_from_world):
        views = rows_of_image[frame * n_cameras : (frame + 1) * n_cameras]
        _add_frame(model, frame, rig_from_world, [seen.pixels[rows] for rows in views])
    rows_of_point = grouped(seen.point, len(start.points))
    for position, rows in zip(start.points, rows_of_point, strict=True):
        track = pycolmap.Track()
        for row in rows.tolist():
            track.add_element(int(image[row]) + FIRST_ID, int(keypoint[row]))
        model.add_point3D(position, track, np.zeros(3, np.uint8))
    return model


def _add_rig(model: pycolmap.Reconstruction, problem: Problem) -> None:
    rig = pycolmap.Rig(rig_id=FIRST_ID)
    for index, camera in enumerate(problem.initial.cameras):
        twin = colmap_camera(camera, EXACT_MODEL[camera.lens], index + FIRST_ID)
        model.add_camera(twin)
        if index == problem.reference:
            rig.add_ref_sensor(twin.sensor_id)
    for index, cam_from_rig in enumerate(problem.initial.cam_from_rig):
        if index != problem.reference:
            rig.add_sensor(model.cameras[index + FIRST_ID].sensor_id, _rigid(cam_from_rig))
    model.add_rig(rig)


def _add_frame(
    model: pycolmap.Reconstruction, frame: int, rig_from_world: Transform, pixels: list[FloatArray]
) -> None:
    """One frame with an image a camera, `pixels` (n, 2) of each."""
    entry = pycolmap.Frame(frame_id=frame + FIRST_ID, rig_id=FIRST_ID)
    entry.rig_from_world = _rigid(rig_from_world)
    images = []
    for camera, seen in enumerate(pixels):
        image = pycolmap.Image(
            name=f"{camera}/{frame}",
            points2D=pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in seen + PIXEL_OFFSET]),
            camera_id=camera + FIRST_ID,
            image_id=frame * len(pixels) + camera + FIRST_ID,
        )
        image.frame_id = entry.frame_id
        entry.add_data_id(image.data_id)
        images.append(image)
    model.add_frame(entry)
    for image in images:
        model.add_image(image)
    model.register_frame(entry.frame_id)


def grouped(owner: IntArray, n_owners: int) -> list[IntArray]:
    """Rows of each owner, in order."""
    order = np.argsort(owner, kind="stable")
    ends = np.cumsum(np.bincount(owner, minlength=n_owners))
    return np.split(order, ends[:-1])


def estimate_of(model: pycolmap.Reconstruction, problem: Problem) -> Estimate:
    """A COLMAP model made by `reconstruction_of`, back in our arrays."""
    start = problem.initial
    rig = model.rigs[FIRST_ID]
    cameras = tuple(
        camera_from_colmap(camera.name, camera.lens, model.cameras[index + FIRST_ID])
        for index, camera in enumerate(start.cameras)
    )
    cam_from_rig = tuple(
        Transform.identity()
        if index == problem.reference
        else _transform(rig.sensor_from_rig(model.cameras[index + FIRST_ID].sensor_id))
        for index in range(len(cameras))
    )
    rig_from_world = tuple(
        _transform(model.frames[frame + FIRST_ID].rig_from_world)
        for frame in range(len(start.rig_from_world))
    )
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    return replace(
        start,
        cameras=cameras,
        cam_from_rig=cam_from_rig,
        rig_from_world=rig_from_world,
        points=points,
    )


def _rigid(transform: Transform) -> pycolmap.Rigid3d:
    matrix = np.column_stack([transform.rotation, transform.translation])
    return pycolmap.Rigid3d(matrix)


def _transform(rigid: pycolmap.Rigid3d | None) -> Transform:
    assert rigid is not None  # every frame and every sensor was given one
    return Transform(rigid.rotation.matrix(), np.ravel(rigid.translation))

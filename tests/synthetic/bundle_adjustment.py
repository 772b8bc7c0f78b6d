"""COLMAP's bundle adjustment of a Problem, as a judge of ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap

from graphs.build import GraphOptions
from graphs.frames import Transform
from graphs.problem import Estimate, Problem
from sfm_calib.colmap import colmap_camera, parameter_names
from sfm_calib.colmap_lenses import EXACT_MODEL

COLMAP_LOSS = {"none": "TRIVIAL", "cauchy": "CAUCHY"}


def rigid(b_from_a: Transform) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(b_from_a.rotation), b_from_a.translation)


def reconstruction_of(problem: Problem, start: Estimate) -> pycolmap.Reconstruction:
    """The same rig, frames, points and observations for COLMAP; its ids count from one."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    sensors = []
    for index, camera in enumerate(start.cameras):
        colmap = colmap_camera(camera, EXACT_MODEL[camera.lens], index + 1)
        model.add_camera(colmap)
        sensors.append(colmap.sensor_id)
        if index == problem.reference:
            rig.add_ref_sensor(colmap.sensor_id)
        else:
            rig.add_sensor(colmap.sensor_id, rigid(start.cam_from_rig[index]))
    model.add_rig(rig)
    seen, n_cameras = problem.observations, len(start.cameras)
    rows = {
        (f, c): np.flatnonzero((seen.frame == f) & (seen.camera == c))
        for f in range(len(start.rig_from_world))
        for c in range(n_cameras)
    }
    for f, rig_from_world in enumerate(start.rig_from_world):
        frame = pycolmap.Frame(frame_id=f + 1, rig_id=1)
        for c in range(n_cameras):
            frame.add_data_id(pycolmap.data_t(sensors[c], f * n_cameras + c + 1))
        frame.rig_from_world = rigid(rig_from_world)
        model.add_frame(frame)
    for (f, c), own in rows.items():
        image = pycolmap.Image(
            name=f"{c}/{f}",
            keypoints=seen.pixels[own] + 0.5,
            camera_id=c + 1,
            image_id=f * n_cameras + c + 1,
        )
        image.frame_id = f + 1
        model.add_image(image)
    for f in range(len(start.rig_from_world)):
        model.register_frame(f + 1)
    keypoint = {int(row): place for own in rows.values() for place, row in enumerate(own)}
    for point, xyz in enumerate(start.points):
        track = pycolmap.Track()
        for row in np.flatnonzero(seen.point == point).tolist():
            track.add_element(
                int(seen.frame[row]) * n_cameras + int(seen.camera[row]) + 1, keypoint[row]
            )
        model.add_point3D(xyz, track)
    return model


def bundle_adjust(
    problem: Problem, start: Estimate, options: GraphOptions
) -> tuple[Estimate, float]:
    """COLMAP's optimum from `start`, and Ceres's cost in px squared."""
    model = reconstruction_of(problem, start)
    settings = pycolmap.BundleAdjustmentOptions()
    settings.print_summary = False
    settings.refine_principal_point = True
    settings.ceres.loss_function_type = pycolmap.LossFunctionType(COLMAP_LOSS[options.loss])
    settings.ceres.loss_function_scale = options.loss_scale * options.sigma_px
    settings.ceres.solver_options.max_num_iterations = 500
    settings.ceres.solver_options.function_tolerance = 0.0
    settings.ceres.solver_options.gradient_tolerance = 1e-10
    settings.ceres.solver_options.parameter_tolerance = 1e-12
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_ceres_bundle_adjuster(settings, config, model).solve()
    assert summary.num_residuals == 2 * len(problem.observations)
    return estimate_of(model, problem), summary.ceres_summary.final_cost


def transform_of(b_from_a: pycolmap.Rigid3d) -> Transform:
    return Transform(b_from_a.rotation.matrix(), np.ravel(b_from_a.translation))


def estimate_of(model: pycolmap.Reconstruction, problem: Problem) -> Estimate:
    cameras, cam_from_rig = [], []
    for index, camera in enumerate(problem.initial.cameras):
        colmap = model.cameras[index + 1]
        named = dict(zip(parameter_names(colmap), colmap.params.tolist(), strict=True))
        named |= {"cx": named["cx"] - 0.5, "cy": named["cy"] - 0.5}
        cameras.append(replace(camera, params=np.array([named[name] for name in camera.names])))
        is_reference = index == problem.reference
        cam_from_rig.append(
            Transform.identity()
            if is_reference
            else transform_of(model.rigs[1].sensor_from_rig(colmap.sensor_id))
        )
    frames = [model.frames[f + 1].rig_from_world for f in range(len(problem.frame_names))]
    points = np.array([model.points3D[i].xyz for i in sorted(model.points3D)])
    return Estimate(tuple(cameras), tuple(cam_from_rig), tuple(map(transform_of, frames)), points)

"""Run by the Python that has mrcal, alone: one calibration, JSON from stdin to stdout.

Nothing of this project is imported here: mrcal is a package of the system's Python, with a numpy
of its own.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import mrcal  # type: ignore[import-not-found]
import numpy as np

FULLY_SEEN, NOT_SEEN = 1.0, -1.0  # mrcal's weight of a corner


def main(given: dict[str, Any]) -> dict[str, Any]:
    """Optimise from a start; see `experiments.peers.mrcal` for what comes in and goes out."""
    inputs = inputs_of(given)
    for warped in (False, True) if given["bends"] else (False,):
        # As mrcal-calibrate-cameras does: the board is flat at first.
        if warped:
            inputs["calobject_warp"] = np.zeros(2)
        inputs["do_optimize_calobject_warp"] = warped
        stats = mrcal.optimize(**inputs)
    n = 2 * inputs["observations_board"][..., 0].size
    kept = (inputs["observations_board"][..., 2] > 0).ravel()
    left = stats["x"][:n].reshape(-1, 2)[kept]
    warp = inputs["calobject_warp"]
    return {
        "intrinsics": inputs["intrinsics"].tolist(),
        "cam_from_rig": inputs["extrinsics_rt_fromref"].tolist(),
        "rig_from_board": inputs["frames_rt_toref"].tolist(),
        "bends": [0.0, 0.0] if warp is None else warp.tolist(),
        "rms_px": float(np.sqrt((left**2).sum(1).mean())),
        "n_left_out": int(stats["Noutliers"]),
        "covariance": covariance_of(inputs, left).tolist(),
        "uncertainty": [
            uncertainty_of(inputs, camera, given["grid"], given["distance"])
            for camera in range(len(inputs["intrinsics"]) if given["uncertainty"] else 0)
        ],
    }


def inputs_of(given: dict[str, Any]) -> dict[str, Any]:
    """What `mrcal.optimize` takes."""
    seen = np.array(given["pixels"], dtype=np.float64)  # views, rows, columns, 2; NaN: not seen
    weight = np.where(np.isfinite(seen[..., :1]), FULLY_SEEN, NOT_SEEN)
    places = np.array(given["cam_from_rig"], dtype=np.float64).reshape(-1, 6)
    return {
        "intrinsics": np.array(given["intrinsics"], dtype=np.float64),
        "extrinsics_rt_fromref": places,
        "frames_rt_toref": np.array(given["rig_from_board"], dtype=np.float64),
        "points": None,
        "observations_board": np.concatenate([np.nan_to_num(seen), weight], axis=-1),
        "indices_frame_camintrinsics_camextrinsics": np.array(given["indices"], dtype=np.int32),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": given["lensmodel"],
        "imagersizes": np.array(given["sizes"], dtype=np.int32),
        "calobject_warp": None,
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "calibration_object_spacing": given["square"],
        "do_apply_outlier_rejection": given["reject"],
        "do_apply_regularization": given["regularise"],
        "verbose": False,
    }


def covariance_of(inputs: dict[str, Any], left: Any) -> Any:
    """Covariance of intrinsics, cam_from_rig (r, t) and bends, in this order.

    left (n, 2): residuals of the corners in use, which bring the noise.
    """
    _, _, J, factor = mrcal.optimizer_callback(**inputs)
    n = J.shape[1]
    whole = factor.solve_xt_JtJ_bt(np.eye(n))
    mrcal.unpack_state(whole, **inputs)
    whole = np.ascontiguousarray(whole.T)
    mrcal.unpack_state(whole, **inputs)
    noise = (left**2).sum() / (left.size - n)
    size = inputs["intrinsics"].shape[1]
    columns: list[int] = []
    for camera in range(len(inputs["intrinsics"])):
        start = mrcal.state_index_intrinsics(camera, **inputs)
        columns += range(start, start + size)
    for camera in range(len(inputs["extrinsics_rt_fromref"])):
        start = mrcal.state_index_extrinsics(camera, **inputs)
        columns += range(start, start + 6)
    if inputs["do_optimize_calobject_warp"]:
        start = mrcal.state_index_calobject_warp(**inputs)
        columns += range(start, start + 2)
    return noise * whole[np.ix_(columns, columns)]


def uncertainty_of(
    inputs: dict[str, Any], camera: int, grid: list[list[float]], distance: float
) -> dict[str, float]:
    """Rms over the pixels `grid` of mrcal's projection uncertainty (px, both coordinates)."""
    model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=camera)
    rays = mrcal.unproject(np.array(grid), *model.intrinsics(), normalize=True)
    found = {}
    for name, points, far in (("infinity", rays, True), ("near", distance * rays, False)):
        each = mrcal.projection_uncertainty(points, model=model, atinfinity=far, what="covariance")
        traces = np.trace(each, axis1=-2, axis2=-1)
        found[name] = float(np.sqrt(np.nanmean(traces)))  # NaN: no ray
    return found


if __name__ == "__main__":
    json.dump(main(json.load(sys.stdin)), sys.stdout)
